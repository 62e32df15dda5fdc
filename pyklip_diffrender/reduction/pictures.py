"""The pictures of the report, with descriptions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from astropy.table import QTable

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import Detection, Disk, WideField, draw_curve
from pyklip_diffrender.reduction.html import Picture
from pyklip_diffrender.reduction.overview import Overview
from pyklip_diffrender.reduction.reduction_result import Reduction
from pyklip_diffrender.reduction.summary import wavefronts
from pyklip_diffrender.reduction.words import number

__all__ = [
    "MOST_FRAMES",
    "curve_pictures",
    "disk_pictures",
    "overview_pictures",
    "star_pictures",
    "wavefront_pictures",
    "wide_pictures",
]

MOST_FRAMES = 4
"""Frames of which pictures are shown."""


def overview_pictures(overview: Overview, summary: Mapping[str, Any]) -> list[Picture]:
    """The frames without the star, KLIP's beside them, and the S/N map; north is up."""
    count = len(summary["candidates"])
    some = f"{count or 'no'} candidate{'' if count == 1 else 's'}"
    some += f" above S/N {summary['threshold_snr']:g}"
    places = "; ".join(
        f"S/N {row['snr']:.1f} at {row['separation_arcsec']:.2f} arcsec"
        for row in summary["candidates"]
    )
    up = "north up" if summary["oriented"] else "oriented like the first frame"
    words = [
        (
            f"Image of {summary['target']} without the star, all frames combined, {up}.",
            f"{overview.images.words}, {up}. "
            + ("Circles mark the candidates. " if count else "")
            + "The scale is linear near 0 and logarithmic beyond.",
        ),
        (
            "Map of the signal-to-noise ratio of a point source, "
            f"{some}{': ' if places else ''}{places}.",
            f"S/N of a point source at every pixel, {some}. The scale is linear within ±5.",
        ),
    ]
    if overview.klip is not None:
        label = overview.klip.label
        words.insert(
            1,
            (
                f"Image of the same frames after {label}.",
                f"The same frames after {label}, on the same scale.",
            ),
        )
    figures, axes = _panels(overview.panels)
    overview.draw(axes)
    return _pictures(figures, *words)


def curve_pictures(
    reduction: Reduction, summary: Mapping[str, Any], klip: QTable | None
) -> list[Picture]:
    """The contrast curve, with that of KLIP if it is known."""
    detection = reduction.detection
    limits = "; ".join(
        f"{row['contrast']:.1e} at {row['separation_arcsec']:.3g} arcsec"
        for row in summary["limits"]
    )
    sigmas = summary["contrast_curve"]["sigmas"]
    dotted = (
        " Dotted: with the small-sample correction."
        if detection.error_factor.is_measured or klip is not None
        else ""
    )
    beside = (
        ""
        if klip is None
        else f" Squares: {klip.meta['label']} on the same frames, in units of the same star, with "
        "the best number of modes at every separation; its noise is the scatter in a ring, its "
        "throughput that of injected planets."
    )
    figure, ax = drawing.panel()
    draw_curve(ax, detection, klip)
    return _pictures(
        [figure],
        (
            f"Curve of the contrast at {sigmas:g} sigma against separation in arcsec"
            f"{': ' if limits else ''}{limits}.",
            f"Contrast, relative to the star without coronagraph, that gives S/N {sigmas:g}: the "
            "median of all position angles and their range. Dashed: the limit for "
            f"an exactly known star.{beside}{dotted} {_scaled(detection)}",
        ),
    )


def _scaled(detection: Detection) -> str:
    """How errors were scaled, in a sentence."""
    factors = detection.error_factor.factors
    if not detection.error_factor.is_needed:
        return "Errors are those of the fit, not scaled."
    if not detection.error_factor.is_measured:
        return (
            f"Errors were multiplied by {factors[0, 0]:.2f}, the square root of the reduced "
            "chi-squared without the candidates."
        )
    return (
        f"Errors were multiplied by {factors.min():.2f} to {factors.max():.2f}, depending on "
        "the star's light and the separation, so that the S/N away from candidates has a "
        "standard deviation of 1."
    )


def wide_pictures(wide: WideField) -> list[Picture]:
    """The S/N map of the whole frames, and the contrast curve to their edge."""
    figures, axes = _panels(2)
    wide.plot(axes)
    count = len(wide.candidates)
    some = f"{count or 'no'} candidate{'' if count == 1 else 's'} above S/N {wide.threshold:g}"
    oriented = wide.observation.position_angles is not None
    up = "north up" if oriented else "oriented like the first frame"
    return _pictures(
        figures,
        (
            f"Map of the signal-to-noise ratio of a point source in the whole frames, {some}.",
            f"S/N of a point source in the whole frames, {up}. Circles have the numbers of the "
            "table. About the star it is that of the search above; elsewhere the star, "
            "extrapolated from its fit, and the background were subtracted. Errors follow the "
            "scatter of the S/N at every separation.",
        ),
        (
            "Curve of the contrast limit against separation in arcsec, to the edge of the frames.",
            "Contrast limit to the edge of the frames, as far as half of a ring is in them.",
        ),
    )


