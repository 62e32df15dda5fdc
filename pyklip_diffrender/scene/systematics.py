"""The known error of the star model, pixel by pixel: the flat-field pattern."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError, ShapeError
from pyklip_diffrender.io.files import open_fits, require_new, write_fits
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.scene.observation import Observation

__all__ = ["Systematics", "pattern_fields", "pattern_hdus"]

_PROVENANCE = ("stars", "frames", "dates")


def pattern_hdus(
    pattern: NDArray[np.floating], error: NDArray[np.floating], source: Any, version: int = 1
) -> list[fits.ImageHDU]:
    """Return the FITS extensions PATTERN and PATTERN_ERROR of one of the patterns of a file.

    `pattern` and `error` are (ny, nx), NaN errors where nothing was measured; `source` has the
    attributes of `Systematics` that go into the header; `version` is the pattern's number in the
    file.
    """
    hdus = [
        fits.ImageHDU(pattern, name="PATTERN", ver=version),
        fits.ImageHDU(error, name="PATTERN_ERROR", ver=version),
    ]
    header = hdus[0].header
    header["STARX"], header["STARY"] = source.center
    if source.first_pixel is not None:
        header["COLUMN"], header["ROW"] = source.first_pixel
    header["PEDESTAL"] = (source.pedestal, "added to the star, then multiplied")
    header["FILTER"], header["CORONMSK"] = source.filter or "", source.image_mask or ""
    return hdus


def pattern_fields(hdus: fits.HDUList, version: int = 1) -> dict[str, Any]:
    """Return pattern, error and the other attributes that `pattern_hdus` wrote."""
    header = hdus["PATTERN", version].header
    return {
        "pattern": native_float64(hdus["PATTERN", version].data),
        "error": native_float64(hdus["PATTERN_ERROR", version].data),
        "center": (float(header["STARX"]), float(header["STARY"])),
        "pedestal": float(header["PEDESTAL"]),
        "first_pixel": (header["COLUMN"], header["ROW"]) if "COLUMN" in header else None,
        "filter": header["FILTER"] or None,
        "image_mask": header["CORONMSK"] or None,
    }


@dataclass(frozen=True, eq=False)
class Systematics:
    """A multiplicative pattern that the star model misses, with its uncertainty.

    The part of a star's image that no wavefront explains is, on the same pixels of the detector,
    largely the same fraction of the light of every star: mostly an error of the flat field.
    The star in pixel p is taken to be ``model_p * (1 + m_p) + pedestal * m_p``, where m_p is
    Gaussian with mean `pattern` and standard deviation `error`. Frames of the same pixels that are
    fitted together share m_p. Light of companions is not multiplied: nothing of it can be mistaken
    for the pattern.

    Attributes
    ----------
    pattern : ndarray, (ny, nx)
        Residual over star.
    error : ndarray, (ny, nx)
        Its standard deviation.
    center : tuple of float
        x, y of the star in the pattern, 0-indexed pixels.
    unknown : float
        Standard deviation of the pattern where it has not been measured.
    pedestal : float
        Constant, in the unit of the frames, that is added to the star before the pattern
        multiplies it. A fit starts from it, and has a free pedestal in every frame. It stands for
        what a fixed pattern leaves far from the star: that of the flat field in the thermal
        background, which was subtracted as if the flat field were perfect, and that of the dark
        current.
    first_pixel : tuple of int or None
        Column and row of the pattern's first pixel on the full detector, as of an `Observation`.
    filter, image_mask : str or None
        Set-up that it is for; None where it is not known.
    name : str
        Short label for headers.
    provenance : dict
        Frames it was learned from, and how.

    Examples
    --------
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> flat = np.full((8, 8), 0.002)
    >>> dr.Systematics(flat, flat / 4, center=(3.5, 3.5), unknown=0.005, name="flat field")
    <Systematics 'flat field': None, 8 x 8 pixels>
    """

    pattern: NDArray[np.float64]
    error: NDArray[np.float64]
    center: tuple[float, float]
    unknown: float
    pedestal: float = 0.0
    first_pixel: tuple[int, int] | None = None
    filter: str | None = None
    image_mask: str | None = None
    name: str = "systematics"
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.pattern.ndim != 2 or self.pattern.shape != self.error.shape:
            raise ShapeError(
                f"pattern and error: got shapes {self.pattern.shape} and {self.error.shape}, "
                "expected two equal shapes (ny, nx)"
            )

    def __repr__(self) -> str:
        ny, nx = self.pattern.shape
        return f"<Systematics {self.name!r}: {self.filter}, {nx} x {ny} pixels>"

    def _repr_html_(self) -> str:
        ny, nx = self.pattern.shape
        return html_summary(
            f"Systematics {self.name}",
            {
                "Filter": self.filter,
                "Mask": self.image_mask,
                "Pattern": f"{nx} x {ny} pixels, unmeasured ones {100 * self.unknown:.2g} %",
                "Pedestal": f"{self.pedestal:.3g}" if self.pedestal else None,
                "Stars": ", ".join(map(str, self.provenance.get("stars", ()))) or None,
            },
        )

    def to_hdus(self) -> list[Any]:
        """Return the FITS extensions PATTERN and PATTERN_ERROR."""
        hdus = pattern_hdus(self.pattern, self.error, self)
        header = hdus[0].header
        header["LABEL"] = fits_text(self.name)
        header["UNKNOWN"] = (self.unknown, "deviation where nothing was measured")
        for key, value in self.provenance.items():
            header[f"HIERARCH {key.upper()}"] = json.dumps(value)
        return hdus

    @classmethod
    def from_hdus(cls, hdus: fits.HDUList) -> Systematics:
        """Make the systematics from what `to_hdus` returned."""
        header = hdus["PATTERN"].header
        return cls(
            **pattern_fields(hdus),
            unknown=float(header["UNKNOWN"]),
            name=header["LABEL"],
            provenance={
                key: json.loads(header[key.upper()]) for key in _PROVENANCE if key.upper() in header
            },
        )

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write to a FITS file, atomically.

        PATTERN is residual over star, PATTERN_ERROR its standard deviation. The header of PATTERN
        has STARX and STARY (position of the star, 0-indexed), COLUMN and ROW (first pixel on the
        detector), PEDESTAL, FILTER and CORONMSK.

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
    def read(cls, path: str | os.PathLike[str]) -> Systematics:
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
                    f"{Path(path).name}: not a complete systematics file ({error}); expected one "
                    "written by Systematics.write"
                ) from error

    def at(self, observation: Observation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pattern and its error on the pixels of an observation.

        Pixels are matched on the detector where both sides know which ones they have, else by the
        position of the star, to the nearest whole pixel.

        Returns
        -------
        pattern, error : ndarray, (ny, nx)
            Where nothing was measured the pattern is 0 and its error `unknown`.

        Raises
        ------
        IncompatibleSetupError
            If the observation was taken through another filter.
        """
        if None not in (self.filter, observation.filter) and self.filter != observation.filter:
            raise IncompatibleSetupError(
                f"{observation.name}: these frames were taken through {observation.filter}, the "
                f"systematics {self.name!r} were learned in {self.filter}"
            )
        pattern = np.zeros(observation.shape)
        error = np.full(observation.shape, self.unknown)
        if self.first_pixel is not None and observation.first_pixel is not None:
            x, y = np.subtract(self.first_pixel, observation.first_pixel)
        else:
            x, y = np.round(observation.center[0] - self.center).astype(int)
        (ny, nx), (height, width) = observation.shape, self.pattern.shape
        # Overlap of the pattern, moved by (x, y), with the observation's array.
        first_row, first_column = max(y, 0), max(x, 0)
        rows = slice(first_row, max(min(y + height, ny), first_row))
        columns = slice(first_column, max(min(x + width, nx), first_column))
        own = (
            slice(rows.start - y, rows.stop - y),
            slice(columns.start - x, columns.stop - x),
        )
        pattern[rows, columns] = self.pattern[own]
        error[rows, columns] = self.error[own]
        return pattern, error
