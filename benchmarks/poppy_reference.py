"""The coronagraph once more, put together from poppy's parts: plain FFTs, nothing shared.

The occulter's profile, the Zernikes and the inversion between the entrance and the exit pupil are
written here or taken from poppy, so that an error of the package does not cancel.
"""

from __future__ import annotations

import functools

import numpy as np
import poppy
from astropy import units as u
from scipy.special import j1, jn_zeros

DIAMETER = 6.603464
SIGMA = 3.2927866


class SombreroOcculter(poppy.optics.AnalyticImagePlaneElement):
    """MASK335R: t = 1 - (2 J1(s) / s)^2 up to the second zero of J1, clear beyond."""

    def get_transmission(self, wave):
        y, x = self.get_coordinates(wave)
        s = np.clip(SIGMA * np.hypot(y, x), 1e-12, jn_zeros(1, 2)[1])
        return 1 - (2 * j1(s) / s) ** 2


def array_optic(name, amplitude, opd=None):
    """A pupil plane from arrays in the exit-pupil orientation."""
    return poppy.ArrayOpticalElement(
        name=name,
        transmission=amplitude,
        opd=np.zeros_like(amplitude) if opd is None else opd,
        pixelscale=DIAMETER / len(amplitude) * u.m / u.pixel,
        planetype=poppy.poppy_core.PlaneType.pupil,
    )


def coronagraph(pupil, opd, lyot, internal_opd, *, oversample, fov_pixels, pixelscale):
    """Entrance pupil, inversion, occulter, Lyot stop, internal aberration, detector.

    Amplitudes and OPDs (npix, npix), m, have the entrance-pupil orientation; `oversample` is the
    number of samples per lambda/D in the plane of the occulter.
    """
    system = poppy.OpticalSystem(oversample=oversample, npix=len(pupil), verbose=False)
    system.pupil_diameter = DIAMETER * u.m
    system.add_pupil(array_optic("primary", pupil, opd))
    system.add_inversion(axis="y")
    system.add_image(SombreroOcculter(name="MASK335R"))
    system.add_pupil(array_optic("MASKRND", lyot[::-1]))
    system.add_pupil(array_optic("internal", np.ones_like(lyot), internal_opd[::-1]))
    system.add_detector(pixelscale=pixelscale, fov_pixels=fov_pixels, oversample=1)
    return system


def image(system, wavelength, x, y):
    """The image of a star at (x, y) arcsec; poppy counts the angle from +y towards -x."""
    system.source_offset_r = np.hypot(x, y)
    system.source_offset_theta = np.rad2deg(np.arctan2(-x, y))
    hdus = system.calc_psf(wavelength=wavelength * u.m, normalize="first")
    return np.asarray(hdus[0].data, dtype=np.float64)


@functools.cache
def lopsided_opd(npix):
    """A wavefront of 60 nm rms without any symmetry, m."""
    axis = (np.arange(npix) - (npix - 1) / 2) / npix
    y, x = axis[:, None], axis[None, :]
    opd = np.sin(2 * np.pi * (3 * x + 1.3 * y + 0.1)) + np.cos(2 * np.pi * (7.1 * y - 2 * x))
    opd += 4 * x * y - 5 * x**3 + 3 * y**2 + (x > 0.1) * (y > 0.2)
    return 60e-9 * (opd - opd.mean()) / opd.std()


@functools.cache
def lopsided_zernikes():
    """36 Noll coefficients, m, each different from zero."""
    return 12e-9 * np.sin(np.arange(36) ** 1.7 + 0.5) / np.sqrt(1 + np.arange(36) / 4)


def tabulated(coefficients, wavelength):
    """What the argument `si_wfe` has to be for a model to have these coefficients at a wavelength.

    NIRCam's long-wave focus changes with the wavelength, relative to 3.23 um where its table was
    made (polynomial of stpsf 2.2.0, highest order first).
    """
    focus = np.poly1d([0.175718713, -1.100964635, 0.986462016, 1.641692934]) / -1.09746e7
    found = coefficients.copy()
    found[3] += focus(wavelength * 1e6) - focus(3.23)
    return found


def zernike_opd(coefficients, npix):
    """Sum of Noll Zernikes by poppy on the inscribed circle, m.

    Left to itself, poppy's function puts the circle through the middles of the outermost pixels.
    """
    axis = (np.arange(npix) - (npix - 1) / 2) / (npix / 2)
    rho, theta = np.hypot(axis[:, None], axis), np.arctan2(axis[:, None], axis)
    basis = poppy.zernike.zernike_basis(len(coefficients), rho=rho, theta=theta, outside=0.0)
    return np.asarray(np.tensordot(coefficients, basis, axes=1), dtype=np.float64)