def disk_pictures(disk: Disk) -> list[Picture]:
    """The frames without the star, and the extended light that was fitted."""
    figures, axes = _panels(2)
    disk.plot(axes)
    return _pictures(
        figures,
        (
            "Image of the extended light: the frames without the star.",
            "Frames minus the star, turned to the orientation of the first one and averaged. "
            "The star was fitted together with the extended light, which therefore is not "
            "subtracted with it.",
        ),
        (
            "Image of the extended light that was fitted.",
            "Light of the non-negative sources that were fitted together with the star, as the "
            "coronagraph shows it in the first frame.",
        ),
    )


def star_pictures(reduction: Reduction, frame: int) -> list[Picture]:
    """Data, model and residual of a frame."""
    detection = reduction.detection
    observation = detection.fits[0].frames[frame].observation
    unit, count = drawing.unit_label(observation.unit), len(observation)
    subtracted = (
        " The star was estimated together with the candidates (circles), whose light is kept."
        if len(detection.candidates)
        else ""
    )
    mean = f", the mean of {count} integrations" if count > 1 else ""
    mean += "" if reduction.disk is None else ", without the extended light"
    return _pictures(
        _star(detection, frame),
        (
            f"Image of {observation.target} behind the coronagraph, in {unit}.",
            f"Observed{mean}. The scale is linear near 0 and logarithmic in bright parts; "
            "the cross marks the star.",
        ),
        (
            f"Modelled image of {observation.target}, in {unit}.",
            "The fitted star and background, on the same scale.",
        ),
        (
            f"The residual image of {observation.target} without the star, in standard "
            "deviations of the noise.",
            "Data without the star, over the noise of each pixel; the scale is linear within ±5."
            f"{subtracted}",
        ),
    )


def wavefront_pictures(reduction: Reduction, summary: Mapping[str, Any]) -> list[Picture]:
    """The wavefront before and after the fit."""
    fit, about = reduction.fit, summary["wavefront_map"]
    before, after = wavefronts(fit)
    rms = [number(about[f"{key}rms_nm"], ".1f", "nm") for key in ("", "refined_", "change_")]
    figures, axes = _panels(3)
    width = fit.model.diameter
    limit = float(np.nanpercentile(np.abs([before, after]), 99.5)) or 1.0
    drawing.wavefront_map(axes[0], before, width, title="Before the fit", limit=limit)
    drawing.wavefront_map(axes[1], after, width, title="After the fit", limit=limit)
    drawing.wavefront_map(axes[2], after - before, width, title="Change")
    return _pictures(
        figures,
        (
            f"Map of the wavefront error before the fit, {rms[0]} rms.",
            f"The map that the fit started from ({about['name']}), {rms[0]} rms.",
        ),
        (
            f"Map of the wavefront error after the fit, {rms[1]} rms.",
            f"The wavefront of the first frame after the fit, {rms[1]} rms.",
        ),
        (
            f"Map of the change of the wavefront error, {rms[2]} rms.",
            f"After minus before, {rms[2]} rms. The frames measure only what the Lyot stop lets "
            "through and what reaches the fitted pixels; the rest follows from the prior.",
        ),
    )


def _star(detection: Detection, frame: int) -> list[Any]:
    """Draw a frame, the model of its star, and the residual, in which candidates are kept."""
    fit = detection.fits[0]
    part, observation = fit.frames[frame], fit.frames[frame].observation.combined()
    valid, noise = observation.valid[0], observation.error[0]
    data = np.where(valid, observation.data[0], np.nan)
    north = observation.north
    norm, unit = drawing.light_norm(data, noise[valid]), drawing.unit_label(observation.unit)
    figures, axes = _panels(3)
    for ax, image, title in ((axes[0], data, "Data"), (axes[1], part.star, "Model of the star")):
        drawing.star_image(ax, image, part.grid, norm, bar=unit, title=title, north=north)
    residual = detection.subtracted[frame] / noise
    places = np.stack([detection.candidates["x"].value, detection.candidates["y"].value], axis=1)
    drawing.signed_image(
        axes[2],
        residual,
        part.grid,
        float(np.nanmax(np.abs(residual))),
        bar="standard deviations of the noise",
        title="Residual",
        places=observation.turned(places, fit.frames[0].observation),
        linear=drawing.SNR_LINEAR,
        north=north,
    )
    return figures


def _panels(count: int) -> tuple[list[Any], list[Any]]:
    """Figures with one axes each, and these axes."""
    panels = [drawing.panel() for _ in range(count)]
    return [figure for figure, _ in panels], [ax for _, ax in panels]


def _pictures(figures: Sequence[Any], *words: tuple[str, str]) -> list[Picture]:
    return [
        Picture(drawing.to_png(figure), alt, caption)
        for figure, (alt, caption) in zip(figures, words, strict=True)
    ]
