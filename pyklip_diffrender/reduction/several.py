"""Several epochs and filters of a star on one page: candidates of each, and of all together."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from astropy.wcs import WCS
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import Combination, Detection, combine
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.files import write_page
from pyklip_diffrender.io.progress import counted
from pyklip_diffrender.options import SPECTRA
from pyklip_diffrender.reduction.pages import (
    Picture,
    curve_arrays,
    plus_minus,
    probability,
    render,
    scientific,
    some_candidates,
)
from pyklip_diffrender.scene.exposure import CatalogueStar, star_of

COMPARISON = ("comparison.html", "comparison.json")
"""Files that `write_comparison` writes."""

_MOST_DRAWN_TRACKS = 6
"""Largest number of candidates for which the track of a background source is drawn."""


def write_comparison(
    folders: Mapping[str, Mapping[str, Any]],
    folder: str | os.PathLike[str],
    combination: Combination | str,
) -> list[Path]:
    """Write ``comparison.html`` and ``comparison.json``, above the products of every reduction.

    `folders` has the summaries by the name of their folder, in order of time, and `combination` is
    the search of all reductions together, or why there is none.
    """
    target = next(iter(folders.values()))["target"]
    combined = {"reason": combination} if isinstance(combination, str) else combination.to_dict()
    content = {
        "target": target,
        "reductions": [
            {"folder": name, "date": each["first_date"], "filter": each["filter"],
             "sentence": each["sentence"], "candidates": each["candidates"]}
            for name, each in folders.items()
        ],
        "combined": combined,
    }  # fmt: skip
    page, data = (Path(folder) / name for name in COMPARISON)
    text = render(
        "comparison.html",
        target=target,
        folders=folders,
        shown=[
            *_thumbnails(folders, Path(folder)),
            *([] if isinstance(combination, str) else [_combined_map(combination)]),
            *_limits(folders, combination),
        ],
        tracks=[] if isinstance(combination, str) else _tracks(combination),
        combined=combined,
        combined_table=None if "reason" in combined else combined_rows(combined),
    )
    write_page(page, text, data, content)
    return [page, data]


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
        ax = drawing.panel()
        drawing.snr_map(
            ax, snr, grid, places * (-1, 1), 0.0 if summary["oriented"] else None,
            title=_name(summary), labels=[str(k + 1) for k in range(len(places))],
        )  # fmt: skip
        caption = (
            f"{_name(summary)}: S/N of a point source, {some_candidates(len(places))}, numbered as "
            "in the table."
        )
        pictures.append(Picture(ax.figure, caption))
    return pictures


def _combined_map(combination: Combination) -> Picture:
    """S/N of all reductions together, with one spectrum."""
    table, spectrum = combination.candidates, _shown_spectrum(combination)
    image = combination.snr[combination.spectra.names.index(spectrum)]
    ax = drawing.panel()
    # East is to the left.
    drawing.snr_map(
        ax, image, combination.grid * (-1, 1),
        _columns(table, "delta_ra", "delta_dec") * (-1, 1), 0.0, title="All together",
        labels=[str(k + 1) for k in range(len(table))],
    )  # fmt: skip
    return Picture(
        ax.figure,
        f"All reductions together: S/N of a point source that does not move, with the spectrum "
        f"{spectrum}, numbered as in the table of the combined search.",
    )


def _shown_spectrum(combination: Combination) -> str:
    """Spectrum of the most significant candidate, if it is a listed one, else the last listed."""
    names = combination.spectra.names
    best = "".join(map(str, combination.candidates["spectrum"][:1]))
    return best if best in names else names[-1]


def _limits(
    folders: Mapping[str, Mapping[str, Any]], combination: Combination | str
) -> list[Picture]:
    """Contrast curves of the reductions, and the limits of all together; none without any."""
    curves = [
        (_name(each), *curve_arrays(each["contrast_curve"]))
        for each in folders.values()
        if each["contrast_curve"]["contrast"]
    ]
    if not curves:
        return []
    sigmas = next(iter(folders.values()))["contrast_curve"]["sigmas"]
    about = (
        f"Contrast, relative to the star without coronagraph, that gives S/N {sigmas:g}, against "
        "separation: the median of all position angles."
    )
    if not isinstance(combination, str):
        name = _shown_spectrum(combination)
        table = combination.limits[combination.limits["spectrum"] == name]
        if len(table):
            contrast = np.asarray(table["contrast"]) * sigmas / table.meta["sigmas"]
            label = f"all together, in {table['filter'][0]}"
            curves.append((label, table["separation"].value, contrast))
            about = f"{about} All together: of a planet with the spectrum {name}."
    ax = drawing.panel()
    drawing.survey_limits(ax, curves, [], sigmas)
    return [Picture(ax.figure, about)]


def _offset(candidate: Mapping[str, Any]) -> NDArray[np.float64]:
    """Offset from the star to the east and north, arcsec."""
    angle = np.deg2rad(candidate["position_angle_deg"])
    separation = candidate["separation_arcsec"]
    return np.array([separation * np.sin(angle), separation * np.cos(angle)])


def _tracks(combination: Combination) -> list[Picture]:
    """Where candidates were seen, and where a source in the background would have been."""
    motion = combination.motion
    if motion is None:
        return []
    pictures = []
    for number in range(1, min(len(combination.candidates), _MOST_DRAWN_TRACKS) + 1):
        seen = combination.sightings[combination.sightings["candidate"] == number]
        start, first = _columns(seen, "delta_ra", "delta_dec")[0], float(seen["epoch_mjd"][0])
        drawn = []
        for date in combination.dates:
            there = seen[np.abs(seen["epoch_mjd"] - date) < 1]
            drawn.append(
                drawing.Epoch(
                    Time(date, format="mjd").isot[:10],
                    _columns(there, "delta_ra", "delta_dec"),
                    np.column_stack(
                        [there["delta_ra_error"].value, there["delta_dec_error"].value]
                    ),
                    None if date == first else start + motion.background(first, date),
                )
            )
        ax = drawing.panel()
        drawing.sky_track(ax, drawn, start, f"Candidate {number}")
        caption = (
            f"Candidate {number} of the combined search, filled, and where a source in the "
            "background would be at the other dates, open and connected by the dashed line. A "
            "companion stays, apart from its orbit."
        )
        pictures.append(Picture(ax.figure, caption))
    return pictures


def _columns(table: QTable, *names: str) -> NDArray[np.float64]:
    """Columns of a table side by side, without their units."""
    return np.column_stack([table[name].value for name in names])


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
    motion: Any = None,
    parallax: Any = None,
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
    motion : optional
    parallax : optional

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
    title = ["", "Separation (arcsec)", "Position angle (deg)", "S/N"]
    title += ["Verdict", "Bound / background / neither (%)"] if dated else []
    title += [*(f"Contrast in {name}" for name in combined["filters"]), "Spectrum", "False alarm"]
    rows = []
    for k, row in enumerate(candidates, 1):
        cells = [
            str(k),
            plus_minus(row["separation_arcsec"], row["separation_error_arcsec"]),
            plus_minus(row["position_angle_deg"], row["position_angle_error_deg"]),
            f"{row['snr']:.1f}",
        ]
        if dated:
            names = ("bound", "background", "neither")
            shares = (f"{100 * row[f'probability_{name}']:.0f}" for name in names)
            cells += [row["verdict"], " / ".join(shares)]
        for name in combined["filters"]:
            value, error = row[f"contrast_{name}"], row[f"contrast_error_{name}"]
            snr = row[f"snr_{name}"]
            known = None not in (value, error, snr)
            cells.append(f"{scientific(value, error)}, S/N {snr:.1f}" if known else "not observed")
        rows.append([*cells, row["spectrum"], probability(row["false_alarm_probability"])])
    return title, rows


def in_words(combination: Combination | str) -> str:
    """The result of a search over filters and epochs, or why there is none, in a few lines."""
    if isinstance(combination, str):
        return f"no combined search: {combination}"
    count = counted(len(combination.candidates), "candidate")
    lines = [f"combined search of {len(combination.maps)} reductions: {count}"]
    for row in combination.candidates:
        verdict = f", {row['verdict']}" if "verdict" in combination.candidates.colnames else ""
        lines.append(
            f"  {row['separation'].value:.3f} arcsec at {row['position_angle'].value:.1f} deg, "
            f"S/N {row['snr']:.1f} ({row['spectrum']}), false-alarm probability "
            f"{probability(row['false_alarm_probability'])}{verdict}"
        )
    lines += [f"  left out: {name}: {reason}" for name, reason in combination.left_out]
    return "\n".join([*lines, *(f"  {each}" for each in combination.remarks)])
