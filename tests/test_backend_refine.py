"""``algo="diffrender"`` end to end: a rendered star, an outdated wavefront, a script as usual."""

import contextlib
import copy
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from astropy.io import fits
from backend_scene import FLUX, LINEAR, NEW, NUMERICS, OLD, SKY, reduced
from pyklip.fakes import gaussfit2d
from pyklip.instruments.Instrument import GenericData
from pyklip.klip import rotate
from scipy.ndimage import map_coordinates

from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError, RefinementError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.pattern import PatternChoice
from pyklip_diffrender.pyklip_backend import (
    DiffrenderSettings,
    backend,
    klip_call,
    subtract_by_refinement,
)
from pyklip_diffrender.pyklip_backend.output_files import on_product, throughput_map
from pyklip_diffrender.refinement import FitSettings, refine
from pyklip_diffrender.scene.aligned_frames import shift_frames
from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation, Window
from pyklip_diffrender.wavefront.bases import default_basis

SHAPE = (44, 40)
PAD = 6
ANGLES = (0.0, 90.0)
CONTRAST, SEPARATION = 4e-5, 0.8


def planet_pixels(angle, position_angle=0.0):
    """Where pyKLIP turns up to north from: x, y offset of the companion in a frame, arcsec."""
    t = np.radians(90 + position_angle - angle)
    return SEPARATION * float(np.cos(t)), SEPARATION * float(np.sin(t))


@pytest.fixture(scope="module")
def small():
    """What fits: 32 pixels, fewer than the frames have."""
    return nircam_coronagraph("F444W", fov_pixels=32, **NUMERICS)


@pytest.fixture(scope="module")
def frames():
    return exposed(CONTRAST)


def exposed(contrast, opposite=0.0):
    """Photons of star, companion and sky in two rolls, with noise; perhaps of another companion."""
    camera = nircam_coronagraph("F444W", fov_pixels=SHAPE, **NUMERICS)
    rng = np.random.default_rng(4)
    with torch.no_grad():
        photons = [
            FLUX * (
                camera(NEW) + contrast * camera(NEW, star_offset=planet_pixels(a))
                + opposite * camera(NEW, star_offset=planet_pixels(a, 180.0))
            ).numpy()
            for a in ANGLES
        ]  # fmt: skip
    return rng.poisson(np.array(photons) + SKY).astype(np.float64)


def padded(frames):
    return np.pad(frames, ((0, 0), (PAD, PAD), (PAD, PAD)), constant_values=np.nan)


def dataset(frames, model, **settings):
    """Frames padded with NaN as spaceKLIP does, and no header."""
    filled = padded(frames)
    center = ((SHAPE[1] - 1) / 2 + PAD, (SHAPE[0] - 1) / 2 + PAD)
    count = len(frames)
    made = GenericData(
        filled, np.tile(center, (count, 1)), parangs=np.array(ANGLES[:count]),
        wvs=np.full(count, 4.44), IWA=2, filenames=np.array([f"roll{i}" for i in range(count)]),
    )  # fmt: skip
    made.OWA = 40.0
    made.diffrender = DiffrenderSettings(
        model=model, **{
            "error": np.sqrt(np.nan_to_num(np.abs(filled), nan=1.0)),
            "settings": FitSettings(basis=default_basis(6.0), response_npix=128), **settings,
        },
    )  # fmt: skip
    return made


def reduce(made, folder, algo="klip"):
    files = reduced(made, folder, algo=algo, numbasis=[1], aligned_center=made.centers[0])
    cube, header = files["x-KLmodes-all.fits"]
    return cube[0].astype(np.float64), header


@pytest.fixture(scope="module")
def refined(small, frames, tmp_path_factory):
    """The frames reduced from an outdated wavefront: dataset, image, header, and throughput."""
    made, folder = dataset(frames, small), tmp_path_factory.mktemp("refined")
    with backend(opd=OLD):
        image, header = reduce(made, folder)
    return made, image, header, fits.getdata(folder / "x-throughput.fits", header=True)


def test_a_library_that_is_not_used_is_said_with_the_reason(frames, small):
    observation = Observation.from_arrays(
        frames, np.sqrt(frames), pixelscale=small.detector.pixelscale, position_angles=[0.0, 90.0]
    )
    library = [replace(observation.part(np.array([0])), reference=True, name="a star beside")]
    settings = DiffrenderSettings(
        model=small, settings=LINEAR, references="off", keep_detected=False
    )
    with pytest.warns(DiffrenderWarning) as caught:
        subtracted = subtract_by_refinement(observation, OLD, settings, references=library)
    said = [str(each.message) for each in caught if "RDI" in str(each.message)]
    assert "of 1 reference frame 1 not used by the fit" in said[0]
    assert subtracted.references == 0
    (contribution,) = subtracted.reduction.visit.contributions
    assert "the option references is 'off'" in contribution.reason


