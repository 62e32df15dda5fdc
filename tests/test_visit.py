"""Frames of reference stars in one likelihood with those of the target."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.time import Time

import pyklip_diffrender as dr
from pyklip_diffrender.cli.reducing import describe_steps
from pyklip_diffrender.detection import sources_of_references
from pyklip_diffrender.detection.error_factor import structures_in_single_roll
from pyklip_diffrender.pattern import (
    PatternLibrary,
    choose_pattern,
    is_known_beside,
    known_pattern,
    measure_patterns,
    pattern_for_visit,
)
from pyklip_diffrender.reduction import ReduceOptions, pipeline
from pyklip_diffrender.reduction import visit as visits
from pyklip_diffrender.reduction.klip import klip_curve
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.reduction.visit import Visit, with_references
from pyklip_diffrender.refinement import FitSettings, align_frame, join_frames, refine
from pyklip_diffrender.refinement.annealing import Annealing
from pyklip_diffrender.refinement.settings import exposure_sequences
from pyklip_diffrender.scene.exposure import CatalogueStar
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.priors import WavefrontPrior

SIZE, NPIX = 32, 64
FLUX, FLAT, DRIFT = 1e8, 0.02, 1e-9
PLANET = Planet(3e-5, 0.7, 40.0)
SETTINGS = FitSettings(
    free=("star_offset", "flux", "background"), cycles=7.0,
    prior=WavefrontPrior({"segment": 6.0, "texture": 3.0}, knee=1.0, fit_scales=False),
    companions_if_stalled=False, min_model_error=0.002, robust=3.0,
)  # fmt: skip
OPD = dr.wavefront.random_opd(1, npix=NPIX)


@cache
def model():
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=SIZE)


def image(change, place, drift=DRIFT):
    """A point source of flux 1 with a wavefront that differs from the map."""
    now = OPD.data + dr.wavefront.random_opd(90, npix=NPIX, rms=4e-9).data
    now = now + dr.wavefront.random_opd(100 + change, npix=NPIX, rms=drift).data
    return model()(now, star_offset=place).detach().numpy()


def frame(star, k, light, **facts):
    """A frame with the flat-field errors of these pixels and noise of its own."""
    flat = 1 + FLAT * np.random.default_rng(5).normal(size=light.shape)
    error = np.sqrt(0.25 + 0.01 * np.abs(light))
    data = flat * light + error * np.random.default_rng(k).normal(size=light.shape)
    header = {"INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "CORONMSK": "MASKA335R"}
    facts = {
        "date": Time(f"2022-10-03T0{k}:00"), "position_angles": np.array([facts.pop("angle", 0.0)]),
        "reference": star != "HD 1", "first_pixel": (600, 1600), **facts,
    }  # fmt: skip
    return Observation.from_arrays(
        data, error, unit=u.MJy / u.sr, pixelscale=model().detector.pixelscale, filter="F444W",
        name=f"{star} {k}", header=fits.Header({**header, "TARGPROP": star}), **facts,
    )  # fmt: skip


@cache
def science():
    frames = []
    for k, (roll, place) in enumerate([(0.0, (0.002, -0.003)), (10.0, (-0.003, 0.001))]):
        beside = tuple(np.add(place, PLANET.rotated(-roll).offset))
        light = image(k, place) + PLANET.contrast * image(k, beside)
        frames.append(frame("HD 1", k + 1, FLUX * light, angle=roll))
    return tuple(frames)


def reference(k, brightness=2.0, drift=DRIFT, companion=0.0, **changes):
    x, y = ((0.0, 0.0), (0.01, 0.01), (-0.01, 0.01))[k % 3]
    light = image(10 + k, (x, y), drift)
    if companion:
        light = light + companion * image(10 + k, (x + 0.5, y - 0.4))
    return frame("HD 2", k + 4, brightness * FLUX * light, **{"angle": 50.0, **changes})


@cache
def alone():
    """The pattern of the rolls themselves, and the fit of the target with it."""
    choice = choose_pattern(science(), (), model(), OPD, settings=SETTINGS)
    assert choice.origin == "rolls"
    fit = refine(model(), science(), OPD, pattern=choice.pattern, settings=SETTINGS)
    return choice, fit


def joined(*references, **keywords):
    choice, fit = alone()
    fit, visit, _ = with_references(fit, choice, references, **keywords)
    return fit, visit, [each.use for each in visit.contributions]


def together(fit, references, settings):
    """All frames in one likelihood, with the unknown pattern of the rolls."""
    pattern = alone()[0].pattern
    aligned = [align_frame(fit, each, settings, pattern=pattern) for each in references]
    return join_frames(fit, aligned, settings, pattern=pattern)


def limit(fit):
    curve = dr.detect(fit, separations=[0.5, 0.7], scatter=1.0, relinearise=np.inf).contrast_curve
    return float(np.mean(curve["contrast"]))


def candidate_of(detection):
    """The only candidate, which is the planet."""
    (row,) = detection.candidates
    assert abs(float(row["contrast"]) - PLANET.contrast) < 3 * float(row["contrast_error"])
    return row


def test_references_make_the_limits_deeper_and_leave_the_planet_alone():
    fit, visit, used = joined(*(reference(k) for k in range(3)))
    assert used == ["wavefront"] * 3
    assert visit.gain == pytest.approx(limit(alone()[1]) / limit(fit), rel=0.1)
    assert visit.gain > 1.15
    for each in visit.contributions:
        assert each.flux == pytest.approx(2.0, rel=0.05)
        assert 0.4 < each.chi2 < 1.3
        assert 0 < each.drift < 6
    assert len(visit.contributions) == 3
    detection = dr.detect(fit)
    candidate_of(detection)
    distant = np.hypot(*np.moveaxis(detection.grid, -1, 0)) > 0.3
    assert 0.8 < np.nanstd(detection.residual_snr[distant]) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [4e-4, 5e-3])
def test_a_companion_of_a_reference_is_masked_and_named(contrast):
    """One that the joint fit shows, and one without which the frames would not be in it."""
    fit, visit, used = joined(*(reference(k, companion=contrast) for k in range(2)))
    assert used == ["wavefront"] * 2
    assert visit.gain > 1.1
    for each in visit.contributions:
        assert "arcsec is subtracted and masked" in each.reason
    for part in fit.frames[2:]:
        away = np.hypot(part.grid[..., 0] - 0.5, part.grid[..., 1] + 0.4)
        assert not part.observation.valid[0, away < 0.15].any()
        assert part.observation.valid[0, away > 0.4].mean() > 0.95
    assert not sources_of_references(fit)
    # Without the mask, the target would have a hole at the pixels of the companion.
    detection = dr.detect(fit)
    assert len(detection.candidates) == 1
    assert np.nanmin(detection.residual_snr) > -5


def test_a_reference_with_another_wavefront_does_not_take_part():
    fit, visit, used = joined(reference(0), reference(1, drift=4e-8))
    assert used == ["wavefront", "not used"]
    assert "is not explained" in visit.contributions[1].reason
    assert len(fit.frames) == 3


@pytest.mark.slow
def test_a_reference_that_contradicts_the_target_is_left_out_by_name(monkeypatch):
    monkeypatch.setattr("pyklip_diffrender.reduction.visit._UNLIKE_STAR_RATIO", np.inf)
    turned = reference(1)
    turned = replace(turned, data=turned.data[:, ::-1].copy(), name="mirrored")
    fit, visit, used = joined(reference(0), turned)
    assert used == ["wavefront", "not used"]
    assert "chi-squared" in visit.contributions[1].reason
    assert [part.observation.name for part in fit.frames] == ["HD 1 1", "HD 1 2", "HD 2 4"]


def test_the_fit_of_the_target_is_kept_where_references_do_not_help():
    fit, visit, used = joined(reference(0, brightness=0.01))
    assert fit is alone()[1]
    assert used == ["not used"]
    assert "of the target's flux" in visit.contributions[0].reason
    assert joined() == (alone()[1], Visit(), [])


@pytest.mark.slow
def test_limits_are_compared_as_they_are_stated():
    choice, fit = alone()
    searched = []

    def search(one):
        searched.append(one)
        # With references, the S/N scatters by twice as much as it should.
        return dr.detect(one, scatter=float(len(searched)), relinearise=1e9)

    frames = [reference(k) for k in range(3)]
    kept, visit, detection = with_references(fit, choice, frames, search=search)
    assert searched[0] is fit
    assert len(searched) == 2
    # The planet is bright in the target's frames, and so in the model of all from the beginning.
    assert searched[1].companions[0, 0] == pytest.approx(PLANET.contrast, rel=0.2)
    assert kept is fit
    assert detection.scatter == 1.0
    assert "limits would be" in visit.contributions[0].reason


@pytest.mark.slow
def test_frames_that_do_not_fit_into_the_memory_are_left_out(caplog):
    derivatives = 4.0 * alone()[1].linear.frames[0].jacobian.numel()
    # The process and the two rolls, and one frame more.
    memory = (1.3e9 + (2 + 1.5 * 2.2) * derivatives) / 0.9
    choice, fit = alone()
    fit = replace(fit, settings=replace(fit.settings, memory=memory))
    _, visit, _ = with_references(fit, choice, [reference(0), reference(1)], memory=memory)
    assert [each.use for each in visit.contributions] == ["wavefront", "not used"]
    assert "memory" in visit.contributions[1].reason
    assert "GB of the option memory" in caplog.text


@cache
def with_a_reference():
    """A reference star beside a target with a bad pixel and a known flux."""
    _, fit = alone()
    valid = np.ones((1, SIZE, SIZE), dtype=bool)
    valid[:, 20, 9] = False
    frames = [
        replace(
            part, observation=replace(part.observation, valid=part.observation.valid & valid),
            start={**part.start, "flux": part.flux},
        )
        for part in fit.frames
    ]  # fmt: skip
    settings = replace(SETTINGS, deviations={"flux": 1e-3})
    return together(replace(fit, frames=tuple(frames)), [reference(0)], settings)


def test_bad_pixels_of_the_target_are_bad_in_the_references_and_its_flux_is_its_own():
    target, _, star = with_a_reference().frames
    assert not star.observation.valid[0, 20, 9]
    assert star.observation.valid[0, 20, 10]
    assert target.flux == pytest.approx(alone()[1].frames[0].flux, rel=5e-3)
    assert star.flux == pytest.approx(2 * FLUX, rel=0.05)


@pytest.mark.parametrize("other", [False, True])
def test_only_frames_of_the_same_pixels_share_a_pattern(other):
    elsewhere = [reference(0, first_pixel=(640, 1600))]
    joint = together(alone()[1], elsewhere, SETTINGS) if other else with_a_reference()
    shares = [bool((part.common != 0).any()) for part in joint.linear.frames]
    assert shares == [True, True, not other]
    # Where its pixels are its own, the pattern is noise of the frame.
    weight, noise = joint.linear.frames[2].weight, joint.frames[2].observation.error[0]
    ratio = np.median((1 / weight[weight > 0]).numpy() / noise[weight.numpy() > 0])
    assert (ratio > 1.05) == other


def test_a_pattern_is_not_learned_twice_from_a_reference():
    choice, _ = alone()

    def pattern(**changes):
        return pattern_for_visit(replace(choice, **changes), science(), [reference(0)])

    assert pattern(origin="library") is not None
    assert pattern(origin="given") is choice.pattern
    # One that was given and has the star of a reference frame is not of other stars.
    learned = replace(choice.pattern, provenance={"stars": ["hd-2"]})
    assert pattern(origin="given", pattern=learned).name == "the rolls themselves"
    assert learned.name == "the rolls themselves"
    assert pattern(origin="off", pattern=None) is None
    elsewhere = [reference(0, first_pixel=(700, 1600))]
    assert pattern_for_visit(replace(choice, origin="none"), science()[:1], elsewhere) is None


TEACHING, TOGETHER = "reference star HD 2", "reference stars and target together"


@pytest.mark.parametrize(
    ("near", "far", "options", "planned", "alone"),
    [
        (3, 0, {}, [TOGETHER], 0),
        (1, 0, {}, [TOGETHER], 0),
        (1, 2, {}, [TEACHING, TOGETHER], 0),
        (3, 2, {}, [TEACHING, TOGETHER], 0),
        (0, 2, {"references": "off"}, [], 2),
        (0, 2, {"pattern": "off"}, [], 2),
        (1, 1, {"references": "pattern"}, [TEACHING], 0),
    ],
)
def test_a_plan_has_what_reference_frames_are_used_for(near, far, options, planned, alone):
    references = (*(reference(k) for k in range(near)), *(later(k) for k in range(far)))
    sequence = dr.ExposureSequence("HD 1", science(), references)
    steps = describe_steps(sequence, ReduceOptions(size=SIZE, **options)).splitlines()
    names = [each.partition(". ")[2] for each in steps]
    assert [name for name in names if name in (TEACHING, TOGETHER)] == planned
    only = f", with {alone} reference frame{'' if alone == 1 else 's'} for KLIP only"
    assert names[-1] == f"products{only if alone else ''}"


FLAT_FIELD = "jwst_nircam_flat_0001.fits"


def later(k, days=55, flat=FLAT_FIELD, **changes):
    """A frame of a reference star of another epoch, with another wavefront."""
    frame = reference(k, drift=3e-9, date=Time("2022-10-03T06:00") + days * u.day, **changes)
    header = fits.Header({**frame.header, "R_FLAT": f"crds://{flat}"})
    return replace(frame, header=header, name=f"{frame.target} {k}, day {days}")


@cache
def taught():
    """The pattern of two epochs of a reference star, and the target's fit with it."""
    first = science()[0]
    rolls = [replace(first, header=fits.Header({**first.header, "R_FLAT": FLAT_FIELD}))]
    rolls.append(science()[1])
    frames = (later(0), later(1), later(2, 300), later(3, flat="other.fits"))
    maps = []

    def opd_at(date):
        maps.append(date.isot[:10])
        return OPD

    few = replace(SETTINGS, max_iterations=4)
    choice = choose_pattern(rolls, frames, model(), OPD, settings=few, opd_at=opd_at, library=False)
    assert maps == ["2022-11-27", "2023-07-30"]
    return choice


