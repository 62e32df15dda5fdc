"""Figures of merit on hand-made images with answers that can be worked out on paper."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pyklip_diffrender.detection.metrics import (
    annulus_snr,
    aperture_sum,
    psnr,
    star_model_error,
    throughput,
)

CENTER = (10.0, 12.0)
PLANET = (15.0, 12.0)
SHAPE = (25, 21)


def pixels_within(position, radius):
    return [
        (y, x)
        for y in range(SHAPE[0])
        for x in range(SHAPE[1])
        if math.dist((x, y), position) <= radius
    ]


@pytest.fixture
def planet():
    """A round spot of known values, lopsided in y."""
    y, x = np.indices(SHAPE)
    return np.exp(-0.3 * ((x - PLANET[0]) ** 2 + (y - PLANET[1] - 0.3) ** 2))


def test_aperture_sum_takes_the_pixels_whose_centres_lie_inside():
    image = np.arange(25.0 * 21).reshape(SHAPE)
    # Radius 1.5 about a pixel's centre: the 3 x 3 block. Its mean is the middle pixel.
    assert aperture_sum(image, PLANET, 1.5) == 9 * image[12, 15]
    assert aperture_sum(image, PLANET, 1.0) == 5 * image[12, 15]
    assert aperture_sum(image, (15.5, 12.0), 0.5) == image[12, 15] + image[12, 16]
    assert aperture_sum(image * 1.01, PLANET, 1.5) == pytest.approx(1.01 * 9 * image[12, 15])
    assert aperture_sum(0 * image, PLANET, 1.5) == 0


def test_annulus_snr_of_a_chessboard():
    """Signal 7 on 9 pixels, +-1 elsewhere: mean m and deviation sqrt(1 - m^2) by counting."""
    y, x = np.indices(SHAPE)
    image = np.where((x + y) % 2 == 0, 1.0, -1.0)
    image[11:14, 14:17] = 7.0
    near = set(pixels_within(PLANET, 1.5))
    outer, inner = set(pixels_within(CENTER, 6.5)), set(pixels_within(CENTER, 3.49999))
    ring = outer - inner - near
    mean = sum(1 if (a + b) % 2 == 0 else -1 for a, b in ring) / len(ring)
    expected = (7 - mean) / math.sqrt(1 - mean**2) * math.sqrt(9)
    got = annulus_snr(image, PLANET, CENTER)
    assert got == pytest.approx(expected, rel=1e-12)
    assert 20 < got < 22
    # It has no units: a scaled image has the same signal to noise, a shifted level too.
    assert annulus_snr(1.01 * image + 3, PLANET, CENTER) == pytest.approx(expected, rel=1e-12)
    # But not a wrong image, nor one with a weaker planet.
    assert annulus_snr(image.T, PLANET, CENTER) != pytest.approx(expected, rel=0.1)
    weaker = np.where(image == 7, 6.93, image)
    assert annulus_snr(weaker, PLANET, CENTER) == pytest.approx(
        (6.93 - mean) / math.sqrt(1 - mean**2) * 3, rel=1e-12
    )


def test_throughput_is_the_amplitude_of_the_planet(planet, rng):
    noise = rng.uniform(0.5, 2.0, SHAPE)
    for share in (1.0, 0.99, 0.71, 0.0, -0.2):
        assert throughput(share * planet, planet, noise, PLANET) == pytest.approx(share, abs=1e-12)
    transposed = np.zeros(SHAPE)
    transposed[:21, :21] = planet[:21, :21].T
    assert abs(throughput(transposed, planet, noise, PLANET)) < 0.9


def test_throughput_weighs_pixels_by_their_noise():
    """Two pixels: sum(p d / s^2) / sum(p^2 / s^2) = (1*3/1 + 2*1/4) / (1/1 + 4/4) = 1.75."""
    planet, image, noise = np.zeros(SHAPE), np.zeros(SHAPE), np.ones(SHAPE)
    planet[12, 15], planet[12, 16] = 1.0, 2.0
    image[12, 15], image[12, 16] = 3.0, 1.0
    noise[12, 16] = 2.0
    assert throughput(image, planet, noise, PLANET) == pytest.approx(1.75, rel=1e-14)
    # Outside the radius nothing counts; what is not finite does not either.
    image[12, 19] = 1e9
    assert throughput(image, planet, noise, PLANET) == pytest.approx(1.75, rel=1e-14)
    image[12, 15] = np.nan
    assert throughput(image, planet, noise, PLANET) == pytest.approx(0.5, rel=1e-14)


def test_star_model_error_is_an_rms_over_the_ring_in_units_of_the_noise():
    truth = np.full(SHAPE, 100.0)
    noise = np.full(SHAPE, 5.0)
    y, x = np.indices(SHAPE)
    distance = np.hypot(x - CENTER[0], y - CENTER[1])
    model = np.where((distance >= 3) & (distance <= 6), 115.0, 1e9)
    assert star_model_error(model, truth, noise, CENTER, 3, 6) == pytest.approx(3.0, rel=1e-14)
    assert star_model_error(truth, truth, noise, CENTER, 3, 6) == 0.0
    assert star_model_error(1.01 * truth, truth, noise, CENTER, 3, 6) == pytest.approx(0.2)
    assert star_model_error(0 * truth, truth, noise, CENTER, 3, 6) == pytest.approx(20.0)
    ramp = truth + x
    assert star_model_error(ramp, truth + y, noise, CENTER, 3, 6) > 0.5


def test_psnr_of_a_known_error(planet):
    """Peak p, constant error e: 20 log10(p / e)."""
    peak = float(planet.max())
    assert psnr(planet + 0.01 * peak, planet, PLANET) == pytest.approx(40.0, abs=1e-9)
    assert psnr(planet, planet, PLANET) == math.inf
    # 1 % too bright is an error of 1 % of the window's rms.
    window = planet[7:18, 10:21]
    expected = 20 * math.log10(peak / (0.01 * math.sqrt((window**2).mean())))
    assert psnr(1.01 * planet, planet, PLANET) == pytest.approx(expected, abs=1e-9)
    nothing = psnr(0 * planet, planet, PLANET)
    assert nothing == pytest.approx(expected - 40, abs=1e-9)
    assert psnr(planet[::-1], planet, PLANET) < 40
