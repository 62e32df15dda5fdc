"""Extended light fitted together with the star, on two simulated rolls of a star with a ring."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from astropy.io import fits as astropy_fits
from astropy.wcs import WCS
from matplotlib import pyplot
from matplotlib.contour import ContourSet
from scipy.optimize import nnls

import pyklip_diffrender as dr
from pyklip_diffrender.detection import disk as module
from pyklip_diffrender.detection.templates import groups_of
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.wavefront import random_drift

ROLLS = (20.0, 32.0)
STAR = dr.Star(w2_magnitude=5.5)
BRIGHTNESS, POSITION_ANGLE = 1e-4, 75.0
OPTIONS = {"monochromatic": 4.5e-6, "npix": 128, "fov_pixels": 48}


def ring(model, opd, position_angle, points=40):
    """Photons of a ring as bright as the star, its long axis at an angle from +y, (ny, nx)."""
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
    along, across = 0.95 * np.cos(angle), 0.3 * np.sin(angle)
    turn = np.deg2rad(position_angle)
    x = across * np.cos(turn) - along * np.sin(turn)
    y = across * np.sin(turn) + along * np.cos(turn)
    with torch.no_grad():
        images = [model(opd, offset).numpy() for offset in zip(x, y, strict=True)]
    return np.asarray(STAR.photons * np.mean(images, axis=0))


@cache
def rolls(brightness):
    """Two rolls of the star, and the light of its ring in them."""
    model = dr.nircam_coronagraph("F444W", **OPTIONS)
    actual = dr.random_opd(1, npix=128).data + random_drift(3, hours=40, npix=128).data
    frames, rings = [], []
    rng = np.random.default_rng(1)
    for k, roll in enumerate(ROLLS):
        rings.append(brightness * ring(model, actual, POSITION_ANGLE - roll))
        starlight = dr.simulate(model, dr.Scene(star=STAR), actual, seed=4 + k)
        counts = starlight.data[0] + rng.poisson(rings[k])
        error = np.sqrt(np.maximum(counts, 0) + dr.Scene().read_noise ** 2)
        frame = dr.Observation.from_arrays(
            counts, error, pixelscale=starlight.pixelscale, name=f"roll{k}.fits"
        )
        frames.append(replace(frame, position_angles=np.array([roll])))
    return frames, rings


@cache
def fitted(brightness=BRIGHTNESS):
    """The star alone, and with extended light."""
    frames, _ = rolls(brightness)
    model = dr.nircam_coronagraph("F444W", **OPTIONS)
    settings = dr.GaussNewton(cycles=10, response_npix=64)
    fit = dr.refine(model, frames, dr.random_opd(1, npix=128), settings=settings)
    return fit, dr.fit_disk(fit)


def amount(image, true):
    """How much of the true light an image has."""
    return float((image * true).sum() / (true**2).sum())


@pytest.mark.slow
def test_a_ring_keeps_its_light():
    fit, disk = fitted()
    _, rings = rolls(BRIGHTNESS)
    # A fit of the star alone takes all of the ring.
    assert amount(np.nan_to_num(fit.frames[0].residual[0]), rings[0]) < 0.2
    for light, true in zip(disk.light, rings, strict=True):
        assert amount(light, true) == pytest.approx(1.0, abs=0.1)
    assert amount(np.nan_to_num(disk.image), rings[0]) == pytest.approx(1.0, abs=0.1)
    assert disk.contrast == pytest.approx(BRIGHTNESS, rel=0.15)
    # The second roll is turned by 12 degrees, 3 pixels at this separation.
    ((_, templates),) = groups_of([disk.fit])
    place = torch.tensor([[0.9, 0.3]], dtype=torch.float64)
    light = templates.at(place)[1][0].numpy()
    peak = np.unravel_index(light.argmax(), light.shape)
    np.testing.assert_allclose(templates.pixels_of(1, place)[:, 0], peak, atol=1.2)
    assert disk.orientation == pytest.approx(POSITION_ANGLE, abs=2)
    # By which factor squared the contrast limits would otherwise be raised.
    assert disk.fit.chi2_per_pixel < fit.chi2_per_pixel / 10


@pytest.mark.slow
def test_a_star_without_a_disk_has_none():
    fit, disk = fitted(0.0)
    assert disk.contrast == 0
    assert len(disk.table) == 0
    assert disk.orientation is None
    assert disk.gain < 300
    assert not np.any(disk.light)
    assert disk.fit is fit


@cache
def small_fit():
    """A star without a companion in 24 x 24 pixels."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    opd = dr.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(star=STAR), opd, seed=1)
    return dr.refine(model, frame, opd, settings=dr.GaussNewton(cycles=4))