def test_a_pattern_is_learned_from_stars_of_any_epoch_with_the_same_flat_field():
    choice = taught()
    assert choice.origin == "references"
    assert [len(fit.frames) for fit in choice.references] == [2, 1]
    ((star, reason),) = choice.failed
    assert star == "HD 2"
    assert "flat field other.fits (R_FLAT), the target with jwst_nircam_flat_0001" in reason
    names = ["HD 2 0, day 55", "HD 2 1, day 55", "HD 2 2, day 300"]
    assert choice.pattern.provenance["frames"] == names
    # It is the flat field of the pixels: after a few steps, three frames show more than half of it.
    true = FLAT * np.random.default_rng(5).normal(size=(SIZE, SIZE))
    assert np.corrcoef(choice.pattern.value.flat, true.flat)[0, 1] > 0.6
    # A library's pattern is averaged with it if it is an error of the same flat field.
    first, measured = choice.science[0], measure_patterns(choice.references)
    for flat, stars in ((FLAT_FIELD, ["HD 2", "HD 9"]), ("other.fits", ["HD 2"])):
        others = [replace(p, star="HD 9", catalogue=CatalogueStar(), flat=flat) for p in measured]
        library = PatternLibrary(tuple(others))
        both = known_pattern(first, choice.references, library=library)
        assert both.provenance["stars"] == stars
    # That of frames in the likelihood is not counted twice; that of other epochs is known beside.
    near, fitted = [reference(0)], [f.observation for fit in choice.references for f in fit.frames]
    assert is_known_beside(choice, near)
    assert not is_known_beside(choice, fitted)
    frames = pattern_for_visit(choice, science(), near).provenance["frames"]
    assert frames == names
    assert "frames" not in pattern_for_visit(choice, science(), fitted).provenance


