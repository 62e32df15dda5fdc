"""Images, derivatives, fits and searches on a GPU, against the processor.

``python -m pytest -m gpu``; other runs of the tests leave these out.
"""

from __future__ import annotations

import device_work as work
import numpy as np
import pytest
import torch

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no CUDA device"),
]

DTYPES = (torch.float64, torch.float32)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("compute", "tolerances"),
    [
        (work.gradient, (1e-9, 2e-4)),
        (work.parameter_derivatives, (1e-9, 1e-4)),
        (work.point_sources, (1e-5, 1e-5)),
        (work.response, (1e-5, 1e-4)),
        (work.fit_gradient, (1e-9, 2e-4)),
    ],
)
def test_images_and_derivatives(compute, tolerances, dtype):
    """As a fraction of the rms; on the processor, single precision is off by up to 1.4e-5.

    Sources and responses are computed in single precision in any case.
    """
    got, expected = compute("cuda", dtype=dtype), compute("cpu", dtype=torch.float64)
    for ours, theirs in zip(got, expected, strict=True):
        error = np.linalg.norm(np.subtract(ours, theirs)) / np.linalg.norm(theirs)
        assert error < tolerances[DTYPES.index(dtype)]


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_search(dtype):
    """Chi-squared, position, flux, contrasts and limits of a joint fit of rolls."""
    frames = work.rolls()
    got, expected = work.search("cuda", frames, dtype=dtype), work.search("cpu", frames)
    # Single precision on the processor: up to 4e-4, for positions of 0.1 mas.
    rtol = 1e-3 if dtype == torch.float64 else 1e-2
    np.testing.assert_allclose(got, expected, rtol=rtol, atol=1e-7)


def test_a_model_is_on_the_gpu_throughout():
    model = work.model_on("cuda")
    image = model(work.opd())
    assert image.device.type == model.device.type == "cuda"
    assert model.with_fidelity(npix=128).device.type == "cuda"
    with pytest.raises(RuntimeError, match="device"):
        _ = image + torch.ones(image.shape)
