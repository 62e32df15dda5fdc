"""Images of the sky with north up, the result at a glance, and the pictures of the report."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.table import QTable
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import (
    Detection,
    Disk,
    WideField,
    combine_frames,
    draw_curve,
    image_hdu,
)
from pyklip_diffrender.imaging import SkyModel
from pyklip_diffrender.io.files import write_fits
from pyklip_diffrender.io.headers import fits_unit
from pyklip_diffrender.io.units import rotation_matrix
from pyklip_diffrender.reduction.pages import Picture, number, some_candidates
from pyklip_diffrender.reduction.pipeline import ReductionResult
from pyklip_diffrender.reduction.summary import wavefronts
from pyklip_diffrender.scene.observation import Window
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates
from pyklip_diffrender.scene.star_place import without_gaps

# Images of the sky about the star with north up, of all frames together.

Image = NDArray[np.float64]


class SkyImages:
    """Images with north up, or with the orientation of the first frame where north is not known."""

    def __init__(self, reduction: ReductionResult) -> None:
        self.detection: Detection = reduction.detection
        # Extended light, which the combined image has and the others lack.
        self.disk, self._is_quick = reduction.disk, reduction.accuracy == "quick"
        self._templates = self.detection.templates
        observation = self.detection.observation
        self.oriented = observation.position_angles is not None
        self._half = max(observation.shape) // 2
        y, x = np.mgrid[-self._half : self._half + 1, -self._half : self._half + 1]
        # (n, n, 2), x, y of the pixels from the star, arcsec; y is north and x is west.
        self.grid = np.sqrt(np.prod(observation.pixelscale)) * np.stack([x, y], axis=-1)
        self.to_sky = rotation_matrix(self.detection.north)

    @cached_property
    def combined(self) -> tuple[Image, Image]:
        """Mean of the frames minus the star, and its standard deviation, in the frames' unit."""
        images, errors = {}, {}
        lights: Sequence[Any] = [0.0] * len(self._templates.frames)
        if self.disk is not None:
            lights = self.disk.light
        # Frames of reference stars may be among those that were fitted.
        for (k, frame), light in zip(self._templates.frames.items(), lights, strict=True):
            subtracted = self.detection.subtracted[k]
            images[k] = without_gaps(subtracted) + light
            error = frame.observation.combined().error[0]
            errors[k] = np.where(np.isfinite(subtracted), error, np.inf)
        return combine_frames(self._templates, images, errors, self.grid @ self.to_sky)

    @cached_property
    def _sky_model(self) -> SkyModel:
        return SkyModel(self.detection.fit)

    @cached_property
    def posterior_mean(self) -> Image:
        """Light of neither star nor detector, in the frames' unit.

        See `imaging`. Point sources have 0.4 to 1 of their peak, least close to the star,
        and no side lobes.
        """
        return self._middle(self._sky_model.estimate()[0])

    @cached_property
    def posterior_mean_error(self) -> Image:
        """Standard deviation of `posterior_mean`."""
        error = self._middle(self._sky_model.error())
        return error * self.detection.error_factor.of(self.grid @ self.to_sky)

    def _middle(self, image: Image) -> Image:
        """The pixels of `grid` in an image of the model of the sky."""
        center = self._sky_model.center
        middle = slice(center - self._half, center + self._half + 1)
        return image[middle, middle]

    @cached_property
    def throughput(self) -> Image:
        """Fraction of the light of a faint source that `combined` has, by a matched filter.

        The light of a candidate, which is fitted with the star, is in the image as a whole.
        """
        # The fit of the star takes the rest. By linear theory the fraction that is left is what the
        # frames say of the source's flux with the star marginalised, 1 / error^2, over what they
        # say of it with the star known, 1 / photon_error^2.
        detection = self.detection
        error = detection.error / detection.error_factor.of(detection.grid)
        return self.turned((detection.photon_error / error) ** 2)

    def turned(self, on_frame: Image) -> Image:
        """Interpolate an image on the pixels of the first frame."""
        offsets = torch.from_numpy((self.grid @ self.to_sky).reshape(-1, 2))
        places = self._templates.pixels_of(min(self._templates.frames), offsets)
        values = map_coordinates(on_frame, places, order=1, cval=np.nan)
        return np.asarray(values.reshape(self.grid.shape[:2]))

    def write(self, path: Path) -> Path:
        """Write all images to a FITS file with a world coordinate system."""
        detection = self.detection
        unit = fits_unit(detection.observation.unit)
        mean, error = self.combined
        images = {
            "COMBINED": (mean, unit),
            "COMBINED_ERROR": (error, unit),
            "THROUGHPUT": (self.throughput, ""),
            "POSTERIOR_MEAN": (self.posterior_mean, unit),
        }
        if not self._is_quick:  # It takes a fifth of the time of a first look's products.
            images["POSTERIOR_MEAN_ERROR"] = (self.posterior_mean_error, unit)
        images |= {
            "CONTRAST": (self.turned(detection.contrast), ""),
            "CONTRAST_ERROR": (self.turned(detection.error), ""),
            "SNR": (self.turned(detection.snr), ""),
        }
        wcs = world_coordinates(self.grid @ self.to_sky, detection.observation)
        first = primary_hdu(detection.observation, detection.provenance, detection.sky.mjd)
        hdus = [image_hdu(image, name, unit, wcs) for name, (image, unit) in images.items()]
        write_fits(fits.HDUList([first, *hdus]), path)
        return path


