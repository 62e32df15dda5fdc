"""Rolls and pairs of rolls of all real stars with the default options, beside KLIP.

Run from the root of the project, with the frames of programmes 1184 and 1386 in ../shared/data::

    python -m benchmarks.real_cases --output results --planets 28

Every case is reduced with `reduce` as a user would: every roll alone and both together, of three
stars in two filters, and HIP 65426. Pairs are reduced with the package's library of patterns and
with it taken away, as for a filter that is not in it, and with the two rolls of the other M dwarf
as reference frames and without; of stars with a disk, these are the four rolls of both M dwarfs.
KLIP has the same frames. Without references the library's pattern is still that of another star, so
that only the cases without the library are like with like there. Fits, products and one row of the
table are kept per case, so that a run that was stopped goes on. For two rolls the table has the
5-sigma contrast limits of `reduce` and of KLIP (`klip_curve`: the other roll and the reference
frames, the best of 1 to 5 modes), both without and with their small-sample corrections, and
`limit_by_ring`: those of `reduce` with the noise of KLIP's curve, the scatter of the map of
contrasts in a ring of width lambda/D with the correction of Mawet et al. (2014). `closed` is the
part of the gap between KLIP's limit and that of a known star which is closed, (KLIP - ours) / (KLIP
- known star) without corrections; the limit of a known star is that of Godoy et al. (2024,
arXiv:2409.03485).
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy import units as u
from astropy.table import Table, vstack

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from benchmarks.real_frames import DATA, frames_of, opd_of
from pyklip_diffrender.io.files import write_table
from pyklip_diffrender.pattern import choice as patterns
from pyklip_diffrender.reduction.klip import klip_curve, small_sample_factor
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.refinement import jansky_per_unit

SEPARATIONS = np.array([0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 2.3])
SIZE = 80
NEAR = 0.45
"""arcsec within which detections of injected planets are counted on their own."""

STARS = {"G-7-34": "star", "HIP17695": "star", "V-AU-MIC": "disk"}
FILTERS = ("F444W", "F356W")


Case = tuple[str, str, str, str, str]
"""Star; filter; rolls ("pair", "roll 1", "roll 2"); the package's library of patterns ("library" or
"no library"); frames of other stars ("references" or "no references")."""

GIVEN = ("star", "filter", "library", "references")

COLUMNS = {
    "limit": "contrast", "limit_small_sample": "small_sample", "limit_by_ring": "by_ring",
    "klip": "KLIP", "klip_small_sample": "KLIP small sample", "known_star": "known_star",
    "error_factor": "error_factor",
}  # fmt: skip
"""Columns of the table of limits, and where the row of a case has them."""

FORMS = (
    ("no library", "references"),
    ("no library", "no references"),
    ("library", "references"),
    ("library", "no references"),
)


def cases() -> list[Case]:
    """All cases, the most telling first."""
    pairs = [(star, band, "pair", *form) for form in FORMS for star in STARS for band in FILTERS]
    alone = [(star, band, f"roll {n}") for star in STARS for band in FILTERS for n in (1, 2)]
    rolls = [("HIP-65426", "F444W", "roll 1"), *alone]
    return [*pairs, *((*each, "library", "no references") for each in rolls)]


def reduce_case(
    star: str,
    band: str,
    rolls: str,
    library: str,
    references: str,
    data: Path,
    planets: int,
    folder: Path,
    start: str | None = None,
) -> None:
    """Reduce one case and write its products and row; `start` may be a map other than the usual."""
    torch.set_num_threads(1)
    began = time.process_time()
    pair = rolls == "pair"
    # Seven planets at a time, few of which are found, would widen the scatter of a single roll.
    most = planets if pair else min(planets, 3)
    injections = most if STARS.get(star) == "star" else 0
    sequence = frames_of(data, star, band)
    science = sequence.science if pair else sequence.science[int(rolls[-1]) - 1 :][:1]
    others = [each for each in sequence.references if STARS.get(each.target) == "star"]
    given = tuple(others) if references == "references" else ()
    if library == "no library":
        patterns.package_library = lambda: dr.PatternLibrary(())
    result = dr.reduce(
        replace(sequence, science=science, references=given),
        start or opd_of(data, star),
        disk=STARS.get(star) == "disk",
        injections=injections,
    )
    seconds, detection = time.process_time() - began, result.detection
    distance = np.hypot(detection.grid[..., 0], detection.grid[..., 1])
    distant = distance > 0.3
    snr = detection.residual_snr[distant]
    peak_memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    row: dict[str, Any] = {
        "star": star, "filter": band, "rolls": rolls, "library": library, "references": references,
        "use": result.visit.in_words(),
        "status": result.fit.status.name,
        "chi2": round(result.fit.chi2_per_pixel, 3),
        "star Jy": star_flux_density(result.fit),
        "S/N scatter": round(float(np.nanstd(snr)), 3),
        "S/N range": f"{np.nanmin(snr):.1f} to {np.nanmax(snr):.1f}",
        "candidates": " ".join(
            f"{each['snr']:.2f}@{each['separation'].value:.3f},{each['position_angle'].value:.1f}"
            for each in detection.candidates
        ),
        "CPU s": round(seconds), "GiB": round(peak_memory, 2),
    }  # fmt: skip
    curve = detection.contrast_curve
    ours = {
        name: np.interp(SEPARATIONS, curve["separation"].value, curve[name])
        for name in ("contrast", "small_sample", "known_star", "error_factor")
    }
    resolution = curve.meta["resolution_arcsec"]
    rings = [np.abs(distance - each) < resolution / 2 for each in SEPARATIONS]
    scatter = [np.nanstd((detection.residual_snr * detection.error)[ring]) for ring in rings]
    ours["by_ring"] = 5 * np.array(scatter) * small_sample_factor(SEPARATIONS, resolution)
    row |= {name: values.tolist() for name, values in ours.items()}
    if pair:
        klip = klip_curve(detection, result.sequence.references, SEPARATIONS)
        row["KLIP"] = np.asarray(klip["contrast"]).tolist()
        row["KLIP small sample"] = np.asarray(klip["small_sample"]).tolist()
        row["modes"] = np.asarray(klip["modes"]).tolist()
    if result.injections is not None:
        about = summarise(result)["injections"]
        near = np.asarray(result.injections["separation"].to_value("arcsec")) < NEAR
        detected = np.asarray(result.injections["detected"])
        row["injections"] = {
            **{key: each for key, each in about.items() if key != "planets"},
            f"detected within {NEAR} arcsec": f"{detected[near].sum()} of {near.sum()}",
            "detected beyond": f"{detected[~near].sum()} of {(~near).sum()}",
        }
    result.write(folder / "products", overwrite=True)
    # With the derivatives, for `benchmarks.false_alarms`.
    result.fit.write(folder / "fit.fits", overwrite=True)
    (folder / "row.json").write_text(json.dumps(row))


def star_flux_density(fit: dr.Refinement) -> float:
    """Flux density of the star in Jy, which all of its frames share."""
    scale = jansky_per_unit(fit.frames[0])
    assert scale is not None, "the frames have no PIXAR_SR"
    return float(f"{scale * fit.frames[0].flux:.4g}")


def limits_of_pairs(rows: list[dict[str, Any]]) -> Table:
    """One row for each separation of every pair, with what both methods were given."""
    parts = []
    for row in sorted(rows, key=lambda row: [row[name] for name in GIVEN]):
        if "KLIP" not in row:
            continue
        part = Table({name: [row[name]] * len(SEPARATIONS) for name in GIVEN})
        part["separation"] = SEPARATIONS * u.arcsec
        for name, key in COLUMNS.items():
            part[name] = row[key]
        ours, klip, known = part["limit"], part["klip"], part["known_star"]
        part["ratio"] = klip / ours
        part["ratio_small_sample"] = part["klip_small_sample"] / part["limit_small_sample"]
        part["ratio_by_ring"] = part["klip_small_sample"] / part["limit_by_ring"]
        part["over_known_star"] = ours / known
        part["closed"] = (klip - ours) / (klip - known)
        parts.append(part)
    table = vstack(parts)
    table.meta = provenance("benchmarks.real_cases --output FOLDER --planets 0 --limits FILE")
    about = {
        "library": "the package's patterns of other stars, or none",
        "references": "frames of other stars that both methods were given",
        "limit": "5-sigma contrast, median over the ring",
        "klip": "KLIP's limit, best of 1 to 5 modes, with the other roll and the references",
        "known_star": "limit for a known star, without error factor",
        "limit_by_ring": "with the noise of KLIP's curve",
        "ratio": "KLIP / this package",
        "ratio_small_sample": "the same, each with its small-sample correction",
        "error_factor": "factor by which errors are multiplied",
    }
    for name, text in about.items():
        table[name].description = text
    for name in table.colnames[len(GIVEN) + 1 :]:
        table[name].format = ".2e" if name.startswith(("limit", "klip", "known")) else ".2f"
    return table


def print_tables(rows: list[dict[str, Any]]) -> None:
    """Print one row per case, the limits of the pairs, and their median and least ratios."""
    short = ("star", "filter", "rolls", "library", "references", "status", "chi2", "star Jy",
             "S/N scatter", "S/N range", "candidates", "CPU s", "GiB")  # fmt: skip
    Table([{key: row[key] for key in short} for row in rows]).pprint_all()
    for row in rows:
        print(*(row[name] for name in GIVEN), row.get("injections", ""))
    limits = limits_of_pairs(rows)
    limits.pprint_all()
    ratios = limits[[*GIVEN, "ratio", "ratio_small_sample", "ratio_by_ring"]].group_by(GIVEN)
    for extreme in (np.median, np.min):
        ratios.groups.aggregate(extreme).pprint_all()


def main() -> None:
    """Reduce all cases in processes of their own and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--planets", type=int, default=28)
    parser.add_argument(
        "--case", nargs=5, metavar=("STAR", "FILTER", "ROLLS", "LIBRARY", "REFERENCES")
    )
    parser.add_argument("--opd", help="map to start from; flat for none")
    parser.add_argument("--tables", action="store_true", help="only print those of earlier runs")
    parser.add_argument("--limits", type=Path, help="file for the limits of pairs of rolls (ECSV)")
    options = parser.parse_args()
    chosen = [tuple(options.case)] if options.case else cases()
    for case in [] if options.tables else chosen:
        folder = options.output / "_".join(case).replace(" ", "")
        if (folder / "row.json").exists():
            continue
        folder.mkdir(parents=True, exist_ok=True)
        if options.case:
            reduce_case(*case, options.data, options.planets, folder, options.opd)
        else:  # So that the peak memory is that of the case.
            rest = ["--data", options.data, "--output", options.output]
            number = ["--planets", str(options.planets)]
            command = [sys.executable, "-m", "benchmarks.real_cases", *rest, *number]
            subprocess.run([*command, "--case", *case], check=False)
    if not options.case:
        rows = [json.loads(path.read_text()) for path in options.output.glob("*/row.json")]
        print_tables(rows)
        if options.limits is not None:
            write_table(limits_of_pairs(rows), options.limits)


if __name__ == "__main__":
    main()
