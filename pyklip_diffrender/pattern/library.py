"""Libraries of detector patterns that were measured on stars: files, search and combination.

The package's own library was measured on frames of JWST programme 1184.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Self

import numpy as np
from astropy.io import fits
from astropy.table import QTable, vstack

from pyklip_diffrender.errors import CorruptFileError
from pyklip_diffrender.io.files import (
    fits_files,
    open_fits,
    require_new,
    unpacked_name,
    write_fits,
)
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.pattern.measure import (
    MeasuredPattern,
    combine_patterns,
    common_pedestal,
    flat_of,
    measure_patterns,
)
from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.scene.detector_pattern import (
    HALF_COVERED,
    DetectorPattern,
    contradiction,
    pattern_fields,
    pattern_hdus,
    shows_star,
    unrecorded,
)
from pyklip_diffrender.scene.exposure import star_of
from pyklip_diffrender.scene.observation import Observation

_STATED_SETUP = {"filter", "mask", "detector"}
"""Properties that both a pattern of a library and the frames that it is for must state."""

_VERSION = 2
"""Version of the layout of the files, in the card PATVERS."""


@dataclass(frozen=True, eq=False)
class PatternLibrary:
    """Detector patterns of many stars, set-ups and dates.

    Attributes
    ----------
    patterns : tuple of MeasuredPattern
        Measured patterns, one for each frame.
    validation : QTable
        Table with a row for each star and epoch, see `learn_patterns`; empty for patterns that were
        not tested on each other.

    Examples
    --------
    From files of the command ``learn``, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> library = dr.PatternLibrary.read("patterns")  # doctest: +SKIP
    >>> result = dr.reduce("calints", "maps", pattern=library)  # doctest: +SKIP
    """

    patterns: tuple[MeasuredPattern, ...] = ()
    validation: QTable = field(default_factory=QTable)

    def __repr__(self) -> str:
        return f"<PatternLibrary: {len(self.patterns)} frames of {', '.join(self.stars) or 'none'}>"

    @property
    def stars(self) -> list[str]:
        """Names of the stars."""
        return list(dict.fromkeys(pattern.star for pattern in self.patterns))

    def matching(self, observation: Observation) -> list[MeasuredPattern]:
        """Return the patterns that an observation may show.

        The patterns have the detector, mask and filter of the observation, cover at least half of
        its pixels, and are of other stars, so that nothing of the target's planets is among them.
        The patterns share one flat field: the observation's if a pattern has it, else the flat
        field of most patterns.
        """
        chosen = [
            pattern
            for pattern in self.patterns
            if contradiction(pattern, observation) is None
            and _STATED_SETUP.isdisjoint(unrecorded(pattern, observation))
            and not shows_star(pattern, observation)
            and _covered(pattern, observation) >= HALF_COVERED
        ]
        flat = _flat_for(chosen, observation)
        return [pattern for pattern in chosen if pattern.flat == flat]

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `write` wrote, or all of a folder.

        Raises
        ------
        MissingFileError
            If there is no such file.
        CorruptFileError
            If a file is truncated or holds something else, or a folder has no library.
        """
        path = Path(path)
        if not path.is_dir():
            patterns, validation = _read(path)
            return cls(patterns, validation)
        files = fits_files(path)
        if not files:
            raise CorruptFileError(
                f"{path}: the folder has no FITS files, expected some that the command learn wrote"
            )
        several = combine_libraries([cls(*_read(each)) for each in files])
        return cls(several.patterns, several.validation)

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write to a FITS file, atomically.

        Each pattern has the extensions PATTERN and PATTERN_ERROR (NaN where nothing was measured),
        as a `DetectorPattern`, with the star, file, date, detector and flat field in the header,
        and STAR (the star without the pattern, MJy/sr), if it was kept. EXTVER is the number of the
        pattern, from 1; VALIDATION is a table, and PATVERS in the primary header the version of the
        layout.

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
        write_fits(self.to_hdus(), path)
        return Path(path)

    def to_hdus(self) -> fits.HDUList:
        """Return what `write` writes, as an HDUList."""
        primary = fits.PrimaryHDU()
        primary.header["PATVERS"] = (_VERSION, "version of the layout")
        hdus = [primary]
        for k, pattern in enumerate(self.patterns, 1):
            hdus += _hdus(pattern, k)
        if len(self.validation):
            hdus.append(fits.table_to_hdu(self.validation))
            hdus[-1].name = "VALIDATION"
        return fits.HDUList(hdus)


