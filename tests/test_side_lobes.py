"""Candidates beside a source that is nearer to the star than the search goes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import pyklip_diffrender as dr
from benchmarks.planets import searched
from pyklip_diffrender.detection.candidates import Candidates, Maps
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import separation_of
from pyklip_diffrender.detection.search import side_lobes
from pyklip_diffrender.detection.templates import groups_of

HIDDEN, PLANET, LOBE = (0.1, -0.08), (-0.3, 0.5), (0.22, 0.3)
UNIT = ErrorFactor.constant(1.0)


@cache
def star():
    """The linear model of a star that was fitted, and its templates."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=128, fov_pixels=28)
    opd = dr.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(), opd, seed=2)
    fit = dr.refine(model, frame, opd, settings=dr.GaussNewton(cycles=5))
    ((linear, templates),) = groups_of([fit])
    return linear, templates


def maps_of(light):
    """Maps of frames with sources, x, y to S/N, about whose star everything is known."""
    linear, templates = star()
    images = templates.at(torch.tensor(list(light), dtype=torch.float64))
    errors = linear.weigh(images).information.rsqrt()
    contrasts = errors * torch.tensor(list(light.values()))
    added = torch.tensordot(contrasts, images[0].double(), dims=1)
    changed = replace(linear.frames[0], residual=added)
    return Maps([(replace(linear, frames=(changed,)), templates)], False)


def candidates_of(maps, light):
    """Candidates at x, y with the S/N that they would have alone."""
    ((linear, templates),) = maps.groups
    images = templates.at(torch.tensor(list(light), dtype=torch.float64))
    errors = linear.weigh(images).information.rsqrt()
    return Candidates.at(list(light), errors * torch.tensor(list(light.values())))


def lobes_of(maps, candidates):
    snr = maps.snr(maps.without(candidates))
    lobes = side_lobes(maps, snr, candidates, UNIT, 5.0, 0.2).tolist()
    return lobes


def test_a_planet_stays_and_a_peak_that_a_hidden_source_explains_does_not():
    maps = maps_of({HIDDEN: 60.0, PLANET: 30.0})
    candidates = candidates_of(maps, {PLANET: 30.0, LOBE: 6.0})
    assert lobes_of(maps, candidates) == [False, True]


def test_without_a_hidden_source_nothing_is_explained():
    maps = maps_of({PLANET: 30.0, LOBE: 6.0})
    assert lobes_of(maps, candidates_of(maps, {PLANET: 30.0})) == [False]


def test_a_source_may_be_significant_only_beside_the_candidate():
    """A candidate that has taken light of the hidden source leaves less than 5 sigma of it."""
    place = (0.34, -0.09)  # The templates of the two have a correlation of 0.48.
    maps = maps_of({HIDDEN: 5.6, place: 3.2})
    alone = candidates_of(maps, {place: 6.0})
    snr = maps.snr(maps.without(alone))
    assert snr[separation_of(maps.grid) < 0.2].max() < 4.8
    assert lobes_of(maps, alone) == [True]


def test_a_source_that_is_not_significant_explains_nothing():
    place = (0.34, -0.09)
    maps = maps_of({HIDDEN: 3.5, place: 4.0})
    assert lobes_of(maps, candidates_of(maps, {place: 5.7})) == [False]


@pytest.mark.slow
def test_no_candidate_beside_a_planet_behind_the_mask():
    """A planet of 9e-5 at 0.11 arcsec ends a fit as CONVERGED, with a peak of 5.1 at 0.35."""
    outcome = searched(60)
    assert outcome.false == ()
    assert outcome.verdict == "fainter than the curve"
    assert np.isnan(outcome.pull)
