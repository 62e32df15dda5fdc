"""Derivatives of large outputs with respect to a few inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

__all__ = ["jacobian"]


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
    >>> from pyklip_diffrender.linear.jacobian import jacobian
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
