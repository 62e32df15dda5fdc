"""Search of whole frames, on simulated rolls of a star with planets in and beyond the fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits as astropy_fits
from astropy.table import QTable

import pyklip_diffrender as dr
from pyklip_diffrender.detection import Detection, WideField, wide_field, wide_search
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.whole_frames import WholeFrame
from pyklip_diffrender.errors import IncompatibleSetupError

WHOLE, FITTED = 120, 48
ROLLS = (20.0, 31.0)
STAR = dr.Star(w2_magnitude=6.5, exposure=1800.0)
PLANETS = (
    dr.Planet(2e-5, separation=0.9, position_angle=60.0),
    dr.Planet(1.5e-5, separation=2.1, position_angle=200.0),
    dr.Planet(2.5e-5, separation=2.4, position_angle=300.0),
)


def rolls() -> list[dr.Observation]:
    """Two rolls of a star with three planets, at their position angles east of north."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=WHOLE)
    opd = dr.random_opd(1, npix=128)
    frames = []
    for k, roll in enumerate(ROLLS):
        seen = tuple(replace(each, position_angle=each.position_angle - roll) for each in PLANETS)
        frame = dr.simulate(model, dr.Scene(STAR, planets=seen), opd, seed=5 + k)
        frames.append(
            replace(frame, position_angles=np.full(len(frame), roll), name=f"roll{k}.fits")
        )
    return frames


@pytest.fixture(scope="module")
def searched() -> tuple[Detection, list[dr.Observation]]:
    frames = rolls()
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=FITTED)
    settings = dr.GaussNewton(cycles=8)
    cut = [each.cutout(FITTED) for each in frames]
    fit = dr.refine(model, cut, dr.random_opd(1, npix=128), settings=settings)
    # As in `reduce`, once more without the light of the sources beyond the fitted pixels.
    cleaned = wide_field(dr.detect(fit), frames).subtracted(frames, cut)
    assert cleaned is not None
    opd = dr.random_opd(1, npix=128)
    return dr.detect(dr.refine(model, cleaned, opd, settings=settings)), frames


@pytest.fixture(scope="module")
def wide(searched: tuple[Detection, list[dr.Observation]]) -> WideField:
    return wide_field(*searched)


def test_sources_that_a_joint_fit_leaves_faint_are_no_candidates() -> None:
    """Peaks of a background above zero: each is above the threshold alone, not beside the rest."""
    variance = np.array([1e-12, 1e-6, 1e-6])
    sources = [
        wide_search._Measurement(np.array([contrast, x, 0.0]), variance, 1.0)
        for contrast, x in ((2e-5, 1.0), (-8e-6, 2.0), (4e-6, 3.0), (6e-6, 4.0))
    ]
    factor = ErrorFactor.constant(1.5)
    # S/N 13, -5, 3 and 4; without frames nothing is fitted again.
    kept = wide_search._significant((), sources, factor, 5.0)
    assert kept == sources[:1]
    assert wide_search._significant((), [], factor, 5.0) == []


@pytest.mark.slow
def test_planets_are_measured_wherever_they_are(wide: WideField) -> None:
    assert len(wide.candidates) == len(PLANETS)
    for planet in PLANETS:
        row = wide.candidates[np.argmin(np.abs(wide.candidates["contrast"] - planet.contrast))]
        for name, true in (
            ("separation", planet.separation),
            ("position_angle", planet.position_angle),
        ):
            value, error = row[name].value, row[f"{name}_error"].value
            # The image far from the star is that at 4 arcsec; a few milliarcsec are systematic.
            slack = 0.005 if name == "separation" else 0.2
            assert abs(value - true) < 4 * error + slack, name
        assert float(row["contrast"]) == pytest.approx(
            planet.contrast, abs=4 * float(row["contrast_error"]), rel=0.05
        )
        assert row["fit_chi2"] < 3 or np.isnan(row["fit_chi2"])


