"""Files of many integrations are read in about as much memory as they are large."""

import gc
import gzip
import tracemalloc

import numpy as np
import pytest
from astropy.io import fits

import pyklip_diffrender as dr
from benchmarks.calints_files import SIDE, calints
from pyklip_diffrender.errors import DiffrenderWarning
from pyklip_diffrender.io import files
from pyklip_diffrender.scene import integrations
from pyklip_diffrender.scene.observation import Observation

# The memory for shifting one integration, in double precision, is that of 28 images.
MANY = 32
BYTES = 12 * MANY * SIDE**2
"""Of a file: two arrays of four bytes, and flags of four."""


def spoilt(arrays):
    """One integration is empty, one has an afterglow, and some pixels are flagged or NaN."""
    arrays["DQ"][3] = 1
    arrays["SCI"][7] += 30.0
    arrays["DQ"][:, 20, 30], arrays["SCI"][5, 40, 50] = 1, np.nan


def plain(folder):
    return calints(folder / "a_calints.fits", integrations=MANY, change=spoilt)


def shifted(folder):
    """As spaceKLIP aligns frames: with recorded shifts, which are undone."""
    path = plain(folder)
    shifts = np.random.default_rng(1).uniform(-0.3, 0.3, (MANY, 2))
    fits.append(path, shifts, fits.Header({"EXTNAME": "IMSHIFTS"}))
    return path


def packed(folder):
    path = plain(folder)
    target = path.with_name(f"{path.name}.gz")
    target.write_bytes(gzip.compress(path.read_bytes(), 1))
    path.unlink()
    return target


def peak(read):
    """Bytes that a call holds at most, of those that Python and numpy ask for."""
    gc.collect()
    tracemalloc.start()
    try:
        read()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("write", [plain, shifted, pytest.param(packed, marks=pytest.mark.slow)])
def test_means_take_at_most_one_and_a_half_times_their_file(tmp_path, monkeypatch, write):
    path, means = write(tmp_path), []
    frames = Observation.from_fits(path)  # What is imported and cached stays.
    assert len(frames) == MANY - 2
    monkeypatch.setattr(files, "_UNPACKED_IN_MEMORY_BYTES", 2**18)
    monkeypatch.setattr(integrations, "_PIXELS_AT_A_TIME", 2**16)
    assert peak(lambda: means.append(Observation.means_from_fits(path))) < 1.5 * BYTES
    (means,) = means
    assert means.count == MANY - 2
    assert means.remarks == frames.remarks
    # Each mean is that of the integrations of a pointing.
    parts = frames.pointings()
    assert sum(map(len, parts)) == len(frames)
    for k, part in enumerate(parts):
        expected = part.combined()
        assert means.integrations[k] == len(part)
        np.testing.assert_array_equal(means.valid[k], expected.valid[0])
        scale = np.abs(expected.data).max()
        np.testing.assert_allclose(means.data[k], expected.data[0], atol=1e-6 * scale)
        np.testing.assert_allclose(means.error[k], expected.error[0], rtol=1e-5)
        np.testing.assert_allclose(means.center[k], expected.center[0], atol=1e-9)
    if write is not shifted:
        np.testing.assert_allclose(means.combined().data, frames.combined().data, atol=1e-5)


@pytest.mark.usefixtures("offline")
def test_pyklip_datasets_take_about_twice_their_file(tmp_path, monkeypatch):
    """What pyKLIP holds itself included: its frames take a third of the file."""
    from pyklip.instruments.JWST import JWSTData

    from pyklip_diffrender.pyklip_backend import dataset_frames, source_frames

    monkeypatch.setattr(integrations, "_PIXELS_AT_A_TIME", 2**16)
    paths = [plain(tmp_path), calints(tmp_path / "warm.fits")]
    for path in paths:
        fits.setval(path, "CRVAL1", value=100.0, extname="SCI")
        fits.setval(path, "CRVAL2", value=20.0, extname="SCI")
    datasets = []

    def read(path):
        datasets.append(JWSTData([str(path)]))

    def gathered():
        dataset = datasets[-1]
        settings = dr.pyklip_backend.DiffrenderSettings()
        return dataset_frames.frames_of(dataset, dataset.input, settings)

    dr.register(opd="flat")
    try:
        read(paths[1])  # What is imported and cached stays.
        assert peak(lambda: read(paths[0])) < 2.2 * BYTES
        with pytest.warns(DiffrenderWarning, match="left out"):
            assert peak(gathered) < 2.5 * BYTES
    finally:
        dr.pyklip_backend.unregister()
    source = getattr(datasets[-1], source_frames.ATTRIBUTE)
    assert source.data.dtype == np.float32
    # A dataset keeps the means that a sequence has.
    (file,) = source.files.values()
    means = Observation.means_from_fits(paths[0])
    for name in ("data", "error", "valid", "center"):
        np.testing.assert_array_equal(getattr(file.frames, name), getattr(means, name))
    assert file.frames.integrations == means.integrations == (MANY - 2,)
    assert file.frames.noise_ratios == pytest.approx(means.noise_ratios)
    assert file.frames.remarks == means.remarks
