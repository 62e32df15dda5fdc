"""Wavefront maps: units, broken and odd files, and the seeded generators."""

from __future__ import annotations

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
from pyklip_diffrender.instrument import jwst_pupil, nircam_coronagraph
from pyklip_diffrender.io import sha256
from pyklip_diffrender.optics import PupilGrid, resample
from pyklip_diffrender.pyklip_backend import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.backend_settings import starting_opd
from pyklip_diffrender.wavefront import (
    SegmentMotions,
    as_opd_map,
    random_drift,
    random_opd,
    read_opd,
    wavefront_for,
)

NPIX = 96


@pytest.fixture(scope="module")
def pupil():
    return jwst_pupil(NPIX).numpy() > 0.5


@pytest.fixture(scope="module")
def opd():
    array = random_opd(5, npix=NPIX).data
    array.setflags(write=False)
    return array


def write(path, data, unit="m", **header):
    hdu = fits.PrimaryHDU(data)
    if unit is not None:
        hdu.header["BUNIT"] = unit
    for key, value in header.items():
        hdu.header[key.replace("_", "-")] = value
    hdu.writeto(path)
    return path


@pytest.mark.parametrize(
    ("unit", "size"),
    [
        ("m", 1.0), ("meters", 1.0), ("um", 1e6), ("micron", 1e6), ("microns", 1e6),
        ("nm", 1e9), ("nanometers", 1e9), ("Meters", 1.0),
    ],
)  # fmt: skip
def test_files_in_any_unit_give_the_same_metres(tmp_path, opd, unit, size):
    got = read_opd(write(tmp_path / "map.fits", opd * size, unit))
    np.testing.assert_allclose(got.data, opd, rtol=1e-14, atol=1e-24)


def test_a_file_without_a_unit_asks_for_one_and_takes_it(tmp_path, opd):
    path = write(tmp_path / "wss.fits", opd * 1e6, None)
    with pytest.raises(UnitError, match=r"wss\.fits.*BUNIT.*unit='m'.*'um', 'nm'"):
        read_opd(path)
    for unit in ("um", u.um):
        np.testing.assert_allclose(read_opd(path, unit=unit).data, opd, rtol=1e-14, atol=1e-24)


@pytest.mark.parametrize("unit", ["s", "furlongs per fortnight", "rad"])
def test_a_unit_that_is_no_length_is_refused(tmp_path, opd, unit):
    with pytest.raises(UnitError, match=rf"map\.fits.*{unit}.*length"):
        read_opd(write(tmp_path / "map.fits", opd, unit))
    with pytest.raises(UnitError, match="opd"):
        as_opd_map(opd * u.s)


@pytest.mark.hard
@pytest.mark.parametrize(
    ("size", "likely"), [(1e9, "nm"), (1e6, "um"), (1e3, "mm"), (1e-3, None), (1e12, None)]
)
def test_an_implausible_rms_warns_and_names_the_unit_that_would_do(
    tmp_path, opd, pupil, size, likely
):
    rms = (opd * size)[pupil].std()
    for call in (as_opd_map, lambda a: read_opd(write(tmp_path / "map.fits", a))):
        with pytest.warns(DiffrenderWarning, match="not plausible") as caught:
            got = call(opd * size)
        message = str(caught[0].message)
        assert f"an rms of {rms:.3g} m" in message
        if likely is None:
            assert "would be" not in message
        else:
            assert f"in {likely} it would be plausible" in message
        np.testing.assert_allclose(got.data, opd * size, rtol=1e-15)


def test_flat_stands_for_a_flat_wavefront(tmp_path, monkeypatch):
    # A folder of that name does not change it.
    (tmp_path / "flat").mkdir()
    monkeypatch.chdir(tmp_path)
    flat = as_opd_map("flat")
    assert flat.name == "flat wavefront"
    assert flat.date is None
    assert flat.shape == (256, 256)
    assert not flat.data.any()
    assert not wavefront_for("flat", None).data.any()
    assert not starting_opd(DiffrenderSettings(opd="flat"), None).data.any()


@pytest.mark.hard
def test_nan_inside_the_pupil_is_counted_and_located(tmp_path, opd, pupil):
    bad = opd.copy()
    assert pupil[30, 40]
    assert pupil[70, 60]
    bad[70, 60] = bad[30, 40] = np.nan
    bad[30, 41] = np.inf
    bad[0, 0] = np.nan
    with pytest.raises(NonFiniteError, match=r"3 values inside the pupil.*\(30, 40\)"):
        as_opd_map(bad)
    with pytest.raises(NonFiniteError, match=r"holes\.fits: 3 values.*\(30, 40\)"):
        read_opd(write(tmp_path / "holes.fits", bad))


