"""How the image answers to small changes: its Jacobian with respect to wavefront and alignment.

For a small OPD change the field is linear, E = E0 + J d, and so the image changes by
2 Re(conj(E0) J) d. The field E0 comes from the model as it is; J, which needs one propagation a
mode, from a coarser copy of the model: an error of a percent in a derivative costs an iteration,
not a bias.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from tqdm import tqdm

from pyklip_diffrender.bases import Basis
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.geometry import PupilGrid
from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.units import ARCSEC

__all__ = [
    "NANOMETRE",
    "Responses",
    "WavefrontResponse",
    "coarse_copy",
    "downsample",
    "parameter_jacobian",
]

_log = logging.getLogger(__name__)

NANOMETRE = 1e-9
"""Wavefront coefficients are in nm inside a fit, so that all its numbers are of order 1."""

_BATCH_BYTES = 2.5e7


def coarse_copy(model: OpticalSystem, npix: int = 128) -> OpticalSystem:
    """A cheaper copy of a model for derivatives: 2 cells per lambda/D, single precision.

    A model without a recipe, or one that is already as coarse, serves itself.
    """
    if not model.recipe or model.npix <= npix or model.npix % npix:
        return model
    return model.with_fidelity(npix=npix, occulter_sampling=2.0, dtype=torch.float32)


def downsample(opd: Tensor, npix: int) -> Tensor:
    """Mean of the OPD over the pixels of a coarser grid, (npix, npix)."""
    if opd.shape[-1] == npix:
        return opd
    if opd.is_complex():
        return torch.complex(downsample(opd.real, npix), downsample(opd.imag, npix))
    return torch.nn.functional.avg_pool2d(opd[None, None], opd.shape[-1] // npix)[0, 0]


class WavefrontResponse:
    """Derivative of the complex field on the detector with respect to wavefront modes.

    The field behind a coronagraph is a small difference of large ones: it changes by much when
    the wavefront changes by little, but its derivative does not. So the derivative of the field
    is kept, and that of the image is made from it for whatever field the star now has.

    Parameters
    ----------
    model : OpticalSystem
    basis : Basis
    opd : Tensor, (n, n)
        About which to linearise, m.
    values : dict of Tensor
        Values of the model's other parameters.
    npix : int
        Pupil samples of the coarse copy that does the propagations.
    memory_limit : float
        Bytes that may be kept.
    progress : bool
        Show a bar.

    Raises
    ------
    IncompatibleSetupError
        If the response would be larger than `memory_limit`.
    """

    def __init__(
        self,
        model: OpticalSystem,
        basis: Basis,
        opd: Tensor,
        values: dict[str, Tensor],
        *,
        npix: int = 128,
        memory_limit: float = 4e9,
        progress: bool = False,
    ) -> None:
        self.model = model
        coarse = coarse_copy(model, npix)
        self.coarse = coarse
        ny, nx = (n * model.detector.oversample for n in model.detector.shape)
        wavelengths = model.bandpass.wavelengths
        size = 8.0 * len(basis) * ny * nx * len(wavelengths)
        if size > memory_limit:
            raise IncompatibleSetupError(
                f"the response of {len(basis)} modes on {ny} x {nx} samples at "
                f"{len(wavelengths)} wavelengths takes {size / 1e9:.1f} GB, more than the limit "
                f"of {memory_limit / 1e9:.1f} GB. Fit a smaller field, fewer wavelengths or "
                "fewer modes, or raise the limit"
            )
        self.fields = [
            torch.empty(len(basis), ny, nx, dtype=torch.complex64, device=model.device)
            for _ in wavelengths
        ]
        full = PupilGrid.full(coarse.npix, coarse.diameter)
        window = coarse.entrance.grid
        complex_bytes = 16 if coarse.dtype == torch.float64 else 8
        batch = max(1, int(_BATCH_BYTES / (complex_bytes * math.prod(window.shape)) / 2))
        with torch.no_grad():
            small = downsample(opd, coarse.npix)
            pupils = [coarse.pupil_field(small, wavelength, values) for wavelength in wavelengths]
            for start in tqdm(
                range(0, len(basis), batch), desc="response", unit="batch", disable=not progress
            ):
                stop = min(start + batch, len(basis))
                sampled = basis.modes(full, start, stop)
                modes = full.crop(sampled, window).to(model.device, coarse.dtype)
                for kept, wavefront in zip(self.fields, pupils, strict=True):
                    # d(exp(i k OPD)) = i k exp(i k OPD) d(OPD), for 1 nm.
                    wavenumber = 2 * math.pi / wavefront.wavelength * NANOMETRE
                    moved = replace(wavefront, field=modes * (1j * wavenumber * wavefront.field))
                    kept[start:stop] = coarse.propagate(moved, values)
        _log.debug("response of %d modes at %d pupil samples", len(basis), coarse.npix)

    def image(
        self, fields: Sequence[Tensor], values: dict[str, Tensor], amplitude_modes: int = 0
    ) -> Tensor:
        """Derivative of the image, for a star with the given fields.

        A mode of the amplitude, an OPD of -1j nm, changes the field by -1j times what the same
        mode of the OPD does, so the same response serves.

        Parameters
        ----------
        fields : sequence of Tensor
            What `OpticalSystem.fields` returns: the star's field at each wavelength.
        values : dict of Tensor
            Values of the model's other parameters (the blur matters here).
        amplitude_modes : int
            How many modes, the first, are amplitude modes as well.

        Returns
        -------
        Tensor, (modes + amplitude_modes, ny, nx), float32
            Light per pixel (fraction of what the pupil collects) per nm.
        """
        modes = len(self.fields[0])
        shape = (modes + amplitude_modes, *self.fields[0].shape[1:])
        total = torch.zeros(shape, device=self.model.device)
        for field, change, weight in zip(
            fields, self.fields, self.model.bandpass.weights, strict=True
        ):
            conjugate = (2 * weight) * field.to(change.dtype).conj()
            product = change * conjugate
            total[:modes] += product.real
            total[modes:] += product[:amplitude_modes].imag
        return self.coarse.detector.image(total, values)


class Responses:
    """The field's responses to a basis that were computed, to be used again nearby.

    Parameters
    ----------
    model : OpticalSystem
    basis : Basis
    relinearise : float
        Change of the pupil's phase (rms, radians) after which the response is computed anew.
    most : int
        How many are kept, the latest.
    """

    def __init__(
        self, model: OpticalSystem, basis: Basis, relinearise: float = 0.3, most: int = 2
    ) -> None:
        self.model, self.basis, self.relinearise, self.most = model, basis, relinearise, most
        self._kept: list[tuple[Tensor, WavefrontResponse]] = []

    def near(
        self, opd: Tensor, values: dict[str, Tensor], npix: int, progress: bool = False
    ) -> WavefrontResponse:
        """The response where the pupil's phase differs little from that of `opd` and `values`."""
        wavenumber = 2 * math.pi / min(self.model.bandpass.wavelengths)
        pupil = self.model.entrance
        x, y = values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu() * ARCSEC
        tilt = y * pupil.full.y[:, None] - x * pupil.full.x[None, :]
        phase = wavenumber * (opd + tilt.to(opd.device))[pupil.lit]
        for kept, response in reversed(self._kept):
            change = (phase - kept).abs()
            if float(torch.sqrt((change**2).mean())) <= self.relinearise:
                return response
        # Room first, for the new one may take as much memory as the old.
        del self._kept[: len(self._kept) + 1 - self.most]
        response = WavefrontResponse(
            self.model, self.basis, opd, values, npix=npix, progress=progress
        )
        self._kept.append((phase, response))
        return response