def combine_libraries(libraries: Iterable[PatternLibrary]) -> PatternLibrary:
    """Put the patterns of several libraries into one.

    For a frame in several libraries, the pattern of the first library is kept.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> from pyklip_diffrender.pattern import package_library
    >>> print(dr.pattern.combine_libraries([dr.PatternLibrary(), package_library()]))
    <PatternLibrary: 8 frames of HIP17695, G-7-34>
    """
    several = list(libraries)
    patterns: dict[tuple[object, ...], MeasuredPattern] = {}
    for library in several:
        for pattern in library.patterns:
            patterns.setdefault(_identity(pattern), pattern)
    tables = [library.validation for library in several if len(library.validation)]
    validation = vstack(tables, metadata_conflicts="silent") if tables else QTable()
    return PatternLibrary(tuple(patterns.values()), validation)


def known_pattern(
    observation: Observation,
    references: Refinement | Sequence[Refinement] = (),
    *,
    library: bool | PatternLibrary = True,
) -> DetectorPattern | None:
    """Combine the detector patterns of reference stars and of a library.

    Parameters
    ----------
    observation : Observation
        Frames that the pattern is for. Patterns of the same star are left out, so that nothing of
        its planets is in the pattern.
    references : Refinement or sequence of Refinement
        Fits of reference stars, if there are any.
    library : bool or PatternLibrary
        True stands for the package's own library, False for none.

    Returns
    -------
    DetectorPattern or None
        The pattern; None if there are fewer than two frames to learn from.

    Examples
    --------
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> ones = np.ones((80, 80))
    >>> header = {"DETECTOR": "NRCALONG", "CORONMSK": "MASKA335R"}
    >>> frame = dr.Observation.from_arrays(
    ...     ones, ones, pixelscale=0.063, filter="F444W", header=header
    ... )
    >>> print(dr.known_pattern(frame))
    <DetectorPattern 'HIP17695, G-7-34': F444W, 80 x 80 pixels>
    """
    if isinstance(library, bool):
        library = package_library() if library else PatternLibrary()
    known = library.matching(observation)
    patterns = measure_patterns(references, common_pedestal(known) if known else None)
    fitted = [star for pattern in patterns for star in pattern.stars]
    if all(pattern.first_pixel is not None for pattern in patterns):
        # A star that was fitted counts once.
        patterns += [
            pattern
            for pattern in known
            if not any(own.is_same(star) for own in pattern.stars for star in fitted)
        ]
    stated = [pattern for pattern in patterns if pattern.flat is not None]
    flat = _flat_for(stated, observation)
    patterns = [pattern for pattern in patterns if pattern.flat in (flat, None)]
    return combine_patterns(patterns) if len(patterns) > 1 else None


def _flat_for(patterns: Sequence[MeasuredPattern], observation: Observation) -> str | None:
    """The flat field of an observation if one of the patterns has it, else the most frequent one.

    Patterns are errors of one flat field: patterns of several must not be averaged.
    """
    flats = Counter(pattern.flat for pattern in patterns)
    own = flat_of(observation)
    return own if own in flats else max(flats, key=lambda each: flats[each], default=None)


