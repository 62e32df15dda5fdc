"""How much deeper one wavefront for both arms of NIRCam would make the limits of each.

Run from the root of the project::

    python -m benchmarks.both_arms [--flat 0.01] [--drift 6e-9]

Frames that the two arms take at the same moment share the telescope's wavefront. A frame of F444W
and one of F210M behind MASK335R are simulated with the same drift of the mirror since the OPD
map, an error of the flat field in every pixel, photon and read noise, and each is fitted alone.
By linear theory, what one frame says of the modes, marginalised over all that is its own, is then
added to the curvature of the other: the errors are those of a fit of both, as if the arms shared
the wavefront exactly. The table has the 5-sigma limits of each frame alone, the ratio by which both
together are deeper, and the ratio for a star whose image is known, which no knowledge can surpass.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch
from astropy.io import fits

import pyklip_diffrender as dr
from pyklip_diffrender.instrument import detector_place
from pyklip_diffrender.optics import resample
from pyklip_diffrender.refinement import settings_for

ARMS = {"F444W": (64, 1e9), "F210M": (64, 3e9)}
"""Side of the fitted square, pixels, and photons of the star."""

READ_NOISE = 15.0
CYCLES = (15.0,)
"""Of the modes of both fits, which have to be the same."""

SEPARATIONS = (0.4, 0.5, 0.6, 0.8)
CHROMATIC = 1e-9
"""Rms of the wavefront that each arm has for itself, m."""


def frame_of(name: str, opd: np.ndarray, flat: float, seed: int) -> dr.Observation:
    """Simulate a frame of one filter, with a finer model than that of the fit."""
    size, photons = ARMS[name]
    place = detector_place("MASK335R", name)
    header = fits.Header(
        {"TELESCOP": "JWST", "INSTRUME": "NIRCAM", "DETECTOR": place.header_detector,
         "CORONMSK": "MASKA335R", "PUPIL": "MASKRND", "APERNAME": f"{place.detector}_MASK335R"}
    )  # fmt: skip
    blank = dr.Observation.from_arrays(
        np.ones((size, size)), np.ones((size, size)), pixelscale=place.siaf_pixelscale,
        filter=name, header=header, position_angles=[0.0],
    )  # fmt: skip
    own = dr.wavefront.random_opd(seed, npix=256, rms=CHROMATIC).data
    with torch.no_grad():
        light = dr.model_for(blank, npix=512, nlambda=11)(
            resample(opd + own, 512), (0.002, -0.002)
        ).double()  # fmt: skip
    rng = np.random.default_rng(seed)
    counts = photons * light.numpy() * (1 + flat * rng.normal(size=light.shape))
    sigma = np.sqrt(counts + READ_NOISE**2)
    return dr.Observation.from_arrays(
        counts + sigma * rng.normal(size=counts.shape), sigma, pixelscale=place.siaf_pixelscale,
        filter=name, header=header, position_angles=[0.0],
    )  # fmt: skip


def information(linear: dr.linear.LinearModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices of the modes of a fit, and what its frame says of them, without their prior."""
    mode = torch.tensor([unknown.name == "modes" for unknown in linear.unknowns])
    modes, rest = torch.nonzero(mode).flatten(), torch.nonzero(~mode).flatten()
    own = linear.curvature[rest][:, rest].clone()
    own.diagonal().add_(linear.deviation[rest] ** -2.0)
    mixed = linear.curvature[rest][:, modes]
    shared = linear.curvature[modes][:, modes] - mixed.T @ torch.linalg.solve(own, mixed)
    return modes, shared


def errors(fit: dr.Refinement, linear: dr.linear.LinearModel) -> tuple[np.ndarray, np.ndarray]:
    """Errors of a planet's flux, and for a known star: the median at every separation."""
    angles = np.arange(0, 2 * np.pi, np.pi / 4)
    model, opd = fit.frames[0].model, fit.wavefront
    with torch.no_grad():
        templates = torch.stack(
            [model(opd, (r * np.cos(t), r * np.sin(t))) for r in SEPARATIONS for t in angles]
        )
    products = linear.weigh({0: templates})
    return tuple(
        np.median((each**-0.5).reshape(len(SEPARATIONS), -1).numpy(), axis=1)
        for each in (products.information, products.photon)
    )


def main() -> None:
    """Fit each arm alone, and print the errors of both together."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--flat", type=float, default=0.01)
    parser.add_argument("--drift", type=float, default=6e-9)
    options = parser.parse_args()
    torch.set_num_threads(1)
    sensed = dr.wavefront.random_opd(1, npix=256).data
    truth = sensed + dr.wavefront.random_opd(2, npix=256, rms=options.drift).data
    fits_of = {}
    for seed, name in enumerate(ARMS, 10):
        frame = frame_of(name, truth, options.flat, seed)
        settings = replace(settings_for(frame), cycles=CYCLES)
        fits_of[name] = dr.refine(dr.model_for(frame), [frame], sensed, settings=settings)
        print(name, fits_of[name].status.name, f"chi2 {fits_of[name].chi2_per_pixel:.3f}")
    print(f"| filter | | {' | '.join(f'{s} arcsec' for s in SEPARATIONS)} |")
    for name, other in (tuple(ARMS), tuple(ARMS)[::-1]):
        fit = fits_of[name]
        alone, known = errors(fit, fit.linear)
        modes, _ = information(fit.linear)
        _, shared = information(fits_of[other].linear)
        curvature = fit.linear.curvature.clone()
        curvature[modes[:, None], modes] += shared
        both, _ = errors(fit, replace(fit.linear, curvature=curvature))
        flux = float(fit.frames[0].flux)
        rows = {"alone, 5 sigma": 5 * alone / flux, "both": alone / both, "known": alone / known}
        for label, row in rows.items():
            spec = ".1e" if "sigma" in label else ".2f"
            print(f"| {name} | {label} | {' | '.join(format(v, spec) for v in row)} |", flush=True)


if __name__ == "__main__":
    main()
