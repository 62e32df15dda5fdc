"""The part of the report on injected planets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from astropy.table import QTable

from pyklip_diffrender import drawing
from pyklip_diffrender.reduction import html
from pyklip_diffrender.reduction.html import Picture
from pyklip_diffrender.reduction.words import plus_minus, scientific

__all__ = ["injections_section"]


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
