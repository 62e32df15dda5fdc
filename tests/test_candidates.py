"""Candidates: companions of a fit among them, light of hidden sources, errors of places."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyklip_diffrender as dr
from benchmarks.planets import searched
from pyklip_diffrender.detection import candidates as module
from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import separation_of
from pyklip_diffrender.detection.search import side_lobes
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.optics.grid import PupilGrid

FOUND = Candidates.at([[0.6, 0.3]], [3e-4])


def fake_fit(*companions):
    """A fit of lambda/D = 0.14 arcsec with companions."""
    array = np.reshape(companions, (-1, 3)).astype(float)
    return SimpleNamespace(
        companions=array,
        companion_errors=np.tile([1e-6, 1e-3, 1e-3], (len(array), 1)),
        model=SimpleNamespace(resolution=0.14),
    )


THERE = (3e-4, 0.6, 0.3)


@pytest.mark.parametrize(
    ("fit", "lacks", "unconfirmed"),
    [
        # A speckle in place of the planet, which a count would not notice.
        (fake_fit((3e-4, -0.6, 0.3)), True, True),
        # At the right place with a fifth more light.
        (fake_fit((3.62e-4, 0.6, 0.3)), True, True),
        (fake_fit((3.1e-4, 0.61, 0.3)), False, False),
        (fake_fit(), True, False),
        (fake_fit(THERE, (1e-5, -0.6, 0.3)), True, True),
    ],
)
def test_companions_are_compared_by_place_and_contrast(fit, lacks, unconfirmed):
    assert module.lacks_candidates(fit, FOUND) is lacks
    assert (len(module.unconfirmed_companions(fit, FOUND)) > 0) is unconfirmed


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
    ],
)
def test_a_planet_that_ends_a_fit_at_a_wrong_wavefront_is_found(seed, cycles):
    outcome = searched(seed, cycles=cycles)
    assert outcome.verdict == "found", outcome.scene
    assert not outcome.false
    # The errors of bright companions are those of the star's flux, about 0.1 %.
    assert abs(outcome.pull) < 4


def changed(share, *planets):
    """A model, a map, and a frame of planets under a wavefront that has changed."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=128, fov_pixels=28)
    before, change = (dr.wavefront.random_opd(k, npix=128) for k in (8, 9))
    now = replace(before, data=before.data + share * change.data)
    return model, dr.simulate(model, dr.Scene(planets=planets), now, seed=5), before, now


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [0.0, 1e-3])
def test_a_companion_that_was_an_error_of_the_wavefront_is_dropped(contrast, caplog):
    """The alignment alone leaves peaks, which the wavefront explains; a planet stays."""
    *given, _ = changed(0.2, dr.Planet(contrast, 0.6, 70.0))
    preset = dr.FitSettings.nircam(
        "F444W", cycles=(9.0,), max_iterations=12, companion_threshold=2.0
    )
    with caplog.at_level("INFO", logger="pyklip_diffrender"):
        fit = dr.refine(*given, settings=preset)
    assert "possible sources" in caplog.text
    assert "outshines" not in caplog.text
    assert ("are dropped" in caplog.text) == (contrast == 0)
    assert fit.companions[:, 0].tolist() == pytest.approx([contrast] if contrast else [], rel=0.05)


@pytest.mark.parametrize("changes", [{}, {"companions_if_stalled": False, "max_companions": 1}])
def test_a_companion_that_outshines_the_star_is_fitted_with_it(caplog, changes):
    """Fitted alone, the star's flux would be negative. Few modes leave an error of 2 %."""
    caplog.set_level("INFO")
    planet = dr.Planet(0.08, 0.6, 70.0)
    *given, now = changed(0.1, planet)
    model = given[0]
    assert model(now).max() < planet.contrast * model(now, planet.offset).max()
    fit = dr.refine(*given, settings=dr.FitSettings(cycles=3, max_iterations=6, **changes))
    (companion,) = fit.companions
    assert "outshines" in caplog.text
    assert companion[0] == pytest.approx(planet.contrast, rel=0.03)
    assert companion[1:] == pytest.approx(planet.offset, abs=0.002)
    assert fit.model_error < 0.02


@pytest.mark.slow
def test_bright_neighbours_are_companions_of_a_fit():
    """One may be faint, and others are too bright for the wavefront to have left them."""
    *given, _ = changed(0.1, dr.Planet(5e-3, 0.6, 70.0), dr.Planet(3e-3, 0.7, 250.0))
    fit = dr.refine(*given, settings=dr.FitSettings(
        cycles=3, max_iterations=6, max_companions=1, companions_if_stalled=False,
    ))  # fmt: skip
    assert sorted(fit.companions[:, 0]) == pytest.approx([3e-3, 5e-3], rel=0.05)


HIDDEN, PLANET, LOBE = (0.1, -0.08), (-0.3, 0.5), (0.22, 0.3)
BESIDE = (0.34, -0.09)
"""The templates of this and of `HIDDEN` have a correlation of 0.48."""

UNIT = ErrorFactor.constant(1.0)


