"""Bad pixels that the file does not flag, told from planets by their neighbours."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import pyklip_diffrender as dr
from pyklip_diffrender.refinement import refine_again

SIZE, NPIX, SCENE = 32, 64, 5
PIXEL = (9, 21)
"""Row and column of the bad pixel, 0.55 arcsec from the star."""

SETTINGS = dr.FitSettings(cycles=6.0, response_npix=NPIX, companions_if_stalled=False)
"""With a model error that is allowed for, fits do not look for companions by themselves."""


@cache
def model(name="F444W"):
    wavelength = {"F444W": 4.5e-6, "F250M": 2.5e-6}[name]
    size = {"npix": NPIX, "fov_pixels": SIZE, "fov_arcsec": None}
    return dr.nircam_coronagraph(name, monochromatic=wavelength, **size)


@cache
def start():
    return dr.wavefront.random_opd(1, npix=NPIX)


def shot(*planets, seed=SCENE, name="F444W"):
    return dr.simulate(model(name), dr.Scene(planets=planets), start(), seed=seed)


def spoiled(frame, sigmas):
    data = frame.data.copy()
    data[0][PIXEL] += sigmas * frame.error[0][PIXEL]
    return replace(frame, data=data)


def fitted(*frames, name="F444W", **changes):
    return dr.refine(model(name), list(frames), start(), settings=replace(SETTINGS, **changes))


def left_out(fit, k=0):
    return [tuple(each) for each in np.argwhere(~fit.frames[k].observation.valid[0]).tolist()]


def here(*, row=PIXEL[0], column=PIXEL[1], contrast):
    """A planet at a place on the frame, in pixels."""
    x, y = (np.array([column, row]) - (SIZE - 1) / 2) * np.array(model().detector.pixelscale)
    return dr.Planet.from_offset(contrast, float(x), float(y))


def test_a_hot_pixel_is_no_planet():
    frame = spoiled(shot(), 25.0)
    before = frame.data.copy(), frame.valid.copy()
    fit = fitted(frame)
    assert left_out(fit) == [PIXEL]
    assert len(dr.detect(fit).candidates) == 0
    assert fit.reduced_chi2 == pytest.approx(1.0, abs=0.15)
    np.testing.assert_array_equal(frame.data, before[0])
    np.testing.assert_array_equal(frame.valid, before[1])
    # Fits that go on do not get it back.
    again = refine_again(fit)
    assert left_out(again) == [PIXEL]
    assert again.chi2_per_pixel == pytest.approx(fit.chi2_per_pixel, rel=0.01)


@pytest.mark.parametrize("sigmas", [-60.0, 1000.0])
def test_the_star_is_fitted_without_a_bad_pixel(sigmas):
    """Chi-squared per pixel is 4 and 400 if it stays, and the latter has the wavefront fitted."""
    frame = spoiled(shot(), sigmas)
    fit = fitted(frame)
    assert left_out(fit) == [PIXEL]
    assert fit.chi2_per_pixel == pytest.approx(1.0, abs=0.1)
    good = fit.frames[0].observation.valid[0]
    pulls = ((frame.data[0] - fit.frames[0].star) / frame.error[0])[good]
    assert pulls.std() == pytest.approx(1.0, abs=0.1)


def test_a_pixel_that_the_fit_took_for_a_companion():
    assert left_out(fitted(spoiled(shot(), 40.0), companions=(here(contrast=3e-6),))) == [PIXEL]


def test_a_bright_companion_of_the_fit_keeps_its_core():
    """Its model is wrong by more than the noise, and its own unknowns explain any source there."""
    planet = here(contrast=1e-4)
    fit = fitted(spoiled(shot(planet), 15.0), companions=(planet,))
    assert left_out(fit) == []
    assert fit.companions[0, 0] == pytest.approx(1e-4, rel=0.1)


def test_a_hot_pixel_on_a_planet_is_left_out():
    """It would make the planet brighter and move it. Only the frame that shows it loses it."""
    planet = here(row=PIXEL[0] + 0.3, column=PIXEL[1] - 0.2, contrast=4e-6)
    frames = [shot(planet), spoiled(shot(planet, seed=SCENE + 1), 25.0)]
    fit = fitted(*frames, companions=(planet,))
    assert (left_out(fit, 0), left_out(fit, 1)) == ([], [PIXEL])
    assert fit.companions[0, 0] == pytest.approx(4e-6, abs=4 * fit.companion_errors[0, 0])


@pytest.mark.parametrize(
    ("name", "shift", "contrast"),
    [
        ("F444W", (0.5, 0.3), 2e-6),
        # An image that is hardly wider than a pixel.
        ("F250M", (0.0, 0.0), 2e-6),
        # Fits that do not have the planet take many steps.
        pytest.param("F250M", (0.25, 0.25), 1e-4, marks=pytest.mark.slow),
    ],
)
def test_planets_are_kept(name, shift, contrast):
    planet = here(row=PIXEL[0] + shift[0], column=PIXEL[1] + shift[1], contrast=contrast)
    frame, without = shot(planet, name=name), shot(name=name)
    assert ((frame.data - without.data) / frame.error).max() > 8
    assert left_out(fitted(frame, name=name)) == []
