"""Complete figures of the demo, a subtraction and a detection."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pyklip_diffrender.instrument.jwst import maskrnd_openings
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.plotting.panels import INK, draw_image, extent_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pyklip_diffrender.demo import DemoResult
    from pyklip_diffrender.detection import Detection

__all__ = ["draw_demo", "draw_detection"]


def draw_demo(result: DemoResult) -> Figure:
    """Draw the demo: the frame, four subtractions in units of the noise, and wavefronts."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 7.6), layout="constrained")
    axes = figure.subplots(2, 4)
    scale = result.model.detector.pixelscale[0]
    frame = result.observation.data[0]
    artist = draw_image(
        axes[0, 0], np.maximum(frame, 1), scale, limits=(0, 1), cmap="magma",
        norm=LogNorm(float(np.percentile(frame, 2)), float(frame.max())),
        title="The frame: the occulted star\nhides the planet (circle)",
    )  # fmt: skip
    figure.colorbar(artist, ax=axes[0, 0], label="photons", shrink=0.85)

    planet = result.scene.planets[0]
    axes[0, 0].plot(*planet.offset, "o", mfc="none", mec="white", ms=13, mew=1.2)
    places = ((0, 1, "initial"), (0, 2, "KLIP"), (0, 3, "optimal"), (1, 0, "detected"))
    titles = {
        "initial": f"Star from the {result.table.meta['hours']:.0f} h old wavefront",
        "KLIP": "KLIP, nine dithered references",
        "optimal": "The true star subtracted",
        "detected": "Star refined, the planet found in the model",
    }
    for row, column, name in places:
        ax = axes[row, column]
        facts = result.table[list(result.table["star model"]).index(name)]
        share = 100 * facts["planet throughput"]
        # Where residuals of the star dominate, the share of the planet's light has no meaning.
        light_fraction = f", planet light kept {share:.0f} %" if facts["star error"] < 20 else ""
        artist = draw_image(
            ax, result.images[name] / result.noise, scale, limits=(-6, 6), cmap="RdBu_r",
            title=f"{titles[name]}\nSNR {facts['annulus SNR']:.1f}{light_fraction}",
        )  # fmt: skip
        ax.plot(*planet.offset, "o", mfc="none", mec=INK, ms=13, mew=1.2, clip_on=True)
        figure.colorbar(artist, ax=ax, label="residual / noise", shrink=0.85)

    grid = PupilGrid.full(result.model.npix, result.model.diameter)
    stop = polygon_coverage(maskrnd_openings(), grid).numpy() > 0.5
    true_change = 1e9 * (result.true_opd - result.measured.data)
    fitted_change = 1e9 * (result.fit.wavefront - result.measured.data)
    limit = float(np.percentile(np.abs(true_change[stop]), 99.5))
    for ax, change, title in (
        (axes[1, 1], true_change, "True change of the wavefront\nseen through the Lyot stop"),
        (axes[1, 2], fitted_change, "Change found from one frame\n(prior, no reference star)"),
    ):
        change_in_stop = np.where(stop, change - change[stop].mean(), np.nan)
        artist = draw_image(
            ax, change_in_stop, grid.spacing, limits=(-limit, limit), cmap="PuOr_r", title=title
        )
        ax.set_xlabel("m", fontsize=8)
        figure.colorbar(artist, ax=ax, label="nm", shrink=0.85)

    _draw_candidates(axes[1, 3], figure, result)
    for ax in (*axes[0], axes[1, 0], axes[1, 3]):
        ax.set_xlabel("arcsec", fontsize=8)
    return figure


def _draw_candidates(ax: Axes, figure: Figure, result: DemoResult) -> None:
    """Draw the S/N map of point sources, with the strongest candidate in the title."""
    detection, planet = result.detection, result.scene.planets[0]
    scale = result.model.detector.pixelscale[0]
    table = detection.table
    facts = "nothing above 5 sigma"
    if len(table):
        facts = (
            f"S/N {table['snr'][0]:.1f}, flux {table['contrast'][0] / planet.contrast:.2f} "
            f"± {table['contrast_error'][0] / planet.contrast:.2f} of true"
        )
    artist = draw_image(
        ax, detection.snr, scale, limits=(-6, 6), cmap="RdBu_r",
        title=f"Wavefront marginalised:\n{facts}",
    )  # fmt: skip
    ax.plot(*planet.offset, "o", mfc="none", mec=INK, ms=13, mew=1.2)
    figure.colorbar(artist, ax=ax, label="S/N of a point source", shrink=0.85)


def draw_detection(detection: Detection) -> Figure:
    """Draw the star-subtracted frame, S/N maps with and without candidates, and the contrast."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(18.5, 4.4), layout="constrained")
    frame, snr_axes, middle, right = figure.subplots(1, 4)
    noise = detection.observation.combined().error[0]
    extent, table = extent_of(detection.grid[0, :, 0], detection.grid[:, 0, 1]), detection.table
    above = f"{len(table)} above {detection.threshold:g}"
    for ax, image, title, label in (
        (frame, detection.subtracted[0] / noise, "First frame, star subtracted", "light / noise"),
        (snr_axes, detection.snr, f"S/N of a point source, {above}", "S/N"),
        (middle, detection.residual_snr, "S/N, candidates removed", "S/N"),
    ):
        artist = ax.imshow(image, origin="lower", extent=extent, cmap="RdBu_r", vmin=-8, vmax=8)
        figure.colorbar(artist, ax=ax, shrink=0.85, label=label)
        ax.plot(0, 0, "+", color=INK, ms=9)
        ax.plot(table["x"].value, table["y"].value, "o", mfc="none", mec="#2f9e44", ms=15, mew=1.4)
        ax.set_title(title, fontsize=10, color=INK, loc="left")
        ax.set_xlabel("arcsec from the star", fontsize=8)
    curve = detection.contrast_curve
    separation = curve["separation"].value
    right.fill_between(
        separation, curve["lowest"], curve["highest"], color="#5b3f95", alpha=0.15, lw=0
    )
    right.semilogy(separation, curve["contrast"], color="#5b3f95", label="wavefront marginalised")
    if detection.error_factor.is_measured:
        right.semilogy(
            separation, curve["small_sample"], ":", color="#5b3f95", label="small-sample corrected"
        )
    right.semilogy(separation, curve["known_star"], "--", color=INK, label="star known exactly")
    right.semilogy(
        table["separation"].value, table["contrast"], "o", mfc="none", mec="#2f9e44", ms=9
    )
    right.set_xlabel("arcsec", fontsize=9)
    right.set_title("5 sigma contrast, median and range of angles", fontsize=10, loc="left")
    right.set_box_aspect(1.0)
    right.legend(frameon=False, fontsize=8)
    return figure
