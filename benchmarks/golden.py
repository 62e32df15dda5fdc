"""Numbers of reductions of real frames, frozen, so that a change of the code that moves them shows.

Run from the root of the project, with the frames of programmes 1184 and 1386 in ../shared/data::

    python -m benchmarks.golden --output docs/results/golden.ecsv   # to freeze the numbers
    python -m benchmarks.golden                                     # to compare with the table

Cases are single rolls, pairs, a pair with the frames of another star, a disk, a wide field and a
combined search, through Python, the command line and pyKLIP. All are quick looks of 48 x 48 pixels:
they go through the same code as full reductions in a tenth of the time. The full tier of the tests
compares some of them (``tests/test_golden.py``).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from astropy.io import fits
from astropy.table import QTable

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from benchmarks.real_frames import DATA, frames_of, opd_of
from pyklip_diffrender.cli import main as command_line
from pyklip_diffrender.detection import Detection

TABLE = Path(__file__).resolve().parents[1] / "docs" / "results" / "golden.ecsv"
SIZE = 48
SEPARATIONS = (0.5, 0.8, 1.1)
STARS, BANDS = ("G-7-34", "HIP17695", "V-AU-MIC"), ("F444W", "F356W")
PAIR = ("G-7-34", "F444W")

Numbers = dict[str, float]

TOLERANCES = {
    # Fits end when a step gains less than 0.02 in chi-squared per degree of freedom: another order
    # of sums moves chi-squared by a few 1e-4 of itself, and limits and fluxes by a few 1e-3.
    "chi2": (2e-3, 0.0),
    "limit": (1e-2, 0.0),
    "flux": (5e-3, 0.0),
    "snr": (1e-2, 0.05),
    # arcsec; a twentieth of the error of a candidate of S/N 10.
    "place": (0.0, 5e-4),
    "image": (1e-2, 0.0),
    "count": (0.0, 0.0),
}
"""Relative and absolute tolerance by the first word of a number's name."""


def reduced(
    data: Path, star: str, band: str = "F444W", rolls: slice = slice(None), **options: object
) -> dr.Reduction:
    sequence = frames_of(data, star, band)
    references = sequence.references if options.pop("with_references", False) else ()
    sequence = replace(sequence, science=sequence.science[rolls], references=references)
    settings = {"accuracy": "quick", "size": SIZE} | options
    return dr.reduce(sequence, opd_of(data, star), **settings)


def numbers_of(reduction: dr.Reduction) -> Numbers:
    """What a user reads off a reduction."""
    detection, fit = reduction.detection, reduction.fit
    values = numbers_of_search(detection)
    values["count of the status"] = float(list(dr.Status).index(fit.status))
    values["chi2"] = fit.chi2_per_pixel
    values["flux of the star"] = fit.frames[0].flux
    values["image rms"] = float(np.nanstd(detection.subtracted[0]))
    return values


def numbers_of_search(detection: Detection) -> Numbers:
    curve, table = detection.contrast_curve, detection.candidates
    values = {"count of candidates": float(len(table))}
    limits = np.interp(SEPARATIONS, curve["separation"].value, curve["contrast"])
    values |= {f"limit at {s}": float(v) for s, v in zip(SEPARATIONS, limits, strict=True)}
    values["snr rms"] = float(np.nanstd(detection.residual_snr))
    values |= numbers_of_table(table)
    return values


def numbers_of_table(table: QTable) -> Numbers:
    values = {}
    for k, row in enumerate(table):
        values[f"place {k}: east"] = float(row["delta_ra"].value)
        values[f"place {k}: north"] = float(row["delta_dec"].value)
        values[f"snr {k}"] = float(row["snr"])
        for name in table.colnames:
            if name.startswith("contrast") and not name.endswith(("_error", "_corr")):
                values[f"flux {k}: {name}"] = float(row[name])
    return values


def through_command_line(data: Path) -> Numbers:
    """A pair and its combined search with the other filter, by the command."""
    star, _ = PAIR
    with tempfile.TemporaryDirectory() as folder:
        arguments = [
            "reduce", str(data / "gto1184"), "--target", star, "--opd", str(opd_of(data)),
            "--quick", "--size", str(SIZE), "-q", "-o", folder,
        ]  # fmt: skip
        if command_line(arguments):
            raise SystemExit("the command failed")
        values = {}
        for path in sorted(Path(folder).glob("*/detection.fits")):
            for name, value in numbers_of_search(Detection.read(path.parent)).items():
                kind, _, rest = name.partition(" ")
                values[f"{kind} {path.parent.name} {rest}"] = value
        combined = json.loads((Path(folder) / "comparison.json").read_text())["combined"]
    values["count of the combined search"] = float(len(combined["candidates"]))
    values["limit combined, median"] = float(np.median([e["contrast"] for e in combined["limits"]]))
    return values


