"""Extended light is told from point sources by its extent, however narrow it is."""

from __future__ import annotations

import numpy as np
import pytest

from pyklip_diffrender.detection.disk import ConnectedLight

RESOLUTION = 2.3


def image(points=None, row=None):
    """S/N of sources, with those of a row 20 each, (48, 48)."""
    snr = np.zeros((48, 48))
    if row is not None:
        snr[row, 4:44] = 20.0
    for place, value in (points or {}).items():
        snr[place] = value
    return snr


def test_the_beam_keeps_the_peak_of_a_point_and_the_opening_takes_it():
    light = ConnectedLight(image({(24, 24): 30.0}), RESOLUTION)
    assert light.smoothed[24, 24] == pytest.approx(30.0, rel=0.02)
    assert light.opened[24, 24] < 0.03 * 30
    assert not light.is_extended.any()
    assert not light.region.any()
    assert not ConnectedLight(image(), RESOLUTION).hides_points.any()


@pytest.mark.parametrize("angle", [0, 20, 45, 77, 90])
def test_a_narrow_line_is_extended_in_any_direction(angle):
    snr = np.zeros((48, 48))
    along = np.arange(-15, 16)
    turn = np.deg2rad(angle)
    snr[np.round(24 + along * np.sin(turn)).astype(int),
        np.round(24 + along * np.cos(turn)).astype(int)] = 20.0  # fmt: skip
    light = ConnectedLight(snr, RESOLUTION)
    assert light.is_extended[snr > 0].all()
    assert light.region[snr > 0].all()
    assert light.opened[24, 24] > 0.6 * light.smoothed[24, 24]
    assert 0.05 < light.region.mean() < 0.2


def test_points_beside_a_line_are_none_of_it_and_those_next_to_it_are():
    away = ConnectedLight(image({(32, 24): 30.0}, row=22), RESOLUTION)
    assert not away.is_extended[32, 24]
    assert away.is_extended[22, 24]
    near = ConnectedLight(image({(24, 24): 30.0}, row=22), RESOLUTION)
    assert near.is_extended[24, 24]
    # What is said of a source before there is one.
    hides = ConnectedLight(image(row=22), RESOLUTION).hides_points
    assert hides[24, 24]
    assert not hides[32, 24]
    reach = np.flatnonzero(hides[:, 24])
    assert reach.min() >= 22 - 2.3 * RESOLUTION
    assert reach.max() <= 22 + 2.3 * RESOLUTION


def test_what_hides_points_is_where_one_would_count_as_extended():
    """By adding it, at every tenth pixel; its own light on both sides of the estimate differs."""
    snr = image(row=22)
    hides = ConnectedLight(snr, RESOLUTION).hides_points
    for row in range(14, 31):
        added = snr.copy()
        added[row, 24] += 5.0
        actual = ConnectedLight(added, RESOLUTION).is_extended[row, 24]
        assert actual == hides[row, 24]


@pytest.mark.parametrize(("brightness", "expected"), [(0.3, False), (0.9, False), (20.0, True)])
def test_the_faintest_region(brightness, expected):
    """Neighbours add to 2.4 in the beam: the second is brighter than 1, but nowhere than 3."""
    assert ConnectedLight(image(row=22) * brightness / 20, RESOLUTION).region.any() == expected


def test_errors_of_the_model_about_a_bright_source_are_no_extended_light():
    line = ConnectedLight(image(row=22), RESOLUTION)
    assert line.is_extended[22].any()
    beside = ConnectedLight(image({(40, 24): 1000.0}, row=22), RESOLUTION)
    assert not beside.is_extended.any()
