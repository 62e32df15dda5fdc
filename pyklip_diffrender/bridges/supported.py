"""Which poppy systems can be converted."""

from __future__ import annotations

from typing import Any

import poppy
from poppy.poppy_core import PlaneType
from poppy.sub_sampled_optics import Subapertures

from pyklip_diffrender.errors import IncompatibleSetupError

__all__ = ["check_supported"]

_SUPPORTED = (
    "pupil and image planes of any optic that gives a transmission and an OPD, coordinate "
    "inversions and rotations in pupils, and a Detector at the end"
)


def check_supported(osys: Any) -> None:
    """Go through the planes of a system.

    Raises
    ------
    IncompatibleSetupError
        At the first thing that is not supported, with its name and what is.
    """
    if isinstance(osys, poppy.FresnelOpticalSystem):
        raise IncompatibleSetupError(
            f"{osys.name}: Fresnel propagation is not supported. Supported are Fraunhofer "
            f"systems (poppy.OpticalSystem) of {_SUPPORTED}"
        )
    if not isinstance(osys, poppy.OpticalSystem):
        raise IncompatibleSetupError(
            f"from_poppy: got a {type(osys).__name__}, expected a poppy.OpticalSystem. For an "
            "Instrument, pass what its get_optical_system() returns, or use from_webbpsf"
        )
    if isinstance(osys, poppy.MatrixFTCoronagraph):
        raise IncompatibleSetupError(
            f"{osys.name}: poppy.MatrixFTCoronagraph samples its image planes in a way of its "
            "own; convert the OpticalSystem that it was made from"
        )
    planes = list(osys.planes)
    if not planes or planes[0].planetype != PlaneType.pupil:
        raise IncompatibleSetupError(
            f"{osys.name}: the first plane must be a pupil, got "
            f"{planes[0] if planes else 'no planes'}. Supported are {_SUPPORTED}"
        )
    if not isinstance(planes[-1], poppy.Detector):
        raise IncompatibleSetupError(
            f"{osys.name}: the last plane must be a Detector, got {planes[-1]}. Add one with "
            "add_detector(pixelscale=, fov_pixels=)"
        )
    known = (PlaneType.pupil, PlaneType.image, PlaneType.rotation, PlaneType.inversion)
    previous = planes[0]
    for plane in planes[:-1]:
        if isinstance(plane, Subapertures) or plane.planetype not in known:
            raise IncompatibleSetupError(
                f"plane {plane.name!r} ({type(plane).__name__}, {plane.planetype}) is not "
                f"supported. Supported are {_SUPPORTED}"
            )
        turning = plane.planetype in (PlaneType.rotation, PlaneType.inversion)
        if turning and previous.planetype == PlaneType.image:
            raise IncompatibleSetupError(
                f"plane {plane.name!r} turns the field in the image plane {previous.name!r}, "
                "where poppy moves it by one sample as well. Put it in front of that plane, "
                "or behind the next pupil"
            )
        previous = plane
