"""Random systems of poppy: rotations, masks, stops, grey and uniform planes in any order."""

from __future__ import annotations

import numpy as np
import poppy
from astropy import units as u
from poppy.poppy_core import PlaneType

WAVELENGTH = 4.5e-6
DIAMETER = 6.5
"""m; lambda/D is 0.143 arcsec."""

_SAMPLINGS = ((24, 1), (32, 2), (36, 3), (24, 4), (28, 2), (30, 3), (26, 2), (27, 3))
"""Samples across the pupil, and oversampling."""

Generator = np.random.Generator


def draw(generator):
    """Draw a system of up to eight planes between the entrance pupil and the detector."""
    # poppy itself cannot pad an odd number of samples to an even one.
    npix, oversample = _SAMPLINGS[generator.integers(len(_SAMPLINGS))]
    system = poppy.OpticalSystem(oversample=oversample, npix=npix, verbose=False)
    system.pupil_diameter = DIAMETER * u.m
    system.add_pupil(_entrance(generator))
    for k in range(generator.integers(1, 9)):
        kind = generator.choice(list(_KINDS), p=[0.15, 0.1, 0.3, 0.15, 0.2, 0.1])
        turns = kind in ("rotation", "inversion")
        if turns and system.planes[-1].planetype == PlaneType.image and generator.random() < 0.9:
            # poppy moves an image that it turns by a sample, which is refused.
            system.add_pupil(poppy.ScalarTransmission(name=f"pupil {k}", transmission=0.9))
        _KINDS[kind](system, generator, f"{kind} {k}")
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


def _shifts(generator, scale):
    x, y = generator.normal(scale=scale, size=2)
    return {"shift_x": float(x), "shift_y": float(y)}


def _entrance(generator):
    return _one_of(
        generator,
        lambda: poppy.optics.ParityTestAperture(name="entrance", radius=3.2 * u.m),
        lambda: poppy.CircularAperture(name="entrance", radius=generator.uniform(1.5, 3.25)),
        lambda: poppy.HexagonAperture(name="entrance", side=generator.uniform(1.5, 3.2)),
        # The whole array is lit.
        lambda: poppy.SquareAperture(name="entrance", size=7.0),
    )


def _one_of(generator, *makers):
    return makers[generator.integers(len(makers))]()


def _mask(system, generator, name):
    shifts = _shifts(generator, 0.1)
    optic = _one_of(
        generator,
        lambda: poppy.CircularOcculter(name=name, radius=generator.uniform(0.05, 0.6), **shifts),
        lambda: poppy.BarOcculter(
            name=name,
            width=generator.uniform(0.05, 0.5) * u.arcsec,
            height=generator.uniform(0.5, 3) * u.arcsec,
            **shifts,
        ),
        lambda: poppy.optics.CircularPhaseMask(
            name=name, radius=generator.uniform(0.1, 0.5) * u.arcsec, wavelength=4.2e-6 * u.m
        ),
        lambda: poppy.BandLimitedCoron(
            name=name, kind=str(generator.choice(["circular", "linear"])), sigma=5.0
        ),
        lambda: poppy.optics.RectangularFieldStop(
            name=name, width=1 * u.arcsec, height=0.6 * u.arcsec, rotation=generator.uniform(0, 90)
        ),
        lambda: poppy.CircularOcculter(name=name, radius=0.05 * system.npix),
    )
    system.add_image(optic)


def _stop(system, generator, name):
    shifts = _shifts(generator, 0.1)
    system.add_pupil(
        _one_of(
            generator,
            lambda: poppy.CircularAperture(name=name, radius=generator.uniform(0.8, 3), **shifts),
            lambda: poppy.RectangleAperture(
                name=name, width=2.5, height=4.0, rotation=generator.uniform(0, 90)
            ),
            # Open outside, so that it does not bound the light.
            lambda: poppy.SecondaryObscuration(
                name=name, secondary_radius=0.7, n_supports=3, support_width=0.3, **shifts
            ),
        )
    )


def _grey(system, generator, name):
    y, x = np.mgrid[: system.npix, : system.npix] / system.npix - 0.5
    factor = float(generator.uniform(0.2, 1))
    system.add_pupil(
        _one_of(
            generator,
            lambda: poppy.ScalarTransmission(name=name, transmission=factor),
            lambda: poppy.ScalarOpticalPathDifference(name=name, opd=2e-7 * u.m),
            lambda: poppy.ThinLens(
                name=name, nwaves=factor, reference_wavelength=4e-6, radius=3.25
            ),
            lambda: poppy.ArrayOpticalElement(
                name=name,
                transmission=0.5 + 0.4 * np.cos(7 * x + 3 * y + factor),
                opd=1e-7 * np.sin(9 * x - 4 * y),
                pixelscale=DIAMETER / system.npix * u.m / u.pix,
                planetype=PlaneType.pupil,
            ),
        )
    )


def _uniform_image(system, generator, name):
    system.add_image(
        poppy.ScalarTransmission(name=name, transmission=float(generator.uniform(0.2, 1)))
    )


_KINDS = {
    "rotation": lambda system, generator, name: system.add_rotation(
        float(generator.choice([90, 180, -90, generator.uniform(-180, 180)]))
    ),
    "inversion": lambda system, generator, name: system.add_inversion(
        axis=str(generator.choice(["x", "y", "both"]))
    ),
    "mask": _mask,
    "stop": _stop,
    "grey": _grey,
    "uniform image": _uniform_image,
}