# The result at a glance: the frames without the star, KLIP's beside them, and the S/N map.

_log = logging.getLogger(__name__)


_LINEAR_SIGMAS = 5.0
"""Linear part of the scale for light, standard deviations of the noise."""


@dataclass(frozen=True, eq=False)
class Klip:
    """KLIP on the frames of a reduction."""

    curve: QTable  # see `klip_curve`
    image: Image  # (ny, nx), frames without the star, combined, north up
    grid: Image  # (ny, nx, 2), x, y of its pixels from the star, arcsec
    label: str  # references and modes of the image

    @classmethod
    def of(cls, reduction: ReductionResult) -> Klip | None:
        """KLIP for a reduction; None where it has no references or fails."""
        sequence, detection = reduction.sequence, reduction.detection
        if not sequence.references and len(sequence.science) < 2:
            return None
        # A disk is part of the frames that KLIP would get.
        science = None if reduction.disk is None else sequence.science
        try:
            # pyKLIP is loaded only if it is needed.
            from pyklip_diffrender.reduction.klip import klip_curve, klip_image

            curve = klip_curve(detection, sequence.references)
            modes = int(np.median(curve["modes"]))
            image = klip_image(detection, sequence.references, science, modes)
        except Exception as error:  # An addition to the report, which is complete without it.
            _log.warning("the report has no comparison with KLIP: %s", error)
            return None
        return cls(curve, *image)


class Overview:
    """Images with north up, or with the orientation of the first frame where north is not known."""

    def __init__(self, images: SkyImages, klip: Klip | None) -> None:
        self.images, self.klip = images, klip
        detection = images.detection
        self._detection = detection
        self._unit = drawing.unit_label(detection.observation.unit)
        table = detection.candidates
        self._places = np.stack([table["x"].value, table["y"].value], axis=1) @ images.to_sky.T
        self._labels = [f"S/N {each:.1f}" for each in table["snr"]]

    @property
    def panels(self) -> tuple[str, ...]:
        """Names of the panels: the image, KLIP's, the most probable image, and the S/N."""
        return (
            "without_star",
            *(() if self.klip is None else ("klip",)),
            # With a disk in the model that image would lack its light.
            *(("most_probable",) if self.images.disk is None else ()),
            "snr",
        )

    def draw(self, ax: Any, panel: str) -> None:
        """Draw one of `panels`; all images of light have the same scale."""
        grid, north = self.images.grid, 0.0 if self.images.oriented else None
        if panel == "snr":
            snr = self.images.turned(self._detection.snr)
            drawing.snr_map(ax, snr, grid, self._places, north, title="S/N", labels=self._labels)
            return
        mean, error = self.images.combined
        image, title = mean, "Without the star"
        if panel == "most_probable":
            image, title = self.images.posterior_mean, "Most probable image"
        if panel == "klip" and self.klip is not None:
            image, grid, title = self.klip.image, self.klip.grid, self.klip.label
        drawing.signed_image(
            ax, image, grid, float(np.nanmax(np.abs(mean))), bar=self._unit, title=title,
            places=self._places, linear=_LINEAR_SIGMAS * float(np.nanmedian(error)), north=north,
        )  # fmt: skip
        pixel = self.images.grid[0, 1, 0] - self.images.grid[0, 0, 0]
        half = np.abs(self.images.grid).max() + pixel / 2
        # East is left.
        ax.set_xlim((-half, half) if north is None else (half, -half))
        ax.set_ylim(-half, half)

    def figure(self) -> Any:
        """One figure of the panels but the most probable image, and the contrast curve."""
        panels = [each for each in self.panels if each != "most_probable"]
        figure, axes = drawing.new_figure(1, len(panels) + 1)
        for ax, panel in zip(axes[0], panels, strict=False):
            self.draw(ax, panel)
        draw_curve(axes[0, -1], self._detection, self.klip and self.klip.curve)
        return figure


