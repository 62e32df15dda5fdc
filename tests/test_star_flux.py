"""The flux of the star, to which contrasts refer: from diffracted light, or from a catalogue."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from astropy import units as u
from astropy.io import fits

import pyklip_diffrender as dr
from pyklip_diffrender.detection import measured_planet
from pyklip_diffrender.errors import IncompatibleSetupError, UnitError
from pyklip_diffrender.reduction import ReduceOptions, prepare
from pyklip_diffrender.refinement import jansky_per_unit, star_flux_error, with_star_flux
from pyklip_diffrender.wavefront import as_opd_map

TRUTH = 3e-5
PLANET = dr.Planet(TRUTH, 0.6, 120.0)
SETTINGS = dr.GaussNewton(cycles=6)


@pytest.fixture(scope="module")
def fit():
    """A simulated star and planet, with the header of a calibrated frame."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    opd = dr.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(planets=(PLANET,)), opd, seed=3)
    header = fits.Header({"INSTRUME": "NIRCAM", "PIXAR_SR": 9.2e-14})
    frame = replace(frame, unit=u.MJy / u.sr, header=header)
    return dr.refine(model, frame, opd, settings=SETTINGS)


def test_contrasts_of_real_frames_have_the_error_of_the_stars_flux(fit):
    detection = dr.detect(fit)
    (planet,) = detection.candidates
    assert star_flux_error(fit) == 0.1
    # The noise is 1/469 of the planet.
    assert planet["contrast_error"] / planet["contrast"] == pytest.approx(0.1, rel=0.01)
    assert planet["flux_density_error"] / planet["flux_density"] < 0.02
    assert planet["delta_mag_error"].value == pytest.approx(0.1086, rel=0.01)
    measured = detection.measure([PLANET.offset])[0]
    assert measured["contrast_error"] / measured["contrast"] == pytest.approx(0.1, rel=0.01)
    # An injected planet is as bright as it is in units of the same star.
    injected = measured_planet(detection, PLANET.offset, fit.frames[0].flux)
    assert injected.detected
    assert 1 < injected.contrast_error * injected.snr / injected.contrast < 1.5
    brighter = measured_planet(detection, PLANET.offset, 2 * fit.frames[0].flux)
    assert brighter.contrast == pytest.approx(injected.contrast / 2)
    assert brighter.contrast_error == pytest.approx(injected.contrast_error / 2)
    assert brighter.snr == injected.snr


def with_header(fit, header):
    """The fit with another header of its frame, and that frame's observation."""
    observation = replace(fit.frames[0].observation, header=header)
    frames = (replace(fit.frames[0], observation=observation),)
    return replace(fit, frames=frames), observation


def test_simulated_frames_have_no_such_error(fit):
    assert star_flux_error(with_header(fit, fits.Header())[0]) == 0.0


def test_without_a_map_the_star_is_less_certain(fit, caplog):
    flat = as_opd_map("flat")
    assert star_flux_error(replace(fit, initial=flat)) == 0.4
    assert star_flux_error(replace(fit, initial=flat, catalogue_error=0.05)) == 0.05
    # A reduction says so, unless the flux is given.
    header = fit.frames[0].observation.header.copy()
    header["CORONMSK"] = "MASKA335R"
    sequence = dr.Sequence("A STAR", (with_header(fit, header)[1],))
    for opd, flux, warned in (
        ("flat", None, True),
        ("flat", 0.4, False),
        (fit.initial, None, False),
    ):
        caplog.clear()
        prepare(sequence, opd, ReduceOptions(size=8, star_flux=flux))
        assert ("may be wrong by 40 %; give the flux" in caplog.text) is warned


@pytest.mark.slow
def test_contrasts_refer_to_the_catalogues_star(fit, tmp_path):
    """Held more tightly than these frames, which determine it to 1e-4: the star obeys."""
    share = 0.98
    before = dr.detect(fit)
    tied = with_star_flux(fit, share * before.sky.star[0], 0.05, held=1e-6)
    after = dr.detect(tied)
    assert star_flux_error(tied) == 0.05
    assert after.sky.star[0] / before.sky.star[0] == pytest.approx(share, rel=3e-4)
    (then,), (now,) = before.candidates, after.candidates
    assert now["contrast"] / then["contrast"] == pytest.approx(1 / share, rel=6e-3)
    assert (now["flux_density"] / then["flux_density"]).value == pytest.approx(1.0, abs=6e-3)
    # That of the star, and of what a star held at a wrong flux leaves.
    assert 0.05 < now["contrast_error"] / now["contrast"] < 0.1
    # The stated flux wherever it is shown, of frames that pull at the star, because they determine
    # its flux better than it is held.
    stated = 1.04 * before.sky.star[0]
    tied = with_star_flux(fit, stated, 0.05)
    assert jansky_per_unit(tied.frames[0]) * tied.frames[0].flux == pytest.approx(stated, rel=0.005)
    detection = dr.detect(tied)
    assert detection.sky.star[0] == stated
    detection.write(tmp_path)
    assert fits.getheader(tmp_path / "detection.fits")["DRSTARJY"] == stated
    again = dr.Refinement.read(tied.write(tmp_path / "fit.fits"))
    assert (again.catalogue_flux, again.catalogue_error) == (stated, 0.05)


def test_frames_without_calibration_are_refused_before_the_fit(fit):
    bare, observation = with_header(fit, fits.Header({"INSTRUME": "NIRCAM"}))
    with pytest.raises(IncompatibleSetupError, match="is not calibrated: expected"):
        with_star_flux(bare, 0.4, 0.03)
    sequence = dr.Sequence("a star", (observation,))
    with pytest.raises(IncompatibleSetupError, match="is not calibrated: expected"):
        dr.reduce(sequence, fit.initial, size=16, star_flux="0.4 Jy")


@pytest.mark.parametrize("error", [0.0, math.nan])
def test_errors_that_are_not_positive_are_refused(fit, error):
    sequence = dr.Sequence("a star", (fit.frames[0].observation,))
    with pytest.raises((IncompatibleSetupError, UnitError, ValueError), match="star_flux_error"):
        dr.reduce(sequence, fit.initial, star_flux=0.4, star_flux_error=error)
