"""Damaged files: always an error of this package or the right result, never another exception."""

from __future__ import annotations

import numpy as np
import pytest
from fits_samples import READERS, calints, content, opd_map, outcome, same, sane, wavefront
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderError,
    DiffrenderWarning,
    ShapeError,
    UnitError,
)
from pyklip_diffrender.io import open_fits
from pyklip_diffrender.scene import Observation
from pyklip_diffrender.wavefront import read_opd

pytestmark = pytest.mark.hard

KINDS = tuple(READERS)

AS_THEY_COME = (Phase.explicit, Phase.generate)
"""Four bytes need no shrinking, which takes longer than the search."""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "damaged.fits"


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    for kind in KINDS:
        (folder / kind).write_bytes(content(kind))
    return {kind: READERS[kind](folder / kind) for kind in KINDS}


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
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_cut_anywhere(kind, packed, path, truth):
    """An error at every length but one: between extensions the file is whole without the last."""
    whole = content(kind, packed=packed)
    lengths = {*range(0, len(whole), max(163, len(whole) // 100)), *range(0, len(whole), 2880)}
    lengths |= {len(whole) * percent // 100 for percent in (25, 50, 99)} | {len(whole) - 1}
    accepted = []
    for length in sorted(lengths):
        result, warned = outcome(kind, path, whole[:length])
        if result is not None:
            assert warned
            assert same(result, truth[kind])
            accepted.append(length)
    # DQ, the last extension, has a header and a data block of 2880 bytes.
    expected = [len(whole) - 2 * 2880] if kind == "calints" and not packed else []
    assert accepted == expected


@pytest.mark.parametrize("kind", KINDS)
@settings(phases=AS_THEY_COME)
@given(data=st.data())
def test_bytes_changed_anywhere_end_in_an_error_or_a_usable_result(kind, path, data):
    """Nothing guards a plain file: a changed pixel is a changed pixel. But nothing else breaks."""
    result, _ = outcome(kind, path, data.draw(damages(kind)))
    assert result is None or sane(result)


@pytest.mark.parametrize("kind", KINDS)
@settings(phases=AS_THEY_COME)
@given(data=st.data())
def test_bytes_changed_in_a_gzipped_file_are_always_noticed(kind, path, truth, data):
    """gzip has a checksum; what is not under it (the name, the time) changes no number."""
    result, _ = outcome(kind, path, data.draw(damages(kind, packed=True)))
    assert result is None or same(result, truth[kind])


@pytest.mark.parametrize("kind", KINDS)
@settings(phases=AS_THEY_COME)
@given(data=st.data())
def test_bytes_changed_in_a_file_with_checksums_are_always_noticed(kind, path, truth, data):
    """One byte: in a sum of words, changes of several may cancel."""
    result, warned = outcome(kind, path, data.draw(damages(kind, most=1, checksum=True)))
    assert result is None or warned or same(result, truth[kind])


def test_a_changed_pixel_under_a_checksum_is_noticed(path):
    damaged = bytearray(content("opd", checksum=True))
    damaged[-2880 + 1000] ^= 0x10
    path.write_bytes(bytes(damaged))
    with pytest.raises(CorruptFileError, match="checksum"):
        read_opd(path)


@pytest.mark.parametrize("kind", ["opd", "calints"])
def test_a_header_edited_under_its_checksum_is_said(kind, path):
    """Editors of headers leave old sums behind; the data are whole."""
    whole = content(kind, checksum=True)
    path.write_bytes(whole.replace(b"2022-", b"2023-"))
    with pytest.warns(DiffrenderWarning, match=r"damaged\.fits.*CHECKSUM"):
        result = READERS[kind](path)
    assert result.date.iso.startswith("2023")


def test_a_card_without_a_value_counts_as_none(path):
    hdus = calints()
    for key in ("ROLL_REF", "CRPIX1"):
        hdus["SCI"].header[key] = None
    hdus[0].header["FILTER"] = None
    hdus[0].header["DATE-BEG"] = None
    hdus.writeto(path, overwrite=True)
    got = Observation.from_fits(path)
    assert (got.filter, got.date) == (None, None)
    np.testing.assert_array_equal(got.center, [[4.5, 3.5]] * 2)
    hdus["SCI"].header["BUNIT"] = None
    hdus.writeto(path, overwrite=True)
    with pytest.raises(UnitError, match=r"damaged\.fits"):
        Observation.from_fits(path)


def test_flags_that_are_no_integers_are_refused(path):
    calints(DQ=np.zeros((2, 8, 10))).writeto(path, overwrite=True)
    with pytest.raises(CorruptFileError, match=r"damaged\.fits: DQ holds float64"):
        Observation.from_fits(path)


@pytest.mark.parametrize(("name", "word"), [("SCI", "data"), ("ERR", "error"), ("DQ", "valid")])
def test_shapes_that_do_not_fit_are_said_with_the_file(name, word, path):
    dtype = np.uint32 if name == "DQ" else np.float32
    shape = (8,) if name == "SCI" else (8, 9)
    calints(**{name: np.ones(shape, dtype=dtype)}).writeto(path, overwrite=True)
    with pytest.raises(ShapeError, match=rf"damaged\.fits: {word}"):
        Observation.from_fits(path)


@pytest.mark.parametrize(
    ("kind", "old", "new"),
    [
        ("opd", b"DATE-OBS= '2022-08-11", b"DATE-OBS= '2022-88-11"),
        ("opd", b"BUNIT   = 'm       '", b"BUNIT   =  m       '"),
        ("calints", b"DATE-BEG= '2022-07-30", b"DATE-BEG= 'yesterday-"),
        ("calints", b"ROLL_REF=                100.0", b"ROLL_REF=                1=0.0"),
        ("calints", b"ROLL_REF=                100.0", b"ROLL_REF= 'a little'          "),
        ("calints", b"CRPIX1  =                  6.0", b"CRPIX1  = 'six'               "),
        ("calints", b"PIXAR_A2=              0.00396", b"PIXAR_A2= 'small'             "),
        ("calints", b"PIXAR_A2=              0.00396", b"PIXAR_A2=             -0.00396"),
        ("calints", b"PIXAR_A2=              0.00396", b"PIXAR_A2=              1.0E999"),
        ("calints", b"XTENSION= 'IMAGE   '", b"XTENSION  'IMAGE   '"),
        ("calints", b"EXTNAME = 'SCI     '", b"EXTNAME = 'SCI     /"),
        ("opd", b"NAXIS   =                    2", b"NAXIS   =                    A"),
        ("opd", b"NAXIS1  =                   16", b"NAXIS1  =               999916"),
        ("opd", b"BITPIX  =                  -64", b"BITPIX  =                  -63"),
        ("opd", b"BUNIT   = 'm       '", b"BUNIT   = 's       '"),
        ("calints", b"NAXIS   =                    3", b"NAXIS   =                   -3"),
        ("calints", b"NAXIS1  =                   10", b"NAXIS1  =                  -10"),
        ("calints", b"XTENSION= 'IMAGE   '", b"XTENSION= 'IMBGE   '"),
        ("calints", b"EXTNAME = 'SCI     '", b"EXTNAME = 'SKY     '"),
        ("calints", b"GCOUNT  =                    1", b"GCOUNT  =                    7"),
        ("calints", b"SIMPLE  =                    T", b"SIMPLE  =                    F"),
    ],
)
def test_a_damaged_card_is_an_error_of_this_package(kind, old, new, path):
    assert len(old) == len(new)
    assert old in content(kind)
    result, _ = outcome(kind, path, content(kind).replace(old, new))
    assert result is None


SHAPES = st.lists(st.integers(1, 5), min_size=1, max_size=4).map(tuple)


@given(shapes=st.tuples(SHAPES, SHAPES, SHAPES), equal=st.tuples(st.booleans(), st.booleans()))
def test_calints_of_any_shapes(shapes, equal, path):
    """Right if all three are the same two or three axes, else an error."""
    science = shapes[0]
    error, quality = (science if e else s for e, s in zip(equal, shapes[1:], strict=True))
    rng = np.random.default_rng(3)
    planes = {
        "SCI": rng.normal(size=science), "ERR": rng.uniform(1, 2, size=error),
        "DQ": np.zeros(quality, dtype=np.uint32),
    }  # fmt: skip
    calints(**planes).writeto(path, overwrite=True)
    result, _ = outcome("calints", path, path.read_bytes())

    def stack(shape):
        return (1, *shape) if len(shape) == 2 else shape

    fits_together = stack(science) == stack(error) == stack(quality) and len(stack(science)) == 3
    assert (result is not None) == fits_together
    if isinstance(result, Observation):
        np.testing.assert_array_equal(result.data, planes["SCI"].reshape(stack(science)))
        assert result.valid.all()


@given(shape=SHAPES)
def test_maps_of_any_shape(shape, path):
    data = 1e-7 * np.random.default_rng(3).normal(size=shape)
    opd_map(data).writeto(path, overwrite=True)
    result, _ = outcome("opd", path, path.read_bytes())
    # One sample is a map that is constant, which is refused.
    assert (result is not None) == (len(shape) == 2 and shape[0] == shape[-1] > 1)
    if result is not None:
        np.testing.assert_array_equal(result.data, data)


@given(names=st.permutations(["SCI", "ERR", "DQ", "AREA"]), keep=st.integers(0, 4))
def test_extensions_in_any_order_or_missing(names, keep, path, truth):
    hdus = calints(AREA=np.ones((8, 10), dtype=np.float32))
    type(hdus)([hdus[0], *(hdus[name] for name in names[:keep])]).writeto(path, overwrite=True)
    result, warned = outcome("calints", path, path.read_bytes())
    there = set(names[:keep])
    assert (result is not None) == ({"SCI", "ERR"} <= there)
    if result is not None:
        assert same(result, truth["calints"])
        assert warned == ("DQ" not in there)


@pytest.mark.parametrize("name", ["SCI", "ERR", "DQ"])
def test_a_table_in_the_place_of_an_image(name, path):
    from astropy.io import fits

    hdus = calints()
    column = fits.Column("A", "D", array=np.arange(4.0))
    table = fits.BinTableHDU.from_columns([column], name=name)
    kept = [table if hdu.name == name else hdu for hdu in hdus]
    fits.HDUList(kept).writeto(path, overwrite=True)
    with pytest.raises(DiffrenderError, match=rf"damaged\.fits: {name} is a table"):
        Observation.from_fits(path)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.int64, np.float32, np.float64])
def test_pixels_of_any_type(dtype, path):
    """Unsigned types come as scaled signed ones."""
    data = (np.arange(160) % 100).reshape(2, 8, 10).astype(dtype)
    calints(SCI=data, DQ=np.zeros(data.shape, dtype=np.uint16)).writeto(path, overwrite=True)
    got = Observation.from_fits(path)
    np.testing.assert_array_equal(got.data, data.astype(np.float64))


def test_reading_leaves_the_file_as_it_was(path):
    for kind in KINDS:
        path.write_bytes(content(kind))
        with open_fits(path) as hdus:
            hdus[0].header["CHANGED"] = True
            if hdus[0].data is not None:
                hdus[0].data[:] = 0
        assert path.read_bytes() == content(kind)
        assert kind != "opd" or np.array_equal(read_opd(path).data, wavefront())