def _covered(pattern: MeasuredPattern, observation: Observation) -> float:
    """The part of the observation's pixels that a pattern covers.

    Frames that do not say where their pixels are on the detector may be anywhere.
    """
    if pattern.first_pixel is None or observation.first_pixel is None:
        return 1.0
    # Columns and rows on the detector: the overlap of two rectangles.
    starts = np.array([pattern.first_pixel, observation.first_pixel])
    shapes = np.array([pattern.value.shape[::-1], observation.shape[::-1]])
    overlap = (starts + shapes).min(axis=0) - starts.max(axis=0)
    return float(np.clip(overlap, 0, None).prod() / shapes[1].prod())


def _identity(pattern: MeasuredPattern) -> tuple[object, ...]:
    """Frame in which a pattern was measured, and the flat field of the frame's calibration."""
    name = unpacked_name(pattern.frame)
    return (name or id(pattern), pattern.date, pattern.filter, pattern.detector, pattern.flat)


@lru_cache(maxsize=1)
def package_library() -> PatternLibrary:
    """The library that comes with the package."""
    name = resources.files("pyklip_diffrender.pattern") / "data" / "patterns.fits.gz"
    with resources.as_file(name) as path:
        return PatternLibrary.read(path)


def _hdus(pattern: MeasuredPattern, number: int) -> list[fits.ImageHDU]:
    """Extensions of a pattern; unknown pixels have the error NaN."""
    error = np.sqrt(np.where(np.isfinite(pattern.variance), pattern.variance, np.nan))
    value = pattern.value.astype(np.float32)
    hdus = pattern_hdus(value, error.astype(np.float32), pattern, number)
    header = hdus[0].header
    header["STAR"] = (fits_text(pattern.star), "star that it was measured on")
    star = pattern.catalogue
    for card, name in zip(("TARGPROP", "TARGNAME"), star.names, strict=False):
        header[card] = fits_text(name)
    if star.coordinates is not None:
        cards = ("RA_REF", "DEC_REF") if star.pointing else ("TARG_RA", "TARG_DEC")
        header[cards[0]], header[cards[1]] = star.coordinates
    if star.motion is not None:
        header["MU_RA"], header["MU_DEC"] = star.motion
    if star.epochs and not star.pointing:
        # DATE-OBS is the date of the frame.
        header["MU_EPOCH"] = star.epochs[0]
    header["FRAME"], header["DATE-BEG"] = fits_text(pattern.frame), pattern.date
    if pattern.light is not None:
        hdus.append(fits.ImageHDU(pattern.light.astype(np.float32), name="STAR", ver=number))
    return hdus


def _read(path: Path) -> tuple[tuple[MeasuredPattern, ...], QTable]:
    """Patterns and table of a file."""
    with open_fits(path) as hdus:
        version = hdus[0].header.get("PATVERS")
        if version != _VERSION:
            raise CorruptFileError(
                f"{path}: got {'no' if version is None else version} version of a library of "
                f"patterns (PATVERS), expected {_VERSION}. The command learn writes such files"
            )
        try:
            count = sum(hdu.name == "PATTERN" for hdu in hdus)
            patterns = tuple(_pattern(hdus, k) for k in range(1, 1 + count))
            table = QTable.read(hdus["VALIDATION"]) if "VALIDATION" in hdus else QTable()
        except (KeyError, TypeError, ValueError) as error:
            raise CorruptFileError(
                f"{path}: not a complete library of patterns ({error}). Learn the library again"
            ) from error
    return patterns, table


def _pattern(hdus: fits.HDUList, number: int) -> MeasuredPattern:
    header, fields = hdus["PATTERN", number].header, pattern_fields(hdus, number)
    value, error = fields.pop("value"), fields.pop("error")
    known = np.isfinite(error)
    has_star = ("STAR", number) in hdus
    return MeasuredPattern(
        star=header["STAR"],
        value=np.where(known, value, 0.0),
        variance=np.where(known, error, np.inf) ** 2,
        frame=header["FRAME"],
        date=header["DATE-BEG"],
        light=native_float64(hdus["STAR", number].data) if has_star else None,
        catalogue=star_of(header, header["FRAME"]),
        **fields,
    )
