"""A frame to be fitted: data, noise, and the forward model in the data's unit."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError, ShapeError
from pyklip_diffrender.instrument.masks import mask_of_header
from pyklip_diffrender.io.units import to_number
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.scene.exposure import module_of
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.systematics import Systematics
from pyklip_diffrender.wavefront.opd import OPDMap, resample

__all__ = ["Problem", "starting_values"]

_log = logging.getLogger(__name__)

_SCALE_TOLERANCE = 0.02
"""NIRCam's pixels differ by 1.3 % in x and y, and by 0.7 % from the square ones of stpsf."""


@dataclass
class Problem:
    """One star image to be explained.

    Frames of an observation that share star and wavefront are averaged first, with their
    inverse variances as weights.

    Attributes
    ----------
    model : OpticalSystem
    observation : Observation
        Before the frames are averaged.
    initial : OPDMap
        Starting wavefront.
    start : dict
        Starting values of optical parameters (numbers in the units of the parameter table, or
        Quantities), and of "flux" and "background" where known.
    systematics : Systematics, optional
        Flat-field pattern of these pixels, with its error.
    """

    model: OpticalSystem
    observation: Observation
    initial: OPDMap
    start: dict[str, Any] = field(default_factory=dict)
    systematics: Systematics | None = None

    def __post_init__(self) -> None:
        if self.observation.shape != self.model.detector.shape:
            ny, nx = self.model.detector.shape
            raise ShapeError(
                f"the observation has {self.observation.shape[0]} x {self.observation.shape[1]} "
                f"pixels, the model {ny} x {nx}. Cut with observation.cutout({ny}), or make the "
                "model with fov_pixels to match"
            )
        require_same_setup(self.model, self.observation)
        self.require_parameters(self.start, "start")
        self.start = dict(self.start)
        for name in {"flux", "background"} & self.start.keys():
            unit = self.observation.unit
            self.start[name] = to_number(self.start[name], unit, f"start: {name}")
        combined = self.observation.combined()
        device = self.model.device
        self.data = torch.from_numpy(combined.data[0]).to(device)
        self.sigma = torch.from_numpy(combined.error[0]).to(device)
        self.valid = torch.from_numpy(combined.valid[0]).to(device)
        if not bool(self.valid.any()):
            raise NoValidPixelsError(f"{self.observation.name}: all pixels are masked")
        self.gain = torch.ones_like(self.data)
        self.gain_error = torch.zeros_like(self.data)
        self.pedestal = 0.0
        if self.systematics is not None:
            pattern, error = self.systematics.at(self.observation)
            self.gain = 1 + torch.from_numpy(pattern).to(device)
            self.gain_error = torch.from_numpy(error).to(device)
            self.pedestal = self.systematics.pedestal

    def leave_out(self, pixels: Tensor) -> None:
        """Mask pixels, (ny, nx), in all frames of the observation."""
        if bool(pixels.any()):
            places = [(x, y) for y, x in torch.nonzero(pixels).tolist()]
            _log.info("%s: bad pixels (x, y) left out: %s", self.observation.name, places)
            self.valid = self.valid & ~pixels.to(self.valid.device)
            self.observation = replace(
                self.observation, valid=self.observation.valid & ~pixels.cpu().numpy()
            )

    def starting_opd(self, npix: int) -> Tensor:
        """The starting wavefront on a pupil array of (npix, npix), m."""
        opd = resample(self.initial.data, npix)
        return torch.from_numpy(np.ascontiguousarray(opd)).to(self.model.device)

    @property
    def has_free_pedestal(self) -> bool:
        """Whether the known pattern tells how much light it multiplies besides the star."""
        return self.pedestal > 0 and bool((self.gain != 1).any())

    @property
    def pixels(self) -> int:
        """Number of pixels that are fitted."""
        return int(self.valid.sum())

    def optical_start(self, names: tuple[str, ...]) -> dict[str, Tensor]:
        """Starting values of the named optical parameters and of any given otherwise."""
        starts = self.model.values(
            {n: v for n, v in self.start.items() if n in self.model.parameters}
        )
        missing = [parameter(name) for name in names if name not in starts]
        others = self.model.values({p.name: np.full(p.size, p.start) for p in missing})
        # `values` fills in the model's defaults, which must not replace explicit values.
        return {**others, **starts}

    def require_parameters(self, names: Iterable[str], argument: str = "free") -> None:
        """Raise `IncompatibleSetupError` for a name that is no parameter of this problem."""
        available = (*self.model.parameters, "flux", "background")
        for name in names:
            if name not in available:
                raise IncompatibleSetupError(
                    f"{argument}: {name!r} is not a parameter of this model, which has {available}"
                )

    def flux_and_background(
        self,
        image: Tensor,
        sigma: Tensor,
        names: tuple[str, ...],
    ) -> tuple[float, float]:
        """Weighted least-squares flux and background for a rendered star.

        A parameter that is not in `names` keeps its start (flux must then have been given).
        """
        weight = torch.where(self.valid, sigma**-2, 0.0)
        flux = float(self.start.get("flux", 0.0))
        level = float(self.start.get("background", 0.0))
        columns = []
        if "flux" in names:
            columns.append(image)
        if "background" in names:
            columns.append(torch.ones_like(image))
        target = self.data - (0 if "flux" in names else flux) * image
        target = target - (0 if "background" in names else level)
        if columns:
            design = torch.stack(columns).flatten(1)
            # Columns of very different size: solve for them in units of their own length.
            length = torch.sqrt((design**2 * weight.flatten()).sum(dim=1))
            scaled = design / length[:, None]
            solution = torch.linalg.solve(
                (scaled * weight.flatten()) @ scaled.T,
                (scaled * weight.flatten()) @ target.flatten(),
            )
            values = (solution / length).tolist()
            flux = values[0] if "flux" in names else flux
            level = values[-1] if "background" in names else level
        return flux, level


