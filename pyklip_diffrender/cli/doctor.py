"""``pyklip-diffrender doctor``: whether the package can work here."""

from __future__ import annotations

import os
import platform
import shutil
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import click

from pyklip_diffrender._version import __version__
from pyklip_diffrender.cli.machine import free_memory
from pyklip_diffrender.cli.session import Run
from pyklip_diffrender.cli.shared_options import Command, common
from pyklip_diffrender.errors import DiffrenderError

__all__ = ["Check", "doctor"]

_LIBRARIES = (
    "torch", "numpy", "scipy", "astropy", "poppy", "photutils", "pyklip", "matplotlib", "tqdm",
    "click", "tomli_w",
)  # fmt: skip

_TABLES = (
    "jwst_primary_polygons", "nircam_filters", "nircam_maskrnd_openings", "nircam_si_zernikes",
)  # fmt: skip

_NEEDED = 2e9
"""Bytes of memory that the demo, and a reduction of one roll, take."""

_PRODUCTS = 0.5e9
"""Bytes on disk that the products of a reduction of two rolls may take."""


_EXPLAINED = 1.5
"""Chi-squared per pixel above which the self-test has failed; 0.8 is usual."""


@dataclass(frozen=True)
class Check:
    """Outcome of one check."""

    state: Literal["ok", "note", "FAIL"]
    text: str


def check_libraries(names: Iterable[str] = _LIBRARIES) -> Iterator[Check]:
    """Import every library that the package needs."""
    yield Check("ok", f"pyklip-diffrender {__version__}, Python {platform.python_version()}")
    for name in names:
        try:
            import_module(name)
            yield Check("ok", f"{name} {version(name.replace('_', '-'))}")
        except PackageNotFoundError:
            yield Check("note", f"{name} can be imported, and has no version")
        except Exception as error:  # Broken libraries raise anything.
            yield Check(
                "FAIL",
                f"{name} cannot be imported ({error}). Install the package again, in a fresh "
                "environment",
            )


def check_data(tables: Collection[str] = _TABLES) -> Iterator[Check]:
    """Read the files that come with the package."""
    from pyklip_diffrender.io.files import embedded_table
    from pyklip_diffrender.pattern.library import package_library

    try:
        rows = sum(len(embedded_table(name)) for name in tables)
        patterns = len(package_library().patterns)
    except (DiffrenderError, OSError, ValueError) as error:
        yield Check("FAIL", f"data files cannot be read ({error}). Install the package again")
    else:
        yield Check(
            "ok",
            f"data files: {rows} rows in {len(tables)} tables of the instrument, {patterns} "
            "patterns of the flat field",
        )


def check_stpsf() -> Iterator[Check]:
    """Look for stpsf, which is optional, and its data."""
    from pyklip_diffrender.io.files import read_text

    try:
        name = f"stpsf {version('stpsf')}"
    except PackageNotFoundError:
        yield Check("note", "stpsf is not installed; only bridges and maps from MAST need it")
        return
    folder = os.environ.get("STPSF_PATH") or os.environ.get("WEBBPSF_PATH")
    if not folder:
        yield Check("note", f"{name}; STPSF_PATH is not set, so stpsf has no data files")
    elif not (Path(folder) / "version.txt").is_file():
        yield Check(
            "FAIL",
            f"{name}; STPSF_PATH is {folder}, which has no version.txt. Set it to stpsf's data "
            "files, or unset it",
        )
    else:
        data = read_text(Path(folder) / "version.txt").strip()
        yield Check("ok", f"{name}; STPSF_PATH is {folder}, version {data}")


