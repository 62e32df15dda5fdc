"""Errors of positions, which are measured from a star that is hidden behind the mask."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.detection import Candidates
from pyklip_diffrender.detection.candidates import (
    in_derivatives,
    refine_candidates,
    with_position_of_star,
)
from pyklip_diffrender.detection.templates import Templates, groups_of
from pyklip_diffrender.optics import PupilGrid

BRIGHT, FAINT = (0.45, 0.5), (-0.6, 0.2)
PLACES = ((0.1, -0.7), FAINT)
FREE = ("star_offset", "detector_shift", "si_zernikes")
"""All of them move light on the detector, and are nearly degenerate."""

SIZES = {"star_offset": 1e-3, "detector_shift": 1e-3, "si_zernikes": 2e-9, "modes": 2.0}
"""Changes that move light by about 0.3 mas."""


@pytest.fixture(scope="module")
def fit():
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=128, fov_pixels=36)
    opd = dr.random_opd(1, npix=128)
    planets = (dr.Planet.from_offset(4e-3, *BRIGHT), dr.Planet.from_offset(9e-5, *FAINT))
    frame = dr.simulate(model, dr.Scene(planets=planets), opd, seed=3)
    settings = dr.GaussNewton(
        free=(*FREE, "flux"), cycles=2, companions=planets[:1], max_companions=0
    )
    return dr.refine(model, frame, opd, settings=settings)


def rates(fit, place):
    """Displacements of a source by the unknowns, (unknowns, 2), arcsec per unit.

    Each unknown is changed in the model, and the change is fitted by flux and place of the source.
    """
    (frame,), basis = fit.frames, fit.basis
    grid = PupilGrid.full(frame.model.npix, frame.model.diameter)
    values = frame.optical_values
    values["star_offset"] = values["star_offset"] + torch.tensor(place, dtype=torch.float64)

    def slope(name, component):
        size = len(basis) if name == "modes" else len(values[name])
        step = torch.zeros(size, dtype=torch.float64)
        step[component] = SIZES[name]
        images = []
        for change in (step, -step):
            opd, changed = torch.from_numpy(frame.opd.copy()), dict(values)
            if name == "modes":
                opd = opd + basis.opd(change * 1e-9, grid)
            else:
                changed[name] = values[name] + change
            with torch.no_grad():
                images.append(frame.model(opd, **changed).double().numpy())
        return (images[0] - images[1]) / (2 * SIZES[name])

    with torch.no_grad():
        source = frame.model(torch.from_numpy(frame.opd.copy()), **values).double().numpy()
    weight = fit.linear.frames[0].weight.numpy()
    columns = [source, slope("star_offset", 0), slope("star_offset", 1)]
    whitened = np.stack([(weight * each).ravel() for each in columns], axis=1)
    displaced = np.zeros((len(fit.linear.unknowns), 2))
    for k, unknown in enumerate(fit.linear.unknowns):
        if unknown.name in SIZES:
            change = (weight * slope(unknown.name, unknown.component)).ravel()
            displaced[k] = np.linalg.lstsq(whitened, change, rcond=None)[0][1:]
    return displaced


def test_the_star_is_uncertain_by_all_that_moves_light(fit):
    groups = groups_of([fit])
    candidates = Candidates.at(PLACES, [3e-5, 3e-5])
    added = (with_position_of_star(groups, candidates).covariance - candidates.covariance).numpy()
    assert not added[:2].any()  # Contrasts have errors of their own.
    assert not added[:, :2].any()
    moves = [rates(fit, place) for place in PLACES]
    combinations = np.stack([each[:, axis] for axis in (0, 1) for each in moves], axis=1)
    expected = fit.linear.covariances(torch.from_numpy(combinations)).numpy()
    # A coarser pupil, and single precision.
    scale = np.sqrt(expected.diagonal())
    np.testing.assert_allclose(added[2:, 2:], expected, atol=0.05 * scale.min() ** 2, rtol=0.05)
    # Each of the parameters alone is uncertain by much more than their sum.
    alone = [k for k, each in enumerate(fit.linear.unknowns) if each.name == "detector_shift"]
    assert (fit.linear.covariance.diagonal()[alone].sqrt().numpy() > 3 * scale.max()).all()


def test_candidates_have_the_error_of_the_star(fit):
    search = dr.detect(fit)
    assert search.sources.offsets.numpy() == pytest.approx(np.array([BRIGHT, FAINT]), abs=2e-3)
    groups = groups_of(search.fits)
    of_star = with_position_of_star(
        groups, Candidates.at([FAINT], [9e-5]), torch.tensor(FAINT, dtype=torch.float64)
    ).errors[0, 1:]
    own = refine_candidates(groups, search.sources, reach=0.01)
    # The light of the bright planet counts in the derivatives by what moves the star.
    assert (own.errors[0, 1:] > 0.9 * of_star).all()
    added = (search.sources.covariance - own.covariance).diagonal().reshape(3, 2).T
    assert added[0].numpy() == pytest.approx(0, abs=1e-3 * float(of_star.min() ** 2))
    np.testing.assert_allclose(added[1, 1:], of_star**2, rtol=0.01)
    # The table has these errors, scaled.
    factor = search.error_factor.of(search.sources.offsets)
    stated = search.candidates["x_error"].to_value("arcsec")
    np.testing.assert_allclose(stated, factor * search.sources.errors[:, 1].numpy())


def test_companions_of_a_fit_are_known_in_the_orientation_of_another(fit):
    frame = replace(
        fit.frames[0],
        observation=replace(fit.frames[0].observation, position_angles=np.array([20.0])),
    )
    origin = replace(
        frame, observation=replace(frame.observation, position_angles=np.array([50.0]))
    )
    templates = Templates(replace(fit, frames=(frame,)), origin)
    # In the fit the sky is turned by 50 - 20 degrees counter-clockwise, here back.
    there = dr.Planet.from_offset(1.0, *BRIGHT).rotated(-30.0).offset
    wrong = dr.Planet.from_offset(1.0, *BRIGHT).rotated(30.0).offset
    places = torch.tensor([there, wrong, BRIGHT, FAINT], dtype=torch.float64)
    assert in_derivatives(templates, places).tolist() == [True, False, False, False]
