"""Derivatives of the image with respect to named parameters, such as a shift of the Lyot stop.

As in `response`, the derivative of the complex field may come from a coarser model than the field.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pyklip_diffrender.linear.jacobian import jacobian
from pyklip_diffrender.optics.system import OpticalSystem

__all__ = ["field_derivatives", "image_derivatives"]

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
