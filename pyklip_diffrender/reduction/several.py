"""Several epochs and filters of a star on one page: its candidates in all of them.

Between epochs a companion moves with the star, and a source in the background does not. In the
filters of one epoch a source is at one place, and has a colour.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.wcs import WCS
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import Combination, Detection, combine
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.reduction.pages import Picture, plus_minus, render, scientific
from pyklip_diffrender.scene.exposure import CatalogueStar, star_of

__all__ = [
    "COMPARISON",
    "SPECTRA",
    "by_star",
    "combined_rows",
    "compare_reductions",
    "in_words",
    "search_together",
    "sources_of",
    "write_comparison",
]

SPECTRA = ("blackbody", "flat", "free")
"""Spectra of planets in searches over filters, unless others are asked for."""

COMPARISON = ("comparison.html", "comparison.json")
"""Files that `write_comparison` writes."""

_EPOCH = 5.0
"""Days between reductions of one epoch."""

_YEAR = 365.25

_AGREES = 11.8
"""Chi-squared of two coordinates that agree within three standard deviations (99.7 %)."""

_PREFERRED = 9.0
"""Difference of chi-squared by which one explanation is preferred to the other."""

_MOST_TRACKS = 6
"""Candidates of which the way of a background source is drawn."""

_FLOOR = 0.003
"""Error of positions between reductions beyond that of the fit, arcsec: orientation, distortion,
and where the star is behind the mask."""


def compare_reductions(
    summaries: Sequence[Mapping[str, Any]], motion: tuple[float, float] | None
) -> list[dict[str, Any]]:
    """Compare the candidates of pairs of reductions, of several epochs or filters.

    `summaries` are those of `summarise` in order of time; `motion` is the proper motion of the
    star, mu_alpha cos(delta) and mu_delta, arcsec per year: without it no source in the background
    is recognised. Returns a dict for every pair of candidates that may be one source.
    """
    pairs = []
    for (i, first), (j, second) in combinations(enumerate(summaries), 2):
        if not (first["oriented"] and second["oriented"]):
            continue
        years = (second["epoch_mjd"] - first["epoch_mjd"]) / _YEAR
        # Hypotheses about d, by which the place beside the star has changed, with covariance C: a
        # companion stays, apart from its orbit (chi-squared d C^-1 d), and a source in the
        # background moves opposite to the star, d = -mu t. Parallaxes are neglected: the star's
        # moves such a source by at most twice the parallax.
        sky = None if motion is None else -np.array(motion) * years
        for k, one in enumerate(first["candidates"], 1):
            for m, other in enumerate(second["candidates"], 1):
                moved = _offset(other) - _offset(one)
                inverse = np.linalg.inv(_covariance(one) + _covariance(other))
                star = float(moved @ inverse @ moved)
                away = None if sky is None else float((moved - sky) @ inverse @ (moved - sky))
                if min(star, np.inf if away is None else away) > _AGREES:
                    continue
                colour, error = _colour(first, one, second, other)
                pairs.append(
                    {
                        "reductions": [i, j],  # from 0
                        "dates": [str(each["first_date"])[:10] for each in (first, second)],
                        "filters": [first["filter"], second["filter"]],
                        "candidates": [k, m],  # numbers in the tables, from 1
                        "moved_arcsec": [float(each) for each in moved],  # to the east and north
                        "chi2_with_star": star,  # of two degrees of freedom, as the next
                        "chi2_with_sky": away,
                        "colour_mag": colour,
                        "colour_error_mag": error,
                        "verdict": (
                            "at one place" if _together(first, second) else _verdict(star, away)
                        ),
                    }
                )
    return pairs


def _together(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two reductions are of one epoch."""
    return abs(first["epoch_mjd"] - second["epoch_mjd"]) <= _EPOCH


def _colour(
    first: Mapping[str, Any],
    one: Mapping[str, Any],
    second: Mapping[str, Any],
    other: Mapping[str, Any],
) -> tuple[float | None, float | None]:
    """Difference of the magnitudes in two filters, and its error."""
    if first["filter"] == second["filter"] or not ("ab_mag" in one and "ab_mag" in other):
        return None, None
    error = math.hypot(one["ab_mag_error"], other["ab_mag_error"])
    return one["ab_mag"] - other["ab_mag"], error


