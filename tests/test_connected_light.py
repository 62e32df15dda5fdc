"""Extended light is told from point sources by its extent, however narrow it is."""

import numpy as np
import pytest

from pyklip_diffrender.detection.disk import ConnectedLight

RESOLUTION = 2.3


def connected(points=None, row=22, brightness=20.0):
    """Of sources with an S/N, and of those of a row, (48, 48)."""
    snr = np.zeros((48, 48))
    if row is not None:
        snr[row, 4:44] = brightness
    for place, value in (points or {}).items():
        snr[place] += value
    return ConnectedLight(snr, RESOLUTION)


def test_the_beam_keeps_the_peak_of_a_point_and_the_opening_takes_it():
    light = connected({(24, 24): 30.0}, row=None)
    assert light.smoothed[24, 24] == pytest.approx(30.0, rel=0.02)
    assert light.opened[24, 24] < 0.03 * 30
    assert not light.is_extended.any()
    assert not light.region.any()
    assert not connected(row=None).hides_points.any()


@pytest.mark.parametrize("angle", [0, 20, 77])
def test_a_narrow_line_is_extended_in_any_direction(angle):
    snr = np.zeros((48, 48))
    along, turn = np.arange(-15, 16), np.deg2rad(angle)
    places = np.round(24 + np.outer([np.sin(turn), np.cos(turn)], along)).astype(int)
    snr[tuple(places)] = 20.0
    light = ConnectedLight(snr, RESOLUTION)
    assert light.is_extended[snr > 0].all()
    assert light.region[snr > 0].all()
    assert light.opened[24, 24] > 0.6 * light.smoothed[24, 24]
    assert 0.05 < light.region.mean() < 0.2


def test_points_beside_a_line_are_none_of_it_and_those_next_to_it_are():
    """And what hides points is where one would count as extended: by adding it, row by row."""
    hides = connected().hides_points[:, 24]
    for row in range(22, 31):
        assert connected({(row, 24): 5.0}).is_extended[row, 24] == hides[row]
    away = connected({(32, 24): 30.0})
    assert not away.is_extended[32, 24]
    assert away.is_extended[22, 24]
    assert connected({(24, 24): 30.0}).is_extended[24, 24]
    reach = np.flatnonzero(hides)
    assert reach.min() >= 22 - 2.3 * RESOLUTION
    assert 24 <= reach.max() <= 22 + 2.3 * RESOLUTION


@pytest.mark.parametrize(("brightness", "expected"), [(0.3, False), (0.9, False), (20.0, True)])
def test_the_faintest_region(brightness, expected):
    """Neighbours add to 2.4 in the beam: the second is brighter than 1, but nowhere than 3."""
    assert connected(brightness=brightness).region.any() == expected


def test_errors_of_the_model_about_a_bright_source_are_no_extended_light():
    assert connected().is_extended[22].any()
    assert not connected({(40, 24): 1000.0}).is_extended.any()
