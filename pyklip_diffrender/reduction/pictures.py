"""The pictures of the report, with descriptions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import Detection, Disk, WideField, draw_curve
from pyklip_diffrender.reduction.overview import Overview
from pyklip_diffrender.reduction.pages import Picture
from pyklip_diffrender.reduction.reduction_result import Reduction
from pyklip_diffrender.reduction.summary import wavefronts
from pyklip_diffrender.reduction.words import number, plus_minus, scientific

__all__ = ["MOST_FRAMES", "ReportPictures"]

Pictures = Sequence[Picture]

MOST_FRAMES = 4
"""Frames of which pictures are shown, and candidates."""

_STAMP = 0.45
"""Half of the side of the pictures of a candidate, arcsec."""


@dataclass(frozen=True)
class ReportPictures:
    """The pictures of a report, by section; those that a reduction does not have are missing.

    Attributes
    ----------
    overview, curve, wide, disk, injections, completeness, wavefront : sequence of Picture
    candidates, stars : sequence of sequence of Picture
        For each candidate and for each frame of the target that is shown.
    """

    overview: Pictures = ()
    curve: Pictures = ()
    candidates: Sequence[Pictures] = ()
    wide: Pictures = ()
    disk: Pictures = ()
    injections: Pictures = ()
    completeness: Pictures = ()
    stars: Sequence[Pictures] = ()
    wavefront: Pictures = ()

    @classmethod
    def of(
        cls, reduction: Reduction, overview: Overview, summary: Mapping[str, Any]
    ) -> ReportPictures:
        """Draw all that a reduction has."""
        detection = reduction.detection
        klip = overview.klip and overview.klip.curve
        frames = list(detection.groups[0][1].frames)[:MOST_FRAMES]
        shown = range(min(len(detection.candidates), MOST_FRAMES))
        planets, fractions = reduction.injections, reduction.completeness
        return cls(
            _overview(overview, summary),
            _curve(reduction, summary, klip),
            [_candidate(detection, each) for each in shown],
            () if reduction.wide is None else _wide(reduction.wide),
            () if reduction.disk is None else _disk(reduction.disk),
            () if planets is None else _injections(planets),
            () if fractions is None else _completeness(fractions, detection.contrast_curve),
            [_star(reduction, each) for each in frames],
            _wavefront(reduction, summary),
        )

    def __iter__(self) -> Iterator[Picture]:
        for each in (self.overview, self.curve, *self.candidates, self.wide, self.disk,
                     self.injections, self.completeness, *self.stars, self.wavefront):  # fmt: skip
            yield from each


def _overview(overview: Overview, summary: Mapping[str, Any]) -> list[Picture]:
    """The frames without the star, KLIP's beside them, and the S/N map; north is up."""
    count = len(summary["candidates"])
    some = f"{count or 'no'} candidate{'' if count == 1 else 's'}"
    some += f" above S/N {summary['threshold_snr']:g}"
    places = "; ".join(
        f"S/N {row['snr']:.1f} at {row['separation_arcsec']:.2f} arcsec"
        for row in summary["candidates"]
    )
    up = "north up" if summary["oriented"] else "oriented like the first frame"
    separations = [row["separation_arcsec"] for row in summary["limits"]]
    ours, theirs = overview.kept(separations)
    words = {
        "without_star": (
            f"Image of {summary['target']} without the star, all frames combined, {up}.",
            f"Mean of all frames minus the star, {up}. "
            + _kept("A faint source keeps", ours, separations, " (THROUGHPUT in images.fits)")
            + (
                "A candidate, which was fitted together with the star, keeps all of its light. "
                "Circles mark the candidates. "
                if count
                else ""
            )
            + "The scale is linear near 0 and logarithmic beyond.",
        ),
        "most_probable": (
            f"Most probable image of the sky about {summary['target']}, {up}.",
            f"Most probable image of the sky without star and detector, {up}, from all frames and "
            "on the same scale. Point sources have 0.4 to 1 of their peak, least close to the "
            "star, and no side lobes.",
        ),
        "snr": (
            "Map of the signal-to-noise ratio of a point source, "
            f"{some}{': ' if places else ''}{places}.",
            f"S/N of a point source at every pixel, {some}. The scale is linear within ±5.",
        ),
    }
    if overview.klip is not None and theirs is not None:
        label = overview.klip.label
        words["klip"] = (
            f"Image of the same frames after {label}.",
            f"Mean of the same frames after {label}, on the same scale. "
            + _kept("Any source, a candidate too, keeps about", theirs, separations),
        )
    figures, axes = _panels(len(overview.panels))
    for ax, panel in zip(axes, overview.panels, strict=True):
        overview.draw(ax, panel)
    return _pictures(figures, overview.panels, *(words[each] for each in overview.panels))


