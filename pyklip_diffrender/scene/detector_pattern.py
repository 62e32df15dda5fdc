"""The detector pattern: the known error of the star model, pixel by pixel."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError, ShapeError
from pyklip_diffrender.io.files import open_fits, require_new, write_fits
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.scene.exposure import (
    CatalogueStar,
    detector_of,
    flat_field_of,
    image_mask,
    star_of,
)
from pyklip_diffrender.scene.observation import Observation

_PROVENANCE = ("stars", "frames", "dates")


def pattern_hdus(
    value: NDArray[np.floating], error: NDArray[np.floating], source: Any, version: int = 1
) -> list[fits.ImageHDU]:
    """Return the FITS extensions PATTERN and PATTERN_ERROR of one of the patterns of a file.

    `value` and `error` are (ny, nx), NaN errors where nothing was measured; `source` has the
    attributes of `DetectorPattern` that go into the header; `version` is the pattern's number in
    the file.
    """
    hdus = [
        fits.ImageHDU(value, name="PATTERN", ver=version),
        fits.ImageHDU(error, name="PATTERN_ERROR", ver=version),
    ]
    header = hdus[0].header
    header["STARX"], header["STARY"] = source.center
    if source.first_pixel is not None:
        header["COLUMN"], header["ROW"] = source.first_pixel
    header["PEDESTAL"] = (source.pedestal, "added to the star, then multiplied")
    header["FILTER"], header["CORONMSK"] = source.filter or "", source.image_mask or ""
    header["DETECTOR"] = source.detector or ""
    header["R_FLAT"] = (source.flat or "", "flat field of the frames' calibration")
    return hdus


def pattern_fields(hdus: fits.HDUList, version: int = 1) -> dict[str, Any]:
    """Return value, error and the other attributes that `pattern_hdus` wrote."""
    header = hdus["PATTERN", version].header
    return {
        "value": native_float64(hdus["PATTERN", version].data),
        "error": native_float64(hdus["PATTERN_ERROR", version].data),
        "center": (float(header["STARX"]), float(header["STARY"])),
        "pedestal": float(header["PEDESTAL"]),
        "first_pixel": (header["COLUMN"], header["ROW"]) if "COLUMN" in header else None,
        "filter": header["FILTER"] or None,
        "image_mask": header["CORONMSK"] or None,
        # Files of earlier versions do not have these two.
        "detector": header.get("DETECTOR") or None,
        "flat": header.get("R_FLAT") or None,
    }


def _star_from(facts: dict[str, Any]) -> CatalogueStar:
    """The star that `asdict` has made a dict of, whose tuples JSON keeps as lists."""
    known: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in facts.items()
    }
    return CatalogueStar(**known)


# Whether something that was learned from frames is for other frames.

HALF_COVERED = 0.5
"""Smallest part of a frame's pixels that a pattern must cover to be chosen; a given pattern that
covers less gets a remark."""

# `learned` is a pattern or the fit of a reference star: it has filter, image_mask, detector and
# flat, None where not known, and stars and names of frames.


def shows_star(learned: Any, observation: Observation) -> bool:
    """Whether something was learned from frames of the star of an observation."""
    own = star_of(observation.header, observation.name)
    if any(
        star.is_same(own) or any(star.is_called(name) for name in own.names)
        for star in learned.stars
    ):
        return True
    # A header without a star, and a name that somebody has given, usually the name of a file.
    return observation.name != Observation.name and observation.name in learned.frames


def _aspects(
    learned: Any, observation: Observation
) -> tuple[tuple[str, str | None, str | None], ...]:
    """Names of the properties that have to agree, each as learned and as observed."""
    header, name = observation.header, observation.name
    return (
        ("filter", learned.filter, observation.filter),
        ("mask", learned.image_mask, image_mask(header, name)),
        ("detector", learned.detector, detector_of(header, name)),
    )


def contradiction(learned: Any, observation: Observation) -> tuple[str, str, str] | None:
    """The first property in which frames differ, as learned and as observed; None if none does.

    The properties are filter, mask and detector. What is not recorded does not differ.
    """
    return next(
        (
            (aspect, before, now)
            for aspect, before, now in _aspects(learned, observation)
            if before is not None and now is not None and before != now
        ),
        None,
    )


def unrecorded(learned: Any, observation: Observation) -> list[str]:
    """The properties that cannot be compared because one of the two does not state them."""
    header = observation.header
    stars = [star_of(header, observation.name), *learned.stars]
    missing = [
        each for each, before, now in _aspects(learned, observation) if None in (before, now)
    ]
    if not learned.stars or not all(star.is_known for star in stars):
        missing.append("star")
    if None in (learned.flat, flat_field_of(header, observation.name)):
        missing.append("flat field")
    return missing


def caveat(pattern: DetectorPattern, observation: Observation) -> str:
    """Reasons against relying on a pattern that is used; empty if there are none.

    Only patterns with values have reasons: where the size alone is known, it is the frames' own.
    """
    if not pattern.value.any():
        return ""
    remarks, missing = [], unrecorded(pattern, observation)
    if missing:
        remarks.append(
            f"not compared, because pattern or frames do not say it: {', '.join(missing)}"
        )
    covered = pattern.covered(observation)
    if covered < HALF_COVERED:
        remarks.append(f"covers {100 * covered:.0f} % of the pixels")
    return "; ".join(remarks)


def require_pattern_of(pattern: DetectorPattern, observation: Observation) -> None:
    """Raise IncompatibleSetupError for a pattern that an observation's pixels cannot have.

    A pattern is refused for another filter, mask or detector, if it covers no pixel, and if it was
    learned from the star of the observation.
    """
    name = f"pattern {pattern.name!r}"
    differing = contradiction(pattern, observation)
    if differing is not None:
        aspect, before, now = differing
        raise IncompatibleSetupError(
            f"{name} was learned with the {aspect} {before}, and {observation.name} has the "
            f"{aspect} {now}. Give a pattern of the same {aspect}, or 'auto'"
        )
    if shows_star(pattern, observation):
        raise IncompatibleSetupError(
            f"{name} was learned from frames of {observation.target}, the star of "
            f"{observation.name}: its planets are part of the pattern, and would be subtracted "
            "with it. Give a pattern of other stars, or 'auto'"
        )
    if pattern.covered(observation) == 0:
        (ny, nx), (rows, columns) = observation.shape, pattern.value.shape
        raise IncompatibleSetupError(
            f"{name} has none of the pixels of {observation.name}: it has {columns} x {rows} from "
            f"{pattern.first_pixel} on (column and row on the detector), the frame {nx} x {ny} "
            f"from {observation.first_pixel} on. Give a pattern of the same subarray, or 'auto'"
        )


@dataclass(frozen=True, eq=False)
class DetectorPattern:
    """A multiplicative pattern that the star model misses, with its uncertainty.

    The part of a star's image that no wavefront explains is, on the same pixels of the detector,
    largely the same fraction of the light of every star: mostly an error of the flat field.
    The star in pixel p is taken to be ``model_p * (1 + m_p) + pedestal * m_p``, where m_p is
    Gaussian with mean `value` and standard deviation `error`. Frames of the same pixels that are
    fitted together share m_p. Light of companions is not multiplied: nothing of it can be mistaken
    for the pattern.

    Attributes
    ----------
    value : ndarray, (ny, nx)
        Residual over star.
    error : ndarray, (ny, nx)
        Standard deviation of the pattern.
    center : tuple of float
        x, y of the star in the pattern, 0-indexed pixels.
    unknown : float
        Standard deviation of the pattern where it has not been measured.
    pedestal : float
        Constant, in the unit of the frames, that is added to the star before the pattern
        multiplies it. A fit starts from it, and has a free pedestal in every frame. The pedestal
        stands for what fixed patterns leave far from the star: the pattern of the flat field in the
        thermal background, which was subtracted as if the flat field were perfect, and the pattern
        of the dark current.
    first_pixel : tuple of int or None
        Column and row of the pattern's first pixel on the full detector, as of an `Observation`.
    filter, image_mask, detector : str or None
        Set-up of the pattern; None where it is not known.
    flat : str or None
        Flat field with which the frames of the pattern were calibrated (R_FLAT).
    catalogue : tuple of CatalogueStar
        Names and coordinates of the stars that the pattern was learned from.
    name : str
        Short label for headers.
    provenance : dict
        Frames that the pattern was learned from, and how.

    Examples
    --------
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> flat = np.full((8, 8), 0.002)
    >>> dr.DetectorPattern(flat, flat / 4, center=(3.5, 3.5), unknown=0.005, name="flat field")
    <DetectorPattern 'flat field': None, 8 x 8 pixels>
    """

    value: NDArray[np.float64]
    error: NDArray[np.float64]
    center: tuple[float, float]
    unknown: float
    pedestal: float = 0.0
    first_pixel: tuple[int, int] | None = None
    filter: str | None = None
    image_mask: str | None = None
    name: str = "pattern"
    provenance: dict[str, Any] = field(default_factory=dict)
    detector: str | None = None
    flat: str | None = None
    catalogue: tuple[CatalogueStar, ...] = ()

    def __post_init__(self) -> None:
        if self.value.ndim != 2 or self.value.shape != self.error.shape:
            raise ShapeError(
                f"value and error: got shapes {self.value.shape} and {self.error.shape}, "
                "expected two equal shapes (ny, nx)"
            )

    def __repr__(self) -> str:
        ny, nx = self.value.shape
        return f"<DetectorPattern {self.name!r}: {self.filter}, {nx} x {ny} pixels>"

    @property
    def stars(self) -> tuple[CatalogueStar, ...]:
        """Stars that the pattern was learned from; by name alone where no catalogue is known."""
        return self.catalogue or tuple(
            CatalogueStar((str(name),)) for name in self.provenance.get("stars", ())
        )

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames that the pattern was learned from."""
        return tuple(self.provenance.get("frames", ()))

    def to_hdus(self) -> list[Any]:
        """Return the FITS extensions PATTERN and PATTERN_ERROR."""
        hdus = pattern_hdus(self.value, self.error, self)
        header = hdus[0].header
        header["LABEL"] = fits_text(self.name)
        header["UNKNOWN"] = (self.unknown, "deviation where nothing was measured")
        for key, value in self.provenance.items():
            header[f"HIERARCH {key.upper()}"] = json.dumps(value)
        if self.catalogue:
            header["CATALOG"] = json.dumps([asdict(star) for star in self.catalogue])
        return hdus

    @classmethod
    def from_hdus(cls, hdus: fits.HDUList) -> DetectorPattern:
        """Make the pattern from what `to_hdus` returned."""
        header = hdus["PATTERN"].header
        return cls(
            **pattern_fields(hdus),
            unknown=float(header["UNKNOWN"]),
            name=header["LABEL"],
            provenance={
                key: json.loads(header[key.upper()]) for key in _PROVENANCE if key.upper() in header
            },
            catalogue=tuple(map(_star_from, json.loads(header.get("CATALOG", "[]")))),
        )

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write to a FITS file, atomically.

        PATTERN is the residual over the star, PATTERN_ERROR its standard deviation. The header of
        PATTERN has STARX and STARY (position of the star, 0-indexed), COLUMN and ROW (first pixel
        on the detector), PEDESTAL, FILTER, CORONMSK, DETECTOR, R_FLAT, and the stars.

        Parameters
        ----------
        path : path
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        ExistingFileError
            If the file exists, and `overwrite` is False; it is also an `OSError`.
        """
        require_new([path], overwrite)
        write_fits(fits.HDUList([fits.PrimaryHDU(), *self.to_hdus()]), path)
        return Path(path)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> DetectorPattern:
        """Read what `write` wrote.

        Raises
        ------
        CorruptFileError
            If the file is missing, truncated, or holds something else.
        """
        with open_fits(path) as hdus:
            try:
                return cls.from_hdus(hdus)
            except (KeyError, TypeError, ValueError) as error:
                raise CorruptFileError(
                    f"{Path(path).name}: not a complete detector pattern ({error}); expected a "
                    "file written by DetectorPattern.write"
                ) from error

    def _box(self, observation: Observation) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Rows and columns that pattern and observation share: in the observation, in the pattern.

        Pixels are matched on the detector where both sides know which ones they have, else by the
        position of the star, to the nearest whole pixel.
        """
        if self.first_pixel is not None and observation.first_pixel is not None:
            x, y = np.subtract(self.first_pixel, observation.first_pixel)
        else:
            x, y = np.round(observation.center[0] - self.center).astype(int)
        (ny, nx), (height, width) = observation.shape, self.value.shape
        # Overlap of the pattern, moved by (x, y), with the observation's array.
        first_row, first_column = max(y, 0), max(x, 0)
        rows = slice(first_row, max(min(y + height, ny), first_row))
        columns = slice(first_column, max(min(x + width, nx), first_column))
        own = (
            slice(rows.start - y, rows.stop - y),
            slice(columns.start - x, columns.stop - x),
        )
        return (rows, columns), own

    def covered(self, observation: Observation) -> float:
        """The part of the pixels of an observation that the pattern has."""
        return self.value[self._box(observation)[1]].size / np.prod(observation.shape)

    def at(self, observation: Observation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pattern and its error on the pixels of an observation.

        Pixels are matched on the detector where both sides know which ones they have, else by the
        position of the star, to the nearest whole pixel.

        Returns
        -------
        value, error : ndarray, (ny, nx)
            Where nothing was measured the value is 0 and its error `unknown`.
        """
        value = np.zeros(observation.shape)
        error = np.full(observation.shape, self.unknown)
        there, own = self._box(observation)
        value[there] = self.value[own]
        error[there] = self.error[own]
        return value, error
