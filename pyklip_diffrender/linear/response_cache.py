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

__all__ = ["ResponseCache"]

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


class ResponseCache:
    """Cache of wavefront responses, and of derivatives with respect to other parameters.

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
        derivatives are computed again. With parameter derivatives computed at a distance of 0.2
        (15 mas in the star's position), the stated error of the star's position is half the correct
        one, and the position is off by four times that error.
    keep : int
        Number of responses to store: one for each frame, because star positions differ.
    memory : float
        Number of bytes of responses to store. Those that do not fit are computed again whenever
        they are needed, the oldest first, about the same wavefront.
    progress : bool
        Show progress bars.

    Attributes
    ----------
    farthest : float
        Largest change of the field at which derivatives were used; set it to 0 to begin anew.
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
        self.keep = keep
        self.model, self.basis, self.npix, self.wavelengths = model, basis, npix, wavelengths
        self.relinearise, self.memory, self.progress = relinearise, memory, progress
        self._kept: list[tuple[_About, WavefrontResponse]] = []
        self._slopes: list[tuple[_About, dict[str, list[Tensor]]]] = []
        self._kept_wavelengths, bandpass = model.bandpass.thinned(wavelengths)
        self._coarse = coarse_copy(model, npix).at_wavelengths(bandpass)
        self._last_pupil = LastPupil(self._coarse)
        self.farthest = 0.0

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
        slopes = self._slopes_near(opd, values, names)
        own = [fields[k] for k in self._kept_wavelengths]
        return image_derivatives(self._coarse, own, values, names, slopes)

    def _slopes_near(
        self, opd: Tensor, values: dict[str, Tensor], names: tuple[str, ...]
    ) -> dict[str, list[Tensor]]:
        inside = opd[self.model.entrance.lit]
        near = self._nearest(self._slopes, inside, values, _TILT_OF_SLOPES)
        if near is not None:
            about, slopes = near
            if self._last_pupil.change(about.now, values) > _UNSEEN:
                for fields in slopes.values():
                    self._last_pupil.multiply(fields, about.now, values)
                about.now = dict(values)
            return slopes
        del self._slopes[: max(0, len(self._slopes) + 1 - self.keep)]
        slopes = field_derivatives(self._coarse, downsample(opd, self._coarse.npix), values, names)
        self._slopes.append((_About(inside, dict(values), dict(values)), slopes))
        return slopes

    def near(self, opd: Tensor, values: dict[str, Tensor]) -> WavefrontResponse:
        """Return the stored response for nearly the same field, or compute it.

        It follows changes in the last pupil, so that it is right until the next call.
        """
        inside = opd[self.model.entrance.lit]
        near = self._nearest(self._kept, inside, values, _TILT)
        if near is not None:
            about, response = near
            if self._last_pupil.change(about.now, values) > _UNSEEN:
                response.follow(self._last_pupil, values)
                about.now = dict(values)
            return response
        # Unknowns whose effects nearly cancel need derivatives of the same field.
        self._slopes.clear()
        # Memory is freed first, because the new response is as large as the old one.
        del self._kept[: max(0, len(self._kept) + 1 - self.keep)]
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
        return response

    def _nearest(
        self,
        kept: Sequence[tuple[_About, _Derivatives]],
        opd: Tensor,
        values: dict[str, Tensor],
        tilt: float,
    ) -> tuple[_About, _Derivatives] | None:
        """The derivatives with the smallest error, see `_error`, if it is allowed."""
        errors = [self._error(about, opd, values, tilt) for about, _ in kept]
        if not errors or min(errors) > self.relinearise:
            return None
        self.farthest = max(self.farthest, min(errors))
        return kept[errors.index(min(errors))]

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
