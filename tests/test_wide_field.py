"""Search of whole frames, and extended light that is fitted together with the star."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from astropy.io import fits as astropy_fits
from astropy.table import QTable
from astropy.wcs import WCS
from matplotlib import pyplot
from matplotlib.contour import ContourSet
from scipy.optimize import nnls

import pyklip_diffrender as dr
from pyklip_diffrender.detection import disk as module
from pyklip_diffrender.detection import (
    sources_at_edges,
    sources_beyond,
    wide_field,
    without_blurred_edges,
)
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.detection.whole_frame import WholeFrame
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.pyklip_backend.subtract import FittedPointing
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.reduction.pictures import _stamps
from pyklip_diffrender.reduction.pipeline import prepare
from pyklip_diffrender.scene.observation import Window
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.scene.simulation import field_of, images_of_stars, within_field
from pyklip_diffrender.wavefront.opd import random_drift


def model(pixels=48):
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=pixels)


OPD = dr.wavefront.random_opd(1, npix=128)
WHOLE, FITTED = 120, 48
ROLLS = (20.0, 31.0)
STAR = dr.Star(w2_magnitude=6.5, exposure=1800.0)
PLANETS = (
    dr.Planet(2e-5, separation=0.9, position_angle=60.0),
    dr.Planet(1.5e-5, separation=2.1, position_angle=200.0),
    dr.Planet(2.5e-5, separation=2.4, position_angle=300.0),
)


def frames_of(planets, *rolls):
    """A whole frame for each roll of a star with planets east of north."""
    frames = []
    for k, roll in enumerate(rolls):
        seen = tuple(replace(each, position_angle=each.position_angle - roll) for each in planets)
        frame = dr.simulate(model(WHOLE), dr.Scene(STAR, planets=seen), OPD, seed=5 + k)
        frames.append(replace(frame, position_angles=np.full(1, roll), name=f"roll{k}.fits"))
    return frames


@pytest.fixture(scope="module")
def searched():
    """The search of two rolls of a star with three planets, and the whole frames."""
    frames = frames_of(PLANETS, *ROLLS)
    settings, fitted = dr.FitSettings(cycles=6), model(FITTED)
    cut = [each.cutout(FITTED) for each in frames]
    fit = dr.refine(fitted, cut, OPD, settings=settings)
    # As in `reduce`, once more without the light of the sources beyond the fitted pixels.
    cleaned = wide_field(dr.detect(fit), frames).subtracted(frames, cut)
    detection = dr.detect(dr.refine(fitted, cleaned, OPD, settings=settings))
    return detection, frames, wide_field(detection, frames)


POINT = dr.Planet.from_offset(3e-5, -1.7, 1.4)
WIDTHS, AXIS = (0.3, 0.12), 130.0
"""Standard deviations of an extended source, arcsec, and angle of its long axis from +y, deg."""


def gaussian(contrast, x, y):
    """A Gaussian of point sources 0.14 arcsec apart, out to 2.4 standard deviations."""
    steps = np.mgrid[-6:7, -6:7].reshape(2, -1).T * 0.14
    angle = np.deg2rad(AXIS)
    turned = steps @ [[-np.sin(angle), np.cos(angle)], [np.cos(angle), np.sin(angle)]]
    weights = np.exp(-((turned / WIDTHS) ** 2).sum(axis=-1) / 2)
    shown = weights > 0.05
    light = contrast * weights[shown] / weights[shown].sum()
    places = steps[shown] + (x, y)
    return [dr.Planet.from_offset(k, *place) for k, place in zip(light, places, strict=True)]


@pytest.fixture(scope="module")
def crowded():
    """A point source, an extended one, and another one at the lower edge; the star is known."""
    planets = (POINT, *gaussian(4e-4, 1.3, 0.2), *gaussian(1e-3, -0.4, -2.4))
    frame = dr.simulate(model(100), dr.Scene(STAR, planets=planets), OPD, seed=5)
    settings = dr.FitSettings(wavefront=False, companions_if_stalled=False)
    fit = dr.refine(model(24), frame.cutout(24), OPD, settings=settings)
    detection = dr.detect(fit, relinearise=False)
    return detection, frame, wide_field(detection, [frame])


def run_of(wholes, size, **settings):
    options = ReduceOptions(settings=dr.FitSettings(**settings))
    return prepare(ExposureSequence("HD 1", tuple(wholes)), OPD, options, model=model(size))


@pytest.mark.parametrize(
    ("whole", "size", "contrast", "separation"), [(WHOLE, FITTED, 3e-3, 2.1), (144, 80, 1e-4, 3.2)]
)
def test_a_bright_source_beyond_the_fitted_pixels_is_known_before_the_fit(
    whole, size, contrast, separation
):
    """The first one's lobes are 27 times the noise, and a fit of the star alone never ends."""
    source = dr.Planet(contrast, separation, position_angle=200.0)
    run, alone = (
        run_of([dr.simulate(model(whole), dr.Scene(STAR, planets=planets), OPD, seed=5)],
               size, wavefront=False, companions_if_stalled=False)
        for planets in ((source,), ())
    )  # fmt: skip
    assert alone._beyond == ()
    (known,) = run._beyond
    assert known.contrast == pytest.approx(contrast, rel=0.1)
    assert np.hypot(*np.subtract(known.offset, source.offset)) < 0.05
    assert run.run().fit.companions[0, 0] == pytest.approx(contrast, rel=0.01)


