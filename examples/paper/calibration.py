"""Calibration: S/N at planet-free positions and the contrast limit, against drift.

    python examples/paper/calibration.py --opd BEFORE AFTER --seeds 20

The table has one row for each frame: the rms of S/N where there is no planet (for all positions,
and for rings), that of the matched filter for a known star on the same noise, and the ratio of the
5-sigma contrast to the matched filter's photon limit. About a hundred positions of a frame are
independent, a dozen in the innermost ring, so that the rms of one frame scatters by 7 %. Fits of
the longest drift, an extrapolation, take many times longer than the others. On the embedded
generator each seed has its own wavefront and drift.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import torch
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

import pyklip_diffrender as dr
from pyklip_diffrender.detection import Detection

sys.path.insert(0, str(Path(__file__).parent))
from scene import Frame, Setting, frame, mapped, options, setting, timed_table

HOURS = (0.0, 3.0, 40.0, 86.0, 200.0)
RINGS = np.arange(0.3, 2.35, 0.2)


def known_star_snr(detection: Detection, shot: Frame) -> NDArray[np.float64]:
    """S/N map of the matched filter that knows the star and its noise."""
    templates = detection.templates
    ny, nx = shot.star.shape
    whitened = torch.from_numpy(shot.known_star / shot.noise)
    weight = torch.from_numpy(1 / shot.noise)
    values = []
    for start in range(0, ny * nx, 640):
        index = np.arange(start, min(start + 640, ny * nx))
        images = templates.at_pixels(*np.divmod(index, nx))[0].double() * weight
        values.append(torch.tensordot(images, whitened, dims=2) / images.flatten(1).norm(dim=1))
    return torch.cat(values).reshape(ny, nx).numpy()


def rms(values: ArrayLike) -> float:
    """Root mean square of the finite values; NaN if there are none, as outside the field."""
    array = np.asarray(values, dtype=float)
    finite = array[np.isfinite(array)]
    return math.sqrt(np.mean(finite**2)) if finite.size else math.nan


def one_frame(setup: Setting, hours: float, seed: int) -> Table:
    """One row of the table."""
    setup = setup.redrawn(seed)
    shot = frame(setup, hours, seed)
    fit = dr.refine(setup.model, shot.observation, setup.measured)
    detection = dr.detect(fit, threshold=math.inf)
    radius = np.hypot(detection.grid[..., 0], detection.grid[..., 1])
    inside = (radius >= RINGS[0]) & (radius < RINGS[-1])
    optimal = known_star_snr(detection, shot)
    limit = detection.error / detection.photon_error
    (fitted,) = fit.frames
    level = float(fitted.values["background"][0])
    star_error = ((fitted.star - level - shot.star) / shot.noise)[inside]
    row = {
        "hours": hours,
        "seed": seed,
        "chi2": fit.chi2_per_pixel,
        "effective": fit.effective_parameters,
        "status": fit.status.name,
        "scatter": detection.scatter,
        "null": rms(detection.snr[inside]),
        "known_star_null": rms(optimal[inside]),
        "highest": np.abs(detection.snr[inside]).max(),
        "beyond_4": int((np.abs(detection.snr[inside]) > 4).sum()),
        "positions": int(inside.sum()),
        "star_error": float(np.sqrt(np.mean(star_error**2))),
        "seconds": fit.seconds,
    }
    limits = []
    for ring in RINGS[:-1]:
        in_ring = (radius >= ring) & (radius < ring + 0.2)
        limits.append(float(np.median(limit[in_ring])) if in_ring.any() else math.nan)
        row[f"null_{ring:.1f}"] = rms(detection.snr[in_ring])
        row[f"known_star_{ring:.1f}"] = rms(optimal[in_ring])
        row[f"limit_{ring:.1f}"] = limits[-1]
    row["limit_mean"], row["limit_worst"] = np.nanmean(limits), np.nanmax(limits)
    return Table(rows=[row])


def main() -> None:
    """Run the study."""
    parser = options(__doc__.splitlines()[0])
    arguments = parser.parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if arguments.quick else {}
    setup = setting(tuple(arguments.opd) if arguments.opd else None, **changes)
    hours, seeds = (HOURS[2:3], 2) if arguments.quick else (HOURS, arguments.seeds)
    jobs = [(setup, h, k) for k in range(seeds) for h in hours]
    name = "calibration_measured" if arguments.opd else "calibration_generator"
    table = timed_table(
        lambda: mapped(one_frame, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for hour in hours:
        part = table[table["hours"] == hour]
        print(
            f"{hour:5.0f} h: null S/N {rms(part['null']):.3f} "
            f"(known star {rms(part['known_star_null']):.3f}), "
            f"limit {part['limit_mean'].mean():.3f}, star error {part['star_error'].mean():.2f}"
        )


if __name__ == "__main__":
    main()
