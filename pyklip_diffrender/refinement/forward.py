"""The forward model of a fit and its derivatives, at a point of the unknowns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from pyklip_diffrender.linear.mode_fields import NANOMETRE
from pyklip_diffrender.linear.response import coarse_copy, downsample
from pyklip_diffrender.linear.response_cache import Reading, ResponseCache
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.unknowns import FrameUnknowns

__all__ = ["Forward", "Point"]

_DIFFERENCE = 5e-4
"""arcsec between images whose difference is a derivative; accurate to 1e-4."""


@dataclass(frozen=True)
class Point:
    """Values of the unknowns of a frame, and what they render.

    Attributes
    ----------
    unknowns : FrameUnknowns
    vector : Tensor
    opd : Tensor, (npix, npix)
        m; complex where the pupil's amplitude is free.
    fields : list of Tensor
        The star's field at each wavelength, at flux 1.
    image : Tensor, (ny, nx)
        The star at flux 1.
    light : Tensor, (ny, nx)
        The star in the data's unit, with the known flat-field pattern (also that of the
        pedestal, see `Systematics`).
    star : Tensor, (ny, nx)
        The star and the background.
    total : Tensor, (ny, nx)
        With the companions.
    """

    unknowns: FrameUnknowns
    vector: Tensor
    opd: Tensor
    fields: list[Tensor]
    image: Tensor
    light: Tensor
    star: Tensor
    total: Tensor

    @property
    def multiplied(self) -> Tensor:
        """Light that the flat-field pattern multiplies, (ny, nx)."""
        return self.light + self.unknowns.level("pedestal", self.vector)


class Forward:
    """Renders points, and linearises about them.

    Parameters
    ----------
    problem : Problem
    responses : ResponseCache
        Of the model to the basis; shared by frames.
    """

    def __init__(self, problem: Problem, responses: ResponseCache) -> None:
        self.problem, self.model = problem, problem.model
        self.basis, self.responses = responses.basis, responses
        self.coarse = coarse_copy(problem.model, responses.npix)
        self._starting_opd = problem.starting_opd(self.model.npix)

    def opd(self, unknowns: FrameUnknowns, vector: Tensor) -> Tensor:
        """Return the wavefront, (npix, npix), m; complex if the pupil's amplitude is free."""
        grid = PupilGrid.full(self.model.npix, self.model.diameter)
        opd = self._starting_opd
        coefficients = vector[unknowns.where("modes")]
        if bool((coefficients != 0).any()):
            change = self.basis.opd(coefficients * NANOMETRE, grid)
            opd = opd + change.to(self.model.device)
        amplitude = vector[unknowns.where("amplitude")]
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
        """Render a point.

        Parameters
        ----------
        unknowns : FrameUnknowns
        vector : Tensor
        rendered : Tensor of bool, (companions,), optional
            Which of the companions are part of `total`; default those that the frame shows.
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

        Parameters
        ----------
        point : Point
        offsets : Tensor, (k, 2)
            x, y from the star, arcsec, in the orientation of this frame.
        """
        values = self._towards(point.unknowns.values(point.vector), offsets)
        with torch.no_grad():
            images = self.coarse(self.coarse_opd(point), **values)
        return point.unknowns.level("flux", point.vector) * images

    @staticmethod
    def _towards(values: dict[str, Tensor], offset: Tensor) -> dict[str, Tensor]:
        star = values.get("star_offset", torch.zeros(2, dtype=torch.float64))
        return {**values, "star_offset": star + offset.to(star.device)}

    def jacobian(
        self, point: Point, modes: int, kappa: float = 0.0, reading: Reading | None = None
    ) -> Tensor:
        """Derivative of `total`, (unknowns, ny, nx), float32, on the CPU.

        Up to the first `modes` modes; with 0 only what comes before amplitude and wavefront. The
        light of companions that are faint, or that an error `kappa` of the star model outweighs,
        counts as independent of optics and wavefront. `reading` takes the derivatives of the field.
        """
        reading = self.responses.reading() if reading is None else reading
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
        for light in self._lights(point, bright):
            self._add_slopes(rows, point, *light, modes, reading)
        return rows

    def _lights(
        self, point: Point, companions: Tensor
    ) -> Iterator[tuple[list[Tensor], dict[str, Tensor], Tensor]]:
        """Fields, parameters, and level of the star and of companions (k, 3)."""
        unknowns, vector = point.unknowns, point.vector
        values, flux = unknowns.values(vector), unknowns.level("flux", vector)
        yield point.fields, values, flux * self.problem.gain
        for source in companions:
            towards = self._towards(values, unknowns.turn @ source[1:])
            with torch.no_grad():
                fields = self.model.fields(point.opd, **towards)
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

        Those by companions are of the coarse copy. That by the flux has the light of `companions`,
        (k, 3), besides the star's.
        """
        unknowns, vector = point.unknowns, point.vector
        flux, gain = unknowns.level("flux", vector), self.problem.gain
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
            turned = torch.tensordot(unknowns.turn.T, moved, dims=1)
            rows += list((flux * source[0] * turned).float())
        return torch.stack(rows) if rows else torch.zeros(0, *point.image.shape)

    def slopes(self, point: Point, pixels: Tensor, companions: Tensor) -> dict[str, Tensor]:
        """Derivatives of ``(pixels * image).sum()`` through the model itself.

        They take as long as two or three images, by reverse mode at one wavelength after the other.
        `jacobian` has those of a coarse copy at fewer wavelengths, with an error that exceeds a
        gradient near its zero, and without the light of faint companions. `levels` has the
        derivatives by the other unknowns.

        Parameters
        ----------
        point : Point
        pixels : Tensor, (ny, nx)
        companions : Tensor, (k, 3)
            Those that the image shows besides the star.

        Returns
        -------
        dict of str to Tensor
            float64, on the CPU: by the optical parameters, the modes, and the amplitude if it is
            free.
        """
        unknowns = point.unknowns
        names = unknowns.optical
        lights = self._lights(point, companions)
        totals = [
            torch.stack(parts).sum(dim=0)
            for parts in zip(
                *(self._source_slopes(point, *light, pixels) for light in lights), strict=True
            )
        ]
        by_name = dict(zip(names, totals[1:], strict=True))
        result = {name: slope.double().cpu().flatten() for name, slope in by_name.items()}
        result["modes"] = self._by_modes(totals[0].real)
        if totals[0].is_complex():
            result["amplitude"] = -self._by_modes(totals[0].imag)[: unknowns.amplitude_modes]
        return result

    def _source_slopes(
        self, point: Point, fields: list[Tensor], values: dict[str, Tensor], level: Tensor,
        pixels: Tensor,
    ) -> list[Tensor]:  # fmt: skip
        """Derivatives of ``(pixels * image).sum()`` of one source by OPD and optical parameters."""
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
        """Derivatives by the modes, from those by the OPD."""
        grid = PupilGrid.full(self.model.npix, self.model.diameter)
        modes = torch.zeros(len(self.basis), dtype=torch.float64, requires_grad=True)
        opd = self.basis.opd(modes * NANOMETRE, grid)
        return torch.autograd.grad(opd, modes, by_opd.cpu().to(opd.dtype))[0]

    def _position_slopes(self, opd: Tensor, values: dict[str, Tensor]) -> Tensor:
        """Derivatives with respect to x and y of a source, (2, ny, nx), per arcsec, on the CPU.

        Central differences: four images take a quarter of the time of forward-mode derivatives.
        """
        offset, slopes = values["star_offset"], []
        for step in _DIFFERENCE * torch.eye(2, dtype=offset.dtype, device=offset.device):
            with torch.no_grad():
                ahead = self.coarse(opd, **{**values, "star_offset": offset + step})
                behind = self.coarse(opd, **{**values, "star_offset": offset - step})
            slopes.append((ahead.double() - behind.double()).cpu() / (2 * _DIFFERENCE))
        return torch.stack(slopes)
