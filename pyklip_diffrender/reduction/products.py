"""The files that a reduction writes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pyklip_diffrender import drawing
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import replacing, write_table
from pyklip_diffrender.reduction.overview import Klip, Overview
from pyklip_diffrender.reduction.pages import FIGURE_FORMATS, write_figures
from pyklip_diffrender.reduction.pictures import ReportPictures
from pyklip_diffrender.reduction.reduction_result import Reduction
from pyklip_diffrender.reduction.report import page
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


_FIGURES = "figures"
"""Folder of the figures, in that of the products."""

_FIGURE = re.compile(
    r"(without_star|klip|most_probable|snr|contrast_curve|candidate_\d+_(frame_\d+|corner)"
    r"|whole_frames_(snr|contrast_curve)|extended_light(_model)?|injected_planets|completeness"
    r"|frame_\d+_(data|model|residual)|wavefront_(before|after|change))"
    rf"\.({'|'.join(FIGURE_FORMATS)})"
)
"""Names of the files of figures."""


def existing_products(folder: Path) -> list[Path]:
    """Files in a folder that are called like products of a reduction."""
    figures = folder / _FIGURES
    drawn = figures.iterdir() if figures.is_dir() else ()
    return [
        *(folder / name for name in PRODUCTS if (folder / name).exists()),
        *sorted(path for path in drawn if _FIGURE.fullmatch(path.name)),
    ]


def write_products(
    reduction: Reduction,
    folder: Path,
    *,
    fit: bool = True,
    derivatives: bool = False,
    figures: Literal["pdf", "png", "svg"] | None = None,
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
    figures : {"pdf", "png", "svg"}, optional
        Write every figure of the report to a file of this format, too.

    Returns
    -------
    list of Path

    Raises
    ------
    IncompatibleSetupError
        For another format.
    """
    if figures is not None and figures not in FIGURE_FORMATS:
        raise IncompatibleSetupError(
            f"figures: got {figures!r}, expected one of {', '.join(FIGURE_FORMATS)}, or None for a "
            "report without files of its figures"
        )
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
    summary, pictures = _shown(reduction, overview)
    if figures is not None:
        written += write_figures(pictures, folder / _FIGURES, figures)
    written += _write_page(summary, pictures, folder, written)
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
    return _write_page(*_shown(reduction, overview), folder, files)


def _shown(reduction: Reduction, overview: Overview) -> tuple[dict[str, Any], ReportPictures]:
    """Numbers and pictures of the report."""
    summary = summarise(reduction, overview.klip and overview.klip.curve)
    return summary, ReportPictures.of(reduction, overview, summary)


def _write_page(
    summary: dict[str, Any], pictures: ReportPictures, folder: Path, files: Iterable[Path]
) -> list[Path]:
    html, data = (folder / name for name in ("report.html", "summary.json"))
    listed = [*files, html, data]
    drawn = [path for path in listed if path.parent.name == _FIGURES]
    about = {path.name: PRODUCTS.get(path.name, "") for path in listed if path not in drawn}
    if drawn:
        about[f"{_FIGURES}/"] = f"the {len(drawn)} figures of this page, each in a file"
    text = page(summary, pictures, about)
    written = {html: text, data: json.dumps(summary, indent=2, allow_nan=False) + "\n"}
    for path, content in written.items():
        with replacing(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return list(written)
