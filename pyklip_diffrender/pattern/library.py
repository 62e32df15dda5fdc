"""Flat-field patterns that were measured on other stars and come with the package.

The table was made by ``examples/make_pattern_library.py`` from frames of JWST programme 1184.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
from astropy.io import fits

from pyklip_diffrender.io.files import open_fits, write_fits
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.names import same_name
from pyklip_diffrender.pattern.measure import (
    MeasuredPattern,
    combine_patterns,
    measure_patterns,
)
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.scene.catalogue_star import star_of
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.systematics import Systematics, pattern_fields, pattern_hdus

__all__ = ["known_systematics", "read_patterns", "write_patterns"]

_COVERED = 0.5
"""Smallest part of a frame's pixels that the patterns must cover to be of use."""


def known_systematics(
    observation: Observation,
    references: Refinement | Sequence[Refinement] = (),
    *,
    library: bool = True,
) -> Systematics | None:
    """Combine the flat-field pattern of reference stars and that of the package's own library.

    Parameters
    ----------
    observation : Observation
        Frames that it is for. Patterns of the same star are left out, so that nothing of its
        planets is in the pattern.
    references : Refinement or sequence of Refinement
        Fits of reference stars, if there are any.
    library : bool
        False leaves the library out.

    Returns
    -------
    Systematics or None
        None if there are fewer than two frames to learn from.

    Examples
    --------
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> ones = np.ones((80, 80))
    >>> header = {"DETECTOR": "NRCALONG", "CORONMSK": "MASKA335R"}
    >>> frame = dr.Observation.from_arrays(
    ...     ones, ones, pixelscale=0.063, filter="F444W", header=header
    ... )
    >>> print(dr.known_systematics(frame))
    <Systematics 'HIP17695, G-7-34': F444W, 80 x 80 pixels>
    """
    known = _library_for(observation) if library else []
    pedestal = known[0].pedestal if known else None
    patterns = measure_patterns(references, pedestal)
    target = star_of(observation.header, observation.name).names or (observation.target,)
    stars = [pattern.star for pattern in patterns] + list(target)
    if all(pattern.first_pixel is not None for pattern in patterns):
        patterns += [
            each for each in known if not any(same_name(each.star, star) for star in stars)
        ]
    return combine_patterns(patterns) if len(patterns) > 1 else None


def _library_for(observation: Observation) -> list[MeasuredPattern]:
    """The library's patterns of the observation's filter and mask, if they cover its pixels.

    Frames that do not say where their pixels are on the detector may be anywhere.
    """
    if observation.header.get("DETECTOR") != "NRCALONG":
        return []
    mask = str(observation.header.get("CORONMSK", "")).strip().upper()
    return [
        pattern
        for pattern in _library()
        if pattern.filter == observation.filter
        and pattern.image_mask == mask
        and _covered(pattern, observation) >= _COVERED
    ]


def _covered(pattern: MeasuredPattern, observation: Observation) -> float:
    """The part of the observation's pixels that a pattern covers."""
    if pattern.first_pixel is None or observation.first_pixel is None:
        return 1.0
    starts = np.array([pattern.first_pixel, observation.first_pixel])
    shapes = np.array([pattern.value.shape[::-1], observation.shape[::-1]])
    overlap = (starts + shapes).min(axis=0) - starts.max(axis=0)
    return float(np.clip(overlap, 0, None).prod() / shapes[1].prod())


@lru_cache(maxsize=1)
def _library() -> tuple[MeasuredPattern, ...]:
    name = resources.files("pyklip_diffrender.pattern") / "data" / "patterns.fits.gz"
    with resources.as_file(name) as path:
        return tuple(read_patterns(path))


def write_patterns(patterns: Sequence[MeasuredPattern], path: str | os.PathLike[str]) -> Path:
    """Write patterns to a FITS file, two extensions as of a `Systematics` for each, atomically."""
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [fits.PrimaryHDU()]
    for k, pattern in enumerate(patterns, 1):
        error = np.sqrt(np.where(np.isfinite(pattern.variance), pattern.variance, np.nan))
        value = pattern.value.astype(np.float32)
        hdus += pattern_hdus(value, error.astype(np.float32), pattern, k)
        header = hdus[-2].header
        header["STAR"] = (fits_text(pattern.star), "star that it was measured on")
        header["FRAME"], header["DATE-BEG"] = fits_text(pattern.frame), pattern.date
    write_fits(fits.HDUList(hdus), path)
    return Path(path)


def read_patterns(path: str | os.PathLike[str]) -> list[MeasuredPattern]:
    """Read what `write_patterns` wrote.

    Raises
    ------
    CorruptFileError
        If the file is missing or truncated.
    """
    patterns = []
    with open_fits(path) as hdus:
        for k in range(1, 1 + sum(hdu.name == "PATTERN" for hdu in hdus)):
            header, fields = hdus["PATTERN", k].header, pattern_fields(hdus, k)
            value, error = fields.pop("pattern"), fields.pop("error")
            known = np.isfinite(error)
            patterns.append(
                MeasuredPattern(
                    star=header["STAR"],
                    value=np.where(known, value, 0.0),
                    variance=np.where(known, error, np.inf) ** 2,
                    frame=header["FRAME"],
                    date=header["DATE-BEG"],
                    **fields,
                )
            )
    return patterns