def reduced(frames, **options):
    """The run of a reduction beside frames of reference stars, and its result."""
    options = ReduceOptions(settings=SETTINGS, size=SIZE, **options)
    sequence = dr.ExposureSequence("HD 1", science(), tuple(frames))
    run = pipeline.prepare(sequence, OPD, options, model=model())
    return run, run.run()


@pytest.mark.slow
def test_references_of_other_epochs_teach_the_pattern_and_not_the_wavefront():
    far = [later(k, flat=FLAT_FIELD) for k in range(3)]
    near = reference(4)
    run, result = reduced([near, *far])
    assert [each.name for each in run._joining] == [near.name]
    assert [each.use for each in result.visit.contributions] == ["wavefront", *["pattern"] * 3]
    assert "of another epoch" in result.visit.contributions[1].reason
    fitted = [each.observation.name for each in result.fit.frames]
    assert fitted == [each.name for each in (*science(), near)]
    assert result.reference_frames == 4
    assert [len(each.frames) for each in result.references] == [3]
    assert result.pattern.provenance["stars"] == ["HD 2"]
    assert "of 4 reference frames 1 in the likelihood, limits " in str(result)
    assert "3 for the detector pattern" in str(result)
    candidate_of(result.detection)
    # With a pattern of which only the size is known it is 1.4, although that is fitted.
    assert result.fit.chi2_per_pixel < 1.2 < alone()[1].chi2_per_pixel
    assert result.fit.status is dr.Status.CONVERGED
    # KLIP has all of them.
    assert (
        "4 reference frames"
        in klip_curve(result.detection, result.sequence.references).meta["label"]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "count", "reason"),
    [
        ({"references": "off"}, 2, "the option references is 'off'"),
        ({"pattern": "off"}, 2, "another one, and pattern is 'off'"),
        ({}, 1, "another one, and there are too few frames for a pattern, two at least"),
    ],
)
def test_what_is_not_used_is_said_with_the_reason(options, count, reason, caplog):
    _, result = reduced([later(k) for k in range(count)], **options)
    assert {each.use for each in result.visit.contributions} == {"not used"}
    for text in (result.visit.in_words(), repr(result.visit), str(result), caplog.text):
        assert f"of {count} reference frame" in text
        assert reason in text
    assert result.reference_frames == 0
    for klip, use in ((None, "not used"), (result.detection.contrast_curve, "KLIP only")):
        summary = summarise(result, klip)
        assert [each["use"] for each in summary["frames"]] == ["target"] * 2 + [use] * count
        (page,) = {each["use"] for each in summary["visit"]["contributions"]}
        assert page == use


