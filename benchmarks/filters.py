"""Filters and masks of which there are no real frames: simulated rolls, with injected planets.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.filters F250M F410M F480M F460M:MASK430R

Two rolls of G 7-34 keep their headers, orientation and noise, but for the filter and the mask.
Their images are those of a finer model than that of the fit (512 samples, 15 wavelengths), with a
wavefront 10 nm rms from the map, a star 3 mas from the middle of the mask, and a flat field with
errors of 2 % in every pixel. `reduce` gets the files and the map.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from astropy.io import fits

import pyklip_diffrender as dr
from benchmarks.real_frames import DATA, opd_of
from pyklip_diffrender.reduction.summary import summarise

ROLLS = ("jw01184005001_03106", "jw01184006001_03106")
FLUX = 0.3  # Jy
FLAT = 0.02
OFFSET = (0.002, -0.002)  # arcsec
CHANGE = 10e-9  # m rms
SEPARATIONS = (0.5, 1.0, 2.0)


def simulate(
    source: Path, target: Path, filter: str, mask: str, opd: np.ndarray, seed: int
) -> None:
    """Replace the image of a calints file by a simulation."""
    with fits.open(source) as hdus:
        data, error = hdus["SCI"].data[0], hdus["ERR"].data[0]
        good = np.isfinite(data) & np.isfinite(error) & (hdus["DQ"].data[0] & 1 == 0)
        floor = np.median(error[good & (np.abs(data) < 1)] ** 2)
        bright = good & (data > 20)
        per_light = np.median((error[bright] ** 2 - floor) / data[bright])
        hdus[0].header.update(
            FILTER=filter,
            CORONMSK=mask.replace("MASK", "MASKA"),
            SUBARRAY=f"SUB320A{mask.removeprefix('MASK')}",
        )
        for name in ("IMSHIFTS", "MASKOFFS"):
            hdus[name].data = np.zeros_like(hdus[name].data)
        hdus.writeto(target)
        observation = dr.Observation.from_fits(target)
        model = dr.model_for(observation, data.shape[0], npix=512, nlambda=15)
        middle = (np.array(data.shape[::-1]) - 1) / 2
        values = {
            "star_offset": OFFSET,
            "detector_shift": (observation.center[0] - middle) * model.detector.pixelscale,
        }
        with torch.no_grad():
            star = model(opd, **values).double().numpy()
        # The flat field is that of the detector: the same for both rolls.
        flat = 1 + FLAT * np.random.default_rng(1).normal(size=star.shape)
        # Headers calibrate what the Lyot stop lets through.
        collected = FLUX / model.transmission()
        light = collected * 1e-6 / hdus["SCI"].header["PIXAR_SR"] * star * flat
        sigma = np.sqrt(floor + per_light * light)
        noise = sigma * np.random.default_rng(seed).normal(size=star.shape)
        hdus["SCI"].data, hdus["ERR"].data = (
            image[None].astype(np.float32) for image in (light + noise, sigma)
        )
        hdus.writeto(target, overwrite=True)


def main() -> None:
    """Simulate, reduce, and print what was recovered."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("filters", nargs="+", metavar="FILTER[:MASK]")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--planets", type=int, default=14)
    options = parser.parse_args()
    sensed = dr.read_opd(opd_of(options.data))
    opd = sensed.data + dr.wavefront.random_opd(5, npix=sensed.data.shape[-1], rms=CHANGE).data
    for name in options.filters:
        filter, _, mask = name.partition(":")
        mask = mask or "MASK335R"
        with tempfile.TemporaryDirectory() as folder:
            files = [Path(folder) / f"{roll}_calints.fits" for roll in ROLLS]
            for seed, (roll, file) in enumerate(zip(ROLLS, files, strict=True)):
                (source,) = (options.data / "gto1184").glob(f"{roll}*calints*")
                simulate(source, file, filter, mask, opd, seed)
            began = time.perf_counter()
            result = dr.reduce(files, sensed, injections=options.planets)
        seconds = time.perf_counter() - began
        summary = summarise(result)
        planets = summary["injections"]
        curve = result.detection.contrast_curve
        limits, known = (
            np.interp(SEPARATIONS, curve["separation"].value, curve[column])
            for column in ("contrast", "known_star")
        )
        print(
            f"{filter} {mask}: {summary['status']['name']}, "
            f"{len(summary['candidates'])} candidates, "
            f"chi2 {result.fit.chi2_per_pixel:.2f}, errors times {result.detection.scatter:.2f}, "
            f"star {result.detection.sky.star_jansky:.3f} Jy, "
            f"{planets['detected']} of {planets['count']}, contrast / truth "
            f"{planets['mean_ratio']:.2f} +- {planets['mean_ratio_error']:.2f}, pulls "
            f"{planets['pull_deviation']:.2f}, limits "
            + " ".join(f"{value:.1e}" for value in limits)
            + ", over those of a known star "
            + " ".join(f"{value:.2f}" for value in limits / known)
            + f", {seconds:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
