"""The top of the page on the paper's experiments: three sentences, a table, the exceptions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import published
from astropy.table import Table
from judging import methods_in, select, spread
from pages import markdown, study_table
from sections import Lines

__all__ = ["sentences", "summary_table", "where_others_lead"]

NEAR, FAR = 0.6, 1.6
"""Separations whose contrasts the table shows, arcsec."""


def sentences(results: Path) -> Lines:
    """The result, in three sentences."""
    lines: Lines = []
    planets, curves = study_table(results, "klip_table"), study_table(results, "contrast_boundary")
    if planets:
        table = planets[0]
        won = select(table, method="marginalised")
        share = [
            spread(part["matched_snr"] / part["photon_snr"])[0]
            for part in _cases(won, ("separation", "contrast"))
        ]
        flux = [spread(part["throughput"])[0] for part in _cases(won, ("separation", "contrast"))]
        lines.append(
            "Over the planets of the paper's comparison with KLIP, the marginalised estimate has "
            f"{min(share):.2f} to {max(share):.2f} of the S/N of a matched filter for a known "
            f"star, and fluxes of {min(flux):.3f} to {max(flux):.3f} of the true ones."
        )
    if curves:
        table = curves[0]
        gain, below, of = [], [], 0
        for k, separation in enumerate(published.SEPARATIONS):
            part = select(table, separation=separation)
            if not len(part) or not 0.3 <= separation <= 2.2:
                continue
            ours = spread(select(part, method="marginalised")["contrast"])[0]
            gain.append(spread(select(part, method="KLIP")["contrast"])[0] / ours)
            limits = (published.BOUNDARY["theirs"][k], published.BOUNDARY["noise limit"][k])
            below.append([ours < limit for limit in limits])
            of += 1
        curve, limit = np.sum(below, axis=0)
        lines.append(
            f"Its 5-sigma contrast from 0.3 to 2.2 arcsec is {min(gain):.0f} to {max(gain):.0f} "
            f"times lower than KLIP's; it is below the paper's published curve at {curve} of {of} "
            f"separations, and below the paper's published noise limit at {limit}."
        )
    if planets:
        errors = {
            name: spread(select(planets[0], method=name)["star_error"])[0]
            for name in ("Gauss-Newton", "Adam", "KLIP", "KLIP, library")
        }
        text = ", ".join(f"{n} {e:.2f}" for n, e in errors.items() if math.isfinite(e))
        lines.append(f"Median error of the subtracted star, in units of the noise: {text}.")
    return [" ".join(lines), ""]


def _cases(table: Table, keys: tuple[str, ...]) -> Iterable[Table]:
    for setting in dict.fromkeys(tuple(row[key] for key in keys) for row in table):
        yield select(table, **dict(zip(keys, setting, strict=True)))


def summary_table(results: Path) -> Lines:
    """One row for each method: medians over the six planets, and two contrasts."""
    planets, curves = study_table(results, "klip_table"), study_table(results, "contrast_boundary")
    if not planets or not curves:
        return []
    rows = []
    for method in methods_in(planets[0]):
        part = select(planets[0], method=method)
        line = select(curves[0], method=method)
        # The library was given in the first study only.
        contrasts = [
            spread(select(line, separation=separation)["contrast"])[0] if len(line) else math.nan
            for separation in (NEAR, FAR)
        ]
        cells = [
            (spread(part["annulus_snr"])[0], ".1f"),
            (spread(part["matched_snr"] / part["photon_snr"])[0], ".2f"),
            (spread(part["throughput"])[0], ".2f"),
            (spread(part["star_error"])[0], ".2f"),
            *((contrast, ".2g") for contrast in contrasts),
        ]
        rows.append([method, *("" if math.isnan(v) else f"{v:{form}}" for v, form in cells)])
    header = (
        "method", "annulus SNR", "matched-filter S/N / photon limit", "throughput",
        "star error, sigma", f'5-sigma contrast at {NEAR}"', f'at {FAR}"',
    )  # fmt: skip
    return [
        "Medians over the six planets of the comparison with KLIP, and over noise:",
        "",
        *markdown(header, rows),
    ]


COMPARED = (
    ("klip_table", ("separation", "contrast")),
    ("contrast_boundary", ("separation",)),
    ("contrast_drift", ("contrast", "hours")),
    ("snr_grid", ("contrast", "hours", "separation")),
)
"""Studies that compare methods, and the columns that identify their cases."""

OURS = ("Gauss-Newton", "marginalised")
_OURS = "Gauss-Newton and the marginalised estimate"

MEASURES = {"annulus_snr": True, "star_error": False, "contrast": False}
"""Columns, and whether more is better."""

UNITS = {"separation": '"', "hours": " h", "contrast": ""}


def where_others_lead(results: Path) -> Lines:
    """Cases in which the median of KLIP or Adam is better than that of this package."""
    lines, rows = [], 0
    for name, keys in COMPARED:
        study = study_table(results, name)
        for part in _cases(study[0], keys) if study else ():
            rows += 1
            case = ", ".join(f"{part[key][0]:g}{UNITS[key]}" for key in keys)
            for column, larger in MEASURES.items():
                if column in part.colnames and column not in keys:
                    quantity = column.replace("_", " ").replace("snr", "SNR")
                    lines += _ahead(part, column, case, quantity, larger=larger)
    if not rows:
        return []
    if not lines:
        return [f"In none of {rows} rows is another method ahead of both {_OURS}.", ""]
    return [
        f"Of {rows} rows of the comparisons below, another method's median is ahead of both "
        f"{_OURS} in these:",
        "",
        *(f"- {words}" for words in lines),
        "",
        "The annulus SNR of a bright planet saturates, and faint residuals of the star may "
        "increase it above that of the true star. If that of the true star is small, all are "
        "noise. See the limits.",
        "",
    ]


def _ahead(part: Table, column: str, case: str, quantity: str, *, larger: bool) -> Lines:
    sign = 1 if larger else -1
    spreads = [spread(select(part, method=method)[column]) for method in OURS]
    ours = max(
        (each for each in spreads if math.isfinite(each[0])), key=lambda each: sign * each[0]
    )
    best = spread(select(part, method="optimal")[column])[0]
    reference = f"; true star {best:.3g}" if math.isfinite(best) else ""
    words = []
    for method in ("KLIP", "KLIP, library", "Adam"):
        theirs = spread(select(part, method=method)[column])
        if sign * theirs[0] > sign * ours[0]:
            words.append(
                f"{case}: {quantity} {theirs[0]:.3g} ({method}) against {ours[0]:.3g} "
                f"({ours[1]:.3g} to {ours[2]:.3g}{reference})"
            )
    return words
