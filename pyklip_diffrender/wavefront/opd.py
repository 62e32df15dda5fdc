"""Wavefront maps: read from FITS with their unit, or made from a seed where there is no file."""

from __future__ import annotations

import hashlib
import math
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy import units as u
from astropy.io import fits
from astropy.time import Time
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    NonFiniteError,
    ShapeError,
    UnitError,
)
from pyklip_diffrender.instrument.jwst import jwst_pupil
from pyklip_diffrender.io.files import open_fits, sha256
from pyklip_diffrender.io.headers import header_date, header_text, merged_header
from pyklip_diffrender.io.units import native_float64, to_metres, warn_of_rms
from pyklip_diffrender.optics.grid import PupilGrid, resample
from pyklip_diffrender.wavefront.bases import FourierModes, SegmentMotions

__all__ = ["OPDMap", "as_opd_map", "drift", "random_drift", "random_opd", "read_opd", "resample"]


@dataclass(frozen=True)
class OPDMap:
    """A wavefront map with what is known of it.

    Attributes
    ----------
    data : ndarray, (npix, npix), float64
        m, OTE entrance-pupil orientation; 0 where the file had no value.
    date : Time or None
        When the wavefront was sensed.
    name : str
        File name, or what made it.
    sha256 : str
        Hash of the file, or of the data.
    """

    data: NDArray[np.float64]
    date: Time | None
    name: str
    sha256: str

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[np.float64]:
        return np.array(self.data, dtype=dtype)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the map."""
        return self.data.shape


def read_opd(
    path: str | os.PathLike[str],
    extension: str | int | None = None,
    unit: str | u.UnitBase | None = None,
) -> OPDMap:
    """Read an OPD map from a FITS file.

    Parameters
    ----------
    path : path
        FITS, gzipped or not.
    extension : str or int, optional
        Default: the first with a two-dimensional image.
    unit : str or Unit, optional
        Where the header has no BUNIT.

    Raises
    ------
    CorruptFileError
        The file is missing, truncated, or has no two-dimensional image.
    UnitError
        No unit is known, or it is not a length.
    ShapeError
        The map is not square.
    NonFiniteError
        NaN or infinity inside the pupil (outside it becomes 0).

    Warns
    -----
    DiffrenderWarning
        If the rms inside the pupil is not plausible for JWST, with the unit that would make it.
    """
    path = Path(path)
    with open_fits(path) as hdus:
        hdu = _image(hdus, extension, path)
        raw = native_float64(hdu.data)
        header = merged_header(hdus[0].header, hdu.header, path.name)
    unit = unit or header_text(header, "BUNIT", path.name)
    if not unit:
        raise UnitError(
            f"{path.name}: the header has no BUNIT. Say it: read_opd(path, unit='m') "
            "(or 'um': WSS files are in micron)"
        )
    try:
        # STScI writes "meters", "microns".
        spelled = str(unit).strip().rstrip("s").lower() if isinstance(unit, str) else unit
        data = raw * u.Unit(spelled).to(u.m)
    except (ValueError, u.UnitConversionError) as error:
        raise UnitError(f"{path.name}: BUNIT is {unit!r}, expected a unit of length") from error
    date = header_date(header, ("DATE-OBS", "DATE-BEG"), path.name)
    return OPDMap(_check(data, path.name), date, path.name, sha256(path))


def as_opd_map(opd: Any, name: str = "array") -> OPDMap:
    """Make an `OPDMap` of a path, Quantity, array (m), tensor or map.

    Raises
    ------
    UnitError, ShapeError, NonFiniteError, CorruptFileError
        As `read_opd`.
    """
    if isinstance(opd, OPDMap):
        return opd
    if isinstance(opd, str | os.PathLike):
        return read_opd(opd)
    data = to_metres(opd, "opd")
    return OPDMap(_check(data, name), None, name, hashlib.sha256(data.tobytes()).hexdigest())


def _image(hdus: fits.HDUList, extension: str | int | None, path: Path) -> Any:
    if extension is not None:
        try:
            return hdus[extension]
        except (KeyError, IndexError) as error:
            raise CorruptFileError(
                f"{path}: no extension {extension!r}; it has {[h.name for h in hdus]}"
            ) from error
    for hdu in hdus:
        if getattr(hdu, "data", None) is not None and np.ndim(hdu.data) == 2:
            return hdu
    raise CorruptFileError(f"{path}: no two-dimensional image in it; expected an OPD map")


@lru_cache(maxsize=8)
def _inside(npix: int) -> NDArray[np.bool_]:
    """Which samples are inside the pupil; made in as much time as a map is read in."""
    inside: NDArray[np.bool_] = jwst_pupil(npix).numpy() > 0.5
    inside.setflags(write=False)
    return inside


def _check(data: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """Square, NaN only outside the pupil, and an rms that a telescope could have."""
    if data.ndim != 2 or data.shape[0] != data.shape[1] or not data.size:
        raise ShapeError(f"{name}: got shape {data.shape}, expected a square map")
    pupil = _inside(data.shape[0])
    bad = ~np.isfinite(data)
    if (bad & pupil).any():
        first = tuple(int(i) for i in np.argwhere(bad & pupil)[0])
        raise NonFiniteError(
            f"{name}: {int((bad & pupil).sum())} values inside the pupil are NaN or infinite, the "
            f"first at [y, x] = {first}. Interpolate them or use another map"
        )
    data = np.where(bad, 0.0, data)
    warn_of_rms(float(data[pupil].std()), name, stacklevel=4)
    return data


def drift(before: Any, after: Any, hours: float, interval: float = 86.0) -> NDArray[np.float64]:
    """A wavefront between (or beyond) two measured ones, linear in time.

    Parameters
    ----------
    before, after : OPDMap or ndarray, (npix, npix)
        m.
    hours : float
        Time since `before`.
    interval : float
        Hours from `before` to `after`.
    """
    first, second = native_float64(before), native_float64(after)
    return first + hours / interval * (second - first)


def random_opd(seed: int, npix: int = 1024, rms: float = 66e-9) -> OPDMap:
    """A seeded wavefront like those measured in flight.

    Segment piston, tip and tilt carry 24 % of the variance (as in the maps of 2022-08-11 and
    2022-08-14), the rest is texture whose amplitude is flat to 8 cycles per pupil and falls as
    the square of the frequency beyond: errors inside the segments.

    Parameters
    ----------
    seed : int
    npix : int
        Samples across the pupil. The same seed gives the same wavefront at any sampling.
    rms : float
        Over the pupil, m.
    """
    return _random(seed, npix, rms, segment_variance=0.24, knee=8.0, slope=2.0, name="random_opd")


def random_drift(seed: int, hours: float, npix: int = 1024, rms_per_86h: float = 9e-9) -> OPDMap:
    """A seeded change of the wavefront that grows linearly in time.

    Segment motions carry 62 % of the variance (as in the change from 2022-08-11 to 08-14), low
    and mid frequencies the rest.

    Parameters
    ----------
    seed : int
    hours : float
    npix : int
    rms_per_86h : float
        m; the published pair of maps differs by 9.06 nm.
    """
    unit = _random(
        seed, npix, 1e-8, segment_variance=0.62, knee=8.0, slope=2.0, name="random_drift"
    )
    data = unit.data * (rms_per_86h / 1e-8 * hours / 86.0)
    return OPDMap(data, None, f"random_drift(seed={seed}, hours={hours})", unit.sha256)


def _random(
    seed: int, npix: int, rms: float, segment_variance: float, knee: float, slope: float, name: str
) -> OPDMap:
    generator = np.random.default_rng(seed)
    grid = PupilGrid.full(npix)
    pupil = jwst_pupil(npix)
    segments, fourier = SegmentMotions(), FourierModes(32.0)
    # Pistons twice as large as tips and tilts, as measured.
    motions = torch.from_numpy(generator.normal(size=(18, 3)) * np.array([2.0, 1.0, 0.8]))
    texture = torch.from_numpy(generator.normal(size=len(fourier)))
    texture = texture / (1 + (fourier.frequencies / knee) ** slope)
    parts = [segments.opd(motions.flatten(), grid), fourier.opd(texture, grid)]
    weight = pupil / pupil.sum()

    def normalised(opd: torch.Tensor) -> torch.Tensor:
        opd = opd - (weight * opd).sum()
        return opd / torch.sqrt((weight * opd**2).sum())

    rigid, inner = (normalised(part) for part in parts)
    mixed = math.sqrt(segment_variance) * rigid + math.sqrt(1 - segment_variance) * inner
    data = (rms * normalised(mixed) * (pupil > 0)).numpy()
    return OPDMap(data, None, f"{name}(seed={seed})", hashlib.sha256(data.tobytes()).hexdigest())
