"""Pupil shapes: exact areas, orientation, smooth motion."""

import math

import numpy as np
import pytest
import torch
from astropy.io import fits

from pyklip_diffrender.instrument.masks import jwst_pupil, lyot_openings
from pyklip_diffrender.optics.grid import (
    JWST_DIAMETER,
    PupilGrid,
    polygon_coverage,
    transform_polygons,
)


def area(polygon):
    x, y = polygon.T
    return 0.5 * abs(float((x * y.roll(-1) - y * x.roll(-1)).sum()))


@pytest.mark.parametrize("npix", [7, 101])
def test_coverage_has_the_exact_area(npix):
    grid = PupilGrid.full(npix)
    coverage = polygon_coverage(lyot_openings("MASKRND"), grid)
    expected = sum(map(area, lyot_openings("MASKRND")))
    assert float(coverage.sum()) * grid.spacing**2 == pytest.approx(expected, rel=1e-12)
    assert coverage.min() >= 0
    assert coverage.max() <= 1 + 1e-12


def test_coverage_in_a_window_is_the_window_of_the_coverage():
    full = PupilGrid.full(90)
    window = PupilGrid(90, JWST_DIAMETER, (20, 71), (33, 80))
    whole = polygon_coverage(lyot_openings("MASKRND"), full)
    found = polygon_coverage(lyot_openings("MASKRND"), window)
    torch.testing.assert_close(found, full.crop(whole, window), rtol=0, atol=1e-12)


def test_a_shift_moves_to_plus_x_and_plus_y_and_a_rotation_turns_x_towards_y():
    grid = PupilGrid.full(128)
    still = polygon_coverage(lyot_openings("MASKRND"), grid)
    shift, zero = torch.tensor([2.0, 3.0], dtype=torch.float64) * grid.spacing, torch.zeros(2)
    moved = polygon_coverage(
        transform_polygons(lyot_openings("MASKRND"), shift, zero[0].double()), grid
    )
    torch.testing.assert_close(moved, still.roll((3, 2), dims=(0, 1)), rtol=0, atol=1e-10)
    marker = torch.tensor([[2.0, -0.1], [2.2, -0.1], [2.2, 0.1], [2.0, 0.1]], dtype=torch.float64)
    quarter = torch.tensor(math.pi / 2, dtype=torch.float64)
    (turned,) = transform_polygons([marker], zero.double(), quarter)
    np.testing.assert_allclose(turned.mean(dim=0), [0.0, 2.1], atol=1e-12)


def test_jwst_pupil_has_its_struts_where_the_telescope_has():
    pupil = jwst_pupil(256)
    # One vertical strut above the centre, none straight below it, a hole in the middle.
    assert float(pupil[200, 127:129].max()) == 0.0
    assert float(pupil[60, 128]) == pytest.approx(1.0)
    assert float(pupil[128, 128]) == 0.0
    # The geometric collecting area without the segments' rounding is 25.4 to 26 m^2.
    assert float(pupil.sum()) * (JWST_DIAMETER / 256) ** 2 == pytest.approx(25.77, abs=0.05)


def test_lyot_stop_is_where_the_official_one_is():
    """Area (m^2) and centre of gravity (m) of the official map, to the accuracy of contours."""
    grid = PupilGrid.full(512)
    stop = polygon_coverage(lyot_openings("MASKRND"), grid)
    assert float(stop.sum() * grid.spacing**2) == pytest.approx(4.8725, rel=1e-3)
    x, y = float((stop.sum(0) * grid.x).sum()), float((stop.sum(1) * grid.y).sum())
    assert x / float(stop.sum()) == pytest.approx(0.0, abs=1e-3)
    assert y / float(stop.sum()) == pytest.approx(0.1359, abs=5e-4)


@pytest.mark.parametrize(
    ("shape", "file", "limit"),
    [
        ("stop", "NIRCam/optics/NIRCam_Lyot_Somb.fits.gz", 4e-3),
        ("design", "jwst_pupil_RevW_npix1024.fits.gz", 5e-4),
    ],
)
def test_outlines_are_those_of_the_official_maps(official_files, shape, file, limit):
    """To what a contour of a sampled map can know; behind them images agree to 0.2 %."""
    truth = torch.from_numpy(fits.getdata(official_files / file).astype(np.float64))
    truth = truth / truth.max()
    stop = polygon_coverage(lyot_openings("MASKRND"), PupilGrid.full(1024))
    mine = stop if shape == "stop" else jwst_pupil(1024)

    def away(one, other=truth):
        return float((one - other).abs().sum() / truth.sum())

    assert away(mine) < limit
    assert away(mine, truth.flip(0)) > 10 * limit