def test_a_frame_in_which_the_image_of_the_pupil_samples_repeats_is_rendered_with_more():
    """That of 64 samples does after 9.0 arcsec, and the frame has 9.7."""
    whole, source = 156, dr.Planet.from_offset(1e-2, -2.2, 2.1)
    frame = dr.simulate(model(whole), dr.Scene(STAR, planets=(source,)), OPD, seed=5)
    settings = dr.FitSettings(wavefront=False, companions_if_stalled=False, max_iterations=3)
    coarse, cut = model(32).with_fidelity(npix=64), frame.cutout(32)
    (fit,) = dr.refine(coarse, cut, OPD, settings=settings).frames
    (known,), _ = sources_beyond([fit], [frame], [cut])
    assert known.contrast == pytest.approx(source.contrast, rel=0.1)
    assert np.hypot(*np.subtract(known.offset, source.offset)) < 0.05
    star = fit.render(whole, background=False)
    with torch.no_grad():
        # Of the wavefront the fit knows what its samples show.
        known_opd = resample(resample(OPD.data, 64), 128)
        expected = fit.flux * model(whole)(known_opd).numpy()
    # The fit has moved the star and the stop a little.
    assert np.linalg.norm(star - expected) < 0.1 * np.linalg.norm(expected)
    np.testing.assert_array_equal(fit.render(32, background=False), fit.render(background=False))
    absorbing = replace(fit, opd=fit.opd * (1 + 0.5j))
    for samples in (64, 128):
        rendered = absorbing.opd_for(coarse.with_fidelity(npix=samples))
        assert rendered.shape == (samples, samples)
        torch.testing.assert_close(rendered.imag, 0.5 * rendered.real)


def real_frame(shape, filter="F444W", mask="MASKA335R", center=None):
    """A frame of NIRCam with noise only."""
    header = astropy_fits.Header({"INSTRUME": "NIRCAM", "CORONMSK": mask, "PUPIL": "MASKRND"})
    ones = np.ones((1, *shape))
    noise = np.random.default_rng(1).normal(size=ones.shape)
    scale = 0.031 if filter == "F210M" else 0.063
    return dr.Observation.from_arrays(
        noise, ones, pixelscale=scale, filter=filter, header=header, center=center, unit="MJy/sr"
    )


