"""Detector patterns: learned from many stars, and chosen for a target."""

from contextlib import nullcontext
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import fits
from astropy.time import Time

import pyklip_diffrender as dr
from benchmarks.calints_files import SIDE, calints
from pyklip_diffrender import errors
from pyklip_diffrender.pattern import (
    MeasuredPattern,
    as_request,
    choose_pattern,
    combine_patterns,
    package_library,
)
from pyklip_diffrender.pyklip_backend import subtract_by_refinement
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.reduction.pipeline import prepare
from pyklip_diffrender.scene.detector_pattern import caveat

SIZE = 32
FLAT = "crds://jwst_nircam_flat_9999.fits"
OPD = dr.wavefront.random_opd(1, npix=256)
# The frames differ from the model by flux and pattern only.
ALIGNED = dr.FitSettings(free=("flux", "background"), wavefront=False, companions_if_stalled=False)
RMS = 0.05
PATTERN = RMS * np.random.default_rng(5).normal(size=(SIDE, SIDE))
PEDESTAL = 1.0


@pytest.fixture(scope="module")
def starlight(tmp_path_factory):
    """The image of a star of unit flux in frames like those of `calints`."""
    (frame,) = dr.ExposureSequence.from_files(
        [written(tmp_path_factory.mktemp("one"), "HD 1")]
    ).science
    cut = frame.cutout(SIZE)
    model = dr.model_for(frame, SIZE)
    middle = (SIZE - 1) / 2
    shift = tuple((cut.center[0] - middle) * model.detector.pixelscale)
    image = np.zeros((SIDE, SIDE))
    x, y = np.array(cut.first_pixel) - frame.first_pixel
    with torch.no_grad():
        image[y : y + SIZE, x : x + SIZE] = model(OPD.data, detector_shift=shift).numpy()
    return image


def written(folder, star, k=1, light=None):
    return calints(
        folder / f"jw01184{k:03d}001_03106_00001_nrcalong_calints.fits", star, observation=k,
        roll=70.0 + 5 * k, cards={"SUBSTRT1": 601, "SUBSTRT2": 1601, "R_FLAT": FLAT}, light=light,
        date=f"2022-10-03T{k:02d}:00:00",
    )  # fmt: skip


@pytest.fixture
def frames(tmp_path, starlight):
    """A roll of one star and two of another, with one pattern in the pixels of the detector."""
    folder = tmp_path / "frames"
    for k, (star, flux) in enumerate((("HD 1", 1e8), ("HD 2", 3e8), ("HD 2", 3e8)), 1):
        light = flux * starlight
        written(folder, star, k, light + PATTERN * (light + PEDESTAL))
    return folder


def learned(frames, **options):
    return dr.pattern.learn_patterns(frames, OPD, size=SIZE, settings=ALIGNED, **options)


def test_the_pattern_of_one_star_holds_for_the_other(frames, tmp_path):
    library = learned(frames, folder=tmp_path / "fits")
    rows = library.validation
    assert list(rows["star"]) == ["HD 1", "HD 2"]
    assert list(rows["flat"]) == ["jwst_nircam_flat_9999.fits"] * 2
    assert list(rows["frames"]) == [1, 2]
    # The pattern is several times the noise near the star.
    assert (rows["chi2_alone"] > 3).all()
    assert rows["chi2_with_others"][0] < 0.5 * rows["chi2_alone"][0]
    assert rows["shown"][0] == pytest.approx(1.0, abs=0.1)
    # One frame of another star is too little.
    assert np.isnan(rows["chi2_with_others"][1])
    assert np.isnan(rows["shown"][1])
    # Frames of a third star would be fitted with the pattern that is there.
    frame = dr.Observation.from_fits(written(tmp_path, "HD 3", 9)).cutout(SIZE)
    known = dr.known_pattern(frame, library=library)
    assert known.provenance["stars"] == ["HD 1", "HD 2"]
    x, y = np.array(frame.first_pixel) - (600, 1600)
    truth, (got, error) = PATTERN[y : y + SIZE, x : x + SIZE], known.at(frame)
    sure = error < 0.3 * RMS
    assert sure.mean() > 0.2
    assert np.corrcoef(got[sure], truth[sure])[0, 1] > 0.95
    # Errors are those for another frame, whose scatter from frame to frame adds to them.
    assert 0.3 < ((got - truth) / error)[sure].std() < 1.3
    # The same run takes its fits from the folder; one that is damaged is made again.
    kept = sorted((tmp_path / "fits").iterdir())
    assert len(kept) == 3
    times = [each.stat().st_mtime_ns for each in kept]
    kept[0].write_bytes(kept[0].read_bytes()[:5000])
    again = learned(frames, folder=tmp_path / "fits")
    assert sorted((tmp_path / "fits").iterdir()) == kept
    assert [each.stat().st_mtime_ns for each in kept][1:] == times[1:]
    for one, other in zip(library.patterns, again.patterns, strict=True):
        np.testing.assert_allclose(one.value, other.value, atol=1e-9)


