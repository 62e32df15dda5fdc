"""Rows of the stability table: images and gradients of the optics."""

import math
from functools import lru_cache, partial

import mpmath
import numpy as np
import torch

from benchmarks import poppy_reference as reference
from benchmarks.hard_cases import (
    FLOAT32_IMAGE,
    NPIX,
    WAVELENGTH,
    Row,
    segment,
    small,
    system,
    wavefront,
    worst,
)
from pyklip_diffrender.instrument.masks import MASKS, jwst_pupil, lyot_openings
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.scene.objects import Planet, Scene
from pyklip_diffrender.scene.simulation import expected_photons, planet_photons, star_photons

FLUX, READ_NOISE = 2.8e12, 42.0
"""Photons of the paper's star, and its read noise: they say how near to the truth is near."""


# -- images ----------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _plain_fft(mas):
    """The image by poppy's FFTs; the offset lies on no axis and no diagonal."""
    planes = reference.coronagraph(
        jwst_pupil(NPIX).numpy(),
        reference.lopsided_opd(NPIX),
        polygon_coverage(lyot_openings("MASKRND"), PupilGrid.full(NPIX)).numpy(),
        reference.zernike_opd(reference.lopsided_zernikes(), NPIX),
        oversample=4,
        fov_pixels=32,
        pixelscale=NIRCAM_LW_PIXELSCALE,
    )
    return reference.image(planes, WAVELENGTH, *_offset(mas))


def _offset(mas):
    return mas * 1e-3 * math.cos(0.7), mas * 1e-3 * math.sin(0.7)


def plain_fft(mas, route, sampling, dtype):
    """Semi-analytic image against the plain FFT with 4 samples per lambda/D on the occulter."""
    model = small(
        si_wfe=reference.tabulated(reference.lopsided_zernikes(), WAVELENGTH), flip_si_wfe=True,
        dtype=dtype, route=route, occulter_sampling=sampling,
    )  # fmt: skip
    return worst(model(reference.lopsided_opd(NPIX), _offset(mas)), _plain_fft(mas))


def sampling(dtype):
    """The default route against 16 cells per lambda/D, plane by plane."""
    fine = small(occulter_sampling=16.0, route="planes")(wavefront())
    return worst(system(dtype)(wavefront()), fine)


def occulter(dtype):
    """1 - t at radii from 1e-12 arcsec to the edge, against 50 digits."""
    radii = np.concatenate([[0.0], np.geomspace(1e-12, 1.0, 40)])
    with mpmath.workdps(50):
        # SIGMA as a double, as the code has it.
        s = [mpmath.mpf(float(r)) * mpmath.mpf(reference.SIGMA) for r in radii]
        exact = [1.0 if x == 0 else float((2 * mpmath.besselj(1, x) / x) ** 2) for x in s]
    x = torch.from_numpy(radii)
    got = MASKS["MASK335R"].complement(x, torch.zeros_like(x)).to(dtype)
    return float(np.abs(got.double().numpy() / exact - 1).max())


def hit(microns, waves, dtype):
    """A segment `waves` too high against one a whole wave lower: the same image."""
    wavelength = microns * 1e-6
    model, opd = system(dtype, wavelength), wavefront()
    low = model(opd + (waves - 1) * wavelength * segment())
    return worst(model(opd + waves * wavelength * segment()), low)


def distance(vector, truth):
    """Length of a difference as a fraction of the length of the truth."""
    difference = (vector.double() - truth.double()).norm() / truth.double().norm()
    return float(difference) if torch.isfinite(difference) else math.inf


