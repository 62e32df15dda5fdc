"""The backend with a pipeline's own subclass of `Data`, and with pyKLIP's pools of processes."""

from __future__ import annotations

import multiprocessing

import numpy as np
import pytest
from astropy.io import fits
from backend_scene import CENTER, OPD, SHAPE, frames, generic, psf, render
from pyklip import rdi
from pyklip.instruments.Instrument import Data
from pyklip.instruments.utils import wcsgen
from pyklip.parallelized import klip_dataset

from pyklip_diffrender.pyklip_backend import DiffrenderSettings, backend

ANGLES = (0.0, 20.0, 45.0)

# pyKLIP 2.10 takes the mean of sections that are all NaN.
pytestmark = pytest.mark.filterwarnings("ignore:Mean of empty slice:RuntimeWarning")


class PipelineData(Data):
    """A dataset of images in memory, as corgidrp makes it: its own attributes, library and files.

    Only what `Data` demands is there: no headers, and none of the attributes of `GenericData`.
    """

    # What `Data` declares abstract: each pipeline stores it as it likes.
    input = centers = filenums = filenames = PAs = wvs = wcs = IWA = output = None

    def __init__(self, images, references):
        super().__init__()
        self.readdata(images)
        count = len(references)
        names = [*self.filenames, *(f"reference_{k}.fits" for k in range(count))]
        self._psflib = rdi.PSFLibrary(
            np.array([*self.input, *references]), np.array(CENTER), names, compute_correlation=True
        )
        self._psflib.prepare_library(self)

    def readdata(self, images):
        count = len(images)
        self.input = np.array(images)
        self.centers = np.tile(CENTER, (count, 1))
        self.filenums = np.arange(count)
        self.filenames = np.array([f"image_{k}.fits" for k in range(count)])
        self.PAs = np.array(ANGLES[:count])
        self.wvs = np.full(count, 575e-9)
        self.wcs = np.array([wcsgen.generate_wcs(angle, CENTER) for angle in self.PAs])
        self.IWA = 3
        self.flipx = False

    def savedata(
        self, filepath, data, klipparams = None, filetype = "",
        zaxis = None, more_keywords = None,
    ):  # fmt: skip
        header = fits.Header({"PIPELINE": "ours", "PSFPARAM": klipparams, "FILETYPE": filetype})
        header["PSFCENTX"], header["PSFCENTY"] = self.output_centers[0]
        header.update({f"KLMODE{k}": mode for k, mode in enumerate(() if zaxis is None else zaxis)})
        fits.PrimaryHDU(data.astype(np.float32), header).writeto(filepath, overwrite=True)

    def calibrate_output(self, img, spectral=False, units="contrast"):
        return img


@pytest.mark.parametrize("mode", ["ADI", "RDI", "ADI+RDI"])
def test_a_pipelines_own_dataset(mode, rng, tmp_path):
    images = frames(ANGLES, rng)
    star = 900 * psf(*CENTER) + rng.normal(0, 0.05, (4, *SHAPE))
    dataset = PipelineData(images, star)
    dataset.diffrender = DiffrenderSettings(opd=OPD, subtractor=render)
    options = {
        "annuli": 1, "subsections": 1, "movement": 1, "numbasis": [1, 4], "calibrate_flux": False,
        "numthreads": 1, "verbose": False,
    }  # fmt: skip
    with backend():
        # The algorithm is not the pipeline's to choose: it calls pyKLIP without `algo`.
        klip_dataset(
            dataset, outputdir=str(tmp_path), fileprefix="", mode=mode,
            psf_library=dataset._psflib, **options,
        )  # fmt: skip
    image, header = fits.getdata(tmp_path / "-KLmodes-all.fits", header=True)
    # The pipeline reads the product again and copies its cards, one by one.
    copied = fits.Header()
    for card in header.cards:
        copied.set(*card)
    assert copied["PIPELINE"] == "ours"
    assert copied["DRALGO"] == "diffrender"
    assert (copied["PSFCENTX"], copied["PSFCENTY"]) == tuple(dataset.output_centers[0])
    combined = np.nanmean(dataset.output[:, :, 0], axis=1)
    np.testing.assert_allclose(image, combined, rtol=1e-5)
    # The companion is 12 pixels up, and nothing is left of the star of 1000.
    x, y = np.round(dataset.output_centers[0]).astype(int)
    assert image[0, y + 12, x] == pytest.approx(2.0, abs=0.3)
    image[:, y + 7 : y + 18, x - 5 : x + 6] = np.nan
    assert np.nanmax(abs(image)) < 0.5


@pytest.fixture
def start_method(request):
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method(request.param, force=True)
    yield request.param
    multiprocessing.set_start_method(before, force=True)


@pytest.mark.parametrize(
    "start_method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)], indirect=True
)
def test_the_start_method_of_processes_changes_nothing(start_method, rng, tmp_path):
    """pyKLIP turns frames in a pool, and measures their noise in one for weighted means.

    Processes of a fork server know no more than those that are spawned.
    """
    images, cubes = frames(ANGLES, rng), []
    for threads in (1, 2):
        dataset = generic(images, ANGLES)
        with backend(opd=OPD, subtractor=render):
            klip_dataset(
                dataset, mode="ADI", annuli=2, subsections=1, movement=0, numbasis=[1],
                outputdir=str(tmp_path), fileprefix="x", time_collapse="weighted-mean",
                highpass=8.0, numthreads=threads, verbose=False, algo="diffrender",
            )  # fmt: skip
        cubes.append(fits.getdata(tmp_path / "x-KLmodes-all.fits"))
    assert np.isfinite(cubes[0]).any()
    np.testing.assert_array_equal(*cubes)
