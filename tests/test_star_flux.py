"""The flux of the star, to which contrasts refer: of a fit, of a catalogue, of its spectrum."""

import math
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time

import pyklip_diffrender as dr
from pyklip_diffrender.detection import measured_planet
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.instrument.spectrum import filter_throughput
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.reduction.pipeline import prepare
from pyklip_diffrender.refinement import jansky_per_unit, star_flux_error, with_star_flux
from pyklip_diffrender.wavefront.opd import as_opd_map

PLANET = dr.Planet(3e-5, 0.6, 120.0)


@pytest.fixture(scope="module")
def fit():
    """A simulated star and planet, with the header of a calibrated frame."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    opd = dr.wavefront.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(planets=(PLANET,)), opd, seed=3)
    header = fits.Header({"INSTRUME": "NIRCAM", "PIXAR_SR": 9.2e-14})
    frame = replace(frame, unit=u.MJy / u.sr, header=header)
    return dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=6))


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
    injected = measured_planet(detection, PLANET.offset, fit.frames[0].star_light)
    assert injected.detected
    assert 1 < injected.contrast_error * injected.snr / injected.contrast < 1.5
    brighter = measured_planet(detection, PLANET.offset, 2 * fit.frames[0].star_light)
    assert brighter.contrast == pytest.approx(injected.contrast / 2)
    assert brighter.contrast_error == pytest.approx(injected.contrast_error / 2)
    assert brighter.snr == injected.snr


def with_header(fit, header):
    """The fit with another header of its frame, and that frame's observation."""
    observation = replace(fit.frames[0].observation, header=header)
    frames = (replace(fit.frames[0], observation=observation),)
    return replace(fit, frames=frames), observation


def test_without_a_current_map_the_star_is_less_certain(fit, caplog):
    assert star_flux_error(with_header(fit, fits.Header())[0]) == 0.0  # Of a simulated frame.
    flat = as_opd_map("flat")
    assert star_flux_error(replace(fit, initial=flat)) == 0.4
    assert star_flux_error(replace(fit, initial=flat, catalogue_error=0.05)) == 0.05
    observation = replace(fit.frames[0].observation, date=Time("2023-01-01"))
    dated = replace(fit, frames=(replace(fit.frames[0], observation=observation),))
    for days, error in ((0, 0.1), (30, 0.2), (60, 0.3), (104, 0.3), (-30, 0.2)):
        sensed = replace(fit.initial, date=observation.date - days * u.day)
        assert star_flux_error(replace(dated, initial=sensed)) == pytest.approx(error)
    # A reduction says so, unless the flux is given.
    header = fit.frames[0].observation.header.copy()
    header["CORONMSK"] = "MASKA335R"
    sequence = dr.ExposureSequence("A STAR", (with_header(fit, header)[1],))
    cases = (("flat", None, True), ("flat", 0.4, False), (fit.initial, None, False))
    for opd, flux, warned in cases:
        caplog.clear()
        prepare(sequence, opd, ReduceOptions(size=8, star_flux=flux))
        assert ("may be wrong by 40 %; give the flux" in caplog.text) is warned


@pytest.mark.slow
def test_contrasts_refer_to_the_catalogues_star(fit, tmp_path):
    """Held more tightly than these frames, which determine it to 1e-4: the star obeys."""
    before, share = dr.detect(fit), 0.98
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


