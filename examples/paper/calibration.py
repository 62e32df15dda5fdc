"""Calibration: S/N at planet-free positions and the contrast limit, against drift.

    python examples/paper/calibration.py --opd BEFORE AFTER --seeds 20

One row of the table a frame: the standard deviation of S/N from 0 where there is no planet (for
all positions, and for the rings), that of the matched filter that knows the star, on the same
noise, and the ratio of the 5-sigma contrast to the matched filter's photon limit. About a hundred
positions of a frame are independent, a dozen in the innermost ring: one frame's standard deviation
scatters by 7 %, and about its own mean, which is not 0, it would be too small. Frames of the
longest drift, extrapolated from the others, take many times longer than those. On the embedded
generator each seed has a wavefront and a drift of its own.
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


def known_star_snr(found: Detection, shot: Frame) -> NDArray[np.float64]:
    """S/N map of the matched filter that knows the star and its noise."""
    templates = found.groups[0][1]
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
    """Root mean square of what is finite; NaN of nothing: a small field has no outer rings."""
    array = np.asarray(values, dtype=float)
    finite = array[np.isfinite(array)]
    return math.sqrt(np.mean(finite**2)) if finite.size else math.nan


def one_frame(here: Setting, hours: float, seed: int) -> Table:
    """One row of the table."""
    here = here.redrawn(seed)
    shot = frame(here, hours, seed)
    fit = dr.refine(here.model, shot.observation, here.measured)
    found = dr.detect(fit, threshold=math.inf)
    radius = np.hypot(found.grid[..., 0], found.grid[..., 1])
    inside = (radius >= RINGS[0]) & (radius < RINGS[-1])
    optimal = known_star_snr(found, shot)
    limit = found.error / found.photon_error
    (fitted,) = fit.frames
    level = float(fitted.values["background"][0])
    star_error = ((fitted.star - level - shot.star) / shot.noise)[inside]
    row = {
        "hours": hours,
        "seed": seed,
        "chi2": fit.chi2_per_pixel,
        "effective": fit.effective_parameters,
        "status": fit.status.name,
        "scatter": found.scatter,
        "null": rms(found.snr[inside]),
        "known_star_null": rms(optimal[inside]),
        "highest": np.abs(found.snr[inside]).max(),
        "beyond_4": int((np.abs(found.snr[inside]) > 4).sum()),
        "positions": int(inside.sum()),
        "star_error": float(np.sqrt(np.mean(star_error**2))),
        "seconds": fit.seconds,
    }
    limits = []
    for ring in RINGS[:-1]:
        where = (radius >= ring) & (radius < ring + 0.2)
        limits.append(float(np.median(limit[where])) if where.any() else math.nan)
        row[f"null_{ring:.1f}"] = rms(found.snr[where])
        row[f"known_star_{ring:.1f}"] = rms(optimal[where])
        row[f"limit_{ring:.1f}"] = limits[-1]
    row["limit_mean"], row["limit_worst"] = np.nanmean(limits), np.nanmax(limits)
    return Table(rows=[row])


def main() -> None:
    """Run the study."""
    parser = options(__doc__.splitlines()[0])
    given = parser.parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if given.quick else {}
    here = setting(tuple(given.opd) if given.opd else None, **changes)
    hours, seeds = (HOURS[2:3], 2) if given.quick else (HOURS, given.seeds)
    jobs = [(here, h, k) for k in range(seeds) for h in hours]
    name = "calibration_measured" if given.opd else "calibration_generator"
    table = timed_table(
        lambda: mapped(one_frame, jobs, given.processes), given.output / f"{name}.ecsv"
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
