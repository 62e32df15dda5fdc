"""The image of the sky is the posterior mean in closed form, and has north up."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d

import pyklip_diffrender as dr
from pyklip_diffrender.imaging import (
    _BEAM_FWHM_LAMBDA_D,
    _PRIOR_SOURCE_SNR,
    SkyModel,
    interpolation_matrix,
)

SIZE, NPIX, CONTRAST = 24, 64, 4e-7
PLACE = (0.45, 0.3)  # x, y arcsec of a planet from the star in the first frame.


@cache
def sky():
    """Of two rolls of a star with a faint planet, fitted without it."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=SIZE)
    opd = dr.wavefront.random_opd(1, npix=NPIX)
    frames = []
    for k, angle in enumerate((0.0, 30.0)):
        # On the detector, the sky turns clockwise as the position angle of +y grows.
        planet = dr.Planet.from_offset(CONTRAST, *PLACE).rotated(-angle)
        shot = dr.simulate(model, dr.Scene(planets=(planet,)), opd, seed=k)
        frames.append(replace(shot, position_angles=np.full(len(shot), angle)))
    settings = dr.FitSettings(cycles=3, max_companions=0)
    return SkyModel(dr.refine(model, frames, opd, settings=settings))


def convolution(kernel, ny, nx):
    """Convolution of an image, zero beyond its edges, with a kernel, as a matrix."""
    unit = np.eye(ny * nx).reshape(-1, ny, nx)
    columns = [convolve2d(pixel, kernel, mode="same").ravel() for pixel in unit]
    return np.array(columns).T


@cache
def dense():
    """Images of point sources in the data, and the posterior mean of their peaks, as matrices."""
    model = sky()
    linear = model.templates.linear
    ny, nx = linear.frames[0].residual.shape
    n = ny * nx
    seen = convolution(model._source, ny, nx)
    h = np.concatenate([seen @ model._onto_frames[k].toarray() for k in (0, 1)])
    inverse = np.zeros((2 * n, 2 * n))
    for k in (0, 1):
        cleaned = linear.clean({k: torch.eye(n, dtype=torch.float64).reshape(n, ny, nx)})
        for j in (0, 1):
            part = (linear.frames[j].weight * cleaned[j]).flatten(1).numpy()
            inverse[j * n : (j + 1) * n, k * n : (k + 1) * n] = part.T
    weighted = model._prior.reshape(-1, 1) ** 2 * (h.T @ inverse)
    return h, np.linalg.solve(np.eye(len(weighted)) + weighted @ h, weighted)


def test_the_estimate_is_that_of_the_closed_form():
    model = sky()
    data = np.concatenate([model.light()[k][0].numpy().ravel() for k in (0, 1)])
    sources = (dense()[1] @ data).reshape(model.shape)
    expected = np.fft.ifft2(np.fft.fft2(sources) * model._beam).real
    # Conjugate gradients end at a residual of a thousandth, in other units.
    np.testing.assert_allclose(model.estimate()[0], expected, atol=4e-3 * np.abs(expected).max())


def test_the_error_is_that_of_the_closed_form():
    model = sky()
    # The estimate's covariance is E Sigma E^T; with E = S H^T Sigma^-1 that is E H S^T.
    h, estimate = dense()
    response = estimate @ h
    covariance = (response * model._prior.ravel() ** 2) @ (np.eye(len(response)) - response).T
    beam = np.fft.fftshift(np.fft.ifft2(model._beam).real)
    places = np.indices(model.shape).reshape(2, -1).T - model.center
    seen = np.array([np.roll(beam, place, (0, 1)).ravel() for place in places])
    exact = np.sqrt((seen @ covariance * seen).sum(axis=1)).reshape(model.shape)
    distance = np.hypot(*np.moveaxis(model.grid, -1, 0)) / model.resolution
    error = model.error()
    for ring in range(1, 6):
        chosen = distance.astype(int) == ring
        assert np.median(error[chosen]) == pytest.approx(np.median(exact[chosen]), rel=0.12)


def test_a_source_in_white_noise_keeps_its_peak():
    """Noise of 1 everywhere, a prior of the stated S/N, frames that repeat beyond their edges."""
    model = sky()
    kernel = model._source
    source = np.zeros(model.shape)
    source[model.center, model.center] = 1.0
    places = np.indices(model.shape).reshape(2, -1).T - model.center
    image = convolve2d(source, kernel, mode="same", boundary="wrap")
    images = np.array([np.roll(image, place, (0, 1)).ravel() for place in places])
    sigma = _PRIOR_SOURCE_SNR / np.linalg.norm(kernel)
    system = np.eye(len(places)) / sigma**2 + images @ images.T
    kept = np.linalg.solve(system, images @ image.ravel()).reshape(model.shape)
    beam = np.fft.fftshift(np.fft.ifft2(model._beam).real)
    seen = convolve2d(kept, beam, mode="same", boundary="wrap")
    assert seen[model.center, model.center] == pytest.approx(1.0, rel=1e-9)
    # Variance of the beam along x.
    variance = (beam * places[:, 1].reshape(beam.shape) ** 2).sum() / beam.sum()
    fwhm = np.sqrt(8 * np.log(2) * variance) * model.pixelscale
    assert fwhm == pytest.approx(_BEAM_FWHM_LAMBDA_D * model.resolution, rel=0.02)


def test_a_source_has_the_stated_throughput():
    model = sky()
    row, column = 16, 19
    first = model.templates.origin
    place = torch.from_numpy(first.grid[row, column])[None]
    light = {k: 1e-3 * each for k, each in model.templates.at(place).items()}
    data = model.light()
    added = model.estimate({k: data[k] + light[k] for k in light})[0] - model.estimate()[0]
    # The first frame has north up.
    brightest = np.unravel_index(added.argmax(), added.shape)
    np.testing.assert_allclose(model.grid[brightest], place[0], atol=model.pixelscale)
    onto = interpolation_matrix(model.places(place.numpy(), 0.0), model.shape)
    kept = float((onto @ added.ravel())[0]) / float(light[0][0, row, column])
    # The beam is right for white noise and on the average of a ring; one place may have more.
    assert 0.3 < kept < 1.3
    stated = model.throughput()
    assert stated.shape == first.observation.shape
    # That of the ring, where the star of this model takes more of some sources than of others.
    assert stated[row, column] == pytest.approx(kept, rel=0.3)
    assert ((stated > 0.3) & (stated < 1.1)).all()


def test_interpolation_turns_a_smooth_image_exactly_enough():
    y, x = np.indices((21, 23)).astype(float)
    image = np.exp(-((x - 11.3) ** 2 + (y - 9.6) ** 2) / (2 * 1.5**2))
    places = np.random.default_rng(1).uniform(4, 16, (50, 2))
    expected = np.exp(-((places - (11.3, 9.6)) ** 2).sum(axis=1) / (2 * 1.5**2))
    found = interpolation_matrix(places, image.shape) @ image.ravel()
    # Lanczos' kernel of three pixels, for a source of 3.5 pixels FWHM.
    np.testing.assert_allclose(found, expected, atol=6e-3)