def test_nan_outside_the_pupil_becomes_zero(tmp_path, opd, pupil):
    holes = np.where(pupil, opd, np.nan)
    for got in (as_opd_map(holes), read_opd(write(tmp_path / "outside.fits", holes))):
        np.testing.assert_array_equal(got.data[pupil], opd[pupil])
        assert not got.data[~pupil].any()


def test_the_first_image_is_taken_unless_another_is_named(tmp_path, opd):
    path = tmp_path / "many.fits"
    images = [fits.ImageHDU(k * opd, name=f"STEP{k}") for k in (1, 2)]
    for image in images:
        image.header["BUNIT"] = "m"
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(path)
    np.testing.assert_array_equal(read_opd(path).data, opd)
    np.testing.assert_array_equal(read_opd(path, extension="STEP2").data, 2 * opd)
    np.testing.assert_array_equal(read_opd(path, extension=2).data, 2 * opd)
    for missing in ("STEP3", 7):
        with pytest.raises(CorruptFileError, match=r"many\.fits.*STEP1"):
            read_opd(path, extension=missing)


def test_a_file_without_a_map_is_refused(tmp_path, opd):
    with pytest.raises(CorruptFileError, match=r"cube\.fits.*two-dimensional"):
        read_opd(write(tmp_path / "cube.fits", np.stack([opd, opd])))
    with pytest.raises(CorruptFileError, match="nowhere"):
        read_opd(tmp_path / "nowhere.fits")


@pytest.mark.parametrize("name", ["OPD", "opdmap", "WFE", "Wavefront"])
def test_a_map_behind_the_pupil_is_taken_by_its_name(tmp_path, opd, name):
    path = tmp_path / "two.fits"
    images = [fits.ImageHDU(opd, name=name), fits.ImageHDU((opd != 0) * 1.0, name="PUPIL")]
    images[0].header["BUNIT"] = "m"
    fits.HDUList([fits.PrimaryHDU(), *images[::-1]]).writeto(path)
    np.testing.assert_array_equal(read_opd(path).data, opd)


@pytest.mark.parametrize("unit", ["m", None])
@pytest.mark.parametrize(
    ("change", "values"),
    [
        (lambda opd: 0 * opd, "value 0,"),
        (lambda opd: 0 * opd + 3e-8, "value 3e-08,"),
        # The pupil itself, and another with wider struts.
        (lambda opd: (jwst_pupil(len(opd)).numpy() > 0) * 1.0, "value 1,"),
        (lambda opd: (jwst_pupil(len(opd)).numpy() > 0.999) * 1.0, "values 0 and 1,"),
    ],
)
def test_a_mask_or_a_constant_is_no_wavefront(tmp_path, opd, change, values, unit):
    path = write(tmp_path / "mask.fits", change(opd), unit)
    with pytest.raises(CorruptFileError, match=rf"mask\.fits.*no wavefront.*{values}.*extension="):
        read_opd(path)


@pytest.mark.parametrize("shape", [(2, 16, 16), (16, 16)])
def test_science_frames_are_no_map(tmp_path, shape):
    path = tmp_path / "jw01_nrcalong_calints.fits"
    primary, frames = fits.PrimaryHDU(), fits.ImageHDU(np.ones(shape), name="SCI")
    primary.header["EXP_TYPE"] = "NRC_CORON"
    frames.header["BUNIT"] = "MJy/sr"
    fits.HDUList([primary, frames]).writeto(path)
    with pytest.raises(CorruptFileError, match="no wavefront map, but an exposure of type NRC_COR"):
        read_opd(path)


def test_a_map_that_is_not_square_is_refused(tmp_path, opd):
    with pytest.raises(ShapeError, match=r"map\.fits.*\(96, 90\).*square"):
        read_opd(write(tmp_path / "map.fits", opd[:, :90]))
    for shape in ((96, 90), (96,), (2, 96, 96)):
        with pytest.raises(ShapeError, match="square"):
            as_opd_map(np.zeros(shape))


def test_date_name_and_hash_are_kept(tmp_path, opd):
    path = write(tmp_path / "dated.fits", opd, DATE_OBS="2022-08-11T01:02:03")
    got = read_opd(path)
    assert got.date.isot == "2022-08-11T01:02:03.000"
    assert got.name == "dated.fits"
    assert got.sha256 == sha256(path)
    assert as_opd_map(got) is got
    assert as_opd_map(opd).date is None
    assert as_opd_map(opd).sha256 == hashlib.sha256(opd.tobytes()).hexdigest()


