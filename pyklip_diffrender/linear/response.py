"""Derivatives of the image with respect to wavefront modes and optical parameters."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.fast_path import PlaneWaves
from pyklip_diffrender.optics.grid import STAR_RADIUS, PupilGrid, doubled_samples, zernike_basis
from pyklip_diffrender.optics.planes import CompactOcculter, Wavefront
from pyklip_diffrender.optics.propagation import Propagation, batch_of
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.wavefront.bases import Basis, FourierModes, fourier_part

NANOMETRE = 1e-9
"""Unit of wavefront coefficients inside a fit, m, in which the coefficients are of order 1."""


class ModeFields:
    """Derivatives of the complex field on the detector with respect to modes.

    `opd`, (npix, npix) in m, is the wavefront about which the field is differentiated.
    """

    def __init__(
        self, model: OpticalSystem, basis: Basis, opd: Tensor, values: dict[str, Tensor]
    ) -> None:
        self._model, self._basis, self._values = model, basis, model.values(values)
        wavelengths = model.bandpass.wavelengths
        with torch.no_grad():
            # d(exp(i k OPD)) = i k exp(i k OPD) d(OPD): the field in the pupil times the mode is
            # propagated. Cosines and sines are pairs of plane waves, which propagate faster, see
            # `PlaneWaves`.
            self._pupils = [model.pupil_field(opd, each, self._values) for each in wavelengths]

    @torch.no_grad()
    def batches(self, size: int) -> Iterator[tuple[Tensor, list[Tensor]]]:
        """Derivatives with respect to all modes, for `size` (at least 4) modes at a time.

        Yields the places of the modes in the basis, (modes,), int64, and the derivatives at each
        wavelength, (modes, ny, nx), complex64, per nm.
        """
        first, fourier = fourier_part(self._basis) or (len(self._basis), None)
        waves = [] if fourier is None else self._plane_waves(fourier.reach)
        if not waves:
            first = len(self._basis)
        for modes in torch.arange(first).split(size) if first else ():
            yield modes, [each.to(torch.complex64) for each in self._propagated(modes)]
        if waves:
            assert fourier is not None
            for modes, changes in self._from_waves(waves, fourier, size):
                yield first + modes, [each.to(torch.complex64) for each in changes]

    def _plane_waves(self, reach: int) -> list[PlaneWaves]:
        """Plane waves at each wavelength; an empty list if the model has none."""
        waves = [self._model.plane_waves(each, self._values, reach) for each in self._pupils]
        return [each for each in waves if each is not None]

    def _propagated(self, modes: Tensor) -> list[Tensor]:
        model = self._model
        full = PupilGrid.full(model.npix, model.diameter)
        sampled = self._basis.modes(full, int(modes[0]), int(modes[-1]) + 1)
        shapes = model.entrance.on_window(sampled).to(model.device, model.dtype)
        changes = []
        for wavefront in self._pupils:
            moved = replace(wavefront, field=shapes * (_factor(wavefront) * wavefront.field))
            changes.append(model.propagate(moved, self._values))
        return changes

    def _from_waves(
        self, waves: list[PlaneWaves], fourier: FourierModes, size: int
    ) -> Iterator[tuple[Tensor, list[Tensor]]]:
        """Derivatives with respect to Fourier modes, with places counted from the first of them."""
        places = {(fx, fy): 2 * k for k, (fx, fy) in enumerate(fourier.cycles.tolist())}
        scales = [fourier.amplitude / 2 * _factor(each) for each in self._pupils]
        for fx in range(fourier.reach + 1):
            every = [fy for fy in range(fourier.reach + 1) if (fx, fy) in places]
            for start in range(0, len(every), max(1, size // 4)):
                fy = every[start : start + max(1, size // 4)]
                pairs = [(fx, each) for each in fy] + [(-fx, each) for each in fy]
                # The wave opposite to (fx, 0) is (-fx, 0), so that the two are one pair.
                known = [k for k, pair in enumerate(pairs) if pair in places]
                cosines = torch.tensor([places[pairs[k]] for k in known])
                changes = []
                # With opposite waves e and e*, cos = (e + e*) / 2 and sin = i (e* - e) / 2. `plus`
                # has +-fx with +fy, and `minus` the opposite waves, -+fx with -fy.
                for each, scale in zip(waves, scales, strict=True):
                    fields = each.fields(fx, slice(fy[0], fy[-1] + 1))
                    plus = fields[:, 0].flatten(0, 1)[known]
                    minus = fields[[1, 0], 1].flatten(0, 1)[known]
                    pair = [scale * (plus + minus), 1j * scale * (minus - plus)]
                    changes.append(torch.stack(pair, dim=1).flatten(0, 1))
                yield torch.stack([cosines, cosines + 1], dim=1).flatten(), changes


def _factor(wavefront: Wavefront) -> complex:
    """Factor i k of the derivative by an OPD in nm."""
    return 2j * math.pi / wavefront.wavelength * NANOMETRE


# The instrument's internal aberration, and the phase ramp that shifts the image, multiply the field
# in the last pupil, between the last focal plane and the detector. A change of this factor
# convolves all fields on the detector, and their derivatives, with one small kernel, in a tenth of
# the time of new derivatives. A star that moves relative to the occulter moves the image as well;
# the change of the light that the occulter blocks is neglected.

_FIELDS_AT_A_TIME = 16
"""Number of fields that are transformed at a time, which fit in the processor's cache."""


