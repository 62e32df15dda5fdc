"""Search of whole frames, on simulated rolls of a star with planets in and beyond the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits as astropy_fits
from astropy.table import QTable

import pyklip_diffrender as dr
from pyklip_diffrender.detection import wide_field
from pyklip_diffrender.detection.whole_frame import WholeFrame
from pyklip_diffrender.errors import IncompatibleSetupError

WHOLE, FITTED = 120, 48
ROLLS = (20.0, 31.0)
STAR = dr.Star(w2_magnitude=6.5, exposure=1800.0)
PLANETS = (
    dr.Planet(2e-5, separation=0.9, position_angle=60.0),
    dr.Planet(1.5e-5, separation=2.1, position_angle=200.0),
    dr.Planet(2.5e-5, separation=2.4, position_angle=300.0),
)


def rolls():
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
def searched():
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
def wide(searched):
    return wide_field(*searched)


POINT = dr.Planet.from_offset(3e-5, -1.7, 1.4)
WIDTHS, AXIS = (0.3, 0.12), 130.0
"""Standard deviations of an extended source, arcsec, and angle of its long axis from +y, deg."""


def gaussian(contrast, x, y):
    """A Gaussian of point sources 0.14 arcsec apart, out to 2.4 standard deviations."""
    steps = np.mgrid[-6:7, -6:7].reshape(2, -1).T * 0.14
    angle = np.deg2rad(AXIS)
    along = steps @ [-np.sin(angle), np.cos(angle)]
    across = steps @ [np.cos(angle), np.sin(angle)]
    weights = np.exp(-((along / WIDTHS[0]) ** 2 + (across / WIDTHS[1]) ** 2) / 2)
    shown = weights > 0.05
    weights = contrast * weights[shown] / weights[shown].sum()
    return tuple(
        dr.Planet.from_offset(w, x + step[0], y + step[1])
        for w, step in zip(weights, steps[shown], strict=True)
    )


@pytest.fixture(scope="module")
def crowded():
    """A point source, an extended one, and another one at the lower edge; the star is known."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=100)
    opd = dr.random_opd(1, npix=128)
    planets = (POINT, *gaussian(4e-4, 1.3, 0.2), *gaussian(1e-3, -0.4, -2.4))
    frame = dr.simulate(model, dr.Scene(STAR, planets=planets), opd, seed=5)
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    settings = dr.GaussNewton(wavefront=False, companions_if_stalled=False)
    fit = dr.refine(model, frame.cutout(24), opd, settings=settings)
    return dr.detect(fit, relinearise=False), frame


@pytest.fixture(scope="module")
def crowded_field(crowded):
    detection, frame = crowded
    return wide_field(detection, [frame])


@pytest.mark.slow
def test_an_extended_source_is_one_row_with_its_shape(crowded_field):
    table = crowded_field.candidates
    table = table[np.isfinite(table["fit_chi2"])]
    assert sorted(table["shape"]) == ["extended", "point"]
    (point,), (extended,) = (table[table["shape"] == kind] for kind in ("point", "extended"))
    assert np.hypot(point["x"].value - POINT.offset[0], point["y"].value - POINT.offset[1]) < 0.02
    assert point["fit_chi2"] < 2
    assert point["contrast"] == pytest.approx(POINT.contrast, rel=0.2)
    assert np.isnan(point["fwhm_major"])
    assert np.hypot(extended["x"].value - 1.3, extended["y"].value - 0.2) < 0.05
    assert extended["fit_chi2"] > 3
    # The background takes some of its outskirts.
    assert extended["contrast"] == pytest.approx(4e-4, rel=0.3)
    widths = [extended[name].value for name in ("fwhm_major", "fwhm_minor")]
    np.testing.assert_allclose(widths, 2.355 * np.array(WIDTHS), rtol=0.25)
    assert extended["axis_angle"].value == pytest.approx(AXIS, abs=8)


def test_nothing_is_found_outside_the_searched_pixels(crowded):
    """Those are 16 pixels from the last valid rows and columns, also where the file has more."""
    detection, frame = crowded
    valid = frame.valid.copy()
    valid[:, -20:] = False
    wide = wide_field(detection, [replace(frame, valid=valid)])
    rows, columns = np.nonzero(np.isfinite(wide.snr))
    # The fitted pixels are in the middle of the frame.
    assert (rows.min(), rows.max()) == (16, 99 - 20 - 16)
    assert (columns.min(), columns.max()) == (16, 99 - 16)
    x, y = (wide.candidates[name].value for name in ("x", "y"))
    edge = (50 - 16) * 0.0629
    assert (np.abs(x) < edge).all()
    assert (y > -edge).all()
    assert (y < edge - 20 * 0.0629).all()
    # The point source is now beyond the last rows that are searched.
    assert "point" not in wide.candidates["shape"][np.isfinite(wide.candidates["fit_chi2"])]


def test_the_map_has_north_up_and_numbered_circles(crowded, crowded_field):
    detection, frame = crowded
    wide = crowded_field
    turned = replace(frame, position_angles=np.array([90.0]))
    fit = detection.fits[0]
    part = replace(fit.frames[0], observation=turned.cutout(24))
    oriented = replace(wide, detection=replace(
        detection, fits=(replace(fit, frames=(part,)),)
    ))  # fmt: skip
    for each, turn in ((wide, lambda x, y: (x, y)), (oriented, lambda x, y: (-y, x))):
        ax, _ = each.plot()
        labels = {text.get_text(): text.xy for text in ax.texts if text.get_text().isdigit()}
        assert len(labels) == len(wide.candidates)
        for k, row in enumerate(wide.candidates, 1):
            place = turn(row["x"].value, row["y"].value)
            np.testing.assert_allclose(labels[str(k)], place, atol=1e-9)
            # The map has the source where the circle is.
            (image,) = ax.images
            left, right, bottom, top = image.get_extent()
            ny, nx = image.get_array().shape
            column = int((place[0] - left) / (right - left) * nx)
            line = int((place[1] - bottom) / (top - bottom) * ny)
            near = image.get_array()[line - 1 : line + 2, column - 1 : column + 2]
            assert near.max() > 0.6 * row["snr"] if row["shape"] != "extended" else near.max() > 5


@pytest.mark.slow
def test_planets_are_measured_wherever_they_are(wide):
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
def test_contrasts_outside_have_the_error_of_the_stars_flux_as_well(wide, searched):
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
def test_maps_are_those_of_the_fit_about_the_star(wide, searched):
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
def test_a_wide_field_is_written_and_drawn(wide, tmp_path):
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
def test_other_frames_are_refused(searched):
    detection, frames = searched
    with pytest.raises(IncompatibleSetupError, match="expected those of the fit"):
        wide_field(detection, frames[:1])
    with pytest.raises(IncompatibleSetupError, match="before they were cut"):
        wide_field(detection, [each.cutout(40) for each in frames])


@pytest.mark.slow
def test_a_hot_pixel_is_no_source_and_a_source_no_hot_pixel(searched):
    detection, frames = searched
    fit = detection.fits[0].frames[0]
    planets = WholeFrame(fit, frames[0], 0.0)
    assert np.isfinite(planets.sigma).all()
    data = frames[0].data.copy()
    data[0, 20, 80] += 100 * frames[0].error[0, 20, 80]
    hot = WholeFrame(fit, replace(frames[0], data=data), 0.0)
    assert np.argwhere(np.isinf(hot.sigma)).tolist() == [[20, 80]]