@pytest.mark.hard
def test_every_kind_of_array_equals_a_float64_copy(tmp_path, opd):
    steps = np.round(opd / 1e-11).astype(np.int16)
    scaled = fits.PrimaryHDU(steps)
    scaled.header["BSCALE"], scaled.header["BUNIT"] = 1e-11, "m"
    scaled.writeto(tmp_path / "int16.fits")
    with fits.open(tmp_path / "int16.fits", do_not_scale_image_data=True) as hdus:
        assert hdus[0].data.dtype == ">i2"
    # astropy scales 16-bit integers in single precision.
    np.testing.assert_allclose(
        read_opd(tmp_path / "int16.fits").data, steps * 1e-11, rtol=3e-7, atol=1e-20
    )
    opd.astype(">f8").tofile(tmp_path / "raw")
    for kind in (
        opd.astype(">f8"),
        np.memmap(tmp_path / "raw", dtype=">f8", mode="r", shape=opd.shape),
        np.asfortranarray(opd),
        torch.from_numpy(opd.copy()).requires_grad_(),
        opd.tolist(),
    ):
        np.testing.assert_array_equal(as_opd_map(kind).data, opd)
    np.testing.assert_array_equal(
        read_opd(write(tmp_path / "single.fits", opd.astype(np.float32))).data,
        opd.astype(np.float32),
    )


def test_resampling_keeps_a_plane_and_its_orientation():
    coarse, fine = (PupilGrid.full(n) for n in (48, 144))
    plane = (3 * fine.x[None, :] - 2 * fine.y[:, None]).numpy()
    expected = (3 * coarse.x[None, :] - 2 * coarse.y[:, None]).numpy()
    np.testing.assert_allclose(resample(plane, 48), expected, atol=1e-12)
    # Bilinear at the border has nothing to go by.
    np.testing.assert_allclose(resample(expected, 144)[2:-2, 2:-2], plane[2:-2, 2:-2], atol=1e-12)
    np.testing.assert_allclose(
        resample(expected, 60)[2:-2, 2:-2],
        (3 * PupilGrid.full(60).x[None, :] - 2 * PupilGrid.full(60).y[:, None])[2:-2, 2:-2],
        atol=1e-12,
    )


@pytest.mark.parametrize("given", [48, 96, 130, 192])
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


def test_resampling_to_fewer_pixels_takes_means(opd):
    np.testing.assert_allclose(
        resample(opd, 32), opd.reshape(32, 3, 32, 3).mean(axis=(1, 3)), rtol=1e-12, atol=1e-22
    )
    assert resample(opd, NPIX) is opd


def test_random_drift_grows_in_proportion_to_time():
    day = random_drift(3, 24.0, npix=NPIX).data
    for hours in (-6.0, 0.0, 40.0, 240.0):
        np.testing.assert_allclose(
            random_drift(3, hours, npix=NPIX).data, day * hours / 24, rtol=1e-12, atol=1e-25
        )


def weighted(map_):
    """Mean and rms over the pupil."""
    weight = jwst_pupil(map_.shape[0]).numpy()
    weight = weight / weight.sum()
    return float((weight * map_).sum()), float(np.sqrt((weight * map_**2).sum()))


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(77, marks=pytest.mark.slow)]
)
def test_random_opd_has_the_rms_that_was_asked_for_and_no_piston(seed):
    for rms in (66e-9, 10e-9):
        mean, got = weighted(random_opd(seed, npix=NPIX, rms=rms).data)
        assert got == pytest.approx(rms, rel=1e-6)
        assert abs(mean) < 1e-6 * rms
    _, got = weighted(random_drift(seed, 43.0, npix=NPIX).data)
    assert got == pytest.approx(4.5e-9, rel=1e-6)


@pytest.mark.hard
def test_the_same_seed_gives_the_same_bits_and_another_seed_another_wavefront():
    first, again = random_opd(5, npix=NPIX), random_opd(5, npix=NPIX)
    assert first.data.tobytes() == again.data.tobytes()
    assert first.sha256 == again.sha256
    other = random_opd(6, npix=NPIX)
    assert first.sha256 != other.sha256
    correlation = np.corrcoef(first.data.ravel(), other.data.ravel())[0, 1]
    assert abs(correlation) < 0.3
    assert "seed=5" in first.name


def test_the_same_seed_gives_the_same_wavefront_at_any_sampling():
    pupil = jwst_pupil(128).numpy() > 0.999
    coarse = random_opd(4, npix=128).data
    for npix in (256, 512):
        fine = resample(random_opd(4, npix=npix).data, 128)
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
