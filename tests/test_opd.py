"""OPD maps: units, broken and odd files, and the seeded generators."""

import hashlib

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import fits

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    NonFiniteError,
    ShapeError,
    UnitError,
)
from pyklip_diffrender.instrument.masks import jwst_pupil
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.io import sha256
from pyklip_diffrender.optics.grid import PupilGrid, resample
from pyklip_diffrender.pyklip_backend import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.backend_settings import starting_opd
from pyklip_diffrender.wavefront import random_opd
from pyklip_diffrender.wavefront.bases import SegmentMotions
from pyklip_diffrender.wavefront.opd import as_opd_map, opd_for, random_drift, read_opd

NPIX = 96
PUPIL = jwst_pupil(NPIX).numpy() > 0.5
OPD = random_opd(5, npix=NPIX).data
OPD.setflags(write=False)
HOLES = OPD.copy()
HOLES[[70, 30, 0], [60, 40, 0]] = np.nan
HOLES[30, 41] = np.inf


def write(path, data, unit="m", **header):
    hdu = fits.PrimaryHDU(data)
    hdu.header.update({"BUNIT": unit, **header} if unit else header)
    hdu.writeto(path)
    return path


@pytest.mark.parametrize(
    ("unit", "size"), [("meters", 1.0), ("um", 1e6), ("microns", 1e6), ("nm", 1e9), ("Meters", 1.0)]
)
def test_files_in_any_unit_give_the_same_metres(tmp_path, unit, size):
    got = read_opd(write(tmp_path / "map.fits", OPD * size, unit))
    np.testing.assert_allclose(got.data, OPD, rtol=1e-14, atol=1e-24)


def no_wavefront(values):
    return rf"map\.fits.*no wavefront.*{values}.*extension="


@pytest.mark.parametrize(
    ("data", "unit", "expected", "complaint"),
    [
        (OPD, None, UnitError, r"map\.fits.*BUNIT.*unit='m'.*'um', 'nm'"),
        (OPD, "s", UnitError, r"map\.fits.*s.*length"),
        (OPD, "furlongs per fortnight", UnitError, r"map\.fits.*furlongs per fortnight.*length"),
        (HOLES, "m", NonFiniteError, r"map\.fits: 3 values inside the pupil.*\(30, 40\)"),
        (np.stack([OPD, OPD]), "m", CorruptFileError, r"map\.fits.*two-dimensional"),
        (OPD[:, :90], "m", ShapeError, r"map\.fits.*\(96, 90\).*square"),
        (np.ones((9, 9)), "MJy/sr", CorruptFileError, "no OPD map, but an exposure of type"),
        # Constants, the pupil itself, and another with wider struts.
        (0 * OPD, None, CorruptFileError, no_wavefront("value 0,")),
        (0 * OPD + 3e-8, "m", CorruptFileError, no_wavefront("value 3e-08,")),
        ((jwst_pupil(NPIX) > 0) * 1.0, "m", CorruptFileError, no_wavefront("value 1,")),
        ((jwst_pupil(NPIX) > 0.999) * 1.0, None, CorruptFileError, no_wavefront("values 0 and 1,")),
    ],
)
def test_files_without_a_map_are_refused(tmp_path, data, unit, expected, complaint):
    exposure = {"EXP_TYPE": "NRC_CORON"} if unit == "MJy/sr" else {}
    with pytest.raises(expected, match=complaint):
        read_opd(write(tmp_path / "map.fits", np.asarray(data), unit, **exposure))


@pytest.mark.parametrize(
    ("given", "expected", "complaint"),
    [
        (OPD * u.s, UnitError, "opd"),
        (HOLES, NonFiniteError, r"3 values inside the pupil.*\(30, 40\)"),
        (np.zeros((96, 90)), ShapeError, "square"),
        (np.zeros(96), ShapeError, "square"),
        (np.zeros((2, 96, 96)), ShapeError, "square"),
    ],
)
def test_arrays_that_are_no_map_are_refused(given, expected, complaint):
    with pytest.raises(expected, match=complaint):
        as_opd_map(given)


def test_a_unit_can_be_given(tmp_path):
    path = write(tmp_path / "wss.fits", OPD * 1e6, None)
    for unit in ("um", u.um):
        np.testing.assert_allclose(read_opd(path, unit=unit).data, OPD, rtol=1e-14, atol=1e-24)


@pytest.mark.hard
@pytest.mark.parametrize(("size", "likely"), [(1e9, "nm"), (1e3, "mm"), (1e-3, None), (1e12, None)])
def test_an_implausible_rms_warns_and_names_the_unit_that_would_do(tmp_path, size, likely):
    rms = (OPD * size)[PUPIL].std()
    for call in (as_opd_map, lambda a: read_opd(write(tmp_path / "map.fits", a))):
        with pytest.warns(DiffrenderWarning, match="not plausible") as caught:
            got = call(OPD * size)
        message = str(caught[0].message)
        assert f"an rms of {rms:.3g} m" in message
        if likely is None:
            assert "would be" not in message
        else:
            assert f"in {likely} it would be plausible" in message
        np.testing.assert_allclose(got.data, OPD * size, rtol=1e-15)


