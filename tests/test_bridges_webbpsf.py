"""`from_webbpsf` against the real stpsf, on an offline data directory without symmetry."""

import copy
import sys
from functools import partial

import numpy as np
import pytest
import torch
from astropy.io import fits
from derivatives import slopes

from benchmarks import stpsf_data
from benchmarks.stpsf_data import lopsided, pupil, zernike_tensor
from pyklip_diffrender import errors
from pyklip_diffrender.bridges import from_webbpsf, opd_to_webbpsf
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.optics.grid import JWST_DIAMETER, PupilGrid, zernike_basis

NPIX = 256
FAST = {"monochromatic": 4.5e-6, "fft_oversample": 2, "detector_oversample": 1, "fov_pixels": 60}


@pytest.fixture
def nircam(stpsf_path):
    """Make a configured stpsf.NIRCam."""
    return partial(stpsf_data.nircam, stpsf_path)


def error(image, truth):
    image, truth = np.asarray(image), np.asarray(truth)
    return float(np.abs(image - truth).max() / truth.max())


def changed_aberrations(instrument, change):
    """The instrument's class of internal aberrations, with a change of the OPD."""

    class Changed(instrument._si_wfe_class):
        def __init__(self, owner):
            super().__init__(owner)
            self.opd = change(self.opd)

    return Changed


@pytest.mark.slow
def test_the_flip_of_the_internal_wavefront_is_recorded_and_can_be_chosen(nircam):
    instrument = nircam()
    models = [from_webbpsf(instrument, flip_si_wfe=flip, **FAST) for flip in (False, True)]
    assert [model.si_wfe_flipped for model in models] == [False, True]
    assert models[0].calc_psf()[0].header["DRSIFLIP"] is False
    assert from_webbpsf(instrument, **FAST).si_wfe_flipped is True
    # Before 2.2.0, stpsf did not flip.
    instrument._si_wfe_class = changed_aberrations(instrument, lambda opd: opd[::-1])
    truth = instrument.calc_psf(**FAST)[1].data
    assert error(models[0](), truth) < 1e-10
    assert error(models[1](), truth) > 1e-3


@pytest.mark.slow
def test_keywords_and_extensions_are_those_of_stpsf(nircam):
    instrument = nircam(source_offset_r=0.1, source_offset_theta=20.0)
    truth = instrument.calc_psf(**FAST)
    psf = from_webbpsf(instrument, **FAST).calc_psf()
    assert [hdu.name for hdu in psf] == [hdu.name for hdu in truth]
    for mine, theirs in zip(psf, truth, strict=True):
        keys = set(theirs.header) - {"HISTORY", "DATE", "FFTTYPE", "AUTHOR"}
        assert keys <= set(mine.header)
        different = {k for k in keys if mine.header[k] != theirs.header[k]}
        # The drop of the peak by jitter, from images that agree to rounding.
        assert different <= {"JITRSTRL"}
        assert mine.header["DRPROP"] == "MASK335R: compact"


def test_the_users_object_and_the_model_do_not_touch_each_other(nircam):
    instrument = nircam(source_offset_x=0.05)
    settings = copy.deepcopy(instrument.options)
    model = from_webbpsf(instrument, **FAST)
    image = model()
    model.calc_psf(add_distortion=False)
    assert instrument.options == settings
    instrument.options["source_offset_x"] = 1.0
    instrument.image_mask = "MASK430R"
    assert torch.equal(model(), image)
    assert torch.equal(model.with_fidelity(monochromatic=4.5e-6)(), image)
    fft = from_webbpsf(nircam(source_offset_x=0.05), propagation="fft", **FAST)
    assert fft.propagation == {"MASK335R": "fft"}
    assert error(fft(), image) < 1e-10


@pytest.mark.slow
def test_a_refined_wavefront_goes_back(nircam):
    instrument = nircam()
    model = from_webbpsf(instrument, add_distortion=True, **FAST)
    opd = lopsided(NPIX, 99, 50e-9) * pupil(NPIX)
    instrument.pupilopd = opd_to_webbpsf(opd, instrument)
    truth = instrument.calc_psf(**FAST)
    assert error(model(opd), truth["DET_DIST"].data) < 1e-10
    again = from_webbpsf(instrument, **FAST)
    assert np.abs(again.entrance.opd.numpy() - opd).max() < 1e-20
    # Upside down, or without taking out the field dependence, it would not be the same image.
    with pytest.warns(errors.DiffrenderWarning, match="upside down"):
        instrument.pupilopd = opd_to_webbpsf(opd[::-1].copy(), instrument)
    assert error(model(opd), instrument.calc_psf(**FAST)["DET_DIST"].data) > 1e-2
    instrument.pupilopd[0].data = opd
    assert error(model(opd), instrument.calc_psf(**FAST)["DET_DIST"].data) > 1e-4


