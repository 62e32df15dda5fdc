"""The gates for numbers and files: units, byte order, broken files, keywords, whole products."""

import gzip
import json
import math
import os
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable

from pyklip_diffrender import io
from pyklip_diffrender.errors import CorruptFileError, NonFiniteError
from pyklip_diffrender.io.headers import KEYWORDS, fits_unit, set_keyword
from pyklip_diffrender.io.tables import add_columns, plain_rows

ROOT = Path(__file__).resolve().parents[1]


def written(path):
    data = np.arange(64 * 64, dtype=np.float32).reshape(64, 64)
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(data, name="A"), fits.ImageHDU(-data, name="B")]
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.hard
@pytest.mark.parametrize(
    "dress",
    [
        lambda a, path: a.astype(">f4"),
        lambda a, path: np.asfortranarray(a),
        lambda a, path: np.repeat(a, 2, axis=1)[:, ::2],
        lambda a, path: torch.from_numpy(a).requires_grad_(),
        lambda a, path: a.tolist(),
        lambda a, path: np.memmap(path, dtype=">f8", mode="r", shape=a.shape),
    ],
    ids=["f4be", "fortran", "strided", "tensor", "list", "read-only map"],
)
def test_every_kind_of_array_becomes_the_same_native_copy(dress, tmp_path):
    # Multiples of 1/4 below 2^14: exact in every type that is tried.
    plain = np.arange(-24, 24, dtype=np.float64).reshape(6, 8) / 4
    plain.astype(">f8").tofile(tmp_path / "map.dat")
    value = dress(plain.copy(), tmp_path / "map.dat")
    got = io.native_float64(value)
    np.testing.assert_array_equal(got, plain)
    assert got.dtype == np.dtype("=f8")
    assert got.dtype.isnative
    assert got.flags.c_contiguous
    assert not isinstance(got, np.memmap)
    torch.from_numpy(got)[:] = 7
    io.to_metres(value, "x")[:] = 7
    # What was given stays as it is.
    np.testing.assert_array_equal(io.native_float64(value), plain)


def test_values_that_are_not_finite_are_counted_and_located():
    array = np.zeros((5, 6))
    array[2, 3], array[4, 1], array[0, 5] = np.nan, np.inf, -np.inf
    with pytest.raises(NonFiniteError, match=r"map: 3 values.*\(0, 5\)"):
        io.require_finite(array, "map")
    with pytest.raises(NonFiniteError, match=r"map: 2 values.*\(2, 3\)"):
        io.require_finite(array, "map", np.arange(30).reshape(5, 6) > 11)


@pytest.mark.parametrize("suffix", [".fits", ".fits.gz"])
def test_a_truncated_file_is_an_error_that_names_it(tmp_path, suffix):
    path = written(tmp_path / f"cut{suffix}")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 99 // 100])
    complaint = pytest.raises(CorruptFileError, match=r"cut\.fits.*not a complete FITS file")
    with complaint as caught, io.open_fits(path):
        pass
    assert isinstance(caught.value, OSError)
    assert str(path.stat().st_size) in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"this is no FITS file\n" * 300, gzip.compress(b"no", mtime=0)]
)
def test_what_is_not_fits_is_a_corrupt_file(tmp_path, content):
    path = tmp_path / "other.fits"
    path.write_bytes(content)
    with pytest.raises(CorruptFileError, match=r"other\.fits"), io.open_fits(path):
        pass


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    for path in (tmp_path / "nowhere.fits", tmp_path):
        with pytest.raises(CorruptFileError, match=path.name), io.open_fits(path):
            pass
        # As other libraries have it.
        with pytest.raises(FileNotFoundError), io.open_fits(path):
            pass


def test_an_unusual_but_complete_header_is_no_corruption(tmp_path):
    """BLANK on floats is against the standard, common, and harmless: astropy only warns."""
    path = tmp_path / "blank.fits"
    hdu = fits.PrimaryHDU(np.ones((4, 4), dtype=np.float32))
    hdu.writeto(path)
    # Put in by hand, for astropy would not write it.
    raw = bytearray(path.read_bytes())
    end = raw.index(b"END" + b" " * 77)
    raw[end : end + 160] = b"BLANK   =                -9999".ljust(80) + b"END".ljust(80)
    path.write_bytes(bytes(raw))
    with pytest.warns(fits.verify.VerifyWarning, match="BLANK"), io.open_fits(path) as hdus:
        assert hdus[0].data.sum() == 16.0


@pytest.mark.parametrize("suffix", [".fits", ".fits.gz"])
def test_a_written_file_reads_back_and_leaves_nothing_else(tmp_path, suffix):
    path = tmp_path / "new" / f"product{suffix}"
    data = np.arange(12.0).reshape(3, 4)
    for scale in (1, 2):
        io.write_fits(fits.HDUList([fits.PrimaryHDU(scale * data)]), path)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    assert (path.read_bytes()[:2] == b"\x1f\x8b") == (suffix == ".fits.gz")
    with io.open_fits(path) as hdus:
        kept = hdus[0].data
    np.testing.assert_array_equal(kept, 2 * data)


