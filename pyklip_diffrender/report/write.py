"""Writing the report and its summary."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path

from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.reduction import Reduction
from pyklip_diffrender.report.html import page
from pyklip_diffrender.report.pictures import (
    MOST_FRAMES,
    disk_pictures,
    search_pictures,
    star_pictures,
    wavefront_pictures,
    wide_pictures,
)
from pyklip_diffrender.report.summary import summarise

__all__ = ["write_report"]


def write_report(
    reduction: Reduction, folder: str | os.PathLike[str], files: Iterable[Path] = ()
) -> list[Path]:
    """Write ``report.html``, one page that needs no other file, and ``summary.json``.

    Parameters
    ----------
    reduction : Reduction
    folder : path
        Made if it does not exist. Files of these names are replaced.
    files : iterable of path
        Other products, which the page lists.

    Returns
    -------
    list of Path
    """
    html, data = (Path(folder) / name for name in ("report.html", "summary.json"))
    summary = summarise(reduction)
    frames = range(min(len(reduction.detection.fits[0].frames), MOST_FRAMES))
    text = page(
        summary,
        search_pictures(reduction, summary),
        [star_pictures(reduction, frame) for frame in frames],
        wavefront_pictures(reduction, summary),
        [] if reduction.wide is None else wide_pictures(reduction.wide),
        [] if reduction.disk is None else disk_pictures(reduction.disk),
        [path.name for path in (*files, html, data)],
    )
    written = {html: text, data: json.dumps(summary, indent=2, allow_nan=False) + "\n"}
    for path, content in written.items():
        with replacing(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return list(written)
