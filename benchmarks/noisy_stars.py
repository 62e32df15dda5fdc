"""Frames of expected photons with noise, and stars whose wavefront has drifted from a map."""

from dataclasses import dataclass, field

import numpy as np
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.wavefront import random_opd
from pyklip_diffrender.wavefront.bases import JointBasis

READ_NOISE = 42.0


def observed(expected, seed, pixelscale, **details):
    """A frame with photon and read noise."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(expected) + rng.normal(0, READ_NOISE, expected.shape)
    error = np.sqrt(np.maximum(counts, 0) + READ_NOISE**2)
    return dr.Observation.from_arrays(counts, error, pixelscale=pixelscale, **details)


def drift(basis, npix, segments, others, seed):
    """A random change of the wavefront, m: nanometres of motions of segments, of other modes."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randn(len(basis), dtype=torch.float64, generator=generator)
    size = torch.where(basis.frequencies == 0, segments, others)
    return basis.opd(1e-9 * size * drawn, PupilGrid.full(npix)).numpy()


@dataclass
class DriftedStar:
    """A model, an old wavefront and a later one; fits and detections are made once."""

    model: dr.OpticalSystem
    opd: np.ndarray
    later: np.ndarray
    basis: JointBasis
    flux: float
    made: dict = field(default_factory=dict, init=False)

    def star(self, offset=(0.0, 0.0), **moved):
        """Expected photons."""
        return self.flux * self.model(self.later, **{"star_offset": offset, **moved}).numpy()

    def light(self, planet, offset=(0.0, 0.0)):
        return planet.contrast * self.star(tuple(np.add(offset, planet.offset)))

    def expected(self, *planets, offset=(0.0, 0.0)):
        return sum((self.light(planet, offset) for planet in planets), self.star(offset))

    def observed(self, expected, seed, **details):
        return observed(expected, seed, self.model.detector.pixelscale, **details)

    def refined(self, observation, *, start=None, pattern=None, **changes):
        settings = {"basis": self.basis, "response_npix": self.model.npix, **changes}
        return dr.refine(
            self.model, observation, self.opd, settings=dr.FitSettings(**settings), start=start,
            pattern=pattern,
        )  # fmt: skip

    def fitted(self, seed, *planets):
        if ("fit", seed, planets) not in self.made:
            observation = self.observed(self.expected(*planets), seed)
            self.made["fit", seed, planets] = self.refined(observation)
        return self.made["fit", seed, planets]

    def detected(self, seed, *planets):
        if ("detection", seed, planets) not in self.made:
            self.made["detection", seed, planets] = dr.detect(self.fitted(seed, *planets))
        return self.made["detection", seed, planets]


def drifted_star(npix, size, basis, segments, others, seed, flux, kind=DriftedStar):
    """A star in F444W at 4.5 um, whose wavefront has drifted by nanometres."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=npix, fov_pixels=size)
    opd = random_opd(3, npix=npix).data
    later = opd + drift(basis, npix, segments, others, seed)
    return kind(model, opd, later, basis, flux)
