"""Operations and bytes of the package's work, and how long a GPU would take at least.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.operations --target G-7-34 --filter F444W

Every operation of PyTorch is counted with its floating-point operations and the bytes of its inputs
and outputs. The predicted time is the sum over operations of the longest of three: operations over
the peak rate of their precision, bytes over the bandwidth of the memory, and the start of a kernel.
(`torch.utils.flop_counter` counts neither transforms nor bytes.) No GPU was measured. Of the
reduction, the linear algebra is counted as if it were on the GPU as well; it stays on the
processor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import pyklip_diffrender as dr
from benchmarks.real_options import real_frames_parser
from pyklip_diffrender.linear.response import WavefrontResponse
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.scene.simulation import model_for
from pyklip_diffrender.wavefront.bases import default_basis

PEAK = {32: 67e12, 64: 34e12}
"""Operations per second of an H100 SXM without tensor cores, by the bits of a real number: NVIDIA
H100 Tensor Core GPU datasheet."""

BANDWIDTH = 3.35e12
"""Bytes per second of its memory, ibid."""

START = 5e-6
"""Seconds from one kernel to the next that a program starts from Python, an assumption."""

_VIEWS = ("view", "slice", "select", "unsqueeze", "squeeze", "expand", "t", "transpose", "permute",
          "as_strided", "detach", "unbind", "split", "alias", "unfold", "diagonal", "real", "imag",
          "view_as_real", "view_as_complex", "conj", "_conj", "_reshape_alias", "movedim",
          "_unsafe_view", "empty", "new_empty", "lift_fresh", "_local_scalar_dense")  # fmt: skip
_PRODUCTS = ("mm", "bmm", "addmm", "baddbmm", "mv", "dot")
_PICKED = ("index", "index_select", "gather")
_TRANSFORMS = ("_fft_c2c", "_fft_r2c", "_fft_c2r")


@dataclass
class Total:
    """Sums over operations."""

    kernels: int = 0
    operations: float = 0.0
    bytes: float = 0.0
    seconds: float = 0.0

    def add(self, name: str, inputs: list[Tensor], outputs: list[Tensor]) -> None:
        """Add an operation."""
        kind = outputs[0].dtype
        written, read = (
            sum(e.numel() * e.element_size() for e in part) for part in (outputs, inputs)
        )
        # What is picked from a table is read, not the table.
        moved = written + (min(read, written) if name in _PICKED else read)
        operations = operations_of(name, inputs, outputs[0])
        peak = PEAK[32 if kind in (torch.float32, torch.complex64) else 64]
        self.kernels += 1
        self.operations += operations
        self.bytes += moved
        self.seconds += max(operations / peak, moved / BANDWIDTH, START)

    def __str__(self) -> str:
        return (
            f"{self.kernels} kernels, {self.operations / 1e9:.3g} Gflop, "
            f"{self.bytes / 1e9:.3g} GB, at least {1e3 * self.seconds:.3g} ms"
        )


class Count(TorchDispatchMode):
    """Counts all operations that are run inside."""

    def __init__(self) -> None:
        super().__init__()
        self.total = Total()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Run an operation and count it."""
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        inputs = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        outputs = [each for each in tree_leaves(result) if isinstance(each, Tensor)]
        if outputs and name not in _VIEWS:
            self.total.add(name, inputs, outputs)
        return result


def operations_of(name: str, inputs: list[Tensor], out: Tensor) -> float:
    """Floating-point operations of one operation of PyTorch, one per element if it is not known."""
    is_complex = out.is_complex()
    if name in _PRODUCTS:
        # The inner length is the last axis of the first factor; biases come before it.
        factor = inputs[-2]
        return (8.0 if is_complex else 2.0) * out.numel() * factor.shape[-1]
    if name in _TRANSFORMS:
        # All transforms of the package are over the last two axes.
        return 5.0 * out.numel() * math.log2(max(2, math.prod(out.shape[-2:])))
    if "cholesky" in name:
        return out.shape[-1] ** 3 / 3 * math.prod(out.shape[:-2])
    if "solve" in name or "inv" in name:
        return float(out.numel() * inputs[0].shape[-1])
    return out.numel() * (6.0 if is_complex and "mul" in name else 1.0)


def counted(work: Callable[[], object]) -> Total:
    """Count the operations of some work."""
    with Count() as count:
        work()
    return count.total


def main() -> None:
    """Count an image, a response and the fit of a roll."""
    parser = real_frames_parser(__doc__)
    options = parser.parse_args()
    sequence = dr.Sequence.from_files(options.frames, target=options.target, filter=options.filter)
    sequence = replace(sequence, science=sequence.science[:1], references=()).cutout(80)
    model = model_for(sequence.science[0], 80)
    opd = torch.from_numpy(resample(dr.read_opd(options.opd).data, model.npix))
    basis = default_basis(18.0)
    with torch.no_grad():
        model(opd)  # Constants are computed once.
        image = counted(lambda: model(opd))
    print(f"one image, {len(model.bandpass.wavelengths)} wavelengths: {image}")
    response = counted(lambda: WavefrontResponse(model, basis, opd, {}))
    print(f"response of {len(basis)} modes: {response}")
    print(f"reduction of one roll: {counted(lambda: dr.reduce(sequence, options.opd))}")


if __name__ == "__main__":
    main()
