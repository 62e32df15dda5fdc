"""A pretended accelerator: tensors lie on the processor, and may not be mixed as if they did not.

A tensor belongs to the device if its memory does. Memory is followed through all operations, in
every derivative too, and what an accelerator would refuse is refused: operations between tensors
on both devices, and arrays of numpy that share a tensor's memory.
"""

from contextlib import contextmanager

import torch
from torch import Tensor
from torch._C import _functorch
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

DEVICE = torch.device("lazy")
"""A device that torch knows by name, and never tries to start."""

_CPU = torch.device("cpu")
_aten = torch.ops.aten

_COPIES = (_aten.copy_.default, _aten._to_copy.default)
"""What may move data between devices."""

_INDEXED = (_aten.index.Tensor, _aten.index_put.default, _aten.index_put_.default,
            _aten._index_put_impl_.default)  # fmt: skip
"""Operations whose indices may be on the processor where the indexed tensor is not."""


class Memory:
    """Knows which memory belongs to the device."""

    def __init__(self):
        self._places = {}

    def holds(self, tensor):
        """Whether a tensor is on the device; None for a constant that goes with both devices."""
        return self._places.get(self._key(tensor), False)

    def mark(self, tensor, held):
        """State where a tensor is."""
        self._places.pop(self._key(tensor), None)
        if held is not False:
            self._places[self._key(tensor)] = held

    @staticmethod
    def _key(tensor):
        while _functorch.is_functorch_wrapped_tensor(tensor):
            tensor = _functorch.get_unwrapped(tensor)
        return StorageWeakRef(tensor.untyped_storage())


class _Operations(TorchDispatchMode):
    """Follows memory through operations."""

    def __init__(self, memory):
        super().__init__()
        self._memory = memory
        self.computes = False
        """Whether the present call has operands; constants are then torch's own."""
        self.leaves = False
        """Whether the present call copies to the processor."""

    @classmethod
    def _should_skip_dynamo(cls):
        return False  # Its import would take seconds.

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        tensors = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        if func not in _COPIES:
            self._require_one_device(func, args, tensors)
        places = {self._memory.holds(each) for each in tensors} - {None}
        held = (True in places) if places else None
        if kwargs.get("device") == DEVICE:
            kwargs["device"], held = _CPU, True
        elif not tensors and not self.computes:
            held = False
        if held and self.leaves:
            held = False
        result = func(*args, **kwargs)
        for each in tree_leaves(result):
            # What is written in place stays where it is.
            if isinstance(each, Tensor) and (
                self._memory.holds(each) is None or not any(each is t for t in tensors)
            ):
                self._memory.mark(each, held)
        return result

    def _require_one_device(self, func, args, tensors):
        holds = self._memory.holds
        if func in _INDEXED and holds(args[0]):
            tensors = [args[0], *args[2:3]]
        # A number on the processor may go with any tensor.
        lenient = torch.Tag.pointwise in func.tags
        apart = [t for t in tensors if holds(t) is False and (t.ndim or not lenient)]
        if apart and any(holds(each) for each in tensors):
            shapes = [(tuple(t.shape), holds(t)) for t in tensors]
            raise RuntimeError(f"{func}: expected all tensors on one device, got {shapes}")


class _Functions(TorchFunctionMode):
    """Says which device a tensor is on, and moves tensors."""

    def __init__(self, memory, operations):
        super().__init__()
        self._memory, self._operations = memory, operations

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        holds = self._memory.holds
        if func == Tensor.device.__get__:
            return DEVICE if holds(args[0]) else _CPU
        if func in (Tensor.numpy, Tensor.__array__) and holds(args[0]):
            raise TypeError("cannot convert a tensor on another device to numpy; use .cpu() first")
        if func is Tensor.cpu:
            return self._to_cpu(args[0])
        if func is Tensor.to:
            return self._to(*args, **kwargs)
        if func in (torch.tensor, torch.as_tensor):
            device = kwargs.pop("device", None)
            made = args[0] if isinstance(args[0], Tensor) else func(*args, **kwargs)
            return made if device is None else self._to(made, device, kwargs.get("dtype"))
        operands = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        self._operations.computes = bool(operands)
        try:
            return func(*args, **kwargs)
        finally:
            self._operations.computes = False

    def _to(self, tensor, *args, **kwargs):
        values = [*args, *kwargs.values()]
        device = DEVICE if self._memory.holds(tensor) else _CPU
        dtype = tensor.dtype
        for value in values:
            if isinstance(value, Tensor):
                device, dtype = (DEVICE if self._memory.holds(value) else _CPU), value.dtype
            elif isinstance(value, torch.dtype):
                dtype = value
            elif isinstance(value, str | torch.device):
                device = torch.device(value)
        if device == _CPU:
            tensor = self._to_cpu(tensor)
        elif not self._memory.holds(tensor):
            tensor = self._moved(tensor, DEVICE)
        return tensor.to(dtype)

    def _to_cpu(self, tensor):
        return self._moved(tensor, _CPU) if self._memory.holds(tensor) else tensor

    def _moved(self, tensor, device):
        """A copy on the other device, of tangents too; its gradient goes the other way."""
        self._operations.leaves = device == _CPU
        try:
            moved = tensor.clone() if device == _CPU else tensor.to(device)
        finally:
            self._operations.leaves = False
        if moved.requires_grad:
            back = DEVICE if device == _CPU else _CPU
            moved.register_hook(lambda gradient: self._moved(gradient, back))
        return moved


@contextmanager
def pretended():
    """Inside, `DEVICE` can be used as a device of torch."""
    memory = Memory()
    operations = _Operations(memory)
    with operations, _Functions(memory, operations):
        yield memory
