"""The detector's own pixels: undoing a shift, the library of patterns, finding lost pixels."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy.io import fits
from scipy.ndimage import fourier_shift, gaussian_filter
from small_files import calints

import pyklip_diffrender as dr
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.pattern import MeasuredPattern, combine_patterns, place_on_detector
from pyklip_diffrender.scene.aligned_frames import shift_frames, undo_shifts
from pyklip_diffrender.scene.star_place import measured_offset

SIDE = 320
SHIFTS = np.array([[10.6, -13.3], [10.4, -13.4]])


@cache
def on_detector():
    """A smooth scene on the detector, with the pixel-scale pattern of a flat field."""
    rng = np.random.default_rng(1)
    smooth = gaussian_filter(rng.normal(size=(SIDE, SIDE)), 2, mode="wrap")
    flat = 1 + 0.05 * rng.normal(size=(SIDE, SIDE))
    return np.asarray(100 * (2 + smooth / smooth.std()) * flat)


@cache
def aligned():
    """The scene, shifted with the Fourier transform; the whole pixels are those of the cut."""
    light = np.fft.fft2(on_detector())
    net = [(y + 14, x - 10) for x, y in SHIFTS]
    return np.stack([np.fft.ifft2(fourier_shift(light, each)).real for each in net])


def aligned_file(path, recorded=None, **cards):
    """Two frames as an alignment leaves them: star at (160, 160), cut so that it is at (150, 174).

    DQ stays where it was. Shifts are `recorded` in these extensions. Cards that are None are not
    there.
    """
    primary = {
        "INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "FILTER": "F444W", "PUPIL": "MASKRND",
        "CORONMSK": "MASKA335R", "APERNAME": "NRCA5_MASK335R", "TARGPROP": "A STAR",
        "SUBSTRT1": 492, "SUBSTRT2": 1502, "DATE-BEG": "2022-10-03T00:00:00", **cards,
    }  # fmt: skip
    place = {"PIXAR_A2": 0.0039, "CRPIX1": 151.0, "CRPIX2": 175.0, "ROLL_REF": 10.0}
    quality = np.zeros((2, SIDE, SIDE), dtype=np.uint32)
    quality[:, 100, 60] = 1
    calints(path, aligned(), quality=quality, primary=primary, **place)
    for name, shifts in ({"IMSHIFTS": SHIFTS} if recorded is None else recorded).items():
        fits.append(path, shifts, fits.Header({"EXTNAME": name}))
    return path


def test_the_shift_of_aligned_frames_is_undone(tmp_path):
    observation = dr.Observation.from_fits(aligned_file(tmp_path / "aligned.fits"))
    # Net shifts of about (0.5, 0.65): the nearest whole pixels.
    assert observation.first_pixel == (491, 1500)
    # Far from the edges, both frames show the detector's pixels, however they were shifted.
    inside, native = np.s_[40:-40, 40:-40], np.roll(on_detector(), 1, axis=0)
    for frame in observation.data:
        error = np.where(observation.valid[0], frame - native, 0.0)[inside]
        assert np.abs(error).max() < 0.05 * native[inside].std()
    np.testing.assert_allclose(observation.center, [[149.4, 174.3], [149.6, 174.4]], atol=1e-9)
    assert np.argwhere(~observation.valid)[0].tolist() == [0, 101, 60]  # DQ follows its pixel.
    assert observation.cutout(80).first_pixel == (491 + 110, 1500 + 135)
    # Newer releases of spaceKLIP record the shift in two parts.
    center = np.tile(SHIFTS[0] + 0.2, (2, 1))
    parts = {"CENTER_SHIFT": center, "ALIGN_SHIFT": SHIFTS - center}
    new = dr.Observation.from_fits(
        aligned_file(tmp_path / "new.fits", parts, STARCENX=151.0, STARCENY=175.0)
    )
    np.testing.assert_allclose(new.data, observation.data, rtol=0, atol=1e-9)
    np.testing.assert_allclose(new.center, observation.center)
    assert new.first_pixel == observation.first_pixel


def test_shifts_that_were_not_applied_yet_are_not_undone(tmp_path):
    star = np.array([140.3, 187.6])
    shifts = {"CENTER_SHIFT": np.tile((SIDE - 1) / 2 - star, (2, 1))}
    stated = dict(zip(("STARCENX", "STARCENY"), star + 1, strict=True))
    path = aligned_file(tmp_path / "centers.fits", shifts, **stated)
    observation, as_written = dr.Observation.from_fits(path), fits.getdata(path, "SCI")
    np.testing.assert_allclose(observation.data[observation.valid], as_written[observation.valid])
    np.testing.assert_allclose(observation.center, [star, star])
    assert observation.first_pixel == (491, 1501)


def test_plain_calints_know_their_pixels(tmp_path):
    plain = aligned_file(tmp_path / "plain.fits", {})
    assert dr.Observation.from_fits(plain).first_pixel == (491, 1501)
    # Somebody has moved the star, and does not say how.
    moved = aligned_file(tmp_path / "moved.fits", {}, STARCENX=151.0)
    assert dr.Observation.from_fits(moved).first_pixel is None


def test_a_gap_does_not_spread_when_a_shift_is_undone(tmp_path):
    """A hole at the star's peak in SCI or ERR: neighbours keep values and errors, or are masked."""
    y, x = np.indices((SIDE, SIDE))
    star = 3000 * np.exp(-((x - 150) ** 2 + (y - 174) ** 2) / (2 * 1.1**2))
    star += 200 * np.exp(-np.hypot(x - 150, y - 174) / 8)
    frames = np.stack([star, star]) + np.random.default_rng(3).normal(size=(2, SIDE, SIDE))
    paths = {}
    for name in ("twin", "SCI", "ERR"):
        paths[name] = aligned_file(tmp_path / f"{name}.fits")
        with fits.open(paths[name], mode="update") as hdus:
            hdus["SCI"].data = frames.copy()
            hdus["DQ"].data = np.zeros(frames.shape, dtype=np.int32)
            if name != "twin":
                hdus[name].data[0, 174, 150] = np.nan
            if name == "ERR":
                hdus["ERR"].data[0, 60, 60:64] = (0.0, -1.0, np.nan, 0.0)
    twin = dr.Observation.from_fits(paths["twin"])
    assert twin.valid.all()
    for name in ("SCI", "ERR"):
        got = dr.Observation.from_fits(paths[name])
        # The pixels that the gap is mixed with, and little else.
        lost = ~got.valid[0]
        near = np.hypot(x - 150, y - 175) < 1.6
        assert lost[near].any()
        assert lost[np.abs(y - 61) > 3].sum() < 300
        assert got.valid[1].all()
        away = np.where(got.valid, got.data - twin.data, 0.0) / twin.error
        assert np.abs(away).max() < 1.5
        ratio = got.error[got.valid] / twin.error[got.valid]
        assert ratio.min() > 0.95
        assert ratio.max() < 1.2


