"""FITS files by their suffix, and configurations with a byte-order mark."""

import gzip

import numpy as np
import pytest
from astropy.io import fits
from survey_stubs import configuration, inputs

import pyklip_diffrender as dr
from benchmarks.calints_files import calints
from pyklip_diffrender.io.files import fits_files, is_fits_name
from pyklip_diffrender.pattern import PatternLibrary, package_library
from pyklip_diffrender.scene.admission import exposures_in
from pyklip_diffrender.surveys.config import read_config
from pyklip_diffrender.surveys.jobs import jobs_of
from pyklip_diffrender.wavefront import random_opd
from pyklip_diffrender.wavefront.opd import choose_opd

SUFFIXES = (".fits", ".fit", ".fts", ".FITS", ".Fit", ".fits.gz", ".FITS.GZ", ".fit.gz", ".fits.fz")
MARK = "\N{ZERO WIDTH NO-BREAK SPACE}"


def renamed(path, suffix):
    """The same content in a file with another suffix, packed as the suffix says."""
    target = path.with_name(path.name.removesuffix(".fits") + suffix)
    if suffix.lower().endswith(".fz"):
        with fits.open(path, memmap=False) as hdus:
            packed = [
                fits.CompImageHDU(hdu.data, hdu.header, compression_type="GZIP_1", quantize_level=0)
                if hdu.is_image and np.ndim(hdu.data) > 1
                else hdu
                for hdu in hdus
            ]
            if packed[0] is not hdus[0]:
                packed.insert(0, fits.PrimaryHDU())
            fits.HDUList(packed).writeto(target, checksum=True)
        path.unlink()
    elif suffix.lower().endswith(".gz"):
        target.write_bytes(gzip.compress(path.read_bytes(), 1))
        path.unlink()
    else:
        path.rename(target)
    return target


def frames_of(folder, suffix):
    path = renamed(calints(folder / "a_calints.fits"), suffix)
    (each,) = exposures_in(folder)
    assert each.path == path
    assert each.exposure.filter == "F444W"
    assert each.observation is not None
    return each.observation.data.sum()


def map_of(folder, suffix):
    data, header = random_opd(1, npix=32).data * 1e9, fits.Header({"BUNIT": "nm"})
    fits.writeto(folder / "opd_2022-08-01.fits", data, header)
    renamed(folder / "opd_2022-08-01.fits", suffix)
    return choose_opd(folder, "2022-08-02").data.std()


def library_of(folder, suffix):
    PatternLibrary(package_library().patterns[:1]).write(folder / "one.fits")
    renamed(folder / "one.fits", suffix)
    return PatternLibrary.read(folder).patterns[0].value.sum()


def jobs_in(folder, suffix):
    path = renamed(calints(folder / "a_calints.fits"), suffix)
    content = {"sequence": [{"files": str(folder), "opd": "flat"}]}
    (job,) = jobs_of(read_config(content))
    return job.files == (str(path),)


@pytest.mark.parametrize("suffix", [".fit", ".FITS.GZ", ".fits.fz"])
@pytest.mark.parametrize("read", [frames_of, map_of, library_of, jobs_in])
def test_a_folder_is_read_whatever_the_suffix_of_its_files(tmp_path, suffix, read):
    for name in ("usual", "other"):
        (tmp_path / name).mkdir()
    usual, other = read(tmp_path / "usual", ".fits"), read(tmp_path / "other", suffix)
    assert usual
    assert other == pytest.approx(usual, rel=1e-12)


def test_other_files_are_no_fits_files(tmp_path):
    names = ["a.fits.txt", "fits", "a.fitsx", "a.gz", "._a.fits", ".a.fits.1f.fits", "b.ft"]
    for name in names:
        (tmp_path / name).touch()
    (tmp_path / "folder.fits").mkdir()
    assert fits_files(tmp_path) == []
    assert not any(is_fits_name(name) for name in names[:4])
    assert all(is_fits_name(f"a{suffix}") for suffix in SUFFIXES)


def test_a_file_and_its_packed_copy_are_one(tmp_path):
    copy = renamed(calints(tmp_path / "a_calints.fits"), ".fits.fz")
    path = calints(tmp_path / "a_calints.fits")
    sequence = dr.ExposureSequence.from_files([path, copy])
    assert len(sequence.science) == 1
    assert "the same file as a_calints" in sequence.excluded[0][1]


def test_configurations_may_begin_with_a_byte_order_mark(tmp_path):
    path = configuration(tmp_path / "survey.toml", inputs(tmp_path / "data"))
    plain = read_config(path)
    path.write_text(MARK + path.read_text(encoding="utf-8"), encoding="utf-8")
    assert read_config(path) == plain