@pytest.mark.parametrize("accuracy", ["full", "quick"])
def test_of_the_whole_detector_the_field_of_the_mask_is_used(accuracy, caplog):
    frame = real_frame((2048, 2048), center=[641.3, 1675.4])
    sequence = ExposureSequence("HD 1", (frame,), (replace(frame, reference=True),))
    options = ReduceOptions(accuracy=accuracy, wide=True, size=24)
    caplog.set_level("INFO")
    prepared = prepare(sequence, OPD, options)
    # As for SUB320 (20.16 arcsec); for all of the detector it would be 2,048.
    assert prepared.model.npix == {"full": 256, "quick": 128}[accuracy]
    (whole,), (reference,) = prepared.whole.science, prepared.whole.references
    assert whole.shape == reference.shape == (320, 320)
    assert whole.center[0] == pytest.approx([160, 160], abs=1)
    row, column = np.round(frame.center[0] - whole.center[0]).astype(int)[::-1]
    np.testing.assert_array_equal(
        whole.data[0], frame.data[0, row : row + 320, column : column + 320]
    )
    assert "2048 x 2048 pixels: of each, the 320 x 320 about the star are used" in caplog.text
    # pyKLIP's products of such frames have the star there, too.
    result, pointing = SimpleNamespace(model=prepared.model), SimpleNamespace(observation=frame)
    fitted = FittedPointing(result, 0, pointing, Window(1663, 629, (24, 24)), np.zeros(2))
    assert fitted.box == Window(row, column, (320, 320))
    # At the edge of the detector, the field is as large as inside; a subarray is the field.
    assert field_of(real_frame((600, 400), center=[390.0, 5.0])) == Window(0, 80, (320, 320))
    for each in (real_frame((320, 300)), replace(frame, header=astropy_fits.Header())):
        assert within_field(each) is each


@pytest.mark.parametrize("filter", ["F210M", "F444W"])
def test_a_first_look_behind_a_bar_has_samples_for_all_of_it(filter):
    """In F210M the image of 128 samples repeats after 8 arcsec, and the bar is longer."""
    frame = real_frame((80, 80), filter, "MASKASWB")
    prepared = prepare(
        ExposureSequence("HD 1", (frame,)), "flat", ReduceOptions(accuracy="quick", size=56)
    )
    assert prepared.model.npix == {"F210M": 256, "F444W": 128}[filter]
    star, source = images_of_stars(frame, 0.4, 0.6)
    assert source.sum() > 2 * star.sum()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Linux says the peak of a process, in kB.")