@pytest.mark.slow
def test_star_goes_companion_stays(small, frames, refined, tmp_path):
    made, image, header, _ = refined
    outdated = dataset(frames, small, settings=LINEAR, max_chi2=np.inf)
    with backend(opd=OLD), pytest.warns(DiffrenderWarning, match="MODEL_MISMATCH"):
        reduce(outdated, tmp_path)
    x, y = made.centers[0]
    peak = np.unravel_index(np.nanargmax(image), image.shape)
    np.testing.assert_allclose(peak, (y + SEPARATION / 0.062424185, x), atol=1.0)
    camera = nircam_coronagraph("F444W", fov_pixels=SHAPE, **NUMERICS)
    truth = FLUX * CONTRAST * float(camera(NEW, star_offset=planet_pixels(0.0)).max())
    # A subtracted best fit takes part of the companion for star: 40 to 70 % are known to stay.
    assert 0.4 * truth < np.nanmax(image) < 1.15 * truth

    # The star itself is closer to the truth than the outdated wavefront makes it.
    star = FLUX * camera(NEW).numpy()

    def wrong(reduced):
        found = reduced.diffrender_results[0].subtraction.star[0, PAD:-PAD, PAD:-PAD] - SKY
        pull = (found - star) / np.sqrt(star + SKY)
        return float(np.sqrt(np.mean(pull[6:-6, 4:-4] ** 2)))

    assert wrong(made) < 0.5 * wrong(outdated)

    # The fit saw 32 x 32 pixels, the product covers all that the frames hold.
    assert np.isfinite(image).sum() > 1.0 * frames[0].size
    # Both rolls share a fit.
    assert (header["DRSTAT"], header["DRNFIT"]) == ("CONVERGED", 1)
    (fit,) = made.diffrender_results[0].subtraction.fits
    assert fit.frames == (0, 1)
    assert header["DRCHI2"] == pytest.approx(fit.result.chi2_per_pixel)
    assert (header["DRPATTRN"], header["DRREFS"]) == ("none", 0)
    assert header["DRREFUSE"] == "no reference frames"
    assert (header["DROPD"], header["DRSHA256"]) == (OLD.name, OLD.sha256)


@pytest.mark.slow
def test_what_is_detected_keeps_its_light(small, tmp_path):
    contrast = 3.5e-6  # Too faint for a fit to look for it by itself.
    shots = exposed(contrast)
    made = dataset(shots, small)
    camera = nircam_coronagraph("F444W", fov_pixels=SHAPE, **NUMERICS)
    star = FLUX * camera(NEW).numpy() + SKY
    light = [FLUX * contrast * camera(NEW, star_offset=planet_pixels(a)).numpy() for a in ANGLES]
    kept = {}
    for keep in (False, True):
        with backend(opd=OLD, keep_detected=keep):
            reduced = copy.deepcopy(made)
            _, header = reduce(reduced, tmp_path)
        found = reduced.diffrender_results[0].subtraction
        # It is too faint to be a companion of the fit.
        assert [len(fit.result.companions) for fit in found.fits] == [0]
        assert header["DRKEPT"] == found.kept == int(keep)
        assert len(found.reduction.detection.candidates) == 1
        taken = found.star[:, PAD:-PAD, PAD:-PAD] - star
        shares = [
            1 - (t * p / star).sum() / (p * p / star).sum()
            for t, p in zip(taken, light, strict=True)
        ]
        kept[keep] = np.mean(shares)
    assert kept[False] < 0.85
    assert kept[True] == pytest.approx(1.0, abs=0.1)
    brighter = dataset(exposed(8e-6, opposite=contrast), small)
    with backend(opd=OLD, keep_detected=True):
        reduce(brighter, tmp_path)
    found = brighter.diffrender_results[0].subtraction
    # Both rolls together show one of two companions to the fit; the other one is a candidate.
    assert [len(fit.result.companions) for fit in found.fits] == [1]
    assert len(found.reduction.detection.candidates) == found.kept == 2


