"""Fits of hard data: success means right, and what no image shows stays where it was."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from hard_cases import DTYPES
from stability_fits import (
    FITS,
    FLUX,
    NPIX,
    OFFSET,
    PRIOR,
    fitted,
    model,
    noise,
    observed,
    old,
    piston_of_segments,
    star,
)

from pyklip_diffrender.optics import PupilGrid
from pyklip_diffrender.parameters import OPTICAL_PARAMETERS, parameter
from pyklip_diffrender.refinement import Status
from pyklip_diffrender.wavefront import FourierModes

pytestmark = pytest.mark.hard


STEPS = {
    "star_offset": 1e-5, "lyot_shift": 1e-5, "lyot_rotation": 1e-3, "si_zernikes": 1e-11,
    "detector_shift": 1e-5, "blur": 1e-4, "flux": 1e-4 * FLUX, "background": 1.0, "modes": 0.01,
}  # fmt: skip
"""Of finite differences: small against what bends the image, large against rounding."""

QUICK = ("saturated core, flagged", "bright planet, 1e-3")
"""One of each kind: the others need ``--full``."""


@lru_cache(maxsize=32)
def result(row, dtype):
    """Each fit once."""
    return row.run(dtype)


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, id=row.case, marks=() if row.case in QUICK else pytest.mark.slow)
        for row in FITS
        if row.case != "the start transposed"  # In `benchmarks.stability`.
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
@pytest.mark.parametrize(
    "case",
    ["nothing hard", "50 % missing", "saturated core, flagged", "the same with max_companions=1"],
)
def test_a_float32_model_fits_as_well(case):
    """The optics in float32, the algebra in float64."""
    row = next(row for row in FITS if row.case == case)
    single, error = result(row, torch.float32)
    assert single.status in row.ends
    assert error <= row.limit
    double, _ = result(row, torch.float64)
    # In the worst pixel: 1e-6 of a star whose brightest pixel has 690 sigma, and what a fit that
    # stops at a tolerance makes of it. A 1 % brighter star is 7 sigma away there.
    assert np.abs((single.frames[0].star - double.frames[0].star) / noise()).max() < 0.05


@pytest.mark.slow
def test_piston_of_all_segments_does_not_drift_and_is_reported_as_unknown():
    found = piston_of_segments()
    assert found.fit.status is Status.CONVERGED
    assert abs(found.together) < 0.2 * PRIOR
    assert 0.98 * PRIOR < found.error <= PRIOR * (1 + 1e-9)
    # Not because nothing was learnt: single pistons move, and the best known motion is known.
    assert found.coefficients[::3].std() > 0.3
    assert found.errors.min() < 0.5 * PRIOR


def test_the_jacobian_of_a_fit_matches_finite_differences_in_every_column():
    """All that a fit may leave free, flux and background and modes too."""
    names = (*(p.name for p in OPTICAL_PARAMETERS), "flux", "background")
    basis = FourierModes(1)
    start = {"blur": 0.02, "star_offset": OFFSET}
    fit = fitted(observed(star()), basis=basis, free=names, start=start, max_iterations=2)
    (frame,) = fit.linear.frames
    labels = [str(unknown) for unknown in fit.linear.unknowns]
    at = dict(zip(labels, fit.linear.vector.tolist(), strict=True))
    sizes = {name: parameter(name).size for name in names} | {"modes": len(basis)}
    assert len(at) == len(frame.jacobian) == sum(sizes.values())

    def image(values):
        """The star, without the package's own linearisation."""
        vectors = {
            name: torch.tensor([values[f"{name}[{k}]"] for k in range(size)], dtype=torch.float64)
            for name, size in sizes.items()
        }
        optical = {name: v for name, v in vectors.items() if name in model().parameters}
        opd = old() + basis.opd(vectors["modes"] * 1e-9, PupilGrid.full(NPIX)).numpy()
        star = model()(opd, **optical).numpy()
        return float(vectors["flux"]) * star + float(vectors["background"])

    for label, got in zip(labels, frame.jacobian.double().numpy(), strict=True):
        name = label.split("[")[0]
        step = STEPS[name]
        ends = [image({**at, label: at[label] + k * step}) for k in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        # Responses are kept in single precision, those of modes with a short transform that wraps
        # the faintest light; areas of pixels that an edge of the Lyot stop cuts are only once
        # differentiable.
        limit = 2e-3 if name.startswith("lyot") else 5e-4 if name == "modes" else 1e-4
        # Piston, the first Zernike, has no slope but rounding.
        rounding = 200 * np.finfo(float).eps * ends[0].max() / step
        assert np.abs(got - slope).max() < limit * np.abs(slope).max() + rounding, label
        assert np.abs(slope).max() > 20 * rounding or label == "si_zernikes[0]", label


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
@pytest.mark.parametrize("junk", [1e30, -1e300, np.nan])
def test_masked_pixels_of_a_finished_observation_change_nothing_bitwise(junk, dtype):
    """Masked after the observation was made, so that what is there is still there."""
    frame = observed(star())
    valid = np.random.default_rng(4).random(frame.data.shape) > 0.05
    spoilt = replace(frame, data=np.where(valid, frame.data, junk), valid=valid)
    clean, dirty = (
        fitted(each, dtype=dtype, max_iterations=3)
        for each in (replace(frame, valid=valid), spoilt)
    )
    assert dirty.wavefront.tobytes() == clean.wavefront.tobytes()
    assert dirty.frames[0].star.tobytes() == clean.frames[0].star.tobytes()
    assert dirty.chi2_per_pixel == clean.chi2_per_pixel
    assert np.isfinite(dirty.frames[0].star).all()
