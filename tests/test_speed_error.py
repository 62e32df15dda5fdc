"""The benchmark of speed and error: its tables, and small versions of its measurements."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import speed_error
from benchmarks.speed.setting import Setting
from benchmarks.speed_error import TITLES, Point, as_table, draw


def test_a_figure_has_a_panel_for_each_task_and_a_line_for_each_way():
    points = [
        Point(what, way, f"{k}", 10.0**k, 10.0**-k)
        for what in ("image", "gradient", "fit", "reduction")
        for way in ("fewer samples across the pupil", "KLIP")
        for k in range(3)
    ]
    figure = draw(as_table(points, "python -m benchmarks.speed_error"))
    assert [ax.get_title() for ax in figure.axes] == [
        TITLES[each] for each in ("image", "gradient", "fit", "reduction")
    ]
    for ax in figure.axes:
        lines = [line for line in ax.get_lines() if len(line.get_xdata()) == 3]
        assert len(lines) == 2
        np.testing.assert_allclose(lines[0].get_ydata(), [1, 0.1, 0.01])


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