def _kept(
    subject: str, fractions: NDArray[np.float64], separations: Sequence[float], source: str = ""
) -> str:
    """A sentence about the light that is kept; empty where none is known."""
    parts = [
        f"{100 * fraction:.0f} % of its light at {separation:.3g} arcsec"
        for fraction, separation in zip(fractions, separations, strict=True)
        if np.isfinite(fraction)
    ]
    first, others = parts[:1], [each.replace(" of its light", "") for each in parts[1:]]
    return f"{subject} {', '.join([*first, *others])}{source}. " if parts else ""


def _curve(reduction: Reduction, summary: Mapping[str, Any], klip: QTable | None) -> list[Picture]:
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
        "the best number of modes at every separation; its noise is the scatter in a ring without "
        "the candidates, its throughput that of injected planets."
    )
    figure, ax = drawing.wide_panel()
    draw_curve(ax, detection, klip, legend_below=True)
    return _pictures(
        [figure],
        ["contrast_curve"],
        (
            f"Curve of the contrast at {sigmas:g} sigma against separation in arcsec"
            f"{': ' if limits else ''}{limits}.",
            f"Contrast, relative to the star without coronagraph, that gives S/N {sigmas:g}: the "
            "median of all position angles and their range. Dashed: the limit for "
            f"an exactly known star.{beside}{dotted} {_scaled(detection)}",
        ),
    )


def _candidate(detection: Detection, place: int) -> list[Picture]:
    """Pixels in every frame, flux and position of a candidate, by its place in the table."""
    row, number = detection.candidates[place], place + 1
    unit = drawing.unit_label(detection.observation.unit)
    stamps = _stamps(detection, place)
    pictures = [
        Picture(
            f"candidate_{number}_frame_{frame}",
            drawing.stamp_panels(stamp, unit),
            f"Pixels about candidate {number} in frame {frame}: data, data without the star, model "
            "of the source, and residual.",
            f"Frame {frame}{_roll(stamp.north)}: the data; without star, background and other "
            "candidates; the model of the source, on the same scale; and what is left, in standard "
            "deviations of the noise. The cross marks the fitted position.",
        )
        for frame, stamp in enumerate(stamps, 1)
    ]
    names, values, covariance = _measured(detection, place)
    power = int(np.floor(np.log10(values[0])))
    scale = np.array([10.0**-power, 1e3, 1e3])
    values, covariance = scale * values, np.outer(scale, scale) * covariance
    errors = np.sqrt(np.diagonal(covariance))
    titles = [plus_minus(value, error) for value, error in zip(values, errors, strict=True)]
    figure = drawing.corner(
        [rf"contrast ($10^{{{power}}}$)", *(f"{each} (mas)" for each in names)],
        values, covariance, titles,
    )  # fmt: skip
    corner = Picture(
        f"candidate_{number}_corner",
        figure,
        f"Gaussian of contrast and position of candidate {number}: contrast "
        f"{scientific(row['contrast'], row['contrast_error'])}, {names[0]} {titles[1]} mas, "
        f"{names[1]} {titles[2]} mas.",
        "Contrast and position by the covariance of the fit, with the star and the other "
        "candidates marginalised. Ellipses have one and two standard deviations, 39 and 86 % of "
        "the probability. Errors include those of the star's flux and position.",
    )
    return [*pictures, corner]


def _roll(north: float | None) -> str:
    """The orientation of a frame as an apposition."""
    return "" if north is None else f", +y at position angle {north:.1f} deg"


def _source_of(detection: Detection, place: int) -> int:
    """Place among the sources, which are in the order they were found, of a row of the table."""
    return int(np.argsort(-detection.sources.snr(detection.error_factor))[place])


def _stamps(detection: Detection, place: int) -> list[drawing.Stamp]:
    """The pixels about a candidate in the first frames."""
    templates, sources = detection.groups[0][1], detection.sources
    index = _source_of(detection, place)
    offset = sources.offsets[index : index + 1]
    light, together = templates.at(offset), sources.light(templates)
    stamps = []
    for k, frame in list(templates.frames.items())[:MOST_FRAMES]:
        subtracted = detection.subtracted[k]
        observation = frame.observation.combined()
        own = float(sources.contrasts[index]) * light[k][0].numpy()
        row, column = np.rint(templates.pixels_of(k, offset)[:, 0]).astype(int)
        half = max(3, round(_STAMP / float(np.sqrt(np.prod(observation.pixelscale)))))
        window = slice(row, row + 2 * half + 1), slice(column, column + 2 * half + 1)
        valid = observation.valid[0]
        x, y = (
            axis + scale * np.arange(-half, half + 1)
            for axis, scale in zip(frame.grid[row, column], observation.pixelscale, strict=True)
        )
        data, left, model, noise = (
            np.pad(np.where(valid, image, np.nan), half, constant_values=np.nan)[window]
            for image in (
                observation.data[0], subtracted - together[k][0].numpy() + own, own,
                observation.error[0],
            )
        )  # fmt: skip
        stamps.append(drawing.Stamp(x, y, data, left, model, noise, observation.north))
    return stamps


