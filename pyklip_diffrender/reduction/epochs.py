"""Several epochs of a star on one page: which candidates move with it, and which do not."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from html import escape
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.reduction import html
from pyklip_diffrender.reduction.words import plus_minus, scientific

__all__ = ["EPOCHS", "compare_epochs", "write_epochs"]

EPOCHS = ("epochs.html", "epochs.json")
"""Files that `write_epochs` writes."""

_YEAR = 365.25

_AGREES = 11.8
"""Chi-squared of two coordinates that agree within three standard deviations (99.7 %)."""

_PREFERRED = 9.0
"""Difference of chi-squared by which one explanation is preferred to the other."""

_FLOOR = 0.003
"""Error of positions between epochs beyond that of the fit, arcsec: orientation, distortion, and
where the star is behind the mask."""


def compare_epochs(
    summaries: Sequence[Mapping[str, Any]], motion: tuple[float, float] | None
) -> list[dict[str, Any]]:
    """Compare the positions of candidates in pairs of epochs.

    A companion stays where it is beside the star, apart from its orbit. A source in the background
    stays on the sky, and moves opposite to the star's proper motion beside it; its parallax is
    neglected, as is the star's, which moves it by at most twice the parallax.

    Parameters
    ----------
    summaries : sequence of dict
        Summaries from `summarise`, in order of time.
    motion : tuple of float or None
        Proper motion of the star, mu_alpha cos(delta) and mu_delta, arcsec per year; None if it is
        not known, and then no source in the background is recognised.

    Returns
    -------
    list of dict
        For every pair of candidates that may be one source: the epochs (`dates`), the numbers of
        the candidates in their tables, counted from 1, how far the position changed (`moved_arcsec`
        to the east and north), chi-squared of both explanations (two degrees of freedom), and the
        `verdict`.
    """
    pairs = []
    for (i, first), (j, second) in combinations(enumerate(summaries), 2):
        if not (first["oriented"] and second["oriented"]):
            continue
        years = (second["epoch_mjd"] - first["epoch_mjd"]) / _YEAR
        sky = None if motion is None else -np.array(motion) * years
        for k, one in enumerate(first["candidates"], 1):
            for m, other in enumerate(second["candidates"], 1):
                moved = _offset(other) - _offset(one)
                inverse = np.linalg.inv(_covariance(one) + _covariance(other))
                star = float(moved @ inverse @ moved)
                away = None if sky is None else float((moved - sky) @ inverse @ (moved - sky))
                if min(star, np.inf if away is None else away) > _AGREES:
                    continue
                pairs.append(
                    {
                        "epochs": [i, j],
                        "dates": [first["first_date"][:10], second["first_date"][:10]],
                        "candidates": [k, m],
                        "moved_arcsec": [float(each) for each in moved],
                        "chi2_with_star": star,
                        "chi2_with_sky": away,
                        "verdict": _verdict(star, away),
                    }
                )
    return pairs


def _verdict(star: float, sky: float | None) -> str:
    if sky is None:
        return "beside the star at the same place; the star's proper motion is not known"
    if sky - star > _PREFERRED and star < _AGREES:
        return "moves with the star"
    if star - sky > _PREFERRED and sky < _AGREES:
        return "stays on the sky: a source in the background"
    return "either: the star has moved too little between the epochs"


def _offset(candidate: Mapping[str, Any]) -> NDArray[np.float64]:
    """Offset from the star to the east and north, arcsec."""
    angle = np.deg2rad(candidate["position_angle_deg"])
    separation = candidate["separation_arcsec"]
    return np.array([separation * np.sin(angle), separation * np.cos(angle)])


def _covariance(candidate: Mapping[str, Any]) -> NDArray[np.float64]:
    """Covariance of the offset, arcsec^2."""
    angle = np.deg2rad(candidate["position_angle_deg"])
    along = candidate["separation_error_arcsec"]
    across = candidate["separation_arcsec"] * np.deg2rad(candidate["position_angle_error_deg"])
    turn = np.array([[np.sin(angle), np.cos(angle)], [np.cos(angle), -np.sin(angle)]])
    scales = np.diag([along**2 + _FLOOR**2, across**2 + _FLOOR**2])
    return np.asarray(turn @ scales @ turn.T)


def write_epochs(
    folders: Mapping[str, Mapping[str, Any]],
    motion: tuple[float, float] | None,
    folder: str | os.PathLike[str],
) -> list[Path]:
    """Write ``epochs.html`` and ``epochs.json``, above the products of every epoch.

    Parameters
    ----------
    folders : mapping of str to dict
        Summaries by the name of their folder, in order of time.
    motion : tuple of float or None
        Proper motion of the star, see `compare_epochs`.
    folder : path
        That the folders are in.

    Returns
    -------
    list of Path
    """
    summaries = list(folders.values())
    pairs = compare_epochs(summaries, motion)
    content = {
        "target": summaries[0]["target"],
        "proper_motion_arcsec_per_year": None if motion is None else list(motion),
        "epochs": [
            {"folder": name, "date": each["first_date"], "sentence": each["sentence"],
             "candidates": each["candidates"]}
            for name, each in folders.items()
        ],
        "pairs": pairs,
    }  # fmt: skip
    page, data = (Path(folder) / name for name in EPOCHS)
    texts = {
        page: _page(folders, pairs, motion),
        data: json.dumps(content, indent=2, allow_nan=False) + "\n",
    }
    for path, text in texts.items():
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return list(texts)


def _page(
    folders: Mapping[str, Mapping[str, Any]],
    pairs: Sequence[Mapping[str, Any]],
    motion: tuple[float, float] | None,
) -> str:
    target = next(iter(folders.values()))["target"]
    epochs = [
        [html.link(f"{name}/report.html", str(each["first_date"])[:10]), each["sentence"]]
        for name, each in folders.items()
    ]
    positions = [
        [
            str(each["first_date"])[:10],
            str(each["filter"] or ""),
            str(k),
            plus_minus(row["separation_arcsec"], row["separation_error_arcsec"]),
            plus_minus(row["position_angle_deg"], row["position_angle_error_deg"]),
            f"{row['snr']:.1f}",
            scientific(row["contrast"], row["contrast_error"]),
            plus_minus(row["ab_mag"], row["ab_mag_error"]) if "ab_mag" in row else "not known",
        ]
        for each in folders.values()
        for k, row in enumerate(each["candidates"], 1)
    ]
    moves = [
        [
            " and ".join(f"{d} ({n})" for d, n in zip(p["dates"], p["candidates"], strict=True)),
            "{:+.3f}, {:+.3f}".format(*p["moved_arcsec"]),
            f"{p['chi2_with_star']:.1f}",
            "not known" if p["chi2_with_sky"] is None else f"{p['chi2_with_sky']:.1f}",
            p["verdict"],
        ]
        for p in pairs
    ]
    known = "not known" if motion is None else "{:+.3f}, {:+.3f} arcsec per year".format(*motion)
    sections = [
        html.section("Epochs", html.table(["Date", "Result"], epochs, wrap=1)),
        html.section(
            "Candidates",
            html.table(
                ["Date", "Filter", "", "Separation (arcsec)", "Position angle (deg)", "S/N",
                 "Contrast", "AB magnitude"],
                positions
            )
            if positions
            else html.note("No epoch has a candidate."),
        ),
        html.section(
            "Between epochs",
            html.table(
                ["Candidates", "Moved to east, north (arcsec)", "Chi-squared with the star",
                 "Chi-squared with the sky", "Verdict"],
                moves, wrap=4,
            )
            if moves
            else html.note("No candidate of one epoch has a counterpart in another."),
            html.note(
                "Every epoch was reduced alone, because its wavefront is another one. Chi-squared "
                "has two degrees of freedom. Orbits, the star's parallax and errors of the proper "
                f"motion are neglected. Proper motion of the star to east and north: {known}."
            ),
        ),
    ]  # fmt: skip
    header = f"<header><h1>{escape(str(target))}: {len(folders)} epochs</h1></header>\n"
    return html.document(f"{target}: epochs", header, sections)