def test_a_flux_that_cannot_be_the_stars_is_refused(fit):
    """A number in another unit, or of another star; before the fit with that flux."""
    fit, _ = with_header(fit, fits.Header({"INSTRUME": "NIRCAM", "PIXAR_SR": 9.2e-19}))
    seen = jansky_per_unit(fit.frames[0]) * fit.frames[0].flux
    # F_nu = F_lambda lambda^2 / c, in W / m2 / Hz and W / m2 / m.
    flam = seen * 1e-26 * 2.99792458e8 / 4.5e-6**2 * 1e-6
    magnitude = -2.5 * math.log10(seen / 3631)
    cases = ((1000 * seen, "mJy"), (1e6 * seen, "uJy"), (flam, "W / (um m2)"), (magnitude, "mag"))
    for stated, unit in cases:
        with pytest.raises(IncompatibleSetupError) as raised:
            with_star_flux(fit, stated, 0.05)
        message = str(raised.value)
        assert f"got {stated:.3g} Jy, expected about {seen:.3g} Jy (to 10 %)" in message
        assert f"{stated:.3g} {unit}" in message
        assert f"would be {seen:.3g} Jy" in message
    flat = replace(fit, initial=as_opd_map("flat"))
    for factor in (3.4, 1 / 3.4, 12.0):
        with pytest.raises(IncompatibleSetupError) as raised:
            with_star_flux(fit, factor * seen, 0.05)
        assert "would be" not in str(raised.value)
    # From a flat wavefront the star's flux is uncertain by 40 %.
    with pytest.raises(IncompatibleSetupError, match=r"\(to 40 %\)"):
        with_star_flux(flat, 4.3 * seen, 0.05)
    # One that the fit did not correct says even less.
    lost = replace(flat, status=dr.Status.MODEL_MISMATCH)
    with pytest.raises(IncompatibleSetupError, match=r"\(to 40 %\)"):
        with_star_flux(lost, 13.0 * seen, 0.05)


@pytest.mark.parametrize(
    ("factor", "map_", "status"),
    [(3.2, True, "CONVERGED"), (1 / 4.1, False, "CONVERGED"), (1 / 12, False, "MODEL_MISMATCH")],
)
def test_a_flux_within_a_factor_of_three_is_taken(fit, factor, map_, status):
    """With the error of the fitted one: 10 % with a map, and 40 % without one."""
    start = replace(fit, status=dr.Status[status])
    start = start if map_ else replace(start, initial=as_opd_map("flat"))
    short = replace(start, settings=replace(start.settings, max_iterations=1, wavefront=False))
    seen = jansky_per_unit(fit.frames[0]) * fit.frames[0].flux
    assert with_star_flux(short, factor * seen, 0.05, held=1e-9).catalogue_flux == factor * seen


def test_a_reduction_finds_a_mistaken_unit_before_the_wavefront_is_fitted(fit, caplog):
    cards = {"INSTRUME": "NIRCAM", "PIXAR_SR": 9.2e-19, "CORONMSK": "MASKA335R"}
    fit, frame = with_header(fit, fits.Header(cards))
    sequence = dr.ExposureSequence("A STAR", (frame,))
    seen = jansky_per_unit(fit.frames[0]) * fit.frames[0].flux
    caplog.set_level("INFO")
    for factor, stages in ((1000, []), (5, ["1. wavefront"])):
        options = ReduceOptions(
            star_flux=factor * seen, pattern="off", settings=dr.FitSettings(cycles=6)
        )
        with pytest.raises(IncompatibleSetupError, match=r"star_flux: got"):
            prepare(sequence, fit.initial, options, model=fit.model).run()
        begun = [each.getMessage() for each in caplog.records if each.name.endswith("progress")]
        assert [text for text in begun if "wavefront" in text or "search" in text] == stages
        caplog.clear()


def test_frames_without_calibration_are_refused_before_the_fit(fit):
    bare, observation = with_header(fit, fits.Header({"INSTRUME": "NIRCAM"}))
    sequence = dr.ExposureSequence("a star", (observation,))
    for call in (
        lambda: with_star_flux(bare, 0.4, 0.03),
        lambda: dr.reduce(sequence, fit.initial, size=16, star_flux="0.4 Jy"),
    ):
        with pytest.raises(IncompatibleSetupError, match="is not calibrated: expected"):
            call()


GRID = np.geomspace(1.0, 6.0, 400) * u.micron


def rayleigh_jeans(wavelength):
    return 2.0 * (wavelength / u.micron) ** -2 * u.Jy


def expected(filter):
    """The mean over photons, by a sum that shares no code with the package's."""
    wavelength, throughput = filter_throughput(filter)
    fine = np.linspace(wavelength[0], wavelength[-1], 20001)
    weight = np.interp(fine, wavelength, throughput)
    weight[weight < 0.01] = 0
    flux = 2.0 * (fine * 1e6) ** -2
    return float(np.trapezoid(flux * weight / fine, fine) / np.trapezoid(weight / fine, fine))


