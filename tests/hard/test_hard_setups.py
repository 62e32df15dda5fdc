"""Set-ups and numbers that do not go together are refused, with what would do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hard_cases import DTYPES, small, system, wavefront
from stability_fits import fitted, observed, star

from pyklip_diffrender.errors import (
    DiffrenderError,
    DiffrenderWarning,
    IncompatibleSetupError,
    NonFiniteError,
    NoValidPixelsError,
)
from pyklip_diffrender.scene import Observation, Scene, simulate
from pyklip_diffrender.wavefront import as_opd_map

pytestmark = pytest.mark.hard


def test_a_frame_of_another_filter_is_refused():
    with pytest.raises(IncompatibleSetupError, match=r"F335M.*F444W"):
        fitted(replace(observed(star()), filter="F335M"), max_iterations=1)


@pytest.mark.parametrize(
    ("key", "value"), [("MODULE", "B"), ("CORONMSK", "MASKA210R"), ("PUPIL", "MASKBAR")]
)
def test_a_frame_behind_another_mask_is_refused(key, value):
    frame = observed(star())
    header = frame.header.copy()
    header[key] = value
    with pytest.raises(IncompatibleSetupError, match=value):
        fitted(replace(frame, header=header), max_iterations=1)


def test_a_frame_of_the_same_instrument_is_taken():
    """Headers name the module with the mask; pixels are not square."""
    frame = observed(star())
    header = frame.header.copy()
    header.update({"MODULE": "A", "CORONMSK": "MASKA335R", "PUPIL": "MASKRND"})
    real = replace(frame, header=header, filter="F444W", pixelscale=(0.0620, 0.0628))
    fit = fitted(real, max_iterations=1)
    assert fit.frames[0].star.tobytes() == fitted(frame, max_iterations=1).frames[0].star.tobytes()


def test_a_frame_of_another_pixel_scale_is_refused():
    """The short-wave channel has half the scale."""
    with pytest.raises(IncompatibleSetupError, match=r"0\.031"):
        fitted(replace(observed(star()), pixelscale=(0.031, 0.031)), max_iterations=1)


@pytest.mark.parametrize("scale", [float("nan"), 0.0, -0.06, float("inf")])
def test_an_impossible_pixel_scale_is_refused(scale):
    with pytest.raises(DiffrenderError, match="pixelscale"):
        Observation.from_arrays(np.ones((4, 4)), np.ones((4, 4)), pixelscale=scale)


@pytest.mark.parametrize("kind", [np.float64, np.float32, ">f8", ">f4"])
def test_nan_inside_the_pupil_is_counted_and_located_in_any_type(kind):
    bad = wavefront().numpy().astype(kind)
    bad[30, 50], bad[31, 40] = np.nan, -np.inf
    with pytest.raises(NonFiniteError, match=r"2 values inside the pupil.*\(30, 50\)"):
        as_opd_map(bad)
    with pytest.raises(NonFiniteError, match=r"2 values.*\(30, 50\)"):
        small()(bad)


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
def test_big_endian_read_only_and_scaled_wavefronts_give_the_same_bits(dtype):
    steps = np.round(wavefront().numpy() / 1e-11).astype(np.int16)
    plain = steps * 1e-11
    model = system(dtype)
    expected = model(plain).numpy()
    big = plain.astype(">f8")
    big.setflags(write=False)
    for kind in (big, np.asfortranarray(plain), as_opd_map(plain), plain.tolist()):
        assert model(kind).numpy().tobytes() == expected.tobytes()
    assert not np.array_equal(model(1.01 * plain).numpy(), expected)


@pytest.mark.parametrize(
    "call",
    [lambda opd: small()(opd), lambda opd: simulate(small(), Scene(), opd, seed=1)],
    ids=["model", "simulate"],
)
def test_bare_nanometres_warn_wherever_they_come_in(call):
    with pytest.warns(DiffrenderWarning, match="in nm it would be plausible"):
        call(wavefront().numpy() * 1e9)


def test_what_a_fit_may_try_does_not_warn():
    """Tensors are what is fitted; a mode of 1 pm is a fair question. Warnings are errors here."""
    assert small()(wavefront() * 1e9).isfinite().all()
    assert small()(1e-12 * wavefront(rms=1.0).numpy()).isfinite().all()


def test_a_field_wider_than_the_pupil_resolves_is_refused():
    """32 samples repeat the image after 32 lambda/D, 4.5 arcsec: the field has 5."""
    with pytest.raises(IncompatibleSetupError, match="npix"):
        small(npix=32, fov_pixels=80)


def test_nothing_left_to_fit_is_an_error():
    frame = observed(star())
    with pytest.raises(NoValidPixelsError):
        fitted(replace(frame, valid=np.zeros_like(frame.valid)))
    with pytest.raises(NoValidPixelsError):
        Observation.from_arrays(np.full((4, 4), np.nan), np.ones((4, 4)), pixelscale=0.06)
