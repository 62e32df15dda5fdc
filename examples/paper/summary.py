"""Write reports/inference.md and its figure from the tables of the studies.

    python examples/paper/summary.py

Run it from the root of the project after the studies have written their tables to docs/results.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import calibration
import fluxes
import snapshots
from calibration import rms
from inference_figure import draw
from pages import KINDS, markdown, origin, tables

from pyklip_diffrender.drawing import save
from pyklip_diffrender.io.files import replacing


def about_calibration() -> list[str]:
    """S/N at planet-free positions, and the contrast limit."""
    by_kind = tables("calibration")
    if not by_kind:
        return []
    rows = []
    for kind, table in by_kind.items():
        for hours in sorted(set(table["hours"])):
            part = table[table["hours"] == hours]
            rings, star_known = (
                [rms(part[f"{name}_{r:.1f}"]) for r in calibration.RINGS[:-1]]
                for name in ("null", "known_star")
            )
            beyond = part["beyond_4"]
            expected = [
                part["positions"].sum() * math.erfc(4 / width / math.sqrt(2))
                for width in (1.0, rms(part["null"]))
            ]
            rows.append(
                (
                    KINDS[kind],
                    f"{hours:g}",
                    str(len(part)),
                    f"{rms(part['null']):.3f}",
                    f"{min(rings):.2f} to {max(rings):.2f}",
                    f"{rms(part['known_star_null']):.3f} "
                    f"({min(star_known):.2f} to {max(star_known):.2f})",
                    f"{beyond.sum()} ± {math.sqrt(len(part)) * np.std(beyond, ddof=1):.0f} "
                    f"({expected[0]:.1f}; {expected[1]:.1f})",
                    f"{part['highest'].max():.1f}",
                    f"{part['limit_mean'].mean():.3f}",
                    f"{max(part[f'limit_{r:.1f}'].mean() for r in calibration.RINGS[:-1]):.3f}",
                    f"{part['star_error'].mean():.2f}",
                    f"{part['chi2'].mean():.3f}",
                    ", ".join(sorted(set(part["status"]))),
                )
            )
    header = (
        "wavefronts", "drift, h", "frames", "S/N deviation", "in rings of 0.2 arcsec",
        "the same, star known (in rings)", "positions beyond 4 (Gaussian; as wide)", "highest",
        "limit / photon limit, mean", "worst ring", "star error, sigma", "chi2 / pixel", "status",
    )  # fmt: skip
    return [
        "## Is S/N calibrated?",
        "",
        "Frames without a planet. The standard deviation from 0 of S/N over all positions from 0.3 "
        "to 2.3 arcsec must be 1. About a hundred positions of a frame are independent, a dozen in "
        "the innermost ring, so that twenty frames know it to 2 and 6 %; the matched filter that "
        "knows the star shows what the noise itself did in those frames. The limit is the "
        "closed-form 5-sigma contrast, the median over a ring, relative to that of the matched "
        "filter that knows the star. Positions beyond 4 come in clumps of a few pixels: their "
        "error is that of the sum over frames. Beside them stands how many Gaussian noise has, of "
        "deviation 1 and of the deviation measured.",
        "",
        *markdown(header, rows),
        *origin(by_kind),
    ]


def about_fluxes() -> list[str]:
    """Bias and coverage."""
    by_kind = tables("fluxes")
    if not by_kind:
        return []
    rows = []
    for kind, table in by_kind.items():
        for row in fluxes.summary(table):
            rows.append(
                (
                    KINDS[kind],
                    str(row["contrast"]),
                    str(row["frames"]),
                    f"{row['flux_ratio']:.4f} ± {row['flux_ratio_error']:.4f}",
                    f"{row['mean_pull']:+.2f} ± {row['frames'] ** -0.5:.2f}",
                    f"{row['pull_deviation']:.2f}",
                    f"{100 * row['coverage']:.0f} %",
                    f"{row['mean_snr']:.2f}",
                    f"{row['kept_by_subtraction']:.2f}",
                )
            )
    header = (
        "wavefronts", "contrast", "frames", "flux / true", "mean pull", "deviation of pulls",
        "within 1 sigma", "mean S/N", "kept by mere subtraction",
    )  # fmt: skip
    return [
        "## Are fluxes unbiased and their errors right?",
        "",
        "One planet a frame, at a known place from 0.3 to 2.3 arcsec, the OPD map 40 h old. "
        "A pull is (measured - true) / error. Planets at the closed-form 5-sigma limit of their "
        "place must come out at S/N 5 on average: injection and recovery against the closed form. "
        "The last column is the share of the planet's light that the subtracted frame still has.",
        "",
        *markdown(header, rows),
        *origin(by_kind),
    ]


def about_mismatch() -> list[str]:
    """The instrument found from the frame."""
    by_kind = tables("mismatch")
    if not by_kind:
        return []
    names = {
        "offset_error_mas": "star position, mas",
        "lyot_error_percent": "Lyot stop's shift, % of the pupil",
        "rotation_error_deg": "Lyot stop's rotation, deg",
        "flux_error_percent": "star's flux, %",
        "snr": "planet's S/N",
        "snr_matched": "planet's S/N, alignment given",
        "information_kept": "planet's error, alignment given / found",
        "contrast": "planet's contrast (true 1e-6)",
        "null": "deviation of S/N where there is nothing",
        "iterations": "iterations",
    }
    rows = []
    for name, label in names.items():
        cells = [label]
        for table in by_kind.values():
            values = np.asarray(table[name], dtype=float)
            cells.append(f"{np.median(values):.4g} ({values.min():.4g} to {values.max():.4g})")
        rows.append(cells)
    frames = ", ".join(f"{len(table)} frames ({KINDS[kind]})" for kind, table in by_kind.items())
    return [
        "## Nothing known about the instrument",
        "",
        "The star 50 mas off, the Lyot stop shifted by 2 % of the pupil and turned by 2 degrees, "
        "flux 20 % higher, an unknown background; a planet of 1e-6 at 0.6 arcsec. Errors of what "
        f"the fit found from the frame alone: median, smallest and largest of {frames}.",
        "",
        *markdown(("", *(KINDS[kind] for kind in by_kind)), rows),
        *origin(by_kind),
    ]


def about_companions() -> list[str]:
    """Several planets, and a bright one."""
    by_kind = tables("companions")
    if not by_kind:
        return []
    rows = []
    for kind, table in by_kind.items():
        for scene, contrast in dict.fromkeys(zip(table["scene"], table["contrast"], strict=True)):
            part = table[(table["scene"] == scene) & (table["contrast"] == contrast)]
            detected = part[part["found"]]
            ratio = np.asarray(detected["measured"] / detected["contrast"])
            pull = np.asarray((detected["measured"] - detected["contrast"]) / detected["error"])
            rows.append(
                (
                    KINDS[kind],
                    scene,
                    f"{contrast:g}",
                    f"{len(detected)} of {len(part)}",
                    str(int(part["false_candidates"].max())),
                    f"{np.mean(ratio):.3f} ({ratio.min():.3f} to {ratio.max():.3f})",
                    f"{np.mean(pull):+.2f} ± {len(pull) ** -0.5:.2f}",
                    f"{np.std(pull):.2f}",
                    f"{np.mean(np.abs(pull) < 1):.0%}",
                )
            )
    header = (
        "wavefronts", "scene", "contrast", "found", "false", "flux / true", "mean pull",
        "deviation of pulls", "within 1 sigma",
    )  # fmt: skip
    return [
        "## Several planets, and a bright one",
        "",
        "Two, three and four planets of 5e-7 to 2e-6; one of 1e-3 beside one of 1e-6. The fit is "
        "told nothing about how many there are.",
        "",
        *markdown(header, rows),
        *origin(by_kind),
    ]


def about_ring() -> list[str]:
    """A ring of known shape."""
    by_kind = tables("ring")
    if not by_kind:
        return []
    rows = []
    for kind, table in by_kind.items():
        ratio = np.asarray(table["measured"] / table["light"])
        pull = np.asarray((table["measured"] - table["light"]) / table["error"])
        throughput_of = np.asarray(table["kept_by_subtraction"], dtype=float)
        rows.append(
            (
                KINDS[kind],
                str(len(table)),
                f"{np.mean(ratio):.3f} ({ratio.min():.3f} to {ratio.max():.3f})",
                f"{np.mean(table['error'] / table['light']):.4f}",
                f"{np.mean(pull):+.2f} ± {len(pull) ** -0.5:.2f}",
                f"{np.std(pull):.2f}",
                f"{np.mean(throughput_of):.2f}",
            )
        )
    header = (
        "wavefronts", "frames", "light / true", "its error", "mean pull", "deviation of pulls",
        "kept by mere subtraction",
    )  # fmt: skip
    return [
        "## A ring",
        "",
        "From 0.9 to 1.2 arcsec, with 3e-5 of the star's light. The first fit bends to it and says "
        "MODEL_MISMATCH; `Detection.measure_shape`, given the shape (rendered with that first "
        "fit's wavefront), refines the star anew without the ring.",
        "",
        *markdown(header, rows),
        *origin(by_kind),
    ]


def about_snapshots() -> list[str]:
    """Several frames."""
    by_kind = tables("snapshots")
    if not by_kind:
        return []
    rows = []
    for kind, table in by_kind.items():
        for count in sorted(set(table["snapshots"])):
            part = table[table["snapshots"] == count]
            gain, linked = (snapshots.gain(table, count, n) for n in ("error", "linked_error"))
            pull = (part["measured"] - snapshots.PLANET.contrast) / part["error"]
            rows.append(
                (
                    KINDS[kind],
                    str(count),
                    f"{(snapshots.PLANET.contrast / part['error']).mean():.1f}",
                    f"{gain:.3f}",
                    "" if math.isnan(linked) else f"{linked:.3f}",
                    f"{pull.mean():+.2f} ± {len(part) ** -0.5:.2f}",
                )
            )
    header = (
        "wavefronts", "snapshots N", "expected S/N", "gain / sqrt(N)",
        "the same, fitted together", "mean pull",
    )  # fmt: skip
    return [
        "## Several frames",
        "",
        "Snapshots three hours apart, the wavefront drifting on, a planet of 5e-7 at 0.6 arcsec. "
        "Fitted one by one, their information adds; fitted together, wavefronts may differ by "
        "what the prior allows.",
        "",
        *markdown(header, rows),
        *origin(by_kind),
    ]


def about_failures() -> list[str]:
    """Cases in which calibration breaks, and the status of their fits."""
    by_kind = tables("failures")
    if not by_kind:
        return []
    rows = []
    for kind, table in by_kind.items():
        for case in dict.fromkeys(table["case"]):
            part = table[table["case"] == case]
            rows.append(
                (
                    KINDS[kind],
                    str(case),
                    ", ".join(sorted(set(part["status"]))),
                    f"{np.mean(part['chi2'] / part['expected_chi2']):.3g}",
                    f"{np.mean(part['null'] * part['scatter']):.2f}",
                    f"{np.mean(part['scatter']):.2f}",
                    f"{np.mean(part['null']):.2f}",
                    f"{np.mean(part['limit']):.2f}",
                )
            )
    header = (
        "wavefronts", "what is wrong", "status", "chi2 / expected", "S/N deviation, unscaled",
        "errors scaled by", "S/N deviation", "limit / photon limit",
    )  # fmt: skip
    return [
        "## Where it breaks, and whether it says so",
        "",
        "Frames without a planet, one thing wrong in each that the fit does not know of. "
        "Calibrated is what ends with a deviation near 1; honest is what has a status other than "
        "CONVERGED where the unscaled deviation is not.",
        "",
        *markdown(header, rows),
        *origin(by_kind),
    ]


def about_speed() -> list[str]:
    """Times, compared with the paper's recipe."""
    by_kind = tables("speed")
    if not by_kind:
        return []
    rows = [
        (
            str(row["model"]),
            str(row["run"]),
            *("" if math.isnan(row[name]) else f"{row[name]:.1f}" for name in ("refine", "all")),
            "" if math.isnan(row["star_error"]) else f"{row['star_error']:.2f}",
        )
        for table in by_kind.values()
        for row in table
    ]
    header = (
        "80 x 80 pixels", "run", "refinement, s", "and search, s", "star error, sigma",
    )  # fmt: skip
    return [
        "## How long it takes",
        "",
        "On all cores with nothing else running. The first run in a process loads libraries and "
        "builds constants.",
        "",
        *markdown(header, rows),
        *origin(by_kind),
    ]


def main() -> None:
    """Write page and figure."""
    lines = [
        "# Calibration of fluxes, S/N and contrast",
        "",
        "Written by `python examples/paper/summary.py` from the tables in `docs/results`. The "
        "scene is the paper's (beta Pictoris, 2 h, 4.5 um, 80 x 80 pixels); *measured maps* are "
        "two in-flight OPD maps 86 h apart, *embedded generator* is `random_opd` and "
        "`random_drift`.",
        "",
        "![S/N without a planet, contrast limit, fluxes](images/inference.png)",
        "",
        *about_calibration(),
        *about_fluxes(),
        *about_mismatch(),
        *about_companions(),
        *about_ring(),
        *about_snapshots(),
        *about_failures(),
        *about_speed(),
    ]
    page = Path("reports/inference.md")
    with replacing(page) as temporary:
        temporary.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
    save(draw(), Path("reports/images/inference.png"), dpi=110)
    print(f"wrote {page}")


if __name__ == "__main__":
    main()