def check_machine() -> Iterator[Check]:
    """Look at processors, memory and disk."""
    import torch

    policy = os.environ.get("OMP_WAIT_POLICY", "active")
    yield Check(
        "ok",
        f"{torch.get_num_threads()} threads on {os.cpu_count()} processors, wait policy {policy} "
        "(in Python set OMP_WAIT_POLICY=passive before PyTorch is imported)",
    )
    if not torch.cuda.is_available():
        yield Check("note", "PyTorch sees no GPU; the processor is used")
    else:
        for k in range(torch.cuda.device_count()):
            memory = torch.cuda.get_device_properties(k).total_memory / 1e9
            yield Check("ok", f"cuda:{k}: {torch.cuda.get_device_name(k)}, {memory:.0f} GB")
    yield memory_check(free_memory())
    yield disk_check(shutil.disk_usage(Path.cwd()).free)


def memory_check(free: float | None) -> Check:
    """Judge so many bytes of free memory."""
    if free is None:
        return Check("note", "the system does not say how much memory is free")
    text = f"{free / 1e9:.1f} GB of memory are free"
    if free < _NEEDED:
        return Check("FAIL", f"{text}; the demo and a reduction need 2 GB")
    return Check("ok", text)


def disk_check(free: float) -> Check:
    """Judge so many free bytes on the disk."""
    text = f"{free / 1e9:.1f} GB are free on the disk of this folder"
    if free < _PRODUCTS:
        return Check("FAIL", f"{text}; the products of a reduction need up to 0.5 GB")
    return Check("ok", text)


def check_fit(**settings: Any) -> Iterator[Check]:
    """Simulate a telescope whose segments have moved, and refine its wavefront.

    The mirror is coarsely sampled and nothing but its segments moves, so that seconds suffice.

    Parameters
    ----------
    **settings
        Of `GaussNewton`, besides the basis.
    """
    import numpy as np
    import torch

    from pyklip_diffrender.instrument.nircam import nircam_coronagraph
    from pyklip_diffrender.optics.grid import PupilGrid
    from pyklip_diffrender.refinement import GaussNewton, refine
    from pyklip_diffrender.scene.objects import Scene
    from pyklip_diffrender.scene.simulation import simulate
    from pyklip_diffrender.wavefront.bases import SegmentMotions
    from pyklip_diffrender.wavefront.opd import random_opd

    began = time.perf_counter()
    model = nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=96, fov_pixels=24)
    basis, measured = SegmentMotions(), random_opd(1, npix=model.npix).data
    motions = 1e-8 * np.random.default_rng(2).normal(size=len(basis))
    truth = measured + basis.opd(torch.from_numpy(motions), PupilGrid.full(model.npix)).numpy()
    frame = simulate(model, Scene(), truth, seed=1)
    fit = refine(model, frame, measured, settings=GaussNewton(basis=basis, **settings))
    lit = model.entrance.lit.numpy()
    before, after = (1e9 * float(np.std((opd - truth)[lit])) for opd in (measured, fit.wavefront))
    text = (
        f"self-test in {time.perf_counter() - began:.0f} s: the error of the wavefront fell from "
        f"{before:.1f} to {after:.1f} nm, with chi-squared {fit.chi2_per_pixel:.2f} per pixel"
    )
    if fit.status.usable and after < 0.5 * before and fit.chi2_per_pixel < _EXPLAINED:
        yield Check("ok", text)
    else:
        yield Check(
            "FAIL", f"{text}, expected below {0.5 * before:.1f} nm and {_EXPLAINED}. Do not use "
            "results of this installation; look at the versions above"
        )  # fmt: skip


CHECKS: tuple[Callable[[], Iterator[Check]], ...] = (
    check_libraries,
    check_data,
    check_stpsf,
    check_machine,
    check_fit,
)


@click.command(cls=Command)
@common
@click.pass_obj
def doctor(run: Run) -> int:
    """Check libraries, data files, machine, and a small fit.

    Takes about five seconds. The exit status is 1 if a check fails.
    """
    failed = 0
    for check in CHECKS:
        for outcome in check():
            click.echo(f"{outcome.state:4}  {outcome.text}")
            failed += outcome.state == "FAIL"
    return 1 if failed else 0