# The pictures of the report, with descriptions.

Pictures = Sequence[Picture]

MOST_FRAMES = 4
"""Largest number of frames, and of candidates, with pictures."""

_HALF_STAMP_ARCSEC = 0.45
"""Half of the side of the pictures of a candidate, arcsec."""


@dataclass(frozen=True)
class ReportPictures:
    """The pictures of a report, by section; pictures that a reduction does not have are missing."""

    overview: Pictures = ()
    curve: Pictures = ()
    # For each candidate and, below, for each frame of the target that is shown.
    candidates: Sequence[Pictures] = ()
    wide: Pictures = ()
    disk: Pictures = ()
    injections: Pictures = ()
    completeness: Pictures = ()
    stars: Sequence[Pictures] = ()
    wavefront: Pictures = ()

    @classmethod
    def of(
        cls, reduction: ReductionResult, overview: Overview, summary: Mapping[str, Any]
    ) -> ReportPictures:
        """Draw all that a reduction has."""
        detection = reduction.detection
        klip = overview.klip and overview.klip.curve
        frames = list(detection.templates.frames)[:MOST_FRAMES]
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


def _overview(overview: Overview, summary: Mapping[str, Any]) -> list[Picture]:
    """The frames without the star, KLIP's beside them, and the S/N map; north is up."""
    some = f"{some_candidates(len(summary['candidates']))} above S/N {summary['threshold_snr']:g}"
    up = "north up" if summary["oriented"] else "oriented like the first frame"
    words = {
        "without_star": (
            f"Mean of all frames minus the star, {up}. THROUGHPUT in images.fits is the part of "
            "the light of a faint source that is left; circles mark candidates, which were fitted "
            "together with the star and keep all of their light. The scale is linear near 0 and "
            "logarithmic beyond."
        ),
        "most_probable": (
            f"Most probable image of the sky without star and detector, {up}, from all frames and "
            "on the same scale. Point sources have 0.4 to 1 of their peak, least close to the "
            "star, and no side lobes."
        ),
        "snr": f"S/N of a point source at every pixel, {some}. The scale is linear within ±5.",
    }
    if overview.klip is not None:
        words["klip"] = f"Mean of the same frames after {overview.klip.label}, on the same scale."
    axes = [drawing.panel() for _ in overview.panels]
    for ax, panel in zip(axes, overview.panels, strict=True):
        overview.draw(ax, panel)
    return _pictures(axes, [words[each] for each in overview.panels])


def _curve(
    reduction: ReductionResult, summary: Mapping[str, Any], klip: QTable | None
) -> list[Picture]:
    """The contrast curve, with KLIP's if it is known."""
    detection = reduction.detection
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
        "the candidates, its throughput is measured with injected planets."
    )
    ax = drawing.wide_panel()
    draw_curve(ax, detection, klip, legend_below=True)
    caption = (
        f"Contrast, relative to the star without coronagraph, that gives S/N {sigmas:g}, against "
        "separation: the median of all position angles and their range. "
        f"Dashed: the limit for an exactly known star.{beside}{dotted}"
    )
    return _pictures([ax], [caption])


