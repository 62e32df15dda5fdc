"""`from_poppy` against poppy itself: same samples, so only rounding may differ."""

from __future__ import annotations

import copy
import re

import astropy.units as u
import numpy as np
import poppy
import poppy_reference as reference
import pytest
import random_poppy
import torch
from astropy.io import fits
from poppy.poppy_core import PlaneType

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


def make(*planes, oversample=2, detector=None):
    system = poppy.OpticalSystem(oversample=oversample, npix=NPIX, verbose=False)
    system.pupil_diameter = 6.5 * u.m
    add = {
        "pupil": system.add_pupil,
        "image": system.add_image,
        "invert": lambda axis: system.add_inversion(axis=axis),
        "rotate": system.add_rotation,
    }
    for kind, what in planes:
        add[kind](what)
    system.add_detector(**(detector or DETECTOR))
    system.source_offset_r, system.source_offset_theta = 0.2, 33.0
    return system


def pupil():
    return "pupil", poppy.optics.ParityTestAperture(name="entrance", radius=3.2 * u.m)


def zernikes():
    coefficients = [0, 1e-7, -5e-8, 2e-7, 1e-7, 5e-8, 1e-7, 3e-8]
    return "pupil", poppy.ZernikeWFE(
        name="aberrations", radius=3.3 * u.m, coefficients=coefficients
    )


def stop():
    return "pupil", poppy.SecondaryObscuration(
        name="stop", secondary_radius=0.7, n_supports=3, support_width=0.2, rotation=10, shift_x=0.1
    )


def spot():
    return "image", poppy.CircularOcculter(name="spot", radius=0.3, shift_x=0.05, shift_y=-0.08)


def bar():
    return "image", poppy.BarOcculter(name="bar", width=0.2 * u.arcsec, height=2 * u.arcsec)


def band_limited(kind="circular"):
    return "image", poppy.BandLimitedCoron(name=f"{kind} mask", kind=kind, sigma=5.0)


def phase_spot():
    return "image", poppy.optics.CircularPhaseMask(
        name="phase spot", radius=0.45 * u.arcsec, wavelength=4.2e-6 * u.m
    )


def field_stop():
    return "image", poppy.optics.RectangularFieldStop(
        name="field stop", width=1 * u.arcsec, height=0.6 * u.arcsec, rotation=13
    )


def fits_optic(**turns):
    """A FITS pupil, somewhat smaller than the array, with an OPD in microns."""
    y, x = np.mgrid[:80, :80] - 39.5
    amplitude = ((np.hypot(x, y) < 36) & ~((x > 5) & (y > 12))).astype(float)
    hdus = [fits.PrimaryHDU(a) for a in (amplitude, 0.1 * np.sin(x / 9 + y / 13 + 1))]
    for hdu in hdus:
        hdu.header["PUPLSCAL"] = 6.5 / NPIX
    hdus[1].header["BUNIT"] = "micron"
    return "pupil", poppy.FITSOpticalElement(
        name="file",
        transmission=fits.HDUList([hdus[0]]),
        opd=fits.HDUList([hdus[1]]),
        planetype=PlaneType.pupil,
        **turns,
    )


def image_array():
    """An image-plane mask from an array, on samples of another size than the FFT's."""
    y, x = np.mgrid[:140, :140] - 69.5
    mask = 1 - np.exp(-((x - 3) ** 2 + (y + 6) ** 2) / 60)
    return "image", poppy.ArrayOpticalElement(
        name="array mask",
        transmission=mask,
        pixelscale=0.06 * u.arcsec / u.pix,
        planetype=PlaneType.image,
    )


def aligner(direction):
    return "pupil", poppy.FQPM_FFT_aligner(name=f"{direction} aligner", direction=direction)


def quadrants():
    return "image", poppy.IdealFQPM(name="quadrants", wavelength=4.3e-6 * u.m)


