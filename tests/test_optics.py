"""The optical system: conventions, energy, derivatives, bad input."""

import math

import numpy as np
import pytest
import torch
from astropy import units as u

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument import FLIGHT_ALIGNMENT
from pyklip_diffrender.instrument.masks import FILTERS, MASKS
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.instrument.spectrum import filter_bandpass, filter_throughput
from pyklip_diffrender.io import ARCSEC
from pyklip_diffrender.optics import Bandpass
from pyklip_diffrender.optics.grid import JWST_DIAMETER
from pyklip_diffrender.parameters import OPTICAL_PARAMETERS, parameter
from pyklip_diffrender.wavefront import random_opd

WAVELENGTH = 4.5e-6


def small(filter="F444W", **changes):
    settings = {"monochromatic": WAVELENGTH, "npix": 96, "fov_pixels": 24, **changes}
    return nircam_coronagraph(filter, **settings)


OPD = torch.from_numpy(random_opd(5, npix=96).data)


def test_light_is_conserved_without_masks():
    """On a field of one period of the transform, the image holds all of the pupil's light."""
    scale = WAVELENGTH / (JWST_DIAMETER / 96) / ARCSEC / 192
    bare = {"image_mask": None, "pupil_mask": None, "si_wfe": False}
    full = small(**bare, fov_pixels=192, pixelscale=scale)
    assert float(full(OPD).sum()) == pytest.approx(1.0, rel=1e-10)


def test_a_source_at_positive_offset_appears_at_positive_offset():
    model = small(image_mask=None, fov_pixels=31)
    scale = model.detector.pixelscale[0]
    image = model(None, (6 * scale, -4 * scale)).numpy()
    assert np.unravel_index(image.argmax(), image.shape) == (15 - 4, 15 + 6)


@pytest.mark.parametrize("mask", ["MASK335R", None])
def test_detector_shift_moves_the_image_and_nothing_else(mask):
    """By the route through the occulter's cells, and by that through the planes."""
    model = small(image_mask=mask)
    scale = model.detector.pixelscale[0]
    moved = model(OPD, detector_shift=(3 * scale, -2 * scale))
    torch.testing.assert_close(moved[:-2, 3:], model(OPD)[2:, :-3], rtol=1e-10, atol=1e-16)


def test_blur_is_a_standard_deviation():
    """Variances of Gaussians add, to the 1e-6 by which a sampled one differs."""
    scale, width, blur = 0.06, 2.0, 0.09
    detector = small(fov_pixels=33, pixelscale=scale).detector
    x = torch.arange(33, dtype=torch.float64) - 16

    def gaussian(variance):
        profile = torch.exp(-(x**2) / (2 * variance)) / variance**0.5
        return profile[:, None] * profile

    values = {"blur": torch.tensor([blur], dtype=torch.float64)}
    blurred = detector.image(gaussian(width**2), values)
    expected = gaussian(width**2 + (blur / scale) ** 2)
    torch.testing.assert_close(blurred, expected, rtol=0, atol=1e-5 * float(expected.max()))


def test_shear_and_rectangular_pixels_sample_the_same_image():
    """Every pixel of a sheared, anisotropic array equals a small array centred on that pixel."""
    model = small(pixelscale=(0.060, 0.065), shear=-0.02, fov_pixels=(9, 11))
    image = model(OPD)
    point = small(fov_pixels=1, pixelscale=(0.060, 0.065))
    for row, column in ((0, 0), (8, 2), (3, 10)):
        x = (column - 5) * 0.060
        y = (row - 4) * 0.065 - 0.02 * x
        single = point(OPD, detector_shift=(-x, -y))
        assert float(single[0, 0]) == pytest.approx(float(image[row, column]), rel=1e-9)


def test_oversampled_pixels_are_the_sum_of_their_samples():
    scale = small().detector.pixelscale[0] / 3
    # By one route: the cells of the other are those that suit the detector.
    fine = small(fov_pixels=72, pixelscale=scale, route="planes")(OPD)
    binned = fine.reshape(24, 3, 24, 3).sum(dim=(1, 3))
    coarse = small(oversample=3, route="planes")(OPD)
    torch.testing.assert_close(coarse, binned, rtol=1e-10, atol=1e-18)


