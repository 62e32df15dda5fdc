"""The image of the sky is the posterior mean in closed form, and has north up."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import pyklip_diffrender as dr
from pyklip_diffrender.imaging import SkyModel
from pyklip_diffrender.imaging.interpolation import interpolation_matrix

SIZE, NPIX, CONTRAST = 24, 64, 4e-7
PLACE = (0.45, 0.3)
"""x, y arcsec of a planet from the star in the first frame."""


@cache
def fit() -> dr.Refinement:
    """Two rolls of a star with a faint planet, fitted without it."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=SIZE)
    opd = dr.random_opd(1, npix=NPIX)
    frames = []
    for k, angle in enumerate((0.0, 30.0)):
        turn = np.radians(angle)
        # On the detector, the sky turns clockwise as the position angle of +y grows.
        x, y = np.array(PLACE) @ np.array([[np.cos(turn), -np.sin(turn)],
                                           [np.sin(turn), np.cos(turn)]])  # fmt: skip
        scene = dr.Scene(planets=(dr.Planet.from_offset(CONTRAST, float(x), float(y)),))
        shot = dr.simulate(model, scene, opd, seed=k)
        frames.append(replace(shot, position_angles=np.full(len(shot), angle)))
    settings = dr.GaussNewton(cycles=3, max_companions=0)
    return dr.refine(model, frames, opd, settings=settings, plan="off")


@cache
def sky() -> SkyModel:
    return SkyModel([fit()])


def dense(model: SkyModel) -> NDArray[np.float64]:
    """The estimate as a matrix that multiplies the data."""
    linear, _ = model.groups[0]
    ny, nx = linear.frames[0].residual.shape
    n = ny * nx
    h = np.concatenate([model._onto_frames[0][k].toarray() for k in (0, 1)])
    inverse = np.zeros((2 * n, 2 * n))
    for k in (0, 1):
        unit = torch.eye(n, dtype=torch.float64).reshape(n, ny, nx)
        cleaned = linear.clean({k: unit})
        for j in (0, 1):
            part = (linear.frames[j].weight * cleaned[j]).flatten(1).numpy()
            inverse[j * n : (j + 1) * n, k * n : (k + 1) * n] = part.T
    side = model.shape[0]
    blur = model._sky(np.eye(side * side).reshape(-1, side, side)).reshape(side * side, -1).T
    prior = blur @ blur.T
    weighted = prior @ h.T @ inverse
    return np.linalg.solve(np.eye(len(prior)) + weighted @ h, weighted)


def test_the_estimate_is_that_of_the_closed_form() -> None:
    model = sky()
    estimate = dense(model)
    data = np.concatenate([model.light()[0][k][0].numpy().ravel() for k in (0, 1)])
    expected = (estimate @ data).reshape(model.shape)
    # Conjugate gradients end at a residual of a thousandth, in other units.
    np.testing.assert_allclose(model.estimate()[0], expected, atol=4e-3 * np.abs(expected).max())


def test_a_source_has_the_stated_throughput() -> None:
    model = sky()
    _, templates = model.groups[0]
    row, column = 16, 19
    first = templates.origin
    place = torch.from_numpy(first.grid[row, column])[None]
    light = {k: 1e-3 * each for k, each in templates.at(place).items()}
    data = model.light()[0]
    added = model.estimate([{k: data[k] + light[k] for k in light}])[0] - model.estimate()[0]
    # The first frame has north up.
    brightest = np.unravel_index(added.argmax(), added.shape)
    np.testing.assert_allclose(model.grid[brightest], place[0], atol=model.pixelscale)
    peak = float(light[0][0, row, column])
    kept = float((interpolation_matrix(model.places(place.numpy(), 0.0), model.shape)
                  @ added.ravel())[0]) / peak  # fmt: skip
    assert 0.3 < kept < 1.0
    stated = model.throughput()
    assert stated.shape == first.observation.shape
    # That of the ring, where the star of this model takes more of some sources than of others.
    assert stated[row, column] == pytest.approx(kept, rel=0.3)
    assert (stated[4:-4, 4:-4] < 1.0).all()


def test_interpolation_turns_a_smooth_image_exactly_enough() -> None:
    y, x = np.indices((21, 23)).astype(float)
    image = np.exp(-((x - 11.3) ** 2 + (y - 9.6) ** 2) / (2 * 1.5**2))
    places = np.random.default_rng(1).uniform(4, 16, (50, 2))
    expected = np.exp(-((places - (11.3, 9.6)) ** 2).sum(axis=1) / (2 * 1.5**2))
    found = interpolation_matrix(places, image.shape) @ image.ravel()
    # Lanczos' kernel of three pixels, for a source of 3.5 pixels FWHM.
    np.testing.assert_allclose(found, expected, atol=6e-3)
