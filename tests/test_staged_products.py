"""Products that are written as they come, and reductions that are resumed."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable

import pyklip_diffrender as dr
from pyklip_diffrender.errors import CorruptFileError, ExistingFileError, IncompatibleSetupError
from pyklip_diffrender.reduction import (
    UNFINISHED,
    Preparation,
    ProductFolder,
    ReduceOptions,
    pipeline,
)
from pyklip_diffrender.refinement import coarse_arguments, faintness
from pyklip_diffrender.refinement.settings import quick_settings, settings_for

POINTING = {"CRVAL1": 150.0, "CRVAL2": 30.0, "TARGPROP": "HD 1"}
ROLL = 25.0
PLANET = dr.Planet(2e-4, 0.5, 40.0)


def preparation(**options):
    """One small frame of a star with a planet, and what is needed to reduce it."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    opd = dr.random_opd(1, npix=128)
    frame = replace(
        dr.simulate(model, dr.Scene(planets=(PLANET,)), opd, seed=3),
        header=fits.Header(POINTING), position_angles=np.array([ROLL]), name="roll1_calints.fits",
    )  # fmt: skip
    sequence = dr.Sequence("HD 1", (frame,))
    chosen = ReduceOptions(
        size=24, systematics="off", settings=dr.GaussNewton(cycles=4), injections=2, **options
    )
    return Preparation(sequence, sequence, model, opd, chosen, chosen.settings)


INJECTED = QTable(
    {
        "separation": [0.4, 0.6] * u.arcsec, "position_angle": [10.0, 200.0] * u.deg,
        "injected": [1e-5, 1e-5], "contrast": [1.1e-5, 0.9e-5], "contrast_error": [1e-6, 1e-6],
        "snr": [8.0, 7.0], "detected": [True, True],
    },
    meta={"strength": 1.6},
)  # fmt: skip


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A reduction that was interrupted while planets were injected."""
    prepared, folder = preparation(), tmp_path_factory.mktemp("products")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "recover_planets", interrupted)
        patch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"no picture")
        with pytest.raises(KeyboardInterrupt):
            prepared.run(products=ProductFolder(folder))
    return prepared, folder


def test_an_interrupted_reduction_leaves_fit_and_search(stopped):
    _, folder = stopped
    names = {path.name for path in folder.iterdir()}
    assert {"report.html", "summary.json", "fit.fits", "detection.fits", UNFINISHED} <= names
    assert "injections.ecsv" not in names
    assert len(dr.Detection.read(folder).candidates) == 1
    with pytest.raises(ExistingFileError, match="overwrite"):
        ProductFolder(folder)


@pytest.mark.slow
def test_a_resumed_reduction_does_not_fit_again(stopped, tmp_path, monkeypatch):
    prepared, before = stopped
    for path in before.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    found = dr.Detection.read(tmp_path).candidates
    monkeypatch.setattr(pipeline, "refine", interrupted)
    monkeypatch.setattr(pipeline, "detect", interrupted)
    monkeypatch.setattr(pipeline, "recover_planets", lambda *_: INJECTED)
    products = ProductFolder(tmp_path, resume=True)
    # Options of later stages may change.
    options = replace(prepared.options, memory="3 GB")
    result = replace(prepared, options=options).run(products=products)
    written = products.finish(result)
    np.testing.assert_array_equal(result.detection.candidates["snr"], found["snr"])
    assert tmp_path / "injections.ecsv" in written
    assert not (tmp_path / UNFINISHED).exists()
    assert json.loads((tmp_path / "summary.json").read_text())["injections"]["count"] == 2
    # The derivatives were for the resumed reduction only.
    assert dr.Refinement.read(tmp_path / "fit.fits").stored_linear is None


def test_another_reduction_is_not_resumed(stopped, tmp_path):
    prepared, folder = stopped
    for changed in (
        replace(prepared, options=replace(prepared.options, threshold=4.0)),
        replace(prepared, wavefront=dr.random_opd(2, npix=128)),
    ):
        with pytest.raises(IncompatibleSetupError, match="other frames, with other options"):
            changed.run(products=ProductFolder(folder, resume=True))
    (tmp_path / UNFINISHED).write_text('{"version": 1}')
    with pytest.raises(CorruptFileError, match=r"is damaged.*--overwrite"):
        prepared.run(products=ProductFolder(tmp_path, resume=True))
    with pytest.raises(TypeError, match="without output"):
        dr.reduce(prepared.sequence, prepared.wavefront, resume=True)


def test_a_detection_in_terms_of_astropy(stopped):
    prepared, folder = stopped
    detection = dr.Detection.read(folder)
    (place,) = detection.coordinates
    star = place.__class__(POINTING["CRVAL1"], POINTING["CRVAL2"], unit="deg")
    row = detection.candidates[0]
    assert star.separation(place).arcsec == pytest.approx(row["separation"].value, rel=1e-4)
    angle = star.position_angle(place).deg
    assert angle == pytest.approx(row["position_angle"].value, abs=0.01)
    assert angle == pytest.approx(PLANET.position_angle + ROLL, abs=3)
    ccd = detection.to_ccddata()
    np.testing.assert_array_equal(ccd.data, detection.contrast)
    np.testing.assert_array_equal(ccd.uncertainty.array, detection.error)
    x, y = ccd.wcs.world_to_pixel(place)
    peak = np.unravel_index(np.nanargmax(detection.snr), detection.snr.shape)
    assert np.hypot(x - peak[1], y - peak[0]) < 1
    subtracted = detection.to_ccddata("subtracted")
    assert subtracted.unit == u.photon
    with pytest.raises(IncompatibleSetupError, match="a frame below 1"):
        detection.to_ccddata("subtracted", frame=1)
    frame = prepared.sequence.science[0]
    np.testing.assert_array_equal(frame.mask, ~frame.valid)
    blind = copy.copy(detection)
    vars(blind)["observation"] = replace(detection.observation, header=fits.Header())
    with pytest.raises(IncompatibleSetupError, match="CRVAL1"):
        blind.coordinates  # noqa: B018


def test_a_quick_reduction_is_smaller_and_coarser_where_the_star_is_fainter():
    given = ({}, {"accuracy": "quick"}, {"accuracy": "quick", "size": 80})
    assert [ReduceOptions(**each).side for each in given] == [80, 56, 80]
    ones = np.ones((1, 80, 80))
    header = fits.Header({"INSTRUME": "NIRCAM", "CORONMSK": "MASKA335R"})

    def frame(snr):
        facts = {"pixelscale": 0.063, "filter": "F444W", "header": header}
        return dr.Observation.from_arrays(snr * ones, ones, **facts)

    bright, fainter, faint = (frame(np.sqrt(1800 / k)) for k in (1, 10, 200))
    assert [round(faintness(each)) for each in (bright, fainter, faint)] == [1, 10, 200]
    cycles = [quick_settings(each).cycles[0] for each in (bright, fainter, faint)]
    assert settings_for(bright).cycles[0] > cycles[0] > cycles[1] > cycles[2]
    assert coarse_arguments(bright, (80, 80)) == {"nlambda": 7, "npix": 128}
    assert coarse_arguments(faint, (80, 80))["nlambda"] == 3
    assert coarse_arguments(bright, (320, 80))["npix"] == 256
    for wrong in ({"accuracy": "fast"}, {"accuracy": "quick", "settings": dr.GaussNewton()}):
        with pytest.raises(IncompatibleSetupError, match="accuracy"):
            ReduceOptions(**wrong)