def require_same_setup(model: OpticalSystem, observation: Observation) -> None:
    """Compare filter, masks, module and pixel scale of a model with those of the frames.

    Settings that are unknown on either side, such as those of a system that is not an instrument,
    are not compared.

    Raises
    ------
    IncompatibleSetupError
    """
    setup, header = model.setup, observation.header
    setups = (
        ("filter", setup.get("filter"), observation.filter),
        ("image mask", setup.get("image_mask"), header.get("CORONMSK")),
        ("pupil mask", setup.get("pupil_mask"), header.get("PUPIL")),
        ("module", setup.get("module"), module_of(header, observation.name)),
    )
    for aspect, expected, actual in setups:
        if not isinstance(expected, str) or not isinstance(actual, str):
            continue
        if mask_of_header(actual) != expected.upper():
            raise IncompatibleSetupError(
                f"{observation.name}: these frames have {aspect} {actual}, the model {expected}. "
                "Make the model for the frames, with nircam_coronagraph or from_webbpsf"
            )
    ours, theirs = np.array(model.detector.pixelscale), np.array(observation.pixelscale)
    if (np.abs(theirs / ours - 1) > _SCALE_TOLERANCE).any():
        raise IncompatibleSetupError(
            f"{observation.name}: these frames have {observation.pixelscale} arcsec per pixel in "
            f"(x, y), the model {model.detector.pixelscale}. Make the model with "
            "pixelscale=observation.pixelscale"
        )


def starting_values(
    model: OpticalSystem, observation: Observation, start: Mapping[str, Any]
) -> dict[str, Any]:
    """Add the position of the star, if the observation has one, to the starting values."""
    ny, nx = observation.shape
    displacement = observation.center[0] - np.array([(nx - 1) / 2, (ny - 1) / 2])
    axis = displacement * np.array(model.detector.pixelscale)
    if observation.star_offset is not None and "star_offset" in model.parameters:
        start = {"star_offset": observation.star_offset, **start}
        # The optical axis goes through the occulter, and the star's image is beside it.
        axis -= observation.star_offset
    if "detector_shift" in start or np.abs(axis).max() <= 1e-10:
        return dict(start)
    return {**start, "detector_shift": axis}