def _measured(
    detection: Detection, place: int
) -> tuple[tuple[str, str], NDArray[np.float64], NDArray[np.float64]]:
    """Contrast and offset of a candidate, arcsec, with their covariance.

    The offset is that to the east and north where the orientation is known, else x and y.
    """
    row, sources = detection.candidates[place], detection.sources
    index, count = _source_of(detection, place), len(sources)
    at = index + count * np.arange(3)
    factor = detection.error_factor.of(sources.offsets[index : index + 1])[0]
    covariance = factor**2 * sources.covariance.numpy()[np.ix_(at, at)]
    # That of the star's flux, which does not depend on the position.
    covariance[0, 0] = row["contrast_error"] ** 2
    x, y = row["x"].value, row["y"].value
    if "delta_ra" not in row.colnames:
        return ("x", "y"), np.array([row["contrast"], x, y]), covariance
    angle = np.deg2rad(detection.north)
    sine, cosine = np.sin(angle), np.cos(angle)
    turn = np.eye(3)
    turn[1:, 1:] = [[-cosine, sine], [sine, cosine]]
    return ("ΔRA cos Dec", "ΔDec"), turn @ [row["contrast"], x, y], turn @ covariance @ turn.T


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


def _wide(wide: WideField) -> list[Picture]:
    """The S/N map of the whole frames, and the contrast curve to their edge."""
    figures, axes = _panels(2)
    wide.plot(axes)
    count = len(wide.candidates)
    some = f"{count or 'no'} candidate{'' if count == 1 else 's'} above S/N {wide.threshold:g}"
    oriented = wide.observation.position_angles is not None
    up = "north up" if oriented else "oriented like the first frame"
    return _pictures(
        figures,
        ["whole_frames_snr", "whole_frames_contrast_curve"],
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


def _disk(disk: Disk) -> list[Picture]:
    """The frames without the star, and the extended light that was fitted."""
    figures, axes = _panels(2)
    disk.plot(axes)
    return _pictures(
        figures,
        ["extended_light", "extended_light_model"],
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


def _injections(planets: QTable) -> list[Picture]:
    """Recovered over injected contrast."""
    figure, ax = drawing.panel()
    drawing.injected_planets(ax, planets)
    return _pictures(
        [figure],
        ["injected_planets"],
        (
            f"Recovered over injected contrast of {len(planets)} planets against separation in "
            "arcsec, with error bars.",
            "Recovered over injected contrast. Filled: detected. Open: not detected, and measured "
            "at the known place.",
        ),
    )


def _completeness(fractions: QTable, curve: QTable) -> list[Picture]:
    """The fraction of planets that the search finds."""
    about = fractions.meta
    figure, ax = drawing.panel()
    drawing.completeness(ax, fractions, curve, about["contrast_50"], about["contrast_95"])
    return _pictures(
        [figure],
        ["completeness"],
        (
            "Fraction of planets that the search finds, by contrast and separation in arcsec.",
            "Fraction of planets that the search finds. Dashed: 50 %; solid: 95 %; dotted: "
            "the contrast curve at 5 sigma.",
        ),
    )


def _star(reduction: Reduction, frame: int) -> list[Picture]:
    """Data, model and residual of a frame."""
    detection = reduction.detection
    observation = detection.fits[0].frames[frame].observation
    unit, count = drawing.unit_label(observation.unit), observation.count
    subtracted = (
        " The star was estimated together with the candidates (circles), whose light is kept."
        if len(detection.candidates)
        else ""
    )
    mean = f", the mean of {count} integrations" if count > 1 else ""
    mean += "" if reduction.disk is None else ", without the extended light"
    return _pictures(
        _of_frame(detection, frame),
        [f"frame_{frame + 1}_{each}" for each in ("data", "model", "residual")],
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


def _wavefront(reduction: Reduction, summary: Mapping[str, Any]) -> list[Picture]:
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
        [f"wavefront_{each}" for each in ("before", "after", "change")],
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


def _of_frame(detection: Detection, frame: int) -> list[Any]:
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


def _pictures(
    figures: Sequence[Any], names: Sequence[str], *words: tuple[str, str]
) -> list[Picture]:
    return [
        Picture(name, figure, alt, caption)
        for name, figure, (alt, caption) in zip(names, figures, words, strict=True)
    ]