@cache
def star():
    """Templates in a frame of a star that was fitted."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=128, fov_pixels=28)
    opd = dr.wavefront.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(), opd, seed=2)
    return Templates(dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=5)))


def candidates_of(light):
    """Images of sources at x, y with an S/N of each, and candidates as bright."""
    images = star().at(torch.tensor(list(light), dtype=torch.float64))
    contrasts = star().linear.weigh(images).information.rsqrt() * torch.tensor(list(light.values()))
    return images[0].double(), Candidates.at(list(light), contrasts)


def lobes(light, found):
    """Which candidates are lobes in frames with such sources, and S/N behind the mask."""
    fit, linear = star().fit, star().linear
    images, sources = candidates_of(light)
    added = torch.tensordot(sources.contrasts, images, dims=1)
    changed = replace(linear.frames[0], residual=added)
    maps = module.Maps(Templates(replace(fit, stored_linear=replace(linear, frames=(changed,)))))
    _, candidates = candidates_of(found)
    snr = maps.snr(maps.without(candidates))
    is_lobe = side_lobes(maps, snr, candidates, UNIT, 5.0, 0.2).tolist()
    return is_lobe, snr[separation_of(maps.grid) < 0.2].max()


@pytest.mark.parametrize(
    ("light", "found", "expected"),
    [
        # A planet stays, and a peak that a hidden source explains does not.
        ({HIDDEN: 60.0, PLANET: 30.0}, {PLANET: 30.0, LOBE: 6.0}, [False, True]),
        # Without a hidden source nothing is explained.
        ({PLANET: 30.0, LOBE: 6.0}, {PLANET: 30.0}, [False]),
        # A source that is not significant explains nothing.
        ({HIDDEN: 3.5, BESIDE: 4.0}, {BESIDE: 5.7}, [False]),
    ],
)
def test_a_peak_that_a_hidden_source_explains_is_no_candidate(light, found, expected):
    assert lobes(light, found)[0] == expected


def test_a_source_may_be_significant_only_beside_the_candidate():
    """A candidate that has taken light of the hidden source leaves less than 5 sigma of it."""
    is_lobe, behind_mask = lobes({HIDDEN: 5.6, BESIDE: 3.2}, {BESIDE: 6.0})
    assert behind_mask < 4.8
    assert is_lobe == [True]


@pytest.mark.slow
def test_no_candidate_beside_a_planet_behind_the_mask():
    """A planet of 9e-5 at 0.11 arcsec ends a fit as CONVERGED, with a peak of 5.1 at 0.35."""
    outcome = searched(60)
    assert outcome.false == ()
    assert outcome.verdict == "fainter than the curve"
    assert np.isnan(outcome.pull)


BRIGHT, FAINT = (0.45, 0.5), (-0.6, 0.2)
PLACES = ((0.1, -0.7), FAINT)
FREE = ("star_offset", "detector_shift", "si_zernikes")
"""All of them move light on the detector, and are nearly degenerate."""

SIZES = {"star_offset": 1e-3, "detector_shift": 1e-3, "si_zernikes": 2e-9, "modes": 2.0}
"""Changes that move light by about 0.3 mas."""


@pytest.fixture(scope="module")
def fit():
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=64, fov_pixels=36)
    opd = dr.wavefront.random_opd(1, npix=64)
    planets = (dr.Planet.from_offset(4e-3, *BRIGHT), dr.Planet.from_offset(9e-5, *FAINT))
    frame = dr.simulate(model, dr.Scene(planets=planets), opd, seed=3)
    settings = dr.FitSettings(
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
        step = torch.zeros(len(basis if name == "modes" else values[name]), dtype=torch.float64)
        step[component] = SIZES[name]
        images = []
        for change in (step, -step):
            opd, moved = torch.from_numpy(frame.opd.copy()), values
            if name == "modes":
                opd = opd + basis.opd(change * 1e-9, grid)
            else:
                moved = {**values, name: values[name] + change}
            with torch.no_grad():
                images.append(frame.model(opd, **moved).double().numpy())
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
    candidates = Candidates.at(PLACES, [3e-5, 3e-5])
    added = (
        module.with_position_of_star(Templates(fit), candidates).covariance - candidates.covariance
    ).numpy()
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
    of_star = module.with_position_of_star(
        search.templates, Candidates.at([FAINT], [9e-5]), torch.tensor(FAINT, dtype=torch.float64)
    ).errors[0, 1:]
    own = module.refine_candidates(search.templates, search.sources, reach=0.01)
    # The light of the bright planet counts in the derivatives by what moves the star.
    assert (own.errors[0, 1:] > 0.9 * of_star).all()
    added = (search.sources.covariance - own.covariance).diagonal().reshape(3, 2).T
    assert added[0].numpy() == pytest.approx(0, abs=1e-3 * float(of_star.min() ** 2))
    np.testing.assert_allclose(added[1, 1:], of_star**2, rtol=0.01)
    # The table has these errors, scaled.
    factor = search.error_factor.of(search.sources.offsets)
    stated = search.candidates["x_error"].to_value("arcsec")
    np.testing.assert_allclose(stated, factor * search.sources.errors[:, 1].numpy())
