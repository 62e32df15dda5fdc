"""The parts of the report on injected planets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.table import QTable

from pyklip_diffrender import drawing
from pyklip_diffrender.reduction import html
from pyklip_diffrender.reduction.html import Picture
from pyklip_diffrender.reduction.words import plus_minus, scientific

__all__ = ["completeness_section", "injections_section"]


def injections_section(summary: Mapping[str, Any], planets: QTable) -> str:
    """A section with a sentence, a picture and a table."""
    about = summary["injections"]
    header = ["Separation (arcsec)", "Position angle (deg)", "Injected", "Recovered",
              "Recovered / injected", "S/N", "Detected"]  # fmt: skip
    rows = [
        [
            f"{row['separation'].value:.3f}",
            f"{row['position_angle'].value:.1f}",
            scientific(row["injected"]),
            scientific(row["contrast"], row["contrast_error"]),
            plus_minus(row["contrast"] / row["injected"], row["contrast_error"] / row["injected"]),
            f"{row['snr']:.1f}",
            "yes" if row["detected"] else "no",
        ]
        for row in planets
    ]
    text = (
        f"Planets {planets.meta['strength']:g} times as bright as the limit at their separations "
        "were added to the frames, and the star was fitted again. "
        f"{about['detected']} of {about['count']} were detected."
    )
    if about["mean_ratio_error"] is not None:
        text += (
            " The mean of recovered over injected contrast is "
            f"{plus_minus(about['mean_ratio'], about['mean_ratio_error'])}; "
            f"{100 * about['within_one_error']:.0f} % are within one standard deviation of the "
            f"truth, and the differences scatter by {about['pull_deviation']:.2f} standard "
            "deviations."
        )
    figure, ax = drawing.panel()
    drawing.injected_planets(ax, planets)
    picture = Picture(
        drawing.to_png(figure),
        f"Recovered over injected contrast of {about['count']} planets against separation in "
        "arcsec, with error bars.",
        "Recovered over injected contrast. Filled: detected. Open: not detected, and measured at "
        "the known place.",
    )
    return html.section(
        "Injected planets",
        html.note(text),
        html.pictures([picture], "half"),
        html.table(header, rows),
    )


def completeness_section(fractions: QTable, curve: QTable) -> str:
    """A section with a sentence, a picture and a table."""
    about = fractions.meta
    limits = np.exp(
        np.interp(about["separation_arcsec"], curve["separation"].value, np.log(curve["contrast"]))
    )
    rows = [
        [f"{separation:.2f}", *(scientific(each) if np.isfinite(each) else "-" for each in values)]
        for separation, *values in zip(
            about["separation_arcsec"], limits, about["contrast_50"], about["contrast_95"],
            strict=True,
        )
    ]  # fmt: skip
    text = (
        f"Planets were added to the frames, {fractions['planets'].max()} at every separation and "
        "contrast, and the maps were searched as if nothing were known of them, with the threshold "
        f"of the search, {about['threshold']:g} sigma. In noise without planets it has a false "
        f"candidate in {100 * about['false_alarm']:.2g} % of such fields."
    )
    figure, ax = drawing.panel()
    drawing.completeness(ax, fractions, curve, about["contrast_50"], about["contrast_95"])
    picture = Picture(
        drawing.to_png(figure),
        "Fraction of planets that the search finds, by contrast and separation in arcsec.",
        "Fraction of planets that the search finds. Dashed: 50 %; solid: 95 %; dotted: "
        "the contrast curve at 5 sigma.",
    )
    header = ["Separation (arcsec)", "5 sigma", "50 % found", "95 % found"]
    return html.section(
        "Completeness", html.note(text), html.pictures([picture], "half"), html.table(header, rows)
    )
