"""Models in forked processes, and memory that a process keeps."""

import os
import platform
import subprocess
import sys

import pytest

FORK = """
import multiprocessing, torch
import pyklip_diffrender as dr

torch.set_num_threads(2)
model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=256, fov_pixels=24)

def slope(_):
    opd = torch.zeros(256, 256, dtype=torch.float64, requires_grad=True)
    model(opd).square().sum().backward()
    return float(opd.grad.abs().sum())

here = slope(None)
with multiprocessing.get_context("fork").Pool(1) as pool:
    there = pool.map_async(slope, [None]).get(120)[0]
    threads = pool.apply_async(torch.get_num_threads).get(120)
assert abs(there / here - 1) < 1e-12, (here, there)
assert threads == 1 and torch.get_num_threads() == 2
"""

MEMORY = """
import numpy
from pyklip_diffrender.cli.session import keep_freed_memory

def pages():
    return int(open("/proc/self/statm").read().split()[1])

keep_freed_memory()
arrays = [numpy.ones(2_500_000) for _ in range(20)]
full = pages()
del arrays
assert pages() > 0.9 * full, (pages(), full)
"""


def run(script):
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", script]
    free = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=free)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not hasattr(os, "register_at_fork"), reason="this system has no fork")
def test_a_forked_child_computes_after_a_parent_with_two_threads():
    """Threads of the parent do not exist in the child, which would wait for them forever."""
    run(FORK)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators stay as they are")
def test_the_command_line_uses_freed_memory_again():
    run(MEMORY)