@pytest.mark.parametrize(("angle", "flipx"), [(70.0, False), (-130.0, True)])
def test_maps_are_turned_as_pyklip_turns_frames(angle, flipx):
    y, x = np.indices((40, 46))
    image = np.exp(-((x - 20) ** 2 + (y - 30) ** 2) / 200) + 0.01 * x
    old, new = np.array([22.3, 18.8]), np.array([23.0, 20.0])
    expected = rotate(image, angle, old, new, flipx=flipx)
    turned = on_product(image, old, image.shape, new, angle, flipx)
    both = np.isfinite(turned) & np.isfinite(expected)
    assert both.sum() > 800
    # Linear interpolation here, a spline that ripples at the edges there.
    np.testing.assert_allclose(turned[both], expected[both], atol=0.012)


def test_a_companion_in_the_model_keeps_its_light(small, frames):
    whole = Observation.from_arrays(
        frames[0], np.sqrt(frames[0]), pixelscale=small.detector.pixelscale
    )
    cut = whole.within(Window.about(np.array([19.5, 21.5]), (32, 32)))
    x, y = planet_pixels(0.0)
    known = FitSettings(
        basis=default_basis(3.0), response_npix=128,
        companions=(Planet.from_offset(CONTRAST, x, y),),
    )  # fmt: skip
    fit = refine(small, cut, OLD, settings=known)
    kept = throughput_map(fit, spacing=8, inner=2)
    row, column = round(15.5 + y / 0.0624), round(15.5 + x / 0.0624)
    assert kept[row, column] == pytest.approx(1.0, abs=0.04)
    mirrored = kept[31 - row, column]
    assert 0.2 < mirrored < 0.97


@pytest.mark.slow
def test_a_faint_planet_loses_what_the_throughput_map_says(small, frames, refined, tmp_path):
    """The difference of two reductions, against the closed form; the planet is east of north."""
    camera = nircam_coronagraph("F444W", fov_pixels=SHAPE, **NUMERICS)
    light = np.array(
        [1e-7 * FLUX * camera(NEW, star_offset=planet_pixels(a, 70.0)).numpy() for a in ANGLES]
    )
    made, without, header, (left, about) = refined
    assert header["DRTHRU"] == pytest.approx(np.nanmedian(left), abs=0.2)
    assert about["DRTHRU"] == header["DRTHRU"]
    np.testing.assert_array_equal(np.isnan(left), np.isnan(without))
    error = made.diffrender.error
    with backend(opd=OLD):
        present, _ = reduce(dataset(frames + light, small, error=error), tmp_path)
        alone, _ = reduce(dataset(light, small, error=error), tmp_path, algo="none")
    x, y = made.centers[0]
    turn = np.radians(70.0)
    x -= SEPARATION * np.sin(turn) / 0.062424185
    y += SEPARATION * np.cos(turn) / 0.062424185
    # As spaceKLIP measures injected sources, in units of their peak.
    peaks = [
        gaussfit2d(image / np.nanmax(alone), x, y, searchrad=5, guessfwhm=2.3)[0]
        for image in (present - without, alone)
    ]
    kept = peaks[0] / peaks[1]
    assert 0.2 < kept < 0.9
    expected = map_coordinates(np.nan_to_num(left), [[y], [x]], order=1)[0]
    assert expected == pytest.approx(kept, rel=0.04)


def test_copies_with_added_sources_are_not_fitted_again(small, frames, tmp_path, monkeypatch):
    """A fit of flux and background is linear, so that a new fit would do exactly the same."""
    # The map of the throughput takes seconds, and has tests of its own.
    monkeypatch.setattr(klip_call, "throughput_map", lambda fit: np.ones((32, 32)))
    made = dataset(frames, small, settings=LINEAR, error=1e3)
    untouched = copy.deepcopy(made)
    pixels = np.indices(frames.shape[1:])
    light = 2e3 * np.exp(-((pixels - np.array([[[30]], [[26]]])) ** 2).sum(axis=0) / 4)
    changes = []
    with backend(opd=OLD):
        before, _ = reduce(made, tmp_path)
        for into in (None, made):
            injected = copy.deepcopy(made)
            injected.input[1] += padded(light[None])[0]
            with backend(injected_into=into):
                image, header = reduce(injected, tmp_path)
            changes.append(image - before)
    history = " ".join(str(header["HISTORY"]).split())
    assert "fit: free flux, background" in history
    assert re.search(r"frames 1: star at x \+0.0000, .* flux 1e\+10|flux 9\.9", history)
    alone = rotate(np.pad(light, PAD), ANGLES[1], made.centers[1]) / 2
    # Outside the fitted square, changes of the star's flux are left out.
    square = np.s_[PAD + 8 : PAD + 36, PAD + 6 : PAD + 34]
    full, linear, alone = (image[square] for image in (*changes, alone))
    # The clipped median of a whole frame is subtracted, and pixels outside the square count in it.
    level = np.nanmedian(linear - full)
    assert abs(level) < 0.01
    np.testing.assert_allclose(linear - level, full, atol=1e-3)
    assert np.nanmax(np.abs(full - alone)) > 2
    other = copy.deepcopy(made)
    other.input[:] = np.roll(other.input, 3, axis=2)
    for dataset_, into in ((other, made), (injected, untouched)):
        with backend(injected_into=into), pytest.raises(IncompatibleSetupError, match="injected_i"):
            reduce(dataset_, tmp_path)