@pytest.mark.slow
def test_contrasts_outside_have_the_error_of_the_stars_flux_as_well(
    wide: WideField, searched: tuple[Detection, list[dr.Observation]]
) -> None:
    detection, frames = searched
    (fit,) = detection.fits
    uncertain = replace(fit, catalogue_error=0.1)
    again = wide_field(replace(detection, fits=(uncertain,)), frames).candidates
    outside = np.isfinite(again["fit_chi2"])
    assert outside.any()
    added = again["contrast_error"] ** 2 - wide.candidates["contrast_error"] ** 2
    ratio = np.sqrt(np.abs(added[outside])) / again["contrast"][outside]
    np.testing.assert_allclose(ratio, 0.1, rtol=1e-3)


@pytest.mark.slow
def test_maps_are_those_of_the_fit_about_the_star(
    wide: WideField, searched: tuple[Detection, list[dr.Observation]]
) -> None:
    detection, _ = searched
    begin = (WHOLE - FITTED) // 2
    window = (slice(begin, begin + FITTED),) * 2
    np.testing.assert_array_equal(wide.snr[window], detection.contrast / detection.error)
    np.testing.assert_allclose(wide.grid[window], detection.grid, atol=1e-9)
    curve = wide.contrast_curve
    assert curve["separation"].value.max() > 2.2 > detection.contrast_curve["separation"][-1].value
    # Seamless: where the star is no longer seen, the limits of both are those of the background.
    near = np.interp(1.4, curve["separation"].value, curve["contrast"])
    far = np.interp(2.2, curve["separation"].value, curve["contrast"])
    assert 0.3 < far / near < 1.5


@pytest.mark.slow
def test_a_wide_field_is_written_and_drawn(wide: WideField, tmp_path: Path) -> None:
    written = wide.write(tmp_path)
    assert [path.name for path in written] == [
        "wide_field.fits", "wide_field_candidates.ecsv", "wide_field_contrast.ecsv",
    ]  # fmt: skip
    with astropy_fits.open(written[0]) as hdus:
        np.testing.assert_array_equal(hdus["SNR"].data, wide.snr)
        np.testing.assert_array_equal(hdus["OFFSET_Y"].data, wide.grid[..., 1])
    table = QTable.read(written[1])
    np.testing.assert_allclose(table["snr"], wide.candidates["snr"])
    map_axes, _ = wide.plot()
    assert map_axes.get_title(loc="left").startswith("3 candidates above")
    assert str(wide).count("arcsec") == 3


@pytest.mark.slow
def test_frames_hardly_larger_than_the_fitted_square(
    searched: tuple[Detection, list[dr.Observation]],
) -> None:
    detection, frames = searched
    small = [frame.cutout(FITTED + 20) for frame in frames]
    with pytest.raises(IncompatibleSetupError, match=f"68 x 68 pixels.*more than {FITTED + 32}"):
        wide_field(detection, small)
    # Nowhere 2 arcsec from the star, the background is that of the outer pixels.
    (fit,) = detection.fits
    residual = WholeFrame(fit.frames[0], frames[0].cutout(FITTED), 0.0, np.zeros((0, 3))).residual
    assert np.isfinite(residual).all()
    assert abs(np.median(residual)) < 0.2 * np.std(residual)


@pytest.mark.slow
def test_other_frames_are_refused(searched: tuple[Detection, list[dr.Observation]]) -> None:
    detection, frames = searched
    with pytest.raises(IncompatibleSetupError, match="expected those of the fit"):
        wide_field(detection, frames[:1])
    with pytest.raises(IncompatibleSetupError, match="before they were cut"):
        wide_field(detection, [each.cutout(40) for each in frames])


@pytest.mark.slow
def test_a_hot_pixel_is_no_source_and_a_source_no_hot_pixel(
    searched: tuple[Detection, list[dr.Observation]],
) -> None:
    detection, frames = searched
    fit = detection.fits[0].frames[0]
    planets = WholeFrame(fit, frames[0], 0.0)
    assert np.isfinite(planets.sigma).all()
    data = frames[0].data.copy()
    data[0, 20, 80] += 100 * frames[0].error[0, 20, 80]
    hot = WholeFrame(fit, replace(frames[0], data=data), 0.0)
    assert np.argwhere(np.isinf(hot.sigma)).tolist() == [[20, 80]]
