"""Simulated scenes: the paper's photons, where planets appear, noise."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.refinement import FitSettings, refine
from pyklip_diffrender.scene.objects import ALPHA_PICTORIS_W2, UNOCCULTED_PEAK, Planet, Scene, Star
from pyklip_diffrender.scene.simulation import (
    expected_photons,
    planet_photons,
    simulate,
    star_photons,
)
from pyklip_diffrender.wavefront import random_opd

WAVELENGTH = 4.5e-6
NPIX = 96


@pytest.fixture(scope="module")
def model():
    return nircam_coronagraph("F444W", monochromatic=WAVELENGTH, npix=NPIX, fov_pixels=(32, 36))


@pytest.fixture(scope="module")
def opd():
    return random_opd(5, npix=NPIX).data


def test_the_papers_star_sends_the_papers_photons():
    assert Star().peak_photons == pytest.approx(1.0334e10, rel=2e-4)
    assert Star().photons == pytest.approx(2.7807e12, rel=2e-4)


def test_photons_follow_magnitude_and_exposure():
    star = Star()
    for changes, factor in (
        ({"w2_magnitude": star.w2_magnitude + 2.5}, 1 / 10),
        ({"exposure": 400.0}, 1 / 18),
        ({"w2_magnitude": ALPHA_PICTORIS_W2, "exposure": 400.0}, 10 ** (0.4 * 2.203) / 18),
    ):
        assert replace(star, **changes).photons == pytest.approx(factor * star.photons, rel=1e-12)


def test_the_unocculted_star_has_the_papers_peak():
    """Contrast 1 is the brightest pixel with the Lyot stop and without the occulter.

    How much falls there depends on where in the pixel the star is: the corner or the middle.
    """
    peak = {}
    for count in (80, 81):
        model = nircam_coronagraph(
            "F444W", monochromatic=WAVELENGTH, npix=512, fov_pixels=count, image_mask=None,
            segment_gap=0.0,
        )  # fmt: skip
        peak[count] = float(model(random_opd(1, npix=512).data).max())
    assert 0.93 * UNOCCULTED_PEAK < peak[80] < UNOCCULTED_PEAK < peak[81] < 1.08 * UNOCCULTED_PEAK


@pytest.mark.parametrize(
    ("angle", "direction"), [(0, (0, 1)), (90, (-1, 0)), (180, (0, -1)), (270, (1, 0))]
)
def test_position_angle_is_counter_clockwise_from_up(angle, direction):
    offset = 0.8 * np.array(direction)
    np.testing.assert_allclose(Planet(1e-6, 0.8, angle).offset, offset, atol=1e-15)
    planet = Planet.from_offset(1e-4, *offset)
    assert planet.position_angle % 360 == pytest.approx(angle)
    assert planet.offset == pytest.approx(tuple(offset), abs=1e-12)


@pytest.mark.parametrize("angle", [20.0, 200.0])
def test_a_planet_appears_where_it_was_put(model, opd, angle):
    scene = Scene(star_offset=(0.05, -0.03))
    image = planet_photons(model, scene, Planet(1e-3, 0.75, angle), opd)
    scale = model.detector.pixelscale[0]
    ny, nx = image.shape
    # Up is +y (rows), left is -x: angles from up to the left.
    expected_x = (nx - 1) / 2 + (0.05 - 0.75 * np.sin(np.radians(angle))) / scale
    expected_y = (ny - 1) / 2 + (-0.03 + 0.75 * np.cos(np.radians(angle))) / scale
    y, x = np.indices(image.shape)
    core = np.hypot(x - expected_x, y - expected_y) < 2.5
    total = image[core].sum()
    assert float((image * x)[core].sum() / total) == pytest.approx(expected_x, abs=0.35)
    assert float((image * y)[core].sum() / total) == pytest.approx(expected_y, abs=0.35)
    brightest = np.unravel_index(image.argmax(), image.shape)
    assert np.hypot(*np.subtract(brightest, (expected_y, expected_x))) < 1.0


def test_planets_whose_copies_would_be_in_the_field_are_refused(model, opd):
    """Such as those whose separation is in mas. One at a whole period appears on the star."""
    # lambda / D of the sampled pupil, 6.6 m, times the number of samples.
    period = NPIX * WAVELENGTH / model.diameter * 206264.8
    near, copied = (
        planet_photons(model, Scene(), Planet(1.0, separation, 90.0), opd)
        for separation in (0.4, period - 0.4)
    )
    # The copy is on the other side of the star, behind the same mask.
    assert copied.sum() > 0.5 * near.sum()
    for separation in (period - 0.4, 500.0):
        scene = Scene(planets=(Planet(1e-3, separation, 90.0),))
        with pytest.raises(IncompatibleSetupError, match=r"scene: got a planet at .* 500 \* u.mas"):
            simulate(model, scene, opd, seed=1)
        settings = FitSettings(cycles=6, companions=scene.planets)
        frame = simulate(model, Scene(), opd, seed=1)
        with pytest.raises(IncompatibleSetupError, match=r"companions: got a planet at"):
            refine(model, frame, opd, settings=settings)
    simulate(model, Scene(planets=(Planet(1e-3, period - 1.5, 90.0),)), opd, seed=1)


def test_a_scene_is_the_sum_of_its_parts(model, opd):
    planets = (Planet(1e-5, 0.6, 54), Planet(2e-6, 0.7, 58))
    scene = Scene(planets=planets, background=321.0, star_offset=(0.01, 0.0))
    parts = star_photons(model, scene, opd) + 321.0
    parts = parts + sum(planet_photons(model, scene, p, opd) for p in planets)
    total = expected_photons(model, scene, opd)
    np.testing.assert_allclose(total, parts, rtol=1e-12)
    one, faint = (planet_photons(model, scene, Planet(c, 0.6, 54), opd) for c in (1e-5, 1e-10))
    np.testing.assert_allclose(faint, 1e-5 * one, rtol=1e-12)
    # A brighter star, and its planets with it: contrasts are relative.
    brighter = replace(scene, star=replace(scene.star, w2_magnitude=2.182), background=0.0)
    seen = expected_photons(model, brighter, opd)
    np.testing.assert_allclose(seen, (total - 321.0) * 10**0.4, rtol=1e-9)


def test_noise_has_the_mean_and_variance_of_photons_and_readout():
    model = nircam_coronagraph("F444W", monochromatic=WAVELENGTH, npix=48, fov_pixels=12)
    # From 1e2 to 1e5 photons: readout matters in some pixels, photons in others.
    scene = Scene(star=Star(exposure=20.0), background=100.0)
    opd = random_opd(5, npix=48).data
    expected = expected_photons(model, scene, opd)
    assert expected.max() > 30 * expected.min()
    count = 4000
    frames = simulate(model, scene, opd, seed=3, frames=count).data
    variance = expected + 42.0**2
    away = (frames.mean(axis=0) - expected) / np.sqrt(variance / count)
    # 144 standard normal numbers: their rms is 1 +- 0.06.
    assert np.sqrt(np.mean(away**2)) == pytest.approx(1.0, abs=0.25)
    assert abs(np.mean(away)) < 4 / np.sqrt(away.size)
    ratio = frames.var(axis=0, ddof=1) / variance
    # Each ratio is 1 +- sqrt(2 / 4000), their mean 1 +- 0.002.
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.006)
    assert np.abs(ratio - 1).max() < 5 * np.sqrt(2 / count)
    # Frames and pixels are independent.
    residual = (frames - expected) / np.sqrt(variance)
    assert abs(np.mean(residual[1:] * residual[:-1])) < 5 / np.sqrt(residual.size)
    assert abs(np.mean(residual[:, 1:] * residual[:, :-1])) < 5 / np.sqrt(residual.size)


@pytest.mark.hard
def test_a_simulation_says_what_it_is_and_the_same_seed_gives_the_same_frames(model, opd):
    scene = Scene(planets=(Planet(1e-5, 0.6, 54),))
    got, again, other = (simulate(model, scene, opd, seed=s, frames=3) for s in (8, 8, 9))
    assert got.data.tobytes() == again.data.tobytes()
    assert not np.array_equal(got.data, other.data)
    assert not np.array_equal(got.data[0], got.data[1])
    assert got.data.shape == (3, 32, 36)
    assert (got.unit, got.filter) == (u.photon, "F444W")
    assert got.pixelscale == model.detector.pixelscale
    assert got.valid.all()
    assert "seed=8" in got.name
    np.testing.assert_array_equal(got.center, [[17.5, 15.5]] * 3)
    np.testing.assert_allclose(got.error, np.sqrt(np.maximum(got.data, 0) + 42.0**2), rtol=1e-14)