def test_frames_of_several_flat_fields_do_not_share_a_pattern():
    """The pattern is the error of one flat field."""

    def calibrated(frames, *flats):
        return [
            replace(each, header=fits.Header({**each.header, "R_FLAT": f"crds://{flat}.fits"}))
            for each, flat in zip(frames, flats, strict=True)
        ]

    same, other = (calibrated(science(), "a", flat) for flat in "ab")
    chosen, without = (
        choose_pattern(each, (), model(), OPD, settings=SETTINGS) for each in (same, other)
    )
    assert (chosen.origin, without.origin) == ("rolls", "none")
    aligned = replace(SETTINGS, wavefront=False, free=("flux", "background"))
    for frames, shared in ((same, True), (other, False)):
        fit = refine(model(), frames, OPD, pattern=chosen.pattern, settings=aligned)
        shares = [bool((part.common != 0).any()) for part in fit.linear.frames]
        assert shares == [shared, shared]
    # Frames of a reference star with the same pixels, but another flat field, do not take part.
    (star,) = calibrated([reference(0)], "b")
    assert pattern_for_visit(without, same[:1], [star]) is None
    assert pattern_for_visit(without, same[:1], calibrated([star], "a")) is not None


def test_exposure_sequences():
    frames = [*science(), *(reference(k) for k in range(3))]
    assert exposure_sequences(frames) == [0, 1, 2, 2, 2]
    late = reference(3, date=Time("2022-10-03T12:00"))
    assert exposure_sequences([*frames, late]) == [0, 1, 2, 2, 2, 3]
    rolled = reference(2, angle=60.0)
    assert exposure_sequences([reference(0), rolled]) == [0, 1]


