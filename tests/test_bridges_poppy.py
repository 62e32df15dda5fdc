"""`from_poppy` against poppy itself: same samples, so only rounding may differ."""

import copy
import re
from itertools import product

import astropy.units as u
import numpy as np
import poppy
import pytest
import random_poppy
import torch
from astropy.io import fits
from poppy.poppy_core import PlaneType

from benchmarks import poppy_reference as reference
from pyklip_diffrender.bridges import from_poppy, opd_to_poppy
from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.optics.grid import resample

DETECTOR = {"pixelscale": 0.05, "fov_pixels": 40, "oversample": 2}
WAVELENGTH = 4.5e-6
NPIX = 96

# poppy's anti-aliased circles say that they are only approximate; the same values are used here.
# Random phase masks may be only a few samples wide, of which poppy warns.
pytestmark = [
    pytest.mark.filterwarnings("ignore:filled_circle_aa may not yield exact results"),
    pytest.mark.filterwarnings("ignore:Phase mask is very coarsely sampled"),
    pytest.mark.filterwarnings("ignore:The 'warn' method is deprecated:DeprecationWarning"),
]


def make(*planes, detector=DETECTOR):
    system = poppy.OpticalSystem(oversample=2, npix=NPIX, verbose=False)
    system.pupil_diameter = 6.5 * u.m
    for kind, what in planes:
        if kind == "invert":
            system.add_inversion(axis=what)
        elif kind == "rotate":
            system.add_rotation(what)
        else:
            getattr(system, f"add_{kind}")(copy.deepcopy(what))
    system.add_detector(**detector)
    system.source_offset_r, system.source_offset_theta = 0.2, 33.0
    return system


PUPIL = "pupil", poppy.optics.ParityTestAperture(name="entrance", radius=3.2 * u.m)
TERMS = [0, 1e-7, -5e-8, 2e-7, 1e-7, 5e-8, 1e-7, 3e-8]
ZERNIKES = "pupil", poppy.ZernikeWFE(name="aberrations", radius=3.3, coefficients=TERMS)
STOP = (
    "pupil",
    poppy.SecondaryObscuration(
        name="stop", secondary_radius=0.7, n_supports=3, support_width=0.2, rotation=10, shift_x=0.1
    ),
)
SPOT = "image", poppy.CircularOcculter(name="spot", radius=0.3, shift_x=0.05, shift_y=-0.08)
BAR = "image", poppy.BarOcculter(name="bar", width=0.2 * u.arcsec, height=2 * u.arcsec)
BAND_LIMITED = "image", poppy.BandLimitedCoron(name="circular mask", kind="circular", sigma=5.0)
LINEAR = "image", poppy.BandLimitedCoron(name="linear mask", kind="linear", sigma=5.0)
QUADRANTS = (
    ("pupil", poppy.FQPM_FFT_aligner(direction="forward")),
    ("image", poppy.IdealFQPM(name="quadrants", wavelength=4.3e-6 * u.m)),
    ("pupil", poppy.FQPM_FFT_aligner(direction="backward")),
)


def fits_file(data, **cards):
    return fits.HDUList([fits.PrimaryHDU(data, fits.Header({"PUPLSCAL": 6.5 / NPIX, **cards}))])


