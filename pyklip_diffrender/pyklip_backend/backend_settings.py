"""The settings of a reduction and the OPD map it starts from.

`klip_dataset` accepts no further keywords, so the settings of the backend come from three places.
A field given in an earlier one overrides the same field in a later one:

1. the innermost ``with backend(...)`` around the call,
2. ``dataset.diffrender = DiffrenderSettings(...)``, which its copies share,
3. the defaults given to ``register(...)``.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from astropy import units as u
from astropy.time import Time
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.errors import IncompatibleSetupError, MissingOPDError
from pyklip_diffrender.options import OPTIONS, Accuracy, ReduceOptions
from pyklip_diffrender.wavefront.opd import opd_for
from pyklip_diffrender.wavefront.opd_map import OPDMap

if TYPE_CHECKING:
    from pyklip_diffrender.pattern import PatternLibrary
    from pyklip_diffrender.refinement import FitSettings
    from pyklip_diffrender.scene.detector_pattern import DetectorPattern

OPDLike: TypeAlias = "str | os.PathLike[str] | NDArray[np.floating[Any]] | u.Quantity | OPDMap"
"""An OPD map: a FITS file, an array in metres, a Quantity, or what `read_opd` returns."""

IMAGES = ("cleaned", "subtracted")
"""Images that the products can carry."""

ATTRIBUTE = "diffrender"
"""Attribute of a dataset that holds its own settings."""


@dataclass(frozen=True, eq=False)
class DiffrenderSettings:
    """Settings of ``algo="diffrender"``; a field that is None is not set here.

    Attributes
    ----------
    opd : path, ndarray, Quantity or OPDMap, optional
        OPD map to start from: a FITS file, or a square array in metres, OTE entrance-pupil
        orientation. There is no default: a reduction without one raises `MissingOPDError`. Of a
        folder of maps, the one closest in time to the frames is taken; see `choose_opd` for other
        rules. "flat" stands for a flat wavefront.
    model : optical model, optional
        Model from `nircam_coronagraph` or a bridge. Made for the filter if not given.
    filter : str, optional
        NIRCam filter, such as ``"F444W"``. Read from the dataset if possible.
    pixelscale : float or (x, y), optional
        Arcsec per pixel. Read from the dataset if possible.
    size : int, optional
        Side in pixels of the fitted square about the star; the subtraction covers the whole
        frame. By default as large as the frames allow, up to 80, or up to 56 for a first look with
        ``accuracy="quick"``.
    error : array_like, optional
        Standard deviation per pixel, in the unit of the frames: a number, (ny, nx), or
        (n, ny, nx) for the frames of ``dataset.input``. Read from the ERR extension if there is
        one, else estimated from the frames.
    unit : Unit, optional
        Unit of the frames. Read from BUNIT if present, else dimensionless.
    pattern : DetectorPattern, PatternLibrary, path, "auto", "references" or "off", optional
        Detector pattern. "auto", the default for real NIRCam frames, takes the pattern of the
        package's library, and learns it from the reference frames where it has none; "references"
        learns it from them in any case and uses both; a library, its file, or a folder of such
        files is searched besides the package's; see `reduce`. Reference frames come from a
        psf_library that `JWSTData` has read, if the mode contains RDI, and any in the dataset.
    keep_detected : bool, optional
        Subtract none of the light of detected companions with the star; True by default for real
        NIRCam frames, else False. Bright ones are part of the fit in any case, as in `reduce`.
        Undetected companions still lose light, as much as the throughput map says.
    image : {"cleaned", "subtracted"}, optional
        Image that the products carry. "subtracted", the only one for forward models and the default
        but for real NIRCam frames, is each frame minus its star. "cleaned", the default for real
        NIRCam frames, is the posterior mean of the sky from all rolls together, see
        ``imaging.SkyModel``: sources are as sharp as in the frames but have no side lobes, which
        takes up to half of the light of a disk. Every frame has it on its own pixels, so that
        pyKLIP's mean or median of the frames is the same image. Pixels beyond the fitted square
        have the frames minus star.
    max_chi2 : float, optional
        Reduced chi-squared above which a fit is implausible and the reduction stops with a
        `RefinementError`; 100 by default, inf for no limit.
    injected_into : pyklip.instruments.Instrument.Data, optional
        A dataset that has been reduced. The calls reduce copies of it to which faint sources
        were added; the star is not fitted to them again, but what it takes of the sources follows
        from the linear model of the fit. For contrast curves by injection.
    (see the options)
    model_options : mapping, optional
        Further keywords of `nircam_coronagraph`, such as ``npix`` and ``nlambda``.
    subtractor : callable, optional
        Function of an `Observation`, an `OPDMap` and these settings that returns a `Subtraction`;
        `subtract_by_refinement` by default. It runs in the main process and gets frames that have
        at least one valid pixel. A DiffrenderError stops the reduction, which then leaves no
        products.

    Raises
    ------
    IncompatibleSetupError
        For a value that a field cannot have, and for names in `model_options` that are none of
        `nircam_coronagraph`.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> settings = dr.pyklip_backend.DiffrenderSettings(opd="opd.fits", size=80)

    For one `dataset` that pyKLIP has read:

    >>> dataset.diffrender = settings  # doctest: +SKIP
    """

    opd: OPDLike | None = None
    model: Any = None
    filter: str | None = None
    pixelscale: float | tuple[float, float] | None = None
    size: int | None = None
    error: ArrayLike | None = None
    unit: u.UnitBase | None = None
    settings: FitSettings | None = None
    start: Mapping[str, Any] | None = None
    pattern: DetectorPattern | PatternLibrary | str | os.PathLike[str] | None = None
    references: str | None = None
    keep_detected: bool | None = None
    threshold: float | None = None
    disk: bool | None = None
    star_flux: float | str | u.Quantity | None = None
    star_flux_error: float | None = None
    accuracy: Accuracy | None = None
    image: Literal["cleaned", "subtracted"] | None = None
    max_chi2: float | None = None
    injected_into: Any = None
    model_options: Mapping[str, Any] = field(default_factory=dict)
    subtractor: Callable[..., Any] | None = None

    def __post_init__(self) -> None:
        from pyklip_diffrender.instrument.nircam import nircam_coronagraph
        from pyklip_diffrender.refinement import FitSettings

        options = ReduceOptions(**self.given)
        if self.pattern is not None:
            # What is read from files is kept: settings are merged for every call.
            object.__setattr__(self, "pattern", options.pattern)
        choices = (
            ("image", self.image, IMAGES),
            ("keep_detected", self.keep_detected, (True, False)),
        )
        for name, chosen, allowed in choices:
            if chosen is not None and chosen not in allowed:
                raise IncompatibleSetupError(
                    f"{name}: got {chosen!r}, expected one of {', '.join(map(str, allowed))}"
                )
        for name, value, kind in (
            ("settings", self.settings, FitSettings),
            ("start", self.start, Mapping),
            ("model_options", self.model_options, Mapping),
        ):
            if value is not None and not isinstance(value, kind):
                raise IncompatibleSetupError(
                    f"{name}: got a {type(value).__name__}, expected a "
                    f"{'dict' if kind is Mapping else kind.__name__}"
                )
        known = set(inspect.signature(nircam_coronagraph).parameters) - {"filter"}
        wrong = sorted(set(self.model_options) - known)
        # Another subtractor may make another model.
        if wrong and self.subtractor is None:
            raise IncompatibleSetupError(
                f"model_options: {', '.join(wrong)}: not known to nircam_coronagraph, which has "
                f"{', '.join(sorted(known))}"
            )

    @property
    def given(self) -> dict[str, Any]:
        """Options that are set here, of those that `reduce` has under the same name."""
        values = {name: getattr(self, name, None) for name in OPTIONS}
        return {name: value for name, value in values.items() if value is not None}

    def over(self, other: DiffrenderSettings) -> DiffrenderSettings:
        """Complete the settings from `other`."""
        merged: dict[str, Any] = {}
        for each in fields(self):
            own = getattr(self, each.name)
            merged[each.name] = getattr(other, each.name) if own is None else own
        merged["model_options"] = {**other.model_options, **self.model_options}
        return DiffrenderSettings(**merged)

    def __deepcopy__(self, memo: dict[int, Any]) -> DiffrenderSettings:
        """Itself: it never changes, and a contrast curve copies its dataset 120 times."""
        return self


DiffrenderSettings.__doc__ = inspect.cleandoc(DiffrenderSettings.__doc__ or "").replace(
    "(see the options)",
    "\n".join(
        OPTIONS[name].entry
        for name in (
            "settings",
            "start",
            "references",
            "threshold",
            "disk",
            "star_flux",
            "star_flux_error",
            "accuracy",
        )
    ),
)


def settings_of(dataset: Any) -> DiffrenderSettings:
    """Settings attached to a dataset; empty if there are none.

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


def starting_opd(settings: DiffrenderSettings, date: Time | None) -> OPDMap:
    """Read the OPD map that the settings name, or choose it by the date of the frames.

    Raises
    ------
    MissingOPDError
        If there is none, or none of that date.
    IncompatibleSetupError
        If a map is to be chosen by a date that is not known.
    CorruptFileError, UnitError, ShapeError, NonFiniteError
        As `read_opd`.

    Warns
    -----
    DiffrenderWarning
        If the map is more than 200 days from the date.
    """
    if settings.opd is None:
        raise MissingOPDError(
            "algo='diffrender' starts from a measured OPD map and none was given. Give a "
            "FITS file, an array in metres or a Quantity, in one of three ways: "
            "register(opd=...) once; `with backend(opd=...):` around klip_dataset; or "
            "dataset.diffrender = DiffrenderSettings(opd=...). For JWST, take the map measured "
            "closest in time to the observation, or give the folder with your maps; opd='flat' "
            "starts without one"
        )
    return opd_for(settings.opd, date)
