"""Companions of fits, compared with the candidates of a search, and planets that a fit hides."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import pyklip_diffrender as dr
from benchmarks.planets import searched
from pyklip_diffrender.detection.candidates import (
    Candidates,
    lacks_candidates,
    unconfirmed_companions,
)

FOUND = Candidates.at([[0.6, 0.3]], [3e-4])


def fit(*companions, turned=0.0, reference=False):
    """A fit of lambda/D = 0.14 arcsec; its first frame is turned by so many degrees."""
    observation = SimpleNamespace(
        reference=reference, angle=turned, roll_from=lambda other: turned - other.angle
    )
    array = np.reshape(companions, (-1, 3)).astype(float)
    return SimpleNamespace(
        frames=(SimpleNamespace(observation=observation),),
        companions=array,
        companion_errors=np.tile([1e-6, 1e-3, 1e-3], (len(array), 1)),
        model=SimpleNamespace(resolution=0.14),
    )


@pytest.mark.parametrize(
    ("companions", "lacks", "unconfirmed"),
    [
        ([(3e-4, 0.6, 0.3)], False, False),
        # A speckle in place of the planet, which a count would not notice.
        ([(3e-4, -0.6, 0.3)], True, True),
        # At the right place with a fifth more light.
        ([(3.62e-4, 0.6, 0.3)], True, True),
        ([(3.1e-4, 0.61, 0.3)], False, False),
        ([], True, False),
        ([(3e-4, 0.6, 0.3), (1e-5, -0.6, 0.3)], True, True),
    ],
)
def test_companions_are_compared_by_place_and_contrast(companions, lacks, unconfirmed):
    fits = [fit(*companions)]
    assert lacks_candidates(fits, FOUND) is lacks
    assert (len(unconfirmed_companions(fits, FOUND)) > 0) is unconfirmed


def test_every_fit_has_an_orientation_of_its_own():
    """Turned by 90 degrees counter-clockwise, (x, y) becomes (-y, x)."""
    turned = fit((3e-4, -0.3, 0.6), turned=90.0)
    assert not lacks_candidates([fit((3e-4, 0.6, 0.3)), turned], FOUND)
    assert lacks_candidates([fit((3e-4, 0.6, 0.3)), fit((3e-4, 0.6, 0.3), turned=90.0)], FOUND)


def test_fits_of_reference_stars_have_no_candidates():
    assert not lacks_candidates([fit((3e-4, 0.6, 0.3)), fit(reference=True)], FOUND)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "cycles"),
    [
        pytest.param(27, (12,), id="1.2e-3 at 0.26 arcsec, which bends the wavefront"),
        # Bright companions show finer modes than the star, whose light they would move off the
        # frame.
        pytest.param(34, (24,), id="1e-2 at 1 arcsec, brighter than the star's residual"),
        pytest.param(38, (16,), id="3e-4 at 0.21 arcsec, behind a spurious candidate"),
        pytest.param(183, (24,), id="7e-3 at 1 arcsec, which outshines a star at the wrong place"),
        pytest.param(74, (24,), id="0.08 at 0.48 arcsec, brighter than the star behind the mask"),
    ],
)
def test_a_planet_that_ends_a_fit_at_a_wrong_wavefront_is_found(seed, cycles):
    outcome = searched(seed, cycles=cycles)
    assert outcome.verdict == "found", outcome.scene
    assert not outcome.false
    # The errors of bright companions are those of the star's flux, about 0.1 %.
    assert abs(outcome.pull) < 4


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [0.0, 1e-3])
def test_a_companion_that_was_an_error_of_the_wavefront_is_dropped(contrast, caplog):
    """The alignment alone leaves peaks, which the wavefront explains; a planet stays."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=128, fov_pixels=28)
    before, change = (dr.random_opd(k, npix=128) for k in (8, 9))
    now = replace(before, data=before.data + 0.2 * change.data)
    scene = dr.Scene(planets=(dr.Planet(contrast, 0.6, 70.0),))
    frame = dr.simulate(model, scene, now, seed=5)
    preset = dr.GaussNewton.nircam(
        "F444W", cycles=(9.0,), max_iterations=12, companion_threshold=2.0
    )
    with caplog.at_level("INFO", logger="pyklip_diffrender"):
        fit = dr.refine(model, frame, before, settings=preset)
    assert "possible sources" in caplog.text
    assert ("are dropped" in caplog.text) == (contrast == 0)
    assert fit.companions[:, 0].tolist() == pytest.approx([contrast] if contrast else [], rel=0.05)


def test_a_companion_that_outshines_the_star_is_fitted_with_it():
    """Fitted alone, the star's flux would be negative. Few modes leave an error of 2 %."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=128, fov_pixels=28)
    before, change = (dr.random_opd(k, npix=128) for k in (8, 9))
    now = replace(before, data=before.data + 0.1 * change.data)
    planet = dr.Planet(0.08, 0.6, 70.0)
    frame = dr.simulate(model, dr.Scene(planets=(planet,)), now, seed=5)
    assert model(now).max() < planet.contrast * model(now, planet.offset).max()
    fit = dr.refine(model, frame, before, settings=dr.GaussNewton(cycles=3, max_iterations=6))
    (companion,) = fit.companions
    assert companion[0] == pytest.approx(planet.contrast, rel=0.03)
    assert companion[1:] == pytest.approx(planet.offset, abs=0.002)
    assert fit.model_error < 0.02