class LastPupil:
    """The pupil behind all occulters of a model, seen from the detector's samples."""

    def __init__(self, model: Propagation) -> None:
        self._model = model
        behind = model.parameters_behind
        self.shifts = tuple(n for n in ("star_offset", "detector_shift") if n in model.parameters)
        """Parameters that shift the image, arcsec."""
        self.zernikes = tuple(n for n in ("si_zernikes",) if n in behind)
        """Parameters that are Zernike coefficients of an OPD in this pupil, m."""

    def change(self, before: dict[str, Tensor], after: dict[str, Tensor]) -> float:
        """Rms phase over the pupil, radians, of a change of parameters."""
        wavenumber = 2 * math.pi / min(self._model.bandpass.wavelengths)
        # The rms of a tilt over a disc is a quarter of its diameter times the angle.
        tilt = self._shift(before, after).norm() * self._model.diameter / 4
        waves = self._difference(self.zernikes, before, after).norm()
        return wavenumber * math.hypot(float(tilt), float(waves))

    def multiply(
        self, fields: Sequence[Tensor], before: dict[str, Tensor], after: dict[str, Tensor]
    ) -> None:
        """Convolve fields on the detector, in place, as a change of parameters does.

        There are fields for every wavelength, (count, oversample ny, oversample nx), complex64. The
        field outside the detector is taken to be the field at the opposite edge.
        """
        for wavelength, field in zip(self._model.bandpass.wavelengths, fields, strict=True):
            factor = self._factor(wavelength, field, before, after)
            for piece in field.split(_FIELDS_AT_A_TIME):
                piece.copy_(torch.fft.ifft2(torch.fft.fft2(piece).mul_(factor)))

    def _factor(
        self,
        wavelength: float,
        field: Tensor,
        before: dict[str, Tensor],
        after: dict[str, Tensor],
    ) -> Tensor:
        """Factor of the spectrum of the samples, (ny, nx)."""
        detector = self._model.detector
        # The frequency f of samples that are t apart on the sky stands for the place lambda f / t
        # in the pupil, where a shift of the image is a tilt of the OPD. The sign of y is as in
        # `optics.planes`. The shear of the axes is negligible.
        x, y = (
            torch.fft.fftfreq(count, dtype=torch.float64, device=field.device)
            * (sign * wavelength * detector.oversample / (scale * ARCSEC))
            for count, scale, sign in zip(
                field.shape[:-3:-1], detector.pixelscale, (1, -1), strict=True
            )
        )
        shift = self._shift(before, after).to(field.device)
        opd = shift[1] * y[:, None] - shift[0] * x[None, :]
        coefficients = self._difference(self.zernikes, before, after).to(field.device)
        if len(coefficients):
            basis = zernike_basis(len(coefficients), x, y, self._model.diameter / 2)
            opd = opd + torch.tensordot(coefficients, basis, dims=1)
        phase = (2 * math.pi / wavelength) * opd
        return torch.polar(torch.ones_like(phase), phase).to(field.dtype)

    def _shift(self, before: dict[str, Tensor], after: dict[str, Tensor]) -> Tensor:
        """Shift of the image, (2,), radians."""
        moved = self._difference(self.shifts, before, after).reshape(-1, 2)
        return moved.sum(dim=0) * ARCSEC

    def _difference(
        self, names: Sequence[str], before: dict[str, Tensor], after: dict[str, Tensor]
    ) -> Tensor:
        """Change of named parameters, concatenated, float64 on the CPU."""
        changes = []
        for name in names:
            zero = torch.zeros(parameter(name).size, dtype=torch.float64)
            changes.append(after.get(name, zero).cpu() - before.get(name, zero).cpu())
        return torch.cat([torch.zeros(0, dtype=torch.float64), *changes])