@pytest.mark.parametrize(("card", "value"), [("ROLL_REF", 171.0), ("R_FLAT", "new.fits")])
def test_frames_whose_header_was_corrected_are_fitted_again(
    frames, tmp_path, monkeypatch, card, value
):
    """The pixels are the same; date, flat field and star of a pattern are those of the header."""
    (path, *_) = sorted(frames.iterdir())
    kept = tmp_path / "fits"
    learned([path], folder=kept)
    (first,) = kept.iterdir()
    fits.setval(path, card, value=value, ext=int(card == "ROLL_REF"))
    learned([path], folder=kept)
    (last,) = set(kept.iterdir()) - {first}
    (frame,) = dr.Refinement.read(last).frames
    assert frame.observation.header[card] == value
    # With the header as it was corrected, nothing is fitted any more.
    monkeypatch.setattr("pyklip_diffrender.pattern.learn.refine", None)
    learned([path], folder=kept)


def test_stars_and_filters_that_are_not_there_are_refused(frames):
    with pytest.raises(
        errors.IncompatibleSetupError, match=r"star: got 'HD 7', expected one of 'HD 1'"
    ):
        learned(frames, stars=["HD 7"])
    with pytest.raises(errors.IncompatibleSetupError, match=r"filter: got 'F356W'"):
        learned(frames, filters=["F356W"])


def test_frames_without_a_place_or_a_unit_are_left_out(tmp_path, caplog):
    calints(tmp_path / "a_calints.fits", "HD 1")
    cards = {"BUNIT": "DN/s", "SUBSTRT1": 601, "SUBSTRT2": 1601}
    calints(tmp_path / "b_rateints.fits", "HD 2", observation=2, cards=cards)
    with pytest.raises(errors.NoValidPixelsError, match="no star is left"):
        learned(tmp_path)
    assert "does not say which pixels of the detector" in caplog.text
    assert "its unit is" in caplog.text


def measured(star, k=1, **changes):
    """The pattern of a frame whose residual does not depend on the pedestal."""
    light = 10.0 + np.indices((SIZE, SIZE))[0]
    left = 0.3 * np.random.default_rng([k, ord(star[0])]).normal(size=light.shape)
    pattern = MeasuredPattern(
        star=star, value=left / (light + 1), variance=(0.1 / (light + 1)) ** 2, center=(15.5, 15.5),
        first_pixel=(600, 1600), filter="F444W", image_mask="MASK335R", frame=f"{star} {k}.fits",
        date="2022-10-03", pedestal=1.0, detector="NRCALONG", flat="new.fits", light=light,
    )  # fmt: skip
    return replace(pattern, **changes)


