"""`spaceklip.run_obs` on a stand-in for a spaceKLIP database, and on a real one where installed."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from astropy.io import fits
from astropy.table import QTable, Table, vstack
from small_files import calints as small_calints

from benchmarks.calints_files import calints
from benchmarks.synthetic_searches import searched
from pyklip_diffrender import spaceklip
from pyklip_diffrender.detection import Candidates, Detection
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Sky
from pyklip_diffrender.detection.measurement import candidate_table
from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.pyklip_backend import backend
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.wavefront import random_opd

pytestmark = pytest.mark.filterwarnings("ignore:Mean of empty slice:RuntimeWarning")

SIDE, PIXEL = 41, 0.062424185
KEY = "JWST_NIRCAM_NRCALONG_F444W_MASKRND_MASK335R_SUB320A335R"
FLUX, CONTRAST = 1e10, 2e-5
SKY_ANGLES = (63.0, 73.0)
OPD = random_opd(1, npix=128)
ALIGNED = FitSettings(free=("flux", "background"), wavefront=False)


class StandIn:
    """The part of `spaceKLIP.database.Database` that is used."""

    def __init__(self, folder, obs):
        self.output_dir, self.obs = str(folder), obs
        self.red: dict[str, Table] = {}
        self.src: dict[str, dict[int, Table]] = {}

    def read_jwst_s3_data(self, datapaths):
        for path in datapaths:
            header = fits.getheader(path)
            keys = "TELESCOP INSTRUME DETECTOR FILTER PUPIL CORONMSK SUBARRAY"
            key = "_".join(header[k] for k in keys.split())
            modes = {name: [header[name]] for name in ("MODE", "ANNULI", "SUBSECTS", "KLMODE0")}
            self.red[key] = Table({"FITSFILE": [path], **modes})

    def update_src(self, key, index, tab):
        self.src.setdefault(key, {})[index] = tab


def frame(path, data, roll):
    """Write a stage-2 file with the star where spaceKLIP puts it."""
    center = (SIDE + 1) / 2
    primary = {
        "TELESCOP": "JWST", "EXP_TYPE": "NRC_CORON", "PUPIL": "MASKRND", "CORONMSK": "MASKA335R",
        "TARGPROP": "STAR", "XOFFSET": 0.0, "YOFFSET": 0.0,
    }  # fmt: skip
    science = {
        "PIXAR_SR": 9.2e-14, "PIXAR_A2": PIXEL**2, "STARCENX": center, "STARCENY": center,
        "CRPIX1": center, "CRPIX2": center, "CRVAL1": 201.0, "CRVAL2": -51.0, "ROLL_REF": roll,
        "V3I_YANG": 0.0, "WCSAXES": 2, "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg", "CUNIT2": "deg", "CD1_1": -PIXEL / 3600, "CD1_2": 0.0, "CD2_1": 0.0,
        "CD2_2": PIXEL / 3600,
    }  # fmt: skip
    data = data.astype(np.float32)[None]
    return str(small_calints(path, data, np.sqrt(data), primary=primary, **science))


def concatenation(files, **columns):
    """The table of a concatenation."""
    common = {
        "TYPE": "SCI", "EXP_TYPE": "NRC_CORON", "DATAMODL": "STAGE2", "TELESCOP": "JWST",
        "TARGPROP": "STAR", "TARG_RA": 201.0, "TARG_DEC": -51.0, "INSTRUME": "NIRCAM",
        "DETECTOR": "NRCALONG", "FILTER": "F444W", "CWAVEL": 4.44, "DWAVEL": 1.02,
        "PUPIL": "MASKRND", "CORONMSK": "MASK335R", "EXPSTART": 59790.0, "NINTS": 1,
        "EFFINTTM": 300.0, "SUBARRAY": "SUB320A335R", "APERNAME": "NRCA5_MASK335R",
        "PPS_APER": "NRCA5_MASK335R", "PIXSCALE": PIXEL, "PIXAR_SR": 9.2e-14, "BUNIT": "MJy/sr",
        "BLURFWHM": np.nan, "MASKFILE": "NONE", **columns,
    }  # fmt: skip
    table = Table({name: [value] * len(files) for name, value in common.items()})
    table["FITSFILE"] = np.array(files, dtype=object)
    table["ALIGN_SHIFT"] = np.empty(len(files), dtype=object)
    for k in range(len(files)):
        table["ALIGN_SHIFT"][k] = np.zeros((1, 2))
    return table


def fake_detection(offset, north):
    """A `Detection` with one candidate and one at twice its S/N."""
    errors = torch.tensor([1e-6, 1e-6, 1e-2, 2e-2, 3e-2, 4e-2], dtype=torch.float64)
    candidates = replace(
        Candidates.at([offset, (0.5, 0.6)], [1e-5, 2e-5]),
        covariance=torch.diag(errors**2), detection_errors=errors[:2],
    )  # fmt: skip
    curve = QTable({"separation": [0.3, 0.5], "small_sample": [1e-4, 1e-5], "contrast": [0.0, 0.0]})
    curve["separation"].unit = "arcsec"
    sky = Sky(north, star=(0.5, 0.01))
    table = candidate_table(candidates, ErrorFactor.constant(2.0), np.zeros((2, 2)), sky)
    return SimpleNamespace(candidates=table, contrast_curve=curve)


def stub_product(folder, filter):
    """The image of a concatenation, without light."""
    header = {"TELESCOP": "JWST", "INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "FILTER": filter,
              "PUPIL": "MASKRND", "CORONMSK": "MASK335R", "SUBARRAY": "SUB320A335R",
              "MODE": "ADI", "ANNULI": 1, "SUBSECTS": 1, "KLMODE0": 1}  # fmt: skip
    product = folder / f"{filter}-KLmodes-all.fits"
    fits.PrimaryHDU(header=fits.Header(header)).writeto(product, overwrite=True)
    return product


def test_candidates_become_rows_of_spaceklips_table(tmp_path):
    made = fake_detection((-0.3, 0.4), 90.0)
    table = spaceklip.source_table(made, tmp_path / "x.fits")
    assert list(table["ID"]) == [1, 2]
    # +y points east, and +x north.
    np.testing.assert_allclose(table["RA"][1], 0.4, atol=1e-9)
    np.testing.assert_allclose(table["DEC"][1], -0.3, atol=1e-9)
    np.testing.assert_allclose(table["RA_ERR"], 2 * np.array([4e-2, 3e-2]), rtol=1e-6)
    np.testing.assert_allclose(table["DEC_ERR"], 2 * np.array([2e-2, 1e-2]), rtol=1e-6)
    np.testing.assert_allclose(table["CON"], [2e-5, 1e-5])
    np.testing.assert_allclose(table["SNR"], [10.0, 5.0])
    np.testing.assert_allclose(table["FLUX_JY"], [1e-5, 5e-6])
    assert np.isnan(table["APPMAG"]).all()
    assert set(table["FITSFILE"]) == {str(tmp_path / "x.fits")}


def test_products_have_spaceklips_keywords_and_curves(tmp_path):
    table = concatenation([frame(tmp_path / "a_calints.fits", np.ones((SIDE, SIDE)), 63.0)] * 2)
    product = tmp_path / "x-KLmodes-all.fits"
    header = fits.Header({"PSFCENTX": 20.0, "PSFCENTY": 19.5, "KLMODE0": 1})
    fits.writeto(product, np.zeros((1, SIDE, SIDE)), header)
    spaceklip.complete_header(product, table, "ADI")
    header = fits.getheader(product)
    assert (header["NINTS"], header["MODE"], header["ANNULI"]) == (2, "ADI", 1)
    assert (header["CRPIX1"], header["CRPIX2"], header["CRVAL1"]) == (21.0, 20.5, 201.0)
    assert (header["CD1_1"], header["CD2_2"]) == pytest.approx((-PIXEL / 3600, PIXEL / 3600))
    assert "BLURFWHM" not in header
    spaceklip.write_contrast(product, fake_detection((0.1, 0.1), 0.0))
    for name, values in (("seps", [0.3, 0.5]), ("cons", [1e-4, 1e-5]), ("maskcons", [1e-4, 1e-5])):
        saved = np.load(tmp_path / f"x-KLmodes-all_cal_{name}.npy")
        np.testing.assert_array_equal(saved, [values])
    spaceklip.write_database(tmp_path / "x.dat", table)
    again = Table.read(tmp_path / "x.dat", format="ascii")
    assert list(again["FITSFILE"]) == list(table["FITSFILE"])
    assert again["ALIGN_SHIFT"][0] == "[[0.0, 0.0]]"


def test_columns_that_hold_no_value_end_nothing_after_the_fit(tmp_path):
    """SpaceKLIP copies cards as they are: None, text in place of a number, or masked."""
    path = frame(tmp_path / "a_calints.fits", np.ones((SIDE, SIDE)), 63.0)
    with fits.open(path, mode="update") as hdus:
        del hdus["SCI"].header["CRVAL1"]
    odd = {"TARG_RA": None, "CWAVEL": "N/A", "EXPSTART": None, "NINTS": "two", "PIXSCALE": "",
           "EFFINTTM": True, "MASKFILE": None, "BUNIT": b"MJy/sr", "TARGPROP": "β Pic"}  # fmt: skip
    table = concatenation([path], **odd)
    table["DWAVEL"] = np.ma.masked_array([1.0], mask=[True])
    table.remove_column("APERNAME")
    product = tmp_path / "x-KLmodes-all.fits"
    fits.writeto(product, np.zeros((1, SIDE, SIDE)), fits.Header({"PSFCENTX": 20, "PSFCENTY": 20}))
    spaceklip.complete_header(product, table, "ADI")
    spaceklip.write_database(tmp_path / "x.dat", table)
    spaceklip.write_mask(tmp_path / "x_psfmask.fits", table)
    header = fits.getheader(product)
    assert (header["CWAVEL"], header["TARGPROP"], header["NINTS"]) == ("N/A", "? Pic", 0)
    assert not {"TARG_RA", "DWAVEL", "EXPSTART", "APERNAME", "CRVAL2"} & set(header)
    assert not (tmp_path / "x_psfmask.fits").exists()
    assert Table.read(tmp_path / "x.dat", format="ascii")["CWAVEL"][0] == "N/A"


def test_a_failure_is_reported_after_the_others(tmp_path, monkeypatch, caplog):
    good, bad = (concatenation([str(calints(tmp_path / f"{each}_calints.fits"))]) for each in "ab")
    obs = {
        "bad": bad, KEY: good, "miri": concatenation(["c"], INSTRUME="MIRI", EXP_TYPE="MIR_4QPM"),
        "raw": concatenation(["d"], DATAMODL="STAGE1"),
        "references": concatenation(["e"], TYPE="REF"),
        "clear": concatenation(["f"], CORONMSK="NONE"),
    }  # fmt: skip
    database = StandIn(tmp_path, obs)

    def reduced(key, table, sequence, folder, *others):
        if key == "bad":
            raise IncompatibleSetupError("no such filter")
        return stub_product(folder, "F444W"), fake_detection((-0.3, 0.4), 0.0)

    monkeypatch.setattr(spaceklip, "_reduced", reduced)
    with (
        pytest.warns(DiffrenderWarning) as skipped,
        pytest.raises(ExceptionGroup, match="1 of 2 concatenations failed") as caught,
    ):
        spaceklip.run_obs(database, opd=OPD)
    (error,) = caught.value.exceptions
    assert isinstance(error, IncompatibleSetupError)
    assert error.__notes__ == ["concatenation bad"]
    assert "Traceback" in caplog.text
    assert "no such filter" in caplog.text
    expected = ("MIR_4QPM", "STAGE1", "no frames of a target", "mask NONE")
    for reason, words in zip(skipped, expected, strict=True):
        assert "is skipped" in str(reason.message)
        assert words in str(reason.message)
    assert list(database.red) == [KEY]
    assert list(database.src[KEY][0]["CON"]) == [2e-5, 1e-5]
    with pytest.raises(ExceptionGroup):
        spaceklip.run_obs(database, opd=OPD, restrict_to="bad")


def test_concatenations_of_one_target_are_searched_together(tmp_path, monkeypatch):
    """A planet that is too faint for each of two filters; a bad fit and another star beside it."""
    star, other = ({"TARGPROP": name, "TARG_RA": ra, "TARG_DEC": 5.0} for name, ra in
                   (("HD 1", 10.0), ("HD 2", 90.0)))  # fmt: skip
    place = (0.6, 0.35)
    made = {
        "F444W": searched("F444W", 1, [(*place, 4.2)], north=20.0, header=star),
        "F356W": searched("F356W", 2, [(*place, 4.0)], header=star),
        "F300M": searched("F300M", 3, status="MODEL_MISMATCH", header=star),
        "other": searched("F444W", 4, header=other),
    }
    files = {key: [str(calints(tmp_path / f"{key}_calints.fits"))] for key in made}
    obs = {k: concatenation(files[k], FILTER=made[k].observation.filter) for k in made}

    def reduced(key, table, sequence, folder, *others):
        return stub_product(folder, key), made[key]

    monkeypatch.setattr(spaceklip, "_reduced", reduced)
    database = StandIn(tmp_path, obs)
    with pytest.warns(DiffrenderWarning, match=r"HD 1: F300M .* is left out .*MODEL_MISMATCH"):
        detections = spaceklip.run_obs(database, opd=OPD)
    assert detections == made
    (folder,) = (tmp_path / "diffrender").glob("combined_*")
    assert folder.name == "combined_HD-1"
    (row,) = QTable.read(folder / "combined_candidates.ecsv")
    assert np.hypot(row["delta_ra"].value - 0.6, row["delta_dec"].value - 0.35) < 0.06
    # A second call replaces the files; other spectra are those of the request.
    with pytest.warns(DiffrenderWarning, match="left out"):
        spaceklip.run_obs(database, opd=OPD, spectra=["flat"])
    assert fits.getdata(folder / "combined.fits", "SNR").shape[0] == 1
    # What cannot be searched together is a warning, and the concatenations are returned.
    made["F356W"] = searched("F356W", 2, mjd=60400.0, header=star)
    with pytest.warns(DiffrenderWarning, match="HD 1 has no combined search: .* several epochs"):
        assert spaceklip.run_obs(database, opd=OPD) == made


def test_files_are_judged_before_any_is_fitted(tmp_path):
    rolls = [
        str(calints(tmp_path / f"{k}_calints.fits", observation=k, roll=70.0 + k)) for k in (1, 2)
    ]
    confirmation = calints(tmp_path / "ta.fits", observation=3, cards={"EXP_TYPE": "NRC_TACONFIRM"})
    own = calints(tmp_path / "own.fits", observation=4, roll=80.0)
    other = calints(tmp_path / "psf.fits", "HD 2", observation=5)
    table = concatenation([*rolls, str(confirmation), str(own), str(other)])
    table["TYPE"] = ["SCI"] * 3 + ["REF"] * 2
    with pytest.warns(DiffrenderWarning) as caught:
        left, sequence = spaceklip._admitted(KEY, table)
    assert list(left["FITSFILE"]) == [*rolls, str(other)]
    uses = {row["file"]: row["use"] for row in sequence.table}
    assert uses == {
        "1_calints.fits": "target", "2_calints.fits": "target", "psf.fits": "reference",
        "own.fits": "excluded", "ta.fits": "excluded",
    }  # fmt: skip
    said = " ".join(str(each.message) for each in caught)
    assert "ta.fits is left out: EXP_TYPE is NRC_TACONFIRM" in said
    assert "own.fits is left out: a reference frame that shows the target itself" in said


@pytest.fixture
def real_database(tmp_path):
    reason = "spaceKLIP is not on the package index; install it from its repository"
    database = pytest.importorskip("spaceKLIP.database", reason=reason, exc_type=ImportError)
    made = database.Database(str(tmp_path))
    made.verbose = False
    return made


def two_rolls(folder):
    """Files of a star with a planet 0.8 arcsec from it at 120 degrees."""
    model = nircam_coronagraph(
        "F444W", fov_pixels=SIDE, npix=128, occulter_sampling=2.0, monochromatic=4.44e-6
    )
    rng = np.random.default_rng(1)
    files = []
    for k, roll in enumerate(SKY_ANGLES):
        turned = np.radians(120.0 - roll)
        planet = 0.8 * np.array([-np.sin(turned), np.cos(turned)])
        with torch.no_grad():
            image = model(OPD.data) + CONTRAST * model(OPD.data, star_offset=planet)
        photons = rng.poisson(FLUX * image.numpy() + 100.0).astype(float)
        files.append(frame(folder / f"jw0{k}_calints.fits", photons, roll))
    return model, files


@pytest.mark.slow
@pytest.mark.usefixtures("offline")
@pytest.mark.parametrize("kind", ["stand-in", "real"])
def test_a_concatenation_from_frames_to_sources(kind, tmp_path, request):
    model, files = two_rolls(tmp_path)
    sky = np.radians(120.0)
    real = kind == "real"
    database = request.getfixturevalue("real_database") if real else StandIn(tmp_path, {})
    database.obs[KEY] = concatenation(files)
    detections = spaceklip.run_obs(
        database, opd=OPD, model=model, pattern="off", settings=ALIGNED, save_rolls=True,
        image="subtracted",
    )  # fmt: skip
    assert list(detections) == list(database.red) == [KEY]
    (sources,) = database.src[KEY] if real else database.src[KEY].values()
    assert len(sources) == 1
    for name, truth in (("RA", 0.8 * np.sin(sky)), ("DEC", 0.8 * np.cos(sky)), ("CON", CONTRAST)):
        assert abs(sources[name][0] - truth) < 4 * sources[f"{name}_ERR"][0]
    product = Path(database.red[KEY]["FITSFILE"][0])
    assert product.parent == tmp_path / "diffrender"
    snr, header = fits.getdata(Path(str(product).replace("KLmodes-all", "snr")), header=True)
    peak = np.unravel_index(np.nanargmax(snr), snr.shape)
    y = header["PSFCENTY"] + 0.8 * np.cos(sky) / PIXEL
    x = header["PSFCENTX"] - 0.8 * np.sin(sky) / PIXEL
    np.testing.assert_allclose(peak, (y, x), atol=1.0)
    image = fits.getdata(product)[0]
    brightest = np.unravel_index(np.nanargmax(image), image.shape)
    np.testing.assert_allclose(brightest, (y, x), atol=1.0)
    paths = [product.with_name(f"{product.stem}_roll{k}.fits") for k in (1, 2)]
    rolls = np.array([fits.getdata(path)[0] for path in paths])
    assert fits.getheader(paths[0])["NINTS"] == 1
    seen = np.isfinite(rolls).all(axis=0)
    np.testing.assert_allclose(rolls.mean(axis=0)[seen], image[seen], rtol=1e-5, atol=1e-3)
    assert np.abs(rolls[0] - rolls[1])[seen].max() > 10
    assert (product.parent / f"{KEY}.dat").exists()
    assert Detection.read(product.parent / f"ADI_NANNU1_NSUBS1_{KEY}").candidates["snr"][0] > 5


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"fit_pixel": 80}, TypeError, "unexpected keyword argument 'fit_pixel'"),
        ({"model_options": {"npx": 8}}, IncompatibleSetupError, "npx: not known to nircam_cor"),
        ({"pattern": "no.fits"}, IncompatibleSetupError, "pattern: got 'no.fits'"),
        ({"threshold": 0.0}, IncompatibleSetupError, "threshold: got 0.0"),
        ({"star_flux": {"F335M": 0.4}}, IncompatibleSetupError, r"'F335M'.*\['F444W'\]"),
        ({"star_flux": {"F444W": -0.4}}, IncompatibleSetupError, "expected 1e-06"),
    ],
)
def test_settings_are_checked_before_the_first_file_is_read(settings, error, message, tmp_path):
    database = StandIn(tmp_path, {KEY: concatenation(["missing_calints.fits"])})
    with pytest.raises(error, match=message):
        spaceklip.run_obs(database, opd=OPD, **settings)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("offline")
def test_spaceklips_own_subtraction(tmp_path, monkeypatch, real_database):
    """`pyklippipeline.run_obs` with another algorithm; it does not run without references."""
    pipeline = pytest.importorskip("spaceKLIP.pyklippipeline", exc_type=ImportError)
    model, files = two_rolls(tmp_path)
    table = concatenation(files)
    again = frame(tmp_path / "jw09_calints.fits", fits.getdata(files[0], "SCI")[0], 0.0)
    reference = concatenation([again])
    reference["TYPE"] = "REF"
    table["ROLL_REF"], reference["ROLL_REF"] = SKY_ANGLES, [0.0]
    real_database.obs[KEY] = vstack([table, reference])
    monkeypatch.setattr(pipeline, "get_transmission", lambda *args: None, raising=False)
    with backend(opd=OPD, model=model, pattern="off", settings=ALIGNED):
        modes = {"mode": ["ADI+RDI"], "annuli": [1], "subsections": [1], "numbasis": [1]}
        options = {**modes, "algo": "diffrender", "save_rolls": True}
        pipeline.run_obs(real_database, kwargs=options, subdir="own")
    (product,) = (tmp_path / "own").glob("*-KLmodes-all.fits")
    assert fits.getheader(product)["DRALGO"] == "diffrender"
    assert len(list((tmp_path / "own").glob("*_roll*.fits"))) == 2
