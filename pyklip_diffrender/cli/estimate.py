"""Steps of a reduction, and estimates of their time, memory and room on disk."""

from __future__ import annotations

import math
from collections import Counter

from pyklip_diffrender.cli.machine import free_memory
from pyklip_diffrender.detection.recovery import TOGETHER
from pyklip_diffrender.io.progress import duration
from pyklip_diffrender.pattern import (
    PatternLibrary,
    combine_libraries,
    known_systematics,
    package_library,
)
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.scene.sequence import Sequence

__all__ = ["describe_plan", "size_of_products", "steps_of"]

# Seconds on two cores. Measured for the first roll of G 7-34 in F444W, 80 x 80 pixels, in processor
# time of one thread of an AMD EPYC: 40 s for the fit, 11 s for the search, 10 s for products. Two
# threads take 0.7 of that. The place of HIP 65426 on the detector took 0.6 of its fit. In two rolls
# of AU Mic, the fits with extended light take 1.2 (F356W) and 1.7 times (F444W) the time of the fit
# before; in HIP 17695 the fit with the star's flux takes three fifths of it. Exponents as
# documented.
_FIT = 29.0
_PLACE = 0.6
_QUICK = 0.7
_SEARCH = 8.0
_DISK = 1.4
_TIED = 0.6
_WIDE = 10.0
_COMPLETENESS = 90.0
_WRITE = 7.0
_FRAMES = 0.88
_JOINT = 0.9
_PIXELS = 0.17
_MEMORY = 1.4e9
_MEMORY_PER_FRAME = 0.4e9

# Bytes that reading takes for each of the largest file: pixels and errors of four bytes and a mask,
# of files with flags and no more. Measured: 0.75 (tests/test_memory_of_reading.py bounds it).
_READING = 0.8
_BEFORE_READING = 0.7e9

# Bytes for frames of 80 x 80 pixels.
_REPORT = 5e6
_PRODUCTS = 10e6
_DERIVATIVES = 50e6


def steps_of(sequence: Sequence, options: ReduceOptions) -> list[tuple[str, float]]:
    """The stages of a reduction, each with its duration on two cores, s.

    Parameters
    ----------
    sequence : Sequence
        Cut to the fitted pixels, on which depends whether the library has a pattern for them.
    options : ReduceOptions
    """
    count = len(sequence.science)
    systematics = options.systematics
    area = (options.size / 80) ** 2
    fit = _FIT * area**_PIXELS * (_QUICK if options.accuracy == "quick" else 1.0)
    steps = []
    searched = systematics == "auto" or isinstance(systematics, PatternLibrary)
    libraries = [systematics] if isinstance(systematics, PatternLibrary) else []
    library = combine_libraries([*libraries, package_library()])
    known = searched and known_systematics(sequence.science[0], library=library) is not None
    stars = Counter(each.target for each in sequence.references)
    if known:
        steps += [
            (f"place of {each.name} on the detector", _PLACE * fit)
            for each in sequence.science
            if each.first_pixel is None
        ]
    elif systematics == "references" or (searched and options.references == "pattern"):
        steps += [(f"reference star {star}", fit * n**_FRAMES) for star, n in stars.items()]
    joint = fit * count**_FRAMES * (1 + _TIED * (options.star_flux is not None))
    steps.append(("wavefront", joint))
    others = len(sequence.references) * (options.references == "joint" and not options.disk)
    if others:
        steps.append(("reference stars and target together", fit * _JOINT * (count + others)))
    refit = _DISK * joint * options.disk
    search = _SEARCH * area * count
    steps.append(("search", search))
    more = options.disk or options.wide or options.injections or options.completeness
    if more:
        steps.append(("products after the stage search", _WRITE))
    if options.disk:
        steps.append(("extended light, and wavefront without it", refit))
        steps.append(("search without extended light", search))
    if options.wide:
        steps.append(("whole frames", _WIDE * count))
    if options.injections:
        seconds = joint + refit + _SEARCH * area * count
        rounds = math.ceil(options.injections / TOGETHER)
        steps.append((f"{options.injections} injected planets", rounds * seconds))
    if options.completeness:
        steps.append(("completeness", _COMPLETENESS * area * count))
    steps.append(("products", _WRITE))
    return steps


def size_of_products(sequence: Sequence, *, derivatives: bool) -> float:
    """Bytes that the products of a reduction may take, with some to spare."""
    ny, nx = sequence.science[0].shape
    each = _PRODUCTS + _DERIVATIVES * derivatives
    return _REPORT + each * len(sequence.science) * nx * ny / 80**2


def describe_plan(sequence: Sequence, options: ReduceOptions) -> str:
    """Steps, time and memory as lines of text; arguments as for `steps_of`."""
    steps = steps_of(sequence, options)
    lines = [f"{k}. {name}: about {duration(s)}" for k, (name, s) in enumerate(steps, 1)]
    total = sum(seconds for _, seconds in steps)
    joins = options.references == "joint" and not options.disk
    frames = len(sequence.science) + joins * len(sequence.references)
    memory = _MEMORY + _MEMORY_PER_FRAME * frames * (options.size / 80) ** 2
    files = [row.path for row in sequence.rows if row.path is not None and row.path.exists()]
    largest = max((path.stat().st_size for path in files), default=0)
    # A reduction reads before it fits, and what it has read is then the means of integrations.
    memory = max(memory, _BEFORE_READING + _READING * largest)
    free = free_memory()
    of = "" if free is None else f" ({free / 1e9:.1f} GB are free)"
    lines.append(
        f"in all about {duration(total)} on two cores, up to twice as long if a companion makes "
        f"a second fit necessary, and {memory / 1e9:.1f} GB of memory{of}"
    )
    return "\n".join(lines)
