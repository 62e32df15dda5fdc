"""What an astronomer reports: positions on the sky, fluxes, limits and epochs, and their errors."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import ascii, fits
from astropy.table import QTable
from astropy.time import Time
from astropy.wcs import WCS
from small_files import calints

import pyklip_diffrender as dr
from pyklip_diffrender.detection import Candidates
from pyklip_diffrender.detection.detection_file import write_astrometry
from pyklip_diffrender.detection.error_factor import ErrorFactor, contrast_table
from pyklip_diffrender.detection.field import Positions, Sky
from pyklip_diffrender.detection.measurement import candidate_table, measured_table
from pyklip_diffrender.detection.published_limits import published_limits
from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.instrument import detector_place
from pyklip_diffrender.instrument.masks import FILTERS
from pyklip_diffrender.instrument.spectrum import vega_flux_density
from pyklip_diffrender.refinement import jansky_per_unit, require_calibrated
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import world_coordinates

# Of jw01184005001_03106_00001_nrcalong_calints.fits. The linear part of its WCS is the pipeline's,
# made from the calibrated distortion; ROLL_REF and V3I_YANG are what this package reads.
REAL = {
    "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CUNIT1": "deg", "CUNIT2": "deg",
    "CRPIX1": 11.0, "CRPIX2": 8.0, "CRVAL1": 64.32809808222, "CRVAL2": 8.8205266314574,
    "CD1_1": 1.5631483447774e-06, "CD1_2": -1.7416402091741e-05,
    "CD2_1": -1.7160783488561e-05, "CD2_2": -1.5037827653561e-06,
    "ROLL_REF": 265.015559386916, "V3I_YANG": 0.05428612, "VPARITY": -1,
    "PIXAR_A2": 0.003918172030450555, "PIXAR_SR": 9.20944023299612e-14, "BUNIT": "MJy/sr",
    "EXPMID": 59855.61227794953, "DATE-BEG": "2022-10-03T14:26:41.218", "INSTRUME": "NIRCAM",
}  # fmt: skip
NORTH = REAL["ROLL_REF"] + REAL["V3I_YANG"]
COVARIANCE = np.array([[4.0, 1.5], [1.5, 1.0]]) * 1e-6
"""Of x and y, arcsec^2: tilted, so that a wrong turn shows."""

SKY = Sky(north=NORTH, mjd=59855.5, star=(0.4, 0.04))


def observation(folder, **changes):
    # Not the same value everywhere, which would be an integration without data.
    image = np.random.default_rng(3).normal(1.0, 0.01, (1, 16, 20))
    cards = {**REAL, **changes}
    path = calints(folder / "calints.fits", image, primary={"DATE-BEG": None}, **cards)
    return Observation.from_fits(path)


def candidates(offsets, contrasts):
    covariance = np.zeros((3, len(contrasts), 3, len(contrasts)))
    for k, contrast in enumerate(contrasts):
        covariance[0, k, 0, k] = (0.1 * contrast) ** 2
        covariance[1:, k, 1:, k] = COVARIANCE
    start = Candidates.at(offsets, contrasts)
    flat = torch.from_numpy(covariance.reshape(start.covariance.shape))
    return Candidates(start.offsets, start.contrasts, flat, 0.08 * start.contrasts)


def table(sky=SKY):
    known = candidates([[-0.3, 0.5], [0.2, -0.8]], [1e-4, 2e-4])
    calibration = np.array([[0.1, 0.1], [0.02, 0.02]])
    return candidate_table(known, ErrorFactor.constant(1.0), calibration, sky)


@pytest.mark.parametrize("pixels", [(-9, 13), (7, -12), (-20, -4)])
def test_the_sky_is_where_the_frames_own_wcs_has_it(tmp_path, pixels):
    """A flipped axis or a wrong sign is wrong by the whole offset; the scales agree to 0.2 %."""
    got = observation(tmp_path)
    mask = detector_place("MASK335R", "F444W")
    # As in `Templates.grid`: the detector's scales and shear about the star.
    x = pixels[0] * mask.siaf_pixelscale[0]
    y = pixels[1] * mask.siaf_pixelscale[1] + mask.siaf_shear * x
    place_on_sky = Positions(np.array([[x, y]]), COVARIANCE[None], got.position_angle)
    wcs = WCS(fits.Header({k: v for k, v in REAL.items() if k[:2] in ("CT", "CU", "CR", "CD")}))
    star, place = (wcs.pixel_to_world(*(got.center[0] + k)) for k in ((0, 0), pixels))
    east, north = star.spherical_offsets_to(place)
    distance = star.separation(place).arcsec
    expected = [east.arcsec, north.arcsec]
    np.testing.assert_allclose(place_on_sky.on_sky[0], expected, rtol=0, atol=4e-3 * distance)
    assert place_on_sky.separation[0] == pytest.approx(distance, rel=3e-3)
    grid = np.stack(np.meshgrid(np.arange(3) * mask.siaf_pixelscale[0], np.arange(3.0)), -1)
    grid[..., 1] *= mask.siaf_pixelscale[1]
    grid[..., 1] += mask.siaf_shear * grid[..., 0]
    ours = WCS(world_coordinates(grid, got)).pixel_to_world(*pixels)
    assert ours.separation(place).arcsec < 4e-3 * distance
    away = star.position_angle(place).deg - place_on_sky.position_angle[0]
    assert (away + 180) % 360 - 180 == pytest.approx(0, abs=0.2)


def test_without_a_roll_angle_nothing_is_said_about_the_sky(tmp_path):
    assert observation(tmp_path, ROLL_REF=None).position_angles is None
    blind = table(Sky(mjd=59855.5))
    assert not {"delta_ra", "delta_dec", "radec_corr"} & set(blind.colnames)
    assert "not known" in blind["position_angle"].info.description
    np.testing.assert_array_equal(blind["position_angle"], blind["frame_angle"])


def test_the_table_has_the_whole_covariance_of_each_candidate(rng):
    """Against draws of contrast, x and y, whose offsets are turned as complex numbers.

    North + i east is y - i x times exp(i north).
    """
    truth = np.array([[1e-10, 4e-9, -3e-9], [4e-9, 4e-6, 1.5e-6], [-3e-9, 1.5e-6, 1e-6]])
    start = Candidates.at([[0.2, -0.8]], [2e-4])
    known = Candidates(start.offsets, start.contrasts, torch.tensor(truth), 0.08 * start.contrasts)
    factor, calibration = ErrorFactor.constant(1.5), np.array([[0.1], [0.02]])
    drawn = rng.multivariate_normal([2e-4, 0.2, -0.8], 1.5**2 * truth, size=40_000)
    contrast = drawn[:, 0] + 0.1 * 2e-4 * rng.normal(size=40_000)
    sky = (drawn[:, 2] - 1j * drawn[:, 1]) * np.exp(1j * np.deg2rad(NORTH))
    (row,) = candidate_table(known, factor, calibration, SKY)
    (blind,) = candidate_table(known, factor, calibration, Sky())
    polar = np.abs(sky), np.rad2deg(np.angle(sky)) % 360
    values = {"delta_ra": sky.imag, "delta_dec": sky.real, "contrast": contrast,
              **dict(zip(("separation", "position_angle"), polar, strict=True))}  # fmt: skip
    for name, seen in values.items():
        error = u.Quantity(row[f"{name}_error"]).value
        assert u.Quantity(row[name]).value == pytest.approx(seen.mean(), abs=0.02 * error), name
        assert error == pytest.approx(seen.std(), rel=0.02), name
    for table_, name, pair in (
        (row, "contrast_ra_corr", (contrast, sky.imag)),
        (row, "contrast_dec_corr", (contrast, sky.real)),
        (row, "radec_corr", (sky.imag, sky.real)),
        (row, "seppa_corr", polar),
        (blind, "contrast_x_corr", (contrast, drawn[:, 1])),
        (blind, "contrast_y_corr", (contrast, drawn[:, 2])),
        (blind, "xy_corr", (drawn[:, 1], drawn[:, 2])),
    ):
        # Of 40,000 draws, a correlation is known to 0.005.
        assert table_[name] == pytest.approx(np.corrcoef(*pair)[0, 1], abs=0.02), name
        assert abs(table_[name]) > 0.1, name


def test_the_flux_of_a_planet_does_not_have_the_error_of_the_stars_flux():
    row = table()[0]
    # 10 % of noise; 10 % of the star's flux and its image, of which 2 % of the image alone.
    assert row["contrast_error"] / row["contrast"] == pytest.approx(np.hypot(0.1, 0.1))
    share = (row["flux_density_error"] / row["flux_density"]).value
    assert share == pytest.approx(np.hypot(0.1, 0.02))
    assert row["flux_density"].to_value("Jy") == pytest.approx(0.4 * row["contrast"])
    assert row["ab_mag"].value == pytest.approx(row["flux_density"].to_value(u.ABmag))
    assert row["ab_mag_error"].value == pytest.approx(2.5 / np.log(10) * share)


def test_vega_is_as_bright_as_in_filters_of_spitzer():
    """IRAC's zero points, 280.9 and 179.7 Jy at 3.550 and 4.493 micron (Reach et al. 2005).

    With a power law through the two. Calibrations of Vega differ by 2 to 3 %.
    """
    slope = np.log(280.9 / 179.7) / np.log(3.550 / 4.493)
    for name, pivot in (("F356W", 3.568), ("F444W", 4.404), ("F410M", 4.082)):
        expected = 179.7 * (pivot / 4.493) ** slope
        assert vega_flux_density(name) == pytest.approx(expected, rel=0.04)
    assert None not in {vega_flux_density(each) for each in FILTERS}
    assert vega_flux_density("F1140C") is vega_flux_density(None) is None


def test_magnitudes_of_vega_are_those_of_its_flux_density():
    sky = Sky(star=(18.4115, 0.1), vega=vega_flux_density("F444W"))
    row = table(sky)[1]
    # A star of a tenth of Vega's flux density has magnitude 2.5.
    assert row["vega_mag"].value == pytest.approx(2.5 + row["delta_mag"].value, abs=1e-4)
    assert row["vega_mag_error"].value == pytest.approx(row["ab_mag_error"].value)
    assert "vega_mag" not in table(SKY).colnames


CURVE = QTable({"separation": [0.3, 0.6, 1.2] * u.arcsec, "contrast": [1e-5, 1e-6, np.nan]})
CURVE.meta["sigmas"] = 5.0
MASSES = np.geomspace(0.5, 50, 9)
MODEL = QTable({"mass": MASSES, "F444W": MASSES})


def seen(sky, filter="F444W"):
    """What `published_limits` needs of a detection."""
    frame = SimpleNamespace(filter=filter)
    return SimpleNamespace(sky=sky, observation=frame, provenance={"target": "HD 1"})


BRIGHT = Sky(star=(0.4, 0.04), vega=184.0)


def test_limits_are_written_for_the_cds_and_for_latex(tmp_path):
    found = published_limits(CURVE, seen(BRIGHT), None, None)
    assert found.colnames == ["separation", "contrast", "dmag", "mag"]
    np.testing.assert_allclose(found["dmag"].value, [12.5, 15.0, np.nan])
    star = -2.5 * np.log10(0.4 / 184.0)
    np.testing.assert_allclose(found["mag"].value, np.array([12.5, 15.0, np.nan]) + star)
    assert (found.meta["target"], found.meta["sigmas"]) == ("HD 1", 5.0)
    for form in ("ascii.mrt", "ascii.aastex", "ascii.ecsv"):
        found.write(tmp_path / form, format=form)
    again = ascii.read(str(tmp_path / "ascii.mrt"), format="mrt")
    assert again["dmag"][1] == 15.0
    assert again["separation"].unit == "arcsec"
    text = (tmp_path / "ascii.aastex").read_text(encoding="utf-8")
    assert "0.60 & 1.00e-06 & 15.00 & 21.66" in text
    assert "_" not in text
    assert "mag" not in published_limits(CURVE, seen(Sky()), None, None).colnames


@pytest.mark.parametrize("parallax", [0.02, 20 * u.mas, "20 mas"])
def test_masses_are_those_of_a_power_law(tmp_path, parallax):
    """Planets of 1e-6 Jy (M / M_J)^2 at 10 pc, so that interpolation of logarithms is exact."""
    flux = 1e-6 * MASSES**2
    # At 50 pc, 25 times fainter.
    expected = np.sqrt(25 * 0.4 * np.array([1e-5, 1e-6, np.nan]) / 1e-6)
    vega = QTable({"mass": MASSES, "JWST/NIRCam.F444W": -2.5 * np.log10(flux / 184.0)})
    models = [
        vega,
        QTable({"Mass": MASSES[::-1] * u.jupiterMass, "F444W": (flux[::-1] * u.Jy).to(u.nJy)}),
        QTable({"mass": (MASSES * u.M_jup).to("solMass"), "f444w": (flux * u.Jy).to("mag(AB)")}),
        tmp_path / "model.ecsv",
    ]
    vega.write(models[-1])
    for model in models:
        found = published_limits(CURVE, seen(BRIGHT), model, parallax)
        np.testing.assert_allclose(found["mass"].to_value(u.jupiterMass), expected)


def test_masses_are_those_from_which_all_planets_are_seen():
    """Where deuterium burns, less massive planets are brighter."""
    model = QTable({"mass": [1.0, 10.0, 13.0, 20.0], "F444W": [1e-7, 1e-5, 1e-6, 1e-4] * u.Jy})
    curve = QTable({"separation": [1.0, 1.0, 1.0] * u.arcsec, "contrast": [3e-6, 1e-8, 1.0]})
    curve.meta["sigmas"] = 5.0
    found = published_limits(curve, seen(Sky(star=(1.0, 0.1))), model, 0.1)
    # 3e-6 Jy is below the planet of 10 masses, but only from 13 on all are brighter.
    assert 13 < found["mass"][0].value < 20
    assert np.isnan(found["mass"][1:].value).all()


@pytest.mark.parametrize(
    ("model", "parallax", "sky", "words"),
    [
        (MODEL, None, BRIGHT, "parallax: got None, expected"),
        (MODEL, 20.0, BRIGHT, "parallax: got 20 arcsec.*20 mas"),
        (MODEL, 0.02, Sky(), "no photometric calibration"),
        (QTable({"mass": MASSES, "F356W": MASSES}), 0.02, BRIGHT, "0 columns of F444W among mass"),
        (QTable({"M": MASSES, "F444W": MASSES}), 0.02, BRIGHT, "0 columns of mass among M, F444W"),
        (QTable({"mass": MASSES, "F444W": MASSES, "NIRCam.F444W": MASSES}), 0.02, BRIGHT,
         "2 columns of F444W"),
        (QTable({"mass": [1.0, 2.0, 1.0], "F444W": [3.0, 2.0, 1.0]}), 0.02, BRIGHT,
         "3 rows with 2 masses.*choose one"),
        (QTable({"mass": MASSES, "F444W": MASSES * u.m}), 0.02, BRIGHT, "got F444W in m, expected"),
        (MODEL, 0.02, Sky(star=(1.0, 0.1)), "Vega in F444W"),
        (__file__, 0.02, BRIGHT, "test_sky.py: not a table"),
    ],
)  # fmt: skip
def test_models_that_say_no_masses_are_refused(model, parallax, sky, words):
    with pytest.raises(DiffrenderError, match=words):
        published_limits(CURVE, seen(sky), model, parallax)


def test_what_is_not_detected_has_an_upper_limit():
    snr = np.array([-1.0, 2.0, 4.0, 9.0])
    raw = QTable({"x": [0.5] * 4 * u.arcsec, "y": [0.1] * 4 * u.arcsec, "contrast": 1e-6 * snr,
                  "contrast_error": np.full(4, 1e-6), "snr": snr})  # fmt: skip
    got = measured_table(raw, np.zeros((2, 4)), SKY, 5.0)
    expected = np.array([5.0, 7.0, 9.0, np.nan]) * 1e-6
    np.testing.assert_allclose(got["upper_limit"], expected)
    np.testing.assert_allclose(got["upper_limit_delta_mag"].value, -2.5 * np.log10(expected))
    np.testing.assert_allclose(got["upper_limit_flux_density"].to_value("Jy"), 0.4 * expected)
    # A negative flux has no magnitude.
    np.testing.assert_array_equal(np.isnan(got["delta_mag"].value), snr < 0)
    assert got.meta["sigmas"] == 5
    place = Positions(np.array([[0.5, 0.1]]), COVARIANCE[None], NORTH).on_sky[0]
    np.testing.assert_allclose([got["delta_ra"][0].value, got["delta_dec"][0].value], place)


def test_tables_show_their_contrasts_on_80_columns():
    raw = QTable({"x": [0.5] * u.arcsec, "y": [0.1] * u.arcsec, "contrast": [1.23e-6],
                  "contrast_error": [1e-6], "snr": [1.23]})  # fmt: skip
    measured, ring = (
        measured_table(raw, np.zeros((2, 1)), SKY, 5.0),
        [np.full(2, 1.23456789e-6)] * 2,
    )
    curve = contrast_table(np.array([0.5, 0.6]), ring, ring, 0.14, ErrorFactor.constant(1.5), 0.4)
    for shown in (table(), measured, curve):
        header, *lines = shown.pformat(max_width=80)
        assert max(map(len, (header, *lines))) <= 80
        assert "contrast" in header.split()
        assert all(shown[name].info.description for name in shown.colnames)


def fitted(observation):
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=16)
    return SimpleNamespace(
        observation=observation, transmission=model.transmission(), flux=2e7,
        errors={"flux": np.array([1e6])}, start={},
    )  # fmt: skip


def sky_of(*frames, catalogue_error=None, scatter=1.0):
    opd = dr.wavefront.random_opd(1, npix=128)
    fit = SimpleNamespace(
        frames=frames, catalogue_error=catalogue_error, catalogue_flux=None, initial=opd
    )
    return Sky.of(fit, scatter=scatter)


def test_the_stop_passes_what_arrives_of_a_star_without_the_occulter():
    options = {"monochromatic": 4.5e-6, "npix": 256, "si_wfe": False}
    model = dr.nircam_coronagraph("F444W", fov_pixels=16, **options)
    bare = dr.nircam_coronagraph("F444W", fov_pixels=160, image_mask=None, **options)
    share = model.transmission()
    assert share == bare.transmission()
    with torch.no_grad():
        arrived = float(bare(None).sum())
    # Some of it falls beyond 5 arcsec.
    assert 0.96 * share < arrived < share
    moved = model.transmission(lyot_shift=(0.1, 0.0))
    assert moved < 0.9 * share


def test_a_stars_flux_density_is_that_of_its_unocculted_image(tmp_path):
    got = observation(tmp_path)
    frame = fitted(got)
    scale = jansky_per_unit(frame)
    assert scale == pytest.approx(frame.transmission * REAL["PIXAR_SR"] * 1e6)
    # The posterior's 5 %, doubled, and the 10 % that it does not know of, unless there is a prior.
    for known, share in ((None, math.hypot(0.1, 0.1)), (0.05, math.hypot(0.1, 0.05))):
        value, error = sky_of(frame, catalogue_error=known, scatter=2.0).star
        assert value == pytest.approx(2e7 * scale)
        assert error == pytest.approx(share * value)
    # What is not calibrated has no flux density.
    del got.header["PIXAR_SR"]
    assert jansky_per_unit(fitted(got)) is None
    with pytest.raises(IncompatibleSetupError, match="is not calibrated: expected"):
        require_calibrated(got)


def test_the_epoch_is_the_middle_of_the_exposures(tmp_path):
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    first = observation(tmp_path / "a")
    later = observation(tmp_path / "b", EXPMID=None, **{"DATE-BEG": "2022-10-03T16:00:00"})
    assert first.mid_date.mjd == REAL["EXPMID"]
    sky = sky_of(fitted(first), fitted(later))
    assert sky.mjd == pytest.approx((REAL["EXPMID"] + 59855 + 16 / 24) / 2, abs=1e-8)
    assert sky.date == Time(sky.mjd, format="mjd").isot[:19]
    assert set(table(sky)["epoch_mjd"]) == {sky.mjd}


def test_programs_that_fit_orbits_read_the_astrometry(tmp_path):
    """As their own readers do, of which backtracks and orvara take columns by their place."""
    known = table()
    ra, dec, separation, ra_error, separation_error = (
        known[name].to_value("mas")
        for name in ("delta_ra", "delta_dec", "separation", "delta_ra_error", "separation_error")
    )
    angle, angle_error = (known[f"position_angle{k}"].to_value("deg") for k in ("", "_error"))
    orbitize = {
        "object": [1, 2], "epoch": 59855.5, "raoff": ra, "raoff_err": ra_error, "decoff": dec,
        "sep": separation, "sep_err": separation_error, "pa": angle,
        "radec_corr": known["radec_corr"],
    }  # fmt: skip
    octofitter = {
        "epoch": 59855.5, "ra": ra, "σ_ra": ra_error, "dec": dec, "cor": known["radec_corr"]
    }  # fmt: skip
    backtracks = {0: 59855.5, 2: ra, 3: ra_error, 4: dec, 6: known["radec_corr"]}
    orvara = {
        0: 2459856.0, 1: separation / 1000, 4: angle_error, 5: known["seppa_corr"], 6: [0, 1]
    }  # fmt: skip
    rows = ascii.read(write_astrometry(known, tmp_path / "orbitize.csv", "orbitize"))
    assert isinstance(rows[0]["object"], np.int64)
    by_place = ascii.read(write_astrometry(known, tmp_path / "backtracks.csv", "backtracks"))
    assert list(by_place["quant_type"]) == ["radec", "radec"]
    by_name = ascii.read(write_astrometry(known, tmp_path / "octofitter.csv", "octofitter"))
    plain = np.genfromtxt(
        write_astrometry(known, tmp_path / "relAst.txt", "orvara"), usecols=range(7)
    )
    for read, expected in (
        (rows, orbitize), (by_place.columns, backtracks), (by_name, octofitter), (plain.T, orvara)
    ):  # fmt: skip
        for column, values in expected.items():
            np.testing.assert_allclose(read[column], values, rtol=1e-5)


@pytest.mark.parametrize(
    ("sky", "format", "message"),
    [
        (Sky(north=1.0), "orbitize", "no date"),
        (Sky(mjd=59855.0), "orbitize", "no position angle"),
        (SKY, "csv", "expected one of orbitize, backtracks"),
    ],
)
def test_an_orbit_needs_angle_and_date(sky, format, message, tmp_path):
    with pytest.raises(IncompatibleSetupError, match=message):
        write_astrometry(table(sky), tmp_path / "astrometry.csv", format)
    assert not list(tmp_path.iterdir())
