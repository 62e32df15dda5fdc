"""How the image answers to small changes: its Jacobian with respect to wavefront and alignment.

For a small OPD change the field is linear, E = E0 + J d, and so the image changes by
2 Re(conj(E0) J) d. The field E0 comes from the model as it is; J, which needs one propagation a
mode, from a coarser copy of the model: an error of a percent in a derivative costs an iteration,
not a bias.
"""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor
from tqdm import tqdm

from pyklip_diffrender.bases import Basis
from pyklip_diffrender.geometry import PupilGrid
from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.planes import Wavefront

__all__ = ["NANOMETRE", "coarse_copy", "parameter_jacobian", "wavefront_jacobian"]

_log = logging.getLogger(__name__)

NANOMETRE = 1e-9
"""Wavefront coefficients are in nm inside a fit, so that all its numbers are of order 1."""

_BATCH_BYTES = 2.5e7


def coarse_copy(model: OpticalSystem, npix: int = 256) -> OpticalSystem:
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
    return torch.nn.functional.avg_pool2d(opd[None, None], opd.shape[-1] // npix)[0, 0]


def wavefront_jacobian(
    model: OpticalSystem,
    basis: Basis,
    opd: Tensor,
    values: dict[str, Tensor],
    *,
    npix: int = 256,
    dtype: torch.dtype = torch.float32,
    progress: bool = False,
) -> Tensor:
    """Derivative of the image with respect to the coefficients of a wavefront basis.

    Parameters
    ----------
    model : OpticalSystem
        Gives the field about which to linearise.
    basis : Basis
    opd : Tensor, (npix, npix)
        m.
    values : dict of Tensor
        Values of the model's other parameters.
    npix : int
        Pupil samples of the coarse copy that gives J.
    dtype : torch.dtype
        Real type of the result.
    progress : bool
        Show a bar.

    Returns
    -------
    Tensor, (modes, ny, nx)
        Light per pixel (fraction of what the pupil collects) per nm.
    """
    coarse = coarse_copy(model, npix)
    with torch.no_grad():
        reference = model.fields(opd, **values)
        small = downsample(opd.to(torch.float64), coarse.npix)
        full = PupilGrid.full(coarse.npix, coarse.diameter)
        window = coarse.entrance.grid
        pupils = [
            coarse.pupil_field(small, wavelength, values)
            for wavelength in coarse.bandpass.wavelengths
        ]
        complex_bytes = 16 if coarse.dtype == torch.float64 else 8
        batch = max(1, int(_BATCH_BYTES / (complex_bytes * math.prod(window.shape)) / 2))
        jacobian = torch.empty(len(basis), *model.detector.shape, dtype=dtype, device=model.device)
        for start in tqdm(
            range(0, len(basis), batch), desc="response", unit="batch", disable=not progress
        ):
            stop = min(start + batch, len(basis))
            modes = full.crop(basis.modes(full, start, stop), window).to(model.device, coarse.dtype)
            change = torch.zeros((), dtype=coarse.dtype, device=model.device)
            for field, wavefront, weight in zip(
                reference, pupils, model.bandpass.weights, strict=True
            ):
                # d(exp(i k OPD)) = i k exp(i k OPD) d(OPD), for 1 nm.
                wavenumber = 2 * math.pi / wavefront.wavelength * NANOMETRE
                moved = Wavefront(
                    modes * (1j * wavenumber * wavefront.field), wavefront.wavelength, window
                )
                answer = coarse.propagate(moved, values)
                base = field.to(answer.dtype)
                change = change + (2 * weight) * (base.real * answer.real + base.imag * answer.imag)
            jacobian[start:stop] = coarse.detector.image(change, values).to(dtype)
    _log.debug("response of %d modes at %d pupil samples", len(basis), coarse.npix)
    return jacobian


def parameter_jacobian(
    model: OpticalSystem, opd: Tensor, values: dict[str, Tensor], names: tuple[str, ...]
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

    Returns
    -------
    Tensor, (components, ny, nx)
        Light per pixel per unit of the parameter table.
    """
    # Constants are built and kept at the first call; that must not happen inside a transform.
    with torch.no_grad():
        model(opd, **values)
    rows = []
    for name in names:
        for k in range(len(values[name])):
            direction = torch.zeros_like(values[name])
            direction[k] = 1.0

            def image(value: Tensor, name: str = name) -> Tensor:
                return model(opd, **{**values, name: value})

            rows.append(torch.func.jvp(image, (values[name],), (direction,))[1])
    return torch.stack(rows)
