"""The model of a fit: its frames, their images and derivatives, and chi-squared."""

from __future__ import annotations

import copy
import dataclasses
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError, ShapeError
from pyklip_diffrender.instrument.masks import mask_of_header
from pyklip_diffrender.io.headers import header_text
from pyklip_diffrender.io.units import ARCSEC, to_number
from pyklip_diffrender.linear.model import Noise
from pyklip_diffrender.linear.response import (
    NANOMETRE,
    Reading,
    ResponseCache,
    at_half_the_wavelengths,
    coarse_copy,
    downsample,
)
from pyklip_diffrender.optics.grid import PupilGrid, resample
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.refinement.unknowns import FrameUnknowns, Unknowns
from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.scene.exposure import flat_field_of, module_of
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd_map import OPDMap

# A frame to be fitted: data, noise, and the forward model in the data's unit.

_log = logging.getLogger(__name__)

_SCALE_TOLERANCE = 0.02
"""NIRCam's pixels differ by 1.3 % in x and y, and by 0.7 % from the square ones of stpsf."""


@dataclass
class Problem:
    """One star image to be explained, averaged over the frames of an observation."""

    model: OpticalSystem
    observation: Observation  # Before its frames are averaged.
    initial: OPDMap  # Starting wavefront.
    # Starting values of optical parameters (numbers in the units of the parameter table, or
    # Quantities), and of "flux" and "background" where known.
    start: dict[str, Any] = dataclasses.field(default_factory=dict)
    pattern: DetectorPattern | None = None  # Detector pattern of these pixels, with its error.

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
        # The frames share star and wavefront: their mean, weighted by their inverse variances,
        # takes their place.
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
        if self.pattern is not None:
            pattern, error = self.pattern.at(self.observation)
            self.gain = 1 + torch.from_numpy(pattern).to(device)
            self.gain_error = torch.from_numpy(error).to(device)
            self.pedestal = self.pattern.pedestal

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
        # With the rows M of the free levels (image, 1) and W = 1 / sigma^2, the values that
        # minimise the sum of W (d - M^T v)^2 solve (M W M^T) v = M W d; what is not free is
        # subtracted from d.
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
    """Refuse frames with another filter, mask, module or pixel scale than the model's.

    Settings that are unknown on either side, as for a system that is not an instrument, are not
    compared. Raises `IncompatibleSetupError`.
    """
    setup, header, name = model.setup, observation.header, observation.name
    setups = (
        ("filter", setup.get("filter"), observation.filter),
        ("image mask", setup.get("image_mask"), header_text(header, "CORONMSK", name)),
        ("pupil mask", setup.get("pupil_mask"), header_text(header, "PUPIL", name)),
        # `nircam_coronagraph` is of module A.
        ("module", setup.get("module", "A") if setup else None, module_of(header, name)),
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


def pixel_grid(model: OpticalSystem, values: Mapping[str, Tensor]) -> NDArray[np.float64]:
    """x, y of all pixels from the star, (ny, nx, 2), arcsec."""
    detector = model.detector
    x, y = (
        (axis.reshape(-1, detector.oversample).mean(dim=1) / ARCSEC).cpu().numpy()
        for axis in detector.axes(values)
    )
    star = values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu().numpy()
    across, up = np.meshgrid(x, y)
    return np.stack([across - star[0], up + detector.shear * across - star[1]], axis=-1)


# The forward model of a fit and its derivatives, at a point of the unknowns.

_SHIFT_ARCSEC = 5e-4
"""arcsec between images whose difference is a derivative; accurate to 1e-4."""


@dataclass(frozen=True)
class Point:
    """Values of the unknowns of a frame, and what they render."""

    unknowns: FrameUnknowns
    vector: Tensor  # (unknowns,).
    opd: Tensor  # (npix, npix), m; complex where the pupil's amplitude is free.
    fields: list[Tensor]  # The star's field at each wavelength, at flux 1.
    image: Tensor  # (ny, nx), the star at flux 1.
    # (ny, nx), the star in the data's unit, with the known detector pattern in its light and in
    # the pedestal, see `DetectorPattern`.
    light: Tensor
    star: Tensor  # (ny, nx), the star and the background.
    total: Tensor  # (ny, nx), with the companions.

    @property
    def multiplied(self) -> Tensor:
        """Light that the detector pattern multiplies, (ny, nx)."""
        return self.light + self.unknowns.level("pedestal", self.vector)


class Forward:
    """Renders points, and linearises about them; frames share the responses."""

    def __init__(self, problem: Problem, responses: ResponseCache) -> None:
        self.problem, self.model = problem, problem.model
        self.basis, self.responses = responses.basis, responses
        self.coarse = coarse_copy(problem.model, responses.npix)
        self._starting_opd = problem.starting_opd(self.model.npix)

    @cached_property
    def at_half_the_wavelengths(self) -> Forward:
        """Forward model of this frame at half as many wavelengths."""
        other = copy.copy(self)
        other.model = at_half_the_wavelengths(self.model)
        return other

    def opd(self, unknowns: FrameUnknowns, vector: Tensor) -> Tensor:
        """Return the wavefront, (npix, npix), m; complex if the pupil's amplitude is free."""
        grid = PupilGrid.full(self.model.npix, self.model.diameter)
        opd = self._starting_opd
        coefficients = vector[unknowns.where("modes")]
        if bool((coefficients != 0).any()):
            change = self.basis.opd(coefficients * NANOMETRE, grid)
            opd = opd + change.to(self.model.device)
        amplitude = vector[unknowns.where("amplitude")]
        # With an OPD o + i b the field is exp(i k o) exp(-k b): a positive imaginary part dims the
        # pupil. Amplitude modes have the unit -i nm, so that positive coefficients brighten it.
        if not len(amplitude):
            return opd
        padded = torch.zeros(len(self.basis), dtype=torch.float64)
        padded[: len(amplitude)] = amplitude
        absorption = -self.basis.opd(padded * NANOMETRE, grid).to(self.model.device)
        return torch.complex(opd, absorption)

    def coarse_opd(self, point: Point) -> Tensor:
        """The wavefront on the coarse copy's grid."""
        return downsample(point.opd, self.coarse.npix)

    def at(self, unknowns: FrameUnknowns, vector: Tensor, rendered: Tensor | None = None) -> Point:
        """Render a point, whose `total` has the companions of the mask `rendered` (companions,).

        By default `total` has all companions that the frame shows.
        """
        values, opd = unknowns.values(vector), self.opd(unknowns, vector)
        flux = unknowns.level("flux", vector)
        with torch.no_grad():
            fields = self.model.fields(opd, **values)
            image = self.model.image_of(fields, values).double()
        gain = self.problem.gain
        light = flux * gain * image + unknowns.level("pedestal", vector) * (gain - 1)
        star = light + unknowns.level("background", vector)
        sources = unknowns.visible_sources(vector)
        total = star
        for source in sources if rendered is None else sources[rendered]:
            total = total + flux * self._companion(unknowns, values, source, opd)
        return Point(unknowns, vector, opd, fields, image, light, star, total)

    def _companion(
        self, unknowns: FrameUnknowns, values: dict[str, Tensor], source: Tensor, opd: Tensor
    ) -> Tensor:
        """Image of a companion, beside a star of flux 1."""
        towards = self._towards(values, unknowns.turn @ source[1:])
        with torch.no_grad():
            return source[0] * self.model(opd, **towards).double()

    def sources(self, point: Point, offsets: Tensor) -> Tensor:
        """Images of point sources of contrast 1, (k, ny, nx), in the data's unit.

        `offsets` (k, 2) are x, y from the star, arcsec, in the orientation of this frame.
        """
        values = self._towards(point.unknowns.values(point.vector), offsets)
        with torch.no_grad():
            images = self.coarse(self.coarse_opd(point), **values)
        return point.unknowns.level("flux", point.vector) * images

    @staticmethod
    def _towards(values: dict[str, Tensor], offset: Tensor) -> dict[str, Tensor]:
        star = values.get("star_offset", torch.zeros(2, dtype=torch.float64))
        return {**values, "star_offset": star + offset.to(star.device)}

    def jacobian(self, point: Point, modes: int, kappa: float, reading: Reading) -> Tensor:
        """Derivative of `total`, (unknowns, ny, nx), float32, on the CPU.

        Up to the first `modes` modes; with 0 only what comes before amplitude and wavefront. The
        light of companions that are faint, or that a model error `kappa` outweighs, counts as
        independent of optics and wavefront. `reading` takes the derivatives of the field.
        """
        unknowns, bright = point.unknowns, point.unknowns.bright_sources(point.vector, kappa)
        levels = self.levels(point, bright)
        count = unknowns.where("companions").stop
        if modes:
            count = unknowns.where("modes").start + modes
        # One array, filled in place: it is the largest of the fit.
        rows = torch.empty(count, *point.image.shape, dtype=torch.float32)
        first = unknowns.where("companions").stop - len(levels)
        rows[first : first + len(levels)] = levels
        rows[:first], rows[unknowns.where("companions").stop :] = 0.0, 0.0
        for light in self._lights(point, bright, self.responses.few):
            self._add_slopes(rows, point, *light, modes, reading)
        return rows

    def _lights(
        self, point: Point, companions: Tensor, model: OpticalSystem
    ) -> Iterator[tuple[list[Tensor], dict[str, Tensor], Tensor]]:
        """Fields by a model, parameters, and level of the star and of companions (k, 3)."""
        unknowns, vector = point.unknowns, point.vector
        values, flux = unknowns.values(vector), unknowns.level("flux", vector)
        with torch.no_grad():
            fields = point.fields
            if model is not self.model:
                fields = model.fields(point.opd, **values)
        yield fields, values, flux * self.problem.gain
        for source in companions:
            towards = self._towards(values, unknowns.turn @ source[1:])
            with torch.no_grad():
                fields = model.fields(point.opd, **towards)
            yield fields, towards, flux * source[0] * torch.ones_like(self.problem.gain)

    def _add_slopes(
        self,
        rows: Tensor,
        point: Point,
        fields: list[Tensor],
        values: dict[str, Tensor],
        level: Tensor,
        modes: int,
        reading: Reading,
    ) -> None:
        """Add the derivatives of one source by optical parameters, amplitude and wavefront."""
        unknowns = point.unknowns
        response = reading.near(point.opd, values) if modes else None
        if unknowns.optical:
            slopes = reading.parameters(point.opd, values, unknowns.optical, fields)
            rows[: len(slopes)] += (level * slopes).cpu()
        if response is not None:
            amplitude = unknowns.where("amplitude")
            slopes = response.image(fields, values, unknowns.amplitude_modes, modes)
            slopes *= level.float()
            rows[amplitude] += slopes[modes:].cpu()
            rows[amplitude.stop :] += slopes[:modes].cpu()

    def levels(self, point: Point, companions: Tensor) -> Tensor:
        """Derivative of `total` by levels and companions, (unknowns, ny, nx), float32, on the CPU.

        Derivatives by companions are of the coarse copy. The derivative by the flux has the light
        of `companions`, (k, 3), besides the star's.
        """
        unknowns, vector = point.unknowns, point.vector
        flux, gain = unknowns.level("flux", vector), self.problem.gain
        # With the images S of the star and p_k of companions at flux 1, and the pattern g,
        #
        #     total = F (g S + sum_k c_k p_k) + background + pedestal (g - 1).
        by_level = {
            "flux": gain * point.image,
            "background": torch.ones_like(point.image),
            "pedestal": gain - 1,
        }
        for source in companions:
            light = self._companion(unknowns, unknowns.values(vector), source, point.opd)
            by_level["flux"] = by_level["flux"] + light
        rows = [by_level[name].float().cpu() for name in unknowns.linear]
        for source in unknowns.sources(vector):
            if not unknowns.shows_companions:
                rows += [torch.zeros(point.image.shape)] * 3
                continue
            opd = self.coarse_opd(point)
            values = self._towards(unknowns.values(vector), unknowns.turn @ source[1:])
            with torch.no_grad():
                rows.append((flux * self.coarse(opd, **values)).float().cpu())
            moved = self._position_slopes(opd, values)
            # The place in this frame is R x, so that the derivative by x is R^T times the
            # derivative by the place.
            turned = torch.tensordot(unknowns.turn.T, moved, dims=1)
            rows += list((flux * source[0] * turned).float())
        return torch.stack(rows) if rows else torch.zeros(0, *point.image.shape)

    def slopes(self, point: Point, pixels: Tensor, companions: Tensor) -> dict[str, Tensor]:
        """Derivatives of ``(pixels * image).sum()`` through the model itself, by name of unknowns.

        `pixels` is (ny, nx), and the image shows `companions` (k, 3) besides the star. Names are
        optical parameters, "modes" and, if it is free, "amplitude"; values are float64 on the CPU.
        `levels` has the derivatives by the other unknowns.
        """
        unknowns = point.unknowns
        names = unknowns.optical
        # The derivatives take as long as two or three images, by reverse mode at one wavelength
        # after the other. `jacobian` uses a coarse copy at fewer wavelengths, with an error that
        # exceeds a gradient near its zero, and without the light of faint companions.
        lights = self._lights(point, companions, self.model)
        totals = [
            torch.stack(parts).sum(dim=0)
            for parts in zip(
                *(self._source_slopes(point, *light, pixels) for light in lights), strict=True
            )
        ]
        by_name = dict(zip(names, totals[1:], strict=True))
        result = {name: slope.double().cpu().flatten() for name, slope in by_name.items()}
        result["modes"] = self._by_modes(totals[0].real)
        # For a real number L, torch's gradient G by a complex OPD means dL = Re(conj(G) dOPD). A
        # unit of amplitude is dOPD = -i, so that its derivative is -Im(G).
        if totals[0].is_complex():
            result["amplitude"] = -self._by_modes(totals[0].imag)[: unknowns.amplitude_modes]
        return result

    def _source_slopes(
        self, point: Point, fields: list[Tensor], values: dict[str, Tensor], level: Tensor,
        pixels: Tensor,
    ) -> list[Tensor]:  # fmt: skip
        """Derivatives of ``(pixels * image).sum()`` of one source by OPD and optical parameters."""
        # The light on the detector's samples is sum_l w_l |E_l|^2, so that with G = dL / dlight
        #
        #     dL = sum_l Re(conj(2 w_l G E_l) dE_l) + the part of the detector's own parameters.
        #
        # The fields E_l are known, so that each wavelength can be propagated again and
        # differentiated alone: memory is needed for one of them at a time.
        model, names, spectrum = self.model, point.unknowns.optical, self.model.bandpass
        values = model.values(values)
        inputs = [each.detach().clone() for each in (point.opd, *(values[n] for n in names))]
        for each in inputs:
            each.requires_grad_()
        values = {**values, **dict(zip(names, inputs[1:], strict=True))}
        grad = partial(torch.autograd.grad, allow_unused=True, materialize_grads=True)
        # The detector's part is linear in the light, and the same at all wavelengths.
        light = torch.zeros((), dtype=model.dtype, device=model.device)
        for field, weight in zip(fields, spectrum.weights, strict=True):
            light = light + weight * field.abs().square()
        light.requires_grad_()
        scale = (level * pixels).to(model.dtype)
        by_light, *totals = grad(
            (model.detector.image(light, values) * scale).sum(), [light, *inputs]
        )
        for wavelength, weight, field in zip(
            spectrum.wavelengths, spectrum.weights, fields, strict=True
        ):
            again = model.field(inputs[0], wavelength, values)
            by_field = 2 * weight * by_light * field
            parts = grad(again, inputs, by_field)
            totals = [total + part for total, part in zip(totals, parts, strict=True)]
        return totals

    def _by_modes(self, by_opd: Tensor) -> Tensor:
        """Derivatives by the modes, from derivatives by the OPD."""
        grid = PupilGrid.full(self.model.npix, self.model.diameter)
        modes = torch.zeros(len(self.basis), dtype=torch.float64, requires_grad=True)
        opd = self.basis.opd(modes * NANOMETRE, grid)
        return torch.autograd.grad(opd, modes, by_opd.cpu().to(opd.dtype))[0]

    def _position_slopes(self, opd: Tensor, values: dict[str, Tensor]) -> Tensor:
        """Derivatives with respect to x and y of a source, (2, ny, nx), per arcsec, on the CPU.

        Central differences: four images take a quarter of the time of forward-mode derivatives.
        """
        offset, slopes = values["star_offset"], []
        for step in _SHIFT_ARCSEC * torch.eye(2, dtype=offset.dtype, device=offset.device):
            with torch.no_grad():
                ahead = self.coarse(opd, **{**values, "star_offset": offset + step})
                behind = self.coarse(opd, **{**values, "star_offset": offset - step})
            slopes.append((ahead.double() - behind.double()).cpu() / (2 * _SHIFT_ARCSEC))
        return torch.stack(slopes)


# Derivatives of the pixels of a frame, which are used again at the same point.

ACCURATE = 0.05
"""Largest error of the derivatives that precondition accurate steps. Without these steps, fits
of bright stars stopped at a chi-squared that was up to a fifth too large: along directions in which
the effects of unknowns cancel, the curvature of the coarse copy was 20 times too small."""


@dataclass(frozen=True)
class FrameDerivatives:
    """Derivatives of the pixels of one frame, and where they were computed."""

    jacobian: Tensor  # (rows, ny, nx), float32.
    modes: int  # Number of leading modes with derivatives.
    opd: Tensor  # (npix, npix), m.
    values: dict[str, Tensor]  # Values of the parameters.
    sources: Tensor  # (companions, 3), companions that the frame shows.
    bright: Tensor  # (k, 3), companions whose light counts in derivatives, see `brightest`.
    error: float  # Relative error, as in a `Reading`.
    allowance: float  # Allowed error in this frame, whatever it is in others.

    @classmethod
    def at(
        cls,
        forward: Forward,
        point: Point,
        modes: int,
        outweighing: float,
        reading: Reading,
    ) -> FrameDerivatives:
        """Derivatives at a point, by its first `modes` modes.

        The model error `outweighing` decides which companions count, see `brightest`, and
        `reading` takes the derivatives of the field.
        """
        unknowns, vector = point.unknowns, point.vector
        return cls(
            forward.jacobian(point, modes, outweighing, reading),
            modes,
            point.opd,
            unknowns.values(vector),
            unknowns.visible_sources(vector),
            unknowns.bright_sources(vector, outweighing),
            reading.farthest,
            allowance(forward),
        )

    def is_about(self, point: Point, modes: int, outweighing: float) -> bool:
        """Whether these are the derivatives at a point, see `at`, but for its faint companions."""
        unknowns, vector = point.unknowns, point.vector
        return (
            self.modes == modes
            and torch.equal(self.opd, point.opd)
            and torch.equal(self.bright, unknowns.bright_sources(vector, outweighing))
            and all(
                name in self.values and torch.equal(self.values[name], value)
                for name, value in unknowns.values(vector).items()
            )
        )

    def with_companions_of(self, forward: Forward, point: Point) -> FrameDerivatives:
        """These derivatives, with new ones by the companions that the frame shows at a point."""
        unknowns, vector = point.unknowns, point.vector
        sources = unknowns.visible_sources(vector)
        where = unknowns.where("companions")
        after = self.modes + unknowns.amplitude_modes if self.modes else 0
        known = slice(where.start, len(self.jacobian) - after)
        if known == where and torch.equal(sources, self.sources):
            return self
        levels = forward.levels(point, sources[:0])
        own = levels[len(levels) - (where.stop - where.start) :]
        parts = (self.jacobian[: known.start], own, self.jacobian[known.stop :])
        return replace(self, jacobian=torch.cat(parts), sources=sources)


def allowance(forward: Forward) -> float:
    """Allowed error of a frame's derivatives, whatever it is in others."""
    # Limits for the target hardly depend on the derivatives of reference stars: with 0.05 they are
    # the same to 4e-4 as with 0.01.
    return ACCURATE if forward.problem.observation.reference else 0.0


# Chi-squared of a fit to one or several frames.

_LARGEST_KAPPA = 10.0
"""Largest model error, as a fraction of the star."""


@dataclass(frozen=True)
class State:
    """Values of all unknowns, a vector (unknowns,), and the points that they render, by frame."""

    unknowns: Unknowns
    vector: Tensor
    points: tuple[Point, ...]

    @property
    def flux(self) -> float:
        """Flux of the star in the first frame."""
        return self.points[0].unknowns.level("flux", self.points[0].vector)

    def bright_companions(self, kappa: float = 0.0) -> int:
        """Number of companions, over all frames, that count in Jacobians; see `brightest`."""
        return sum(len(p.unknowns.bright_sources(p.vector, kappa)) for p in self.points)

    @property
    def has_star(self) -> bool:
        """Whether all frames have starlight; without it, no derivative leads back to a star."""
        return all(point.unknowns.level("flux", point.vector) > 0 for point in self.points)


class Objective:
    """Compares states with the data of all frames, each with its `Forward`.

    `robust` is the residual in standard deviations with half the weight (Cauchy's loss); inf for
    least squares.
    """

    def __init__(self, forwards: Sequence[Forward], robust: float) -> None:
        self.forwards = tuple(forwards)
        # Which frames show the same pixels of the detector through the same flat field, so that the
        # error of the pattern is one unknown in all of them. In other frames it is noise.
        self.shares_pattern = _sharing([forward.problem for forward in self.forwards])
        self.robust = robust

    @property
    def pixels(self) -> int:
        """Number of pixels of all frames that are fitted."""
        return sum(forward.problem.pixels for forward in self.forwards)

    def at(self, unknowns: Unknowns, vector: Tensor) -> State:
        """Render all frames."""
        points = tuple(
            forward.at(frame, rows.of_unknowns(vector))
            for forward, frame, rows in zip(
                self.forwards, unknowns.frames, unknowns.rows, strict=True
            )
        )
        return State(unknowns, vector, points)

    def sigma(self, frame: int, point: Point, kappa: float) -> Tensor:
        """Noise and, in quadrature, a model error of the fraction `kappa` of the star."""
        return torch.sqrt(self.noise(frame, point) ** 2 + (kappa * point.total) ** 2)

    def noise(self, frame: int, point: Point) -> Tensor:
        """Noise of the data and, in quadrature, the error of the pattern."""
        problem = self.forwards[frame].problem
        return torch.hypot(problem.sigma, problem.gain_error * point.multiplied)

    def whitened(self, frame: int, point: Point, sigma: Tensor) -> Tensor:
        """Residual over `sigma`; 0 where masked."""
        problem = self.forwards[frame].problem
        return torch.where(problem.valid, (problem.data - point.total) / sigma, 0.0)

    def errors(self, state: State, kappa: float, robust: float) -> Noise:
        """Noise of all frames with the model error `kappa`, made robust about a state."""
        weights = []
        for k, point in enumerate(state.points):
            problem = self.forwards[k].problem
            whole = self.sigma(k, point, kappa)
            shares = self.shares_pattern[k]
            own = torch.hypot(problem.sigma, kappa * point.total) if shares else whole
            weight = torch.where(problem.valid, 1 / own, 0.0)
            if math.isfinite(robust):
                # Outliers show against all errors, the pattern's included.
                residual = self.whitened(k, point, whole)
                # Cauchy's loss b^2 log(1 + (r/b)^2) has the weight 1 / (1 + (r/b)^2) at residual r.
                weight = weight * torch.rsqrt(1 + (residual / robust) ** 2)
            weights.append(weight)
        common = [torch.zeros_like(weight) for weight in weights]
        sharing = [k for k, shares in enumerate(self.shares_pattern) if shares]
        if sharing:
            # c = s g / sqrt(1 + g^2 sum_f w_f^2 s_f^2), see `Noise`, with the light s that is
            # multiplied and the error g of the pattern.
            error = self.forwards[sharing[0]].problem.gain_error
            light = {k: state.points[k].multiplied for k in sharing}
            seen = sum((weights[k] * light[k]) ** 2 for k in sharing)
            scale = error / torch.sqrt(1 + error**2 * seen)
            for k in sharing:
                common[k] = light[k] * scale
        return Noise(tuple(weights), tuple(common))

    def residual(self, frame: int, point: Point) -> Tensor:
        """Data minus model; 0 where masked."""
        problem = self.forwards[frame].problem
        return torch.where(problem.valid, problem.data - point.total, 0.0)

    def residuals(self, state: State) -> list[Tensor]:
        """Data minus model of all frames."""
        return [self.residual(k, point) for k, point in enumerate(state.points)]

    def chi2(self, state: State, noise: Noise) -> float:
        """Chi-squared of all frames, with the errors that pixels share marginalised."""
        return noise.chi2(self.residuals(state))

    def chi2_per_pixel(self, state: State) -> float:
        """Chi-squared per pixel without a model error."""
        return self.chi2(state, self.errors(state, 0.0, math.inf)) / self.pixels

    def model_error(self, state: State) -> float:
        """The model error kappa at which chi-squared per pixel is 1, at least 0 and at most 10."""
        residuals, noises, stars = [], [], []
        for k, point in enumerate(state.points):
            problem = self.forwards[k].problem
            valid = problem.valid
            residuals.append((problem.data - point.total)[valid] ** 2)
            noises.append(self.noise(k, point)[valid] ** 2)
            stars.append(point.total[valid] ** 2)
        residual, noise, star = torch.cat(residuals), torch.cat(noises), torch.cat(stars)
        # The mean of r^2 / (n^2 + kappa^2 s^2) falls with kappa, so that bisection finds the kappa
        # at which it is 1.
        if float((residual / noise).mean()) <= 1:
            return 0.0
        low, high = 0.0, _LARGEST_KAPPA
        for _ in range(50):
            middle = (low + high) / 2
            too_small = float((residual / (noise + middle**2 * star)).mean()) > 1
            low, high = (middle, high) if too_small else (low, middle)
        return high


def _sharing(problems: Sequence[Problem]) -> tuple[bool, ...]:
    """Which frames show the same pixels with one flat field, whose pattern is uncertain.

    Of several such sets only the largest shares the pattern, or the first of equal ones.
    """
    places = [
        (seen.first_pixel, seen.shape, flat_field_of(seen.header, seen.name), id(each.pattern))
        for each in problems
        for seen in (each.observation,)
    ]
    known = [
        place
        for place, problem in zip(places, problems, strict=True)
        if place[0] is not None and bool((problem.gain_error > 0).any())
    ]
    # Such frames have the same first pixel, shape, flat field and pattern.
    most = max(known, key=known.count, default=None)
    if most is None or known.count(most) < 2:
        return (False,) * len(problems)
    return tuple(place == most for place in places)
