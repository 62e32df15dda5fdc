"""The files that a reduction writes."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from pyklip_diffrender import drawing
from pyklip_diffrender.io.files import replacing, write_table
from pyklip_diffrender.reduction.overview import Klip, Overview
from pyklip_diffrender.reduction.page import page
from pyklip_diffrender.reduction.pictures import (
    MOST_FRAMES,
    curve_pictures,
    disk_pictures,
    overview_pictures,
    star_pictures,
    wavefront_pictures,
    wide_pictures,
)
from pyklip_diffrender.reduction.recovery_sections import completeness_section, injections_section
from pyklip_diffrender.reduction.reduction_result import Reduction
from pyklip_diffrender.reduction.sky_images import SkyImages
from pyklip_diffrender.reduction.summary import summarise

__all__ = ["PRODUCTS", "existing_products", "write_products", "write_report"]

PRODUCTS = {
    "report.html": "this page",
    "summary.json": "the content of this page, for programs",
    "detection.png": "the sky without the star, the S/N map and the contrast curve",
    "detection.fits": "maps, star-subtracted frames and candidates, for Detection.read",
    "images.fits": "the sky without the star, its contrast and S/N, with north up",
    "candidates.ecsv": "the candidates with all columns",
    "contrast.ecsv": "the contrast curve",
    "astrometry.csv": "epoch and positions of the candidates, for orbitize!",
    "wide_field.fits": "maps of the whole frames",
    "wide_field_candidates.ecsv": "candidates in the whole frames",
    "wide_field_contrast.ecsv": "contrast curve to the edge of the frames",
    "disk.fits": "the extended light: frames without the star, and its sources",
    "injections.ecsv": "injected planets and their measurements",
    "completeness.ecsv": "fraction of planets that the search finds, by contrast and separation",
    "fit.fits": "the fit, for Refinement.read",
    "systematics.fits": "the flat-field pattern, for other reductions",
}
"""Every file that a reduction may write, with its content."""


def existing_products(folder: Path) -> list[Path]:
    """Files in a folder that are called like products of a reduction."""
    return [folder / name for name in PRODUCTS if (folder / name).exists()]


def write_products(
    reduction: Reduction, folder: Path, *, fit: bool = True, derivatives: bool = False
) -> list[Path]:
    """Write the products of a reduction; see `Reduction.write`.

    Parameters
    ----------
    reduction : Reduction
    folder : Path
        Made if it does not exist. Afterwards it has no products of an earlier reduction.
    fit : bool
        Write ``fit.fits``.
    derivatives : bool
        Write the derivatives of the fit with it.

    Returns
    -------
    list of Path
    """
    written = reduction.detection.write(folder, overwrite=True)
    if fit:
        path = folder / "fit.fits"
        written.append(reduction.fit.write(path, linear=derivatives, overwrite=True))
    if reduction.wide is not None:
        written += reduction.wide.write(folder, overwrite=True)
    if reduction.disk is not None:
        written.append(reduction.disk.write(folder, overwrite=True))
    if reduction.systematics is not None:
        written.append(reduction.systematics.write(folder / "systematics.fits", overwrite=True))
    tables = {"injections": reduction.injections, "completeness": reduction.completeness}
    for name, table in tables.items():
        if table is not None:
            written.append(folder / f"{name}.ecsv")
            write_table(table, written[-1])
    overview = Overview(SkyImages(reduction), Klip.of(reduction))
    written.append(overview.images.write(folder / "images.fits"))
    written.append(folder / "detection.png")
    drawing.save(overview.figure(), written[-1])
    written += _write_report(reduction, overview, folder, written)
    for path in set(existing_products(folder)) - set(written):
        path.unlink()
    return written


def write_report(reduction: Reduction, folder: Path, files: Iterable[Path] = ()) -> list[Path]:
    """Write ``report.html``, one page that needs no other file, and ``summary.json``.

    Parameters
    ----------
    reduction : Reduction
    folder : Path
        Made if it does not exist. Files of these names are replaced.
    files : iterable of path
        Other products, which the page lists.

    Returns
    -------
    list of Path
    """
    overview = Overview(SkyImages(reduction), Klip.of(reduction))
    return _write_report(reduction, overview, folder, files)


def _write_report(
    reduction: Reduction, overview: Overview, folder: Path, files: Iterable[Path]
) -> list[Path]:
    html, data = (folder / name for name in ("report.html", "summary.json"))
    klip = overview.klip and overview.klip.curve
    summary = summarise(reduction, klip)
    injections, fractions = reduction.injections, reduction.completeness
    curve = reduction.detection.contrast_curve
    frames = range(min(len(reduction.fit.frames), MOST_FRAMES))
    text = page(
        summary,
        overview_pictures(overview, summary),
        curve_pictures(reduction, summary, klip),
        [star_pictures(reduction, frame) for frame in frames],
        wavefront_pictures(reduction, summary),
        [] if reduction.wide is None else wide_pictures(reduction.wide),
        [] if reduction.disk is None else disk_pictures(reduction.disk),
        {path.name: PRODUCTS.get(path.name, "") for path in (*files, html, data)},
        [
            *([] if injections is None else [injections_section(summary, injections)]),
            *([] if fractions is None else [completeness_section(fractions, curve)]),
        ],
    )
    written = {html: text, data: json.dumps(summary, indent=2, allow_nan=False) + "\n"}
    for path, content in written.items():
        with replacing(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return list(written)