# Derivatives with respect to named parameters, such as a shift of the Lyot stop, may come from a
# coarser model than the field, as derivatives with respect to the wavefront do.

_IMAGE_PARAMETERS = ("blur",)
"""Parameters that act on the image; all others act on the field."""


def field_derivatives(
    model: OpticalSystem, opd: Tensor, values: dict[str, Tensor], names: tuple[str, ...]
) -> dict[str, list[Tensor]]:
    """Derivatives of the complex field on the detector with respect to named parameters.

    `opd` is (npix, npix), m, and `values` must have every name. There are derivatives by name and
    wavelength, (components, ny, nx), per unit of the parameter table, but none for parameters that
    act on the image only, such as "blur".
    """
    moved = {name: values[name] for name in names if name not in _IMAGE_PARAMETERS}
    if not moved:
        return {}
    # Parameters behind the occulter need no new propagation to the occulter.
    behind = model.parameters_behind.intersection(moved)
    wavelengths = model.bandpass.wavelengths
    with torch.no_grad():
        at = model.values(values)
        waves = [model.pupil_field(model.opd(opd), each, at) for each in wavelengths]
        waves = [model.behind_occulter(wave, at) for wave in waves] if behind else []
    slopes = {}
    for name, value in moved.items():

        def fields(varied: Tensor, name: str = name) -> list[Tensor]:
            changed = {**values, name: varied}
            if name not in behind:
                return model.fields(opd, **changed)
            checked = model.values(changed)
            return [model.to_detector(wave, checked) for wave in waves]

        slopes[name] = jacobian(fields, value)
    return slopes


def image_derivatives(
    model: OpticalSystem,
    fields: Sequence[Tensor],
    values: dict[str, Tensor],
    names: tuple[str, ...],
    slopes: dict[str, list[Tensor]],
) -> Tensor:
    """Derivatives of the image from the derivatives of the field, `slopes`.

    `slopes` come from `field_derivatives`, and `fields` are the fields of the star at each
    wavelength, by a finer model if there is one. The result is (components of all names in order,
    ny, nx), light per pixel per unit of the parameter table.
    """
    rows = []
    for name in names:
        if name in _IMAGE_PARAMETERS:

            def image(varied: Tensor, name: str = name) -> list[Tensor]:
                return [model.image_of(fields, {**values, name: varied})]

            rows += jacobian(image, values[name])
            continue
        # d|E|^2 = 2 Re(conj(E) dE), and the detector's part is linear in the light.
        total = torch.zeros((), dtype=fields[0].real.dtype, device=model.device)
        for field, slope, weight in zip(fields, slopes[name], model.bandpass.weights, strict=True):
            total = total + 2 * weight * (field.conj() * slope).real
        rows.append(model.detector.image(total, values))
    return torch.cat([row.double() for row in rows])


def jacobian(function: Callable[[Tensor], Sequence[Tensor]], value: Tensor) -> list[Tensor]:
    """Derivatives of tensors with respect to a few real numbers, (components,), in reverse mode.

    For every output of the function, real or complex, there are derivatives (components, *shape of
    the output).
    """
    with torch.enable_grad():
        # With weights v, the gradient of the outputs is J^T v, which is linear in v and has the
        # derivative J (J. Townsend, "A new trick for calculating Jacobian vector products",
        # 2017). As in forward mode, the cost grows with the number of inputs. Forward mode takes
        # twice as long, because torch differentiates products with constants in Python.
        varied = value.detach().requires_grad_()
        outputs = function(varied)
        real = [torch.view_as_real(each) if each.is_complex() else each for each in outputs]
        weights = [torch.zeros_like(each, requires_grad=True) for each in real]
        (gradient,) = torch.autograd.grad(real, varied, weights, create_graph=True)
    directions = torch.eye(len(gradient), dtype=gradient.dtype, device=gradient.device)
    # One by one: torch.vmap, which would do them together, takes longer to import.
    slopes = [
        torch.autograd.grad(gradient, weights, each, retain_graph=True) for each in directions
    ]
    rows = [torch.stack(each) for each in zip(*slopes, strict=True)]
    return [
        torch.view_as_complex(each.contiguous()) if output.is_complex() else each
        for output, each in zip(outputs, rows, strict=True)
    ]