@pytest.fixture
def umask():
    """Sets the process's umask, and puts it back."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


def permissions(path):
    return path.stat().st_mode & 0o777


@pytest.mark.parametrize("suffix", [".fits", ".txt"])
def test_a_new_product_has_the_permissions_of_any_new_file(tmp_path, umask, suffix):
    """astropy makes its own file in the place of the temporary one, other writers do not."""
    for mask, expected in ((0o027, 0o640), (0o022, 0o644), (0o077, 0o600)):
        path = tmp_path / f"{mask:o}{suffix}"
        umask(mask)
        if suffix == ".fits":
            io.write_fits(fits.HDUList([fits.PrimaryHDU()]), path)
        else:
            with io.replacing(path) as temporary:
                temporary.write_text("new")
        assert permissions(path) == expected


def test_a_replaced_product_keeps_its_permissions(tmp_path, umask):
    path = written(tmp_path / "product.fits")
    umask(0o022)
    for mode in (0o660, 0o444, 0o600):
        path.chmod(mode)
        io.write_fits(fits.HDUList([fits.PrimaryHDU()]), path)
        assert permissions(path) == mode


def test_two_threads_that_write_one_product_leave_one_of_the_two(tmp_path):
    """Each has a temporary file of its own."""
    path, both = tmp_path / "product.txt", threading.Barrier(2)

    def write(word):
        with io.replacing(path) as temporary:
            both.wait(10)
            temporary.write_text(1000 * word)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, ["a", "b"]))
    assert path.read_text() in (1000 * "a", 1000 * "b")
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_while_writing_leaves_the_old_file(tmp_path):
    path = tmp_path / "product.txt"
    path.write_text("old")

    def write_half():
        with io.replacing(path) as temporary:
            temporary.write_text("ne")
            raise RuntimeError("halfway")

    with pytest.raises(RuntimeError, match="halfway"):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


HALF_WRITTEN = """
import sys, time
from pyklip_diffrender.io.files import replacing
with replacing(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half")
    # The test waits for this line, and kills the process while the file is half written.
    print("writing", flush=True)
    time.sleep(60)
"""


@pytest.mark.hard
def test_a_process_killed_while_writing_leaves_the_old_product_intact(tmp_path):
    path = written(tmp_path / "product.fits")
    before = io.sha256(path)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", HALF_WRITTEN, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout.readline() == b"writing\n"
        process.kill()
    assert io.sha256(path) == before


def test_every_keyword_that_is_written_is_declared():
    """By texts of the package's modules that look like keywords of its own."""
    modules = (ROOT / "pyklip_diffrender").rglob("*.py")
    texts = [each.read_text(encoding="utf-8") for each in modules if each.name != "keywords.py"]
    written = set(re.findall(r"['\"](DR[A-Z0-9]{2,6})['\"]", "\n".join(texts)))
    # The names of a position and its error are formed from their beginning.
    formed = {f"DRFM{axis}{end}" for axis in ("RA", "DE") for end in ("", "ER")}
    assert written - {"DRFM"} | formed == set(KEYWORDS)


def test_keywords_fit_on_cards():
    assert all(len(name) <= 8 for name in KEYWORDS)
    header = fits.Header()
    for name, each in KEYWORDS.items():
        set_keyword(header, name, 1.5)
        assert header.comments[name] == each.comment
        assert each.comment or each.meaning
        assert set(each.files.split(", ")) <= {"reduce", "pyKLIP", "psf"}
    assert len(header.tostring()) % 2880 == 0


def test_values_are_such_as_headers_can_hold():
    header = fits.Header()
    set_keyword(header, "DRCHI2", math.nan)
    set_keyword(header, "DRPATTRN", "Übersicht β")
    assert (header["DRCHI2"], header["DRPATTRN"]) == ("nan", "Ubersicht ?")
    with pytest.raises(KeyError, match="DROPDNAM"):
        set_keyword(header, "DROPDNAM", "map.fits")


@pytest.mark.parametrize(
    ("unit", "text"), [("MJy sr-1", "MJy/sr"), ("electron / s", "electron / s"), ("", "")]
)
def test_units_are_spelled_as_the_pipeline_does(unit, text):
    assert fits_unit(u.Unit(unit)) == text
    assert u.Unit(text) == u.Unit(unit)


def test_columns_say_what_they_are_and_rows_are_json():
    columns = [
        ("place", np.array([0.5, np.inf]), u.arcsec, ".2f", "from the star"),
        ("light", np.array([12.0, np.nan]), u.mag, "", ""),
        ("count", np.array([3, 4]), None, "", ""),
        ("seen", np.array([True, False]), None, "", ""),
        ("name", np.array(["a", ""]), None, "", "of the source"),
    ]
    table = add_columns(QTable(meta={"sigmas": 5}), columns)
    assert (table.meta, table["place"].unit) == ({"sigmas": 5}, u.arcsec)
    place = table["place"].info
    assert (place.format, place.description) == (".2f", "from the star")
    assert (table["light"].info.format, table["light"].info.description) == (None, None)
    rows = plain_rows(table)
    # Numbers of numpy are no JSON, and NaN and infinity are not either.
    assert json.loads(json.dumps(rows, allow_nan=False)) == [
        {"place_arcsec": 0.5, "light": 12.0, "count": 3, "seen": True, "name": "a"},
        {"place_arcsec": None, "light": None, "count": 4, "seen": False, "name": ""},
    ]