def parameter_jacobian(
    model: OpticalSystem,
    opd: Tensor,
    values: dict[str, Tensor],
    names: tuple[str, ...],
    fields: Sequence[Tensor] | None = None,
) -> Tensor:
    """Derivative of the image with respect to the components of named parameters.

    Forward-mode derivatives of the model itself.

    Parameters
    ----------
    model : OpticalSystem
        May be a coarse copy.
    opd : Tensor, (npix, npix)
        m.
    values : dict of Tensor
        Where to differentiate; must hold every name.
    names : tuple of str
    fields : sequence of Tensor, optional
        The finer model's fields there, at each wavelength. Then only the fields' derivatives are
        the coarse model's: E = E_fine + (E_coarse - E_coarse at `values`).

    Returns
    -------
    Tensor, (components, ny, nx)
        Light per pixel per unit of the parameter table.
    """
    # Constants are built and kept at the first call; that must not happen inside a transform.
    with torch.no_grad():
        here = model.fields(opd, **values)
    if fields is None:
        missing = [torch.zeros_like(field) for field in here]
    else:
        missing = [
            fine.to(coarse.dtype) - coarse for fine, coarse in zip(fields, here, strict=True)
        ]
    rows = []
    for name in names:

        def image(value: Tensor, name: str = name) -> Tensor:
            there = {**values, name: value}
            moved = model.fields(opd, **there)
            corrected = [field + rest for field, rest in zip(moved, missing, strict=True)]
            return model.image_of(corrected, there)

        rows.append(torch.func.jacfwd(image)(values[name]).movedim(-1, 0))
    return torch.cat(rows)
