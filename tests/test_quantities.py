"""Quantities: every length, angle, time, flux and temperature takes one in any unit."""

import math

import numpy as np
import pytest
import torch
from astropy import units as u

import pyklip_diffrender as dr
from pyklip_diffrender.errors import IncompatibleSetupError, UnitError
from pyklip_diffrender.refinement.forward import Problem
from pyklip_diffrender.wavefront.opd import as_opd_map, random_drift

OPD = dr.wavefront.random_opd(1, npix=64).data


def coronagraph(**arguments):
    """Image of the model, and what it is made of."""
    small = {"npix": 64, "fov_pixels": 6, "nlambda": 2, "filter": "F444W"}
    if "fov_arcsec" in arguments:
        del small["fov_pixels"]
    model = dr.nircam_coronagraph(**small | arguments)
    with torch.no_grad():
        return model(star_offset=(0.05, 0.02)).numpy()


def observation(**details):
    ones = np.ones((2, 4, 4))
    made = dr.Observation.from_arrays(ones, ones, **{"pixelscale": 0.06} | details)
    return [made.pixelscale, made.star_offset, made.position_angles]


def problem(**start):
    """Starting values of a fit."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=6)
    ones = np.ones((6, 6))
    frames = dr.Observation.from_arrays(
        ones, ones, unit="MJy/sr", pixelscale=model.detector.pixelscale
    )
    made = Problem(model, frames, as_opd_map(OPD), start)
    optical = [value.tolist() for value in made.optical_start(()).values()]
    return [optical, made.start.get("flux"), made.start.get("background")]


CASES = {
    "Planet": (dr.Planet, {
        "contrast": (1e-4 * u.percent, 1e-6),
        "separation": (600 * u.mas, 0.6),
        "position_angle": (0.5 * u.rad, math.degrees(0.5)),
    }),
    "Planet.from_offset": (lambda **given: dr.Planet.from_offset(1e-6, **given), {
        "x": (-300 * u.mas, -0.3),
        "y": (0.01 * u.arcmin, 0.6),
    }),
    "Planet.rotated": (dr.Planet(1e-6, 0.6).rotated, {"angle": (6 * u.arcmin, 0.1)}),
    "Star": (dr.Star, {
        "w2_magnitude": (4 * u.mag, 4),
        "exposure": (2 * u.h, 7200.0),
    }),
    "Scene": (dr.Scene, {
        "star_offset": ([5 * u.mas, -0.02 * u.arcsec], (0.005, -0.02)),
        "read_noise": (9 * u.photon, 9),
        "background": (2 * u.photon, 2),
    }),
    "nircam_coronagraph, one wavelength": (coronagraph, {
        "monochromatic": (4.5 * u.um, 4.5e-6), "pixelscale": (63 * u.mas, 0.063),
        "segment_gap": (7 * u.mm, 0.007), "chromatic_reference": (3350 * u.nm, 3.35e-6),
        "si_wfe": (np.linspace(-9, 9, 36) * u.nm, np.linspace(-9e-9, 9e-9, 36)),
    }),
    "nircam_coronagraph, field and source": (coronagraph, {
        "fov_arcsec": (400 * u.mas, 0.4),
        "pixelscale": ([62, 63] * u.mas, (0.062, 0.063)),
        "source": (4 * u.kK, 4000),
    }),
    "nircam_coronagraph, spectrum": (coronagraph, {
        "source": (
            ([3, 4, 6] * u.um, [1e4, 3e4, 2e4] * u.photon / u.s / u.cm**2 / u.m),
            ([3e-6, 4e-6, 6e-6], [1, 3, 2]),
        ),
    }),
    "random_opd": (lambda rms: dr.wavefront.random_opd(1, npix=32, rms=rms).data, {
        "rms": (50 * u.nm, 5e-8),
    }),
    "random_drift": (lambda hours: random_drift(1, hours, npix=32).data, {
        "hours": (90 * u.min, 1.5),
    }),
    "WavefrontPrior": (dr.wavefront.WavefrontPrior, {
        "scales": (
            {"segment": 4e-9 * u.m, "texture": 1e-4 * u.um}, {"segment": 4.0, "texture": 0.1},
        ),
        "amplitude_scale": (2 * u.nm, 2.0),
    }),
    "FitSettings": (lambda **given: dr.FitSettings(deviations=given).deviations, {
        "star_offset": (3 * u.mas, 0.003),
        "lyot_rotation": (12 * u.arcmin, 0.2),
        "flux": (5 * u.percent, 0.05),
    }),
    "Observation": (observation, {
        "pixelscale": ([62, 63] * u.mas, (0.062, 0.063)),
        "star_offset": ([10, -20] * u.mas, (0.01, -0.02)),
        "position_angles": ([0.5, 0.6] * u.rad, np.degrees([0.5, 0.6])),
    }),
    "refine, start": (problem, {
        "star_offset": ([10, -20] * u.mas, (0.01, -0.02)), "lyot_rotation": (6 * u.arcmin, 0.1),
        "flux": (2e6 * u.Jy / u.sr, 2.0), "background": (3e3 * u.Jy / u.sr, 0.003),
    }),
}  # fmt: skip
"""A call, and its arguments as Quantities and as numbers in the units of the interface."""


def flat(value):
    """Numbers and words in dataclasses, dictionaries and lists."""
    if hasattr(value, "__dataclass_fields__"):
        value = vars(value)
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, list | tuple):
        return [each for member in value for each in flat(member)]
    return [value]


@pytest.mark.parametrize("name", CASES)
def test_a_quantity_is_the_number_in_the_unit_of_the_interface(name):
    call, arguments = CASES[name]
    quantities, numbers = ({key: each[k] for key, each in arguments.items()} for k in (0, 1))
    for got, expected in zip(flat(call(**quantities)), flat(call(**numbers)), strict=True):
        if isinstance(expected, float | int | np.ndarray):
            assert not isinstance(got, u.Quantity)
            np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-30)
        else:
            assert got == expected


@pytest.mark.parametrize("name", CASES)
def test_another_dimension_is_refused_by_name(name):
    """One argument after the other in a unit that no argument has."""
    call, arguments = CASES[name]
    numbers = {key: number for key, (_, number) in arguments.items()}
    for key, (value, _) in arguments.items():
        wrong = 1 * u.K if key != "source" else 1 * u.m
        if isinstance(value, dict):
            wrong = dict.fromkeys(value, wrong)
        elif isinstance(value, tuple):
            wrong = (value[0], value[0])
        elif isinstance(value, u.Quantity) and value.shape:
            wrong = value.value * u.K
        with pytest.raises(UnitError, match=key):
            call(**{**numbers, key: wrong})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: dr.Planet(-1e-6, 0.6), r"contrast: got -1e-06, expected 0 or more"),
        (lambda: dr.Planet(1e-6, -600 * u.mas), r"separation: got -0.6 arcsec, expected 0 or"),
        (lambda: dr.Planet(math.inf, 0.6), r"contrast: got inf, expected a finite number"),
        (lambda: dr.Planet([1, 2], 0.6), r"contrast: got shape \(2,\), expected a single number"),
        (lambda: dr.Planet("far", 0.6), r"contrast: got 'far', expected a number"),
        (lambda: dr.Scene(star_offset=[1, 2, 3]), r"got shape \(3,\), expected one number or two"),
        (lambda: dr.Star(exposure=0), r"exposure: got 0 s, expected a positive number"),
        (lambda: dr.Scene(read_noise=-1), r"read_noise: got -1 ph, expected 0 or more"),
        (lambda: dr.nircam_coronagraph(pixelscale=-0.06), r"pixelscale: got -0.06 arcsec"),
        (lambda: dr.nircam_coronagraph(fov_arcsec=0), r"fov_arcsec: got 0 arcsec"),
        (lambda: dr.nircam_coronagraph(source=-5 * u.K), r"source: got -5 K"),
        (lambda: dr.reduce("nowhere", OPD, threshold=0), r"threshold: got 0, expected a pos"),
        (lambda: dr.wavefront.WavefrontPrior({"segment": -4}), r"scales: segment: got -4 nm"),
    ],
)
def test_values_out_of_bounds_say_what_was_got_and_expected(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_memory_is_text_a_quantity_or_bytes():
    for memory in ("2 GB", "2000MB", 2 * u.Gbyte, 2e9):
        assert dr.FitSettings(memory=memory).memory == 2e9
    assert dr.FitSettings(memory="2 GiB").memory == 2 * 1024**3
    assert dr.FitSettings().memory is None
    for memory in ("much", "2", "2 m", 2 * u.m):
        with pytest.raises(UnitError, match="memory: got"):
            dr.FitSettings(memory=memory)
    with pytest.raises(IncompatibleSetupError, match="memory: got -1 byte"):
        dr.FitSettings(memory=-1)
