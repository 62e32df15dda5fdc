"""What ``accuracy="quick"`` saves and costs: time, star's flux and limits over those of full fits.

    python -m benchmarks.first_look --opd MAP --output FILE CALINTS [CALINTS ...]

The frames of every star and filter among the files are reduced roll by roll and together, each
with one thread. Writes a table in ECSV with a row for each. Limits are compared as contrasts and
in units of flux, because contrasts take the star's flux, which a first look measures less well.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.table import Table

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from pyklip_diffrender.scene.sequence import ExposureSequence

Limits = dict[str, Any]


def reduced(frames: ExposureSequence, opd: Path, accuracy: Any) -> Limits:
    """Processor time, flux, status, and limits as contrasts by separation."""
    began = time.process_time()
    reduction = dr.reduce(frames, opd, accuracy=accuracy)
    seconds = time.process_time() - began
    curve = reduction.detection.contrast_curve
    return {
        "seconds": seconds,
        "flux": reduction.fit.frames[0].flux,
        "status": reduction.fit.status.name,
        "candidates": len(reduction.detection.candidates),
        "separation": curve["separation"].to_value("arcsec"),
        "contrast": np.asarray(curve["contrast"]),
    }


def compared(quick: Limits, full: Limits) -> dict[str, Any]:
    """A row of the table but for its frames."""
    inside = quick["separation"] <= full["separation"].max()
    known = np.interp(quick["separation"][inside], full["separation"], np.log(full["contrast"]))
    ratio = quick["contrast"][inside] / np.exp(known)
    flux = quick["flux"] / full["flux"]
    return {
        "full_s": full["seconds"], "quick_s": quick["seconds"],
        "time": quick["seconds"] / full["seconds"], "flux": flux,
        "limits": np.median(ratio), "limits_least": ratio.min(), "limits_most": ratio.max(),
        "limits_in_flux": np.median(ratio * flux),
        "status": quick["status"], "status_full": full["status"],
        "candidates": quick["candidates"], "candidates_full": full["candidates"],
    }  # fmt: skip


def main() -> None:
    """Reduce all frames twice, and print and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--opd", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("frames", nargs="+", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    groups: dict[tuple[str, str], list[Path]] = {}
    for path in sorted(options.frames):
        frame = dr.Observation.from_fits(path)
        groups.setdefault((frame.target, str(frame.filter)), []).append(path)
    rows: list[dict[str, Any]] = []
    for (star, band), paths in groups.items():
        rolls = [(f"roll {k + 1}", [path]) for k, path in enumerate(paths)]
        for name, used in [*rolls, (f"{len(paths)} rolls", paths)] if len(paths) > 1 else rolls:
            both = (reduced(ExposureSequence.from_files(used), options.opd, each)
                    for each in ("quick", "full"))  # fmt: skip
            rows.append({"star": star, "filter": band, "frames": name, **compared(*both)})
            print(rows[-1], flush=True)
    table = Table(rows)
    table.round({name: 3 for name in table.colnames if table[name].dtype.kind == "f"})
    table.meta = provenance("benchmarks.first_look --opd MAP --output FILE CALINTS")
    table.write(options.output, overwrite=True)


if __name__ == "__main__":
    main()