def test_the_lyot_stop_moves_as_in_stpsf_by_whole_samples(nircam):
    """stpsf shifts in the exit pupil, where y is inverted, by whole samples."""
    shift = 5 / NPIX
    truth = nircam(pupil_shift_x=shift * 1.001, pupil_shift_y=-2 * shift * 1.001).calc_psf(**FAST)
    model = from_webbpsf(nircam(), **FAST)
    assert error(model(lyot_shift=(shift, 2 * shift)), truth[1].data) < 1e-9
    assert error(model(lyot_shift=(0.0, 0.0), lyot_rotation=0.0), model()) < 1e-12
    assert error(model(lyot_shift=(shift, -2 * shift)), truth[1].data) > 1e-2
    # Rotated by splines there and by cubic convolution here, of an unsmoothed edge.
    turned = nircam(pupil_rotation=-1.0).calc_psf(**FAST)[1].data
    right, wrong = (error(model(lyot_rotation=angle), turned) for angle in (1.0, -1.0))
    assert right < 0.005 < 0.1 < wrong


def test_zernikes_add_to_the_internal_wavefront(nircam):
    instrument = nircam()
    coefficients = zernike_tensor(3)
    grid = PupilGrid.full(NPIX)
    basis = zernike_basis(36, grid.x, grid.y, JWST_DIAMETER / 2)
    extra = torch.tensordot(coefficients, basis, dims=1).numpy()[::-1]
    model = from_webbpsf(instrument, **FAST)
    instrument._si_wfe_class = changed_aberrations(instrument, lambda opd: opd + extra)
    truth = instrument.calc_psf(**FAST)[1].data
    assert error(model(si_zernikes=coefficients), truth) < 1e-10


STEPS = {
    "opd": (torch.from_numpy(lopsided(NPIX, 4, 60e-9)), 1e-10),
    "lyot_shift": ([0.0031, -0.0052], 1e-6), "lyot_rotation": ([0.31], 1e-4),
    "si_zernikes": (zernike_tensor(5), 1e-10), "blur": ([0.02], 1e-4),
}  # fmt: skip


def test_gradients(nircam):
    """Through the whole chain to DET_DIST, against finite differences."""
    model = from_webbpsf(nircam(), add_distortion=True, **{**FAST, "fov_pixels": 30})
    generator = torch.manual_seed(6)
    weight = torch.randn(30, 30, generator=generator, dtype=torch.float64)
    for name, (value, step) in STEPS.items():
        at = torch.as_tensor(value, dtype=torch.float64)
        direction = torch.randn(at.shape, generator=generator, dtype=torch.float64)

        def summed(v, name=name):
            return (model(**{name: v}) * weight).sum()

        found, wanted = slopes(summed, at, direction, step)
        assert found == pytest.approx(wanted, rel=1e-6), name


def test_star_offsets_are_source_offsets(nircam):
    x, y = offset = (0.31, -0.12)
    truth = nircam(source_offset_x=x, source_offset_y=y).calc_psf(**FAST)[1].data
    assert error(from_webbpsf(nircam(), **FAST)(star_offset=offset), truth) < 1e-10
    # On top of one that the instrument has, turned as poppy turns it.
    r, theta = np.hypot(x, y) / 2, np.rad2deg(np.arctan2(-x, y))
    half = from_webbpsf(nircam(source_offset_r=r, source_offset_theta=theta), **FAST)
    assert error(half(star_offset=(x / 2, y / 2)), truth) < 1e-10


