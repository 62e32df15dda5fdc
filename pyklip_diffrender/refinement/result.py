"""The result of a refinement: `Refinement`, and `FrameFit` for each of its frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
import torch
from astropy.table import QTable
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.planning import Plan
from pyklip_diffrender.refinement.settings import Adam, GaussNewton
from pyklip_diffrender.refinement.systematics import Systematics
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["FrameFit", "Refinement", "Status"]

Image = NDArray[np.float64]


class Status(Enum):
    """How a refinement ended; the values are the messages."""

    CONVERGED = "converged, and the model explains the data within their noise"
    MODEL_MISMATCH = (
        "converged, but the model does not explain the data: errors include a model error"
    )
    PRIOR_MISMATCH = (
        "converged, but the wavefront is improbable under a prior that was held fixed, so that "
        "errors are too small; let the prior's scales be fitted (fit_scales=True), or widen them"
    )
    ITERATION_LIMIT = "stopped at the limit of iterations before it converged"
    COMPLETED = "all iterations of a fixed recipe were done"
    DIVERGED = "failed: the fitted star has no light, or the loss is not a number"

    @property
    def message(self) -> str:
        """The same as the value."""
        return self.value

    @property
    def usable(self) -> bool:
        """Whether the result may be subtracted."""
        return self is not Status.DIVERGED

    @property
    def calibrated(self) -> bool:
        """Whether the stated errors can be relied on as they are."""
        return self not in (Status.MODEL_MISMATCH, Status.PRIOR_MISMATCH, Status.DIVERGED)


@dataclass(frozen=True, eq=False)
class FrameFit:
    """The star in one frame of a refinement.

    Attributes
    ----------
    model : OpticalSystem
    observation : Observation
        As it was given; several frames of one observation are averaged for the fit.
    start : dict
        Starting values of parameters, by name.
    opd : ndarray, (npix, npix)
        Best estimate of the wavefront, m, entrance-pupil orientation. Complex if the pupil's
        amplitude was free: the imaginary part is then an absorption.
    star : ndarray, (ny, nx)
        The star and the background, in the unit of the observation.
    companion_image : ndarray, (ny, nx)
        Light of the companions that had parameters of their own; not part of `star`.
    values, errors : dict of str to ndarray
        Every parameter but the wavefront and its standard deviation (NaN where it was not
        fitted), in the units of the parameter table.
    gain : ndarray, (ny, nx)
        Known pattern of the model's error by which the star is multiplied; 1 without systematics.
    coefficients : ndarray or None
        Coefficients of the wavefront modes, nm.
    """

    model: OpticalSystem
    observation: Observation
    start: dict[str, Any]
    opd: NDArray[Any]
    star: Image
    companion_image: Image
    values: dict[str, Image]
    errors: dict[str, Image]
    gain: Image
    coefficients: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        return f"<FrameFit: {self.observation.name}, flux {self.flux:.4g}>"

    @property
    def flux(self) -> float:
        """Light of the star that the pupil collects, in the unit of the observation."""
        return float(self.values["flux"][0])

    @property
    def residual(self) -> Image:
        """Data minus star, (frames, ny, nx); NaN where the data are masked.

        Some of the light of sources that were not part of the fit has been taken for the star's
        and is lost here; `Detection.subtracted` keeps it.
        """
        data = self.observation.data - self.star
        return np.where(self.observation.valid, data, np.nan)

    @property
    def optical_values(self) -> dict[str, Tensor]:
        """Values of the model's own parameters, as the model takes them."""
        return {
            name: torch.from_numpy(value)
            for name, value in self.values.items()
            if name in self.model.parameters
        }

    def render(
        self,
        fov_pixels: int | tuple[int, int] | None = None,
        center: tuple[float, float] | None = None,
        *,
        background: bool = True,
    ) -> Image:
        """Render the star on another array of pixels of the same scale.

        Parameters
        ----------
        fov_pixels : int or (ny, nx), optional
            Default as fitted.
        center : (x, y), optional
            Pixel of the new array on which the observation's `center` falls. Default the middle
            of the array.
        background : bool
            Add the fitted background.

        Returns
        -------
        ndarray, (ny, nx)
            In the unit of the observation, without the pattern of the model's error.
        """
        model = self.model
        if fov_pixels is not None and fov_pixels != self.model.detector.shape:
            model = model.with_fidelity(fov_pixels=fov_pixels, fov_arcsec=None)
        values = self.optical_values
        if center is not None:
            ny, nx = model.detector.shape
            old = self.observation.center[0] - (np.array(self.observation.shape[::-1]) - 1) / 2
            moved = np.array(center) - (np.array([nx, ny]) - 1) / 2 - old
            shift = torch.from_numpy(moved * np.array(model.detector.pixelscale))
            values["detector_shift"] = shift + values.get("detector_shift", torch.zeros(2))
        with torch.no_grad():
            image = model(torch.from_numpy(self.opd), **values).double().cpu().numpy()
        level = float(self.values["background"][0]) if background else 0.0
        return np.asarray(self.flux * image + level)


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined wavefront and the stars that it renders, for frames that were fitted together.

    Attributes
    ----------
    frames : tuple of FrameFit
        One for each observation, in the order given.
    initial : OPDMap
        The wavefront map that the fit started from.
    settings : GaussNewton or Adam
    basis : Basis or None
        Wavefront modes that were fitted.
    status : Status
    chi2_per_pixel : float
        With the errors of the observations (and those of `systematics`).
    model_error : float
        Error of the star model that is assumed, as a fraction of the star's light in a pixel, in
        quadrature with the noise; 0 when chi-squared per pixel is near 1.
    companions, companion_errors : ndarray, (companions, 3)
        Companions with parameters of their own: contrast, and x and y from the star in arcsec as
        the first frame shows them.
    scales : dict of str to float
        Scales of the prior at the end, nm.
    effective_parameters : float
        Number of wavefront parameters that the data determine; NaN where not known.
    log_evidence : float
        Of the linearised model, up to a constant of the data: differences compare priors.
    linear : LinearModel or None
        Effect of all unknowns on all pixels, which `detect` needs (None for the Adam recipe).
    systematics : Systematics or None
        What was assumed of the model's error.
    plan : Plan or None
        The model fidelity that was chosen; None if the model was used as given.
    history : list of dict
        One entry for each iteration.
    seconds : float
    seed : int
    """

    frames: tuple[FrameFit, ...]
    initial: OPDMap
    settings: GaussNewton | Adam
    status: Status
    chi2_per_pixel: float
    basis: Basis | None = None
    model_error: float = math.nan
    companions: Image = field(default_factory=lambda: np.zeros((0, 3)))
    companion_errors: Image = field(default_factory=lambda: np.zeros((0, 3)))
    scales: dict[str, float] = field(default_factory=dict)
    effective_parameters: float = math.nan
    log_evidence: float = math.nan
    linear: LinearModel | None = None
    systematics: Systematics | None = None
    plan: Plan | None = None
    history: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = math.nan
    seed: int = 0

    def __repr__(self) -> str:
        count = len(self.frames)
        return (
            f"<Refinement: {self.status.name}, {count} frame{'s' if count > 1 else ''}, "
            f"chi2/pixel {self.chi2_per_pixel:.3g}, {self.seconds:.1f} s>"
        )

    @property
    def model(self) -> OpticalSystem:
        """The optical system, as it was given."""
        return self.frames[0].model

    @property
    def wavefront(self) -> NDArray[Any]:
        """The refined wavefront of the first frame, (npix, npix), m."""
        return self.frames[0].opd

    @property
    def method(self) -> str:
        """Name of the method."""
        return "adam" if isinstance(self.settings, Adam) else "gauss-newton"

    @property
    def planets(self) -> tuple[Planet, ...]:
        """The companions as planets; negative contrasts become 0."""
        return tuple(Planet.from_offset(max(c, 0.0), x, y) for c, x, y in self.companions.tolist())

    @property
    def reduced_chi2(self) -> float:
        """Chi-squared per degree of freedom; NaN where the number of modes is not known."""
        if self.linear is None:
            return math.nan
        pixels = sum(int((frame.weight > 0).sum()) for frame in self.linear.frames)
        return self.chi2_per_pixel / max(1 - self.effective_parameters / pixels, 1e-3)

    @cached_property
    def star_only(self) -> LinearModel:
        """The linear model with the companions' light put back into the data.

        Raises
        ------
        IncompatibleSetupError
            If the method has no linear model.
        """
        if self.linear is None:
            raise IncompatibleSetupError(
                f"a fit by method {self.method!r} has no linear model of its unknowns; use "
                "refine(settings=GaussNewton()), the default"
            )
        if not len(self.companions):
            return self.linear
        light: dict[int, NDArray[np.float64] | Tensor | float] = {
            k: frame.companion_image for k, frame in enumerate(self.frames)
        }
        return self.linear.without("companions", light)

    @property
    def parameters(self) -> QTable:
        """All parameters but the wavefront: frame, name, value, error, unit and description."""
        rows = []
        for k, frame in enumerate(self.frames):
            for name, value in frame.values.items():
                entry = parameter(name)
                for j, (number, error) in enumerate(zip(value, frame.errors[name], strict=True)):
                    label = name if len(value) == 1 else f"{name}[{j}]"
                    rows.append((k, label, number, error, entry.unit, entry.description))
        table = QTable(
            rows=rows,
            names=("frame", "name", "value", "error", "unit", "description"),
            dtype=(int, str, float, float, str, str),
        )
        for name in ("value", "error"):
            table[name].info.format = ".5g"
        return table

    def summary(self) -> Mapping[str, Any]:
        """Return the facts that belong in a header or a log, without arrays."""
        return {
            "method": self.method,
            "status": self.status.name,
            "frames": len(self.frames),
            "chi2_per_pixel": self.chi2_per_pixel,
            "model_error": self.model_error,
            "seconds": self.seconds,
            "seed": self.seed,
            "opd": self.initial.name,
            "opd_sha256": self.initial.sha256,
            "systematics": "none" if self.systematics is None else self.systematics.name,
            **({} if self.plan is None else self.plan.summary()),
        }
