"""The completeness that first-order copies predict, against planets in full reductions.

Run from the root of the project, after `benchmarks.real_cases`::

    python -m benchmarks.completeness results/G-7-34_F444W_pair ...

Every folder has the fit of two rolls (``fit.fits``), and in ``products`` the planets that
`reduce(injections=...)` added to the frames: each was reduced from the start, and detected or not.
The fraction that was detected stands beside the mean of what `completeness` predicts for planets of
their contrasts and separations, from the fit without them.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.table import QTable, Table
from scipy.interpolate import RegularGridInterpolator

import pyklip_diffrender as dr

STRENGTHS = (0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.2, 2.6)
EDGES = (0.0, 0.45, 1.0, np.inf)
"""arcsec, between the rings of the table."""


def predicted(fit: dr.Refinement, planets: QTable) -> np.ndarray:
    """Probability that each planet is found."""
    detection = dr.detect(fit)
    away = planets["separation"].to_value("arcsec")
    grid = np.linspace(away.min(), away.max(), 12)
    table = dr.detection.completeness(detection, separations=grid, strengths=STRENGTHS)
    fractions = np.reshape(table["completeness"], (len(grid), len(STRENGTHS)))
    curve = detection.contrast_curve
    limits = np.interp(away, curve["separation"].to_value("arcsec"), curve["small_sample"])
    strength = np.clip(planets["injected"] / limits, STRENGTHS[0], STRENGTHS[-1])
    interpolate = RegularGridInterpolator((grid, STRENGTHS), fractions)
    return np.asarray(interpolate(np.stack([away, strength], axis=1)))


def main() -> None:
    """Compare all folders and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    options = parser.parse_args()
    rows = []
    for folder in options.folders:
        planets = QTable.read(folder / "products" / "injections.ecsv")
        probability = predicted(dr.Refinement.read(folder / "fit.fits"), planets)
        away = planets["separation"].to_value("arcsec")
        for low, high in pairwise(EDGES):
            ring = (away >= low) & (away < high)
            if ring.any():
                chance = probability[ring]
                expected = f"{chance.sum():.1f} +- {np.sqrt((chance * (1 - chance)).sum()):.1f}"
                count = int(planets["detected"][ring].sum())
                rows.append((folder.name, f"{low:g} to {high:g}", len(chance), count, expected))
                print(rows[-1], flush=True)
    Table(rows=rows, names=("case", "arcsec", "planets", "detected", "predicted")).pprint_all()


if __name__ == "__main__":
    main()