@pytest.mark.parametrize("filter", ["F200W", "F444W"])
def test_a_spectrum_and_photometry_of_a_power_law(tmp_path, filter):
    """The package interpolates power laws exactly; what remains are the two quadratures."""
    np.savetxt(tmp_path / "star.txt", np.c_[GRID.value, rayleigh_jeans(GRID).value], header="um Jy")
    bands = np.repeat([1.66, 2.16, 3.35, 4.60, 11.6], 3) * u.micron
    # Two catalogues agree, and the third is wrong: the median is that of the two.
    flux = rayleigh_jeans(bands).value * np.tile([1.0, 1.0, 3.0], 5)
    table = QTable({"sed_freq": bands.to(u.GHz, u.spectral()), "sed_flux": flux * u.Jy})
    table.write(tmp_path / "star.vot", format="votable")
    for path in tmp_path.iterdir():
        found = dr.instrument.star_flux_density(path, filter)
        assert found.to_value(u.Jy) == pytest.approx(expected(filter), rel=1e-4)


@pytest.mark.parametrize(
    ("text", "expected", "complaint"),
    [
        ("3.0 -1\n4.0 nan\n5.0 0.5\n", CorruptFileError, "1 of 3 samples"),
        ("0.5 1.0\n1.5 0.5\n2.2 0.3\n", IncompatibleSetupError, r"covers 0\.500 to 2\.200 micron"),
        (
            "1.0 1.0\n2.0 0.5\n8.0 0.3\n",
            IncompatibleSetupError,
            r"no sample between 2\.00 and 8\.00 micron",
        ),
    ],
)
def test_files_that_do_not_say_the_flux(tmp_path, text, expected, complaint):
    path = tmp_path / "star.txt"
    path.write_text(text)
    with pytest.raises(expected, match=complaint):
        dr.instrument.star_flux_density(path, "F444W")


def test_spectral_type():
    # Type A0V is nearly a black body of 9600 K, and magnitude 0 in Ks is 666.8 Jy at 2.159 micron.
    wavelength = np.array([2.159, 2.09, 3.56, 4.42])
    flux = wavelength**-3 / np.expm1(14388 / (wavelength * 9600))
    for filter, ratio in zip(("F210M", "F356W", "F444W"), flux[1:] / flux[0], strict=True):
        expected = 666.8 * ratio
        assert dr.instrument.star_flux_density("A0V, K=0", filter).value == pytest.approx(
            expected, rel=0.02
        )
    # A magnitude is a factor of 2.512; other ways to write it mean the same.
    bright, faint = (
        dr.instrument.star_flux_density(f"M4, K={k}", "F356W").value for k in ("5", "6.0")
    )
    assert bright / faint == pytest.approx(10**0.4)
    assert dr.instrument.star_flux_density("M4V,K=5", "F356W").value == bright
    # Between K5 and M5 the table has no W1 - W2; it has to increase from one to the other.
    ratio = [
        dr.instrument.star_flux_density(star, "F460M")
        / dr.instrument.star_flux_density(star, "F356W")
        for star in ("K5V, K=5", "M0V, K=5", "M2.5V, K=5", "M5V, K=5")
    ]
    assert np.all(np.diff(ratio) > 0)


@pytest.mark.parametrize(
    ("star", "filter", "expected", "complaint"),
    [
        ("B2V, K=5", "F444W", IncompatibleSetupError, "got type B2, expected B5 to M9"),
        ("K0III, K=5", "F444W", FileNotFoundError, r'such as "A2V, K=6\.77"'),
        ("missing.txt", "F444W", FileNotFoundError, r"missing\.txt: no such file"),
        ("A0V, K=0", "F999W", IncompatibleSetupError, "F999W"),
    ],
)
def test_stars_that_are_not_known(star, filter, expected, complaint):
    with pytest.raises(expected, match=complaint):
        dr.instrument.star_flux_density(star, filter)