def through_pyklip(data: Path) -> Numbers:
    """The product of pyKLIP's door for a pair."""
    from pyklip.instruments.JWST import JWSTData
    from pyklip.parallelized import klip_dataset

    files = sorted(str(each) for each in (data / "gto1184").glob("jw0118400[56]001_03106_*"))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dr.register(opd=opd_of(data), size=36, accuracy="quick")
        try:
            dataset = JWSTData(files, None, highpass=False)
            klip_dataset(
                dataset, mode="ADI", annuli=1, subsections=1, numbasis=[1], outputdir=folder,
                fileprefix="star", algo="diffrender", numthreads=1, verbose=False,
            )  # fmt: skip
        finally:
            dr.pyklip_backend.unregister()
        image = fits.getdata(Path(folder) / "star-KLmodes-all.fits")[0]
    known = np.isfinite(image)
    return {
        "count of pixels": float(known.sum()),
        "image rms": float(np.std(image[known])),
        "image largest": float(image[known].max()),
    }


def combined(data: Path) -> Numbers:
    """The filters of a star searched together."""
    both = dr.combine([reduced(data, PAIR[0], band) for band in BANDS])
    values = {"count of candidates": float(len(both.candidates))}
    values |= numbers_of_table(both.candidates)
    values["limit, median"] = float(np.median(both.limits["contrast"]))
    values["snr rms"] = float(np.nanstd(both.snr))
    return values


def _reduction(star: str, band: str, data: Path, **options: object) -> Numbers:
    return numbers_of(reduced(data, star, band, **options))


CASES: dict[str, Callable[[Path], Numbers]] = {
    "HIP-65426": lambda data: numbers_of(reduced(data, "HIP-65426")),
    "HIP-65426, wide": lambda data: numbers_of(reduced(data, "HIP-65426", wide=True)),
    **{f"{star}, {band}": partial(_reduction, star, band) for star in STARS[:2] for band in BANDS},
    "V-AU-MIC, F444W, disk": partial(_reduction, "V-AU-MIC", "F444W", disk=True),
    **{
        f"{star}, {band}, roll {k + 1}": partial(_reduction, star, band, rolls=slice(k, k + 1))
        for star in STARS
        for band in BANDS
        for k in range(2)
    },
    "G-7-34, F444W, with references": partial(_reduction, *PAIR, with_references=True),
    "G-7-34, F444W, own pattern": partial(
        _reduction, *PAIR, with_references=True, pattern="references"
    ),
    "combined": combined,
    "command line": through_command_line,
    "pyKLIP": through_pyklip,
}
"""Functions of the folder of the data."""

IN_TESTS = ("HIP-65426", "G-7-34, F444W, with references", "pyKLIP")
"""Cases of the full tier of the tests."""


def differences(case: str, found: Numbers, frozen: QTable) -> list[str]:
    """Say which numbers of a case are not those of the table."""
    rows = frozen[frozen["case"] == case]
    expected = dict(zip(rows["number"], rows["value"], strict=True))
    texts = [f"{name}: only in one of both" for name in sorted(found.keys() ^ expected.keys())]
    for name in sorted(found.keys() & expected.keys()):
        relative, absolute = TOLERANCES[name.split()[0].rstrip(",:")]
        one, other = found[name], float(expected[name])
        if abs(one - other) > absolute + relative * abs(other):
            texts.append(f"{name}: {one:.6g}, frozen {other:.6g}")
    return texts


def main() -> None:
    """Compute all cases, and freeze or compare them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, help="freeze the numbers")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--case", action="append", choices=tuple(CASES))
    options = parser.parse_args()
    torch.set_num_threads(1)
    frozen = None if options.output else QTable.read(TABLE)
    rows, failed = [], False
    for case in options.case or CASES:
        found = CASES[case](options.data)
        rows += [(case, name, value) for name, value in found.items()]
        texts = [] if frozen is None else differences(case, found, frozen)
        failed |= bool(texts)
        print("\n  ".join([f"{case}: {len(found)} numbers", *texts]), flush=True)
    if options.output is None:
        raise SystemExit(failed)
    table = QTable(rows=rows, names=("case", "number", "value"))
    table["value"].info.format = ".8g"
    table.meta = provenance("benchmarks.golden --output docs/results/golden.ecsv")
    table.write(options.output, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
