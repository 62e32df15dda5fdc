"""What holds for every shape, wavefront and flux, tried on many."""

from functools import lru_cache

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.io import ARCSEC
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.wavefront import random_opd

WAVELENGTH = 4.5e-6
SCALE = 0.062424185
SIDES = st.integers(1, 13)
SAMPLES = st.sampled_from([48, 51])
"""Even and odd; the field of 13 pixels lies well inside the period of both."""

OFFSETS = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
RMS = st.floats(1e-9, 2e-6)
SEEDS = st.integers(0, 3)
ROUNDING = 1e-9


@lru_cache(maxsize=64)
def system(npix, ny, nx, oversample=1, **changes):
    return nircam_coronagraph(
        monochromatic=WAVELENGTH, npix=npix, fov_pixels=(ny, nx), oversample=oversample, **changes
    )


@lru_cache(maxsize=16)
def unit_wavefront(seed, npix):
    """1 m rms."""
    return torch.from_numpy(random_opd(seed, npix=npix, rms=1.0).data)


@given(npix=SAMPLES, offset=OFFSETS, rms=RMS, seed=SEEDS,
       shift=st.tuples(st.floats(-0.04, 0.04), st.floats(-0.04, 0.04)),
       angle=st.floats(-4, 4), ny=SIDES, oversample=st.integers(1, 3))  # fmt: skip
def test_no_plane_adds_light(npix, offset, rms, seed, shift, angle, ny, oversample):
    """And the aberration, which has no amplitude, takes none."""
    model = system(npix, ny, 4, oversample)
    opd = rms * unit_wavefront(seed, npix)
    given_ = {"star_offset": offset, "lyot_shift": shift, "lyot_rotation": angle}
    values = model.values(given_)
    wavefront = model.pupil_field(opd, WAVELENGTH, values)
    light = [power(wavefront)]
    for plane, onto in zip(model.between, model.windows(values), strict=True):
        before, wavefront = wavefront, plane.apply(wavefront, values, onto)
        light.append(power(wavefront))
        if plane.name != "MASK335R":
            # A pupil plane does not at any point.
            there = before.grid.crop(before.field, wavefront.grid).abs()
            assert bool((wavefront.field.abs() <= there * (1 + ROUNDING)).all())
    entrance, occulted, stopped, aberrated = light
    assert entrance == pytest.approx(1.0, rel=1e-12)
    assert entrance >= occulted - ROUNDING
    assert occulted >= stopped - ROUNDING
    assert aberrated == pytest.approx(stopped, rel=1e-12)
    image = model(opd, **given_)
    assert image.shape == (ny, 4)
    assert float(image.min()) >= 0
    assert 0 < float(image.sum()) <= aberrated + ROUNDING


def power(wavefront):
    return float((wavefront.field.abs() ** 2).sum()) * wavefront.grid.spacing**2


@given(ny=st.integers(2, 20), nx=st.integers(2, 20), oversample=st.integers(1, 3),
       sigma=st.floats(0, 0.1), seed=SEEDS)  # fmt: skip
def test_blur_and_binning_keep_the_light(ny, nx, oversample, sigma, seed):
    detector = system(48, ny, nx, oversample).detector
    generator = torch.Generator().manual_seed(seed)
    samples = torch.rand(oversample * ny, oversample * nx, generator=generator).double()
    image = detector.image(samples, {"blur": torch.tensor([sigma], dtype=torch.float64)})
    assert image.shape == (ny, nx)
    assert float(image.sum()) == pytest.approx(float(samples.sum()), rel=1e-10)


@given(npix=SAMPLES, ny=SIDES, nx=SIDES, more=st.tuples(st.integers(0, 4), st.integers(0, 4)),
       offset=OFFSETS, seed=SEEDS)  # fmt: skip
def test_odd_and_even_arrays_see_the_same_image(npix, ny, nx, more, offset, seed):
    """More rows at the top and columns on the right move the middle by half as many pixels."""
    opd = 66e-9 * unit_wavefront(seed, npix)
    small = system(npix, ny, nx)(opd, offset)
    shift = (-more[1] * SCALE / 2, -more[0] * SCALE / 2)
    large = system(npix, ny + more[0], nx + more[1])(opd, offset, detector_shift=shift)
    torch.testing.assert_close(large[:ny, :nx], small, rtol=1e-8, atol=1e-14)


@given(npix=SAMPLES, ny=SIDES, nx=SIDES, offset=OFFSETS, seed=SEEDS)
def test_a_tilted_wavefront_is_a_star_off_the_axis(npix, ny, nx, offset, seed):
    grid = PupilGrid.full(npix)
    tilt = -offset[0] * grid.x[None, :] + offset[1] * grid.y[:, None]
    opd = 66e-9 * unit_wavefront(seed, npix)
    model = system(npix, ny, nx)
    torch.testing.assert_close(
        model(opd + ARCSEC * tilt), model(opd, offset), rtol=1e-8, atol=1e-15
    )