def _gradient(model, opd):
    weight = torch.rand(32, 32, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    variable = opd.clone().requires_grad_()
    (model(variable) * weight).sum().backward()
    return variable.grad


def hit_gradient(waves, dtype):
    """The same for the gradient of a sum of pixels."""
    model, opd = system(dtype), wavefront()
    return distance(
        _gradient(model, opd + waves * WAVELENGTH * segment()),
        _gradient(system(torch.float64), opd + (waves - 1) * WAVELENGTH * segment()),
    )


def piston(dtype):
    """1 um of piston over the whole pupil."""
    exact = system(torch.float64)(wavefront())
    return worst(system(dtype)(wavefront() + 1e-6), exact)


def piston_gradient(dtype):
    """Share of the gradient along piston."""
    gradient = _gradient(system(dtype), wavefront())
    lit = system(dtype).entrance.lit
    return abs(float(gradient.sum())) / (float(gradient.norm()) * math.sqrt(float(lit.sum())))


# -- planets and gradients near the truth ------------------------------------------------------


def faint_planet(separation, dtype):
    """A planet of contrast 1e-10 in the scene, less the star, against the planet alone."""
    planet = Planet(1e-10, separation, 40.0)
    scene = Scene(planets=(planet,))
    model, opd = system(dtype), wavefront()
    got = expected_photons(model, scene, opd) - star_photons(model, scene, opd)
    return worst(got, planet_photons(system(torch.float64), scene, planet, opd))


def _chi2(dtype, opd):
    truth = system(torch.float64)(wavefront()).detach()
    sigma = torch.sqrt(FLUX * truth + READ_NOISE**2)
    return (((FLUX * system(dtype)(opd).double() - FLUX * truth) / sigma) ** 2).mean()


def chi2_gradient(nanometres, dtype):
    """Gradient of chi2 with the wavefront so far from the truth.

    float64 against a finite difference along the line to the truth, float32 against float64.
    """
    away = wavefront(9, 1e-9)
    opd = wavefront() + nanometres * away
    gradients = []
    for kind in (torch.float64, dtype):
        variable = opd.clone().requires_grad_()
        _chi2(kind, variable).backward()
        gradients.append(variable.grad)
    if dtype == torch.float32:
        return distance(gradients[1], gradients[0])
    step = 1e-3 * nanometres
    at = [float(_chi2(dtype, opd + k * step * away)) for k in (-2, -1, 1, 2)]
    numeric = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * step)
    return abs(float((gradients[0] * away).sum()) / numeric - 1)


_IMAGE = (1e-12, FLOAT32_IMAGE)
_ONE_WAVE_LOWER = "the image one wave lower"

ROWS = [
    *(Row(f"star {mas:g} mas off, against a plain FFT" if mas else "star exactly on the axis",
          "what the occulter leaves is a small difference of large fields",
          "the image of the plain FFT", (1e-7, FLOAT32_IMAGE),
          partial(plain_fft, mas, "auto", None))
      for mas in (0.0, 1.0, 10.0, 50.0, 100.0)),
    Row("10 mas off, plane by plane, with the FFT's samples on the occulter",
        "as above, without the samples' own error", "the image of the plain FFT",
        (1e-11, FLOAT32_IMAGE), partial(plain_fft, 10.0, "planes", 4.0)),
    Row("default sampling of the occulter instead of 16 cells per lambda/D",
        "the disc is sampled too coarsely",
        "the converged image", (1e-7, FLOAT32_IMAGE),
        sampling),
    Row("occulter at r from 0 to 1 arcsec, against 50 digits",
        "0 / 0 in the middle; 1 - t loses its digits when t is formed first",
        "the right transmission, 1 - t = 1 at r = 0", (1e-13, 1.2e-7), occulter),
    Row("micrometeoroid, 800 nm of surface at 2 um", "phase above pi", _ONE_WAVE_LOWER, _IMAGE,
        partial(hit, 2.0, 0.8)),
    Row("a segment 1.5 waves too high", "phase above pi", _ONE_WAVE_LOWER, _IMAGE,
        partial(hit, 4.5, 1.5)),
    Row("the gradient there", "phase above pi", "the gradient one wave lower", _IMAGE,
        partial(hit_gradient, 1.5)),
    Row("1 um of piston over the whole pupil", "no image can show it: a fit may drift",
        "the same image", _IMAGE, piston),
    Row("share of the gradient along piston", "as above", "no force towards it", (1e-12, 1e-6),
        piston_gradient),
    *(Row(f"planet of contrast 1e-10 at {separation:g} arcsec",
          "in float32 the star swallows it", "the planet: light is added up in float64",
          (1e-6, 1e-5), partial(faint_planet, separation))
      for separation in (0.3, 0.6, 1.0)),
    *(Row(f"gradient of chi2, wavefront {nanometres:g} nm from the truth",
          "the residual is a small difference of two images", "a gradient to descend along",
          (1e-9, limit), partial(chi2_gradient, nanometres))
      for nanometres, limit in ((100.0, 1e-5), (10.0, 5e-5), (1.0, 5e-4), (0.1, 5e-3))),
]  # fmt: skip