# A FITS pupil, somewhat smaller than the array, with an OPD in microns, and an image-plane mask
# from an array, on samples of another size than the FFT's.
Y, X = np.mgrid[:80, :80] - 39.5
LIT = ((np.hypot(X, Y) < 36) & ~((X > 5) & (Y > 12))).astype(float)
FILE = "pupil", poppy.FITSOpticalElement(
    name="file", transmission=fits_file(LIT), planetype=PlaneType.pupil, rotation=20,
    opd=fits_file(0.1 * np.sin(X / 9 + Y / 13 + 1), BUNIT="micron"), shift=(0.02, -0.03),
    flip_y=True,
)  # fmt: skip
Y, X = np.mgrid[:140, :140] - 69.5
ARRAY = "image", poppy.ArrayOpticalElement(
    name="array mask", transmission=1 - np.exp(-((X - 3) ** 2 + (Y + 6) ** 2) / 60),
    pixelscale=0.06 * u.arcsec / u.pix, planetype=PlaneType.image,
)  # fmt: skip
TILT = "pupil", poppy.optics.TiltOpticalPathDifference(tilt_angle=0.12 * u.arcsec, rotation=30)
# Those that random systems do not have, or seldom. What is bounded is computed either way.
COMPACT = {
    "turned several times": (
        PUPIL, ("rotate", 90), ZERNIKES, ("invert", "x"), BAR, STOP, ("rotate", 90),
        ("invert", "y"), ZERNIKES,
    ),
    "turned by -33.3": (
        PUPIL, ("invert", "y"), ZERNIKES, ("rotate", -33.3), BAR, STOP, ("invert", "x")
    ),
    "two masks in one image": (PUPIL, SPOT, BAR, STOP),
    "file, turned and shifted": (FILE, BAR, STOP),
}  # fmt: skip
OTHERS = {
    "array mask": (PUPIL, ("invert", "y"), ARRAY, STOP),
    "quadrants": (PUPIL, ("invert", "y"), *QUADRANTS, STOP),
    "two coronagraphs": (PUPIL, SPOT, BAR, STOP, ("invert", "y"), LINEAR, STOP),
    "tilt": (PUPIL, ("invert", "x"), TILT, ZERNIKES, STOP),
    "beside the axis": (PUPIL, ZERNIKES),
}


