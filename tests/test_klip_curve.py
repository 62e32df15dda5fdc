"""KLIP's contrast curve for the frames of a reduction."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from astropy import units as u
from scipy import stats

import pyklip_diffrender as dr
from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.reduction.klip import klip_curve, small_sample_factor
from pyklip_diffrender.refinement import FrameFit

NPIX, SIZE = 64, 32
RESOLUTION = 0.14
SEPARATIONS = np.array([0.5, 0.8])
FLUX = 1e9


@cache
def model():
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=SIZE)


def frame(seed, angle, shift=(0.0, 0.0)):
    """A frame whose star is `shift` arcsec off the middle, and its perfect fit."""
    wavefront = dr.wavefront.random_opd(1, npix=NPIX).data
    moved = torch.tensor(shift, dtype=torch.float64)
    with torch.no_grad():
        star = FLUX * model()(wavefront, detector_shift=moved).double().numpy()
    noise = np.sqrt(star + 100.0)
    data = star + noise * np.random.default_rng(seed).standard_normal(star.shape)
    scale = model().detector.pixelscale[0]
    observation = dr.Observation.from_arrays(
        data, noise, pixelscale=scale, center=(SIZE - 1) / 2 + np.array(shift) / scale,
        position_angles=angle,
    )  # fmt: skip
    values = {"flux": np.array([FLUX]), "detector_shift": np.array(shift)}
    return FrameFit(
        model(), observation, {}, wavefront, star, np.zeros_like(star), values, {},
        np.ones_like(star), np.zeros(0),
    )  # fmt: skip


def curve_of(science, references=(), separations=None, hidden=False, sources=None):
    """KLIP's curve for fitted frames, as if a search but where `hidden` had these `sources`."""
    curve = SimpleNamespace(meta={"resolution_arcsec": RESOLUTION})
    searched = SimpleNamespace(
        templates=Templates(SimpleNamespace(frames=tuple(science))), contrast_curve=curve,
        grid=science[0].grid, sources=Candidates.at([], []) if sources is None else sources,
        has_limits=~np.broadcast_to(hidden, science[0].grid.shape[:2]),
    )  # fmt: skip
    return klip_curve(searched, [each.observation for each in references], separations)


def seen(fitted, **changes):
    """A frame with another observation."""
    return replace(fitted, observation=replace(fitted.observation, **changes))


@cache
def frames():
    rolls = [frame(2, 0.0), frame(3, 20.0, shift=(0.02, -0.03))]
    return rolls, [frame(4, 0.0, shift=(-0.03, 0.0)), frame(5, 0.0)]


@cache
def quiet():
    return np.asarray(curve_of(*frames(), SEPARATIONS)["contrast"])


def photon_limits(science):
    """5-sigma limits for a known star, at one position angle."""
    templates = Templates(SimpleNamespace(frames=science))
    places = torch.tensor(np.stack([SEPARATIONS, 0 * SEPARATIONS], axis=-1))
    information = sum(
        (image.numpy() ** 2 / science[k].observation.error ** 2).sum(axis=(1, 2))
        for k, image in templates.at(places).items()
    )
    return np.asarray(5 / np.sqrt(information))


def test_limits_are_near_the_photon_limit_and_not_below():
    ratio = quiet() / photon_limits(frames()[0])
    assert (ratio > 1).all()
    assert (ratio < 6).all()


def test_stars_are_aligned():
    """Half a pixel between the star and its recorded position makes the limits worse."""
    science, references = frames()
    wrong = [
        seen(each, center=each.observation.center + off)
        for each, off in zip(references, (0.5, -0.5), strict=True)
    ]
    assert (curve_of(science, wrong, SEPARATIONS)["contrast"] > 1.2 * quiet()).any()


def test_candidates_are_not_noise():
    """Neither a companion of the fit nor a planet that only the search found, in one ring."""
    science, references = frames()
    sources = Candidates.at([[0.5, 0.0], [-0.3, 0.4]], [1e-2, 4e-3])
    templates = Templates(SimpleNamespace(frames=science))
    light = templates.at(sources.offsets)
    crowded = []
    for k, each in enumerate(science):
        companion, planet = (sources.contrasts[:, None, None] * light[k]).numpy()
        data = each.observation.data + companion + planet
        crowded.append(replace(seen(each, data=data), companion_image=companion))
    curve = curve_of(crowded, references, SEPARATIONS, sources=sources)
    assert curve["contrast"] == pytest.approx(quiet(), rel=1e-6)
    # With either of the two in the frames, the ring at 0.5 arcsec has a worse limit.
    for k in range(2):
        left = curve_of(crowded, references, SEPARATIONS, sources=sources.without(k))
        assert left["contrast"][0] > 2 * quiet()[0]


def test_noise_is_that_of_the_places_that_have_limits():
    """A bright source of which the search knows nothing is on one side of the star."""
    science, references = frames()
    grid = science[0].grid
    bright = np.exp(-((grid - [0.45, -0.25]) ** 2).sum(axis=-1) / 0.01)
    lit = [seen(each, data=each.observation.data + 1e4 * bright) for each in science]
    worse = curve_of(lit, references, SEPARATIONS)["contrast"]
    assert (worse > 2 * quiet()).any()
    spared = curve_of(lit, references, SEPARATIONS, grid[..., 0] > -0.1)["contrast"]
    assert (spared < 0.5 * worse).any()
    # A ring without such places, to half a pixel, has no limit.
    inner = curve_of(*frames(), SEPARATIONS, np.hypot(*np.moveaxis(grid, -1, 0)) < 0.65)
    assert np.isnan(inner["contrast"]).tolist() == [True, False]


def test_two_rolls_alone_and_masked_pixels():
    science, _ = frames()
    valid = science[0].observation.valid.copy()
    valid[0, 20, 20:22] = False
    hole = seen(science[0], valid=valid, data=np.where(valid, science[0].observation.data, 0.0))
    curve = curve_of([hole, science[1]], (), [500, 800, 5000] * u.mas)
    assert curve["separation"].to_value(u.arcsec) == pytest.approx(SEPARATIONS)
    assert list(curve["modes"]) == [1, 1]
    assert curve.meta["label"] == "KLIP ADI (other roll, 1 mode)"
    correction = small_sample_factor(SEPARATIONS, curve.meta["resolution_arcsec"])
    assert curve["small_sample"] / curve["contrast"] == pytest.approx(correction)
    assert np.isfinite(curve["contrast"]).all()
    assert (curve["contrast"] < 5 * quiet()).all()
    assert ((curve["throughput"] > 0) & (curve["throughput"] < 1.1)).all()


def test_without_references_there_is_no_curve():
    science, references = frames()
    with pytest.raises(IncompatibleSetupError, match="roll without references"):
        curve_of([science[0], seen(science[1], position_angles=None)])
    with pytest.raises(IncompatibleSetupError, match="rings are complete"):
        curve_of(science, references, 3.0)


def test_small_samples_need_higher_thresholds():
    # Mawet et al. 2014, figure 6: at 1 lambda/D, six elements, a 5 sigma false alarm
    # probability needs tens of sigma; far out nothing is added.
    near, far = small_sample_factor(np.array([1.0, 1000.0]), 1.0)
    expected = stats.t.isf(stats.norm.sf(5.0), 4) * math.sqrt(1 + 1 / 5) / 5
    assert near == pytest.approx(expected)
    assert near > 5
    assert far == pytest.approx(1.0, abs=0.01)
    assert small_sample_factor(np.array([0.1]), 1.0)[0] == math.inf
