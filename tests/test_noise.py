"""Errors of real frames, calibrated far from the star."""

import numpy as np
import pytest

from pyklip_diffrender.scene.integrations import calibrated_errors

SCALE = (0.063, 0.063)
CENTER = np.array([[150.0, 150.0]])


def frames(noise, stated):
    """A star with photon noise on a background of constant noise, and the errors of a file."""
    y, x = np.indices((300, 300))
    distance = np.hypot(x - 150, y - 150)
    star = 400.0 / (1 + (distance / 8) ** 3)
    generator = np.random.default_rng(5)
    photon = 0.2 * np.sqrt(star)
    data = star + generator.normal(size=star.shape) * np.hypot(noise, photon)
    return data[None], np.hypot(stated, photon)[None], photon[None]


@pytest.mark.parametrize("noise", [0.3, 0.8])
def test_the_constant_part_of_the_errors_is_measured_whatever_the_outliers(noise):
    data, error, photon = frames(noise, 0.5)
    valid = np.ones(data.shape, bool)
    found, _ = calibrated_errors(data, error, valid, CENTER, SCALE)
    np.testing.assert_allclose(found, np.hypot(noise, photon), rtol=0.03)
    data[0, 5:15, 40:60] += 50.0  # A background source.
    valid[0, 20, ::7] = False
    data[~valid] = 0.0
    found, _ = calibrated_errors(data, error, valid, CENTER, SCALE)
    np.testing.assert_allclose(found[valid], np.hypot(noise, photon)[valid], rtol=0.04)
    np.testing.assert_array_equal(found[~valid], error[~valid])


def test_frames_without_far_pixels_keep_their_errors():
    data, error, _ = frames(0.3, 0.5)
    near = (slice(None), slice(110, 190), slice(110, 190))
    valid = np.ones((1, 80, 80), bool)
    found, ratios = calibrated_errors(data[near], error[near], valid, CENTER - 110, SCALE)
    np.testing.assert_array_equal(found, error[near])
    assert np.isnan(ratios).all()
