"""Derivatives of the image with respect to named parameters, such as a shift of the Lyot stop.

As in `response`, the derivative of the complex field may come from a coarser model than the field.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from pyklip_diffrender.linear.forward_mode import jacfwd
from pyklip_diffrender.optics.system import OpticalSystem

__all__ = ["field_derivatives", "image_derivatives", "parameter_jacobian"]

_IMAGE_PARAMETERS = ("blur",)
"""Parameters that act on the image; all others act on the field."""


def field_derivatives(
    model: OpticalSystem, opd: Tensor, values: dict[str, Tensor], names: tuple[str, ...]
) -> dict[str, list[Tensor]]:
    """Derivatives of the complex field on the detector with respect to named parameters.

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
        Names that act on the image only, such as "blur", are ignored.

    Returns
    -------
    dict of str to list of Tensor
        For every wavelength (components, ny, nx), per unit of the parameter table.
    """
    moved = {name: values[name] for name in names if name not in _IMAGE_PARAMETERS}
    if not moved:
        return {}
    behind = {name: value for name, value in moved.items() if name in model.parameters_behind}
    before = {name: value for name, value in moved.items() if name not in behind}
    wavelengths = model.bandpass.wavelengths
    with torch.no_grad():
        at = model.values(values)
        waves = [model.pupil_field(model.opd(opd), each, at) for each in wavelengths]
        if before:
            # Constants are not kept within a transform, so the model makes them here.
            for wave in waves:
                model.propagate(wave, at)
        if behind:
            waves = [model.behind_occulter(wave, at) for wave in waves]

    def all_the_way(varied: dict[str, Tensor]) -> list[Tensor]:
        return model.fields(opd, **{**values, **varied})

    def last_part(varied: dict[str, Tensor]) -> list[Tensor]:
        moved = model.values({**values, **varied})
        return [model.to_detector(wave, moved) for wave in waves]

    slopes = _slopes(all_the_way, before)
    for name, value in behind.items():
        # One by one, because the costs of a pass grow with the number of components.
        slopes |= _slopes(last_part, {name: value})
    return slopes


def _slopes(
    fields: Callable[[dict[str, Tensor]], list[Tensor]], values: dict[str, Tensor]
) -> dict[str, list[Tensor]]:
    """Derivatives of complex fields, (components, ny, nx) each."""
    if not values:
        return {}

    def parts(varied: dict[str, Tensor]) -> list[Tensor]:
        # Complex outputs of jacfwd would need complex inputs.
        return [torch.view_as_real(field) for field in fields(varied)]

    slopes = jacfwd(parts)(values)
    return {
        name: [torch.view_as_complex(s[name].movedim(-1, 0).contiguous()) for s in slopes]
        for name in values
    }


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
        What `field_derivatives` returned.

    Returns
    -------
    Tensor, (components of all names in order, ny, nx)
        Light per pixel per unit of the parameter table.
    """
    rows = []
    for name in names:
        if name in _IMAGE_PARAMETERS:

            def image(value: Tensor, name: str = name) -> Tensor:
                return model.image_of(fields, {**values, name: value})

            rows.append(jacfwd(image)(values[name]).movedim(-1, 0))
            continue
        total = torch.zeros((), dtype=fields[0].real.dtype, device=model.device)
        for field, slope, weight in zip(fields, slopes[name], model.bandpass.weights, strict=True):
            total = total + 2 * weight * (field.conj() * slope).real
        rows.append(model.detector.image(total, values))
    return torch.cat([row.double() for row in rows])


def parameter_jacobian(
    model: OpticalSystem,
    opd: Tensor,
    values: dict[str, Tensor],
    names: tuple[str, ...],
    fields: Sequence[Tensor] | None = None,
) -> Tensor:
    """Derivative of the image with respect to the components of named parameters.

    Parameters
    ----------
    model, opd, values, names
        See `field_derivatives`.
    fields : sequence of Tensor, optional
        The finer model's field at each wavelength. Only the derivatives of the field are then
        those of `model`.

    Returns
    -------
    Tensor, (components, ny, nx), float64
        Light per pixel per unit of the parameter table.
    """
    slopes = field_derivatives(model, opd, values, names)
    if fields is None:
        with torch.no_grad():
            fields = model.fields(opd, **values)
    return image_derivatives(model, fields, values, names, slopes)
