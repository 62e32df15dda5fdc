"""Damaged files: always an error of this package or the right result, never another exception."""

import gzip
import io
import warnings
from functools import lru_cache

import numpy as np
import pytest
import small_files
from astropy.io import fits
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from benchmarks.fuzz_intake import make_frames, run
from pyklip_diffrender import errors
from pyklip_diffrender.errors import CorruptFileError, DiffrenderError
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront import OPDMap, random_opd
from pyklip_diffrender.wavefront.opd import read_opd

pytestmark = pytest.mark.hard

READERS = {"opd": read_opd, "calints": Observation.from_fits}


@lru_cache(maxsize=1)
def wavefront():
    """16 x 16 samples, m."""
    return random_opd(5, npix=16).data


def opd_map():
    """An OPD map."""
    hdu = fits.PrimaryHDU(wavefront())
    hdu.header.update({"BUNIT": "m", "DATE-OBS": "2022-08-11T01:02:03"})
    return fits.HDUList([hdu])


def calints(science=None, error=None, quality=None):
    """Two frames of 8 x 10; SCI, ERR or DQ may be given."""
    if science is None:
        science = np.random.default_rng(1).normal(10, 2, (2, 8, 10)).astype(np.float32)
    error = np.ones((2, 8, 10), dtype=np.float32) if error is None else error
    quality = np.zeros((2, 8, 10), dtype=np.uint32) if quality is None else quality
    stream = small_files.calints(io.BytesIO(), science, error, quality)
    stream.seek(0)
    return fits.open(stream)


@lru_cache(maxsize=16)
def content(kind, checksum=False, packed=False):
    """The bytes of a whole file."""
    stream = io.BytesIO()
    {"opd": opd_map, "calints": calints}[kind]().writeto(stream, checksum=checksum)
    return gzip.compress(stream.getvalue(), mtime=0) if packed else stream.getvalue()


def outcome(kind, path, damaged):
    """Read a damaged file: (result, whether there was a warning), or (None, True) for an error.

    Errors that are not the package's own go through.
    """
    path.write_bytes(damaged)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            return READERS[kind](path), bool(caught)
        except DiffrenderError as error:
            if isinstance(error, CorruptFileError) and path.name not in str(error):
                raise AssertionError("the message does not name the file") from error
            return None, True


def _arrays(result):
    if isinstance(result, OPDMap):
        return [result.data]
    return [result.data, result.error, result.valid, result.center, np.array(result.pixelscale)]


def same(result, truth):
    """Whether two results are the same in all numbers."""
    pairs = zip(_arrays(result), _arrays(truth), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs) and result.date == truth.date


def sane(result):
    """Whether a result is one that everything behind the reader can take."""
    finite = all(np.isfinite(a).all() for a in _arrays(result))
    if isinstance(result, OPDMap):
        return finite and result.data.ndim == 2 and result.data.dtype == np.dtype("=f8")
    shapes = {result.data.shape, result.error.shape, result.valid.shape}
    good = len(shapes) == 1 and result.data.ndim == 3 and bool((result.error > 0).all())
    return finite and good and min(result.pixelscale) > 0


KINDS = pytest.mark.parametrize("kind", READERS)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "damaged.fits"


@pytest.fixture(scope="module")
def truth(path):
    return {kind: outcome(kind, path, content(kind))[0] for kind in READERS}