def test_products_and_refusals(tmp_path):
    fit = small_fit()
    for inner in (0, -0.3):
        with pytest.raises(IncompatibleSetupError, match="inner: got"):
            dr.fit_disk(fit, inner=inner)
    reference = replace(fit.frames[0].observation, reference=True)
    star = replace(fit, frames=(replace(fit.frames[0], observation=reference),))
    with pytest.raises(IncompatibleSetupError, match="got a reference star"):
        dr.fit_disk(star)
    disk = dr.fit_disk(fit, inner=0.4)
    assert disk.image.shape == disk.error.shape == disk.light[0].shape == (24, 24)
    np.testing.assert_allclose(disk.image, fit.frames[0].residual[0], atol=1e-9 * STAR.photons)
    np.testing.assert_allclose(disk.error, fit.frames[0].observation.error[0])
    lit = replace(disk, offsets=np.array([[0.5, 0.1], [-0.5, -0.1]]), contrasts=np.array([1, 2e-6]))
    assert lit.orientation is None  # The frame's own orientation is not known.
    with astropy_fits.open(lit.write(tmp_path)) as hdus:
        names = [hdu.name for hdu in hdus[1:]]
        assert names == ["IMAGE", "IMAGE_ERROR", "LIGHT", "HIDES_POINTS", "OFFSET_X", "OFFSET_Y",
                         "SOURCES"]  # fmt: skip
        assert not hdus["HIDES_POINTS"].data.any()
        assert hdus["IMAGE"].header["BUNIT"] == "ph"
        np.testing.assert_allclose(
            WCS(hdus["LIGHT"].header).wcs_pix2world(2, 9, 0), disk.grid[9, 2]
        )
        np.testing.assert_array_equal(hdus["SOURCES"].data["contrast"], lit.contrasts)
    axes = lit.plot()
    pyplot.close(axes[0].figure)
    lines = [
        sum(isinstance(each, ContourSet) for each in axes[1].collections)
        for axes in (lit.plot(), replace(lit, hides_points=lit.grid[..., 0] > 0).plot())
    ]
    pyplot.close("all")
    assert lines == [0, 1]
    assert [ax.get_title(loc="left") for ax in axes] == [
        "frames without the star",
        "extended light",
    ]


def test_non_negative_light_is_that_of_scipy():
    rng = np.random.default_rng(2)
    columns, data = rng.normal(size=(60, 20)), rng.normal(size=60)
    solved = module._brightest(columns.T @ columns, columns.T @ data, np.zeros(20), 0.0)
    expected = nnls(columns, data)[0]
    assert 3 < (expected > 0).sum() < 17
    np.testing.assert_allclose(solved, expected, atol=1e-4)
    gain = module._gain(columns.T @ columns, columns.T @ data, expected)
    assert gain == pytest.approx((data**2).sum() - ((data - columns @ expected) ** 2).sum())


def planets_in(frames, places, contrast):
    """The frames with planets at x, y from the star in the first of them, arcsec."""
    ((_, templates),) = groups_of([fitted()[1].fit])
    light = templates.at(torch.tensor(places, dtype=torch.float64))
    return [
        replace(each, data=each.data + contrast * light[k].sum(dim=0).numpy())
        for k, each in enumerate(frames)
    ]


def with_disk(frames):
    """Fit frames with the settings of `fitted`."""
    model = dr.nircam_coronagraph("F444W", **OPTIONS)
    settings = dr.GaussNewton(cycles=10, response_npix=64)
    return dr.fit_disk(dr.refine(model, frames, dr.random_opd(1, npix=128), settings=settings))


