"""The backend with a pipeline's own subclass of `Data`, in other threads, and in processes."""

import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from astropy.io import fits
from backend_scene import ANGLES, CENTER, OPD, SHAPE, frames, generic, psf, reduced, render
from pyklip import rdi
from pyklip.instruments.Instrument import Data
from pyklip.instruments.utils import wcsgen

from pyklip_diffrender import pyklip_backend


class PipelineData(Data):
    """A dataset in memory, as corgidrp makes it, with what `Data` demands and no headers."""

    # What `Data` declares abstract: each pipeline stores it as it likes.
    input = centers = filenums = filenames = PAs = wvs = wcs = IWA = output = None

    def __init__(self, images, references):
        super().__init__()
        self.readdata(images)
        names = [*self.filenames, *(f"reference_{k}.fits" for k in range(len(references)))]
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
        self, filepath, data, klipparams=None, filetype="", zaxis=None, more_keywords=None
    ):
        header = fits.Header({"PIPELINE": "ours", "PSFPARAM": klipparams, "FILETYPE": filetype})
        header["PSFCENTX"], header["PSFCENTY"] = self.output_centers[0]
        header.update({f"KLMODE{k}": mode for k, mode in enumerate(() if zaxis is None else zaxis)})
        fits.PrimaryHDU(data.astype(np.float32), header).writeto(filepath, overwrite=True)

    def calibrate_output(self, img, spectral=False, units="contrast"):
        return img


@pytest.mark.parametrize("mode", ["ADI", "ADI+RDI"])
def test_a_pipelines_own_dataset(mode, rng, tmp_path):
    images = frames(ANGLES, rng)
    star = 900 * psf(*CENTER) + rng.normal(0, 0.05, (4, *SHAPE))
    dataset = PipelineData(images, star)
    dataset.diffrender = pyklip_backend.DiffrenderSettings(opd=OPD, subtractor=render)
    with pyklip_backend.backend():
        # The algorithm is not the pipeline's to choose: it calls pyKLIP without `algo`.
        files = reduced(
            dataset, tmp_path, "", algo="klip", mode=mode, numbasis=[1, 4], movement=1,
            calibrate_flux=False, psf_library=dataset._psflib,
        )  # fmt: skip
    image, header = files["-KLmodes-all.fits"]
    # The pipeline reads the product again and copies its cards, one by one.
    copied = fits.Header()
    for card in header.cards:
        copied.set(*card)
    assert (copied["PIPELINE"], copied["DRALGO"]) == ("ours", "diffrender")
    assert (copied["PSFCENTX"], copied["PSFCENTY"]) == tuple(dataset.output_centers[0])
    np.testing.assert_allclose(image, np.nanmean(dataset.output[:, :, 0], axis=1), rtol=1e-5)
    # The companion is 12 pixels up, and nothing is left of the star of 1000.
    x, y = np.round(dataset.output_centers[0]).astype(int)
    assert image[0, y + 12, x] == pytest.approx(2.0, abs=0.3)
    image[:, y + 7 : y + 18, x - 5 : x + 6] = np.nan
    assert np.nanmax(abs(image)) < 0.5


@pytest.mark.parametrize(
    ("method", "threads"), [("fork", 2), pytest.param("spawn", 1, marks=pytest.mark.slow)]
)
def test_the_start_method_of_processes_changes_nothing(method, threads, rng, tmp_path):
    """pyKLIP turns frames in a pool, and measures their noise in one for weighted means.

    Processes of a fork server know no more than those that are spawned.
    """
    images, cubes = frames(ANGLES, rng), []
    before = multiprocessing.get_start_method(allow_none=True)
    for start, count in (("fork", 1), (method, threads)):
        multiprocessing.set_start_method(start, force=True)
        with pyklip_backend.backend(opd=OPD, subtractor=render):
            files = reduced(
                generic(images, ANGLES), tmp_path, annuli=2, numbasis=[1], highpass=8.0,
                time_collapse="weighted-mean", numthreads=count,
            )  # fmt: skip
        cubes.append(files["x-KLmodes-all.fits"][0])
    multiprocessing.set_start_method(before, force=True)
    assert np.isfinite(cubes[0]).any()
    np.testing.assert_array_equal(*cubes)


def test_what_is_registered_holds_in_threads(rng, tmp_path):
    dataset = generic(frames([0.0, 30.0], rng), [0.0, 30.0])
    pyklip_backend.register(opd=OPD, subtractor=render, replace=True)
    with ThreadPoolExecutor(1) as pool:
        pool.submit(reduced, dataset, tmp_path, algo="klip", numbasis=[1]).result()
    pyklip_backend.unregister()
    assert "DRALGO" in fits.getheader(tmp_path / "x-KLmodes-all.fits")
