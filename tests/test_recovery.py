"""Planets that are injected into fitted frames, and what is measured of them."""

from dataclasses import replace
from functools import cache
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.table import QTable

import pyklip_diffrender as dr
from pyklip_diffrender.detection import Candidates, measured_planet, recover_planets, with_planets
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.errors import IncompatibleSetupError

NORTH = 20.0
SIZE = 41
PIXEL = 0.06
LIMIT = 1e-4


class Frame:
    """In place of a `FrameFit`: a planet is a pixel; every next frame is brighter by 1."""

    values = MappingProxyType({})

    def __init__(self, flux):
        blank = np.zeros((SIZE, SIZE))
        self.flux = self.star_light = flux
        self.observation = dr.Observation.from_arrays(blank, blank + 1, pixelscale=PIXEL)

    def render(self, *, background, source):
        assert not background
        image = np.zeros((SIZE, SIZE))
        x, y = np.round(np.array(source) / PIXEL + SIZE // 2).astype(int)
        image[y, x] = self.flux
        return image


def searched(science=None, **changes):
    """A search that measures what is on the pixel, with an error of a tenth of the limit."""
    y, x = np.indices((SIZE, SIZE))
    grid = (np.stack([x, y], axis=-1) - SIZE // 2) * PIXEL
    snr = np.where(np.hypot(*np.moveaxis(grid, -1, 0)) < 1.1, 0.0, np.nan)

    def measure(places):
        assert (science[1].data == 2 * science[0].data).all()
        columns, rows = np.round(np.array(places).T / PIXEL + SIZE // 2).astype(int)
        return table(np.zeros((len(places), 2)), science[0].data[0][rows, columns])

    curve = QTable({"separation": [0.2, 1.0] * u.arcsec, "small_sample": [2 * LIMIT, LIMIT]})
    found = changes.setdefault("candidates", table(np.zeros((0, 2)), []))
    # Errors of contrasts are 1.5 times those for a known position.
    errors = torch.full((len(found),), 0.1 * LIMIT, dtype=torch.float64)
    sources = replace(
        Candidates.at(np.stack([found["x"].value, found["y"].value], axis=-1), found["contrast"]),
        covariance=torch.diag((1.5 * errors).repeat(3) ** 2),
        detection_errors=errors,
    )
    values = {
        "has_limits": np.isfinite(changes.get("snr", snr)),
        "fit": SimpleNamespace(frames=[Frame(1.0), Frame(2.0)]), "sources": sources,
        "grid": grid, "snr": snr, "north": NORTH, "contrast_curve": curve, "measure": measure,
        "error_factor": ErrorFactor.constant(1.0),
    }  # fmt: skip
    return SimpleNamespace(**{**values, **changes})


def table(places, contrasts):
    contrasts = np.asarray(contrasts, dtype=float)
    return QTable({
        "x": places[:, 0] * u.arcsec, "y": places[:, 1] * u.arcsec, "contrast": contrasts,
        "contrast_error": 0.1 * LIMIT * np.ones(len(contrasts)), "snr": 10 * contrasts / LIMIT,
    })  # fmt: skip


def test_planets_are_as_bright_as_stated_and_where_they_are_said_to_be():
    """Relative to the star of the injection, even if it is brighter in the fit with planets."""
    sets = []

    def search(science):
        sets.append(science)
        return searched(science, fit=SimpleNamespace(frames=[Frame(2.0), Frame(4.0)]))

    planets = recover_planets(searched(), 5, search)
    assert len(planets) == 5
    limit = 2 ** ((1.0 - planets["separation"].value) / 0.8) * LIMIT
    assert np.asarray(planets["injected"]) == pytest.approx(1.6 * limit)
    # What was measured at the place is what was injected there.
    np.testing.assert_allclose(planets["contrast"], 2.0 * planets["injected"])
    assert not planets["detected"].any()
    # Two in a field of 0.8 arcsec.
    assert [np.count_nonzero(each[0].data) for each in sets] == [2, 2, 1]
    pixels = np.concatenate([np.argwhere(each[0].data[0]) for each in sets])
    for row in planets:
        angle = float(row["position_angle"].value) - NORTH
        place = dr.Planet(1.0, float(row["separation"].value), angle).offset
        away = (pixels[:, ::-1] - SIZE // 2) * PIXEL - place
        assert np.hypot(*away.T).min() < 0.75 * PIXEL
    assert len(set(np.round(planets["separation"].value, 3))) == 5
    assert "..." not in str(planets)


@pytest.mark.parametrize("anywhere", [True, False])
def test_planets_keep_away_from_candidates_and_from_pixels_without_a_limit(anywhere):
    """Without any other place they are not left out."""
    x, y = np.moveaxis(searched().grid, -1, 0)
    candidate, images = table(np.array([[0.5, 0.5]]), [1e-3]), []

    def search(science):
        images.append(science[0].data[0] > 0)
        return searched(science)

    has_limits = (y >= 0) & anywhere
    detection = searched(has_limits=has_limits, candidates=candidate)
    assert len(recover_planets(detection, 5, search)) == 5
    assert sum(each.sum() for each in images) == 5
    if anywhere:
        used = np.any(images, axis=0)
        assert has_limits[used].all()
        assert np.hypot(x - 0.5, y - 0.5)[used].min() > 0.3


@pytest.mark.parametrize(
    ("away", "expected"), [((0.05, 0.0), (7e-4, 1.5, True)), ((0.5, 0.5), (1e-4, 1.0, False))]
)
def test_a_planet_is_its_candidate_or_what_is_measured_at_its_place(away, expected):
    place = (0.3, -0.6)
    data = np.zeros((SIZE, SIZE))
    data[SIZE // 2 - 10, SIZE // 2 + 5] = 1e-4
    frames = tuple(
        dr.Observation.from_arrays(k * data, np.ones_like(data), pixelscale=PIXEL) for k in (1, 2)
    )
    candidates = table(np.array([[1.0, 1.0], np.add(place, away)]), [1e-3, 7e-4])
    # The star of the search has a flux of 1.
    measured = measured_planet(searched(frames, candidates=candidates), place, 0.8)
    contrast, error, detected = expected
    assert (0.8 * measured.contrast, measured.detected) == (pytest.approx(contrast), detected)
    # Noise alone, without what the table's error has of the star's flux.
    assert 0.8 * measured.contrast_error == pytest.approx(error * 0.1 * LIMIT)
    assert measured.snr == pytest.approx(10 * contrast / LIMIT)


def test_injected_planets_turn_with_the_sky():
    """East of north is 30 degrees less from +y in a frame whose +y is 30 degrees further east."""
    frames = [Frame(3.0), Frame(3.0)]
    for frame, angle in zip(frames, (NORTH, NORTH + 30.0), strict=True):
        frame.observation = replace(frame.observation, position_angles=np.array([angle]))
    first, second = with_planets(frames, [dr.Planet(0.5, 0.6, 90.0)])
    # To the left of the star, 10 pixels away; then 60 degrees from up, still on the left.
    middle = SIZE // 2
    np.testing.assert_array_equal(np.argwhere(first.data[0]), [[middle, middle - 10]])
    np.testing.assert_array_equal(np.argwhere(second.data[0]), [[middle + 5, middle - 9]])
    assert first.data.max() == second.data.max() == 1.5


@cache
def star_alone():
    """A star alone, of which the model is exact."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    opd = dr.wavefront.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(), opd, seed=3)
    return dr.detect(dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=6)))


def test_half_of_the_planets_at_the_limit_are_found():
    """Noise is Gaussian: S/N of planets at the limit is 5 on average, and symmetric about it."""
    table = dr.detection.completeness(
        star_alone(), separations=[0.5] * u.arcsec, strengths=[0.5, 1.0, 2.0], angles=20
    )
    assert list(table["planets"]) == [20] * 3
    faint, half, bright = table["completeness"]
    # S/N 2.5 and 10 on average; it varies with the angle, and between pixel centres.
    assert faint <= 0.05
    assert bright == 1
    # The standard deviation of the fraction of 20 planets is 0.11.
    assert 0.2 < half < 0.8
    curve = star_alone().contrast_curve
    limit = np.interp(0.5, curve["separation"].value, curve["small_sample"])
    assert table["contrast"][1] == pytest.approx(limit, rel=0.02)
    assert 0.7 < table.meta["contrast_50"][0] / limit < 1.3
    assert 0 < table.meta["false_alarm"] < 1e-3


def test_the_contrast_of_a_fraction_is_interpolated():
    table = QTable({
        "separation": np.repeat([0.4, 0.8], 3) * u.arcsec, "contrast": [1e-5, 2e-5, 4e-5] * 2,
        "completeness": [0.0, 0.4, 0.8, 0.6, 0.5, 0.7],
    })  # fmt: skip
    half = dr.detection.contrast_of_completeness(table, 0.5)
    assert list(half["separation"].value) == [0.4, 0.8]
    # A quarter of the way from 0.4 to 0.8, in the logarithm; and more than half from the first on.
    assert half["contrast"][0] == pytest.approx(2e-5 * 2**0.25)
    assert np.isnan(half["contrast"][1])
    assert np.isnan(dr.detection.contrast_of_completeness(table, 0.95)["contrast"]).all()


def test_without_a_fit_there_is_no_completeness(tmp_path):
    path = next(each for each in star_alone().write(tmp_path) if each.suffix == ".fits")
    with pytest.raises(IncompatibleSetupError, match="without its fit"):
        dr.detection.completeness(dr.Detection.read(path))