def test_the_embedded_coronagraph_has_the_orientation_of_stpsf(nircam):
    """The package's occulter and internal aberration, wedge tilt and all, around stpsf's arrays.

    The Zernikes differ by a thousandth: poppy puts the circle through the outermost samples. The
    focus of stpsf has a reference wavelength of its own.
    """
    moved = nircam(source_offset_x=0.31, source_offset_y=-0.12, nd_squares=False)
    truth = moved.calc_psf(**FAST)[1].data
    model = from_webbpsf(nircam(nd_squares=False), **FAST)
    (stop,) = (plane for plane in model.planes if plane.name == "MASKRND")

    def embedded(flip=True, offset=(0.31, -0.12)):
        base = nircam_coronagraph(
            monochromatic=4.5e-6, npix=NPIX, fov_pixels=60, occulter_sampling=2,
            pixelscale=moved.pixelscale, si_wfe=moved._get_aberrations().zernike_coeffs,
            flip_si_wfe=flip, chromatic_reference=3.35e-6,
        )  # fmt: skip
        planes = (base.between[0], stop, base.between[2])
        return OpticalSystem(model.entrance, planes, base.detector, base.bandpass)(
            star_offset=offset
        )

    assert error(embedded(), truth) < 5e-3
    assert error(embedded(flip=False), truth) > 2e-2
    assert error(embedded(offset=(0.31, 0.12)), truth) > 0.1


def test_what_cannot_be_converted(nircam):
    with pytest.raises(errors.IncompatibleSetupError, match=r"expected an stpsf\.NIRCam"):
        from_webbpsf("NIRCam")
    with pytest.raises(errors.IncompatibleSetupError, match="'linear' is not supported"):
        from_webbpsf(nircam(jitter="linear"), **FAST)
    with pytest.raises(errors.IncompatibleSetupError, match="too short for NIRCam long wave"):
        from_webbpsf(nircam(), monochromatic=2e-6)
    with pytest.raises(errors.IncompatibleSetupError, match="not all three"):
        from_webbpsf(nircam(), **FAST).calc_psf(
            oversample=2, fft_oversample=2, detector_oversample=2
        )


@pytest.mark.parametrize(
    ("factor", "expected", "complaint"),
    [(1e6, errors.UnitError, "in microns"), (np.nan, errors.NonFiniteError, "NaN")],
)
def test_maps_that_cannot_be_right(nircam, factor, expected, complaint):
    instrument = nircam()
    opd = lopsided(NPIX, 7, 60e-9) * np.where(pupil(NPIX), factor, 0.0)
    header = fits.Header({"BUNIT": "m", "PUPLSCAL": JWST_DIAMETER / NPIX})
    instrument.pupilopd = fits.HDUList([fits.PrimaryHDU(opd, header)])
    with pytest.raises(expected, match=complaint):
        from_webbpsf(instrument, **FAST)
    with pytest.raises(expected, match=complaint):
        opd_to_webbpsf(opd, nircam())


def test_a_map_of_another_size_is_resampled(nircam):
    opd = lopsided(NPIX, 99, 50e-9)
    maps = (np.kron(opd, np.ones((2, 2))), opd)
    taken, wanted = (opd_to_webbpsf(each, nircam())[0].data for each in maps)
    assert np.abs(taken - wanted).max() < 1e-20
    with pytest.raises(errors.ShapeError, match=r"got shape \(100, 90\)"):
        opd_to_webbpsf(np.zeros((100, 90)), nircam())


@pytest.mark.parametrize(
    "missing", ["si_zernikes_coron_wfe.fits", "NIRCam/IPC/KERNEL_IPC_CUBE.fits"]
)
def test_a_missing_file_is_named_with_the_directory(nircam, stpsf_path, missing):
    instrument, path = nircam(), stpsf_path / missing
    aside = path.rename(path.with_suffix(".aside"))
    try:
        with pytest.raises(errors.CorruptFileError, match=f"{path.name}.*STPSF_PATH is"):
            from_webbpsf(instrument, add_distortion=True, **FAST)
    finally:
        aside.rename(path)


@pytest.mark.slow
def test_the_older_name_works_as_well(nircam, stpsf_path, monkeypatch):
    """webbpsf 2 is stpsf under another name and takes its path from WEBBPSF_PATH."""
    monkeypatch.delenv("STPSF_PATH")
    monkeypatch.setenv("WEBBPSF_PATH", str(stpsf_path))
    monkeypatch.delitem(sys.modules, "webbpsf", raising=False)
    with pytest.warns(DeprecationWarning, match="renamed to STPSF"):
        import webbpsf

    instrument = nircam()
    assert isinstance(instrument, webbpsf.NIRCam)
    assert float(from_webbpsf(instrument, **FAST)().sum()) > 0