def damages(kind, most=4, **how):
    """One to `most` bytes changed: half of them to what headers are made of, at any place."""
    whole = content(kind, **how)
    used = [k for k in range(len(whole)) if whole[k : k + 1] not in (b" ", b"\0")]
    place = st.one_of(st.sampled_from(used), st.integers(0, len(whole) - 1))
    byte = st.one_of(st.sampled_from(b"0123456789'=-./ ATFENZe"), st.integers(0, 255))

    def change(flips):
        damaged = bytearray(whole)
        for where, value in flips:
            damaged[where] = value
        return bytes(damaged)

    return st.lists(st.tuples(place, byte), min_size=1, max_size=most).map(change)


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzipped"])
@KINDS
def test_a_file_cut_anywhere(kind, packed, path, truth):
    """An error at every length but one: between extensions the file is whole without the last."""
    whole = content(kind, packed=packed)
    lengths = {*range(0, len(whole), max(163, len(whole) // 100)), *range(0, len(whole), 2880)}
    accepted = []
    for length in sorted(lengths | {len(whole) - 1}):
        result, warned = outcome(kind, path, whole[:length])
        if result is not None:
            assert warned
            assert same(result, truth[kind])
            accepted.append(length)
    # DQ, the last extension, has a header and a data block of 2880 bytes.
    expected = [len(whole) - 2 * 2880] if kind == "calints" and not packed else []
    assert accepted == expected


@KINDS
# Four bytes need no shrinking, which takes longer than the search.
@settings(phases=(Phase.explicit, Phase.generate))
@given(data=st.data())
def test_bytes_changed_anywhere_end_in_an_error_or_a_usable_result(kind, path, truth, data):
    """Nothing guards a plain file: a changed pixel is a changed pixel. But nothing else breaks.

    gzip has a checksum; what is not under it (the name, the time) changes no number. Under a FITS
    checksum one byte: in a sum of words, changes of several may cancel.
    """
    result, _ = outcome(kind, path, data.draw(damages(kind)))
    assert result is None or sane(result)
    result, _ = outcome(kind, path, data.draw(damages(kind, packed=True)))
    assert result is None or same(result, truth[kind])
    result, warned = outcome(kind, path, data.draw(damages(kind, most=1, checksum=True)))
    assert result is None or warned or same(result, truth[kind])


def test_a_changed_pixel_under_a_checksum_is_noticed(path):
    damaged = bytearray(content("opd", checksum=True))
    damaged[-2880 + 1000] ^= 0x10
    path.write_bytes(bytes(damaged))
    with pytest.raises(errors.CorruptFileError, match="checksum"):
        read_opd(path)


@KINDS
def test_a_header_edited_under_its_checksum_is_said(kind, path):
    """Editors of headers leave old sums behind; the data are whole."""
    path.write_bytes(content(kind, checksum=True).replace(b"2022-", b"2023-"))
    with pytest.warns(errors.DiffrenderWarning, match=r"damaged\.fits.*CHECKSUM"):
        result = READERS[kind](path)
    assert result.date.iso.startswith("2023")


def test_a_card_without_a_value_counts_as_none(path):
    hdus = calints()
    for key in ("ROLL_REF", "CRPIX1"):
        hdus["SCI"].header[key] = None
    hdus[0].header.update({"FILTER": None, "DATE-BEG": None})
    hdus.writeto(path, overwrite=True)
    got = Observation.from_fits(path)
    assert (got.filter, got.date) == (None, None)
    np.testing.assert_array_equal(got.center, [[4.5, 3.5]] * 2)
    hdus["SCI"].header["BUNIT"] = None
    hdus.writeto(path, overwrite=True)
    with pytest.raises(errors.UnitError, match=r"damaged\.fits"):
        Observation.from_fits(path)


def with_table(name):
    """The file with a table in the place of an image."""
    table = fits.BinTableHDU.from_columns([fits.Column("A", "D", array=np.arange(4.0))], name=name)
    return fits.HDUList([table if hdu.name == name else hdu for hdu in calints()])


@pytest.mark.parametrize(
    ("hdus", "error", "words"),
    [
        (calints(quality=np.zeros((2, 8, 10))), errors.CorruptFileError, "DQ holds float64"),
        (calints(np.ones(8)), errors.ShapeError, "data"),
        (calints(error=np.ones((8, 9))), errors.ShapeError, "error"),
        (calints(quality=np.ones((8, 9), dtype=np.uint32)), errors.ShapeError, "valid"),
        *((with_table(k), errors.DiffrenderError, f"{k} is a table") for k in ("SCI", "ERR", "DQ")),
    ],
)
def test_planes_that_are_no_images_or_do_not_fit_are_said_with_the_file(hdus, error, words, path):
    hdus.writeto(path, overwrite=True)
    with pytest.raises(error, match=rf"damaged\.fits: {words}"):
        Observation.from_fits(path)


@pytest.mark.parametrize(
    ("kind", "old", "new"),
    [
        ("opd", b"DATE-OBS= '2022-08-11", b"DATE-OBS= '2022-88-11"),
        ("opd", b"BUNIT   = 'm       '", b"BUNIT   =  m       '"),
        ("opd", b"BUNIT   = 'm       '", b"BUNIT   = 's       '"),
        ("opd", b"NAXIS   =                    2", b"NAXIS   =                    A"),
        ("opd", b"NAXIS1  =                   16", b"NAXIS1  =               999916"),
        ("calints", b"DATE-BEG= '2022-07-30", b"DATE-BEG= 'yesterday-"),
        ("calints", b"ROLL_REF=                100.0", b"ROLL_REF=                1=0.0"),
        ("calints", b"ROLL_REF=                100.0", b"ROLL_REF= 'a little'          "),
        ("calints", b"CRPIX1  =                  6.0", b"CRPIX1  = 'six'               "),
        ("calints", b"PIXAR_A2=              0.00396", b"PIXAR_A2=             -0.00396"),
        ("calints", b"PIXAR_A2=              0.00396", b"PIXAR_A2=              1.0E999"),
        ("calints", b"XTENSION= 'IMAGE   '", b"XTENSION  'IMAGE   '"),
        ("calints", b"EXTNAME = 'SCI     '", b"EXTNAME = 'SCI     /"),
        ("calints", b"NAXIS   =                    3", b"NAXIS   =                   -3"),
    ],
)
def test_a_damaged_card_is_an_error_of_this_package(kind, old, new, path):
    assert len(old) == len(new)
    assert old in content(kind)
    result, _ = outcome(kind, path, content(kind).replace(old, new))
    assert result is None


SHAPES = st.lists(st.integers(1, 5), min_size=1, max_size=4).map(tuple)


@given(shapes=st.tuples(SHAPES, SHAPES, SHAPES), equal=st.tuples(st.booleans(), st.booleans()))
@example(shapes=((5, 1, 4), (5,), (5,)), equal=(False, False))
def test_calints_of_any_shapes(shapes, equal, path):
    """Right if all three are the same two or three axes, else an error."""
    science = shapes[0]
    error, quality = (s if k else science for s, k in zip(shapes[1:], equal, strict=True))
    rng = np.random.default_rng(3)
    data, noise = rng.normal(size=science), rng.uniform(1, 2, size=error)
    calints(data, noise, np.zeros(quality, dtype=np.uint32)).writeto(path, overwrite=True)
    result, _ = outcome("calints", path, path.read_bytes())
    stacks = {(1, *shape) if len(shape) == 2 else shape for shape in (science, error, quality)}
    assert (result is not None) == (len(stacks) == 1 and len(max(stacks)) == 3)
    if result is not None:
        np.testing.assert_array_equal(result.data, data.reshape(*stacks))
        assert result.valid.all()


@given(names=st.permutations(["SCI", "ERR", "DQ", "AREA"]), keep=st.integers(0, 4))
def test_extensions_in_any_order_or_missing(names, keep, path, truth):
    hdus = calints()
    hdus.append(fits.ImageHDU(np.ones((8, 10), dtype=np.float32), name="AREA"))
    fits.HDUList([hdus[0], *(hdus[k] for k in names[:keep])]).writeto(path, overwrite=True)
    result, warned = outcome("calints", path, path.read_bytes())
    assert (result is not None) == ({"SCI", "ERR"} <= set(names[:keep]))
    if result is not None:
        assert same(result, truth["calints"])
        assert warned == ("DQ" not in names[:keep])


@pytest.mark.slow
@pytest.mark.parametrize(("real", "folders"), [(False, 15), (True, 5)], ids=["simulated", "real"])
def test_no_folder_is_silently_wrong(tmp_path, real, folders, request):
    source = request.getfixturevalue("shared_data") / "gto1184" if real else None
    frames = make_frames(tmp_path / "untouched", source)
    records = run(frames, range(1000, 1000 + folders))
    assert [
        each for each in records if each["outcome"] in ("wrong", "wrongly refused", "crash")
    ] == []
    assert all(each["message"] for each in records if each["outcome"] in ("excluded", "refused"))


def test_the_untouched_folder_is_used_entirely(tmp_path):
    """The check itself sees a frame that is used wrongly."""
    frames = make_frames(tmp_path / "untouched")
    (record,) = run(frames, [0])
    assert record["outcome"] != "wrong"
    assert record["mutations"]
