"""What fits of other stars add to the measured wavefront, in the same filter.

Fits of different stars differ from their wavefront maps by nearly the same wavefront and amplitude
as long as the filter is the same, and by a different one in another filter. It stands for what the
maps and the model lack of the instrument. A fit that starts from it has less left to explain.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.io.files import open_fits, write_fits
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.linear.response import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.wavefront.bases import default_basis

__all__ = ["StaticWavefront", "read_wavefronts", "write_wavefronts"]

_EXTENSION = "STATIC_WAVEFRONT"


@dataclass(frozen=True, eq=False)
class StaticWavefront:
    """Wavefront and amplitude that the model lacks in one filter.

    Attributes
    ----------
    phase : ndarray, (modes,)
        Coefficients of `default_basis` for JWST, nm.
    amplitude : ndarray, (amplitude modes,)
        The same for an imaginary OPD, by the first of these modes.
    cycles : float
        Highest spatial frequency of the modes, cycles across the pupil.
    stars : tuple of str
        Stars whose fits have shown it.
    filter, image_mask : str or None
    dates : tuple of str
        Of the frames.
    """

    phase: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    cycles: float
    stars: tuple[str, ...]
    filter: str | None = None
    image_mask: str | None = None
    dates: tuple[str, ...] = ()

    def opd(self, grid: PupilGrid) -> Tensor:
        """Return what is added to the wavefront, (rows, columns), m, complex.

        The negative imaginary part is an OPD of -1j m for every amplitude mode, as in a fit.
        """
        basis = default_basis(self.cycles)
        absorbed = np.zeros(len(self.phase))
        absorbed[: len(self.amplitude)] = self.amplitude
        phase, amplitude = (
            basis.opd(torch.from_numpy(values) * NANOMETRE, grid)
            for values in (self.phase, absorbed)
        )
        return torch.complex(phase, -amplitude)

    def to_hdu(self, version: int = 1) -> fits.ImageHDU:
        """Return the FITS extension: coefficients of the phase, then of the amplitude, nm."""
        values = np.concatenate([self.phase, self.amplitude]).astype(np.float32)
        hdu = fits.ImageHDU(values, name=_EXTENSION, ver=version)
        header = hdu.header
        header["BUNIT"] = "nm"
        header["MODES"] = (len(self.phase), "values of the phase")
        header["CYCLES"] = (self.cycles, "highest spatial frequency")
        header["FILTER"], header["CORONMSK"] = self.filter or "", self.image_mask or ""
        header["STARS"], header["DATES"] = json.dumps(self.stars), json.dumps(self.dates)
        return hdu

    @classmethod
    def from_hdus(cls, hdus: fits.HDUList) -> StaticWavefront | None:
        """Make the wavefront from an extension of a file; None if there is none."""
        return cls.from_hdu(hdus[_EXTENSION]) if _EXTENSION in hdus else None

    @classmethod
    def from_hdu(cls, hdu: Any) -> StaticWavefront:
        """Make the wavefront from what `to_hdu` returned."""
        header, values = hdu.header, native_float64(hdu.data)
        return cls(
            phase=values[: header["MODES"]],
            amplitude=values[header["MODES"] :],
            cycles=header["CYCLES"],
            stars=tuple(json.loads(header["STARS"])),
            filter=header["FILTER"] or None,
            image_mask=header["CORONMSK"] or None,
            dates=tuple(json.loads(header["DATES"])),
        )


def write_wavefronts(wavefronts: Sequence[StaticWavefront], path: str | os.PathLike[str]) -> Path:
    """Write wavefronts to a FITS file, one extension for each, atomically."""
    hdus = [each.to_hdu(k) for k, each in enumerate(wavefronts, 1)]
    write_fits(fits.HDUList([fits.PrimaryHDU(), *hdus]), path)
    return Path(path)


def read_wavefronts(path: str | os.PathLike[str]) -> list[StaticWavefront]:
    """Read what `write_wavefronts` wrote.

    Raises
    ------
    CorruptFileError
        If the file is missing or truncated.
    """
    with open_fits(path) as hdus:
        return [StaticWavefront.from_hdu(hdu) for hdu in hdus if hdu.name == _EXTENSION]