def test_broadband_is_the_weighted_sum_of_wavelengths():
    model = small(monochromatic=None, nlambda=3)
    band, reference = model.bandpass, model.bandpass.mean_wavelength
    images = torch.stack(
        [small(monochromatic=w, chromatic_reference=reference)(OPD) for w in band.wavelengths]
    )
    for weights in (None, torch.tensor([3.0, 0.0, 1e9], dtype=torch.float64)):
        given = torch.tensor(band.weights, dtype=torch.float64) if weights is None else weights
        expected = torch.tensordot(given, images, dims=1)
        torch.testing.assert_close(model(OPD, weights=weights), expected, rtol=1e-12, atol=1e-20)


def test_batches_equal_single_calls():
    model = small()
    opds = torch.stack([OPD, 2 * OPD])
    offsets = torch.tensor([[0.01, 0.0], [0.3, -0.2]], dtype=torch.float64)
    batch = model(opds, offsets)
    for k in range(2):
        torch.testing.assert_close(batch[k], model(opds[k], offsets[k]), rtol=1e-10, atol=1e-18)


def test_float32_is_close_to_float64():
    exact, single = small()(OPD), small(dtype=torch.float32)(OPD)
    assert single.dtype == torch.float32
    # Seven digits of the field before the occulter, which removes 99 % of the light.
    assert float((single - exact).abs().max() / exact.max()) < 2e-5


STANDING = {"blur": 26 * u.mas, "lyot_shift": (-0.013, 0.008), "lyot_rotation": 0.6}


@pytest.mark.parametrize("changes", [{}, {"image_mask": None}, {"route": "planes"}], ids=str)
def test_defaults_are_what_a_call_does_not_give(changes):
    plain, model = small(**changes), small(**changes, defaults=STANDING)
    expected = plain(OPD, **STANDING)
    assert float((plain(OPD) - expected).abs().max()) > 1e-2 * float(expected.max())
    torch.testing.assert_close(model(OPD), expected, rtol=0, atol=0)
    torch.testing.assert_close(model(OPD, blur=None), expected, rtol=0, atol=0)
    image = model.image_of(model.fields(OPD), model.values({}))
    torch.testing.assert_close(image, expected, rtol=0, atol=0)
    fields = model.debug(OPD)
    if "image_mask" not in changes:
        assert list(fields) == [
            "JWST pupil", "MASK335R focus", "MASK335R", "MASKRND", "NIRCam internal WFE", "detector"
        ]  # fmt: skip
    torch.testing.assert_close(fields["detector"], plain.debug(OPD, **STANDING)["detector"])
    intensity = plain.debug(OPD)["detector"].abs() ** 2
    torch.testing.assert_close(intensity, plain(OPD), rtol=1e-10, atol=1e-20)
    # What a call gives counts, and leaves the other parameters where they are.
    other = {**STANDING, "lyot_shift": (0.004, 0.001), "star_offset": (0.02, -0.01)}
    given = {name: other[name] for name in ("lyot_shift", "star_offset")}
    torch.testing.assert_close(model(OPD, **given), plain(OPD, **other), rtol=0, atol=0)
    zero = {"blur": 0.0, "lyot_shift": (0.0, 0.0), "lyot_rotation": 0.0}
    torch.testing.assert_close(model(OPD, **zero), plain(OPD), rtol=1e-9, atol=1e-18)


def test_defaults_stay_with_copies_of_another_fidelity():
    given = dict(FLIGHT_ALIGNMENT)
    model = small(npix=192, defaults=given)
    given["lyot_rotation"] = 40.0  # The caller's own; the model has a copy.
    coarse = model.with_fidelity(npix=96)
    torch.testing.assert_close(coarse(OPD), small()(OPD, **FLIGHT_ALIGNMENT), rtol=0, atol=0)
    assert not model.with_fidelity(defaults=None).defaults
    cheap = coarse.with_fidelity(fov_pixels=20)
    expected = small(fov_pixels=20)(OPD, **FLIGHT_ALIGNMENT)
    torch.testing.assert_close(cheap(OPD), expected, rtol=0, atol=0)


