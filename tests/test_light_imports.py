"""Functions that scipy.signal and scipy.stats have, without the time that their imports take."""

import gc
import subprocess
import sys

import numpy as np
import pytest
from scipy import stats
from scipy.signal import fftconvolve

from pyklip_diffrender.cli.session import importing
from pyklip_diffrender.detection import tails
from pyklip_diffrender.optics.grid import fft_convolve


@pytest.mark.parametrize("shape", [(7, 12), (30, 31)])
@pytest.mark.parametrize("kernel", [(4, 5), (9, 2), (40, 33)])
def test_images_are_convolved_as_by_scipy(shape, kernel):
    random = np.random.default_rng(1)
    images, kernel = random.normal(size=(3, *shape)), random.normal(size=kernel)
    got, full = fft_convolve(images, kernel), fft_convolve(images, kernel, full=True)
    for k, image in enumerate(images):
        np.testing.assert_allclose(got[k], fftconvolve(image, kernel, "same"), atol=1e-13)
        np.testing.assert_allclose(full[k], fftconvolve(image, kernel), atol=1e-13)


@pytest.mark.parametrize("freedom", [1.0, 3.3, 50.0, np.inf])
def test_tails_are_as_in_scipy(freedom):
    sigmas = np.array([-2.0, 0.0, 1.0, 5.0, 8.0])
    probability = stats.norm.sf(sigmas)
    np.testing.assert_allclose(tails.gaussian_tail(sigmas), probability, rtol=1e-13)
    np.testing.assert_allclose(tails.gaussian_sigmas(probability), sigmas, atol=1e-13)
    student = stats.t(freedom)
    np.testing.assert_allclose(tails.student_tail(sigmas, freedom), student.sf(sigmas), rtol=1e-13)
    np.testing.assert_allclose(
        tails.student_snr(sigmas, freedom), student.isf(probability), rtol=1e-12, atol=1e-13
    )


def test_reductions_do_not_load_what_takes_long_to_import():
    code = (
        "import sys, pyklip_diffrender.cli.reducing\n"
        "heavy = 'scipy.stats', 'scipy.signal', 'photutils', 'matplotlib', 'pyklip', 'dask'\n"
        "assert 'torch' in sys.modules\n"
        "sys.exit(', '.join(name for name in heavy if name in sys.modules) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_collector_is_left_as_it_is_where_libraries_are_loaded():
    """A frozen object of the caller would never be freed."""
    assert "torch" in sys.modules
    frozen = gc.get_freeze_count()
    with importing():
        assert gc.isenabled()
    assert gc.get_freeze_count() == frozen
    code = (
        "import gc\nfrom pyklip_diffrender.cli.session import importing\n"
        "with importing():\n    assert not gc.isenabled()\n    import torch\n"
        "assert gc.isenabled() and gc.get_freeze_count() > 10_000"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
