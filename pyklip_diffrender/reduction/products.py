"""Writing the report and its summary."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterable
from pathlib import Path

from astropy.table import QTable

from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.reduction import Reduction
from pyklip_diffrender.report.html import page
from pyklip_diffrender.report.injections import injections_section
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

_log = logging.getLogger(__name__)


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
    klip = _klip_curve(reduction)
    summary = summarise(reduction, klip)
    frames = range(min(len(reduction.detection.fits[0].frames), MOST_FRAMES))
    text = page(
        summary,
        search_pictures(reduction, summary, klip),
        [star_pictures(reduction, frame) for frame in frames],
        wavefront_pictures(reduction, summary),
        [] if reduction.wide is None else wide_pictures(reduction.wide),
        [] if reduction.disk is None else disk_pictures(reduction.disk),
        [path.name for path in (*files, html, data)],
        "" if reduction.injections is None else injections_section(summary, reduction.injections),
    )
    written = {html: text, data: json.dumps(summary, indent=2, allow_nan=False) + "\n"}
    for path, content in written.items():
        with replacing(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return list(written)


def _klip_curve(reduction: Reduction) -> QTable | None:
    """KLIP's contrast curve; None where KLIP has no references or fails."""
    if not reduction.sequence.references and len(reduction.sequence.science) < 2:
        return None
    try:
        # pyKLIP is loaded only if it is needed.
        from pyklip_diffrender.pyklip_backend.klip_curve import klip_curve

        return klip_curve(reduction)
    except Exception as error:  # An addition to the report, which is complete without it.
        _log.warning("the report has no contrast curve of KLIP: %s", error)
        return None
