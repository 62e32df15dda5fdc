"""Forward-mode derivatives."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import torch

__all__ = ["jacfwd"]


@cache
def _load_rules() -> None:
    """Let torch load its forward-mode rules.

    Torch compiles them with its own deprecated `torch.jit.script` on first use and warns about
    that; the user of this package can do nothing about it.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"`torch\.jit\.script` is")
        torch.func.jvp(torch.sin, (torch.zeros(1),), (torch.ones(1),))


def jacfwd(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that computes the Jacobian of `function`, as `torch.func.jacfwd` does.

    Parameters
    ----------
    function : callable
        Maps real tensors (or a tree of them) to real tensors.

    Examples
    --------
    >>> import torch
    >>> from pyklip_diffrender.linear.forward_mode import jacfwd
    >>> jacfwd(lambda x: x**2)(torch.tensor([1.0, 3.0]))
    tensor([[2., 0.],
            [0., 6.]])
    """
    _load_rules()
    derivative: Callable[..., Any] = torch.func.jacfwd(function)
    return derivative
