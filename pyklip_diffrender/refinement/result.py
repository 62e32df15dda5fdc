"""What a refinement gives back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
import torch
from astropy.table import QTable, Table
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.planning import Plan
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["Refinement", "Status"]


class Status(Enum):
    """How a refinement ended; the values are the messages."""

    CONVERGED = "converged, and the model explains the data within their noise"
    MODEL_MISMATCH = (
        "converged, but the model does not explain the data: errors are inflated by a model error"
    )
    PRIOR_MISMATCH = (
        "converged, but the wavefront found is improbable under the prior that was held fixed: "
        "errors are too small; let its scales be fitted (fit_scales=True), or widen them"
    )
    ITERATION_LIMIT = "stopped at the limit of iterations, before it converged"
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
        """Whether errors may be believed as they are."""
        return self not in (Status.MODEL_MISMATCH, Status.PRIOR_MISMATCH, Status.DIVERGED)


@dataclass
class Refinement:
    """A refined wavefront and the star that it renders.

    Attributes
    ----------
    model : OpticalSystem
    observation : Observation
    initial : OPDMap
        Where the wavefront started.
    opd : ndarray, (npix, npix), float64
        Best estimate, m, entrance-pupil orientation.
    star_image : ndarray, (ny, nx), float64
        The star (and background), in the observation's unit.
    values : dict of str to ndarray
        Every fitted parameter but the OPD, in the units of the parameter table.
    errors : dict of str to ndarray
        Standard deviations (NaN where the method gives none).
    status : Status
    method : str
    chi2_per_pixel : float
        With the errors of the observation, of what was fitted.
    model_error : float
        Share of the star's light in a pixel, in quadrature with the noise, that the model leaves
        unexplained; 0 when chi2 per pixel is near 1.
    history : list of dict
        One entry an iteration.
    seconds : float
    seed : int
    companions, companion_errors : ndarray, (companions, 3)
        Companions that had parameters of their own: contrast, x and y from the star in arcsec.
        They are not part of `star_image`.
    companion_image : ndarray, (ny, nx)
        Their light, in the observation's unit.
    scales : dict of str to float
        Prior scales at the end, nm.
    effective_parameters : float
        Number of wavefront parameters that the data determine.
    log_evidence : float
        Of the linearised model, up to a constant of the data: differences compare priors.
    coefficients : Tensor or None
        Of the basis, nm.
    linear : LinearModel or None
        All unknowns' effect on all pixels, for detection (None for methods without one). Frames
        that were refined together share it.
    frame : int
        Which of its frames this is.
    settings : GaussNewtonOptions, AdamOptions or LBFGSOptions
        How it was made.
    start : dict
        Starting values that were given.
    plan : Plan, optional
        By which the fit was made cheaper, and what that cost.
    """

    model: OpticalSystem
    observation: Observation
    initial: OPDMap
    opd: NDArray[np.float64]
    star_image: NDArray[np.float64]
    values: dict[str, NDArray[np.float64]]
    errors: dict[str, NDArray[np.float64]]
    status: Status
    method: str
    chi2_per_pixel: float
    model_error: float
    history: list[dict[str, Any]]
    seconds: float
    seed: int
    companions: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    companion_errors: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    companion_image: NDArray[np.float64] | float = 0.0
    scales: dict[str, float] = field(default_factory=dict)
    effective_parameters: float = float("nan")
    log_evidence: float = float("nan")
    coefficients: Tensor | None = None
    linear: LinearModel | None = None
    frame: int = 0
    settings: Any = None
    start: dict[str, Any] = field(default_factory=dict)
    plan: Plan | None = None

    def __repr__(self) -> str:
        return (
            f"<Refinement by {self.method}: {self.status.name}, chi2/pixel "
            f"{self.chi2_per_pixel:.3g}, {self.seconds:.1f} s>"
        )

    @property
    def reduced_chi2(self) -> float:
        """chi2 per pixel over what noise and the number of fitted modes make it.

        Of all frames that were refined together. NaN for methods that do not count modes.
        """
        if self.linear is None:
            return math.nan
        pixels = sum(int((frame.weight > 0).sum()) for frame in self.linear.frames)
        return self.chi2_per_pixel / max(1 - self.effective_parameters / pixels, 1e-3)

    @property
    def residual(self) -> NDArray[np.float64]:
        """Data minus star, (frames, ny, nx); NaN where the data are masked.

        It has lost a part of the light of sources that the fit knew nothing of; see
        `Detection.subtracted`.
        """
        data = self.observation.data - self.star_image
        return np.where(self.observation.valid, data, np.nan)

    @property
    def optical_values(self) -> dict[str, Tensor]:
        """Values of the model's own parameters, as the model takes them."""
        return {
            name: torch.from_numpy(value)
            for name, value in self.values.items()
            if name in self.model.parameters
        }

    @property
    def parameters(self) -> Table:
        """All fitted parameters but the OPD: name, value, error, unit, description."""
        rows = []
        for name, value in self.values.items():
            entry = parameter(name)
            for k, (number, error) in enumerate(zip(value, self.errors[name], strict=True)):
                label = name if len(value) == 1 else f"{name}[{k}]"
                rows.append((label, number, error, entry.unit, entry.description))
        return QTable(
            rows=rows,
            names=("name", "value", "error", "unit", "description"),
            dtype=(str, float, float, str, str),
        )

    def render(
        self,
        fov_pixels: int | tuple[int, int] | None = None,
        center: tuple[float, float] | None = None,
        *,
        background: bool = True,
    ) -> NDArray[np.float64]:
        """The star on another array of pixels of the same scale.

        Parameters
        ----------
        fov_pixels : int or (ny, nx), optional
            Default as fitted.
        center : (x, y), optional
            Where, in pixels of the new array, the pixel position given as the observation's
            `center` should come to lie. Default the middle of the array.
        background : bool
            Add the fitted background.

        Returns
        -------
        ndarray, (ny, nx)
            In the observation's unit.
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
        return float(self.values["flux"][0]) * image + level

    def summary(self) -> Mapping[str, Any]:
        """The facts that belong in a header or a log, without arrays."""
        return {
            "method": self.method,
            "status": self.status.name,
            "chi2_per_pixel": self.chi2_per_pixel,
            "model_error": self.model_error,
            "seconds": self.seconds,
            "seed": self.seed,
            "opd": self.initial.name,
            "opd_sha256": self.initial.sha256,
            **({} if self.plan is None else self.plan.summary()),
        }