# For a small change d of the OPD the field is linear, E = E0 + J d, and the image changes by 2
# Re(conj(E0) J) d. The field E0 comes from the model itself. J needs one propagation per mode and
# comes from a coarser copy of the model: an error of a percent in a derivative costs an iteration,
# but causes no bias.

_log = logging.getLogger(__name__)

_CELLS_PER_LAMBDA_D = 1.9
"""Largest number of cells of the occulter per lambda/D in a coarse copy. One cell per pixel is then
enough at all wavelengths of F444W, down to 3.9 um; two cells per pixel take four times as long."""

_MODES_AT_A_TIME = 128
"""Number of modes whose images are computed at a time."""


def coarse_copy(model: OpticalSystem, npix: int = 128) -> OpticalSystem:
    """Return a cheaper copy of a model for derivatives, or the model if its pupil is as coarse.

    The copy has fewer pupil samples, coarse cells, single precision, and only the part of a bar
    within `STAR_RADIUS` of the field. For a wide field or mask, the number of samples is doubled
    until the image does not repeat inside the field or mask.
    """
    if "npix" not in model.adjustable or model.npix <= npix:
        return model
    bar_reach = _bar_reach(model)
    masks = [plane.radius for plane in model.between if isinstance(plane, CompactOcculter)]
    period = max(_field(model), (bar_reach or max(masks, default=0.0)) + STAR_RADIUS)
    npix = doubled_samples(npix, period, min(model.bandpass.wavelengths), model.diameter)
    sampling = model.recipe.get("occulter_sampling") or math.inf
    coarser = {
        "npix": npix if model.npix % npix == 0 else model.npix,
        "occulter_sampling": min(_CELLS_PER_LAMBDA_D, sampling),
        "bar_reach": bar_reach,
        "dtype": torch.float32,
    }
    return model.with_fidelity(**{k: v for k, v in coarser.items() if k in model.adjustable})


def at_few_wavelengths(model: OpticalSystem, count: int) -> OpticalSystem:
    """Return a copy of a model for derivatives, with at most `count` wavelengths.

    Where planes are known at the model's wavelengths only, these are the model's own.
    """
    bandpass = model.bandpass
    is_free = "bandpass" in model.adjustable
    return model.at_wavelengths(bandpass.condensed(count) if is_free else bandpass.thinned(count))


def at_half_the_wavelengths(model: OpticalSystem) -> OpticalSystem:
    """Return a copy of a model for derivatives, with half as many wavelengths."""
    return at_few_wavelengths(model, math.ceil(len(model.bandpass.wavelengths) / 2))


def _field(model: OpticalSystem) -> float:
    """Side of the detector, arcsec."""
    detector = model.detector
    return max(n * s for n, s in zip(detector.shape[::-1], detector.pixelscale, strict=True))


def _bar_reach(model: OpticalSystem) -> float | None:
    """Distance from the star up to which a bar matters for derivatives, arcsec; None without."""
    bars = [p for p in model.between if isinstance(p, CompactOcculter) and p.reach[0] > p.reach[1]]
    if not bars or "bar_reach" not in model.adjustable:
        return None
    return min(bars[0].reach[0], _field(model) / 2 + STAR_RADIUS)


def downsample(opd: Tensor, npix: int) -> Tensor:
    """Mean of the OPD over the pixels of a coarser grid, (..., npix, npix) with npix a divisor."""
    factor = opd.shape[-1] // npix
    if factor == 1:
        return opd
    # Summing rows and then multiplying for the columns takes a third of the time of average
    # pooling.
    rows = opd.unflatten(-2, (npix, factor)).sum(dim=-2)
    mean = torch.full((factor, 1), 1 / factor**2, dtype=opd.dtype, device=opd.device)
    return (rows.unflatten(-1, (npix, factor)) @ mean).squeeze(-1)


