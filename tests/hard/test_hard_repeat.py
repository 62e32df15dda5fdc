"""The same again: same seed, same bits; threads; a process killed while it writes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from astropy.io import fits
from hard_cases import small, system, wavefront, worst
from stability_fits import error_of, fitted, noise, observed, star

from pyklip_diffrender.io import open_fits, write_fits
from pyklip_diffrender.scene import Planet, Scene, simulate
from pyklip_diffrender.wavefront import random_drift, random_opd

pytestmark = pytest.mark.hard


PRECISIONS = pytest.mark.parametrize(
    "dtype",
    [torch.float64, pytest.param(torch.float32, marks=pytest.mark.slow)],
    ids=["float64", "float32"],
)


@pytest.fixture
def eight_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(8)
    yield
    torch.set_num_threads(before)


def everything(seed):
    """Bits of all that draws random numbers."""
    scene = Scene(planets=(Planet(1e-4, 0.6, 30.0),))
    made = simulate(system(torch.float64), scene, wavefront().numpy(), seed=seed, frames=2)
    arrays = (made.data, made.error, random_opd(seed, 48).data, random_drift(seed, 10.0, 48).data)
    return [array.tobytes() for array in arrays]


def test_the_same_seed_gives_the_same_bits_and_another_does_not():
    first, again, other = everything(7), everything(7), everything(8)
    assert first == again
    assert all(a != b for a, b in zip(first, other, strict=True))


@pytest.mark.usefixtures("eight_threads")
@PRECISIONS
def test_eight_threads_give_the_same_bits_every_time(dtype):
    images = [small(dtype=dtype)(wavefront()).numpy() for _ in range(3)]
    assert images[0].tobytes() == images[1].tobytes() == images[2].tobytes()


@pytest.mark.slow
def test_a_fit_with_eight_threads_is_the_serial_fit():
    """Bits differ, sums are taken in another order; a thousandth of the noise is allowed."""
    before = torch.get_num_threads()
    fits_ = []
    for count in (1, 8, 8):
        torch.set_num_threads(count)
        fits_.append(fitted(observed(star()), max_iterations=6))
    torch.set_num_threads(before)
    serial, first, again = fits_
    assert first.wavefront.tobytes() == again.wavefront.tobytes()
    assert first.frames[0].star.tobytes() == again.frames[0].star.tobytes()
    assert np.abs((first.frames[0].star - serial.frames[0].star) / noise()).max() < 1e-3
    assert first.status is serial.status
    assert error_of(first.frames[0].star) < 1


@PRECISIONS
def test_eight_callers_of_one_model_get_what_one_gets(dtype):
    """A fresh model: its constants are built by whoever comes first."""
    serial, shared = (
        small(dtype=dtype, monochromatic=None, nlambda=2, npix=64, fov_pixels=16) for _ in range(2)
    )
    opds = [torch.from_numpy(random_opd(k, npix=64).data) for k in range(8)]
    offsets = [(0.01 * k, -0.005 * k) for k in range(8)]
    expected = [serial(*each).numpy() for each in zip(opds, offsets, strict=True)]
    with ThreadPoolExecutor(8) as pool:
        got = [image.numpy() for image in pool.map(shared, opds, offsets)]
    for image, true in zip(got, expected, strict=True):
        assert worst(image, true) < (1e-12 if dtype == torch.float64 else 1e-5)
    assert worst(expected[1], expected[0]) > 0.1


@pytest.mark.parametrize("suffix", [".fits", pytest.param(".fits.gz", marks=pytest.mark.slow)])
def test_a_process_killed_in_the_middle_of_the_file_leaves_the_old_one(tmp_path, suffix, killed):
    """Half of the new file is on the disk when the process is killed."""
    path = tmp_path / f"product{suffix}"
    write_fits(fits.HDUList([fits.PrimaryHDU(np.zeros((70, 70)))]), path)
    killed(
        """
        import os, sys, time
        import numpy as np
        from astropy.io import fits
        from pyklip_diffrender.io.files import write_fits
        whole = fits.HDUList.writeto

        def half(hdus, name, **options):
            whole(hdus, name, **options)
            os.truncate(name, os.path.getsize(name) // 2)
            print("writing", flush=True)  # For whoever waits to kill this process.
            time.sleep(60)

        fits.HDUList.writeto = half
        write_fits(fits.HDUList([fits.PrimaryHDU(np.ones((70, 70)))]), sys.argv[1])
        """,
        path,
    )
    with open_fits(path) as hdus:
        assert hdus[0].data.shape == (70, 70)
        assert not hdus[0].data.any()
