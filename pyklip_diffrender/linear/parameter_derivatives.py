"""Derivatives of the image with respect to named parameters, such as a shift of the Lyot stop.

As in `response`, the derivative of the complex field may come from a coarser model than the field.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from pyklip_diffrender.optics.system import OpticalSystem

__all__ = ["field_derivatives", "image_derivatives", "jacobian"]

_IMAGE_PARAMETERS = ("blur",)
"""Parameters that act on the image; all others act on the field."""


def field_derivatives(
    model: OpticalSystem, opd: Tensor, values: dict[str, Tensor], names: tuple[str, ...]
) -> dict[str, list[Tensor]]:
    """Derivatives of the complex field on the detector with respect to named parameters.

    They are derivatives of the model itself.

    Parameters
    ----------
    model : OpticalSystem
        May be a coarse copy.
    opd : Tensor, (npix, npix)
        m.
    values : dict of Tensor
        Where to differentiate; must hold every name.
    names : tuple of str
        Names that act on the image only, such as "blur", are ignored.

    Returns
    -------
    dict of str to list of Tensor
        For every wavelength (components, ny, nx), per unit of the parameter table.
    """
    moved = {name: values[name] for name in names if name not in _IMAGE_PARAMETERS}
    if not moved:
        return {}
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
    """Derivatives of the image from those of the field, for a star whose fields are known.

    Parameters
    ----------
    model : OpticalSystem
    fields : sequence of Tensor
        The star's field at each wavelength; of a finer model, if there is one.
    values : dict of Tensor
    names : tuple of str
    slopes : dict of str to list of Tensor
        Derivatives from `field_derivatives`.

    Returns
    -------
    Tensor, (components of all names in order, ny, nx)
        Light per pixel per unit of the parameter table.
    """
    rows = []
    for name in names:
        if name in _IMAGE_PARAMETERS:

            def image(varied: Tensor, name: str = name) -> list[Tensor]:
                return [model.image_of(fields, {**values, name: varied})]

            rows += jacobian(image, values[name])
            continue
        total = torch.zeros((), dtype=fields[0].real.dtype, device=model.device)
        for field, slope, weight in zip(fields, slopes[name], model.bandpass.weights, strict=True):
            total = total + 2 * weight * (field.conj() * slope).real
        rows.append(model.detector.image(total, values))
    return torch.cat([row.double() for row in rows])


def jacobian(function: Callable[[Tensor], Sequence[Tensor]], value: Tensor) -> list[Tensor]:
    """Differentiate tensors with respect to a few numbers, by two passes in reverse mode.

    With weights v, the gradient of the outputs is J^T v. It is linear in v, and its derivative by v
    is J (J. Townsend, "A new trick for calculating Jacobian vector products", 2017). As in forward
    mode, the cost grows with the number of inputs. Forward mode takes twice as long, because torch
    differentiates products with constants in Python.

    Parameters
    ----------
    function : callable
        Maps a tensor to tensors, real or complex.
    value : Tensor, (components,)
        Where to differentiate; real.

    Returns
    -------
    list of Tensor
        For every output its derivatives, (components, *shape of the output).

    Examples
    --------
    >>> import torch
    >>> from pyklip_diffrender.linear import jacobian
    >>> (slopes,) = jacobian(lambda x: [x**2], torch.tensor([1.0, 3.0]))
    >>> slopes
    tensor([[2., 0.],
            [0., 6.]])
    """
    with torch.enable_grad():
        varied = value.detach().requires_grad_()
        outputs = function(varied)
        real = [torch.view_as_real(each) if each.is_complex() else each for each in outputs]
        weights = [torch.zeros_like(each, requires_grad=True) for each in real]
        (gradient,) = torch.autograd.grad(real, varied, weights, create_graph=True)
    directions = torch.eye(len(gradient), dtype=gradient.dtype, device=gradient.device)
    rows = torch.autograd.grad(gradient, weights, directions, is_grads_batched=True)
    return [
        torch.view_as_complex(each.contiguous()) if output.is_complex() else each
        for output, each in zip(outputs, rows, strict=True)
    ]
