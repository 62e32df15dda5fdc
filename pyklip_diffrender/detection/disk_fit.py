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
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pyklip_diffrender.detection.combination import combine_frames
from pyklip_diffrender.detection.connected_light import ConnectedLight
from pyklip_diffrender.detection.disk import Disk
from pyklip_diffrender.detection.field import Image, pixel_width, separation_of
from pyklip_diffrender.detection.groups import groups_of, has_only_reference_stars
from pyklip_diffrender.detection.relinearise import without_light
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.io.units import require_positive, to_arcsec
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.observation import Observation

__all__ = ["fit_disk"]

Pixels = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Rows and columns."""

_log = logging.getLogger(__name__)

_SPACING = 2
"""Distance of neighbouring sources over the whole field, pixels: about lambda/D in NIRCam's
long-wave filters. A simulated ring that was fitted by sources so far apart, without those at every
pixel, left a chi-squared of 2.2 per pixel, and of 1.05 with them."""

_THRESHOLD = 1.0
"""Standard deviations that a source has to exceed."""

_SIGNIFICANT = 4.0
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
        Of the target. The result's own has no companions: they are in its data.
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
    >>> opd = dr.random_opd(1, npix=128)
    >>> frame = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frame, opd, settings=dr.GaussNewton(cycles=4))
    >>> dr.fit_disk(fit).contrast
    0.0
    """
    inner = float(to_arcsec(inner, "inner"))
    require_positive(inner=inner)
    if not fit.status.usable:
        raise IncompatibleSetupError(f"fit_disk: the fit ended as {fit.status}")
    if has_only_reference_stars(fit):
        raise IncompatibleSetupError(
            "fit_disk: expected frames of the target, got a reference star"
        )
    original = [frame.observation for frame in fit.frames]
    sources = _fit_sources(fit, _positions(fit.frames[0].grid, inner))
    gain, extended = sources.gain, None
    if gain >= _SIGNIFICANT * len(sources):
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

    Parameters
    ----------
    fit : Refinement
        The star together with all light.
    sources : _Sources
        Of all light.
    inner : float
        arcsec.
    original : sequence of Observation
        The frames of the fit.
    bar : ProgressBar
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
    """Non-negative sources on a grid.

    Attributes
    ----------
    templates : Templates
    pixels : tuple of ndarray, (k,)
        Rows and columns.
    contrasts : ndarray, (k,)
    errors : ndarray, (k,)
        Standard deviations of the contrasts, each source alone.
    flux : float
        Flux of the star, to which contrasts are relative.
    light : dict of int to ndarray, (ny, nx)
        By frame.
    gain : float
        Decrease of chi-squared with respect to earlier sources on the same pixels, if any.
    """

    templates: Templates
    pixels: Pixels
    contrasts: Image
    errors: Image
    flux: float
    light: dict[int, Image]
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

    With `only_extended`, those that are point sources are left out after the fit.
    """
    ((linear, templates),) = groups_of([fit])
    images = templates.at_pixels(*pixels)
    flux, before = fit.frames[0].flux, np.zeros(len(pixels[0]))
    if start is not None:
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
    axes = (np.unique(np.append(np.arange(0, n, _SPACING), n - 1)) for n in grid.shape[:2])
    rows, columns = (each.ravel() for each in np.meshgrid(*axes, indexing="ij"))
    outside = separation_of(grid)[rows, columns] >= inner
    return rows[outside], columns[outside]


def _brightest(matrix: Image, vector: Image, start: Image, threshold: float = _THRESHOLD) -> Image:
    """The non-negative light that minimises the sum at the top of this module, (k,)."""
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
