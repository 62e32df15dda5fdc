"""What a reduction needs to know besides the dataset, and where it may be said.

`klip_dataset` takes no keyword it does not know, so the settings of the backend come from
three places; a field given in an earlier one wins over the same field in a later one:

1. the innermost ``with backend(...)`` around the call,
2. ``dataset.diffrender = DiffrenderSettings(...)``, which goes with the dataset, copies included,
3. the defaults given to ``register(...)``.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, TypedDict

import numpy as np
from astropy import units as u
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.errors import IncompatibleSetupError

if TYPE_CHECKING:
    from pyklip_diffrender.planning import Plan
    from pyklip_diffrender.refinement import Adam, GaussNewton, Systematics
    from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["ATTRIBUTE", "DiffrenderSettings", "OPDLike", "Options", "settings_of"]

OPDLike: TypeAlias = "str | os.PathLike[str] | NDArray[np.floating[Any]] | u.Quantity | OPDMap"
"""A wavefront map: a FITS file, an array in metres, a Quantity, or what `read_opd` returns."""

ATTRIBUTE = "diffrender"
"""Name of the attribute of a dataset that holds its own settings."""


class Options(TypedDict, total=False):
    """The settings other than `opd` and `model`, as keywords."""

    filter: str
    pixelscale: float | tuple[float, float]
    fit_pixels: int
    error: ArrayLike
    unit: u.UnitBase
    seed: int
    fit: GaussNewton | Adam
    start: Mapping[str, Any]
    systematics: Systematics
    plan: Plan | str
    keep_detected: bool
    model_options: Mapping[str, Any]
    subtractor: Callable[..., Any]


@dataclass(frozen=True, eq=False)
class DiffrenderSettings:
    """Settings of ``algo="diffrender"``; None means "not said here".

    Attributes
    ----------
    opd : path, ndarray, Quantity or OPDMap, optional
        Wavefront map to start from: a FITS file, or a square array in metres, OTE entrance-pupil
        orientation. There is no default: a reduction without one raises `MissingOPDError`.
    model : optical model or mapping, optional
        What `nircam_coronagraph` and the bridges return. For a dataset of several wavelengths a
        mapping from the wavelength, as in ``dataset.wvs``, to a model. Built from the filter if
        not given.
    filter : str, optional
        NIRCam filter, such as ``"F444W"``. Read from the dataset where that can be done.
    pixelscale : float or (x, y), optional
        Arcsec per pixel. Read from the dataset or the model where that can be done.
    fit_pixels : int, optional
        Side in pixels of the square about the star that is fitted; what is subtracted covers the
        whole frame. By default as much as the frames hold, up to
        `pyklip_diffrender.pyklip_backend.subtract.FIT_PIXELS`.
    error : array_like, optional
        Standard deviation per pixel, in the unit of the frames: a number, (ny, nx), or
        (n, ny, nx) on the frames as they are in ``dataset.input``. Read from the ERR extension
        where there is one, else estimated from the frames.
    unit : Unit, optional
        Unit of the frames. Read from BUNIT where there is one, else dimensionless.
    seed : int, optional
        Passed to `refine`; 0 by default.
    fit : GaussNewton or Adam, optional
        Settings of the fit; see `refine`.
    start : dict, optional
        Starting values by parameter name; see `refine`.
    systematics : Systematics, optional
        What is known of the model's error; see `refine`.
    plan : Plan or str, optional
        "auto" (the default), "off", or a plan that was made before, which serves for all fits of a
        reduction; see `refine`.
    keep_detected : bool, optional
        Look for companions in the fits (`detect`) and refine the star once more with them in the
        model, so that none of their light is taken for the star's; False by default. What is not
        detected loses as much as before: bright injected companions then say nothing about how
        much of a faint one is left.
    model_options : mapping, optional
        Further keywords of `nircam_coronagraph`, such as ``npix`` and ``nlambda``.
    subtractor : Subtractor, optional
        What renders the star; `subtract_by_refinement` by default.
    """

    opd: OPDLike | None = None
    model: Any = None
    filter: str | None = None
    pixelscale: float | tuple[float, float] | None = None
    fit_pixels: int | None = None
    error: ArrayLike | None = None
    unit: u.UnitBase | None = None
    seed: int | None = None
    fit: GaussNewton | Adam | None = None
    start: Mapping[str, Any] | None = None
    systematics: Systematics | None = None
    plan: Plan | str | None = None
    keep_detected: bool | None = None
    model_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    subtractor: Callable[..., Any] | None = None

    def over(self, other: DiffrenderSettings) -> DiffrenderSettings:
        """These settings, with what they do not say taken from `other`."""
        merged: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            mine, theirs = getattr(self, field.name), getattr(other, field.name)
            if field.name.endswith("_options"):
                merged[field.name] = {**theirs, **mine}
            else:
                merged[field.name] = theirs if mine is None else mine
        return DiffrenderSettings(**merged)

    def __deepcopy__(self, memo: dict[int, Any]) -> DiffrenderSettings:
        """Itself: nothing in it changes, and a contrast curve copies its dataset 120 times."""
        return self


def settings_of(dataset: Any) -> DiffrenderSettings:
    """Settings that a dataset carries; empty if it carries none.

    Raises
    ------
    IncompatibleSetupError
        If ``dataset.diffrender`` is something else.
    """
    own = getattr(dataset, ATTRIBUTE, None)
    if own is None:
        return DiffrenderSettings()
    if not isinstance(own, DiffrenderSettings):
        raise IncompatibleSetupError(
            f"dataset.{ATTRIBUTE}: got a {type(own).__name__}, expected DiffrenderSettings. "
            f"Set dataset.{ATTRIBUTE} = DiffrenderSettings(opd=...)"
        )
    return own
