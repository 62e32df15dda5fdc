"""Derivatives by automatic differentiation, and by differences that share no code with it."""

import torch

from pyklip_diffrender.linear.response import field_derivatives, image_derivatives


@torch.no_grad()
def difference(function, at, direction, step):
    """Derivative along a direction by a finite difference of fourth order."""
    f = [function(at + k * step * direction) for k in (-2, -1, 1, 2)]
    return (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * step)


def slopes(function, at, direction, step):
    """Slope of a number along a direction by autograd, and by a difference."""
    variable = at.detach().clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(variable), variable)
    found = float((gradient * direction).sum())
    return found, float(difference(function, at, direction, step))


def parameter_jacobian(model, opd, values, names, fields=None):
    """Derivatives of the image, (components, ny, nx); the fields may be those of a finer model."""
    slopes = field_derivatives(model, opd, values, names)
    fields = model.fields(opd, **values) if fields is None else fields
    return image_derivatives(model, fields, values, names, slopes)