@pytest.mark.slow
def test_planets_beside_a_ring_are_found_at_twice_the_limits():
    _, disk = fitted()
    alone = dr.detect(disk.fit, without_limits=disk.hides_points)
    assert len(alone.candidates) == 0
    curve = alone.contrast_curve
    limit = float(np.interp(1.05, curve["separation"].value, curve["contrast"]))
    # Much of the ring's light would be noise without its own sources.
    assert limit < 3e-7
    frames, _ = rolls(BRIGHTNESS)
    # From 1.0 to 1.15 arcsec from the star, 0.4 from the ring or more.
    places = [(0.6, -0.9), (-0.8, -0.6), (0.3, 1.1)]
    for times in (2.0, 5.0):
        again = with_disk(planets_in(frames, places, times * limit))
        found = dr.detect(again.fit, without_limits=again.hides_points).candidates
        away = np.hypot(*np.moveaxis(
            np.stack([found["x"].value, found["y"].value], axis=-1)[:, None] - places, -1, 0
        ))  # fmt: skip
        assert sorted(away.argmin(axis=1)) == [0, 1, 2]
        assert away.min(axis=0) == pytest.approx(0, abs=0.05)
        assert np.asarray(found["contrast"]) == pytest.approx(times * limit, rel=0.35 / times**0.5)


@pytest.mark.slow
@pytest.mark.parametrize(("brightness", "count"), [(2e-5, 2), (1e-5, 2), (BRIGHTNESS, 1)])
def test_clumps_of_faint_rings_and_of_single_rolls_are_no_planets(brightness, count):
    frames, rings = rolls(brightness)
    disk = with_disk(frames[:count])
    assert len(dr.detect(disk.fit).candidates) == 0
    assert amount(disk.light[0], rings[0]) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_a_planet_next_to_a_ring_counts_as_its_light_and_has_no_limit():
    _, disk = fitted()
    away = np.hypot(*np.moveaxis(disk.grid - (1.0, -0.35), -1, 0))
    assert disk.hides_points[np.unravel_index(away.argmin(), away.shape)]
    assert 0.15 < disk.hides_points.mean() < 0.35
    again = with_disk(planets_in(rolls(BRIGHTNESS)[0], [(1.0, -0.35)], 1e-6))
    assert len(dr.detect(again.fit).candidates) == 0
    assert again.contrast > disk.contrast


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [1e-5, 1e-4])
def test_a_planet_alone_is_no_disk(contrast):
    """Although sources lower chi-squared by ten thousands."""
    disk = with_disk(planets_in(rolls(0.0)[0], [(0.6, -0.5)], contrast))
    assert disk.contrast == 0
    assert disk.gain > 1e4
    assert not disk.hides_points.any()
    (planet,) = dr.detect(disk.fit).candidates
    assert planet["contrast"] == pytest.approx(contrast, rel=0.03)


def test_limits_are_those_of_the_pixels_that_are_left():
    fit = small_fit()
    grid = fit.frames[0].grid
    whole = dr.detect(fit)
    half = dr.detect(fit, without_limits=grid[..., 0] < 0)
    near = np.hypot(*np.moveaxis(grid, -1, 0)) < 0.35
    curve = dr.detect(fit, without_limits=near).contrast_curve
    assert curve["separation"].min() > whole.contrast_curve["separation"].min()
    assert (half.contrast_curve["lowest"] >= whole.contrast_curve["lowest"]).all()
    assert (half.contrast_curve["lowest"] > whole.contrast_curve["lowest"]).any()
    np.testing.assert_array_equal(half.error, whole.error)
    np.testing.assert_array_equal(half.has_limits, whole.has_limits & (grid[..., 0] >= 0))
    table = dr.completeness(half, separations=[0.6], strengths=[3.0], angles=12)
    assert 5 < table["planets"][0] < 8  # Two of twelve are on the edge.
    with pytest.raises(IncompatibleSetupError, match=r"without_limits: got the shape \(3,\)"):
        dr.detect(fit, without_limits=np.zeros(3, dtype=bool))