def relative(image, truth):
    return float(np.linalg.norm(image - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize(
    ("name", "propagation"), [*product(COMPACT, ("compact", "fft")), *product(OTHERS, ("auto",))]
)
def test_images_are_those_of_poppy(name, propagation):
    beside = {"pixelscale": 0.05, "fov_pixels": (40, 30), "oversample": 2, "offset": (1.5, -3)}
    detector = beside if name == "beside the axis" else DETECTOR
    system = make(*{**COMPACT, **OTHERS}[name], detector=detector)
    truth = system.calc_psf(WAVELENGTH)[0].data
    model = from_poppy(system, WAVELENGTH, propagation=propagation)
    assert relative(model.calc_psf()[0].data, truth) < 1e-12
    if propagation != "auto":
        assert set(model.propagation.values()) == {propagation}
        assert set(from_poppy(system, WAVELENGTH).propagation.values()) == {"compact"}


@pytest.mark.parametrize(
    ("seeds", "least"), [(range(12), 8), pytest.param(range(100, 160), 42, marks=pytest.mark.slow)]
)
def test_random_systems(seeds, least):
    refusals = []
    for seed in seeds:
        system = random_poppy.draw(np.random.default_rng(seed))
        try:
            model = from_poppy(system, random_poppy.WAVELENGTH)
        except IncompatibleSetupError as error:
            refusals.append(str(error))
            continue
        truth = system.calc_psf(random_poppy.WAVELENGTH)[0].data
        # Rounding: up to 1e-13 for these sizes. A mask that lacks light is wrong by 1e-4 and more.
        # Where masks block all the light, rounding is relative to the light that came in.
        error = np.abs(model.calc_psf()[0].data - truth).max() / max(truth.max(), 1e-9)
        assert error < 1e-10, (seed, error, [plane.name for plane in system.planes])
    assert all(re.search("by one sample|odd number of samples", each) for each in refusals)
    assert len(seeds) - len(refusals) >= least


def test_an_exit_pupil_is_normalised():
    # A stop that ends inside the array: poppy's exit pupil is the padded one.
    system = make(PUPIL, SPOT, ("pupil", poppy.CircularAperture(radius=2.6 * u.m)))
    truth = system.calc_psf(WAVELENGTH, normalize="exit_pupil")[0]
    psf = from_poppy(system, WAVELENGTH).calc_psf(normalize="exit_pupil")[0]
    assert relative(psf.data, truth.data) < 1e-12
    assert psf.header["NORMALIZ"] == "exit_pupil"


def test_every_keyword_of_poppy_is_there():
    system = make(PUPIL, SPOT, STOP)
    truth = system.calc_psf(WAVELENGTH)[0].header
    header = from_poppy(system, WAVELENGTH).calc_psf()[0].header
    own = {"FFTTYPE", "HISTORY", "SIMPLE"}
    assert set(truth) <= set(header)
    assert {k: header[k] for k in set(truth) - own} == {k: truth[k] for k in set(truth) - own}
    assert header["DRPROP"] == "spot: compact"
    assert header["DRPREC"] == "float64"
    assert header["DRVERS"]


def test_intermediate_wavefronts_are_those_of_poppy():
    system = make(PUPIL, ("rotate", 90), ("invert", "x"), ZERNIKES, BAR, STOP, ZERNIKES)
    _, theirs = system.calc_psf(WAVELENGTH, return_intermediates=True)
    model = from_poppy(system, WAVELENGTH, propagation="fft")
    _, ours = model.calc_psf(return_intermediates=True)
    assert len(ours) == len(theirs) == len(system.planes)
    for mine, wave in zip(ours, theirs, strict=True):
        assert isinstance(mine, poppy.Wavefront)
        size = mine.shape[0]
        first = wave.shape[0] // 2 - size // 2
        part = wave.wavefront[first : first + size, first : first + size]
        # Image planes of an FFT carry the phase of an origin in the corner.
        assert relative(np.abs(mine.wavefront), np.abs(part)) < 1e-12
        assert np.isclose(mine.pixelscale.value, wave.pixelscale.value)
    # Without an FFT there is only that part of the image that the bar blocks.
    _, compact = from_poppy(system, WAVELENGTH).calc_psf(return_intermediates=True)
    rows, columns = compact[4].shape
    y, x = ((theirs[4].shape[0] - size + 1) // 2 for size in (rows, columns))
    part = theirs[4].intensity[y : y + rows, x : x + columns]
    assert columns < rows < theirs[4].shape[0]
    assert np.abs(compact[4].intensity - part).max() < 1e-12 * part.max()
    _, (last,) = model.calc_psf(return_final=True)
    assert relative(last.intensity, theirs[-1].intensity) < 1e-12


def test_later_changes_to_the_users_object_do_not_reach_the_model():
    system = make(PUPIL, ZERNIKES, SPOT, STOP)
    before = copy.deepcopy(system)
    model = from_poppy(system, WAVELENGTH)
    image = model()
    system.planes[2].radius_inner = 1 * u.arcsec
    system.source_offset_r = 0.0
    assert torch.equal(model(), image)
    assert torch.equal(model.with_fidelity(wavelength=WAVELENGTH)(), image)
    assert relative(image.numpy(), from_poppy(before, WAVELENGTH)().numpy()) == 0


def test_star_offsets_add_to_the_systems_own_in_the_final_frame():
    system = make(PUPIL, ("invert", "x"), ("rotate", 20), SPOT, STOP)
    model = from_poppy(system, WAVELENGTH)
    x, y = 0.11, -0.07
    r, theta = system.source_offset_r, np.deg2rad(system.source_offset_theta)
    x_all, y_all = x - r * np.sin(theta), y + r * np.cos(theta)
    system.source_offset_r = np.hypot(x_all, y_all)
    system.source_offset_theta = np.rad2deg(np.arctan2(-x_all, y_all))
    moved = from_poppy(system, WAVELENGTH)()
    assert relative(model(star_offset=(x, y)).numpy(), moved.numpy()) < 1e-12
    truth = system.calc_psf(WAVELENGTH)[0].data.reshape(40, 2, 40, 2).sum(axis=(1, 3))
    assert relative(moved.numpy(), truth) < 1e-12


def test_there_and_back():
    """An OPD fitted here gives the same image in poppy."""
    system = make(PUPIL, ("invert", "y"), ZERNIKES, SPOT, STOP)
    model = from_poppy(system, WAVELENGTH)
    opd = reference.lopsided_opd(NPIX)
    truth = opd_to_poppy(opd, system).calc_psf(WAVELENGTH)[0].data
    assert relative(model.calc_psf(opd=opd)[0].data, truth) < 1e-12
    assert relative(model.calc_psf(opd=opd[::-1].copy())[0].data, truth) > 1e-3
    own = opd_to_poppy(model.entrance.opd, system).calc_psf(WAVELENGTH)[0].data
    assert relative(own, system.calc_psf(WAVELENGTH)[0].data) < 1e-12
    coarse = resample(opd, NPIX // 2)
    assert np.array_equal(opd_to_poppy(coarse, system).planes[0].opd, resample(coarse, NPIX))
    with pytest.raises(ShapeError, match=r"\(95, 96\), expected square maps"):
        opd_to_poppy(opd[:-1], system)


def test_single_precision():
    system = make(PUPIL, SPOT, STOP)
    truth = from_poppy(system, WAVELENGTH)().numpy()
    for propagation in ("compact", "fft"):
        single = from_poppy(system, WAVELENGTH, propagation=propagation, dtype=torch.float32)
        assert single().dtype == torch.float32
        assert relative(single().numpy(), truth) < 1e-4


def changed(plane, **attributes):
    """A system of which one plane is not as it should be, or missing."""
    system = make(PUPIL, SPOT, STOP)
    vars(system.planes[plane]).update(attributes)
    if not attributes:
        del system.planes[plane]
    return system


def forced(**arguments):
    """What converts a mask without bounds."""
    return lambda: from_poppy(make(PUPIL, BAND_LIMITED, STOP), WAVELENGTH, **arguments)


REFUSED = {
    "Fresnel propagation is not supported": lambda: poppy.FresnelOpticalSystem(npix=64),
    r"must be a Detector, got .*Add one": lambda: changed(-1),
    "first plane must be a pupil": lambda: changed(0),
    r"'stop' \(SecondaryObscuration.*not supported. Supported are": (
        lambda: changed(2, planetype=PlaneType.intermediate)
    ),
    "convert the poppy.OpticalSystem from which it was made": (
        lambda: poppy.MatrixFTCoronagraph(make(PUPIL, SPOT, STOP))
    ),
    "SemiAnalyticCoronagraph does not propagate.*convert the poppy.OpticalSystem": (
        lambda: poppy.SemiAnalyticCoronagraph(make(PUPIL, SPOT, STOP), fpm_index=1)
    ),
    "'spot' asks for a matrix transform": lambda: changed(1, propagation_hint="MFT"),
    "'spot'.*there must be a pupil plane": lambda: make(PUPIL, STOP, SPOT),
    "expected a poppy.OpticalSystem": poppy.Instrument,
    "moves the field by one sample": lambda: make(PUPIL, SPOT, ("invert", "y"), STOP),
    r"'circular mask'.*Use propagation='fft'": forced(propagation="compact"),
    "expected 'auto', 'compact' or 'fft'": forced(propagation={"circular mask": "mft"}),
    "normalize": lambda: forced()().calc_psf(normalize="lats"),
    "return_intermediates=True": lambda: forced()().calc_psf(save_intermediates=True),
}


@pytest.mark.parametrize("complaint", REFUSED)
def test_what_is_not_supported_is_named(complaint):
    with pytest.raises(IncompatibleSetupError, match=complaint):
        from_poppy(REFUSED[complaint](), WAVELENGTH)


def test_a_users_own_mask_says_how_far_it_reaches():
    system = make(PUPIL, STOP)
    mask = reference.SombreroOcculter(name="own")
    mask.occulter_box = 2.2
    system.add_image(mask, index=1)
    model = from_poppy(system, WAVELENGTH)
    assert model.propagation == {"own": "compact"}
    assert relative(model.calc_psf()[0].data, system.calc_psf(WAVELENGTH)[0].data) < 1e-12
