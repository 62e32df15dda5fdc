"""The fields at all planes as `poppy.Wavefront` objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import poppy
import torch
from astropy import units as u
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.bridges.image_masks import FourierMask, SampledOcculter
from pyklip_diffrender.bridges.orientation import Orientation
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.system import OpticalSystem

__all__ = ["intermediate_wavefronts"]

Array = NDArray[Any]


def intermediate_wavefronts(
    system: OpticalSystem,
    orientations: Sequence[Orientation],
    normalize: str,
    only_last: bool,
) -> list[poppy.Wavefront]:
    """Fields as poppy's own objects, one per plane, weighted and summed as poppy does.

    For an image plane, the field behind the mask on the sampled part of the image.

    Parameters
    ----------
    system : OpticalSystem
    orientations : sequence of Orientation
        Orientation of every plane relative to poppy's, the entrance pupil first.
    normalize : str
        Only "first".
    only_last : bool
        Return the field on the detector alone.
    """
    if normalize.lower() != "first":
        raise IncompatibleSetupError(
            f"normalize={normalize!r}: intermediate wavefronts come with 'first' only"
        )
    summed: list[poppy.Wavefront] = []
    for wavelength, weight in zip(
        system.bandpass.wavelengths, system.bandpass.weights, strict=True
    ):
        for k, wave in enumerate(_wavefronts(system, orientations, wavelength, only_last)):
            wave.wavefront = wave.wavefront * weight
            if k == len(summed):
                summed.append(wave)
            elif summed[k].shape == wave.shape:
                summed[k].wavefront = summed[k].wavefront + wave.wavefront
            # Otherwise an image plane, sampled in proportion to the wavelength, has another number
            # of samples; that of the first wavelength is kept.
    return summed


def _wavefronts(
    system: OpticalSystem, orientations: Sequence[Orientation], wavelength: float, only_last: bool
) -> list[poppy.Wavefront]:
    values = system.values({})
    full = system.entrance.full
    waves = []
    with torch.no_grad():
        wavefront = system.pupil_field(system.opd(None), wavelength, values)
        windows = system.windows(values)
        planes: list[Any] = [system.entrance, *system.planes]
        for k, plane in enumerate(planes):
            to_poppy = orientations[k].inverse
            if isinstance(plane, SampledOcculter | FourierMask):
                field, spacing = plane.focal_sample(wavefront)
                wave = _wave_of(field, wavelength, full.diameter, spacing / ARCSEC)
                if isinstance(plane, FourierMask):
                    field = to_poppy.apply_to_lattice(field)
                else:
                    # On the image the inversion of y is undone.
                    field = Orientation.inversion("y").then(to_poppy).apply(field)
                wave.wavefront = _numpy(field)
            if k > 0:
                wavefront = system.planes[k - 1].apply(wavefront, values, windows[k - 1])
            if not isinstance(plane, SampledOcculter | FourierMask):
                pupil = to_poppy.apply(wavefront.grid.crop(wavefront.field, full)) * full.spacing
                wave = _wave_of(pupil, wavelength, full.diameter, None)
            wave.location = f"after {plane.name}"
            waves.append(wave)
        detector = system.detector
        final = detector.field(wavefront, values)
    scale = detector.pixelscale[0] / detector.oversample
    last = _wave_of(final, wavelength, full.diameter, scale)
    last.oversample = detector.oversample
    last.location = f"at {detector.name}"
    return [last] if only_last else [*waves, last]


def _numpy(field: Tensor) -> Array:
    return np.asarray(field.cpu().numpy(), dtype=np.complex128)


def _wave_of(
    field: Tensor, wavelength: float, diameter: float, arcsec: float | None
) -> poppy.Wavefront:
    """A field in a pupil, or on an image with samples of a given size."""
    sampling = {} if arcsec is None else {"pixelscale": arcsec * u.arcsec / u.pix}
    wave = poppy.Wavefront(wavelength=wavelength * u.m, npix=1, diam=diameter * u.m, **sampling)
    wave.wavefront = _numpy(field)
    if arcsec is None:
        wave.pixelscale = diameter / len(field) * u.m / u.pix
    else:
        wave.fov = len(field) * arcsec * u.arcsec
    return wave