def test_a_frame_of_the_whole_detector_takes_less_than_two_gigabytes(tmp_path):
    """In a process of its own, whose peak the operating system knows; 1.4 GB for two full rolls."""
    script = tmp_path / "whole_detector.py"
    script.write_text(WHOLE_DETECTOR)
    root = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": f"{root}{os.pathsep}{root / 'tests'}"}
    run = subprocess.run(
        [sys.executable, script], env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    *found, peak = map(float, run.stdout.split())
    assert found == pytest.approx([1e-4, -4.2, 5.1], rel=0.1)
    assert peak < 2e6


@cache
def behind_a_bar():
    """A model of MASKLWB, which takes all light out to 10 arcsec left and right of the star."""
    model = dr.nircam_coronagraph(
        "F444W", image_mask="MASKLWB", monochromatic=4.5e-6, npix=256, fov_pixels=32
    )
    return model, dr.wavefront.random_opd(1, npix=256)


def test_sources_far_from_the_star_are_not_behind_a_bar():
    behind, opd = behind_a_bar()
    frame = dr.simulate(behind, dr.Scene(STAR), opd, seed=5)
    settings = dr.FitSettings(wavefront=False, companions_if_stalled=False)
    fit = dr.refine(behind, frame, opd, settings=settings)
    clear = fit.frames[0].flux * float(Templates(fit).beyond_mask(0).max())
    assert WholeFrame(fit.frames[0], frame, 0.0).kernel.max() == pytest.approx(clear, rel=0.1)


def test_a_bright_source_beside_a_bar_is_fitted_with_the_star():
    behind, opd = behind_a_bar()
    source = dr.Planet.from_offset(1e-3, 0.3, 0.8)
    frame = dr.simulate(behind, dr.Scene(STAR, planets=(source,)), opd, seed=5)
    fit = dr.refine(behind, frame, opd, settings=dr.FitSettings(cycles=4))
    assert fit.status is dr.Status.CONVERGED
    np.testing.assert_allclose(fit.companions, [[1e-3, *source.offset]], rtol=0.01)


WHOLE_DETECTOR = """
import numpy as np

import pyklip_diffrender as dr
from test_wide_field import STAR, real_frame

star = dr.nircam_coronagraph("F444W", npix=256, nlambda=3, fov_pixels=320)
planet = dr.Planet.from_offset(1e-4, -4.2, 5.1)
opd = dr.wavefront.random_opd(1, npix=256)
sky = dr.simulate(star, dr.Scene(STAR, planets=(planet,)), opd, seed=5)
frame = real_frame((2048, 2048), center=[641.5, 1675.5])
frame.data[0] *= 30
frame.error[0] *= 30
frame.data[0, 1516:1836, 482:802] = sky.data[0]
frame.error[0, 1516:1836, 482:802] = sky.error[0]
# Where the star of another mask would be.
frame.data[0, 1660:1680, 1200:1220] = 1e6
settings = dr.FitSettings.nircam("F444W", cycles=(6.0,), max_iterations=4)
result = dr.reduce(dr.ExposureSequence("HD 1", (frame,)), opd, settings=settings, wide=True,
                   size=40)
row = result.wide.candidates[0]
# ru_maxrss would include the process of the tests, from which this one was made.
peak = next(l.split()[1] for l in open("/proc/self/status") if l.startswith("VmHWM"))
# The test reads this line.
print(row["contrast"], row["x"].value, row["y"].value, peak)
"""


def test_a_faint_source_at_the_edges_of_the_fitted_pixels_is_fitted_with_the_star():
    """A fit without it has three candidates that are no source."""
    source = dr.Planet.from_offset(1e-5, 1.57, 0.3)
    for planets in ((), (source,)):
        frames = frames_of(planets, 0.0, 8.0)
        run = run_of(frames, FITTED, cycles=8)
        result = run.run()
        assert len(result.detection.candidates) == len(planets)
    alone = replace(result.fit, companions=np.zeros((0, 3)))
    (edge,) = sources_at_edges(alone, frames)
    fitted = result.fit.planets[-1]
    for each, slack in ((edge, 0.2), (fitted, 0.1)):
        assert (each.contrast, *each.offset) == pytest.approx((1e-5, *source.offset), rel=slack)
    failed = replace(alone, status=dr.Status.DIVERGED)
    assert run._with_sources_at_edges(failed) is failed
    # The report shows the pixels about it that were fitted, and no others.
    stamps = _stamps(result.detection, 0)
    assert list(stamps) == [1, 2]
    for stamp, frame in zip(stamps.values(), result.fit.frames, strict=True):
        turned = source.rotated(frame.observation.roll_from(frames[0]))
        assert (stamp.x.mean(), stamp.y.mean()) == pytest.approx(turned.offset, abs=0.06)
        beyond = stamp.x > frame.grid[..., 0].max() + 0.03
        assert np.isnan(stamp.data[:, beyond]).all()
        assert np.isfinite(stamp.data[:, ~beyond]).any()


@pytest.mark.parametrize(("whole", "fitted"), [(56, 24), (64, 32)])
def test_frames_hardly_larger_than_the_fitted_pixels_have_no_sources_at_their_edges(whole, fitted):
    """All of the smaller one is near the star, where no light is that of the background."""
    frame = dr.simulate(model(whole + 4), dr.Scene(STAR), OPD, seed=5)
    # The star is not in the middle, so that columns and rows that are searched are not fitted.
    frame = frame.within(Window(4, 4, (whole, whole)))
    settings = dr.FitSettings(wavefront=False, companions_if_stalled=False)
    fit = dr.refine(model(fitted), frame.cutout(fitted), OPD, settings=settings)
    assert sources_at_edges(fit, [frame]) == []


def test_pixels_that_light_from_beyond_blurs_into_are_left_out():
    frame = dr.simulate(model(WHOLE), dr.Scene(STAR), OPD, seed=5)
    # A source just beyond the fitted pixels, which end at 1.5 arcsec.
    light, of_cutout = (
        4e6 * model(size)(OPD, star_offset=(1.6, 0.3), blur=0.026).numpy()
        for size in (WHOLE, FITTED)
    )
    whole = replace(frame, data=light[None])
    cut, inside = whole.cutout(FITTED), np.s_[36:84, 36:84]
    left_out = ~without_blurred_edges(whole, cut).valid[0]
    wrong = np.abs(light[inside] - of_cutout) / cut.error[0]
    assert (wrong > 0.8).sum() > 5
    assert left_out[wrong > 0.8].all()
    assert not left_out[wrong < 0.2].any()
    # Nothing is known beyond the frame itself.
    assert without_blurred_edges(cut, cut).valid.all()
    larger = cut.within(Window(-4, -4, (FITTED + 8, FITTED + 8)))
    assert (without_blurred_edges(cut, larger).valid == larger.valid).all()
    prepared = prepare(
        ExposureSequence("HD 1", (whole,)), OPD, ReduceOptions(), model=model(FITTED)
    )
    assert (prepared.sequence.science[0].valid[0] == ~left_out).all()


@pytest.mark.slow
def test_an_extended_source_is_one_row_with_its_shape(crowded):
    table = crowded[-1].candidates
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
    detection, frame, _ = crowded
    valid = frame.valid.copy()
    valid[:, -20:] = False
    wide = wide_field(detection, [replace(frame, valid=valid)])
    rows, columns = np.nonzero(np.isfinite(wide.snr))
    # The fitted pixels are in the middle of the frame.
    assert (rows.min(), rows.max()) == (16, 99 - 20 - 16)
    assert (columns.min(), columns.max()) == (16, 99 - 16)
    # The point source is now beyond the last rows that are searched.
    assert "point" not in wide.candidates["shape"][np.isfinite(wide.candidates["fit_chi2"])]


def test_the_map_has_north_up_and_numbered_circles(crowded):
    detection, frame, wide = crowded
    turned = replace(frame, position_angles=np.array([90.0]))
    part = replace(detection.fit.frames[0], observation=turned.cutout(24))
    fit = replace(detection.fit, frames=(part,))
    oriented = replace(wide, detection=replace(detection, stored_fit=fit))
    # With +y at a position angle of 90 degrees, +y is east and +x is north.
    for each, turn in ((wide, lambda x, y: (x, y)), (oriented, lambda x, y: (y, x))):
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
            x, y = (image.get_transform() - ax.transData).inverted().transform(place)
            column = int((x - left) / (right - left) * nx)
            line = int((y - bottom) / (top - bottom) * ny)
            near = image.get_array()[line - 1 : line + 2, column - 1 : column + 2]
            assert near.max() > 0.6 * row["snr"] if row["shape"] != "extended" else near.max() > 5


@pytest.mark.slow
def test_planets_are_measured_wherever_they_are(searched):
    wide = searched[-1]
    assert len(wide.candidates) == len(PLANETS)
    for planet in PLANETS:
        row = wide.candidates[np.argmin(np.abs(wide.candidates["contrast"] - planet.contrast))]
        # The image far from the star is that at 4 arcsec; a few milliarcsec are systematic.
        for name, slack in (("separation", 0.005), ("position_angle", 0.2)):
            value, error = row[name].value, row[f"{name}_error"].value
            assert abs(value - getattr(planet, name)) < 4 * error + slack, name
        assert float(row["contrast"]) == pytest.approx(
            planet.contrast, abs=4 * float(row["contrast_error"]), rel=0.05
        )
        assert row["fit_chi2"] < 3 or np.isnan(row["fit_chi2"])


@pytest.mark.slow
def test_contrasts_outside_have_the_error_of_the_stars_flux_as_well(searched):
    detection, frames, wide = searched
    uncertain = replace(detection.fit, catalogue_error=0.1)
    again = wide_field(replace(detection, stored_fit=uncertain), frames).candidates
    outside = np.isfinite(again["fit_chi2"])
    assert outside.any()
    added = again["contrast_error"] ** 2 - wide.candidates["contrast_error"] ** 2
    ratio = np.sqrt(np.abs(added[outside])) / again["contrast"][outside]
    np.testing.assert_allclose(ratio, 0.1, rtol=1e-3)


@pytest.mark.slow
def test_maps_are_those_of_the_fit_about_the_star_and_are_written(searched, tmp_path):
    detection, _, wide = searched
    begin = (WHOLE - FITTED) // 2
    window = (slice(begin, begin + FITTED),) * 2
    np.testing.assert_array_equal(wide.snr[window], detection.contrast / detection.error)
    np.testing.assert_allclose(wide.grid[window], detection.grid, atol=1e-9)
    curve = wide.contrast_curve
    assert curve["separation"].value.max() > 2.2 > detection.contrast_curve["separation"][-1].value
    # Seamless: where the star is no longer seen, the limits of both are those of the background.
    near, far = np.interp([1.4, 2.2], curve["separation"].value, curve["contrast"])
    assert 0.3 < far / near < 1.5
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
    detection, frames, _ = searched
    with pytest.raises(IncompatibleSetupError, match="expected the fitted ones"):
        wide_field(detection, frames[:1])
    with pytest.raises(IncompatibleSetupError, match="before they were cut"):
        wide_field(detection, [each.cutout(40) for each in frames])


@pytest.mark.slow
def test_a_hot_pixel_is_no_source_and_a_source_no_hot_pixel(searched):
    detection, (frame, _), _ = searched
    data = frame.data.copy()
    data[0, 20, 80] += 100 * frame.error[0, 20, 80]
    for each, bad in ((frame, []), (replace(frame, data=data), [[20, 80]])):
        sigma = WholeFrame(detection.fit.frames[0], each, 0.0).sigma
        assert np.argwhere(~np.isfinite(sigma)).tolist() == bad


ANGLES = (20.0, 32.0)
HOST = dr.Star(w2_magnitude=5.5)
BRIGHTNESS, POSITION_ANGLE = 1e-4, 75.0


def ring(model, opd, position_angle, points=40):
    """Photons of a ring as bright as the star, its long axis at an angle from +y, (ny, nx)."""
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
    turned = (0.3 * np.sin(angle) + 0.95j * np.cos(angle)) * np.exp(1j * np.deg2rad(position_angle))
    with torch.no_grad():
        images = [model(opd, (place.real, place.imag)).numpy() for place in turned]
    return np.asarray(HOST.photons * np.mean(images, axis=0))


@cache
def rolls(brightness):
    """Two rolls of the star, and the light of its ring in them."""
    actual = OPD.data + random_drift(3, hours=40, npix=128).data
    frames, rings = [], []
    rng = np.random.default_rng(1)
    for k, roll in enumerate(ANGLES):
        rings.append(brightness * ring(model(), actual, POSITION_ANGLE - roll))
        starlight = dr.simulate(model(), dr.Scene(star=HOST), actual, seed=4 + k)
        counts = starlight.data[0] + rng.poisson(rings[k])
        error = np.sqrt(np.maximum(counts, 0) + dr.Scene().read_noise ** 2)
        frame = dr.Observation.from_arrays(
            counts, error, pixelscale=starlight.pixelscale, name=f"roll{k}.fits"
        )
        frames.append(replace(frame, position_angles=np.array([roll])))
    return frames, rings


def star_alone(frames):
    settings = dr.FitSettings(cycles=10, response_npix=64)
    return dr.refine(model(), frames, OPD, settings=settings)


@cache
def fitted(brightness=BRIGHTNESS):
    """The star alone, and with extended light."""
    fit = star_alone(rolls(brightness)[0])
    return fit, dr.detection.fit_disk(fit)


def with_disk(frames):
    return dr.detection.fit_disk(star_alone(frames))


def amount(image, true):
    """How much of the true light an image has."""
    return float((image * true).sum() / (true**2).sum())


@pytest.mark.slow
def test_a_ring_keeps_its_light():
    fit, disk = fitted()
    _, rings = rolls(BRIGHTNESS)
    # A fit of the star alone takes all of the ring.
    assert amount(np.nan_to_num(fit.frames[0].residual[0]), rings[0]) < 0.2
    for light, true in zip(disk.light, rings, strict=True):
        assert amount(light, true) == pytest.approx(1.0, abs=0.1)
    assert amount(np.nan_to_num(disk.image), rings[0]) == pytest.approx(1.0, abs=0.1)
    assert disk.contrast == pytest.approx(BRIGHTNESS, rel=0.15)
    # The second roll is turned by 12 degrees, 3 pixels at this separation.
    templates = Templates(disk.fit)
    place = torch.tensor([[0.9, 0.3]], dtype=torch.float64)
    light = templates.at(place)[1][0].numpy()
    peak = np.unravel_index(light.argmax(), light.shape)
    np.testing.assert_allclose(templates.pixels_of(1, place)[:, 0], peak, atol=1.2)
    assert disk.orientation == pytest.approx(POSITION_ANGLE, abs=2)
    # By which factor squared the contrast limits would otherwise be raised.
    assert disk.fit.chi2_per_pixel < fit.chi2_per_pixel / 10


@pytest.mark.slow
def test_a_star_without_a_disk_has_none():
    fit, disk = fitted(0.0)
    assert disk.contrast == 0
    assert len(disk.table) == 0
    assert disk.orientation is None
    assert disk.gain < 300
    assert not np.any(disk.light)
    assert disk.fit is fit


@cache
def small_fit():
    """A star without a companion in 24 x 24 pixels."""
    frame = dr.simulate(model(24), dr.Scene(star=HOST), OPD, seed=1)
    return dr.refine(model(24), frame, OPD, settings=dr.FitSettings(cycles=4))


def test_products_and_refusals(tmp_path):
    fit = small_fit()
    with pytest.raises(IncompatibleSetupError, match="inner: got"):
        dr.detection.fit_disk(fit, inner=-0.3)
    reference = replace(fit.frames[0].observation, reference=True)
    star = replace(fit, frames=(replace(fit.frames[0], observation=reference),))
    with pytest.raises(IncompatibleSetupError, match="got a reference star"):
        dr.detection.fit_disk(star)
    disk = dr.detection.fit_disk(fit, inner=0.4)
    assert disk.image.shape == disk.error.shape == disk.light[0].shape == (24, 24)
    np.testing.assert_allclose(disk.image, fit.frames[0].residual[0], atol=1e-9 * HOST.photons)
    np.testing.assert_allclose(disk.error, fit.frames[0].observation.error[0])
    lit = replace(disk, offsets=np.array([[0.5, 0.1], [-0.5, -0.1]]), contrasts=np.array([1, 2e-6]))
    assert lit.orientation is None  # The frame's own orientation is not known.
    with astropy_fits.open(lit.write(tmp_path)) as hdus:
        names = [hdu.name for hdu in hdus[1:]]
        assert names == ["IMAGE", "IMAGE_ERROR", "LIGHT", "HIDES_POINTS", "OFFSET_X", "OFFSET_Y",
                         "SOURCES"]  # fmt: skip
        assert not hdus["HIDES_POINTS"].data.any()
        assert hdus["IMAGE"].header["BUNIT"] == "ph"
        np.testing.assert_allclose(
            WCS(hdus["LIGHT"].header).wcs_pix2world(2, 9, 0), disk.grid[9, 2]
        )
        np.testing.assert_array_equal(hdus["SOURCES"].data["contrast"], lit.contrasts)
    axes = lit.plot()
    titles = [ax.get_title(loc="left") for ax in axes]
    assert titles == ["frames without the star", "extended light"]
    hiding = replace(lit, hides_points=lit.grid[..., 0] > 0).plot()
    lines = [sum(isinstance(k, ContourSet) for k in ax[1].collections) for ax in (axes, hiding)]
    assert lines == [0, 1]
    pyplot.close("all")


def test_non_negative_light_is_that_of_scipy():
    rng = np.random.default_rng(2)
    columns, data = rng.normal(size=(60, 20)), rng.normal(size=60)
    solved = module._brightest(columns.T @ columns, columns.T @ data, np.zeros(20), 0.0)
    expected = nnls(columns, data)[0]
    assert 3 < (expected > 0).sum() < 17
    np.testing.assert_allclose(solved, expected, atol=1e-4)
    gain = module._gain(columns.T @ columns, columns.T @ data, expected)
    assert gain == pytest.approx((data**2).sum() - ((data - columns @ expected) ** 2).sum())


def planets_in(frames, places, contrast):
    """The frames with planets at x, y from the star in the first of them, arcsec."""
    light = Templates(fitted()[1].fit).at(torch.tensor(places, dtype=torch.float64))
    return [
        replace(each, data=each.data + contrast * light[k].sum(dim=0).numpy())
        for k, each in enumerate(frames)
    ]


@pytest.mark.slow
def test_planets_are_found_beside_a_ring_and_not_next_to_it():
    """At twice the limits; one next to the ring counts as its light and has no limit."""
    _, disk = fitted()
    alone = dr.detect(disk.fit, without_limits=disk.hides_points)
    assert len(alone.candidates) == 0
    curve = alone.contrast_curve
    limit = float(np.interp(1.05, curve["separation"].value, curve["contrast"]))
    # Much of the ring's light would be noise without its own sources.
    assert limit < 3e-7
    # From 1.0 to 1.15 arcsec from the star, 0.4 from the ring or more.
    places, next_to = [(0.6, -0.9), (-0.8, -0.6), (0.3, 1.1)], (1.0, -0.35)
    nearest = np.linalg.norm(disk.grid - next_to, axis=-1).argmin()
    assert disk.hides_points.flat[nearest]
    assert 0.15 < disk.hides_points.mean() < 0.35
    frames = planets_in(rolls(BRIGHTNESS)[0], [next_to], 1e-6)
    again = with_disk(planets_in(frames, places, 2 * limit))
    found = dr.detect(again.fit, without_limits=again.hides_points).candidates
    # At 0.2 arcsec an error of the wavefront has an S/N of 5, a little more or less by rounding.
    found = found[found["separation"].to_value("arcsec") > 0.5]
    there = np.stack([found["x"].value, found["y"].value], axis=-1)
    away = np.linalg.norm(there[:, None] - places, axis=-1)
    assert sorted(away.argmin(axis=1)) == [0, 1, 2]
    assert away.min(axis=0) == pytest.approx(0, abs=0.05)
    assert np.asarray(found["contrast"]) == pytest.approx(2 * limit, rel=0.25)
    light = [
        each.contrasts[np.linalg.norm(each.offsets - next_to, axis=-1) < 0.15].sum()
        for each in (disk, again)
    ]
    assert light[1] - light[0] == pytest.approx(1e-6, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("brightness", "count"), [(1e-5, 2), (BRIGHTNESS, 1)])
def test_clumps_of_faint_rings_and_of_single_rolls_are_no_planets(brightness, count):
    frames, rings = rolls(brightness)
    disk = with_disk(frames[:count])
    assert len(dr.detect(disk.fit).candidates) == 0
    assert amount(disk.light[0], rings[0]) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_a_planet_alone_is_no_disk():
    """Although sources lower chi-squared by ten thousands."""
    disk = with_disk(planets_in(rolls(0.0)[0], [(0.6, -0.5)], 1e-5))
    assert disk.contrast == 0
    assert disk.gain > 1e4
    assert not disk.hides_points.any()
    (planet,) = dr.detect(disk.fit).candidates
    assert planet["contrast"] == pytest.approx(1e-5, rel=0.03)


def test_limits_are_those_of_the_pixels_that_are_left():
    fit = small_fit()
    grid = fit.frames[0].grid
    whole = dr.detect(fit)
    half = dr.detect(fit, without_limits=grid[..., 0] < 0)
    near = np.hypot(*np.moveaxis(grid, -1, 0)) < 0.35
    curve = dr.detect(fit, without_limits=near).contrast_curve
    assert curve["separation"].min() > whole.contrast_curve["separation"].min()
    assert (half.contrast_curve["lowest"] >= whole.contrast_curve["lowest"]).all()
    assert (half.contrast_curve["lowest"] > whole.contrast_curve["lowest"]).any()
    np.testing.assert_array_equal(half.error, whole.error)
    np.testing.assert_array_equal(half.has_limits, whole.has_limits & (grid[..., 0] >= 0))
    table = dr.detection.completeness(half, separations=[0.6], strengths=[3.0], angles=12)
    assert 5 < table["planets"][0] < 8  # Two of twelve are on the edge.
    with pytest.raises(IncompatibleSetupError, match=r"without_limits: got the shape \(3,\)"):
        dr.detect(fit, without_limits=np.zeros(3, dtype=bool))
