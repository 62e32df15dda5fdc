"""Planets that are injected into fitted frames, and what is measured of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.table import QTable

import pyklip_diffrender as dr
from pyklip_diffrender.detection import Candidates, measured_planet, recover_planets, with_planets
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.recovery import _free_place
from pyklip_diffrender.errors import IncompatibleSetupError

NORTH = 20.0
SIZE = 41
PIXEL = 0.06
LIMIT = 1e-4


class Frame:
    """In place of a `FrameFit`: a planet is a pixel; every next frame is brighter by 1."""

    values: ClassVar[dict[str, Any]] = {}

    def __init__(self, flux):
        blank = np.zeros((SIZE, SIZE))
        self.flux = flux
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
        values = [
            science[0].data[0][
                tuple(np.round(np.array(place) / PIXEL + SIZE // 2).astype(int)[::-1])
            ]
            for place in places
        ]
        return table(np.zeros((len(places), 2)), values)

    curve = QTable({"separation": [0.2, 1.0] * u.arcsec, "small_sample": [2 * LIMIT, LIMIT]})
    changes.setdefault("candidates", table(np.zeros((0, 2)), []))
    values = {
        "has_limits": np.isfinite(changes.get("snr", snr)),
        "fits": [SimpleNamespace(frames=[Frame(1.0), Frame(2.0)])],
        "grid": grid, "snr": snr, "north": NORTH, "contrast_curve": curve, "measure": measure,
        "sources": sources(changes["candidates"]), "error_factor": ErrorFactor.constant(1.0),
    }  # fmt: skip
    return SimpleNamespace(**{**values, **changes})


def sources(candidates):
    """Errors of contrasts are 1.5 times those for a known position."""
    places = np.stack([candidates["x"].value, candidates["y"].value], axis=-1)
    errors = torch.full((len(candidates),), 0.1 * LIMIT, dtype=torch.float64)
    return replace(
        Candidates.at(places, candidates["contrast"]),
        covariance=torch.diag((1.5 * errors).repeat(3) ** 2),
        detection_errors=errors,
    )


def table(places, contrasts):
    contrasts = np.asarray(contrasts, dtype=float)
    return QTable(
        {
            "x": places[:, 0] * u.arcsec, "y": places[:, 1] * u.arcsec, "contrast": contrasts,
            "contrast_error": 0.1 * LIMIT * np.ones(len(contrasts)),
            "snr": 10 * contrasts / LIMIT,
        }
    )  # fmt: skip


@pytest.mark.parametrize("count", [1, 5])
def test_planets_are_as_bright_as_stated_and_where_they_are_said_to_be(count):
    sets = []

    def search(science):
        sets.append(science)
        return searched(science)

    planets = recover_planets(searched(), count, search)
    assert len(planets) == count
    limit = 2 ** ((1.0 - planets["separation"].value) / 0.8) * LIMIT
    assert np.asarray(planets["injected"]) == pytest.approx(1.6 * limit)
    # What was measured at the place is what was injected there.
    assert np.asarray(planets["contrast"]) == pytest.approx(np.asarray(planets["injected"]))
    assert not planets["detected"].any()
    # Two in a field of 0.8 arcsec.
    assert [np.count_nonzero(each[0].data) for each in sets] == [2] * (count // 2) + [1]
    seen = {
        tuple(np.round((np.array(pixel[::-1]) - SIZE // 2) * PIXEL, 6))
        for each in sets
        for pixel in np.argwhere(each[0].data[0]).tolist()
    }
    for row in planets:
        angle = float(row["position_angle"].value) - NORTH
        place = dr.Planet(1.0, float(row["separation"].value), angle).offset
        assert min(np.hypot(x - place[0], y - place[1]) for x, y in seen) < 0.75 * PIXEL
    assert len(set(np.round(planets["separation"].value, 3))) == count
    assert "..." not in str(planets)


def test_no_planet_is_where_extended_light_would_hide_it():
    """All but a quarter of the field is hidden."""
    grid = searched().grid
    hidden = (grid[..., 0] < 0) | (grid[..., 1] < 0)
    images = []

    def search(science):
        images.append(science[0].data[0])
        return searched(science)

    planets = recover_planets(searched(has_limits=~hidden), 5, search)
    assert len(planets) == 5
    assert sum(np.count_nonzero(each) for each in images) == 5
    assert not any(each[hidden].any() for each in images)


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


def test_recovered_contrasts_are_relative_to_the_star_of_the_injection():
    """Though the star is twice as bright in the fit of the frames with planets."""

    def search(science):
        brighter = SimpleNamespace(frames=[Frame(2.0), Frame(4.0)])
        return searched(science, fits=[brighter])

    planets = recover_planets(searched(), 2, search)
    np.testing.assert_allclose(planets["contrast"], 2 * planets["injected"])


def covered(keep):
    plain = searched()
    x, y = np.moveaxis(plain.grid, -1, 0)
    return searched(snr=np.where(keep(x, y), plain.snr, np.nan))


def test_planets_keep_away_from_candidates_and_from_pixels_without_a_value():
    first = _free_place(searched(), 0.6, 0.0)
    assert first == pytest.approx([0.0, 0.6])
    candidate = searched(candidates=table(first[None], [1e-3]))
    moved = _free_place(candidate, 0.6, 0.0)
    assert np.hypot(*moved) == pytest.approx(0.6)
    assert 0.3 < np.hypot(*(moved - first)) < 0.5
    below = _free_place(covered(lambda x, y: y < 0), 0.6, 0.0)
    assert below[1] < 0
    # Without any such place, planets are not left out.
    assert _free_place(covered(lambda x, y: x > 9), 0.6, 0.0) == pytest.approx(first)


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


@pytest.mark.parametrize("count", [-1, 2.5])
def test_a_wrong_number_of_planets_is_refused_before_anything_is_read(count):
    with pytest.raises(IncompatibleSetupError, match="injections"):
        dr.reduce("no such folder", "no such map", injections=count)
