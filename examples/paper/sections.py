"""Tables of the page on the paper's experiments, in Markdown; see `experiments.py`."""

from __future__ import annotations

import beyond
import contrast_boundary
import location
import misalignment
import numpy as np
import published
from astropy.table import Table
from judging import median_and_spread, methods_in, select, spread
from pages import markdown

Lines = list[str]


def grid(table: Table, keys: tuple[str, ...], columns: dict[str, str], form: str) -> Lines:
    """Markdown table of medians and spreads, with settings as rows and methods as columns."""
    lines: Lines = []
    names = methods_in(table)
    settings = list(dict.fromkeys(tuple(row[key] for key in keys) for row in table))
    for column, title in columns.items():
        with_values = [n for n in names if np.isfinite(select(table, method=n)[column]).any()]
        rows = []
        for setting in settings:
            part = select(table, **dict(zip(keys, setting, strict=True)))
            cells = [
                median_and_spread(select(part, method=name)[column], form) for name in with_values
            ]
            rows.append([", ".join(_short(value) for value in setting), *cells])
        lines += [f"{title}:", "", *markdown((", ".join(keys), *with_values), rows)]
    return lines


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def about_boundary(table: Table) -> Lines:
    """Contrast by separation."""
    names = [*contrast_boundary.LIMITS, "KLIP", "Adam", "Gauss-Newton", "marginalised"]
    rows = []
    for separation in np.unique(table["separation"]):
        part = select(table, separation=separation)
        cells = [median_and_spread(select(part, method=name)["contrast"], ".2g") for name in names]
        theirs = dict(zip(published.SEPARATIONS, published.BOUNDARY["theirs"], strict=True))
        rows.append([f"{separation:g}", *cells, f"{theirs[round(float(separation), 3)]:.2g}"])
    ordered = table[np.argsort(table["separation"], kind="stable")]
    throughput_of = grid(
        ordered, ("separation",), {"throughput": "Throughput of the planet"}, ".2f"
    )
    return [*markdown(("arcsec", *names, "published, theirs"), rows), *throughput_of]


def about_klip(table: Table) -> Lines:
    """Six planets."""
    columns = {
        "annulus_snr": "Annulus SNR, the paper's (no significance, see the limits)",
        "matched_snr": "Matched-filter S/N",
        "throughput": "Planet's light kept; for the marginalised estimate, measured / true",
        "star_error": "Star-model error, sigma (for KLIP with what it took of the planet)",
    }
    rows = [
        [f"{separation:g}, {contrast:g}", *(f"{value:g}" for value in values)]
        for (separation, contrast), values in published.TABLE.items()
    ]
    return [
        *grid(table, ("separation", "contrast"), columns, ".2f"),
        f"Annulus SNR as published ({published.TABLE_SOURCE}):",
        "",
        *markdown(("separation, contrast", "KLIP", "theirs", "optimal"), rows),
    ]


def about_misalignment(table: Table) -> Lines:
    """PSNR."""
    rows, behind = [], []
    for axis, amount in dict.fromkeys((row["axis"], row["amount"]) for row in table):
        part = select(table, axis=axis, amount=amount)
        cells = [median_and_spread(select(part, method=m)["psnr"]) for m in misalignment.STYLES]
        share = median_and_spread(part["marginalised_throughput"], ".3f")
        rows.append(
            [f"{axis}: {amount:g}", *cells, median_and_spread(part["marginalised_snr"]), share]
        )
        fitted, best = (
            spread(select(part, method=m)["psnr"])[0] for m in ("Gauss-Newton, fitted", "optimal")
        )
        behind.append(best - fitted)
    header = ("misalignment", *misalignment.STYLES, "marginalised S/N", "its contrast / true")
    return [
        "PSNR in dB over 11 x 11 pixels about the planet. A stop that is not where it should be "
        "lets more of the star past, and that the true star does not undo; with the alignment "
        f"fitted the median PSNR is at most {max(*behind, 0):.1f} dB below that of the true star "
        f"(and up to {-min(*behind, 0):.1f} dB above it: the fit follows some of the noise).",
        "",
        *markdown(header, rows),
    ]


