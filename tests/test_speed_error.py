"""The benchmark of speed and error: its tables, and small versions of its measurements."""

from __future__ import annotations

import pytest

from benchmarks import speed_error
from benchmarks.speed.setting import Setting


@pytest.mark.slow
def test_small_measurements_are_less_wrong_with_more_samples():
    setting = Setting(quick=True)
    images = speed_error.image_points(setting, 0.01)
    gradients = speed_error.gradient_points(setting, 0.01)
    for points in (images, gradients):
        assert all(point.seconds > 0 for point in points)
        for way in ("fewer samples across the pupil", "change of a fine image, on fewer samples"):
            errors = [point.error for point in points if point.way == way]
            assert errors == sorted(errors, reverse=True)
            assert errors[0] > 2 * errors[-1]
    # The finest model is the truth but for the sampling of the occulter.
    (finest,) = (p for p in images if p.setting == "128 samples" and p.way.startswith("fewer"))
    assert finest.error < 1e-3