def _candidate(detection: Detection, place: int) -> list[Picture]:
    """Pixels of a candidate in every frame, by its place in the table."""
    unit = drawing.unit_label(detection.observation.unit)
    pictures = []
    for frame, stamp in _stamps(detection, place).items():
        roll = "" if stamp.north is None else f", +y at position angle {stamp.north:.1f} deg"
        caption = (
            f"Candidate {place + 1} in frame {frame}{roll}: the data; without star, background and "
            "other candidates; the model of the source, on the same scale; and what is left, in "
            "standard deviations of the noise. The cross marks the fitted position."
        )
        pictures.append(Picture(drawing.stamp_panels(stamp, unit), caption))
    return pictures


def _stamps(detection: Detection, place: int) -> dict[int, drawing.Stamp]:
    """The pixels about a candidate in the first frames that show some, by their number from 1."""
    templates, sources = detection.templates, detection.sources
    # Sources are in the order in which they were found, and the table in the order of the S/N.
    index = int(np.argsort(-sources.snr(detection.error_factor))[place])
    offset = sources.offsets[index : index + 1]
    light, together = templates.at(offset), sources.light(templates)
    stamps = {}
    for shown, (k, frame) in enumerate(list(templates.frames.items())[:MOST_FRAMES], 1):
        subtracted = detection.subtracted[k]
        observation = frame.observation.combined()
        own = float(sources.contrasts[index]) * light[k][0].numpy()
        row, column = np.rint(templates.pixels_of(k, offset)[:, 0]).astype(int)
        half = max(3, round(_HALF_STAMP_ARCSEC / float(np.sqrt(np.prod(observation.pixelscale)))))
        window = Window(row - half, column - half, (2 * half + 1, 2 * half + 1))
        valid = observation.valid[0]
        # A source just beyond the fitted pixels is seen in these by its side lobes only.
        if not window.cut(observation.valid, False).any():
            continue
        nearest = np.clip((row, column), 0, np.subtract(valid.shape, 1))
        beyond = np.subtract((column, row), nearest[::-1])
        x, y = (
            axis + scale * (pixels + np.arange(-half, half + 1))
            for axis, scale, pixels in zip(
                frame.grid[*nearest], observation.pixelscale, beyond, strict=True
            )
        )
        # Of all candidates, only the light of this one stays in the picture without the star.
        data, left, model, noise = (
            window.cut(np.where(valid, image, np.nan)[np.newaxis], np.nan)[0]
            for image in (
                observation.data[0], subtracted - together[k][0].numpy() + own, own,
                observation.error[0],
            )
        )  # fmt: skip
        stamps[shown] = drawing.Stamp(x, y, data, left, model, noise, observation.north)
    return stamps


def _wide(wide: WideField) -> list[Picture]:
    """The S/N map of the whole frames, and the contrast curve to their edge."""
    axes = [drawing.panel() for _ in range(2)]
    wide.plot(axes)
    some = f"{some_candidates(len(wide.candidates))} above S/N {wide.threshold:g}"
    oriented = wide.observation.position_angles is not None
    up = "north up" if oriented else "oriented like the first frame"
    ny, nx = wide.snr.shape
    words = [
        (
            f"S/N of a point source in the whole frames, {some}, {up}: {nx} × {ny} pixels, at most "
            "the field of the mask, 20 arcsec wide. Circles have the numbers of the table. About "
            "the star it is the S/N of the search above; elsewhere the star, extrapolated from its "
            "fit, and the background were subtracted. Errors follow the scatter of the S/N at "
            "every separation."
        ),
        "Contrast limit to the edge of the frames, as far as half of a ring is in them.",
    ]
    return _pictures(axes, words)