@pytest.mark.slow
def test_products_show_the_sky_of_all_rolls(small, frames, tmp_path):
    """A source that turns with the sky is where it belongs, and the estimate is linear."""
    made = dataset(frames, small, settings=LINEAR, error=1e3, image="cleaned")
    pixels = np.indices(made.input.shape[1:])
    changes = []
    with backend(opd=OLD):
        before, header = reduce(made, tmp_path)
        left = fits.getdata(tmp_path / "x-throughput.fits")
        for factor in (1, 2):
            injected = copy.deepcopy(made)
            for frame, angle, center in zip(injected.input, ANGLES, made.centers, strict=True):
                x, y = np.array(planet_pixels(angle, 70.0)) / 0.062424185 + center
                distance = (pixels[1] - x) ** 2 + (pixels[0] - y) ** 2
                frame += factor * 1e4 * np.exp(-distance / (2 * 0.95**2))
            with backend(injected_into=made):
                changes.append(reduce(injected, tmp_path)[0] - before)
    assert header["DRIMAGE"] == "cleaned"
    # Products, and the images of planets, have single precision.
    np.testing.assert_allclose(changes[1], 2 * changes[0], atol=2e-3 * 1e4)
    turn, center = np.radians(70.0), made.centers[0]
    x, y = center + SEPARATION * np.array([-np.sin(turn), np.cos(turn)]) / 0.062424185
    row, column = np.unravel_index(np.nanargmax(changes[0]), changes[0].shape)
    assert np.hypot(row - y, column - x) < 1
    # A Gaussian instead of the image behind the mask, whose wings the star takes, and which has
    # less light for the same peak.
    kept, expected = np.nanmax(changes[0]) / 1e4, left[round(y), round(x)]
    assert 0.5 * expected < kept < expected
    assert expected == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(("instrument", "kept"), [("NIRCAM", True), (None, False)])
def test_companions_are_kept_by_default_in_real_frames_only(instrument, kept, small, monkeypatch):
    given_back = []
    monkeypatch.setattr(
        "pyklip_diffrender.pyklip_backend.subtract._give_back", lambda *args: given_back.append(1)
    )
    star = FLUX * small(OLD.data).numpy() + SKY
    header = fits.Header({} if instrument is None else {"INSTRUME": instrument})
    observation = Observation.from_arrays(
        star, np.sqrt(star), pixelscale=small.detector.pixelscale, header=header
    )
    subtract_by_refinement(observation, OLD, DiffrenderSettings(model=small, settings=LINEAR))
    assert bool(given_back) == kept


@pytest.mark.parametrize("wrong", ["nothing", "filter"])
def test_a_header_that_contradicts_the_data_stops_the_reduction(wrong, small, frames, tmp_path):
    model = small
    expected = pytest.warns(DiffrenderWarning, match="roll0.*MODEL_MISMATCH.*What to do: .*filter")
    if wrong == "filter":
        model = nircam_coronagraph("F356W", fov_pixels=32, **NUMERICS | {"monochromatic": 3.56e-6})
        expected = pytest.raises(RefinementError, match=r"roll0: .* max_chi2=100: .*STARCENX.*filt")
    made = dataset(frames[:1], model, settings=LINEAR)
    with backend(opd=OLD), expected:
        reduce(made, tmp_path)
    assert bool(list(tmp_path.iterdir())) == (wrong == "nothing")


def test_a_fit_that_diverges_stops_the_reduction(small, frames, tmp_path):
    made = dataset(-frames[:1], small)
    refused = pytest.raises(RefinementError, match="roll0: the fit ended as DIVERGED: the fitted")
    with backend(opd=OLD, settings=LINEAR), refused as caught:
        reduce(made, tmp_path)
    assert caught.value.result.frames[0].star.shape == (32, 32)
    assert list(tmp_path.iterdir()) == []
    assert made.output is None


