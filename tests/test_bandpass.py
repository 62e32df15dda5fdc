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


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_polynomials_keep_their_sums(count):
    few = BAND.condensed(count)
    assert len(few.wavelengths) == count
    assert min(BAND.wavelengths) < min(few.wavelengths) <= max(few.wavelengths) < 4.95e-6
    for order in range(2 * count):
        assert moment(few, order) == pytest.approx(moment(BAND, order), rel=1e-10, abs=1e-12)
    # That is all that so few nodes can do.
    assert moment(few, 2 * count) != pytest.approx(moment(BAND, 2 * count), rel=1e-6)


def test_a_whole_filter_keeps_its_moments():
    # The nodes come from a recurrence, which loses digits with the number of wavelengths.
    band = filter_bandpass("F444W", 21)
    few = band.condensed(9)
    for order in range(18):
        assert moment(few, order) == pytest.approx(moment(band, order), rel=1e-10, abs=1e-12)


def test_as_many_wavelengths_as_there_are():
    assert BAND.condensed(5) is BAND
    assert BAND.condensed(9) is BAND


def test_the_width_is_that_of_all_wavelengths():
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
