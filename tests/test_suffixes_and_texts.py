"""FITS files by their suffix, and texts with a byte-order mark, wherever files are read."""

from __future__ import annotations

import ast
import gzip
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from survey_stubs import configuration, inputs

import pyklip_diffrender as dr
from benchmarks.calints_files import calints
from pyklip_diffrender.cli.application import application
from pyklip_diffrender.cli.session import read_config as command_config
from pyklip_diffrender.instrument.spectrum import read_spectrum
from pyklip_diffrender.io.files import fits_files, is_fits_name
from pyklip_diffrender.pattern import PatternLibrary, package_library
from pyklip_diffrender.scene.admission import exposures_in
from pyklip_diffrender.surveys.config import read_config
from pyklip_diffrender.surveys.jobs import jobs_of
from pyklip_diffrender.wavefront import choose_map, random_opd

ROOT = Path(__file__).resolve().parents[1]

SUFFIXES = (".fits", ".fit", ".fts", ".FITS", ".Fit", ".fits.gz", ".FITS.GZ", ".fit.gz", ".fits.fz")
QUICK = (".fit", ".FITS.GZ", ".fits.fz")
"""The others need ``--full``."""

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
    observation = each.read()
    assert observation is not None, each.reason
    return observation.data.sum()


def map_of(folder, suffix):
    hdu = fits.PrimaryHDU(random_opd(1, npix=32).data * 1e9, fits.Header({"BUNIT": "nm"}))
    hdu.writeto(folder / "opd_2022-08-01.fits")
    renamed(folder / "opd_2022-08-01.fits", suffix)
    return choose_map(folder, "2022-08-02").data.std()


def library_of(folder, suffix):
    PatternLibrary(package_library().patterns[:1]).write(folder / "one.fits")
    renamed(folder / "one.fits", suffix)
    return PatternLibrary.read(folder).patterns[0].value.sum()


def jobs_in(folder, suffix):
    path = renamed(calints(folder / "a_calints.fits"), suffix)
    content = {"sequence": [{"files": str(folder), "opd": "flat"}]}
    (job,) = jobs_of(read_config(content))
    return job.files == (str(path),)


@pytest.mark.parametrize(
    "suffix",
    [pytest.param(s, marks=() if s in QUICK else pytest.mark.slow) for s in SUFFIXES],
)
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


@pytest.mark.parametrize("packed", [".fits.gz", ".fits.fz"])
def test_a_file_and_its_packed_copy_are_one(tmp_path, packed):
    (tmp_path / "copy").mkdir()
    renamed(calints(tmp_path / "copy" / "a_calints.fits"), packed).rename(
        tmp_path / f"a_calints{packed}"
    )
    path = calints(tmp_path / "a_calints.fits")
    sequence = dr.Sequence.from_files([path, tmp_path / f"a_calints{packed}"])
    assert len(sequence.science) == 1
    assert "the same file as a_calints" in sequence.excluded[0][1]


def test_only_one_module_knows_the_suffixes():
    """Lists of suffixes that are not in `io.files` miss some of them."""
    for path in (ROOT / "pyklip_diffrender").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Tuple | ast.List):
                words = [each.value for each in node.elts if isinstance(each, ast.Constant)]
                assert not {".fits", ".fits.gz", ".fit"} & set(map(str, words)), path


def test_texts_are_read_by_one_function():
    """It takes byte-order marks. Files of the system's and the package's own have none."""
    for path in (ROOT / "pyklip_diffrender").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                own = ast.unparse(node.func.value).startswith(("Path('/proc", "style", "source"))
                is_text = node.func.attr in ("read_text", "loadtxt", "genfromtxt")
                first = ast.unparse(node.args[0]) if node.args else ""
                right = own or path.name == "files.py" or first.startswith("read_text(")
                assert not is_text or right, f"{path}:{node.lineno}"


def spectrum_as_text(path):
    path.write_text(f"{MARK}# um Jy\n1 2\n2 0.8\n3 0.4\n4 0.3\n5 0.2\n6 0.1\n", encoding="utf-8")
    return path


def spectrum_without_comment(path):
    path.write_text(f"{MARK}1 2\r\n2 0.8\r\n3 0.4\r\n4 0.3\r\n5 0.2\r\n6 0.1\r\n", encoding="utf-8")
    return path


def spectrum_as_ecsv(path):
    path = path.with_suffix(".ecsv")
    QTable({"w": [1, 2, 3, 4, 5, 6.0], "f": [2, 0.8, 0.4, 0.3, 0.2, 0.1]}).write(path)
    path.write_text(MARK + path.read_text(encoding="utf-8"), encoding="utf-8")
    return path


def spectrum_as_votable(path):
    path = path.with_suffix(".vot")
    frequency = 299792.458 / np.array([6, 5, 4, 3, 2, 1.0])  # GHz
    table = QTable({"sed_freq": frequency, "sed_flux": [0.1, 0.2, 0.3, 0.4, 0.8, 2.0]})
    table.write(path, format="votable")
    path.write_text(MARK + path.read_text(encoding="utf-8"), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "write", [spectrum_as_text, spectrum_without_comment, spectrum_as_ecsv, spectrum_as_votable]
)
def test_a_spectrum_may_begin_with_a_byte_order_mark(tmp_path, write):
    wavelength, flux = read_spectrum(write(tmp_path / "star.txt"))
    np.testing.assert_allclose(wavelength, [1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6], rtol=1e-6)
    np.testing.assert_allclose(flux, [2, 0.8, 0.4, 0.3, 0.2, 0.1])


def test_configurations_may_begin_with_a_byte_order_mark(tmp_path):
    path = configuration(tmp_path / "survey.toml", inputs(tmp_path / "data"))
    plain = read_config(path)
    path.write_text(MARK + path.read_text(encoding="utf-8"), encoding="utf-8")
    assert read_config(path) == plain
    config = tmp_path / "run.toml"
    config.write_text(f"{MARK}quiet = true\n[psf]\nsize = 20\n", encoding="utf-8")
    assert command_config(application.commands["psf"], config)["size"] == 20
