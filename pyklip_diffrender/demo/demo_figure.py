"""The figure of the demo."""

from __future__ import annotations

from typing import Any

import numpy as np

from pyklip_diffrender import drawing
from pyklip_diffrender.demo.comparison import DemoResult
from pyklip_diffrender.instrument.jwst import maskrnd_openings
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage

__all__ = ["draw_demo"]

_TITLES = {
    "initial": "Star from the {hours:.0f} h old wavefront",
    "KLIP": "KLIP, nine dithered references",
    "optimal": "The true star subtracted",
    "detected": "Star refined, the planet found in the model",
}

_LIMIT = 6.0
"""Limit of the scale for residuals, standard deviations."""


def draw_demo(result: DemoResult) -> Any:
    """Draw the frame, four subtractions over the noise, the wavefront's change and the S/N map.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure, axes = drawing.new_figure(2, 4)
    grid, planet = result.fit.frames[0].grid, [result.scene.planets[0].offset]
    frame = np.maximum(result.observation.data[0], 1)
    drawing.star_image(
        axes[0, 0], frame, grid, drawing.light_norm(frame, result.noise), bar="photons",
        title="The frame: the occulted star\nhides the planet",
    )  # fmt: skip
    for ax, name in zip([*axes[0, 1:], axes[1, 0]], _TITLES, strict=True):
        facts = result.table[list(result.table["star model"]).index(name)]
        # Where residuals of the star dominate, the fraction of the planet's light has no meaning.
        kept = (
            f", planet light kept {100 * facts['planet throughput']:.0f} %"
            if facts["star error"] < 20
            else ""
        )
        title = _TITLES[name].format(hours=result.table.meta["hours"])
        drawing.signed_image(
            ax, result.images[name] / result.noise, grid, _LIMIT, places=planet,
            bar="residual / noise", title=f"{title}\nSNR {facts['annulus SNR']:.1f}{kept}",
        )  # fmt: skip
    _draw_changes(axes[1, 1:3], result)
    drawing.snr_map(
        axes[1, 3], result.detection.snr, grid, planet,
        title=f"Wavefront marginalised:\n{_strongest(result)}",
    )  # fmt: skip
    return figure


def _draw_changes(axes: Any, result: DemoResult) -> None:
    """Draw the true and the fitted change of the wavefront on one scale."""
    pupil = PupilGrid.full(result.model.npix, result.model.diameter)
    stop = polygon_coverage(maskrnd_openings(), pupil).numpy() > 0.5
    changes = [
        1e9 * (opd - result.measured.data) for opd in (result.true_opd, result.fit.wavefront)
    ]
    limit = float(np.percentile(np.abs(changes[0][stop]), 99.5))
    titles = (
        "True change of the wavefront\nseen through the Lyot stop",
        "Change fitted to one frame\n(prior, no reference star)",
    )
    for ax, change, title in zip(axes, changes, titles, strict=True):
        seen = np.where(stop, change - change[stop].mean(), np.nan)
        drawing.wavefront_map(ax, seen, result.model.diameter, title=title, limit=limit)


def _strongest(result: DemoResult) -> str:
    """Describe the strongest candidate."""
    table, truth = result.detection.candidates, result.scene.planets[0].contrast
    if not len(table):
        return f"nothing above {result.detection.threshold:g} sigma"
    return (
        f"S/N {table['snr'][0]:.1f}, flux {table['contrast'][0] / truth:.2f} "
        f"± {table['contrast_error'][0] / truth:.2f} of true"
    )
