"""The top of the page on the paper's experiments: three sentences, a table, the exceptions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import published
from astropy.table import Table
from judging import chosen, methods_in, spread
from pages import markdown, preferred
from sections import Lines

__all__ = ["in_short", "sentences", "where_others_lead"]

NEAR, FAR = 0.6, 1.6
"""Separations whose contrasts the table shows, arcsec."""


def sentences(results: Path) -> Lines:
    """The result, in three sentences."""
    found: Lines = []
    planets, curves = preferred(results, "klip_table"), preferred(results, "contrast_boundary")
    if planets:
        table = planets[0]
        won = chosen(table, method="marginalised")
        share = [
            spread(part["matched_snr"] / part["photon_snr"])[0]
            for part in _cases(won, ("separation", "contrast"))
        ]
        flux = [spread(part["throughput"])[0] for part in _cases(won, ("separation", "contrast"))]
        found.append(
            "Over the planets of the paper's comparison with KLIP, the marginalised estimate has "
            f"{min(share):.2f} to {max(share):.2f} of the S/N of a matched filter that knows the "
            f"star, and {min(flux):.3f} to {max(flux):.3f} of the planets' light."
        )
    if curves:
        table = curves[0]
        gain, below, of = [], [], 0
        for k, separation in enumerate(published.SEPARATIONS):
            part = chosen(table, separation=separation)
            if not len(part) or not 0.3 <= separation <= 2.2:
                continue
            ours = spread(chosen(part, method="marginalised")["contrast"])[0]
            gain.append(spread(chosen(part, method="KLIP")["contrast"])[0] / ours)
            limits = (published.BOUNDARY["theirs"][k], published.BOUNDARY["noise limit"][k])
            below.append([ours < limit for limit in limits])
            of += 1
        curve, limit = np.sum(below, axis=0)
        found.append(
            f"Its 5-sigma contrast from 0.3 to 2.2 arcsec is {min(gain):.0f} to {max(gain):.0f} "
            f"times lower than KLIP's; it is below the paper's published curve at {curve} of {of} "
            f"separations, and below the paper's published noise limit at {limit}."
        )
    if planets:
        errors = {
            name: spread(chosen(planets[0], method=name)["star_error"])[0]
            for name in ("Gauss-Newton", "Adam", "KLIP", "KLIP, library")
        }
        text = ", ".join(f"{n} {e:.2f}" for n, e in errors.items() if math.isfinite(e))
        found.append(f"Median error of the subtracted star, in units of the noise: {text}.")
    return [" ".join(found), ""]


def _cases(table: Table, keys: tuple[str, ...]) -> Iterable[Table]:
    for setting in dict.fromkeys(tuple(row[key] for key in keys) for row in table):
        yield chosen(table, **dict(zip(keys, setting, strict=True)))


def in_short(results: Path) -> Lines:
    """One row a method: medians over the six planets, and the contrast at two separations."""
    planets, curves = preferred(results, "klip_table"), preferred(results, "contrast_boundary")
    if not planets or not curves:
        return []
    rows = []
    for method in methods_in(planets[0]):
        part = chosen(planets[0], method=method)
        line = chosen(curves[0], method=method)
        # The library was given in the first study only.
        contrasts = [
            spread(chosen(line, separation=separation)["contrast"])[0] if len(line) else math.nan
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
        "method", "annulus SNR", "matched-filter S/N / photon limit", "planet's light kept",
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
"""Studies in which methods are set beside each other, and what tells their rows apart."""

OURS = ("Gauss-Newton", "marginalised")
_OURS = "Gauss-Newton and the marginalised estimate"

MEASURES = {"annulus_snr": True, "star_error": False, "contrast": False}
"""Columns, and whether more is better."""

UNITS = {"separation": '"', "hours": " h", "contrast": ""}


def where_others_lead(results: Path) -> Lines:
    """Rows in which KLIP or Adam is ahead of this package's images by the medians."""
    found, rows = [], 0
    for name, keys in COMPARED:
        study = preferred(results, name)
        for part in _cases(study[0], keys) if study else ():
            rows += 1
            where = ", ".join(f"{part[key][0]:g}{UNITS[key]}" for key in keys)
            for column, larger in MEASURES.items():
                if column in part.colnames and column not in keys:
                    what = column.replace("_", " ").replace("snr", "SNR")
                    found += _ahead(part, column, where, what, larger=larger)
    if not rows:
        return []
    if not found:
        return [f"In none of {rows} rows is another method ahead of both {_OURS}.", ""]
    return [
        f"Of {rows} rows of the comparisons below, another method's median is ahead of both "
        f"{_OURS} in these:",
        "",
        *(f"- {words}" for words in found),
        "",
        "Why: a bright planet's annulus SNR saturates, and faint remains of the star may raise it "
        "above that of the true star; where the true star's is small, all are noise. See the "
        "limits.",
        "",
    ]


def _ahead(part: Table, column: str, where: str, what: str, *, larger: bool) -> Lines:
    sign = 1 if larger else -1
    own = [spread(chosen(part, method=method)[column]) for method in OURS]
    ours = max((each for each in own if math.isfinite(each[0])), key=lambda each: sign * each[0])
    best = spread(chosen(part, method="optimal")[column])[0]
    known = f"; true star {best:.3g}" if math.isfinite(best) else ""
    words = []
    for method in ("KLIP", "KLIP, library", "Adam"):
        theirs = spread(chosen(part, method=method)[column])
        if sign * theirs[0] > sign * ours[0]:
            words.append(
                f"{where}: {what} {theirs[0]:.3g} ({method}) against {ours[0]:.3g} "
                f"({ours[1]:.3g} to {ours[2]:.3g}{known})"
            )
    return words