@pytest.mark.parametrize(
    ("cards", "place"),
    [
        ({"APERNAME": "NRCA5_FULL_MASK335R"}, True), ({"CORONMSK": "UNKNOWN"}, True),
        ({"SUBSTRT1": None, "SUBSTRT2": None}, True), ({"SUBSTRT1": 1, "SUBSTRT2": 1}, True),
        ({"DETECTOR": None, "APERNAME": None}, False), ({"FILTER": "F277W"}, False),
        ({"CORONMSK": None, "APERNAME": None}, False),
    ],
)  # fmt: skip
def test_the_place_of_shifted_frames_is_known_or_left_to_the_search(tmp_path, cards, place):
    got = dr.Observation.from_fits(aligned_file(tmp_path / "a.fits", **cards))
    if not place:
        assert got.first_pixel is None
        return
    # The star is on the same place of the detector as in the first test.
    expected = np.add([[149.4, 174.3], [149.6, 174.4]], (491, 1500))
    np.testing.assert_allclose(got.center + got.first_pixel, expected, atol=1e-6)


def measured(star, first=(600, 1630)):
    truth = 0.05 * np.random.default_rng(5).normal(size=(60, 60))
    noise = np.random.default_rng(len(star)).normal(size=truth.shape)
    x, y = first[0] - 600, first[1] - 1630
    seen = (truth + 0.01 * noise)[y + 5 : y + 45, x + 5 : x + 45]
    return MeasuredPattern(
        star, seen, np.full((40, 40), 0.01**2), (20.0 - x, 20.0 - y), first, "F444W", "MASKA335R",
        f"{star}.fits", "2022-10-03",
    )  # fmt: skip


def test_patterns_are_combined_pixel_by_pixel_of_the_detector():
    one, other = measured("A"), measured("BB", (602, 1629))
    known = combine_patterns([one, other])
    assert known.first_pixel == (600, 1629)
    truth = 0.05 * np.random.default_rng(5).normal(size=(60, 60))
    inside = known.value[3:38, 3:38] - truth[7:42, 8:43]
    # The average of two, shrunk a little.
    assert inside.std() == pytest.approx(0.01 / np.sqrt(2), rel=0.1)
    assert known.provenance["stars"] == ["A", "BB"]
    with pytest.raises(IncompatibleSetupError, match="F356W"):
        combine_patterns([one, replace(other, filter="F356W")])
    assert known.provenance["frames"] == ["A.fits", "BB.fits"]


