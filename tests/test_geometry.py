"""Pupil shapes: exact areas, orientation, smooth motion."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from astropy.io import fits

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument import TABULATED_GAP, jwst_pupil, jwst_segments, maskrnd_openings
from pyklip_diffrender.optics import (
    JWST_DIAMETER,
    PupilGrid,
    polygon_coverage,
    transform_polygons,
    widen_polygon,
)


def area(polygon):
    x, y = polygon.T
    return 0.5 * abs(float((x * y.roll(-1) - y * x.roll(-1)).sum()))


@pytest.mark.parametrize("npix", [7, 32, 101, 1024])
def test_coverage_has_the_exact_area(npix):
    grid = PupilGrid.full(npix)
    coverage = polygon_coverage(maskrnd_openings(), grid)
    expected = sum(area(polygon) for polygon in maskrnd_openings())
    # Sums of 1e6 areas in double precision.
    assert float(coverage.sum()) * grid.spacing**2 == pytest.approx(expected, rel=1e-12)
    assert coverage.min() >= 0
    assert coverage.max() <= 1 + 1e-12


def test_coverage_of_a_known_triangle():
    # Pixels of side 1 from -2 to 2; the triangle (-1, -1), (1, -1), (-1, 1) halves two of four.
    grid = PupilGrid.full(4, 4.0)
    triangle = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64)
    expected = torch.zeros(4, 4, dtype=torch.float64)
    expected[1, 1], expected[1, 2], expected[2, 1] = 1.0, 0.5, 0.5
    torch.testing.assert_close(polygon_coverage([triangle], grid), expected)


def test_coverage_in_a_window_is_the_window_of_the_coverage():
    full = PupilGrid.full(90)
    window = PupilGrid(90, JWST_DIAMETER, (20, 71), (33, 80))
    whole = polygon_coverage(maskrnd_openings(), full)
    torch.testing.assert_close(
        polygon_coverage(maskrnd_openings(), window), full.crop(whole, window), rtol=0, atol=1e-12
    )


def test_coverage_is_differentiable_in_shift_and_rotation():
    generator = torch.Generator().manual_seed(3)
    weight = torch.rand(30, 30, dtype=torch.float64, generator=generator)

    def total(shift, rotation):
        moved = transform_polygons(maskrnd_openings(), shift, rotation)
        return (weight * polygon_coverage(moved, PupilGrid.full(30))).sum()

    shift = torch.tensor([0.013, -0.021], dtype=torch.float64, requires_grad=True)
    rotation = torch.tensor(0.004, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(total, (shift, rotation), eps=1e-7, atol=1e-6)


def test_a_shift_by_whole_pixels_moves_the_array_to_plus_x_and_plus_y():
    grid = PupilGrid.full(128)
    still = polygon_coverage(maskrnd_openings(), grid)
    shift = torch.tensor([2.0, 3.0], dtype=torch.float64) * grid.spacing
    moved = polygon_coverage(
        transform_polygons(maskrnd_openings(), shift, torch.zeros((), dtype=torch.float64)), grid
    )
    torch.testing.assert_close(moved, still.roll((3, 2), dims=(0, 1)), rtol=0, atol=1e-10)


def test_a_positive_rotation_turns_plus_x_towards_plus_y():
    marker = [torch.tensor([[2.0, -0.1], [2.2, -0.1], [2.2, 0.1], [2.0, 0.1]], dtype=torch.float64)]
    quarter = torch.tensor(math.pi / 2, dtype=torch.float64)
    (turned,) = transform_polygons(marker, torch.zeros(2, dtype=torch.float64), quarter)
    np.testing.assert_allclose(turned.mean(dim=0), [0.0, 2.1], atol=1e-12)


def test_jwst_pupil_has_its_struts_where_the_telescope_has():
    pupil = jwst_pupil(256)
    middle = 128
    # One vertical strut above the centre, none straight below it, a hole in the middle.
    assert float(pupil[200, middle - 1 : middle + 1].max()) == 0.0
    assert float(pupil[60, middle]) == pytest.approx(1.0)
    assert float(pupil[middle, middle]) == 0.0
    # The geometric collecting area without the segments' rounding is 25.4 to 26 m^2.
    assert float(pupil.sum()) * (JWST_DIAMETER / 256) ** 2 == pytest.approx(25.77, abs=0.05)


def test_pupil_does_not_change_with_the_sampling():
    fine = jwst_pupil(1024).reshape(128, 8, 128, 8).mean(dim=(1, 3))
    torch.testing.assert_close(jwst_pupil(128), fine, rtol=0, atol=1e-9)


def test_widening_closes_the_gap_between_segments():
    outlines = list(jwst_segments().values())
    grown = [widen_polygon(p, TABULATED_GAP / 2) for p in outlines]
    gained = sum(map(area, grown)) - sum(map(area, outlines))
    perimeter = sum(float((p - p.roll(1, 0)).norm(dim=1).sum()) for p in outlines)
    assert gained == pytest.approx(perimeter * TABULATED_GAP / 2, rel=0.01)
    # A narrower gap lets more light through, all of it where the gaps were.
    assert float(jwst_pupil(128, 0.004).sum()) > float(jwst_pupil(128).sum())


@pytest.mark.parametrize("pupil", ["design", "flight"])
def test_lyot_stop_stays_inside_the_segments(pupil):
    """The openings hide segment edges and struts."""
    stop = polygon_coverage(maskrnd_openings(), PupilGrid.full(512))
    blocked = stop * (jwst_pupil(512, pupil=pupil) < 0.99)
    assert float(blocked.sum() / stop.sum()) < 0.005
    flipped = stop.flip(0) * (jwst_pupil(512, pupil=pupil) < 0.99)
    assert float(flipped.sum() / stop.sum()) > 0.05


def test_lyot_stop_is_where_the_official_one_is():
    """Area (m^2) and centre of gravity (m) of the official map, to the accuracy of contours.

    An earlier table was 0.184 m too high.
    """
    grid = PupilGrid.full(512)
    stop = polygon_coverage(maskrnd_openings(), grid)
    assert float(stop.sum() * grid.spacing**2) == pytest.approx(4.8725, rel=1e-3)
    x, y = float((stop.sum(0) * grid.x).sum()), float((stop.sum(1) * grid.y).sum())
    assert x / float(stop.sum()) == pytest.approx(0.0, abs=1e-3)
    assert y / float(stop.sum()) == pytest.approx(0.1359, abs=5e-4)


def test_obscurations_in_flight_are_only_about_the_struts():
    """A narrower vertical strut, and hinges beside all three: 0.1 % of the light."""
    difference = jwst_pupil(512, pupil="flight") - jwst_pupil(512)
    assert float(difference.abs().sum() / jwst_pupil(512).sum()) == pytest.approx(0.003, abs=0.0005)
    # Light is gained along the vertical strut, and lost beside the two below.
    assert float(difference[400:410, 250:262].max()) > 0.3
    assert float(difference[110:150, 170:200].min()) == -1.0
    assert float(difference[:, :160].abs().max()) == 0.0
    with pytest.raises(IncompatibleSetupError, match="'design' or 'flight'"):
        jwst_pupil(64, pupil="RevW")


def official(shared_data, file):
    path = shared_data / "stpsf-data" / file
    if not path.exists():
        pytest.skip(f"needs {path}")
    return torch.from_numpy(fits.getdata(path).astype(np.float64))


@pytest.mark.parametrize(
    ("shape", "file", "limit"),
    [
        ("stop", "NIRCam/optics/NIRCam_Lyot_Somb.fits.gz", 4e-3),
        ("design", "jwst_pupil_RevW_npix1024.fits.gz", 5e-4),
        ("flight", "jwst_pupil_flight_npix1024.fits.gz", 5e-4),
    ],
)
def test_outlines_are_those_of_the_official_maps(shared_data, shape, file, limit):
    """To what a contour of a sampled map can know; behind them images agree to 0.2 %."""
    truth = official(shared_data, file)
    truth = truth / truth.max()
    stop = shape == "stop"
    mine = (
        polygon_coverage(maskrnd_openings(), PupilGrid.full(1024))
        if stop
        else jwst_pupil(1024, pupil=shape)
    )

    def away(other):
        return float((mine - other).abs().sum() / truth.sum())

    assert away(truth) < limit
    assert away(truth.flip(0)) > 10 * limit
    if not stop:
        (other,) = {"design", "flight"} - {shape}
        assert float((jwst_pupil(1024, pupil=other) - truth).abs().sum() / truth.sum()) > 4 * limit


def test_crop_pads_with_zeros_where_the_window_sticks_out():
    small = PupilGrid(10, 1.0, (3, 6), (2, 7))
    large = PupilGrid(10, 1.0, (1, 9), (4, 10))
    values = torch.arange(15.0).reshape(3, 5) + 1
    placed = torch.zeros(10, 10)
    placed[3:6, 2:7] = values
    torch.testing.assert_close(small.crop(values, large), placed[1:9, 4:10])