def test_the_size_of_the_drift_is_that_of_the_frames(monkeypatch):
    steps, measure = [], Annealing._measure_priors

    def recorded(self, course, may_widen):
        steps.append(len(self.history))
        measure(self, course, may_widen)

    monkeypatch.setattr(Annealing, "_measure_priors", recorded)
    stated = WavefrontPrior({"segment": 0.6, "texture": 0.3}, knee=1.0)
    settings = replace(SETTINGS, drift=stated, dither_drift=stated, drift_cycles=6.0)
    joint = together(alone()[1], [reference(k, drift=5e-9) for k in range(3)], settings)
    assert 1.5 < joint.scales["texture dither"] / 0.3 <= 4.0001
    # It is measured after the first step, and once more before the last ones.
    assert steps[0] == 1 < steps[-1] < len(joint.history)
    for scaled, most in ((True, 8.0), (False, 2.4)):
        slews = replace(stated, scales={"segment": 2.0, "texture": 1.0}, fit_scales=scaled)
        wide = replace(settings, drift=slews)
        largest = wide.with_drift_scales({"segment dither": 99.0}, wide).dither_drift.scales
        assert largest == pytest.approx({"segment": most, "texture": 0.3})


@pytest.mark.slow
def test_frames_that_never_agree_are_left_out(monkeypatch):
    monkeypatch.setattr(visits, "_MOST_JOINT_FITS", 2)

    def contradicting(joint, count):
        return {joint.frames[count].observation.name: "it contradicts the others"}

    monkeypatch.setattr(visits, "_contradicting", contradicting)
    fit, visit, _ = joined(*(reference(k) for k in range(3)))
    assert fit is alone()[1]
    first, second, third = (each.reason for each in visit.contributions)
    assert first == second == "it contradicts the others"
    assert third.endswith("has no end")


def test_a_single_roll_may_show_a_structure_of_the_detector():
    # Nothing is stated of fits that do not explain their frames, as here those without a drift.
    both, single = (
        dr.detect(replace(fit, status=dr.Status.CONVERGED), threshold=4.0)
        for fit in (alone()[1], refine(model(), science()[:1], OPD, settings=SETTINGS))
    )
    assert (both.rolls, single.rolls) == (2, 1)
    (row,) = single.candidates
    structures = float(structures_in_single_roll(row["snr"]))
    assert structures <= row["false_alarm_probability"] < 2 * structures
    (row,) = both.candidates
    assert row["false_alarm_probability"] < 0.1 * structures
    assert "2 candidates in 12 real rolls" in single.remark
    assert both.remark == ""