class WavefrontResponse:
    """Derivative of the complex field on the detector with respect to wavefront modes.

    A coarse copy of the model with `npix` pupil samples and at most so many `wavelengths` is
    differentiated about `opd` (n, n), m, in every call of `image` until `store` is called.
    """

    def __init__(
        self,
        model: OpticalSystem,
        basis: Basis,
        opd: Tensor,
        values: dict[str, Tensor],
        *,
        npix: int = 128,
        wavelengths: int = 4,
        progress: bool = False,
    ) -> None:
        self.model, self.basis = model, basis
        # The field behind a coronagraph is a small difference of large fields. A small change of
        # the wavefront changes the field by a large factor, but hardly changes the derivative of
        # the field. This derivative is therefore stored, and the derivative of the image is
        # computed from it and from the current field of the star.
        self.coarse = coarse = coarse_copy(at_few_wavelengths(model, wavelengths), npix)
        self._progress = progress
        self._fields: list[Tensor] | None = None
        pixels = math.prod(model.detector.shape) * model.detector.oversample**2
        self.size = 8 * len(basis) * pixels * len(coarse.bandpass.wavelengths)
        """Size of the stored derivatives, bytes."""
        # Behind the occulter, arrays are padded to twice the size of the image.
        samples = max(math.prod(coarse.entrance.grid.shape), 4 * pixels)
        self._batch = batch_of(samples, coarse.dtype.to_complex(), coarse.device)
        self._opd, self._values = downsample(opd, coarse.npix), values
        self._mode_fields: ModeFields | None = None

    @property
    def stored(self) -> bool:
        """Whether the derivatives are stored."""
        return self._fields is not None

    def store(self) -> None:
        """Compute the derivatives and store them."""
        ny, nx = (n * self.model.detector.oversample for n in self.model.detector.shape)
        count = len(self.basis)
        fields = [
            torch.empty(count, ny, nx, dtype=torch.complex64, device=self.model.device)
            for _ in self.coarse.bandpass.wavelengths
        ]
        with ProgressBar("response", count, shown=self._progress) as bar:
            for modes, changes in self._batches():
                for kept, change in zip(fields, changes, strict=True):
                    kept.index_copy_(0, modes.to(kept.device), change)
                bar.update(len(modes))
        self._fields, self._mode_fields = fields, None
        _log.debug("response of %d modes at %d pupil samples", count, self.coarse.npix)

    def follow(self, last_pupil: LastPupil, values: dict[str, Tensor]) -> None:
        """Follow a change of parameters that `LastPupil.multiply` can follow."""
        if self._fields is not None:
            last_pupil.multiply(self._fields, self._values, values)
        self._values, self._mode_fields = values, None

    def forget(self) -> None:
        """Free the memory of the derivatives."""
        self._fields = None

    def _batches(self, count: int | None = None) -> Iterator[tuple[Tensor, list[Tensor]]]:
        """Places of modes, and the derivatives of the field by these modes at each wavelength.

        With `count`, at least the leading `count` modes.
        """
        if self._fields is None:
            if self._mode_fields is None:
                self._mode_fields = ModeFields(self.coarse, self.basis, self._opd, self._values)
            yield from self._mode_fields.batches(self._batch)
            return
        every = torch.arange(len(self.basis) if count is None else count)
        for modes in every.split(_MODES_AT_A_TIME):
            part = slice(int(modes[0]), int(modes[-1]) + 1)
            yield modes, [kept[part] for kept in self._fields]

    def image(
        self,
        fields: Sequence[Tensor],
        values: dict[str, Tensor],
        amplitude_modes: int = 0,
        modes: int | None = None,
    ) -> Tensor:
        """Derivatives of the image by modes, for fields of the star at few wavelengths.

        The result is (modes + amplitude_modes, ny, nx), float32, light per pixel (fraction of the
        light that the pupil collects) per nm. The first `modes` rows are for the leading wavefront
        modes (default all), the others for the leading amplitude modes.
        """
        # dI = sum_l 2 w_l Re(conj(E_l) J_l dx). An amplitude mode is an OPD of -i nm, and changes
        # the field by -i times the change by the OPD mode. The derivative by an amplitude mode
        # therefore has the imaginary part in place of the real part.
        modes = len(self.basis) if modes is None else modes
        detector, count = self.coarse.detector, max(modes, amplitude_modes)
        images = torch.empty(modes + amplitude_modes, *detector.shape, device=self.model.device)
        conjugates = [
            (2 * weight) * field.to(torch.complex64).conj()
            for field, weight in zip(fields, self.coarse.bandpass.weights, strict=True)
        ]
        for places, changes in self._batches(count):
            total = _weighted_sum(changes, conjugates)
            for rows, parts in ((images[:modes], total.real), (images[modes:], total.imag)):
                wanted = places < len(rows)
                if wanted.all():
                    rows[places] = detector.image(parts.contiguous(), values)
                elif wanted.any():
                    rows[places[wanted]] = detector.image(parts[wanted], values)
        return images