def observation(**cards):
    header = {"INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "CORONMSK": "MASKA335R", **cards}
    ones = np.ones((SIZE, SIZE))
    return dr.Observation.from_arrays(
        ones, ones, pixelscale=0.063, filter="F444W", header=header, first_pixel=(600, 1600)
    )


def test_a_library_is_searched_by_setup_place_star_and_flat():
    library = dr.PatternLibrary((
        measured("A"), measured("B"), measured("B", 2, flat="old.fits"),
        measured("C", image_mask="MASK430R"), measured("C", filter="F356W"),
        measured("C", detector="NRCA2"), measured("C", first_pixel=(100, 1600)),
    ))  # fmt: skip

    def stars(**cards):
        return [f"{each.star} {each.flat}" for each in library.matching(observation(**cards))]

    assert stars(R_FLAT="crds://new.fits") == ["A new.fits", "B new.fits"]
    assert stars(R_FLAT="crds://old.fits") == ["B old.fits"]
    # A flat field that none has: the one of most patterns, which the fit may refute.
    assert stars(R_FLAT="crds://newest.fits") == stars() == ["A new.fits", "B new.fits"]
    assert stars(R_FLAT="new.fits", TARGNAME="a") == ["B new.fits"]
    # A star is known by its coordinates too: another programme may call it by another name.
    frame = observation(TARGPROP="Target 7", TARG_RA=53.1, TARG_DEC=-9.4)
    catalogue = replace(measured("A").catalogue, names=("G 80-21",), coordinates=(53.1001, -9.4))
    library = dr.PatternLibrary((measured("G 80-21", catalogue=catalogue), measured("B")))
    assert [each.star for each in library.matching(frame)] == ["B"]
    # Nor do the coordinates of another epoch make it another star.
    moved = {"MU_RA": 0.0, "MU_DEC": 4.5, "MU_EPOCH": "2000-01-01", "DATE-BEG": "2022-12-01"}
    frame = observation(TARGPROP="Target 7", TARG_RA=53.1, TARG_DEC=-9.4 + 103.1 / 3600, **moved)
    assert [each.star for each in library.matching(frame)] == ["B"]


def test_pedestals_are_brought_together():
    one = measured("A")
    other = one.with_pedestal(3.0)
    np.testing.assert_allclose(other.value * (one.light + 3.0), one.value * (one.light + 1.0))
    frame = observation()
    # Without their stars the patterns of a file keep the pedestal that they have.
    bare = replace(measured("B", pedestal=0.7), light=None)
    for second, expected in ((measured("B"), 1.0), (bare, 0.7)):
        library = dr.PatternLibrary((other, second, measured("C")))
        assert dr.known_pattern(frame, library=library).pedestal == expected
    both = dr.PatternLibrary((bare, replace(measured("C"), light=None)))
    with pytest.raises(errors.IncompatibleSetupError, match="without its star"):
        dr.known_pattern(frame, library=both)


def test_libraries_survive_their_files_and_are_combined(tmp_path):
    unknown = measured("B").variance.copy()
    unknown[3, 4] = np.inf
    catalogue = replace(
        measured("A").catalogue, names=("A", "Ä 1"), coordinates=(10.0, 2.0), motion=(0.3, -0.2),
        epochs=(2000.5, Time(measured("A").date).jyear),
    )  # fmt: skip
    first = dr.PatternLibrary((measured("A", catalogue=catalogue), measured("B", variance=unknown)))
    second = dr.PatternLibrary(
        (measured("B", value=np.zeros_like(unknown)), measured("C", light=None))
    )
    first.write(tmp_path / "one.fits.gz")
    second.write(tmp_path / "two.fits")
    both = dr.PatternLibrary.read(tmp_path)
    assert [each.frame for each in both.patterns] == ["A 1.fits", "B 1.fits", "C 1.fits"]
    a, b, c = both.patterns
    np.testing.assert_allclose(a.value, measured("A").value, rtol=1e-6)
    np.testing.assert_allclose(b.variance, unknown, rtol=1e-6)
    assert a.light is not None
    assert c.light is None
    assert (a.detector, a.flat, a.image_mask) == ("NRCALONG", "new.fits", "MASK335R")
    assert a.catalogue == replace(catalogue, names=("A", "A 1"))
    assert len(dr.pattern.combine_libraries([both, package_library()]).patterns) == 11
    (tmp_path / "one.fits.gz").unlink()
    measured_file = dr.DetectorPattern(np.zeros((8, 8)), np.ones((8, 8)), (15.5, 15.5), 0.1)
    measured_file.write(tmp_path / "pattern.fits")
    with pytest.raises(errors.CorruptFileError, match=r"pattern.fits: got no version"):
        dr.PatternLibrary.read(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(errors.CorruptFileError, match="no FITS files"):
        dr.PatternLibrary.read(tmp_path / "empty")


def test_a_folder_of_libraries_is_a_choice_of_pattern(tmp_path):
    dr.PatternLibrary((measured("A"), measured("B"))).write(tmp_path / "own" / "one.fits")
    options = ReduceOptions(size=SIZE, pattern=tmp_path / "own")
    assert isinstance(options.pattern, dr.PatternLibrary)
    frame = observation(R_FLAT="new.fits")
    chosen = choose_pattern([frame], [], model(), OPD, pattern=options.pattern)
    assert chosen.label == "library (A, B)"
    # Where the folder has nothing, the package's library may have something.
    other = replace(observation(R_FLAT="jwst_nircam_flat_0465.fits"), first_pixel=(620, 1650))
    chosen = choose_pattern([other], [], model(), OPD, pattern=options.pattern)
    assert chosen.label == "library (HIP17695, G-7-34)"
    settings = dr.pyklip_backend.DiffrenderSettings(pattern=tmp_path / "own")
    assert len(settings.pattern.patterns) == 2
    with pytest.raises(errors.IncompatibleSetupError, match=r"pattern: got .*nowhere"):
        dr.pyklip_backend.DiffrenderSettings(pattern=tmp_path / "nowhere")


@pytest.mark.slow
def test_real_stars_teach_the_pattern_of_another(shared_data):
    """Two rolls each of two stars, with fits of few modes and cheap derivatives."""
    settings = {
        "cycles": 9.0, "max_companions": 0, "max_iterations": 8, "response_npix": 64,
        "accurate_steps": False, "companions_if_stalled": False,
    }  # fmt: skip
    library = dr.pattern.learn_patterns(
        shared_data / "gto1184", shared_data / "opd_2022-08-14.fits.gz", filters=["F444W"], size=32,
        stars=["HIP 17695", "G 7-34"], settings=dr.FitSettings.nircam("F444W", **settings),
    )  # fmt: skip
    rows = library.validation
    assert list(rows["star"]) == ["HIP17695", "G-7-34"]
    assert (rows["chi2_with_others"] < 0.5 * rows["chi2_alone"]).all()
    # The package's own patterns are of the same frames, from fits of larger squares.
    own = {each.frame: each for each in package_library().patterns}
    for pattern in library.patterns:
        other = own[pattern.frame]
        x, y = np.subtract(pattern.first_pixel, other.first_pixel)
        there = (slice(y, y + 32), slice(x, x + 32))
        both = np.isfinite(pattern.variance) & np.isfinite(other.variance[there])
        assert np.corrcoef(pattern.value[both], other.value[there][both])[0, 1] > 0.7


COARSE = dr.wavefront.random_opd(1, npix=64)
LIBRARY = {"INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "CORONMSK": "MASKA335R"}
SAME_FLAT = {**LIBRARY, "R_FLAT": "crds://jwst_nircam_flat_0465.fits"}
OTHER_FLAT = {**LIBRARY, "R_FLAT": "crds://jwst_nircam_flat_0999.fits"}
ELSEWHERE = {**LIBRARY, "DETECTOR": "NRCA2"}
PLACE = (625, 1659)
"""Pixels in the middle of those that the library has."""
STARS = "HIP17695, G-7-34"


@cache
def model():
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=SIZE)


def frame(target, cards, *, shown=1.0, seed=1):
    """A bright star, with a part of the library's pattern, on known pixels."""
    light = 3e6 * model()(COARSE.data).numpy()
    blank = dr.Observation.from_arrays(
        light, np.ones_like(light), pixelscale=model().detector.pixelscale, filter="F444W",
        unit=u.MJy / u.sr, name=f"{target} {seed}", first_pixel=PLACE,
        header=fits.Header({"TARGPROP": target, **LIBRARY}), position_angles=np.array([5.0 * seed]),
    )  # fmt: skip
    known = dr.known_pattern(blank)
    noise = 0.01 * np.sqrt(light + 1.0)
    data = light + shown * known.at(blank)[0] * (light + known.pedestal)
    data += noise * np.random.default_rng(seed).standard_normal(light.shape)
    header = fits.Header({"TARGPROP": target, **cards})
    return replace(blank, data=data[None], error=noise[None], header=header)


def rolls(cards, **changes):
    return [frame("TARGET", cards, seed=k, **changes) for k in (1, 2)]


def fitting(made):
    """Fits with the chosen pattern, which are listed by its label and whether they are repeated."""

    def fit(choice, again):
        made.append((choice.label, again))
        pattern = choice.pattern
        return dr.refine(model(), choice.science, COARSE, settings=ALIGNED, pattern=pattern)

    return fit


@pytest.mark.parametrize(
    ("request_", "cards", "fitted", "label", "used"),
    [
        ("auto", LIBRARY, False, f"library ({STARS})", 0),
        ("auto", ELSEWHERE, True, "references (REF)", 2),
        ("references", LIBRARY, True, f"references (REF), library ({STARS})", 2),
        ("off", LIBRARY, False, "none", 0),
        ("mine", LIBRARY, False, "given (mine)", 0),
    ],
)
def test_references_are_fitted_only_where_they_are_needed(request_, cards, fitted, label, used):
    zeros = np.zeros((SIZE, SIZE))
    mine = dr.DetectorPattern(zeros, zeros, (15.5, 15.5), 0.1, name="mine")
    read = []

    def references():
        read.extend(frame("REF", cards, seed=k) for k in (3, 4))
        return read

    chosen = choose_pattern(
        # Two rolls, which would share a pattern of their own if nothing else were known.
        rolls(cards), references, model(), COARSE, settings=ALIGNED,
        pattern=mine if request_ == "mine" else request_,
    )  # fmt: skip
    assert bool(read) == bool(chosen.references) == fitted
    assert (chosen.label, sum(len(fit.frames) for fit in chosen.references)) == (label, used)
    assert (chosen.pattern is None) == (label == "none")
    assert chosen.settings is ALIGNED


def test_a_known_pattern_takes_the_place_of_most_of_the_models_error():
    (roll,) = (frame("TARGET", LIBRARY),)
    preset = dr.FitSettings.nircam("F444W", min_model_error=0.002)
    assert choose_pattern([roll], (), model(), COARSE).settings == preset
    limited = choose_pattern([roll], (), model(), COARSE, memory=2e9).settings
    assert limited == replace(preset, memory=2e9)
    assert choose_pattern([roll], (), model(), COARSE, pattern="off").settings is None


@pytest.mark.parametrize(
    ("cards", "shown", "references", "labels"),
    [
        (SAME_FLAT, 1.0, 2, [f"library ({STARS})"]),
        (SAME_FLAT, 0.0, 2, [f"library ({STARS})", "references (REF)"]),
        (SAME_FLAT, 0.0, 0, [f"library ({STARS})", "the rolls themselves"]),
        # The first frame tells as much where the header names another flat field, or none.
        (LIBRARY, 0.0, 2, ["references (REF)"]),
        (OTHER_FLAT, 0.0, 0, ["the rolls themselves"]),
        (OTHER_FLAT, 1.0, 2, [f"library ({STARS})"]),
    ],
)
def test_a_library_of_another_flat_field_is_replaced(cards, shown, references, labels):
    """The fit is repeated with what there is besides the library."""
    made = []
    others = [frame("REF", cards, shown=shown, seed=3 + k) for k in range(references)]
    given = rolls(cards, shown=shown), others, model(), COARSE
    choice, last = dr.pattern.fit_with_pattern(*given, fitting(made), settings=ALIGNED)
    assert made == list(zip(labels, (False, True), strict=False))
    assert last.pattern is choice.pattern


def test_rolls_share_an_unknown_pattern_where_nothing_is_known():
    def chosen(*rolls, pattern="auto"):
        return choose_pattern(rolls, [], model(), COARSE, pattern=pattern).pattern

    roll, turned = rolls(ELSEWHERE)
    pattern = chosen(roll, turned)
    assert pattern.name == "the rolls themselves"
    values, errors = pattern.at(roll)
    assert (values == 0).all()
    assert (errors == 0.03).all()
    assert pattern.pedestal == 1.9
    assert chosen(roll, replace(turned, unit=u.DN / u.s)) is not None
    # One roll, in one file or two, different pixels, pixels that are not known, other instruments,
    # and "off".
    elsewhere = replace(turned, first_pixel=(601, 1600))
    lost = [replace(each, first_pixel=None) for each in (roll, turned)]
    simulated = [replace(each, header=fits.Header()) for each in (roll, turned)]
    for frames in ([roll], [roll, roll], [roll, elsewhere], lost, simulated):
        assert chosen(*frames) is None
    assert chosen(roll, turned, pattern="off") is None


@pytest.mark.parametrize("shown", [1.0, 0.0])
def test_a_rough_fit_tells_which_pixels_a_frame_shows(shown, caplog):
    """Where it shows the pattern; otherwise the pattern is not used."""
    lost = replace(frame("TARGET", LIBRARY, shown=shown), first_pixel=None)
    choice = choose_pattern([lost], [], model(), COARSE, settings=ALIGNED)
    assert (choice.label == f"library ({STARS})") == (shown > 0)
    assert choice.science[0].first_pixel == (PLACE if shown else None)
    assert ("is not seen in them; it is not used" in caplog.text) == (shown == 0)
    assert choice.settings is ALIGNED


# A pattern that is given has to be one that could have been chosen.


@cache
def given():
    """The library's pattern of these pixels, as it is in the products of a reduction."""
    return dr.known_pattern(frame("TARGET", SAME_FLAT))


WRONG = [
    ({"TARGPROP": "hip 17695"}, {}, "was learned from frames of hip 17695, the star of"),
    # Another programme may call it by another name.
    (
        {"TARGPROP": "M dwarf 3", "TARG_RA": 56.8473, "TARG_DEC": -1.9722}, {},
        "learned from frames of M dwarf 3, .*: its planets are part of the pattern",
    ),
    ({"CORONMSK": "MASKA430R"}, {}, "with the mask MASK335R, .* has the mask MASK430R"),
    ({"DETECTOR": "NRCA2"}, {}, "with the detector NRCALONG, .* has the detector NRCA2"),
    ({}, {"filter": "F356W"}, "with the filter F444W, .* has the filter F356W"),
    ({}, {"first_pixel": (100, 1600)}, r"none of the pixels .* from \(100, 1600\) on"),
]  # fmt: skip


@pytest.mark.parametrize(("cards", "changes", "message"), WRONG)
def test_a_pattern_that_could_not_have_been_chosen_is_refused(cards, changes, message, tmp_path):
    """Before any work, and alike wherever it is given; also one that was written and read."""
    one, two = (
        replace(each, **changes, header=fits.Header({**each.header, **cards}))
        for each in rolls(SAME_FLAT)
    )
    pattern = dr.DetectorPattern.read(given().write(tmp_path / "pattern.fits"))
    with pytest.raises(errors.IncompatibleSetupError, match=message):
        dr.refine(model(), [one, two], COARSE, pattern=pattern)
    options = ReduceOptions(size=SIZE, pattern=tmp_path / "pattern.fits")
    with pytest.raises(errors.IncompatibleSetupError, match=message):
        prepare(dr.ExposureSequence(one.target, (one, two)), COARSE, options, model=model())
    settings = dr.pyklip_backend.DiffrenderSettings(model=model(), pattern=pattern)
    with pytest.raises(errors.IncompatibleSetupError, match=message):
        subtract_by_refinement(one, COARSE, settings)


def test_what_a_pattern_does_not_say_is_a_remark(tmp_path, caplog):
    """Files of earlier versions name their stars, and neither their places nor the flat field."""
    path = given().write(tmp_path / "pattern.fits")
    with fits.open(path, mode="update") as hdus:
        for card in ("DETECTOR", "R_FLAT", "CATALOG"):
            del hdus["PATTERN"].header[card]
    old = dr.DetectorPattern.read(path)
    assert [star.names for star in old.stars] == [("HIP17695",), ("G-7-34",)]
    missing = "do not say it: detector, flat field"
    first, second = rolls(SAME_FLAT)
    assert missing in caveat(old, first)
    assert caveat(given(), first) == ""
    # The pattern reaches 9 of 32 columns.
    aside = replace(first, first_pixel=(PLACE[0] + 47, PLACE[1]))
    assert caveat(given(), aside) == "covers 28 % of the pixels"
    sequence = dr.ExposureSequence("TARGET", (first, second))
    begun = prepare(sequence, COARSE, ReduceOptions(size=SIZE, pattern=old), model=model())
    assert missing in caplog.text
    assert begun.options.pattern is old
    same = replace(first, header=fits.Header({**first.header, "TARGPROP": "G 7-34"}))
    with pytest.raises(errors.IncompatibleSetupError, match="learned from frames of G 7-34"):
        prepare(dr.ExposureSequence("G 7-34", (same,)), COARSE, begun.options, model=model())
    caplog.clear()
    foreign = dr.PatternLibrary((measured("A", filter="F356W"),))
    prepare(sequence, COARSE, ReduceOptions(size=SIZE, pattern=foreign), model=model())
    assert "none of the 1 patterns that were given" in caplog.text


@pytest.mark.parametrize(("cards", "fitted"), [(SAME_FLAT, 1), (LIBRARY, 1), (OTHER_FLAT, 0)])
def test_a_pattern_that_is_given_and_not_seen_is_refused(cards, fitted):
    """Before the fit where the frames name another flat field than the pattern."""
    made = []
    fit = fitting(made)
    arguments = {"settings": ALIGNED, "pattern": given()}
    message = "shows less than half of the pattern 'HIP17695, G-7-34'. .*_0465.fits"
    with pytest.raises(errors.IncompatibleSetupError, match=message):
        dr.pattern.fit_with_pattern(rolls(cards, shown=0.0), (), model(), COARSE, fit, **arguments)
    assert len(made) == fitted
    shown = rolls(cards)
    choice, _ = dr.pattern.fit_with_pattern(shown, (), model(), COARSE, fit, **arguments)
    assert choice.pattern is given()
    # Only one of two rolls has another flat field.
    if cards == OTHER_FLAT:
        mixed = [rolls(SAME_FLAT)[0], rolls(cards, shown=0.0)[1]]
        with pytest.raises(errors.IncompatibleSetupError, match=message):
            dr.pattern.fit_with_pattern(mixed, (), model(), COARSE, fit, **arguments)
        assert len(made) == 1


def test_frames_are_moved_onto_the_pixels_of_a_pattern_that_is_given():
    lost, bare = (replace(frame("TARGET", LIBRARY, shown=k), first_pixel=None) for k in (1.0, 0.0))
    arguments = {"settings": ALIGNED, "pattern": given()}
    chosen = choose_pattern([lost], [], model(), COARSE, **arguments)
    assert chosen.science[0].first_pixel == PLACE
    with pytest.raises(errors.IncompatibleSetupError, match="is not seen in these frames"):
        choose_pattern([bare], [], model(), COARSE, **arguments)


def test_products_in_place_of_other_files_are_named(tmp_path):
    """The same thing is said wherever they are given."""
    (roll,) = (frame("TARGET", {**SAME_FLAT, "EXP_TYPE": "NRC_CORON"}),)
    fit = dr.refine(model(), roll, COARSE, settings=ALIGNED)
    known = dr.PatternLibrary((measured("A"),))
    products = {
        "a fit": fit.write(tmp_path / "fit.fits"),
        "a search": dr.detect(fit).write(tmp_path)[0],
        "a detector pattern": given().write(tmp_path / "pattern.fits"),
        "a library of detector patterns": known.write(tmp_path / "library.fits"),
    }
    for what, path in products.items():
        words = f"{path.name}: this is no OPD map, but {what}, a product of pyklip_diffrender"
        with pytest.raises(errors.CorruptFileError, match=words):
            dr.read_opd(path)
        words = f"{path.name}: it is {what}, a product of pyklip_diffrender; expected frames"
        with pytest.raises(errors.NoValidPixelsError, match=words):
            dr.ExposureSequence.from_files(path)
        if "pattern" in what:
            assert as_request(path) is not None
            continue
        with pytest.raises(errors.CorruptFileError, match=f"this is {what}, expected a detector"):
            as_request(path)


def test_patterns_of_several_flat_fields_and_set_ups_are_not_averaged():
    for name, value in {"flat": "old.fits", "detector": "NRCA2", "image_mask": "MASK430R"}.items():
        with pytest.raises(errors.IncompatibleSetupError, match=value):
            combine_patterns([measured("A"), measured("B", **{name: value})])
        both = combine_patterns([measured("A"), measured("B", **{name: None})])
        assert getattr(both, name) is None
    # Of reference stars and a library, the flat field of the frames decides.
    fit = dr.refine(model(), rolls(OTHER_FLAT), COARSE, settings=ALIGNED)
    for cards, stars in ((OTHER_FLAT, ["TARGET"]), (SAME_FLAT, ["HIP17695", "G-7-34"])):
        assert dr.known_pattern(frame("NEW", cards), fit).provenance["stars"] == stars


@pytest.mark.parametrize(
    ("cards", "shown", "label"),
    [
        ({}, 1.0, "none"),
        pytest.param(LIBRARY, 1.0, STARS, marks=pytest.mark.slow),
        (SAME_FLAT, 0.0, "none"),
    ],
)
def test_pyklip_chooses_as_a_reduction_does(cards, shown, label):
    """Simulations use no pattern by default."""
    settings = dr.pyklip_backend.DiffrenderSettings(
        model=model(), settings=ALIGNED, max_chi2=np.inf, keep_detected=False
    )
    told = []
    # On simulations the pattern is an error of the model.
    warned = nullcontext() if cards else pytest.warns(errors.DiffrenderWarning)
    with warned:
        star = frame("TARGET", cards, shown=shown)
        result = subtract_by_refinement(star, COARSE, settings, tell=told.append)
    assert result.pattern == label
    refuted = any("without the library's detector pattern" in each for each in told)
    assert refuted == (bool(cards) and shown == 0)