def test_frames_at_one_place_are_averaged_and_all_share_a_fit(small, frames):
    cube = frames[[0, 1, 0, 0, 0]]
    center = np.array([[19.5, 21.5], [19.5, 21.5], [20.5, 21.5], [19.7, 21.5], [19.5, 21.9]])
    observation = Observation.from_arrays(
        cube, np.sqrt(cube), pixelscale=0.0624, center=center,
        position_angles=np.array([0.0, 10.0, 0.0, 0.04, 0.0]), filter="F444W",
    )  # fmt: skip
    told = []
    settings = DiffrenderSettings(model=small, settings=LINEAR, max_chi2=np.inf)
    with pytest.warns(DiffrenderWarning):
        rendered = subtract_by_refinement(observation, OLD, settings, tell=told.append)
    (fit,) = rendered.fits
    assert fit.frames == (0, 1, 2, 3, 4)
    assert [frame.observation.count for frame in fit.result.frames] == [2, 1, 1, 1]
    assert "5 frames of 4 pointings together" in told[0]
    assert rendered.star.shape == cube.shape
    np.testing.assert_array_equal(rendered.star[0], rendered.star[3])
    assert np.isfinite(rendered.star).all()


def test_start_and_pattern_reach_the_fit(small, frames):
    """The pattern is part of what is subtracted, inside the fitted square and beside it."""
    drawn = 0.05 * np.random.default_rng(6).normal(size=SHAPE)
    measured = drawn.copy()
    measured[:, -3:] = 0.0
    middle = ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    pattern = DetectorPattern(measured, np.full(SHAPE, 1e-3), middle, 0.05)
    camera = nircam_coronagraph("F444W", fov_pixels=SHAPE, **NUMERICS)
    star = FLUX * camera(OLD.data, (0.02, 0.0)).numpy()
    noise = np.sqrt(star + SKY)
    data = star * (1 + drawn) + SKY + noise * np.random.default_rng(7).normal(size=SHAPE)
    observation = Observation.from_arrays(
        data, noise, pixelscale=small.detector.pixelscale, filter="F444W"
    )
    settings = DiffrenderSettings(model=small, settings=LINEAR, start={"star_offset": (0.02, 0.0)})
    chi2 = {}
    for known in (None, pattern):
        chosen = replace(settings, pattern=known)
        with contextlib.nullcontext() if known else pytest.warns(DiffrenderWarning):
            found = subtract_by_refinement(observation, OLD, chosen)
        assert found.pattern == ("pattern" if known else "none")
        (fit,) = found.fits
        assert fit.result.frames[0].values["star_offset"].tolist() == [0.02, 0.0]
        away = ((found.star[0] - star * (1 + measured) - SKY) / noise)[:, :-3]
        chi2[known is None] = fit.chi2, np.sqrt(np.mean(away**2))
    assert chi2[True][0] > 10
    assert chi2[True][1] > 2
    # 1024 pixels: known to 4.4 %; the star's flux, to 1e-4.
    assert chi2[False][0] == pytest.approx(1.0, abs=0.13)
    assert chi2[False][1] < 0.1


@pytest.mark.parametrize("side", [32, 44])
def test_frames_that_were_moved_for_the_fit_are_subtracted_where_they_are(side, small, monkeypatch):
    camera = nircam_coronagraph("F444W", fov_pixels=side, **NUMERICS)
    # Not so bright that the ringing at the edges is above the noise.
    star = FLUX / 100 * camera(OLD.data, (0.02, 0.0)).numpy() + SKY
    observation = Observation.from_arrays(
        star, np.sqrt(star), pixelscale=small.detector.pixelscale, filter="F444W"
    )
    away = np.array([0.3, -0.2])

    def moved(science, *_, **options):
        (frame,) = science
        shifted = shift_frames(frame.data, away[np.newaxis])
        registered = replace(frame, data=shifted, center=frame.center + away)
        return PatternChoice((registered,), None, settings.settings)

    monkeypatch.setattr("pyklip_diffrender.pattern.choice.choose_pattern", moved)
    settings = DiffrenderSettings(model=small, settings=LINEAR, start={"star_offset": (0.02, 0.0)})
    rendered = subtract_by_refinement(observation, OLD, settings)
    inner = np.s_[6:-6, 6:-6]
    wrong = (rendered.star[0] - star)[inner] / np.sqrt(star)[inner]
    unmoved = (shift_frames(star[np.newaxis], away[np.newaxis])[0] - star)[inner]
    assert np.sqrt(np.mean(wrong**2)) < 0.2
    assert np.sqrt(np.mean((unmoved / np.sqrt(star)[inner]) ** 2)) > 1.0