def sources_of(
    summaries: Sequence[Mapping[str, Any]], pairs: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Group the candidates that the filters of one epoch have at one place.

    `pairs` are what `compare_reductions` returned. There is a dict for every source of an epoch
    with several filters: its date, and what `_in_filter` says of each reduction of the epoch.
    """
    nodes = [(i, k) for i, each in enumerate(summaries) for k in range(len(each["candidates"]))]
    number = {node: n for n, node in enumerate(nodes)}
    links = [
        tuple(number[i, k - 1] for i, k in zip(pair["reductions"], pair["candidates"], strict=True))
        for pair in pairs
        if _together(*(summaries[i] for i in pair["reductions"]))
    ]
    if not nodes:
        return []
    first, second = np.array(links, dtype=int).reshape(-1, 2).T
    # A source makes several pairs in three filters: it is a connected part of the graph of pairs.
    graph = coo_array((np.ones(len(links)), (first, second)), shape=(len(nodes), len(nodes)))
    _, labels = connected_components(graph, directed=False)
    sources = []
    for label in dict.fromkeys(labels.tolist()):
        members = [node for node, own in zip(nodes, labels, strict=True) if own == label]
        start = summaries[members[0][0]]
        epoch = [i for i, each in enumerate(summaries) if _together(each, start)]
        if len({summaries[i]["filter"] for i in epoch}) < 2:
            continue
        separation = start["candidates"][members[0][1]]["separation_arcsec"]
        sources.append(
            {
                "date": str(start["first_date"])[:10],
                "filters": [
                    _in_filter(i, summaries[i], [k for j, k in members if j == i], separation)
                    for i in epoch
                ],
            }
        )
    return sources


def _in_filter(
    number: int, summary: Mapping[str, Any], candidates: Sequence[int], separation: float
) -> dict[str, Any]:
    curve = summary["contrast_curve"]
    # The contrast at that separation that would have been a candidate; None beyond the curve.
    limit = None
    if not candidates and len(curve["separation_arcsec"]):
        places = np.array(curve["separation_arcsec"], dtype=float)
        if places[0] <= separation <= places[-1]:
            contrasts = np.array(curve["contrast"], dtype=float)
            five = float(np.interp(separation, places, contrasts))
            value = five * summary["threshold_snr"] / curve["sigmas"]
            limit = value if math.isfinite(value) else None
    return {
        "reduction": number,
        "filter": summary["filter"],
        "candidates": [k + 1 for k in candidates],
        "limit": limit,
    }


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
    # C = T diag(s_along^2, s_across^2) T^T: the columns of T point away from the star, and across,
    # to the east and north.
    turn = np.array([[np.sin(angle), np.cos(angle)], [np.cos(angle), -np.sin(angle)]])
    scales = np.diag([along**2 + _FLOOR**2, across**2 + _FLOOR**2])
    return np.asarray(turn @ scales @ turn.T)


def write_comparison(
    folders: Mapping[str, Mapping[str, Any]],
    motion: tuple[float, float] | None,
    folder: str | os.PathLike[str],
    combination: Combination | str | None = None,
) -> list[Path]:
    """Write ``comparison.html`` and ``comparison.json``, above the products of every reduction.

    `folders` has the summaries by the name of their folder, in order of time, `motion` is as for
    `compare_reductions`, and `combination` the search of all reductions together, or why there is
    none.
    """
    summaries = list(folders.values())
    pairs = compare_reductions(summaries, motion)
    sources = sources_of(summaries, pairs)
    content = {
        "target": summaries[0]["target"],
        "proper_motion_arcsec_per_year": None if motion is None else list(motion),
        "reductions": [
            {"folder": name, "date": each["first_date"], "filter": each["filter"],
             "sentence": each["sentence"], "candidates": each["candidates"]}
            for name, each in folders.items()
        ],
        "pairs": pairs,
        "sources": sources,
        "combined": (
            combination.to_dict() if isinstance(combination, Combination)
            else None if combination is None else {"reason": combination}
        ),
    }  # fmt: skip
    page, data = (Path(folder) / name for name in COMPARISON)
    texts = {
        page: render(
            "comparison.html",
            target=summaries[0]["target"],
            folders=folders,
            pairs=pairs,
            thumbnails=_thumbnails(folders, Path(folder)),
            tracks=_tracks(summaries, motion),
            motion=motion,
            combined=content["combined"],
            combined_table=_combined_table(content["combined"]),
            filters=list(dict.fromkeys(str(e["filter"]) for s in sources for e in s["filters"])),
            sources=[
                {
                    "date": source["date"],
                    "by_filter": {
                        str(each["filter"]): _brightness(summaries[each["reduction"]], each)
                        for each in source["filters"]
                    },
                }
                for source in sources
            ],
        ),
        data: json.dumps(content, indent=2, allow_nan=False) + "\n",
    }
    for path, text in texts.items():
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return list(texts)


def _name(summary: Mapping[str, Any]) -> str:
    """Date and filter of a reduction."""
    return f"{str(summary['first_date'])[:10]} {summary['filter'] or ''}".rstrip()


def _thumbnails(folders: Mapping[str, Mapping[str, Any]], above: Path) -> list[Picture]:
    """S/N maps with north up, for the folders that have products."""
    pictures = []
    for name, summary in folders.items():
        path = above / name / "images.fits"
        if not path.exists():
            continue
        with fits.open(path) as hdus:
            snr, header = np.array(hdus["SNR"].data, dtype=float), hdus["SNR"].header
        scale = WCS(header).proj_plane_pixel_scales()[0].to_value(u.arcsec)
        y, x = np.indices(snr.shape) + 1.0
        grid = scale * np.stack([x - header["CRPIX1"], y - header["CRPIX2"]], axis=-1)
        # East is to the left.
        places = np.array([_offset(each) for each in summary["candidates"]]).reshape(-1, 2)
        figure, ax = drawing.panel()
        drawing.snr_map(
            ax, snr, grid, places * (-1, 1), 0.0 if summary["oriented"] else None,
            title=_name(summary), labels=[str(k + 1) for k in range(len(places))],
        )  # fmt: skip
        count = len(places)
        some = f"{count or 'no'} candidate{'' if count == 1 else 's'}"
        pictures.append(
            Picture(
                name,
                figure,
                f"Map of the signal-to-noise ratio of a point source, {_name(summary)}, {some}.",
                f"{_name(summary)}: S/N of a point source, {some}, numbered as in the table.",
            )
        )
    return pictures


def _tracks(
    summaries: Sequence[Mapping[str, Any]], motion: tuple[float, float] | None
) -> list[Picture]:
    """Where the candidates of the first epoch would be later as sources in the background."""
    oriented = [each for each in summaries if each["oriented"]]
    start = next((each for each in oriented if each["candidates"]), None)
    if motion is None or start is None:
        return []
    dated = [each for each in oriented if each["epoch_mjd"] >= start["epoch_mjd"]]
    if all(_together(start, each) for each in dated):
        return []
    pictures = []
    for k, candidate in enumerate(start["candidates"][:_MOST_TRACKS], 1):
        place, epochs = _offset(candidate), []
        for each in dated:
            offsets = [_offset(row) for row in each["candidates"]]
            errors = [np.sqrt(np.diagonal(_covariance(row))) for row in each["candidates"]]
            years = (each["epoch_mjd"] - start["epoch_mjd"]) / _YEAR
            epochs.append(
                drawing.Epoch(
                    _name(each),
                    np.array(offsets).reshape(-1, 2),
                    np.array(errors).reshape(-1, 2),
                    # A source in the background moves opposite to the star's proper motion beside
                    # it.
                    None if _together(start, each) else place - np.array(motion) * years,
                )
            )
        figure, ax = drawing.panel()
        drawing.sky_track(ax, epochs, place, f"Candidate {k} of {_name(start)}")
        pictures.append(
            Picture(
                f"track_{k}",
                figure,
                f"Offsets of candidate {k} of {_name(start)} and of later candidates from the "
                "star, and the way of a source in the background.",
                f"Candidates near candidate {k} of {_name(start)}, filled, and where a source in "
                "the background would be at every later date, open and connected by the dashed "
                "line: it moves opposite to the star's proper motion. A companion stays, apart "
                "from its orbit.",
            )
        )
    return pictures


def by_star(detections: Mapping[str, Detection]) -> dict[str, dict[str, Detection]]:
    """Group searches by their star.

    Parameters
    ----------
    detections : mapping of str to Detection
        By any name.

    Returns
    -------
    dict of str to dict
        The searches of each star, in the order and with the names of `detections`. Where two stars
        have one name, it is numbered. Searches whose headers name no star are alone.
    """
    groups: list[dict[str, Detection]] = []
    stars: list[CatalogueStar] = []
    for name, each in detections.items():
        star = star_of(each.observation.header, each.observation.name)
        place = next((k for k, other in enumerate(stars) if star.is_same(other)), None)
        if place is None:
            stars.append(star)
            groups.append({})
        groups[-1 if place is None else place][name] = each
    named: dict[str, dict[str, Detection]] = {}
    for group in groups:
        target = next(iter(group.values())).observation.target
        name, number = target, 1
        while name in named:
            number += 1
            name = f"{target} ({number})"
        named[name] = group
    return named


def search_together(
    reductions: Sequence[Any],
    *,
    spectra: Sequence[str] = SPECTRA,
    star: str | None = None,
    motion: tuple[float, float] | None = None,
    parallax: float | None = None,
) -> Combination | str:
    """Search finished reductions of a star together, or say why that is not possible.

    The reductions are worth more than a search that cannot be made of them, so that what is wrong
    with it is no error here.

    Parameters
    ----------
    reductions : sequence of Reduction, Detection or path
        As for `combine`, as the other arguments are.
    spectra : sequence of str
    star : str, optional
    motion : (2,), optional
    parallax : float, optional

    Returns
    -------
    Combination or str
        The message of the error, if there was one.
    """
    try:
        return combine(
            reductions, spectra=spectra, star=star, proper_motion=motion, parallax=parallax
        )
    except (CorruptFileError, IncompatibleSetupError) as error:
        return str(error)


def combined_rows(combined: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Title and rows of cells of a table with the candidates of a search over filters and epochs.

    `combined` is what `Combination.to_dict` returned, also after it was read from
    ``comparison.json``.
    """
    candidates = combined["candidates"]
    dated = any("verdict" in each for each in candidates)
    title = ["", "Separation (arcsec)", "Position angle (deg)", "S/N", "Spectrum", "False alarm"]
    title += [f"Contrast in {name}" for name in combined["filters"]]
    title += ["Bound / background / neither (%)", "Verdict"] if dated else []
    rows = []
    for k, row in enumerate(candidates, 1):
        cells = [
            str(k),
            plus_minus(row["separation_arcsec"], row["separation_error_arcsec"]),
            plus_minus(row["position_angle_deg"], row["position_angle_error_deg"]),
            f"{row['snr']:.1f}",
            row["spectrum"],
            scientific(row["false_alarm_probability"]),
        ]
        for name in combined["filters"]:
            value, error = row[f"contrast_{name}"], row[f"contrast_error_{name}"]
            snr = row[f"snr_{name}"]
            known = None not in (value, error, snr)
            cells.append(f"{scientific(value, error)}, S/N {snr:.1f}" if known else "not observed")
        if dated:
            names = ("bound", "background", "neither")
            shares = (f"{100 * row[f'probability_{name}']:.0f}" for name in names)
            cells += [" / ".join(shares), row["verdict"]]
        rows.append(cells)
    return title, rows


def in_words(combination: Combination | str) -> str:
    """The result of a search over filters and epochs, or why there is none, in a few lines."""
    if isinstance(combination, str):
        return f"no combined search: {combination}"
    count = len(combination.candidates)
    lines = [
        f"combined search of {len(combination.maps)} reductions: {count} "
        f"candidate{'' if count == 1 else 's'}"
    ]
    for row in combination.candidates:
        verdict = f", {row['verdict']}" if "verdict" in combination.candidates.colnames else ""
        lines.append(
            f"  {row['separation'].value:.3f} arcsec at {row['position_angle'].value:.1f} deg, "
            f"S/N {row['snr']:.1f} ({row['spectrum']}), false-alarm probability "
            f"{row['false_alarm_probability']:.1e}{verdict}"
        )
    lines += [f"  left out: {name}: {reason}" for name, reason in combination.left_out]
    return "\n".join([*lines, *(f"  {each}" for each in combination.remarks)])


def _combined_table(
    combined: Mapping[str, Any] | None,
) -> tuple[list[str], list[list[str]]] | None:
    """`combined_rows`, where there is a combined search."""
    return None if combined is None or "reason" in combined else combined_rows(combined)


def _brightness(summary: Mapping[str, Any], in_filter: Mapping[str, Any]) -> str:
    if not in_filter["candidates"]:
        limit = in_filter["limit"]
        return "not searched" if limit is None else f"< {scientific(limit)}"
    texts = []
    for k in in_filter["candidates"]:
        row = summary["candidates"][k - 1]
        value = (
            plus_minus(row["ab_mag"], row["ab_mag_error"])
            if "ab_mag" in row
            else scientific(row["contrast"], row["contrast_error"])
        )
        texts.append(f"({k}) {value}, S/N {row['snr']:.1f}")
    return "; ".join(texts)
