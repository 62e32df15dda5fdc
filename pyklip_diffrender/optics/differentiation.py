"""Distinguish differentiated tensors from constants, whose results may be cached."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import TypeVar

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

__all__ = ["Cache", "Position", "cached", "has_memory", "is_plain", "position_of"]

Key = TypeVar("Key", bound=Hashable)
Made = TypeVar("Made")

Position = tuple[tuple[str, float], ...]
"""Named values as plain numbers, as a key for results computed from them."""


class Cache(dict[Key, Made]):
    """Constants by key, each made once. Copies by `pickle` and `copy.deepcopy` are empty.

    Nothing is stored within a transform of `torch.func`, which wraps all results: wrapped tensors
    cannot be copied or written after it has ended.
    """

    def kept(self, key: Key, make: Callable[[], Made]) -> Made:
        """The constant for a key, which `make` makes if there is none yet."""
        made = self.get(key)
        if made is None:
            self[key] = made = make()
        return made

    def __setitem__(self, key: Key, made: Made) -> None:
        if has_memory(torch.zeros(()) + 0):
            super().__setitem__(key, made)

    def __reduce__(self) -> tuple[type[Cache[Key, Made]], tuple[()]]:
        return type(self), ()


def has_memory(tensor: Tensor) -> bool:
    """Whether a tensor is not wrapped by a transform of `torch.func`, nor a dual number.

    Tensors in reverse mode by `backward` or `torch.autograd.grad` are not wrapped.
    """
    try:
        tensor.data_ptr()
    except RuntimeError:
        return False  # A wrapper without memory of its own.
    return unpack_dual(tensor).tangent is None


def is_plain(tensor: Tensor) -> bool:
    """Whether a tensor takes part in no differentiation at all."""
    return has_memory(tensor) and not (tensor.requires_grad and torch.is_grad_enabled())


def position_of(values: Mapping[str, Tensor], names: Iterable[str]) -> Position | None:
    """Values of the named parameters, or None if one of them is being differentiated.

    Names without a value are omitted.
    """
    position = []
    for name in sorted(set(names) & set(values)):
        if not is_plain(values[name]):
            return None
        position += [(name, number) for number in values[name].flatten().tolist()]
    return tuple(position)


def cached(
    store: Cache[Key, tuple[Position, Made]],
    key: Key,
    position: Position | None,
    make: Callable[[], Made],
) -> Made:
    """The stored result for a key if it was made at the same position, else a new one.

    Only the latest result for each key is stored. Nothing is stored while differentiating
    (position None), nor within a transform of `torch.func`, see `Cache`.

    Parameters
    ----------
    store : Cache
    key : hashable
    position : Position or None
        See `position_of`.
    make : callable
        Makes a new result.
    """
    if position is None:
        return make()
    latest = store.get(key)  # Read only once: another thread may replace it at any moment.
    if latest is None or latest[0] != position:
        store[key] = latest = (position, make())
    return latest[1]
