"""Completeness: the fraction of planets that a search finds."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

import pyklip_diffrender as dr
from pyklip_diffrender.detection import contrast_of_completeness, with_planets
from pyklip_diffrender.errors import IncompatibleSetupError


@cache
def searched():
    """A star alone, of which the model is exact."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    opd = dr.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(), opd, seed=3)
    return dr.detect(dr.refine(model, frame, opd, settings=dr.GaussNewton(cycles=6)))


def test_half_of_the_planets_at_the_limit_are_found():
    """Noise is Gaussian: S/N of planets at the limit is 5 on average, and symmetric about it."""
    table = dr.completeness(
        searched(), separations=[0.5] * u.arcsec, strengths=[0.5, 1.0, 2.0], angles=20
    )
    assert list(table["planets"]) == [20] * 3
    faint, half, bright = table["completeness"]
    # S/N 2.5 and 10 on average; it varies with the angle, and between pixel centres.
    assert faint <= 0.05
    assert bright == 1
    # The standard deviation of the fraction of 20 planets is 0.11.
    assert 0.2 < half < 0.8
    curve = searched().contrast_curve
    limit = np.interp(0.5, curve["separation"].value, curve["small_sample"])
    assert table["contrast"][1] == pytest.approx(limit, rel=0.02)
    assert 0.7 < table.meta["contrast_50"][0] / limit < 1.3
    assert 0 < table.meta["false_alarm"] < 1e-3


@pytest.mark.slow
def test_planets_are_found_where_full_fits_find_them():
    """A planet in the frames, everything fitted again: as in the maps to first order."""
    detection = searched()
    frames = detection.fits[0].frames
    for strength, expected in ((0.5, False), (1.5, True)):
        table = dr.completeness(detection, separations=[0.6], strengths=[strength], angles=4)
        contrast, fraction = float(table["contrast"][0]), float(table["completeness"][0])
        found = 0
        for angle in 90.0 * np.arange(4):
            observation = with_planets(frames, [dr.Planet(contrast, 0.6, angle)])
            fit = dr.refine(
                detection.fits[0].model, observation, detection.fits[0].initial,
                settings=dr.GaussNewton(cycles=6),
            )  # fmt: skip
            found += len(dr.detect(fit).candidates)
        assert found / 4 == pytest.approx(fraction, abs=0.26)  # One planet of four.
        assert (found > 2) == expected


def test_the_contrast_of_a_fraction_is_interpolated():
    table = QTable(
        {
            "separation": np.repeat([0.4, 0.8], 3) * u.arcsec,
            "contrast": [1e-5, 2e-5, 4e-5] * 2,
            "completeness": [0.0, 0.4, 0.8, 0.6, 0.5, 0.7],
        }
    )
    half = contrast_of_completeness(table, 0.5)
    assert list(half["separation"].value) == [0.4, 0.8]
    # A quarter of the way from 0.4 to 0.8, in the logarithm; and more than half from the first on.
    assert half["contrast"][0] == pytest.approx(2e-5 * 2**0.25)
    assert np.isnan(half["contrast"][1])
    assert np.isnan(contrast_of_completeness(table, 0.95)["contrast"]).all()


def test_without_fits_there_is_no_completeness(tmp_path):
    path = next(each for each in searched().write(tmp_path) if each.suffix == ".fits")
    with pytest.raises(IncompatibleSetupError, match="without its fits"):
        dr.completeness(dr.Detection.read(path))
