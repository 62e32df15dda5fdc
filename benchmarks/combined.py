"""How many false candidates a combined search has, and how much deeper it is than one filter.

Run from the root of the project::

    python -m benchmarks.combined --output docs/results/combined_search.ecsv [--sequences 12]

Frames of a star are simulated in two and in three filters and at two epochs, each with a wavefront
that has drifted since the map, and fitted and searched by `refine` and `detect`. The searches are
combined by `combine`. Numbers of finished sequences are kept beside the table (`.jsonl`), and not
computed again. The table has, for each set:

- the standard deviation of the S/N of noise, without planets, of single and combined searches;
- how many searches of noise have a peak above a lowered threshold, of a single filter and of all
  together, beside the number that is stated;
- the ratio of the limit of the best single filter to that of the combination, for a planet of 1,500
  K, each at the threshold of equal false-alarm probability, beside the root of the summed squares.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.table import QTable
from astropy.time import Time

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from pyklip_diffrender.detection import Detection, SkyMap
from pyklip_diffrender.detection.field import separation_of
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.wavefront.bases import FourierModes, JointBasis, SegmentMotions

WAVELENGTHS = {"F444W": 4.4e-6, "F356W": 3.56e-6, "F300M": 3.0e-6}
SETS = {
    "two filters": (("F444W", 0), ("F356W", 0)),
    "three filters": (("F444W", 0), ("F356W", 0), ("F300M", 0)),
    "two epochs": (("F444W", 0), ("F444W", 1)),
}
"""Filter and epoch of the searches that are combined."""

STAR = "A2V, K=6.77"
NPIX, SIDE, CYCLES = 64, 32, 4.0
DATES = ("2022-08-01T00:00:00", "2023-09-01T00:00:00")
MOTION = (0.3, -0.2)
INNER = 0.35
LEVEL = 3.4
"""Threshold at which false candidates are counted: high enough for the theory of maxima, and low
enough for a few in some dozens of searches."""


def searched(name: str, epoch: int, seed: int) -> Detection:
    """Simulate, fit and search a frame without a planet."""
    model = dr.nircam_coronagraph(name, monochromatic=WAVELENGTHS[name], npix=NPIX, fov_pixels=SIDE)
    sensed = dr.wavefront.random_opd(3, npix=NPIX).data
    basis = JointBasis([SegmentMotions(), FourierModes(CYCLES)])
    # Every epoch has its own drift, which the filters share.
    generator = torch.Generator().manual_seed(10 * seed + epoch)
    deviation = 1e-9 * torch.where(basis.frequencies == 0, 2.0, 0.15)
    change = deviation * torch.randn(len(basis), dtype=torch.float64, generator=generator)
    drift = basis.opd(change, PupilGrid.full(NPIX)).numpy()
    number = 100 * seed + 10 * epoch + list(WAVELENGTHS).index(name)
    frame = replace(
        dr.simulate(model, dr.Scene(), sensed + drift, seed=number),
        position_angles=np.array([15.0 + 60.0 * epoch]),
        date=Time(DATES[epoch]),
    )
    settings = dr.FitSettings(basis=basis, response_npix=NPIX)
    fit = dr.refine(model, frame, sensed, settings=settings)
    return dr.detect(fit, inner=INNER)


def combined(detections: Sequence[Detection], threshold: float) -> dr.Combination:
    return dr.combine(
        detections, star=STAR, threshold=threshold, inner=INNER, proper_motion=MOTION,
        parallax=0.01,
    )  # fmt: skip


def highest(detection: Detection) -> float:
    """Highest peak between the pixels of a single search, in Gaussian standard deviations."""
    each = SkyMap.of(detection, "one")
    x, y = np.moveaxis(detection.grid, -1, 0)
    fine = np.linspace(0, 1, 4 * SIDE)
    places = np.stack(np.meshgrid(x.min() + fine * np.ptp(x), y.min() + fine * np.ptp(y)), axis=-1)
    values = each.at(each.on_sky(places))[1]
    return float(values[separation_of(places) >= INNER].max())


def deviation(detection: Detection) -> float:
    used = separation_of(detection.grid) >= INNER
    return float(np.nanstd(detection.snr[used]))


def main() -> None:
    """Simulate, combine, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--sequences", type=int, default=12)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    kept = options.output.with_suffix(".jsonl")
    known = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    for seed in range(len(known), options.sequences):
        known.append(sequence(seed))
        with open(kept, "a", encoding="utf-8") as file:
            file.write(json.dumps(known[-1]) + "\n")
        print(f"sequence {seed + 1} of {options.sequences}", flush=True)
    for name in SETS:
        parts = [each[name] for each in known[: options.sequences]]
        means = {key: float(np.mean([each[key] for each in parts])) for key in parts[0]}
        rows.append({"set": name, "searches": len(parts)} | means)
    table = QTable(rows)
    for column in table.colnames[2:]:
        table[column].info.format = ".3f"
    table.meta = provenance(f"benchmarks.combined --sequences {options.sequences}")
    table.meta["threshold"] = LEVEL
    table.write(options.output, format="ascii.ecsv", overwrite=True)
    table.pprint_all()


def sequence(seed: int) -> dict[str, dict[str, float]]:
    """Simulate one star in all filters and epochs; numbers by set."""
    members = sorted({each for parts in SETS.values() for each in parts})
    singles = {each: searched(*each, seed) for each in members}
    numbers = {}
    for name, parts in SETS.items():
        chosen = [singles[each] for each in parts]
        both = combined(chosen, LEVEL)
        best, squares, all_ = gain(chosen)
        numbers[name] = {
            "snr_single": float(np.mean([deviation(each) for each in chosen])),
            "snr_combined": float(np.nanstd(both.snr[:, separation_of(both.grid) >= INNER])),
            "false_single": float(np.mean([highest(each) > LEVEL for each in chosen])),
            "false_combined": float(len(both.candidates) > 0),
            "false_stated": stated(both),
            "gain": best / all_,
            "gain_without_trials": best * squares**0.5,
        }
    return numbers


def gain(chosen: Sequence[Detection]) -> tuple[float, float, float]:
    """Limit of the best search, sum of the squares of the inverse errors, and combined limit.

    For a planet of 1,500 K, as the amplitude of its spectrum, median beyond 0.35 arcsec.
    """
    both = combined(chosen, 5.0)
    spectrum = (
        both.spectra.names.index("black body of 1500 K") if len(both.spectra.names) > 1 else 0
    )
    places = both.grid[separation_of(both.grid) >= INNER][::7]
    errors = []
    for each in both.maps:
        flux = both.spectra.flux[spectrum, both.spectra.filters.index(each.filter)]
        star = 1.0 if both.unit != "Jy" else float(each.star or 1.0)
        errors.append(each.at(places)[2] * star / flux)
    errors = np.array(errors)
    inside = np.isfinite(errors).all(axis=0)
    all_ = (errors[:, inside] ** -2.0).sum(axis=0) ** -0.5
    level = next(v for k, v in both.thresholds.items() if k.endswith("spectra") and
                 (k.startswith("all")))  # fmt: skip
    best = 5.0 * float(np.median(errors[:, inside], axis=1).min())
    return best, float(np.median(all_)) ** -2.0 / 25.0, level * float(np.median(all_))


def stated(both: dr.Combination) -> float:
    """Probability of a false candidate that the thresholds of a combined search are made for."""
    return float(-np.expm1(-both.expected_false_candidates))


if __name__ == "__main__":
    main()
