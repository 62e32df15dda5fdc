"""Random systems of poppy: rotations, masks, stops, grey and uniform planes in any order."""

import numpy as np
import poppy
from astropy import units as u
from poppy.poppy_core import PlaneType

WAVELENGTH = 4.5e-6
DIAMETER = 6.5
"""m; lambda/D is 0.143 arcsec."""

_SAMPLINGS = ((24, 1), (32, 2), (36, 3), (24, 4), (28, 2), (30, 3), (26, 2), (27, 3))
"""Samples across the pupil, and oversampling; poppy cannot pad an odd number to an even one."""


def draw(generator):
    """Draw a system of up to eight planes between the entrance pupil and the detector."""
    npix, oversample = _SAMPLINGS[generator.integers(len(_SAMPLINGS))]
    system = poppy.OpticalSystem(oversample=oversample, npix=npix, verbose=False)
    system.pupil_diameter = DIAMETER * u.m
    system.add_pupil(_entrance(generator))
    kinds = ("rotation", "inversion", "mask", "stop", "grey", "uniform image")
    for k in range(generator.integers(1, 9)):
        kind = generator.choice(kinds, p=[0.15, 0.1, 0.3, 0.15, 0.2, 0.1])
        behind_image = system.planes[-1].planetype == PlaneType.image
        if kind in ("rotation", "inversion") and behind_image and generator.random() < 0.9:
            # poppy moves an image that it turns by a sample, which is refused.
            system.add_pupil(poppy.ScalarTransmission(name=f"pupil {k}", transmission=0.9))
        _add(system, generator, kind, f"{kind} {k}")
    if system.planes[-1].planetype == PlaneType.image:
        system.add_pupil(poppy.ScalarTransmission(name="last pupil"))
    system.add_detector(
        pixelscale=float(generator.uniform(0.05, 0.15)),
        fov_pixels=int(generator.integers(8, 17)),
        oversample=int(generator.integers(1, 3)),
    )
    system.source_offset_r = float(generator.uniform(0, 0.4))
    system.source_offset_theta = float(generator.uniform(0, 360))
    return system


def _add(system, generator, kind, name):
    if kind == "rotation":
        system.add_rotation(float(generator.choice([90, 180, -90, generator.uniform(-180, 180)])))
    elif kind == "inversion":
        system.add_inversion(axis=str(generator.choice(["x", "y", "both"])))
    elif kind == "mask":
        system.add_image(_mask(generator, name, system.npix))
    elif kind == "stop":
        system.add_pupil(_stop(generator, name))
    elif kind == "grey":
        system.add_pupil(_grey(generator, name, system.npix))
    else:
        transmission = float(generator.uniform(0.2, 1))
        system.add_image(poppy.ScalarTransmission(name=name, transmission=transmission))


def _shifts(generator):
    x, y = generator.normal(scale=0.1, size=2)
    return {"shift_x": float(x), "shift_y": float(y)}


def _one_of(generator, *optics):
    return optics[generator.integers(len(optics))]


def _entrance(generator):
    return _one_of(
        generator,
        poppy.optics.ParityTestAperture(name="entrance", radius=3.2 * u.m),
        poppy.CircularAperture(name="entrance", radius=generator.uniform(1.5, 3.25)),
        poppy.HexagonAperture(name="entrance", side=generator.uniform(1.5, 3.2)),
        # The whole array is lit.
        poppy.SquareAperture(name="entrance", size=7.0),
    )


def _mask(generator, name, npix):
    width, height = generator.uniform(0.05, 0.5) * u.arcsec, generator.uniform(0.5, 3) * u.arcsec
    angle, radius = generator.uniform(0, 90), generator.uniform(0.1, 0.5) * u.arcsec
    shifts, kind = _shifts(generator), str(generator.choice(["circular", "linear"]))
    return _one_of(
        generator,
        poppy.CircularOcculter(name=name, radius=generator.uniform(0.05, 0.6), **shifts),
        poppy.BarOcculter(name=name, width=width, height=height, **shifts),
        poppy.optics.CircularPhaseMask(name=name, radius=radius, wavelength=4.2e-6 * u.m),
        poppy.BandLimitedCoron(name=name, kind=kind, sigma=5.0),
        poppy.optics.RectangularFieldStop(
            name=name, width=1 * u.arcsec, height=0.6 * u.arcsec, rotation=angle
        ),
        poppy.CircularOcculter(name=name, radius=0.05 * npix),
    )


def _stop(generator, name):
    shifts, angle = _shifts(generator), generator.uniform(0, 90)
    return _one_of(
        generator,
        poppy.CircularAperture(name=name, radius=generator.uniform(0.8, 3), **shifts),
        poppy.RectangleAperture(name=name, width=2.5, height=4.0, rotation=angle),
        # Open outside, so that it does not bound the light.
        poppy.SecondaryObscuration(
            name=name, secondary_radius=0.7, n_supports=3, support_width=0.3, **shifts
        ),
    )


def _grey(generator, name, npix):
    y, x = np.mgrid[:npix, :npix] / npix - 0.5
    factor = float(generator.uniform(0.2, 1))
    return _one_of(
        generator,
        poppy.ScalarTransmission(name=name, transmission=factor),
        poppy.ScalarOpticalPathDifference(name=name, opd=2e-7 * u.m),
        poppy.ThinLens(name=name, nwaves=factor, reference_wavelength=4e-6, radius=3.25),
        poppy.ArrayOpticalElement(
            name=name,
            transmission=0.5 + 0.4 * np.cos(7 * x + 3 * y + factor),
            opd=1e-7 * np.sin(9 * x - 4 * y),
            pixelscale=DIAMETER / npix * u.m / u.pix,
            planetype=PlaneType.pupil,
        ),
    )