COMPACT = {
    "inverted in x": (pupil(), ("invert", "x"), zernikes(), spot(), stop()),
    "inverted in y": (pupil(), ("invert", "y"), zernikes(), spot(), stop()),
    "inverted in both": (pupil(), ("invert", "both"), zernikes(), spot(), stop()),
    "turned by 90": (pupil(), zernikes(), ("rotate", 90), bar(), stop()),
    "turned by 180": (pupil(), zernikes(), ("rotate", 180), bar(), stop()),
    "turned by -90": (pupil(), zernikes(), ("rotate", -90), bar(), stop()),
    "turned several times": (
        pupil(), ("rotate", 90), zernikes(), ("invert", "x"), bar(), stop(), ("rotate", 90),
        ("invert", "y"), zernikes(),
    ),
    "turned by -33.3": (
        pupil(), ("invert", "y"), zernikes(), ("rotate", -33.3), bar(), stop(), ("invert", "x")
    ),
    "phase spot": (pupil(), phase_spot(), stop()),
    "two masks in one image": (pupil(), spot(), bar(), stop()),
    "file": (fits_optic(), bar(), stop()),
    "file, turned and shifted": (
        fits_optic(rotation=20, shift=(0.02, -0.03), flip_y=True), bar(), stop()
    ),
    "no stop": (
        ("pupil", poppy.CircularAperture(radius=2 * u.m)), bar(),
        ("pupil", poppy.ScalarTransmission(name="nothing"))
    ),
}  # fmt: skip
OTHERS = {
    "no mask": (pupil(), zernikes()),
    "free rotation": (pupil(), zernikes(), ("rotate", 10), stop()),
    "band limited": (pupil(), band_limited(), stop()),
    "field stop": (pupil(), ("invert", "x"), field_stop(), stop()),
    "array mask": (pupil(), ("invert", "y"), image_array(), stop()),
    "quadrants": (
        pupil(), ("invert", "y"), aligner("forward"), quadrants(), aligner("backward"), stop()
    ),
    "two coronagraphs": (
        pupil(), spot(), bar(), stop(), ("invert", "y"), band_limited("linear"), stop()
    ),
    "gray plane between": (
        pupil(), band_limited(), ("pupil", poppy.ScalarTransmission(transmission=0.8)),
        band_limited("linear"), stop(),
    ),
    "tilt": (
        pupil(), ("invert", "x"), ("pupil", poppy.optics.TiltOpticalPathDifference(
            tilt_angle=0.12 * u.arcsec, rotation=30)), zernikes(), stop()
    ),
    "lens and OPD": (
        pupil(), ("pupil", poppy.ThinLens(nwaves=0.3, reference_wavelength=4e-6, radius=3.25)),
        ("pupil", poppy.ScalarOpticalPathDifference(opd=1e-7 * u.m)),
    ),
}  # fmt: skip