def _disk(disk: Disk) -> list[Picture]:
    """The frames without the star, and the extended light that was fitted."""
    axes = [drawing.panel() for _ in range(2)]
    disk.plot(axes)
    words = [
        (
            "Frames minus the star, turned to the orientation of the first one and averaged. The "
            "star was fitted together with the extended light, which therefore is not subtracted "
            "with it."
        ),
        (
            "Light of the non-negative sources that were fitted together with the star, as the "
            "coronagraph shows it in the first frame."
        ),
    ]
    return _pictures(axes, words)


def _injections(planets: QTable) -> list[Picture]:
    """Recovered over injected contrast."""
    ax = drawing.panel()
    drawing.injected_planets(ax, planets)
    caption = (
        f"Recovered over injected contrast of {len(planets)} planets against separation. Filled: "
        "detected. Open: not detected, and measured at the known place."
    )
    return _pictures([ax], [caption])


def _completeness(fractions: QTable, curve: QTable) -> list[Picture]:
    """The fraction of planets that the search finds."""
    about = fractions.meta
    ax = drawing.panel()
    drawing.completeness(ax, fractions, curve, about["contrast_50"], about["contrast_95"])
    caption = (
        "Fraction of planets that the search finds, by contrast and separation. Dashed: 50 %; "
        "solid: 95 %; dotted: the contrast curve at 5 sigma."
    )
    return _pictures([ax], [caption])


def _star(reduction: ReductionResult, frame: int) -> list[Picture]:
    """Data, model and residual of a frame."""
    detection = reduction.detection
    observation = detection.fit.frames[frame].observation
    unit, count = drawing.unit_label(observation.unit), observation.count
    subtracted = (
        " The star was estimated together with the candidates (circles), whose light is kept."
        if len(detection.candidates)
        else ""
    )
    mean = f", the mean of {count} integrations" if count > 1 else ""
    mean += "" if reduction.disk is None else ", without the extended light"
    words = [
        (
            f"Image of {observation.target} behind the coronagraph{mean}, in {unit}. The scale is "
            "linear near 0 and logarithmic in bright parts; the cross marks the star."
        ),
        "The fitted star and background, on the same scale.",
        (
            "Data without the star, over the noise of each pixel. The scale is linear within ±5."
            f"{subtracted}"
        ),
    ]
    return _pictures(_of_frame(detection, frame), words)


def _wavefront(reduction: ReductionResult, summary: Mapping[str, Any]) -> list[Picture]:
    """The wavefront before and after the fit."""
    fit, about = reduction.fit, summary["opd"]
    before, after = wavefronts(fit)
    rms = [number(about[f"{key}rms_nm"], ".1f", "nm") for key in ("", "refined_", "change_")]
    axes = [drawing.panel() for _ in range(3)]
    width = fit.model.diameter
    limit = float(np.nanpercentile(np.abs([before, after]), 99.5)) or 1.0
    drawing.opd_map(axes[0], before, width, title="Before the fit", limit=limit)
    drawing.opd_map(axes[1], after, width, title="After the fit", limit=limit)
    drawing.opd_map(axes[2], after - before, width, title="Change")
    words = [
        f"The OPD map that the fit started from ({about['name']}), {rms[0]} rms.",
        f"The wavefront of the first frame after the fit, {rms[1]} rms.",
        (
            f"Change of the wavefront, after minus before: {rms[2]} rms. The frames measure only "
            "what the Lyot stop lets through and what reaches the fitted pixels; the rest follows "
            "from the prior."
        ),
    ]
    return _pictures(axes, words)


def _of_frame(detection: Detection, frame: int) -> list[Any]:
    """Draw a frame, the model of its star, and the residual, in which candidates are kept."""
    fit = detection.fit
    part, observation = fit.frames[frame], fit.frames[frame].observation.combined()
    valid, noise = observation.valid[0], observation.error[0]
    data = np.where(valid, observation.data[0], np.nan)
    north = observation.north
    norm, unit = drawing.light_norm(data, noise[valid]), drawing.unit_label(observation.unit)
    axes = [drawing.panel() for _ in range(3)]
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
    return axes


def _pictures(axes: Sequence[Any], captions: Sequence[str]) -> list[Picture]:
    """The figures of axes with their captions."""
    return [Picture(ax.figure, caption) for ax, caption in zip(axes, captions, strict=True)]