def test_what_is_kept_for_one_position_is_not_used_for_another():
    """Nor does it hide a derivative: a parameter may be varied after it has stood still."""
    model = small()
    one, other = {"lyot_shift": (0.01, 0.0), "detector_shift": (0.02, 0.01)}, {"lyot_rotation": 1.0}
    for values in (one, other, {}, one, {**one, **other}):
        torch.testing.assert_close(model(OPD, **values), small()(OPD, **values), rtol=0, atol=0)
    shift = torch.tensor([0.01, 0.0], dtype=torch.float64)
    model(OPD, lyot_shift=shift)
    shift.requires_grad_()
    with torch.no_grad():
        model(OPD, lyot_shift=shift)
    (slope,) = torch.autograd.grad(model(OPD, lyot_shift=shift).sum(), shift)
    fresh = shift.detach().clone().requires_grad_()
    (expected,) = torch.autograd.grad(small()(OPD, lyot_shift=fresh).sum(), fresh)
    torch.testing.assert_close(slope, expected, rtol=1e-12, atol=0)
    forward = torch.func.jacfwd(lambda s: model(OPD, lyot_shift=s).sum())(shift.detach())
    torch.testing.assert_close(forward, slope, rtol=1e-9, atol=0)


# Radius of half the transmitted light, arcsec: 6 lambda/D at 2.1, 3.35 and 4.3 um (Krist et al.
# 2009), of the intensity, and rounded to a percent.
@pytest.mark.parametrize(
    ("name", "half"), [("MASK210R", 0.400), ("MASK335R", 0.638), ("MASK430R", 0.812)]
)
def test_half_of_the_light_passes_where_the_mask_is_named_for(name, half):
    mask, zero = MASKS[name], torch.zeros(1, dtype=torch.float64)
    for factor, passes in ((0.985, False), (1.015, True)):
        assert ((1 - mask.complement(zero + factor * half, zero)) ** 2 > 0.5) == passes
    beyond = torch.tensor([mask.radius * (1 + 1e-12), 10.0], dtype=torch.float64)
    assert not mask.complement(beyond, zero).any()


def start_of(name):
    """A point away from special places for every parameter."""
    entry = parameter(name)
    generator = torch.Generator().manual_seed(len(name))
    size = 0.02 if name == "blur" else entry.prior * 0.3
    return size * (0.5 + torch.rand(entry.size, dtype=torch.float64, generator=generator))


