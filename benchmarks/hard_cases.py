"""What the hard cases share: small systems, comparators, and the rows of the stability table.

A row is measured by the tests, which hold it to its limits, and by
``benchmarks/stability.py``, which prints it into the documentation.
"""

from collections.abc import Callable
from contextlib import contextmanager
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.optics import Bandpass, OpticalSystem
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.wavefront import random_opd
from pyklip_diffrender.wavefront.bases import SegmentMotions

DTYPES = (torch.float64, torch.float32)
WAVELENGTH = 4.5e-6
NPIX = 128

FLOAT32_IMAGE = 3e-5
"""Limit of a float32 image: 6e-8 a product, and what the coronagraph leaves is the small
difference of fields 20 times as large; 1e-6 plane by plane, 8e-6 on the lattice were measured, and
2.1e-5 with torch 2.6, whose sums are ordered differently."""


class Row(NamedTuple):
    """One line of the table: what it is, what could go wrong, what the user sees.

    The limits are for float64 and float32. `measure` takes a real dtype and gives an error,
    relative, so that an answer of zeros has an error of 1 and one scaled by 1 % an error of 0.01.
    """

    case: str
    trouble: str
    sees: str
    limits: tuple[float, float]
    measure: Callable[[torch.dtype], float]


def small(**changes):
    """The coronagraph on a small grid."""
    settings = {"monochromatic": WAVELENGTH, "npix": NPIX, "fov_pixels": 32, **changes}
    return nircam_coronagraph("F444W", **settings)


@lru_cache(maxsize=8)
def system(dtype, wavelength=WAVELENGTH):
    """The same, made once; at any wavelength, also those that no filter has."""
    model = small(dtype=dtype)
    if wavelength == WAVELENGTH:
        return model
    band = Bandpass((wavelength,), (1.0,))
    return OpticalSystem(model.entrance, model.between, model.detector, band)


@lru_cache(maxsize=8)
def wavefront(seed=5, rms=66e-9):
    """A wavefront as in flight, m."""
    return torch.from_numpy(random_opd(seed, npix=NPIX, rms=rms).data)


@lru_cache(maxsize=2)
def segment(npix=NPIX):
    """1 on one segment, 0 elsewhere."""
    return (SegmentMotions().modes(PupilGrid.full(npix), 6, 7)[0] > 0.5).double()


@contextmanager
def threads(count):
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    yield
    torch.set_num_threads(before)


def worst(image, truth):
    """Largest difference of two images as a fraction of the peak; NaN counts as infinite."""
    got, true = (np.asarray(torch.as_tensor(each).detach().double()) for each in (image, truth))
    difference = np.abs(got - true).max() / np.abs(true).max()
    return float(difference) if np.isfinite(difference) else float("inf")