@pytest.mark.parametrize("name", ["F444W", "F356W"])
def test_the_library_knows_other_stars_on_the_same_pixels(tmp_path, name):
    cut = dr.Observation.from_fits(aligned_file(tmp_path / "a.fits", FILTER=name)).cutout(80)
    known = dr.known_pattern(cut)
    assert known.filter == name
    assert known.provenance["stars"] == ["HIP17695", "G-7-34"]
    pattern, error = known.at(cut)
    # A few percent, measured to a percent or so near the star.
    y, x = np.indices(pattern.shape) - 39.5
    near = np.hypot(x, y) < 20
    assert 0.02 < pattern[near].std() < 0.08
    assert np.median(error[near]) < 0.5 * pattern[near].std()
    assert dr.known_pattern(cut, library=False) is None
    assert dr.known_pattern(replace(cut, first_pixel=(100, 100))) is None
    # The target itself is left out.
    cut.header["TARGPROP"] = "HIP 17695"
    assert dr.known_pattern(cut).provenance["stars"] == ["G-7-34"]


@cache
def system():
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=32)


def test_lost_pixels_are_found_by_the_pattern():
    """The star falls `moved` off its place among the pixels of the pattern's detector."""
    flat = 0.06 * np.random.default_rng(8).normal(size=(38, 38))
    opd, moved = dr.wavefront.random_opd(1, npix=64), np.array([0.3, 1.2])
    frames = dr.simulate(system(), dr.Scene(dr.Star(exposure=20.0)), opd, seed=3)
    net = np.round(moved) - moved
    onto = np.fft.ifft2(fourier_shift(np.fft.fft2(frames.data[0]), net[::-1])).real
    # By no whole pixel in x, and by one in y.
    onto = onto * (1 + flat[2:34, 3:35])
    data = np.fft.ifft2(fourier_shift(np.fft.fft2(onto), -net[::-1])).real
    # A dead pixel in the light of the star, which must not spread when the frame is shifted.
    valid = np.ones((1, 32, 32), dtype=bool)
    valid[0, 12, 20] = False
    header = fits.Header({"DETECTOR": "NRCALONG"})
    observation = replace(frames, data=np.where(valid, data, 0.0), valid=valid, header=header)
    settings = dr.FitSettings(cycles=6, min_model_error=0.05)
    fit = dr.refine(system(), observation, opd, settings=settings)
    known = dr.DetectorPattern(
        flat, np.full(flat.shape, 0.01), (18.5, 18.5), unknown=0.06, first_pixel=(100, 200)
    )
    frame = place_on_detector(fit, known)
    assert frame.first_pixel == (103 - 0, 203 - 1)
    np.testing.assert_allclose(frame.center - observation.center, [[-0.3, -0.2]], atol=0.11)
    assert not frame.valid[~valid].any()
    # The fit leaves out pixels that deviate by as much as the star in them: ringing does that.
    assert (frame.valid != valid).sum() < 4
    for row, column in ((12, 19), (12, 21), (11, 20), (13, 20)):
        assert frame.data[0, row, column] == pytest.approx(onto[row, column], rel=0.08)


@pytest.mark.parametrize("x", [-0.4, 1.7])
def test_a_star_is_measured_to_a_tenth_of_a_pixel(x):
    """About a stated position between the pixels."""
    columns, rows = np.meshgrid(np.arange(101.0), np.arange(101.0))
    stated = np.array([50.3, 49.6])
    distance = np.hypot(columns - stated[0] - x, rows - stated[1])
    star = 1e3 * np.exp(-((distance / 4) ** 2)) * (1 + 0.5 * np.cos(distance))
    away = measured_offset(star, np.ones_like(star), star > -1, stated, 0.063)
    assert away == pytest.approx([x, 0.0], abs=0.1)


def test_padding_around_shifted_frames_leaves_their_pixels_valid():
    """Rows and columns of NaN that were added after the shift are no gaps of the image."""
    smooth = gaussian_filter(np.random.default_rng(1).normal(size=(1, 40, 48)), (0, 1.2, 1.2))
    shift = np.array([[0.3, -0.2]])
    moved, error = shift_frames(100 * smooth, shift), np.ones(smooth.shape)
    around = ((0, 0), (7, 12), (20, 5))
    padded, errors = (np.pad(each, around, constant_values=np.nan) for each in (moved, error))
    inner = np.s_[:, 7:47, 20:68]
    for found, plain in zip(
        undo_shifts(padded, errors, -shift), undo_shifts(moved, error, -shift), strict=True
    ):
        np.testing.assert_array_equal(found[inner], plain)
    valid = undo_shifts(padded, errors, -shift)[2]
    assert valid.sum() == valid[inner].sum() == smooth.size
