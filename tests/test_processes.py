"""Models in forked processes."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
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


@pytest.mark.skipif(not hasattr(os, "register_at_fork"), reason="this system has no fork")
def test_a_forked_child_computes_after_a_parent_with_two_threads():
    """Threads of the parent do not exist in the child, which would wait for them forever."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", SCRIPT], capture_output=True,
        text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