@pytest.mark.hard
@pytest.mark.parametrize("name", [p.name for p in OPTICAL_PARAMETERS])
def test_gradcheck_of_every_parameter(name):
    model = small(npix=48, fov_pixels=6)
    coarse = OPD.reshape(48, 2, 48, 2).mean(dim=(1, 3))
    unit = parameter(name).prior if name != "blur" else 0.02

    def image(value):
        # In units of the parameter's own size, and of the image's peak: numbers of order 1.
        return 1e5 * model(coarse, **{name: value * unit})

    value = (start_of(name) / unit).requires_grad_()
    assert torch.autograd.gradcheck(image, (value,), eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.hard
@pytest.mark.parametrize("what", ["phase", "amplitude"])
def test_gradcheck_of_the_opd(what):
    model = small(npix=12, fov_pixels=5)
    opd = random_opd(7, npix=12).data
    nm = torch.from_numpy(opd * 1e9 if what == "phase" else np.full_like(opd, 20.0))

    def image(nm):
        absorbed = torch.complex(torch.from_numpy(opd), nm * 1e-9)
        return 1e5 * model(nm * 1e-9 if what == "phase" else absorbed)

    assert torch.autograd.gradcheck(image, nm.requires_grad_(), eps=1e-3, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("name", FILTERS)
def test_bandpass_weights_sum_to_one_and_lie_in_the_filter(name):
    wavelength, throughput = filter_throughput(name)
    assert (np.diff(wavelength) > 0).all()
    assert throughput.max() == pytest.approx(1.0, abs=1e-3)
    band = filter_bandpass(name, 9)
    assert math.fsum(band.weights) == pytest.approx(1.0, abs=1e-12)
    assert list(band.wavelengths) == sorted(band.wavelengths)
    assert band.mean_wavelength == pytest.approx(float(name[1:4]) * 1e-8, rel=0.05)
    cool, hot = (filter_bandpass(name, 5, each).mean_wavelength for each in (2000.0, 9000.0))
    assert cool > hot


BAND = Bandpass((4.4e-6, 3.9e-6, 4.1e-6, 4.95e-6, 4.7e-6), (0.3, 0.1, 0.25, 0.15, 0.2))


def moment(band, order):
    x = (np.array(band.wavelengths) - 4.4e-6) / 1e-6
    return float(np.array(band.weights) @ x**order)


# The nodes come from a recurrence, which loses digits with the number of wavelengths.
@pytest.mark.parametrize(
    ("band", "count"), [(BAND, 1), (BAND, 3), (BAND, 4), (filter_bandpass("F444W", 21), 9)]
)
def test_polynomials_keep_their_sums(band, count):
    few = band.condensed(count)
    assert len(few.wavelengths) == count
    assert min(band.wavelengths) < min(few.wavelengths)
    assert max(few.wavelengths) < max(band.wavelengths)
    for order in range(2 * count):
        assert moment(few, order) == pytest.approx(moment(band, order), rel=1e-10, abs=1e-12)
    # That is all that so few nodes can do.
    assert count == 9 or moment(few, 2 * count) != pytest.approx(moment(band, 2 * count), rel=1e-6)
    assert BAND.condensed(5) is BAND
    assert BAND.width == pytest.approx(1.05 / 4.4175)


def test_a_given_spectrum_is_used():
    line = (np.array([3e-6, 4.39e-6, 4.4e-6, 4.41e-6, 6e-6]), np.array([0, 0, 1.0, 0, 0]))
    band = filter_bandpass("F444W", 7, line)
    assert band.mean_wavelength == pytest.approx(4.4e-6, abs=1e-8)
    assert len(band.wavelengths) < 7
    with pytest.raises(IncompatibleSetupError, match="no light"):
        filter_bandpass("F444W", 7, (line[0], 0 * line[1]))
    with pytest.raises(IncompatibleSetupError, match=r"'F150W'.*F182M.*F480M"):
        filter_throughput("F150W")


LEGAL = r".*F182M.*F212N \(short wave\) or F250M.*F480M \(long wave\)"


@pytest.mark.hard
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"filter": "F444", "image_mask": "MASK430R"}, "'F444'" + LEGAL),
        ({"filter": "F115W", "image_mask": "MASK210R"}, "'F115W'" + LEGAL),
        ({"filter": "nonsense", "image_mask": None}, "'nonsense'" + LEGAL),
        ({"monochromatic": 4.5}, "metres"), ({"monochromatic": 2e-6}, "outside F444W"),
        ({"image_mask": "MASKXWB"}, "MASK210R.*MASKLWB"),
        ({"pupil_mask": "MASKLWB"}, "MASKRND.*MASKBAR"),
        ({"image_mask": "MASKLWB", "bar_place": "F210M"}, "bar_place.*'F210M'.*F444W.*NARROW"),
        ({"defaults": {"star_offset": (0.1, 0.0)}}, "belongs to a source"),
        ({"fov_pixels": 10, "fov_arcsec": 1.0}, "not both"), ({"fov_pixels": 0}, "at least 1"),
        ({"occulter_sampling": 0.5}, "at least 1"), ({"dtype": torch.float16}, "float32"),
    ],
)  # fmt: skip
def test_impossible_settings_are_refused(changes, words):
    with pytest.raises(IncompatibleSetupError, match=words):
        small(**changes)


def test_an_imaginary_opd_changes_the_amplitude_and_nothing_else():
    """OPD -1j a: the amplitude grows by exp(2 pi a / wavelength) everywhere, the light squared."""
    model = small(image_mask=None)
    gain = 30e-9
    brighter = model(torch.complex(OPD, torch.full_like(OPD, -gain)))
    expected = model(OPD) * math.exp(4 * math.pi * gain / WAVELENGTH)
    torch.testing.assert_close(brighter, expected, rtol=1e-12, atol=1e-20)