def test_flat_stands_for_a_flat_wavefront(tmp_path, monkeypatch):
    # A folder of that name does not change it.
    (tmp_path / "flat").mkdir()
    monkeypatch.chdir(tmp_path)
    flat = as_opd_map("flat")
    assert (flat.name, flat.date, flat.shape) == ("flat wavefront", None, (256, 256))
    assert not flat.data.any()
    assert not opd_for("flat", None).data.any()
    assert not starting_opd(DiffrenderSettings(opd="flat"), None).data.any()


def test_nan_outside_the_pupil_becomes_zero(tmp_path):
    holes = np.where(PUPIL, OPD, np.nan)
    for got in (as_opd_map(holes), read_opd(write(tmp_path / "outside.fits", holes))):
        np.testing.assert_array_equal(got.data, np.where(PUPIL, OPD, 0.0))


def images(path, **extensions):
    """A file with images in metres."""
    unit = fits.Header({"BUNIT": "m"})
    hdus = [fits.ImageHDU(data, unit, name) for name, data in extensions.items()]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    return path


def test_the_first_image_is_taken_unless_another_is_named(tmp_path):
    path = images(tmp_path / "many.fits", STEP1=OPD, STEP2=2 * OPD)
    np.testing.assert_array_equal(read_opd(path).data, OPD)
    for extension in ("STEP2", 2):
        np.testing.assert_array_equal(read_opd(path, extension=extension).data, 2 * OPD)
    for missing in ("STEP3", 7):
        with pytest.raises(CorruptFileError, match=r"many\.fits.*STEP1"):
            read_opd(path, extension=missing)
    with pytest.raises(CorruptFileError, match="nowhere"):
        read_opd(tmp_path / "nowhere.fits")


@pytest.mark.parametrize("name", ["OPD", "opdmap", "WFE", "Wavefront"])
def test_a_map_behind_the_pupil_is_taken_by_its_name(tmp_path, name):
    path = images(tmp_path / "two.fits", PUPIL=(OPD != 0) * 1.0, **{name: OPD})
    np.testing.assert_array_equal(read_opd(path).data, OPD)


def test_date_name_and_hash_are_kept(tmp_path):
    path = write(tmp_path / "dated.fits", OPD, **{"DATE-OBS": "2022-08-11T01:02:03"})
    got = read_opd(path)
    assert got.date.isot == "2022-08-11T01:02:03.000"
    assert got.name == "dated.fits"
    assert got.sha256 == sha256(path)
    assert as_opd_map(got) is got
    assert as_opd_map(OPD).date is None
    assert as_opd_map(OPD).sha256 == hashlib.sha256(OPD.tobytes()).hexdigest()


@pytest.mark.hard
def test_integers_and_single_precision_equal_a_float64_copy(tmp_path):
    steps = np.round(OPD / 1e-11).astype(np.int16)
    scaled = read_opd(write(tmp_path / "int16.fits", steps, BSCALE=1e-11)).data
    # astropy scales 16-bit integers in single precision.
    np.testing.assert_allclose(scaled, steps * 1e-11, rtol=3e-7, atol=1e-20)
    single = OPD.astype(np.float32)
    got = read_opd(write(tmp_path / "single.fits", single)).data
    np.testing.assert_array_equal(got, single)


def test_resampling_keeps_a_plane_and_its_orientation_and_takes_means():
    def plane(npix):
        grid = PupilGrid.full(npix)
        return (3 * grid.x[None, :] - 2 * grid.y[:, None]).numpy()

    np.testing.assert_allclose(resample(plane(144), 48), plane(48), atol=1e-12)
    # Bilinear at the border has nothing to go by.
    for npix in (60, 144):
        inside = np.s_[2:-2, 2:-2]
        finer = resample(plane(48), npix)
        np.testing.assert_allclose(finer[inside], plane(npix)[inside], atol=1e-12)
    means = OPD.reshape(32, 3, 32, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(resample(OPD, 32), means, rtol=1e-12, atol=1e-22)
    assert resample(OPD, NPIX) is OPD


@pytest.mark.parametrize("given", [96, 130])
def test_a_model_takes_maps_of_any_size(given):
    model = nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=12)
    map_ = random_opd(5, npix=given)
    wanted = model(torch.from_numpy(resample(map_.data, NPIX)))
    stack = np.stack([map_.data, 2 * map_.data])
    for value in (map_, map_.data, map_.data * 1e9 * u.nm, map_.data.tolist()):
        torch.testing.assert_close(model(value), wanted, rtol=1e-9, atol=1e-20)
    torch.testing.assert_close(model(stack)[0], wanted, rtol=1e-9, atol=1e-20)
    (field,) = model.fields(map_)
    torch.testing.assert_close(field.abs() ** 2, wanted, rtol=1e-9, atol=1e-20)
    psf = model.calc_psf(opd=map_)["DET_SAMP"].data
    np.testing.assert_allclose(psf, wanted.numpy(), rtol=1e-9, atol=1e-20)
    # Another orientation or another wavefront is another image.
    for other in (map_.data[::-1], map_.data.T, 1.01 * map_.data):
        assert not torch.allclose(model(other.copy()), wanted, rtol=1e-3, atol=0)


