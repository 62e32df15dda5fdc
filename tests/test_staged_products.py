"""Products that are written as they come, beside those of other runs."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData

import pyklip_diffrender as dr
from pyklip_diffrender.errors import DiffrenderWarning, ExistingFileError, IncompatibleSetupError
from pyklip_diffrender.io.files import OutputFolder
from pyklip_diffrender.reduction import ReduceOptions, pipeline
from pyklip_diffrender.reduction.pipeline import Preparation
from pyklip_diffrender.reduction.products import ProductFolder
from pyklip_diffrender.refinement import coarse_arguments, faintness
from pyklip_diffrender.refinement.settings import quick_settings, settings_for

POINTING = {"CRVAL1": 150.0, "CRVAL2": 30.0, "TARGPROP": "HD 1"}
ROLL = 25.0
PLANET = dr.Planet(2e-4, 0.5, 40.0)


def preparation(**options):
    """One small frame of a star with a planet, and what is needed to reduce it."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    opd = dr.wavefront.random_opd(1, npix=128)
    frame = replace(
        dr.simulate(model, dr.Scene(planets=(PLANET,)), opd, seed=3),
        header=fits.Header(POINTING), position_angles=np.array([ROLL]), name="roll1_calints.fits",
    )  # fmt: skip
    sequence = dr.ExposureSequence("HD 1", (frame,))
    chosen = ReduceOptions(
        size=24, pattern="off", settings=dr.FitSettings(cycles=4), injections=2, **options
    )
    return Preparation(sequence, sequence, model, opd, chosen, chosen.settings)


def interrupted(*_, **__):
    raise KeyboardInterrupt


class Remembering(ProductFolder):
    """The folder of the products, and the reductions that were written to it."""

    kept = ()

    def keep(self, reduction):
        self.kept += (reduction,)
        return super().keep(reduction)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A reduction that was interrupted while planets were injected, and its folder."""
    products = Remembering(tmp_path_factory.mktemp("products"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "recover_planets", interrupted)
        patch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"no picture")
        with pytest.raises(KeyboardInterrupt):
            preparation().run(keep=products.keep)
    (reduction,) = products.kept
    return reduction, products.folder


def test_an_interrupted_reduction_leaves_fit_and_search(stopped):
    _, folder = stopped
    names = {path.name for path in folder.iterdir()}
    assert {"report.html", "summary.json", "fit.fits", "detection.fits"} <= names
    assert "injections.ecsv" not in names
    assert not [name for name in names if name.startswith(".")]
    assert len(dr.Detection.read(folder).candidates) == 1
    # Nothing of it has to be kept for later: the derivatives are there if they are asked for.
    assert dr.Refinement.read(folder / "fit.fits").stored_linear is None
    with pytest.raises(ExistingFileError, match="overwrite"):
        ProductFolder(folder)


def content(folder):
    """Content of all files in a folder, and in those inside."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_without_overwrite_products_of_another_run_are_kept_as_well(tmp_path):
    names = ("a.txt", "b.txt")

    def files(folder):
        return [folder / name for name in names]

    def writing(text, names=names):
        def write(folder):
            for name in names:
                (folder / name).write_text(text)
            return [folder / name for name in names]

        return write

    runs = [OutputFolder(tmp_path / "out", names, overwrite=False) for _ in range(3)]
    assert runs[0].replace(writing("first")) == files(tmp_path / "out")
    for number, run in enumerate(runs[1:], 2):
        with pytest.warns(DiffrenderWarning, match="somebody else has written"):
            assert run.replace(writing(str(number))) == files(tmp_path / "out" / f"out-{number}")
        # Products of the next stages belong there as well.
        assert run.replace(writing("again")) == files(tmp_path / "out" / f"out-{number}")
    assert {path.read_text() for path in files(tmp_path / "out")} == {"first"}
    with pytest.raises(IncompatibleSetupError, match=r"a\.txt is a file, expected a folder"):
        OutputFolder(tmp_path / "out" / "a.txt", names, overwrite=True)
    with pytest.raises(ExistingFileError, match=r"a\.txt, .*b\.txt exist"):
        OutputFolder(tmp_path / "out", names, overwrite=False)
    # What the new products do not have is removed, but not where somebody has changed it.
    last = OutputFolder(tmp_path / "out", names, overwrite=True)
    assert last.replace(writing("last", ["a.txt"])) == [tmp_path / "out" / "a.txt"]
    assert not (tmp_path / "out" / "b.txt").exists()
    # Products that cannot be written leave the earlier ones as they are.
    before = content(tmp_path)
    with pytest.raises(ZeroDivisionError):
        last.replace(lambda folder: [(folder / "a.txt").write_text("half"), 1 / 0])
    assert content(tmp_path) == before
    (tmp_path / "out" / "a.txt").write_text("by hand")
    last.clear()
    assert (tmp_path / "out" / "a.txt").read_text() == "by hand"


def test_a_detection_in_terms_of_astropy(stopped):
    reduction, folder = stopped
    detection = dr.Detection.read(folder)
    star = SkyCoord(POINTING["CRVAL1"], POINTING["CRVAL2"], unit="deg")
    row = detection.candidates[0]
    place = star.spherical_offsets_by(row["delta_ra"], row["delta_dec"])
    assert star.separation(place).arcsec == pytest.approx(row["separation"].value, rel=1e-4)
    angle = star.position_angle(place).deg
    assert angle == pytest.approx(row["position_angle"].value, abs=0.01)
    assert angle == pytest.approx(PLANET.position_angle + ROLL, abs=3)
    ccd = CCDData.read(folder / "detection.fits", hdu="CONTRAST", unit="")
    np.testing.assert_array_equal(ccd.data, detection.contrast)
    x, y = ccd.wcs.world_to_pixel(place)
    peak = np.unravel_index(np.nanargmax(detection.snr), detection.snr.shape)
    assert np.hypot(x - peak[1], y - peak[0]) < 1
    subtracted = CCDData.read(folder / "detection.fits", hdu="SUBTRACTED")
    assert subtracted.unit == u.photon
    frame = reduction.sequence.science[0]
    np.testing.assert_array_equal(frame.mask, ~frame.valid)


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
    with pytest.raises(IncompatibleSetupError, match="accuracy, settings: got 'quick'"):
        ReduceOptions(accuracy="quick", settings=dr.FitSettings())
