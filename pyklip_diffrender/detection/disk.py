"""Extended light about a star, such as a disk: non-negative sources fitted with the star.

With the star marginalised as for point sources, the light a of sources on a grid of positions
minimises

    a^T M a / 2 - v^T a + s sum_j a_j / sigma_j,    a >= 0,

where M and v are the normal equations of the sources' images and sigma_j is the standard deviation
of source j alone. Frames of several rolls share the sources, which turn with the sky, while the
star stays. The last term, a threshold of s standard deviations, keeps sources at zero that only
noise asks for.

The light of a disk biases the star that was fitted without it, beyond the range of the linear
model. So the star is fitted again without that light, three times in all.

Sources first stand at every second pixel of the field. They show where light is extended; there,
and where there are point sources, sources at every pixel follow. Point sources are fitted, too, but
are no part of the extended light: they stay in the data, for the search to judge.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import minimize

from pyklip_diffrender import drawing
from pyklip_diffrender.detection.candidates import without_light
from pyklip_diffrender.detection.detection_file import image_hdu
from pyklip_diffrender.detection.field import Image, Sky, pixel_width, separation_of
from pyklip_diffrender.detection.templates import Templates, combine_frames
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import require_new, write_fits
from pyklip_diffrender.io.headers import fits_unit, set_keyword
from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.io.units import require_positive, to_arcsec
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates

# Which light of sources on a grid is extended, and which belongs to point sources.
#
# The brightness of the sources is smoothed by a beam of lambda/D. Of all straight lines of a given
# length through a position, in all directions, one is brightest at its faintest point: that
# brightness is the opening of the image by lines (Soille 2003, Morphological Image Analysis,
# chapter 4). It keeps what goes on in any direction, however narrow, such as a disk seen edge-on or
# a ring, while little is left of a point source, which is dark half a line away.

Mask = NDArray[np.bool_]

_HALF_LINE_LAMBDA_D = 1.5
"""lambda/D, rounded to pixels: the beam leaves at most 2 % of a point source at that distance."""

_LINE_DIRECTIONS = 12
"""Number of directions of lines, over half a turn."""

_OPENING_SHARE = 0.18
"""Least share of the smoothed brightness that the opening keeps of extended light. It was 0.21
or more at the brightest peaks, of S/N 8 to 95, of simulated rings and clouds, which noise breaks up
into clumps, and at most 0.16 for planets of S/N 13 and more 0.4 arcsec from a bright ring."""

_FLOOR_SIGMAS = 1.0
_PEAK_SIGMAS = 3.0
"""Standard deviations of one source: extended light is brighter than the first everywhere and than
the second somewhere. The opening of noise was up to 2.9."""

_BESIDE_POINT = 0.2
"""Share of the brightest point source that extended light must have somewhere: errors of the model
left up to 0.1 of a source about simulated companions of 1e-5 to 1e-3."""

_REGION_MARGIN_LAMBDA_D = 0.5
"""lambda/D by which regions exceed what is as bright as that."""

_POINT_SNR = 5.0
"""S/N of a point source that is significant."""


class ConnectedLight:
    """Brightness of sources, smoothed and opened by lines.

    `snr` (ny, nx) is the light of the source on each pixel over its standard deviation if it were
    alone, and `resolution` lambda/D in pixels. `smoothed` and `opened` have its shape; the beam
    keeps the peak of a point source.
    """

    def __init__(self, snr: Image, resolution: float) -> None:
        self.resolution = resolution
        width = resolution / np.sqrt(8 * np.log(2))
        self.smoothed = 2 * np.pi * width**2 * ndimage.gaussian_filter(snr, width)
        self.opened = self._opening()

    def _opening(self, peak: float = 0.0) -> Image:
        """The opening at every pixel with a point source added there, (ny, nx)."""
        # For every direction, lines of 2 `half` + 1 pixels that contain the pixel: the largest of
        # their smallest values. The profile reaches two half lines to each side, so that it holds
        # all of them.
        half = max(1, round(_HALF_LINE_LAMBDA_D * self.resolution))
        along = np.arange(-2 * half, 2 * half + 1)
        source = peak * np.exp(-4 * np.log(2) * (along / self.resolution) ** 2)
        rows, columns = np.indices(self.smoothed.shape)
        best = np.zeros(self.smoothed.shape)
        for angle in np.pi / _LINE_DIRECTIONS * np.arange(_LINE_DIRECTIONS):
            profiles = [
                ndimage.map_coordinates(
                    self.smoothed,
                    [rows + step * np.sin(angle), columns + step * np.cos(angle)],
                    order=1,
                    mode="nearest",
                )
                + added
                for step, added in zip(along, source, strict=True)
            ]
            faintest = ndimage.minimum_filter1d(profiles, 2 * half + 1, axis=0)
            best = np.maximum(best, faintest[half : 3 * half + 1].max(axis=0))
        return best

    @property
    def is_extended(self) -> Mask:
        """Where light is extended, (ny, nx); nowhere if all of it may be the error of a point."""
        is_extended = self.opened > _OPENING_SHARE * self.smoothed
        least = max(_PEAK_SIGMAS, _BESIDE_POINT * np.where(is_extended, 0, self.smoothed).max())
        return np.asarray(is_extended & (self.opened[is_extended].max(initial=0) > least))

    @property
    def region(self) -> Mask:
        """Where extended light may be, (ny, nx); empty if none is bright enough."""
        labels, _ = ndimage.label(self.opened > _FLOOR_SIGMAS, structure=np.ones((3, 3)))
        return self._with_margin(
            np.isin(labels, np.setdiff1d(labels[self.opened > _PEAK_SIGMAS], 0))
        )

    @property
    def bright(self) -> Mask:
        """Where light is significant, whatever it is, (ny, nx)."""
        return self._with_margin(self.smoothed > _POINT_SNR)

    def _with_margin(self, mask: Mask) -> Mask:
        away = ndimage.distance_transform_edt(~mask) if mask.any() else np.inf
        return np.broadcast_to(away <= _REGION_MARGIN_LAMBDA_D * self.resolution, mask.shape)

    @property
    def hides_points(self) -> Mask:
        """Where a point source of S/N 5 would count as extended light, (ny, nx)."""
        return np.asarray(self._opening(_POINT_SNR) > _OPENING_SHARE * (self.smoothed + _POINT_SNR))


# Extended light about a star: an image of it, and where it comes from.


@dataclass(frozen=True, eq=False)
class Disk:
    """Extended light about a star.

    Attributes
    ----------
    fit : Refinement
        The star, fitted to the frames without the extended light.
    light : tuple of ndarray, (ny, nx)
        The extended light in every frame of the target, as the coronagraph shows it, in the data's
        unit.
    image : ndarray, (ny, nx)
        Frames minus the star, turned to the orientation of the first one and averaged, in the
        data's unit. It has the noise of the data and their resolution; NaN where no frame has a
        valid pixel.
    error : ndarray, (ny, nx)
        Standard deviation of `image` for a known star.
    grid : ndarray, (ny, nx, 2)
        x, y of the first frame's pixels from the star, arcsec.
    offsets : ndarray, (k, 2)
        x, y from the star of the sources that are not zero, arcsec, in the first frame.
    contrasts : ndarray, (k,)
        Their light as a fraction of the star's, before the coronagraph. Empty if there is no
        significant extended light; `light` is then 0.
    hides_points : ndarray of bool, (ny, nx)
        Where a point source of S/N 5 would count as extended light: mostly within two lambda/D of
        it. Limits for point sources do not hold there.
    gain : float
        Decrease of chi-squared by the sources in the frames' first fit, with the star marginalised.

    Examples
    --------
    With frames and OPD maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", disk=True)  # doctest: +SKIP
    >>> result.disk.contrast, result.disk.orientation  # doctest: +SKIP
    """

    fit: Refinement
    light: tuple[Image, ...]
    image: Image
    error: Image
    grid: Image
    offsets: Image
    contrasts: Image
    hides_points: NDArray[np.bool_]
    gain: float

    def __repr__(self) -> str:
        return (
            f"<Disk: {len(self.contrasts)} sources, {self.contrast:.3g} of the star's light, "
            f"chi-squared lower by {self.gain:.4g}>"
        )

    @property
    def contrast(self) -> float:
        """All extended light as a fraction of the star's."""
        return float(self.contrasts.sum())

    @property
    def orientation(self) -> float | None:
        """Position angle of the long axis of the light, degrees east of north, from 0 to 180.

        The axis of the largest second moment of the sources about the star. None if there are no
        sources, or where the orientation of the frames is not known.
        """
        north = self.fit.frames[0].observation.position_angles
        if north is None or not len(self.contrasts):
            return None
        x, y = self.offsets.T
        # Twice the angle, so that both sides of the star count alike.
        doubled = 2 * np.arctan2(-x, y)
        weight = self.contrasts * (x**2 + y**2)
        angle = np.arctan2(weight @ np.sin(doubled), weight @ np.cos(doubled)) / 2
        return float((np.degrees(angle) + north[0]) % 180)

    def plot(self, ax: Any = None) -> NDArray[Any]:
        """Draw the frames without the star, and the extended light in the first one.

        A dashed line in the second encloses where a point source would count as extended light.

        Parameters
        ----------
        ax : two Axes, optional
            Axes to draw in; a new figure by default.

        Returns
        -------
        ndarray of Axes
        """
        axes = drawing.axes_for(ax, 2)
        observation = self.fit.frames[0].observation
        bar, north = drawing.unit_label(observation.unit), observation.north
        limit = float(np.nanpercentile(self.light[0], 99)) or float(np.nanmax(self.error))
        for each, image, title in (
            (axes[0], self.image, "frames without the star"),
            (axes[1], self.light[0], "extended light"),
        ):
            drawing.signed_image(each, image, self.grid, limit, bar=bar, title=title, north=north)
        if self.hides_points.any():
            axes[1].contour(
                *np.moveaxis(drawing.on_sky(self.grid, north), -1, 0), self.hides_points,
                levels=[0.5],
                colors="0.3", linestyles="dashed", linewidths=1,
            )  # fmt: skip
        return np.array(axes)

    @property
    def table(self) -> QTable:
        """The sources: x, y, contrast."""
        x, y = self.offsets.T
        return QTable({"x": x * u.arcsec, "y": y * u.arcsec, "contrast": self.contrasts})

    def write(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write disk.fits; returns its path.

        Its extensions are IMAGE, IMAGE_ERROR, LIGHT (one for every frame), HIDES_POINTS (1 or 0),
        OFFSET_X, OFFSET_Y and the table SOURCES.

        Raises
        ------
        ExistingFileError
            If the file exists, and `overwrite` is False; it is also an `OSError`.
        """
        path = Path(folder) / "disk.fits"
        require_new([path], overwrite)
        first = self.fit.frames[0].observation
        unit, wcs = fits_unit(first.unit), world_coordinates(self.grid, first)
        shown = [each for each in self.fit.frames if not each.observation.reference]
        frames = [each.wcs for each in shown]
        sources = fits.BinTableHDU(self.table, name="SOURCES")
        set_keyword(sources.header, "DRGAIN", self.gain)
        hdus = fits.HDUList(
            [
                primary_hdu(first, self.fit.summary(), Sky.of(self.fit).mjd),
                image_hdu(self.image, "IMAGE", unit, wcs),
                image_hdu(self.error, "IMAGE_ERROR", unit, wcs),
                *(
                    image_hdu(each, "LIGHT", unit, cards, k)
                    for k, (each, cards) in enumerate(zip(self.light, frames, strict=True), 1)
                ),
                image_hdu(np.asarray(self.hides_points, dtype=float), "HIDES_POINTS", "", wcs),
                image_hdu(self.grid[..., 0], "OFFSET_X", "arcsec", wcs),
                image_hdu(self.grid[..., 1], "OFFSET_Y", "arcsec", wcs),
                sources,
            ]
        )
        write_fits(hdus, path)
        return path


Pixels = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Rows and columns."""

_log = logging.getLogger(__name__)

_SPACING_PIXELS = 2
"""Distance of neighbouring sources over the whole field, pixels: about lambda/D in NIRCam's
long-wave filters. A simulated ring that was fitted by sources so far apart, without those at every
pixel, left a chi-squared of 2.2 per pixel, and of 1.05 with them."""

_SOURCE_SIGMAS = 1.0
"""Standard deviations that a source has to exceed."""

_DISK_CHI2_PER_SOURCE = 4.0
"""Decrease of chi-squared per source below which it is noise: it was 1.9 for a simulated star
without a disk, and 11 to 26 for stars with one."""


def fit_disk(fit: Refinement, *, inner: float = 0.25, progress: bool = False) -> Disk:
    """Fit extended light about a star together with the star.

    The light may have any shape, but not be negative. What is symmetric about the star, or seen in
    a single roll, is told from the star only by the prior on its wavefront: two rolls or more are
    best. Sources that are dark 1.5 lambda/D away in all directions are no part of it: pass the
    attributes `fit` and `hides_points` of the result to `detect` to search for them.

    Parameters
    ----------
    fit : Refinement
        Fit of the target. The result's own fit has no companions: they are in its data.
    inner : float or Quantity
        Smallest separation of sources, arcsec.
    progress : bool
        Show progress bars.

    Returns
    -------
    Disk

    Raises
    ------
    IncompatibleSetupError
        For a fit that failed, that has no linear model, or that shows no target, or if `inner` is
        not positive.

    Examples
    --------
    A star without a disk has no extended light:

    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> frame = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=4))
    >>> dr.detection.fit_disk(fit).contrast
    0.0
    """
    inner = float(to_arcsec(inner, "inner"))
    require_positive(inner=inner)
    if not fit.status.usable:
        raise IncompatibleSetupError(f"fit_disk: the fit ended as {fit.status}")
    original = [frame.observation for frame in fit.frames]
    sources = _fit_sources(fit, _positions(fit.frames[0].grid, inner))
    gain, extended = sources.gain, None
    if gain >= _DISK_CHI2_PER_SOURCE * len(sources):
        with ProgressBar("disk", shown=progress) as bar:
            extended = _extended(fit, sources, inner, original, bar)
    if extended is None:
        _log.info("no extended light: %s", sources)
    fit, sources = extended or (fit, sources.dark())
    image, error = _combined(fit, sources, original)
    is_lit = sources.contrasts > 0
    return Disk(
        fit=fit,
        light=tuple(sources.light[k] for k in sorted(sources.light)),
        image=image,
        error=error,
        grid=sources.templates.grid,
        offsets=sources.offsets[is_lit],
        contrasts=sources.contrasts[is_lit],
        hides_points=sources.connected.hides_points,
        gain=gain,
    )


def _extended(
    fit: Refinement,
    sources: _Sources,
    inner: float,
    original: Sequence[Observation],
    bar: ProgressBar,
) -> tuple[Refinement, _Sources] | None:
    """The star without extended light, and the sources of that light; None if there is none.

    `fit` and `sources` are of the star together with all light, `inner` is in arcsec, and
    `original` are the frames of the fit.
    """
    bar.update(sources=len(sources))
    fit = without_light(fit, sources.light, original)
    sources = _fit_sources(fit, sources.pixels, sources)
    light, outside = sources.connected, separation_of(sources.templates.grid) >= inner
    region = light.region & outside
    if not region.any():
        return None
    rows, columns = np.nonzero(region | (light.bright & outside))
    # The star first without point sources, whose light it would take up.
    for only_extended in (False, True):
        sources = _fit_sources(fit, (rows, columns), sources, only_extended)
        bar.update(sources=len(sources))
        if not len(sources):
            return None
        fit = without_light(fit, sources.light, original)
    return fit, sources


@dataclass(frozen=True, eq=False)
class _Sources:
    """Non-negative sources on a grid."""

    templates: Templates
    pixels: Pixels  # Rows and columns, (k,) each.
    contrasts: Image  # (k,).
    errors: Image  # (k,), standard deviations of the contrasts, each source alone.
    flux: float  # Flux of the star, to which contrasts are relative.
    light: dict[int, Image]  # (ny, nx) by frame.
    # Decrease of chi-squared with respect to earlier sources on the same pixels, if any.
    gain: float

    def __len__(self) -> int:
        return int((self.contrasts > 0).sum())

    @property
    def offsets(self) -> Image:
        """x, y from the star, arcsec, (k, 2)."""
        return np.asarray(self.templates.grid[self.pixels])

    @property
    def connected(self) -> ConnectedLight:
        """Which of the light is extended."""
        grid = self.templates.grid
        snr = np.zeros(grid.shape[:2])
        snr[self.pixels] = self.contrasts / self.errors
        return ConnectedLight(snr, self.templates.fit.model.resolution / pixel_width(grid))

    def __str__(self) -> str:
        return (
            f"{len(self)} sources, {self.contrasts.sum():.3g} of the star's light, chi-squared "
            f"lower by {self.gain:.4g}"
        )

    def dark(self) -> _Sources:
        """Return the sources without light."""
        light = {k: np.zeros_like(each) for k, each in self.light.items()}
        return replace(self, contrasts=np.zeros_like(self.contrasts), light=light)


def _fit_sources(
    fit: Refinement, pixels: Pixels, start: _Sources | None = None, only_extended: bool = False
) -> _Sources:
    """Sources in the frames of a fit, to which the light of `start` is added again.

    With `only_extended`, point sources are left out after the fit.
    """
    templates = Templates(fit)
    linear = templates.linear
    images = templates.at_pixels(*pixels)
    flux, before = fit.frames[0].flux, np.zeros(len(pixels[0]))
    if start is not None:
        # The star was fitted without this light, which is added to the data again.
        linear = linear.without("companions", start.light)
        if all(map(np.array_equal, start.pixels, pixels)):
            before = start.contrasts * (start.flux / flux)
    matrix, vector = (each.numpy() for each in linear.normal_equations(images))
    errors = matrix.diagonal().clip(min=1e-300) ** -0.5
    contrasts = _brightest(matrix, vector, before)
    sources = _Sources(templates, pixels, contrasts, errors, flux, {}, 0.0)
    if only_extended:
        contrasts = np.where(sources.connected.is_extended[pixels], contrasts, 0.0)
    light = {k: np.tensordot(contrasts, each.double().numpy(), 1) for k, each in images.items()}
    gain = _gain(matrix, vector, contrasts) - _gain(matrix, vector, before)
    sources = replace(sources, contrasts=contrasts, light=light, gain=gain)
    _log.info("extended light: %s", sources)
    return sources


def _positions(grid: Image, inner: float) -> Pixels:
    """Rows and columns of the pixels on which sources are."""
    # The last ones, too, because the light of a disk goes on beyond the frame.
    axes = (np.unique(np.append(np.arange(0, n, _SPACING_PIXELS), n - 1)) for n in grid.shape[:2])
    rows, columns = (each.ravel() for each in np.meshgrid(*axes, indexing="ij"))
    outside = separation_of(grid)[rows, columns] >= inner
    return rows[outside], columns[outside]


def _brightest(
    matrix: Image, vector: Image, start: Image, threshold: float = _SOURCE_SIGMAS
) -> Image:
    """The non-negative light that minimises the sum at the top of this module, (k,)."""
    # In units of each source's standard deviation: x C x / 2 - (g - s) x, with the threshold s and
    # the slope C x - g + s.
    scale = np.sqrt(matrix.diagonal().clip(min=1e-300))
    curvature, gradient = matrix / scale[:, None] / scale, vector / scale

    def target(light: Image) -> tuple[float, Image]:
        slope = curvature @ light - gradient + threshold
        return float(light @ (slope + threshold - gradient) / 2), slope

    solved = minimize(target, start * scale, jac=True, method="L-BFGS-B",
                      bounds=[(0, None)] * len(scale), options={"maxiter": 2000})  # fmt: skip
    return np.asarray(solved.x / scale)


def _gain(matrix: Image, vector: Image, light: Image) -> float:
    """Decrease of chi-squared by the light of sources."""
    return float(2 * vector @ light - light @ matrix @ light)


def _combined(
    fit: Refinement, sources: _Sources, original: Sequence[Observation]
) -> tuple[Image, Image]:
    """Frames minus the star, turned onto the first one and averaged, and the errors."""
    templates = sources.templates
    images, errors = {}, {}
    for k, light in sources.light.items():
        frame = original[k].combined()
        valid = frame.valid[0]
        images[k] = np.where(valid, frame.data[0] - fit.frames[k].star, light)
        errors[k] = np.where(valid, frame.error[0], np.inf)
    return combine_frames(templates, images, errors, templates.grid)
