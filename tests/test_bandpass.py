"""Fewer wavelengths in place of a bandpass."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pyklip_diffrender.instrument import filter_bandpass, nircam_coronagraph
from pyklip_diffrender.optics import Bandpass
from pyklip_diffrender.wavefront import random_opd

BAND = Bandpass((4.4e-6, 3.9e-6, 4.1e-6, 4.95e-6, 4.7e-6), (0.3, 0.1, 0.25, 0.15, 0.2))


def moment(band, order):
    x = (np.array(band.wavelengths) - 4.4e-6) / 1e-6
    return float(np.array(band.weights) @ x**order)


# The nodes come from a recurrence, which loses digits with the number of wavelengths.
@pytest.mark.parametrize(
    ("band", "count"), [(BAND, 1), (BAND, 3), (BAND, 4), (filter_bandpass("F444W", 21), 9)]
)
def test_polynomials_keep_their_sums(band, count):
    few = band.condensed(count)
    assert len(few.wavelengths) == count
    assert min(band.wavelengths) < min(few.wavelengths)
    assert max(few.wavelengths) < max(band.wavelengths)
    for order in range(2 * count):
        assert moment(few, order) == pytest.approx(moment(band, order), rel=1e-10, abs=1e-12)
    # That is all that so few nodes can do.
    assert count == 9 or moment(few, 2 * count) != pytest.approx(moment(band, 2 * count), rel=1e-6)
    assert BAND.condensed(5) is BAND
    assert BAND.width == pytest.approx(1.05 / 4.4175)


def test_images_are_more_accurate_than_with_a_selection():
    model = nircam_coronagraph("F444W", npix=128, fov_pixels=24, nlambda=9)
    opd = random_opd(1, npix=128).data
    errors = []
    with torch.no_grad():
        whole = model(opd, (0.5, 0.2))
        for few in (model.bandpass.condensed(3), model.bandpass.thinned(4)[1]):
            image = model.at_wavelengths(few)(opd, (0.5, 0.2))
            errors.append(float((image - whole).norm() / whole.norm()))
    assert errors[0] < 0.5 * errors[1] < 0.02