def _weighted_sum(changes: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    """Sum over wavelengths of changes (modes, ny, nx) times weights (ny, nx)."""
    total = torch.zeros_like(changes[0])
    # Pieces that fit in the processor's cache are faster than the whole product.
    for start in range(0, len(total), _FIELDS_AT_A_TIME):
        piece = slice(start, start + _FIELDS_AT_A_TIME)
        for change, weight in zip(changes, weights, strict=True):
            total[piece] += change[piece] * weight
    return total


_FIELD_CHANGE_PER_STOP_DIAMETER = 20.0
"""Relative change of the field for a shift of the Lyot stop by one pupil diameter. The openings of
the stop are about a twentieth of a diameter wide."""

_RESPONSE_ERROR_PER_RADIAN = 0.35
"""Error of a response that followed a shift of the star, per radian of tilt: 0.17 on average and
0.35 for low modes, which put light on the occulter."""

_SLOPE_ERROR_PER_RADIAN = 0.5
"""Error of derivatives by other parameters that followed a shift of the star, per radian of tilt.
The position of the star needs accurate derivatives."""

_FOLLOWED_ERROR_PER_RADIAN = 0.1
"""Error of derivatives that followed another change in the last pupil, per radian: 0.05 within half
of the field and 0.2 at its edges."""

_UNFOLLOWED_RADIANS = 0.01
"""Change in the last pupil, radians, that is not followed."""


@dataclass
class _About:
    """Wavefront and parameters for which derivatives were computed, and taken since."""

    opd: Tensor  # OPD inside the pupil, m.
    values: dict[str, Tensor]  # Parameters for which the derivatives were computed.
    now: dict[str, Tensor]  # Parameters to which the derivatives have followed.


_Kept = TypeVar("_Kept", bound=tuple[_About, object])


class Reading:
    """Access to the derivatives of a cache that records the largest error of what was taken.

    The cache computes derivatives again where the field has changed by more than `allowed`
    (relative, radians for a phase, rms over the pupil), and stores `keep` responses, but no new
    response if this is the last reading (`is_last`). `farthest` is the largest change of the field
    since the derivatives were computed. With derivatives that were computed at a distance of 0.2
    (15 mas in the star's position), the stated error of the star's position is half the true error,
    and the position is off by four times as much.
    """

    def __init__(self, cache: ResponseCache, allowed: float, keep: int, is_last: bool) -> None:
        self._cache, self._allowed, self._keep, self._is_last = cache, allowed, keep, is_last
        self.farthest = 0.0

    def _nearest(
        self, kept: Sequence[_Kept], opd: Tensor, values: dict[str, Tensor], tilt: float
    ) -> _Kept | None:
        """The derivatives with the smallest error, if allowed; see `ResponseCache.error`."""
        errors = [self._cache.error(about, opd, values, tilt) for about, _ in kept]
        if not errors or min(errors) > self._allowed:
            return None
        self.farthest = max(self.farthest, min(errors))
        return kept[errors.index(min(errors))]

    def near(self, opd: Tensor, values: dict[str, Tensor]) -> WavefrontResponse:
        """Take the response for nearly the same field, see `ResponseCache`.

        The response follows changes in the last pupil, and is right until the next call.
        """
        cache = self._cache
        inside = opd[cache.model.entrance.lit]
        near = self._nearest(cache.responses, inside, values, _RESPONSE_ERROR_PER_RADIAN)
        if near is not None:
            about, response = near
            if cache.last_pupil.change(about.now, values) > _UNFOLLOWED_RADIANS:
                response.follow(cache.last_pupil, values)
                about.now = dict(values)
            return response
        # Unknowns whose effects nearly cancel need derivatives of the same field.
        cache.slopes.clear()
        # Memory is freed first, because the new response is as large as the old one.
        del cache.responses[: max(0, len(cache.responses) + 1 - self._keep)]
        response = WavefrontResponse(
            cache.model,
            cache.basis,
            opd,
            values,
            npix=cache.npix,
            wavelengths=cache.wavelengths,
            progress=cache.progress,
        )
        if not self._is_last and response.size <= cache.memory:
            cache.make_room(response.size)
            response.store()
        cache.responses.append((_About(inside, dict(values), dict(values)), response))
        return response

    def parameters(
        self,
        opd: Tensor,
        values: dict[str, Tensor],
        names: tuple[str, ...],
        fields: Sequence[Tensor],
    ) -> Tensor:
        """Take the derivatives by named parameters, (components, ny, nx).

        `opd` is (npix, npix) on the model's grid, m, and `fields` are the fields of the star by the
        cache's model `few`. The names must not change between calls.
        """
        cache = self._cache
        inside = opd[cache.model.entrance.lit]
        near = self._nearest(cache.slopes, inside, values, _SLOPE_ERROR_PER_RADIAN)
        if near is not None:
            about, slopes = near
            if cache.last_pupil.change(about.now, values) > _UNFOLLOWED_RADIANS:
                for slope in slopes.values():
                    cache.last_pupil.multiply(slope, about.now, values)
                about.now = dict(values)
        else:
            del cache.slopes[: max(0, len(cache.slopes) + 1 - self._keep)]
            coarse = downsample(opd, cache.coarse.npix)
            slopes = field_derivatives(cache.coarse, coarse, values, names)
            cache.slopes.append((_About(inside, dict(values), dict(values)), slopes))
        return image_derivatives(cache.coarse, fields, values, names, slopes)


class ResponseCache:
    """Cache of wavefront responses, and of derivatives with respect to other parameters.

    A `Reading` takes derivatives and says how far they are from exact derivatives. Stored responses
    take at most `memory` bytes. Responses that do not fit are computed again whenever they are
    needed, about the same wavefront.
    """

    def __init__(
        self,
        model: OpticalSystem,
        basis: Basis,
        *,
        npix: int = 128,
        wavelengths: int = 4,
        memory: float = math.inf,
        progress: bool = False,
    ) -> None:
        self.model, self.basis, self.npix, self.wavelengths = model, basis, npix, wavelengths
        self.memory, self.progress = memory, progress
        self.responses: list[tuple[_About, WavefrontResponse]] = []
        self.slopes: list[tuple[_About, dict[str, list[Tensor]]]] = []
        """Derivatives of the field by parameters, see `field_derivatives`."""
        self.few = at_few_wavelengths(model, wavelengths)
        """The model at the wavelengths of the derivatives, which gives the field of the star."""
        self.coarse = coarse_copy(self.few, npix)
        """The coarse model that is differentiated by parameters."""
        self.last_pupil = LastPupil(self.coarse)

    def make_room(self, size: int) -> None:
        """Free the oldest responses until `size` bytes can be stored."""
        stored = [response for _, response in self.responses if response.stored]
        while stored and sum(each.size for each in stored) + size > self.memory:
            stored.pop(0).forget()

    def error(self, about: _About, opd: Tensor, values: dict[str, Tensor], tilt: float) -> float:
        """Relative error of derivatives that have followed changes in the last pupil.

        `opd` is the OPD inside the pupil, m, and `tilt` the error per radian of tilt, rms over the
        pupil.
        """

        def difference(name: str) -> Tensor:
            zero = torch.zeros((), dtype=torch.float64)
            return values.get(name, zero).cpu() - about.values.get(name, zero).cpu()

        wavenumber = 2 * math.pi / min(self.model.bandpass.wavelengths)
        # The rms of a tilt over a disc is a quarter of its diameter times the angle.
        lever = wavenumber * ARCSEC * self.model.diameter / 4
        parts = [
            float((wavenumber * (opd - about.opd).abs()).square().mean().sqrt()),
            _FOLLOWED_ERROR_PER_RADIAN * self.last_pupil.change(about.values, values),
        ]
        for name, sensitivity in (
            ("star_offset", tilt * lever),
            ("lyot_shift", _FIELD_CHANGE_PER_STOP_DIAMETER),
            ("lyot_rotation", _FIELD_CHANGE_PER_STOP_DIAMETER * math.radians(1) / 4),
            # Derivatives cannot follow an aberration in another pupil.
            ("si_zernikes", 0.0 if self.last_pupil.zernikes else wavenumber),
        ):
            parts.append(sensitivity * float(difference(name).norm()))
        return math.hypot(*parts)
