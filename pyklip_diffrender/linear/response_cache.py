"""Cache of derivatives of the field, which are used again where the field is nearly the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.linear.last_pupil import LastPupil
from pyklip_diffrender.linear.parameter_derivatives import field_derivatives, image_derivatives
from pyklip_diffrender.linear.response import WavefrontResponse, coarse_copy, downsample
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.wavefront.bases import Basis

__all__ = ["Reading", "ResponseCache"]

_Derivatives = TypeVar("_Derivatives")

_OPENINGS = 20.0
"""Relative change of the field for a shift of the Lyot stop by one pupil diameter. The openings of
the stop are about a twentieth of a diameter wide."""

_TILT = 0.35
"""Error of a response that followed a shift of the star, per radian of tilt: 0.17 on average and
0.35 for low modes, whose light falls on the occulter."""

_TILT_OF_SLOPES = 0.5
"""Error of derivatives by other parameters that followed a shift of the star, per radian of tilt.
The position of the star needs accurate ones."""

_FOLLOWED = 0.1
"""Error of derivatives that followed another change in the last pupil, per radian: 0.05 within half
of the field and 0.2 at its edges."""

_UNSEEN = 0.01
"""Change in the last pupil, radians, that is not followed."""


@dataclass
class _About:
    """Where derivatives were computed, and where they have been taken since.

    Attributes
    ----------
    opd : Tensor
        Inside the pupil.
    values, now : dict of Tensor
        Values of the parameters then, and those to which the derivatives followed.
    """

    opd: Tensor
    values: dict[str, Tensor]
    now: dict[str, Tensor]


class Reading:
    """Takes derivatives from a cache, and knows the largest error of those that it has taken.

    Parameters
    ----------
    cache : ResponseCache
    allowed : float
        Relative change of the field above which derivatives are computed again.
    keep : int
        Number of responses that the cache stores.

    Attributes
    ----------
    farthest : float
        Largest change of the field since the derivatives that were taken were computed.
    """

    def __init__(self, cache: ResponseCache, allowed: float, keep: int) -> None:
        self._cache, self._allowed, self._keep = cache, allowed, keep
        self.farthest = 0.0

    def near(self, opd: Tensor, values: dict[str, Tensor]) -> WavefrontResponse:
        """Take the response for nearly the same field, see `ResponseCache.near`."""
        response, error = self._cache.response_within(opd, values, self._allowed, self._keep)
        self.farthest = max(self.farthest, error)
        return response

    def parameters(
        self,
        opd: Tensor,
        values: dict[str, Tensor],
        names: tuple[str, ...],
        fields: Sequence[Tensor],
    ) -> Tensor:
        """Take the derivatives by parameters, (components, ny, nx), see `ResponseCache`."""
        slopes, error = self._cache.slopes_within(opd, values, names, self._allowed, self._keep)
        self.farthest = max(self.farthest, error)
        return self._cache.image_slopes(fields, values, names, slopes)


class ResponseCache:
    """Cache of wavefront responses, and of derivatives with respect to other parameters.

    Whoever needs to know how far its derivatives are from exact ones takes them by a `Reading`.

    Parameters
    ----------
    model : OpticalSystem
    basis : Basis
    npix : int
        Pupil samples of the coarse copy that does the propagations.
    wavelengths : int
        Largest number of wavelengths at which derivatives are computed.
    relinearise : float
        Relative change of the field (radians for a phase), rms over the pupil, above which
        derivatives are computed again, unless a `Reading` allows another one. With parameter
        derivatives computed at a distance of 0.2 (15 mas in the star's position), the stated error
        of the star's position is half the correct one, and the position is off by four times that
        error.
    keep : int
        Number of responses to store: one for each frame, because star positions differ.
    memory : float
        Number of bytes of responses to store. Those that do not fit are computed again whenever
        they are needed, the oldest first, about the same wavefront.
    progress : bool
        Show progress bars.
    """

    def __init__(
        self,
        model: OpticalSystem,
        basis: Basis,
        *,
        npix: int = 128,
        wavelengths: int = 4,
        relinearise: float = 0.05,
        keep: int = 1,
        memory: float = math.inf,
        progress: bool = False,
    ) -> None:
        self.model, self.basis, self.npix, self.wavelengths = model, basis, npix, wavelengths
        self._relinearise, self._keep = relinearise, keep
        self.memory, self.progress = memory, progress
        self._kept: list[tuple[_About, WavefrontResponse]] = []
        self._slopes: list[tuple[_About, dict[str, list[Tensor]]]] = []
        self._kept_wavelengths, bandpass = model.bandpass.thinned(wavelengths)
        self._coarse = coarse_copy(model, npix).at_wavelengths(bandpass)
        self._last_pupil = LastPupil(self._coarse)

    def reading(self, allowed: float | None = None, keep: int | None = None) -> Reading:
        """Begin to take derivatives with another allowed error, or another number of responses."""
        return Reading(
            self,
            self._relinearise if allowed is None else allowed,
            self._keep if keep is None else keep,
        )

    def parameters(
        self,
        opd: Tensor,
        values: dict[str, Tensor],
        names: tuple[str, ...],
        fields: Sequence[Tensor],
    ) -> Tensor:
        """Derivative of the image with respect to named parameters, (components, ny, nx).

        Parameters
        ----------
        opd : Tensor, (npix, npix)
            On the model's grid, m.
        values : dict of Tensor
        names : tuple of str
            Free parameters; they must not change between calls.
        fields : sequence of Tensor
            The star's field at each wavelength.
        """
        return self.reading().parameters(opd, values, names, fields)

    def image_slopes(
        self,
        fields: Sequence[Tensor],
        values: dict[str, Tensor],
        names: tuple[str, ...],
        slopes: dict[str, list[Tensor]],
    ) -> Tensor:
        """Derivatives of the image, (components, ny, nx), from those of the field."""
        own = [fields[k] for k in self._kept_wavelengths]
        return image_derivatives(self._coarse, own, values, names, slopes)

    def slopes_within(
        self,
        opd: Tensor,
        values: dict[str, Tensor],
        names: tuple[str, ...],
        allowed: float,
        keep: int,
    ) -> tuple[dict[str, list[Tensor]], float]:
        """Derivatives of the field by parameters, and their error; see `Reading`."""
        inside = opd[self.model.entrance.lit]
        near = self._nearest(self._slopes, inside, values, _TILT_OF_SLOPES, allowed)
        if near is not None:
            about, slopes, error = near
            if self._last_pupil.change(about.now, values) > _UNSEEN:
                for fields in slopes.values():
                    self._last_pupil.multiply(fields, about.now, values)
                about.now = dict(values)
            return slopes, error
        del self._slopes[: max(0, len(self._slopes) + 1 - keep)]
        slopes = field_derivatives(self._coarse, downsample(opd, self._coarse.npix), values, names)
        self._slopes.append((_About(inside, dict(values), dict(values)), slopes))
        return slopes, 0.0

    def near(self, opd: Tensor, values: dict[str, Tensor]) -> WavefrontResponse:
        """Return the stored response for nearly the same field, or compute it.

        It follows changes in the last pupil, so that it is right until the next call.
        """
        return self.reading().near(opd, values)

    def response_within(
        self, opd: Tensor, values: dict[str, Tensor], allowed: float, keep: int
    ) -> tuple[WavefrontResponse, float]:
        """The response for nearly the same field, and its error; see `Reading`."""
        inside = opd[self.model.entrance.lit]
        near = self._nearest(self._kept, inside, values, _TILT, allowed)
        if near is not None:
            about, response, error = near
            if self._last_pupil.change(about.now, values) > _UNSEEN:
                response.follow(self._last_pupil, values)
                about.now = dict(values)
            return response, error
        # Unknowns whose effects nearly cancel need derivatives of the same field.
        self._slopes.clear()
        # Memory is freed first, because the new response is as large as the old one.
        del self._kept[: max(0, len(self._kept) + 1 - keep)]
        response = WavefrontResponse(
            self.model,
            self.basis,
            opd,
            values,
            npix=self.npix,
            wavelengths=self.wavelengths,
            stored=False,
            progress=self.progress,
        )
        if response.size <= self.memory:
            self._make_room(response.size)
            response.store()
        self._kept.append((_About(inside, dict(values), dict(values)), response))
        return response, 0.0

    def _nearest(
        self,
        kept: Sequence[tuple[_About, _Derivatives]],
        opd: Tensor,
        values: dict[str, Tensor],
        tilt: float,
        allowed: float,
    ) -> tuple[_About, _Derivatives, float] | None:
        """The derivatives with the smallest error, and it, see `_error`, if it is allowed."""
        errors = [self._error(about, opd, values, tilt) for about, _ in kept]
        if not errors or min(errors) > allowed:
            return None
        return *kept[errors.index(min(errors))], min(errors)

    def _make_room(self, size: int) -> None:
        """Free the oldest responses until as many bytes can be stored."""
        stored = [response for _, response in self._kept if response.stored]
        while stored and sum(each.size for each in stored) + size > self.memory:
            stored.pop(0).forget()

    def _error(self, about: _About, opd: Tensor, values: dict[str, Tensor], tilt: float) -> float:
        """Relative error of derivatives that have followed changes in the last pupil.

        Parameters
        ----------
        about : _About
        opd : Tensor
            Inside the pupil, m.
        values : dict of Tensor
        tilt : float
            Error per radian of tilt, rms over the pupil.
        """

        def difference(name: str) -> Tensor:
            zero = torch.zeros((), dtype=torch.float64)
            return values.get(name, zero).cpu() - about.values.get(name, zero).cpu()

        wavenumber = 2 * math.pi / min(self.model.bandpass.wavelengths)
        # The rms of a tilt over a disc is a quarter of its diameter times the angle.
        lever = wavenumber * ARCSEC * self.model.diameter / 4
        parts = [
            float((wavenumber * (opd - about.opd).abs()).square().mean().sqrt()),
            _FOLLOWED * self._last_pupil.change(about.values, values),
        ]
        for name, sensitivity in (
            ("star_offset", tilt * lever),
            ("lyot_shift", _OPENINGS),
            ("lyot_rotation", _OPENINGS * math.radians(1) / 4),
            # Where the aberration is in another pupil, derivatives cannot follow it.
            ("si_zernikes", 0.0 if self._last_pupil.zernikes else wavenumber),
        ):
            parts.append(sensitivity * float(difference(name).norm()))
        return math.hypot(*parts)
