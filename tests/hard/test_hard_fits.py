"""Fits of hard data: success means right, and what no image shows stays where it was."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from benchmarks import stability_fits as hard
from benchmarks.hard_cases import DTYPES, small, threads, wavefront
from pyklip_diffrender import errors
from pyklip_diffrender.refinement import Status
from pyklip_diffrender.scene.objects import Scene
from pyklip_diffrender.scene.simulation import simulate
from pyklip_diffrender.wavefront.opd import as_opd_map

pytestmark = pytest.mark.hard

QUICK = ("saturated core, flagged", "bright planet, 1e-3")
"""One of each kind: the others need ``--full``."""

BY_HAND = ("the start transposed", "the start mirrored", "5 % of the pixels missing")
"""Only in `benchmarks.stability`: of the kind of harder ones that are tested."""


@lru_cache(maxsize=32)
def result(row, dtype):
    """Each fit once."""
    return row.run(dtype)


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, id=row.case, marks=() if row.case in QUICK else pytest.mark.slow)
        for row in hard.FITS
        if row.case not in BY_HAND
    ],
)
def test_a_fit_ends_as_the_table_says(row):
    fit, error = result(row, torch.float64)
    assert fit.status in row.ends
    # Of the fitted star: right where the fit says that it is, and a number everywhere.
    assert error <= row.limit
    assert np.isfinite(fit.frames[0].star).all()
    assert np.isfinite(fit.wavefront).all()
    if "planet listed" in row.sees:
        ((contrast, *_),) = fit.companions.tolist()
        assert contrast == pytest.approx(1e-3, abs=4 * fit.companion_errors[0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("case", ["50 % missing", "the same with max_companions=1"])
def test_a_float32_model_fits_as_well(case):
    """The optics in float32, the algebra in float64."""
    row = next(row for row in hard.FITS if row.case == case)
    single, error = result(row, torch.float32)
    assert single.status in row.ends
    assert error <= row.limit
    double, _ = result(row, torch.float64)
    # In the worst pixel: 1e-6 of a star whose brightest pixel has 690 sigma, and what a fit that
    # stops at a tolerance makes of it. A 1 % brighter star is 7 sigma away there.
    assert np.abs((single.frames[0].star - double.frames[0].star) / hard.noise()).max() < 0.05


@pytest.mark.slow
def test_piston_of_all_segments_does_not_drift_and_is_reported_as_unknown():
    found = hard.piston_of_segments()
    assert found.fit.status is Status.CONVERGED
    assert abs(found.together) < 0.2 * hard.PRIOR
    assert 0.98 * hard.PRIOR < found.error <= hard.PRIOR * (1 + 1e-9)
    # Not because nothing was learnt: single pistons move, and the best known motion is known.
    assert found.fit.frames[0].coefficients[:54:3].std() > 0.3
    errors = found.fit.linear.covariance.diagonal().sqrt()[-len(hard.MORE) :]
    assert errors[:54].min() < 0.5 * hard.PRIOR


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
def test_masked_pixels_of_a_finished_observation_change_nothing_bitwise(dtype):
    """Masked after the observation was made, so that what is there is still there."""
    frame = hard.observed(hard.star())
    valid = np.random.default_rng(4).random(frame.data.shape) > 0.05
    clean, *dirty = (
        hard.fitted(replace(frame, data=data, valid=valid), dtype=dtype, max_iterations=3)
        for data in (frame.data, *(np.where(valid, frame.data, k) for k in (1e30, -1e300, np.nan)))
    )
    for each in dirty:
        assert each.wavefront.tobytes() == clean.wavefront.tobytes()
        assert each.frames[0].star.tobytes() == clean.frames[0].star.tobytes()
        assert each.chi2_per_pixel == clean.chi2_per_pixel
        assert np.isfinite(each.frames[0].star).all()


@pytest.mark.slow
def test_a_fit_with_eight_threads_is_the_serial_fit():
    """Bits differ, sums are taken in another order; a thousandth of the noise is allowed."""
    fits = []
    for count in (8, 8, 1):
        with threads(count):
            fits.append(hard.fitted(hard.observed(hard.star()), max_iterations=6))
    first, again, serial = fits
    assert first.wavefront.tobytes() == again.wavefront.tobytes()
    assert first.frames[0].star.tobytes() == again.frames[0].star.tobytes()
    assert np.abs((first.frames[0].star - serial.frames[0].star) / hard.noise()).max() < 1e-3
    assert first.status is serial.status
    assert hard.error_of(first.frames[0].star) < 1


def changed(cards=None, **changes):
    frame = replace(hard.observed(hard.star()), **changes)
    header = frame.header.copy()
    header.update(cards or {})
    return replace(frame, header=header)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"filter": "F335M"}, errors.IncompatibleSetupError, r"F335M.*F444W"),
        ({"cards": {"MODULE": "B"}}, errors.IncompatibleSetupError, "B"),
        ({"cards": {"CORONMSK": "MASKA210R"}}, errors.IncompatibleSetupError, "MASKA210R"),
        # The short-wave channel has half the scale.
        ({"pixelscale": (0.031, 0.031)}, errors.IncompatibleSetupError, r"0\.031"),
        ({"valid": np.zeros((1, 24, 24), dtype=bool)}, errors.NoValidPixelsError, None),
    ],
)
def test_a_frame_that_is_not_the_models_is_refused(changes, error, words):
    with pytest.raises(error, match=words):
        hard.fitted(changed(**changes), max_iterations=1)


def test_a_frame_of_the_same_instrument_is_taken():
    """Headers name the module with the mask; pixels are not square."""
    cards = {"MODULE": "A", "CORONMSK": "MASKA335R", "PUPIL": "MASKRND"}
    real = changed(cards, filter="F444W", pixelscale=(0.0620, 0.0628))
    fit, same = (hard.fitted(each, max_iterations=1) for each in (real, hard.observed(hard.star())))
    assert fit.frames[0].star.tobytes() == same.frames[0].star.tobytes()


def test_a_model_and_a_simulation_read_arrays_as_maps_are_read():
    plain = wavefront().numpy()
    big = plain.astype(">f8")
    big.setflags(write=False)
    for kind in (big, np.asfortranarray(plain), as_opd_map(plain), plain.tolist()):
        assert torch.equal(small()(kind), small()(plain))
    bad = plain.astype(">f4")
    bad[30, 50], bad[31, 40] = np.nan, -np.inf
    for call in (small(), lambda opd: simulate(small(), Scene(), opd, seed=1)):
        with pytest.raises(errors.NonFiniteError, match=r"2 values.*\(30, 50\)"):
            call(bad)
        with pytest.warns(errors.DiffrenderWarning, match="in nm it would be plausible"):
            call(plain * 1e9)


def test_what_a_fit_may_try_does_not_warn():
    """Tensors are what is fitted; a mode of 1 pm is a fair question. Warnings are errors here."""
    assert small()(wavefront() * 1e9).isfinite().all()
    assert small()(1e-12 * wavefront(rms=1.0).numpy()).isfinite().all()


def test_a_field_wider_than_the_pupil_resolves_is_refused():
    """32 samples repeat the image after 32 lambda/D, 4.5 arcsec: the field has 5."""
    with pytest.raises(errors.IncompatibleSetupError, match="npix"):
        small(npix=32, fov_pixels=80)