def about_drift(table: Table) -> Lines:
    """SNR, and S/N of the marginalised estimate."""
    lines = grid(table, ("contrast", "hours"), {"annulus_snr": "Annulus SNR"}, ".1f")
    rows_of_fit = select(table, method="Gauss-Newton")
    rows = []
    for contrast in np.unique(rows_of_fit["contrast"]):
        for hours in np.unique(rows_of_fit["hours"]):
            part = select(rows_of_fit, contrast=contrast, hours=hours)
            values = (
                median_and_spread(part["marginalised_snr"]),
                median_and_spread(part["marginalised_throughput"], ".2f"),
            )
            rows.append([f"{contrast:g}", f"{hours:g}", *values])
    header = ("contrast", "drift, h", "marginalised S/N", "contrast / true")
    return [*lines, *markdown(header, rows)]


def about_location(table: Table) -> Lines:
    """Positions."""
    rows = []
    for separation in np.unique(table["separation"]):
        part = select(table, separation=separation)
        detected = part[part["found"]]
        rows.append(
            [
                f"{separation:g}",
                f"{len(detected)} of {len(part)}",
                str(int(part["false_candidates"].sum())),
                median_and_spread(location.distance(detected), ".2f"),
                median_and_spread(1e3 * np.hypot(detected["x_error"], detected["y_error"]), ".2f"),
                median_and_spread(detected["flux_ratio"], ".3f"),
                median_and_spread(detected["snr"]),
                median_and_spread(part["photon_snr"]),
                *(median_and_spread(part[f"snr_{name}"]) for name in location.SNRS),
            ]
        )
    header = (
        "arcsec", "found", "false", "off by, mas", "expected, mas", "contrast / true", "S/N",
        "photon limit", *(f"annulus SNR, {name}" for name in location.SNRS),
    )  # fmt: skip
    return markdown(header, rows)


def about_grid(table: Table) -> Lines:
    """SNR against three things."""
    keys = ("contrast", "hours", "separation")
    columns = {"annulus_snr": "Annulus SNR", "matched_snr": "Matched-filter S/N",
               "throughput": "Throughput of the planet"}  # fmt: skip
    return grid(table, keys, columns, ".2f")


def about_progress(table: Table) -> Lines:
    """Stages."""
    columns = {"star_error": ".2f", "annulus_snr": ".1f", "opd_left": ".2f", "seconds": ".1f"}
    rows = []
    for method in ("Adam", "Gauss-Newton"):
        for step in np.unique(select(table, method=method)["step"]):
            part = select(table, method=method, step=step)
            cells = (median_and_spread(part[column], form) for column, form in columns.items())
            rows.append([method, str(step), *cells])
    header = ("method", "steps", "star error, sigma", "annulus SNR", "change not found", "seconds")
    return markdown(header, rows)


def about_beyond(table: Table) -> Lines:
    """Case by case."""
    methods = [m for m in beyond.METHODS if m in set(table["method"]) and m != "optimal"]
    rows, behind = [], []
    for case in dict.fromkeys(table["case"]):
        part = select(table, case=case, method="Gauss-Newton")
        every = select(table, case=case)
        rows.append(
            [
                str(case),
                str(len(part)),
                ", ".join(sorted(set(part["status"]))),
                median_and_spread(part["marginalised_snr"]),
                median_and_spread(part["marginalised_snr"] / part["photon_snr"], ".2f"),
                median_and_spread(part["marginalised_throughput"], ".2f"),
                median_and_spread(part["null"], ".2f"),
                *(median_and_spread(select(every, method=m)["star_error"], ".2f") for m in methods),
            ]
        )
        errors = {m: spread(select(every, method=m)["star_error"])[0] for m in methods}
        ours = min(errors["Gauss-Newton"], errors["marginalised"])
        for method in ("KLIP", "Adam"):
            if errors.get(method, np.inf) < ours:
                behind.append(f"{case} ({method} {errors[method]:.1f} against {ours:.1f} sigma)")
    header = ("case", "frames", "status", "S/N", "/ photon limit", "contrast / true", "null",
              *(f"star error, {m}" for m in methods))  # fmt: skip
    return [
        *markdown(header, rows),
        "Another method leaves less of the star than this package in: "
        f"{'; '.join(behind) or 'none'}.",
        "No wavefront explains a ring, and none of one wavelength explains nine: the fit bends to "
        "them, and its status says that it does not explain the data. With the shape of the ring "
        "given, or with nine wavelengths, it does (the ring's shape is rendered with the bent "
        "wavefront: that is the larger null). KLIP has no model that could be wrong. Over "
        "nine wavelengths the price of the wavefront's freedom is higher, 1.4 to 1.5 times the "
        "photon limit in the one frame that was looked at (1.2 at one): probably because speckles "
        "of different wavelengths lie over each other, and tell less of the modes.",
        "",
    ]
