"""What takes part in differentiation, and what merely stands where it is and may be kept."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import TypeVar

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

__all__ = ["Position", "has_memory", "is_plain", "kept", "position_of"]

Key = TypeVar("Key", bound=Hashable)
Made = TypeVar("Made")

Position = tuple[tuple[str, float], ...]
"""Named values as plain numbers, for the key of what is computed from them."""


def has_memory(tensor: Tensor) -> bool:
    """Whether a tensor is itself, and takes part in no transform of `torch.func`.

    Those of reverse mode by `backward` or `torch.autograd.grad` do, whether they need it or not.
    """
    try:
        tensor.data_ptr()
    except RuntimeError:
        return False  # It stands for others, and has no memory of its own.
    return unpack_dual(tensor).tangent is None


def is_plain(tensor: Tensor) -> bool:
    """Whether a tensor takes part in no differentiation at all."""
    return has_memory(tensor) and not (tensor.requires_grad and torch.is_grad_enabled())


def position_of(values: Mapping[str, Tensor], names: Iterable[str]) -> Position | None:
    """Where the named parameters stand, or None if one of them is being differentiated.

    Names without a value are left out.
    """
    found = []
    for name in sorted(set(names) & set(values)):
        if not is_plain(values[name]):
            return None
        found += [(name, number) for number in values[name].flatten().tolist()]
    return tuple(found)


def kept(
    store: dict[Key, tuple[Position, Made]],
    key: Key,
    position: Position | None,
    make: Callable[[], Made],
) -> Made:
    """What was made last for a key, if it was made for the same position, else a new one.

    Parameters
    ----------
    store : dict
        Of the latest for each key. Nothing is stored of what is being differentiated (position
        None), nor within a transform of `torch.func`, which wraps all results: wrapped tensors
        cannot be copied when it is over.
    key : hashable
    position : Position or None
        See `position_of`.
    make : callable
        Makes a new one.
    """
    if position is None:
        return make()
    latest = store.get(key)
    if latest is None or latest[0] != position:
        latest = (position, make())
        if has_memory(torch.zeros(()) + 0):
            store[key] = latest
    return latest[1]
