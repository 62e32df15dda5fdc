"""What holds for every shape, wavefront and flux, tried on many."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pyklip_diffrender.instrument import jwst_pupil, maskrnd_openings, nircam_coronagraph
from pyklip_diffrender.io import ARCSEC
from pyklip_diffrender.optics import (
    JWST_DIAMETER,
    MatrixFourier,
    PupilGrid,
    polygon_coverage,
    resample,
    transform_polygons,
)
from pyklip_diffrender.scene import (
    Observation,
    Planet,
    Scene,
    Star,
    expected_photons,
    planet_photons,
    star_photons,
)
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


@given(npix=SAMPLES, ny=SIDES, nx=SIDES, oversample=st.integers(1, 3), offset=OFFSETS, rms=RMS,
       seed=SEEDS, mask=st.sampled_from(["MASK335R", None]))  # fmt: skip
def test_no_image_holds_more_light_than_the_pupil_collects(
    npix, ny, nx, oversample, offset, rms,
    seed, mask,
):  # fmt: skip
    model = system(npix, ny, nx, oversample, image_mask=mask)
    image = model(rms * unit_wavefront(seed, npix), offset)
    assert image.shape == (ny, nx)
    assert float(image.min()) >= 0
    assert 0 < float(image.sum()) <= 1 + ROUNDING


@given(npix=SAMPLES, offset=OFFSETS, rms=RMS, seed=SEEDS,
       shift=st.tuples(st.floats(-0.04, 0.04), st.floats(-0.04, 0.04)),
       angle=st.floats(-4, 4))  # fmt: skip
def test_no_plane_adds_light(
    npix, offset, rms, seed, shift,
    angle,
):  # fmt: skip
    """And the aberration, which has no amplitude, takes none."""
    model = system(npix, 4, 4)
    given_ = {"star_offset": offset, "lyot_shift": shift, "lyot_rotation": angle}
    values = model.values(given_)
    wavefront = model.pupil_field(rms * unit_wavefront(seed, npix), WAVELENGTH, values)
    light = [power(wavefront)]
    for plane, onto in zip(model.planes, model.windows(values), strict=True):
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
    assert stopped > 0


def power(wavefront):
    return float((wavefront.field.abs() ** 2).sum()) * wavefront.grid.spacing**2


@given(shift=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), angle=st.floats(-10, 10),
       npix=st.integers(2, 40))  # fmt: skip
def test_stops_never_amplify_and_keep_their_area(shift, angle, npix):
    moved = transform_polygons(
        maskrnd_openings(),
        torch.tensor(shift, dtype=torch.float64),
        torch.deg2rad(torch.tensor(angle, dtype=torch.float64)),
    )
    grid = PupilGrid.full(npix)
    cover = polygon_coverage(moved, grid)
    assert float(cover.min()) >= -1e-12
    assert float(cover.max()) <= 1 + 1e-12
    rest = polygon_coverage(maskrnd_openings(), PupilGrid.full(40))
    area = float(rest.sum()) * PupilGrid.full(40).spacing ** 2
    # None of it leaves the array, which is 0.3 m larger on every side.
    inside = all((o.abs().max() < JWST_DIAMETER / 2) for o in moved)
    if inside:
        assert float(cover.sum()) * grid.spacing**2 == pytest.approx(area, rel=1e-9)


@given(ny=st.integers(2, 20), nx=st.integers(2, 20), oversample=st.integers(1, 3),
       sigma=st.floats(0, 0.1), seed=SEEDS)  # fmt: skip
def test_blur_and_binning_keep_the_light(ny, nx, oversample, sigma, seed):
    detector = system(48, ny, nx, oversample).detector
    generator = torch.Generator().manual_seed(seed)
    samples = torch.rand(oversample * ny, oversample * nx, generator=generator).double()
    blur = {"blur": torch.tensor([sigma], dtype=torch.float64)}
    image = detector.image(samples, blur)
    assert image.shape == (ny, nx)
    assert float(image.sum()) == pytest.approx(float(samples.sum()), rel=1e-10)
    # No blur adds contrast to what it is applied to. (Binning afterwards may: it aliases.)
    blurred = system(48, oversample * ny, oversample * nx).detector.image(samples, blur)
    assert float(blurred.std()) <= float(samples.std()) * (1 + ROUNDING)


@given(factor=st.floats(1e-12, 1e12), npix=SAMPLES, offset=OFFSETS, seed=SEEDS)
def test_images_are_linear_in_the_spectrum(factor, npix, offset, seed):
    model = nircam_coronagraph(npix=npix, fov_pixels=(5, 6), nlambda=2)
    opd = 66e-9 * unit_wavefront(seed, npix)
    weights = torch.tensor(model.bandpass.weights, dtype=torch.float64)
    first, second = (model(opd, offset, weights=weights * w) for w in torch.eye(2))
    torch.testing.assert_close(
        model(opd, offset, weights=factor * weights), factor * (first + second), rtol=1e-12, atol=0
    )


@given(contrasts=st.tuples(st.floats(1e-10, 1.0), st.floats(1e-10, 1.0)),
       magnitude=st.floats(-2, 15), background=st.floats(0, 1e6))  # fmt: skip
def test_scenes_are_linear_in_star_planets_and_background(contrasts, magnitude, background):
    model, opd = system(48, 9, 8), 66e-9 * unit_wavefront(0, 48)
    planets = Planet(contrasts[0], 0.2, 70.0), Planet(contrasts[1], 0.25, 200.0)
    star = Star(w2_magnitude=magnitude)
    scene = Scene(star=star, planets=planets, background=background)
    bright = Scene(star=Star(w2_magnitude=magnitude - 2.5), planets=planets, background=background)
    parts = star_photons(model, scene, opd) + background
    for each in planets:
        parts = parts + planet_photons(model, scene, each, opd)
    total = expected_photons(model, scene, opd)
    np.testing.assert_allclose(total, parts, rtol=1e-12)
    np.testing.assert_allclose(
        expected_photons(model, bright, opd) - background, 10 * (total - background),
        rtol=1e-9, atol=1e-12 * background,
    )  # fmt: skip
    ratio = planet_photons(model, scene, planets[0], opd) / contrasts[0]
    alone = planet_photons(model, Scene(star=star), Planet(1.0, 0.2, 70.0), opd)
    np.testing.assert_allclose(ratio, alone, rtol=1e-12)


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


@given(npix=st.integers(3, 9), data=st.data(), nx=SIDES, ny=SIDES, shear=st.floats(-0.1, 0.1),
       centred=st.booleans())  # fmt: skip
def test_the_matrix_transform_is_the_plain_sum(npix, data, nx, ny, shear, centred):
    """Any window, any positions."""
    limits = [sorted(data.draw(st.lists(st.integers(0, npix), min_size=2, max_size=2, unique=True)))
              for _ in range(2)]  # fmt: skip
    grid = PupilGrid(npix, JWST_DIAMETER, tuple(limits[0]), tuple(limits[1]))
    x, y = (
        ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * 0.06 + (0 if centred else 0.01 * n))
        * ARCSEC
        for n in (nx, ny)
    )
    generator = torch.Generator().manual_seed(npix)
    field = torch.randn(*grid.shape, dtype=torch.complex128, generator=generator)
    transform = MatrixFourier(grid, x, y, WAVELENGTH, shear=shear)
    true_y = y[:, None] + shear * x[None, :]
    phase = (
        x[None, :, None, None] * grid.x[None, None, None, :]
        - true_y[:, :, None, None] * grid.y[None, None, :, None]
    )
    kernel = torch.exp(2j * math.pi / WAVELENGTH * phase)
    plain = (kernel * field).sum(dim=(2, 3)) * grid.spacing**2 / WAVELENGTH
    scale = float(field.abs().sum()) * grid.spacing**2 / WAVELENGTH
    assert float((transform.forward(field) - plain).abs().max()) <= 1e-13 * scale
    assert float(plain.abs().max()) > 0


@given(npix=st.integers(2, 40), factor=st.integers(2, 4), slope=st.tuples(
    st.floats(-1e-6, 1e-6), st.floats(-1e-6, 1e-6)))  # fmt: skip
def test_resampling_by_whole_factors_keeps_means_and_planes(npix, factor, slope):
    def plane(n):
        axis = (np.arange(n) + 0.5) / n
        return slope[0] * axis[None, :] + slope[1] * axis[:, None] + 1e-8

    np.testing.assert_allclose(resample(plane(npix * factor), npix), plane(npix), atol=1e-19)


@pytest.mark.parametrize("npix", [2, 7, 16, 31, 39])
def test_pupils_of_any_size_have_the_same_area(npix):
    """To the pixels in which a strut crosses the edge of a segment: 1.7e-4, the most, at 39."""
    cover = jwst_pupil(npix)
    assert cover.shape == (npix, npix)
    assert 0 <= float(cover.min()) <= float(cover.max()) <= 1
    area = float(cover.sum()) * (JWST_DIAMETER / npix) ** 2
    reference = float(jwst_pupil(1).sum()) * JWST_DIAMETER**2
    assert area == pytest.approx(reference, rel=2e-4)


@given(ny=st.integers(3, 12), nx=st.integers(3, 12), size=st.integers(1, 3),
       place=st.tuples(st.floats(0, 1), st.floats(0, 1)))  # fmt: skip
def test_cutouts_of_any_size_hold_the_star_in_their_middle(ny, nx, size, place):
    data = np.arange(1.0, ny * nx + 1).reshape(ny, nx)
    # As far from the edge as half a cut-out, and half a pixel for rounding.
    room = size / 2
    if nx < 2 * room + 1 or ny < 2 * room + 1:
        return
    center = (room + place[0] * (nx - 1 - 2 * room), room + place[1] * (ny - 1 - 2 * room))
    whole = Observation.from_arrays(data, data, pixelscale=SCALE, center=center)
    cut = whole.cutout(size)
    assert cut.shape == (size, size)
    assert np.abs(cut.center - (size - 1) / 2).max() <= 0.5 + 1e-12
    # The pixel under the star is the same one.
    corner = np.round(whole.center[0] - cut.center[0]).astype(int)
    rows, columns = slice(corner[1], corner[1] + size), slice(corner[0], corner[0] + size)
    np.testing.assert_array_equal(cut.data[0], data[rows, columns])


@given(separation=st.floats(1e-3, 10), angle=st.floats(-720, 720))
def test_position_angles_go_round(separation, angle):
    x, y = Planet(1.0, separation, angle).offset
    assert math.hypot(x, y) == pytest.approx(separation, rel=1e-12)
    back = math.degrees(math.atan2(-x, y))
    assert (back - angle + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)