def test_a_model_refuses_what_it_cannot_resample(tmp_path):
    model = nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=12)
    with pytest.raises(ShapeError, match=r"tensor of shape \(48, 48\).*96.*opd\.numpy\(\)"):
        model(torch.zeros(48, 48, requires_grad=True))
    for shape in ((96, 90), (96,), (0, 0)):
        with pytest.raises(ShapeError, match="expected square maps"):
            model(np.zeros(shape))
    with pytest.raises(TypeError, match=r"read_opd\(path\)"):
        model(tmp_path / "map.fits")
    with pytest.raises(UnitError, match="'s'"):
        model(OPD * u.s)
    with pytest.raises(UnitError, match="arcsec"):
        model(OPD, star_offset=[1.0, 2.0] * u.m)


def test_random_drift_grows_in_proportion_to_time():
    day = random_drift(3, 24.0, npix=NPIX).data
    for hours in (-6.0, 0.0, 240.0):
        drift = random_drift(3, hours, npix=NPIX).data
        np.testing.assert_allclose(drift, day * hours / 24, rtol=1e-12, atol=1e-25)


def test_random_maps_have_the_rms_that_was_asked_for_and_no_piston():
    weight = jwst_pupil(NPIX).numpy()
    weight = weight / weight.sum()
    for map_, rms in (
        (random_opd(0, npix=NPIX), 66e-9),
        (random_opd(77, npix=NPIX, rms=10e-9), 10e-9),
        (random_drift(0, 43.0, npix=NPIX), 4.5e-9),
    ):
        assert np.sqrt((weight * map_.data**2).sum()) == pytest.approx(rms, rel=1e-6)
        assert rms < 5e-9 or abs((weight * map_.data).sum()) < 1e-6 * rms


@pytest.mark.hard
def test_the_same_seed_gives_the_same_bits_and_another_seed_another_wavefront():
    first, again, other = (random_opd(seed, npix=NPIX) for seed in (5, 5, 6))
    assert first.data.tobytes() == again.data.tobytes()
    assert first.sha256 == again.sha256 != other.sha256
    assert abs(np.corrcoef(first.data.ravel(), other.data.ravel())[0, 1]) < 0.3
    assert "seed=5" in first.name


def test_the_same_seed_gives_the_same_wavefront_at_any_sampling():
    pupil = jwst_pupil(128).numpy() > 0.999
    coarse = random_opd(4, npix=128).data
    fine = resample(random_opd(4, npix=256).data, 128)
    # A mean over a pixel damps the highest of 32 cycles by a tenth; segment edges are cut.
    assert np.sqrt(np.mean((fine - coarse)[pupil] ** 2)) < 0.05 * 66e-9
    assert np.corrcoef(fine[pupil], coarse[pupil])[0, 1] > 0.998


@pytest.mark.slow
def test_segments_carry_the_share_of_the_variance_that_was_measured():
    """24 % of the wavefront, 62 % of its drift.

    Rigid motions also fit some of the texture, the same share p of it on average: what they
    leave is (1 - p) times the texture's variance, so that p drops out of the ratio.
    """
    inside = (jwst_pupil(NPIX) > 0.999).flatten()
    segments = SegmentMotions()
    design = segments.modes(PupilGrid.full(NPIX), 0, len(segments)).flatten(1)[:, inside].T.numpy()
    projector = np.linalg.qr(design)[0]

    def left_over(map_):
        values = map_.ravel()[inside]
        rest = values - projector @ (projector.T @ values)
        return float((rest**2).sum() / (values**2).sum())

    seeds = range(12)
    still = np.mean([left_over(random_opd(s, npix=NPIX).data) for s in seeds])
    moving = np.mean([left_over(random_drift(s, 86.0, npix=NPIX).data) for s in seeds])
    assert still / moving == pytest.approx((1 - 0.24) / (1 - 0.62), rel=0.07)
    assert 0.5 < still < 0.76


def test_the_measured_pair_has_the_known_rms_and_drift(shared_data):
    first, second = (read_opd(shared_data / f"opd_2022-08-{day}.fits.gz") for day in (11, 14))
    pupil = jwst_pupil(1024).numpy() > 0.5
    assert first.shape == (1024, 1024)
    assert first.data[pupil].std() == pytest.approx(60e-9, rel=0.05)
    assert (second.data - first.data)[pupil].std() == pytest.approx(8.2e-9, rel=0.07)
    assert first.sha256 != second.sha256
