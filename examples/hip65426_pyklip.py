"""HIP 65426 behind MASK335R without a reference star: an ordinary pyKLIP script, one word changed.

    python examples/hip65426_pyklip.py CALINTS OPD [--output FOLDER]

CALINTS is a NIRCam F444W file of one roll, OPD the map measured nearest in time. The
script writes what pyKLIP writes, maps and tables of companion candidates, and a figure.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from pyklip.instruments.JWST import JWSTData
from pyklip.parallelized import klip_dataset

import pyklip_diffrender as dr
from pyklip_diffrender.drawing import save
from pyklip_diffrender.refinement import Refinement

COMPANION_RADIUS = 0.35  # arcsec; what is left out of the figure of merit


def reduce(frames: Path, opd: Path, folder: Path) -> Refinement:
    """Run pyKLIP with algo="diffrender"; returns the fit behind the subtraction."""
    folder.mkdir(parents=True, exist_ok=True)
    with dr.pyklip_backend.backend(opd=opd):
        dataset = JWSTData([str(frames)], None, highpass=False)
        klip_dataset(
            dataset,
            mode="ADI",
            outputdir=str(folder),
            fileprefix="HIP65426_F444W",
            annuli=1,
            subsections=1,
            numbasis=[1],
            movement=1,
            algo="diffrender",  # the one word
            verbose=False,
        )
    (result,) = dataset.diffrender_results
    return result.subtraction.fits[0].result


def away_from_companions(fit: Refinement) -> np.ndarray:
    """Pixels of the fitted square that no companion reaches, (ny, nx)."""
    (frame,) = fit.frames
    ny, nx = frame.observation.shape
    scale = fit.model.detector.pixelscale
    star = frame.values["detector_shift"] + frame.values["star_offset"]
    y, x = np.indices((ny, nx))
    keep = np.ones((ny, nx), dtype=bool)
    for _, dx, dy in fit.companions:
        in_x = (x - (nx - 1) / 2) * scale[0] - star[0] - dx
        in_y = (y - (ny - 1) / 2) * scale[1] - star[1] - dy
        keep &= np.hypot(in_x, in_y) > COMPANION_RADIUS
    return keep


def residual_share(frame: np.ndarray, star: np.ndarray, keep: np.ndarray) -> float:
    """Mean absolute residual as a share of the mean light, where `keep`."""
    return float(np.abs(frame - star)[keep].sum() / np.abs(frame)[keep].sum())


def main() -> None:
    """Reduce, report, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", type=Path)
    parser.add_argument("opd", type=Path)
    parser.add_argument("--output", type=Path, default=Path("hip65426"))
    options = parser.parse_args()

    began = time.perf_counter()
    fit = reduce(options.frames, options.opd, options.output)
    seconds = time.perf_counter() - began
    keep = away_from_companions(fit)
    (fitted,) = fit.frames
    data = fitted.observation.data
    print(f"\n{fit.status}; chi2/pixel {fit.chi2_per_pixel:.2f}")
    print(f"reduction {seconds:.0f} s, of which the fit {fit.seconds:.0f} s")
    for name, frame in (*((f"integration {k}", f) for k, f in enumerate(data)),
                        ("their mean", data.mean(axis=0))):  # fmt: skip
        # A companion's wings reach far beyond what is left out: they are modelled, not star.
        share = residual_share(frame - fitted.companion_image, fitted.star, keep)
        print(f"mean |residual| / star, {name}: {100 * share:.2f} %")
    print(fit.parameters["name", "value", "error", "unit"][:9])
    # With the errors scaled to what the model does not explain.
    detection = dr.detect(fit)
    print(detection)
    detection.write(options.output)
    save(fit.plot()[0].figure, options.output / "hip65426.png")


if __name__ == "__main__":
    main()