def relative(image, truth):
    return float(np.linalg.norm(image - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("propagation", ["compact", "fft"])
@pytest.mark.parametrize("planes", COMPACT.values(), ids=COMPACT)
def test_bounded_masks_either_way(planes, propagation):
    system = make(*planes)
    truth = system.calc_psf(WAVELENGTH)[0].data
    model = from_poppy(system, WAVELENGTH, propagation=propagation)
    assert relative(model.calc_psf()[0].data, truth) < 1e-12
    assert set(model.propagation.values()) == {propagation}
    assert set(from_poppy(system, WAVELENGTH).propagation.values()) == {"compact"}


@pytest.mark.parametrize("planes", OTHERS.values(), ids=OTHERS)
def test_everything_else(planes):
    system = make(*planes)
    truth = system.calc_psf(WAVELENGTH)[0].data
    model = from_poppy(system, WAVELENGTH)
    assert relative(model.calc_psf()[0].data, truth) < 1e-12


def compared(seeds):
    """Compare random systems with poppy; return how many were converted and not refused."""
    converted, refusals = 0, []
    for seed in seeds:
        system = random_poppy.draw(np.random.default_rng(seed))
        try:
            model = from_poppy(system, random_poppy.WAVELENGTH)
        except IncompatibleSetupError as error:
            refusals.append(str(error))
            continue
        truth = system.calc_psf(random_poppy.WAVELENGTH)[0].data
        image = model.calc_psf()[0].data
        # Rounding: up to 1e-13 for these sizes. A mask that lacks light is wrong by 1e-4 and more.
        # Where masks block all the light, rounding is relative to the light that came in.
        error = np.abs(image - truth).max() / max(truth.max(), 1e-9)
        assert error < 1e-10, (seed, error, [plane.name for plane in system.planes])
        converted += 1
    assert all(re.search("by one sample|odd number of samples", each) for each in refusals)
    return converted


def test_random_systems():
    assert compared(range(12)) >= 8


@pytest.mark.slow
def test_many_random_systems():
    assert compared(range(100, 220)) >= 85


def test_the_image_is_the_binned_psf():
    system = make(pupil(), spot(), stop())
    truth = system.calc_psf(WAVELENGTH)[0].data.reshape(40, 2, 40, 2).sum(axis=(1, 3))
    assert relative(from_poppy(system, WAVELENGTH)().numpy(), truth) < 1e-12


def test_several_wavelengths_with_weights():
    system = make(pupil(), zernikes(), spot(), stop())
    waves, weights = [4e-6, 4.4e-6, 5e-6] * u.m, [1.0, 2.0, 3.0]
    truth = system.calc_psf(waves, weight=weights)
    model = from_poppy(system, waves, weights)
    assert relative(model.calc_psf()[0].data, truth[0].data) < 1e-12
    source = {"wavelengths": waves.value, "weights": weights}
    again = from_poppy(system, WAVELENGTH).calc_psf(source=source)
    assert relative(again[0].data, truth[0].data) < 1e-12


@pytest.mark.parametrize("normalize", ["first", "last", "exit_pupil"])
def test_normalisations(normalize):
    # A stop that ends inside the array: poppy's exit pupil is the padded one.
    system = make(pupil(), spot(), ("pupil", poppy.CircularAperture(radius=2.6 * u.m)))
    truth = system.calc_psf(WAVELENGTH, normalize=normalize)[0]
    psf = from_poppy(system, WAVELENGTH).calc_psf(normalize=normalize)[0]
    assert relative(psf.data, truth.data) < 1e-12
    assert psf.header["NORMALIZ"] == normalize


def test_a_detector_beside_the_axis_and_not_square():
    detector = {"pixelscale": 0.05, "fov_pixels": (40, 30), "oversample": 2, "offset": (1.5, -3)}
    system = make(pupil(), zernikes(), detector=detector)
    truth = system.calc_psf(WAVELENGTH)[0].data
    assert relative(from_poppy(system, WAVELENGTH).calc_psf()[0].data, truth) < 1e-12


def test_every_keyword_of_poppy_is_there():
    system = make(pupil(), spot(), stop())
    truth = system.calc_psf(WAVELENGTH)[0].header
    header = from_poppy(system, WAVELENGTH).calc_psf()[0].header
    own = {"FFTTYPE", "HISTORY", "SIMPLE"}
    assert set(truth) <= set(header)
    assert {k: header[k] for k in set(truth) - own} == {k: truth[k] for k in set(truth) - own}
    assert header["DRPROP"] == "spot: compact"
    assert header["DRPREC"] == "float64"
    assert header["DRVERS"]


def test_intermediate_wavefronts_are_those_of_poppy():
    system = make(pupil(), ("rotate", 90), ("invert", "x"), zernikes(), bar(), stop(), zernikes())
    _, theirs = system.calc_psf(WAVELENGTH, return_intermediates=True)
    model = from_poppy(system, WAVELENGTH, propagation="fft")
    _, ours = model.calc_psf(return_intermediates=True)
    assert len(ours) == len(theirs) == len(system.planes)
    for mine, wave in zip(ours, theirs, strict=True):
        assert isinstance(mine, poppy.Wavefront)
        size, whole = mine.shape[0], wave.shape[0]
        first = whole // 2 - size // 2
        part = wave.wavefront[first : first + size, first : first + size]
        # Image planes of an FFT carry the phase of an origin in the corner.
        assert relative(np.abs(mine.wavefront), np.abs(part)) < 1e-12
        assert np.isclose(mine.pixelscale.value, wave.pixelscale.value)
    # Without an FFT there is only that part of the image that the bar blocks.
    _, compact = from_poppy(system, WAVELENGTH).calc_psf(return_intermediates=True)
    rows, columns = compact[4].shape
    middle = theirs[4].shape[0] // 2
    part = theirs[4].intensity[
        middle - rows // 2 : middle + rows // 2 + 1,
        middle - columns // 2 : middle + columns // 2 + 1,
    ]
    assert columns < rows < theirs[4].shape[0]
    assert np.abs(compact[4].intensity - part).max() < 1e-12 * part.max()
    _, (last,) = model.calc_psf(return_final=True)
    assert relative(last.intensity, theirs[-1].intensity) < 1e-12


def test_later_changes_to_the_users_object_do_not_reach_the_model():
    system = make(pupil(), zernikes(), spot(), stop())
    before = copy.deepcopy(system)
    model = from_poppy(system, WAVELENGTH)
    image = model()
    system.planes[2].radius_inner = 1 * u.arcsec
    system.source_offset_r = 0.0
    assert torch.equal(model(), image)
    assert torch.equal(model.with_fidelity(wavelength=WAVELENGTH)(), image)
    assert relative(image.numpy(), from_poppy(before, WAVELENGTH)().numpy()) == 0


def test_star_offsets_add_to_the_systems_own_in_the_final_frame():
    system = make(pupil(), ("invert", "x"), ("rotate", 20), spot(), stop())
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


@pytest.mark.parametrize("inversion", ["x", "y"])
def test_there_and_back(inversion):
    """An OPD fitted here gives the same image in poppy."""
    system = make(pupil(), ("invert", inversion), zernikes(), spot(), stop())
    model = from_poppy(system, WAVELENGTH)
    opd = reference.lopsided_opd(NPIX)
    truth = opd_to_poppy(opd, system).calc_psf(WAVELENGTH)[0].data
    assert relative(model.calc_psf(opd=opd)[0].data, truth) < 1e-12
    assert relative(model.calc_psf(opd=opd[::-1].copy())[0].data, truth) > 1e-3
    own = opd_to_poppy(model.entrance.opd, system).calc_psf(WAVELENGTH)[0].data
    assert relative(own, system.calc_psf(WAVELENGTH)[0].data) < 1e-12
    coarse = resample(opd, NPIX // 2)
    taken = opd_to_poppy(coarse, system).planes[0].opd
    assert np.array_equal(taken, resample(coarse, NPIX))
    with pytest.raises(ShapeError, match=r"\(95, 96\), expected square maps"):
        opd_to_poppy(opd[:-1], system)


def slope(function, at, step):
    """Directional derivative by autograd against finite differences of fourth order."""
    direction = torch.randn(at.shape, generator=torch.manual_seed(1), dtype=at.dtype)
    variable = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(variable), variable)
    wanted = (gradient * direction).sum()
    f = [function(at + k * step * direction).detach() for k in (-2, -1, 1, 2)]
    found = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * step)
    assert abs(found - wanted) <= 1e-7 * abs(wanted)


@pytest.mark.parametrize("propagation", ["compact", "fft"])
def test_gradients_with_respect_to_the_opd(propagation):
    system = make(pupil(), ("rotate", 15), zernikes(), spot(), stop())
    model = from_poppy(system, WAVELENGTH, propagation=propagation)
    weight = torch.randn(40, 40, generator=torch.manual_seed(2), dtype=torch.float64)
    opd = torch.from_numpy(reference.lopsided_opd(NPIX))
    slope(lambda v: (model(v) * weight).sum(), opd, 1e-10)


def test_planes_become_trainable_on_request():
    system = make(pupil(), ("invert", "y"), zernikes(), spot(), stop())
    model = from_poppy(system, WAVELENGTH, trainable=("aberrations",))
    opd, transmission = model.trainable["aberrations"]
    assert list(model.trainable) == ["aberrations"]
    truth = from_poppy(system, WAVELENGTH)()
    assert relative(model().detach().numpy(), truth.numpy()) < 1e-14
    model().square().sum().backward()
    assert opd.grad.abs().max() > 0
    assert transmission.grad is not None
    # The tensors have the frame of their own plane: poppy agrees on a change of it.
    change = reference.lopsided_opd(NPIX)
    with torch.no_grad():
        opd += torch.from_numpy(change)
    extra = poppy.ArrayOpticalElement(
        name="extra",
        transmission=np.ones_like(change),
        opd=change,
        pixelscale=6.5 / NPIX * u.m / u.pix,
        planetype=PlaneType.pupil,
    )
    system.add_pupil(extra, index=3)
    truth_changed = from_poppy(system, WAVELENGTH)()
    assert relative(model().detach().numpy(), truth_changed.numpy()) < 1e-12


def test_single_precision():
    system = make(pupil(), spot(), stop())
    truth = from_poppy(system, WAVELENGTH)().numpy()
    for propagation in ("compact", "fft"):
        single = from_poppy(system, WAVELENGTH, propagation=propagation, dtype=torch.float32)
        assert single().dtype == torch.float32
        assert relative(single().numpy(), truth) < 1e-4


def fresnel():
    system = poppy.FresnelOpticalSystem(pupil_diameter=2 * u.m, npix=64)
    system.add_optic(poppy.CircularAperture(radius=1 * u.m))
    return system


def without_detector():
    system = make(pupil())
    del system.planes[-1]
    return system


def starting_in_an_image():
    system = make(pupil(), spot())
    del system.planes[0]
    return system


def with_unknown_plane():
    system = make(pupil(), zernikes())
    system.planes[1].planetype = PlaneType.intermediate
    return system


def matrix_fourier():
    return poppy.MatrixFTCoronagraph(make(pupil(), spot(), stop()))


def semi_analytic():
    return poppy.SemiAnalyticCoronagraph(make(pupil(), spot(), stop()), fpm_index=1)


def with_a_mask_on_its_own_samples():
    system = make(pupil(), spot(), stop())
    system.planes[1].propagation_hint = "MFT"
    return system


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        (fresnel, "Fresnel propagation is not supported"),
        (without_detector, r"must be a Detector, got .*Add one"),
        (starting_in_an_image, "first plane must be a pupil"),
        (with_unknown_plane, r"'aberrations' \(ZernikeWFE.*not supported. Supported are"),
        (matrix_fourier, "convert the poppy.OpticalSystem that it was made from"),
        (semi_analytic, "SemiAnalyticCoronagraph propagates.*convert the poppy.OpticalSystem"),
        (with_a_mask_on_its_own_samples, "'spot' asks for a matrix transform"),
        (lambda: make(pupil(), stop(), spot()), "'spot'.*there must be a pupil plane"),
        (lambda: poppy.Instrument(), "expected a poppy.OpticalSystem"),
        (lambda: make(pupil(), spot(), ("invert", "y"), stop()), "moves it by one sample"),
    ],
)
def test_what_is_not_supported_is_named(bad, complaint):
    with pytest.raises(IncompatibleSetupError, match=complaint):
        from_poppy(bad(), WAVELENGTH)


def test_a_mask_without_bounds_cannot_be_forced():
    system = make(pupil(), band_limited(), stop())
    with pytest.raises(IncompatibleSetupError, match=r"'circular mask'.*Use propagation='fft'"):
        from_poppy(system, WAVELENGTH, propagation="compact")
    with pytest.raises(IncompatibleSetupError, match="expected 'auto', 'compact' or 'fft'"):
        from_poppy(system, WAVELENGTH, propagation={"circular mask": "mft"})
    with pytest.raises(IncompatibleSetupError, match="normalize"):
        from_poppy(system, WAVELENGTH).calc_psf(normalize="lats")
    with pytest.raises(IncompatibleSetupError, match="return_intermediates=True"):
        from_poppy(system, WAVELENGTH).calc_psf(save_intermediates=True)


def test_a_users_own_mask_says_how_far_it_reaches():
    system = make(pupil(), stop())
    mask = reference.SombreroOcculter(name="own")
    mask.occulter_box = 2.2
    system.add_image(mask, index=1)
    model = from_poppy(system, WAVELENGTH)
    assert model.propagation == {"own": "compact"}
    assert relative(model.calc_psf()[0].data, system.calc_psf(WAVELENGTH)[0].data) < 1e-12
