"""Wavefront maps on their way in and out: plausibility checks, and HDULists for poppy and stpsf."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import DiffrenderWarning, UnitError
from pyklip_diffrender.io.opd_map import OPDMap
from pyklip_diffrender.io.units import require_finite, to_metres
from pyklip_diffrender.optics.grid import JWST_DIAMETER

__all__ = ["check_opd", "opd_to_hdus"]

Array = NDArray[np.float64]

LARGEST_RMS = 2e-5
"""m; a telescope whose wavefront is worse than this makes no image in the infrared."""

_TURNS: dict[str, Any] = {
    "as it is": lambda a: a,
    "upside down": np.flipud,
    "left to right": np.fliplr,
    "turned by 180 deg": lambda a: a[::-1, ::-1],
}


def check_opd(opd: Array, amplitude: Array, name: str) -> None:
    """Check the size of a map's values, and where its blank samples are.

    Parameters
    ----------
    opd : ndarray, (npix, npix)
        m.
    amplitude : ndarray, (npix, npix)
        Transmission of the pupil in the orientation that the map should have.
    name : str
        What the map is, for the message.

    Raises
    ------
    NonFiniteError
        If a value inside the pupil is not finite.
    UnitError
        If the values are too large to be in metres.

    Warns
    -----
    DiffrenderWarning
        If the blank samples match the pupil better after a flip or a rotation by 180 degrees.
    """
    inside = amplitude > 0
    require_finite(opd, name, inside)
    rms = float(np.std(opd[inside])) if inside.any() else 0.0
    if rms > LARGEST_RMS:
        raise UnitError(
            f"{name}: {rms:.3g} m rms inside the pupil, more than several wavelengths. Maps must "
            "be in metres; those of the wavefront-sensing software are in microns. Give it as a "
            "Quantity, or set BUNIT in the file"
        )
    drawn = (opd != 0) & np.isfinite(opd)
    if drawn.all() or not drawn.any():
        return
    mismatch = {turn: float(np.mean(act(drawn) != inside)) for turn, act in _TURNS.items()}
    best = min(mismatch, key=lambda turn: mismatch[turn])
    if mismatch[best] < 0.5 * mismatch["as it is"]:
        warnings.warn(
            f"{name}: its blank samples match the pupil {best} ({mismatch[best]:.1%} of the "
            f"samples differ, against {mismatch['as it is']:.1%} as it is). Maps must have the "
            "orientation of the entrance pupil, row 0 at the bottom (-V3)",
            DiffrenderWarning,
            stacklevel=3,
        )


def opd_to_hdus(opd: Any, diameter: float = JWST_DIAMETER) -> fits.HDUList:
    """An OPD in the form that poppy's and stpsf's readers take, for ``nircam.pupilopd`` or a file.

    Parameters
    ----------
    opd : OPDMap, Tensor, Quantity or array, (npix, npix)
        Bare numbers are metres. The origin of an `OPDMap` goes into the header.
    diameter : float
        Side of the array, m.

    Returns
    -------
    HDUList
        One image in metres, with BUNIT and PUPLSCAL.
    """
    values = to_metres(opd, "opd")
    header = fits.Header()
    header["BUNIT"] = "m"
    header["PUPLDIAM"] = (diameter, "[m] side of the array")
    header["PUPLSCAL"] = (diameter / values.shape[-1], "[m / pixel]")
    header["CONTENTS"] = "OTE OPD, entrance pupil orientation"
    if isinstance(opd, OPDMap):
        header["OPDFILE"] = (opd.name, "Origin of the map")
        if opd.aperture:
            header["APERNAME"] = (opd.aperture, "Sensing field point")
        if opd.date is not None:
            header["DATE-OBS"], header["TIME-OBS"] = opd.date.isot.split("T")
        for line in opd.history:
            header.add_history(line)
    return fits.HDUList([fits.PrimaryHDU(values, header)])
