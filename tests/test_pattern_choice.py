"""Which flat-field pattern a target is fitted with: of the library, of other stars, or none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits

import pyklip_diffrender as dr
from pyklip_diffrender.errors import DiffrenderWarning
from pyklip_diffrender.pattern import choose_systematics, fit_with_pattern, known_systematics
from pyklip_diffrender.pyklip_backend import DiffrenderSettings, subtract_by_refinement
from pyklip_diffrender.refinement import GaussNewton
from pyklip_diffrender.scene import Observation, Systematics

SIZE, NPIX = 32, 64
ALIGNED = GaussNewton(free=("flux", "background"), wavefront=False, companions_if_stalled=False)
OPD = dr.random_opd(1, npix=NPIX)
LIBRARY = {"INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "CORONMSK": "MASKA335R"}
SAME_FLAT = {**LIBRARY, "R_FLAT": "crds://jwst_nircam_flat_0465.fits"}
OTHER_FLAT = {**LIBRARY, "R_FLAT": "crds://jwst_nircam_flat_0999.fits"}
ELSEWHERE = {**LIBRARY, "DETECTOR": "NRCA2"}
PLACE = (625, 1659)
"""Pixels in the middle of those that the library has."""
STARS = "HIP17695, G-7-34"


@cache
def model():
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=SIZE)


def frame(target, cards, *, shown=1.0, seed=1, flux=3e6):
    """A bright star, with a part of the library's pattern, on known pixels."""
    light = flux * model()(OPD.data).numpy()
    header = fits.Header({"TARGPROP": target, **LIBRARY})
    blank = Observation.from_arrays(
        light, np.ones_like(light), pixelscale=model().detector.pixelscale, filter="F444W",
        unit=u.MJy / u.sr, name=f"{target} {seed}", header=header, first_pixel=PLACE,
        position_angles=np.array([5.0 * seed]),
    )  # fmt: skip
    known = known_systematics(blank)
    multiplied = shown * known.at(blank)[0] * (light + known.pedestal)
    noise = 0.01 * np.sqrt(light + 1.0)
    data = light + multiplied + noise * np.random.default_rng(seed).standard_normal(light.shape)
    header = fits.Header({"TARGPROP": target, **cards})
    return replace(blank, data=data[None], error=noise[None], header=header)


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
    mine = Systematics(zeros, zeros, (15.5, 15.5), 0.1, name="mine")
    read = []

    def references():
        read.append("references")
        return [frame("REF", cards, seed=k) for k in (3, 4)]

    chosen = choose_systematics(
        # Two rolls, which would share a pattern of their own if nothing else were known.
        [frame("TARGET", cards, seed=k) for k in (1, 2)],
        references,
        model(),
        OPD,
        systematics=mine if request_ == "mine" else request_,
        settings=ALIGNED,
    )
    assert bool(read) == bool(chosen.references) == fitted
    assert (chosen.label, chosen.reference_frames) == (label, used)
    assert (chosen.systematics is None) == (label == "none")
    assert chosen.settings is ALIGNED


def test_a_known_pattern_takes_the_place_of_most_of_the_models_error():
    (roll,) = (frame("TARGET", LIBRARY),)
    preset = GaussNewton.nircam("F444W", min_model_error=0.002)
    assert choose_systematics([roll], (), model(), OPD).settings == preset
    limited = choose_systematics([roll], (), model(), OPD, memory=2e9).settings
    assert limited == replace(preset, memory=2e9)
    assert choose_systematics([roll], (), model(), OPD, systematics="off").settings is None


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
    fitted = []

    def fit(choice, again):
        assert again == bool(fitted)
        fitted.append(choice.label)
        return dr.refine(
            model(), choice.science, OPD, settings=ALIGNED, systematics=choice.systematics
        )

    choice, last = fit_with_pattern(
        [frame("TARGET", cards, shown=shown, seed=k) for k in (1, 2)],
        [frame("REF", cards, shown=shown, seed=3 + k) for k in range(references)],
        model(),
        OPD,
        fit,
        settings=ALIGNED,
    )
    assert fitted == labels
    assert last.systematics is choice.systematics


def test_rolls_share_an_unknown_pattern_where_nothing_is_known():
    def chosen(*rolls, systematics="auto"):
        choice = choose_systematics(rolls, [], model(), OPD, systematics=systematics)
        return choice.systematics

    roll, turned = (frame("TARGET", ELSEWHERE, seed=k) for k in (1, 2))
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
    for rolls in ([roll], [roll, roll], [roll, elsewhere], lost, simulated):
        assert chosen(*rolls) is None
    assert chosen(roll, turned, systematics="off") is None


@pytest.mark.parametrize("shown", [1.0, 0.0])
def test_a_rough_fit_tells_which_pixels_a_frame_shows(shown, caplog):
    """Where it shows the pattern; otherwise the pattern is not used."""
    lost = replace(frame("TARGET", LIBRARY, shown=shown), first_pixel=None)
    choice = choose_systematics([lost], [], model(), OPD, settings=ALIGNED)
    assert (choice.label == f"library ({STARS})") == (shown > 0)
    assert choice.science[0].first_pixel == (PLACE if shown else None)
    assert ("is not seen in them; it is not used" in caplog.text) == (shown == 0)
    assert choice.settings is ALIGNED


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
    settings = DiffrenderSettings(model=model(), fit=ALIGNED, max_chi2=np.inf, keep_detected=False)
    told = []
    star = frame("TARGET", cards, shown=shown)
    if not cards:  # The pattern then is an error of the model.
        with pytest.warns(DiffrenderWarning):
            result = subtract_by_refinement(star, OPD, settings, tell=told.append)
    else:
        result = subtract_by_refinement(star, OPD, settings, tell=told.append)
    assert result.systematics == label
    refuted = any("without the library's flat-field pattern" in each for each in told)
    assert refuted == (bool(cards) and shown == 0)


@pytest.mark.slow
def test_a_reduction_keeps_the_references_that_it_fitted():
    rolls = tuple(frame("TARGET", LIBRARY, seed=k) for k in (1, 2))
    references = tuple(frame("REF", LIBRARY, seed=k) for k in (3, 4))
    sequence = dr.Sequence("TARGET", rolls, references)
    result = dr.reduce(sequence, OPD, size=24, settings=ALIGNED, systematics="references")
    assert [len(each.frames) for each in result.references] == [2]
    assert result.systematics is result.fit.systematics
    assert "REF" in result.systematics.provenance["stars"]
