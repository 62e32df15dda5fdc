"""Extended light about a star, such as a disk: non-negative sources fitted with the star.

With the star marginalised as for point sources, the light a of sources on a grid of positions
minimises

    a^T M a / 2 - v^T a + s sum_j a_j / sigma_j,    a >= 0,

where M and v are the normal equations of the sources' images and sigma_j is the standard deviation
of source j alone. Frames of several rolls share the sources, which turn with the sky, while the
star stays. The last term, a threshold of s standard deviations, keeps sources at zero that only
noise asks for.

The light of a disk biases the star that was fitted without it, beyond the range of the linear
model. So the star is fitted again without that light, until the sources hardly change.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pyklip_diffrender.detection.combination import combine_frames
from pyklip_diffrender.detection.disk import Disk
from pyklip_diffrender.detection.field import Image, separation_of
from pyklip_diffrender.detection.groups import groups_of, has_only_reference_stars
from pyklip_diffrender.detection.relinearise import without_light
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.io.units import require_positive, to_arcsec
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.observation import Observation

__all__ = ["fit_disk"]

_log = logging.getLogger(__name__)

_SPACING = 2
"""Distance of neighbouring sources, pixels: about lambda/D in NIRCam's long-wave filters."""

_THRESHOLD = 1.0
"""Standard deviations that a source has to exceed."""

_ROUNDS = 2
"""Largest number of times that the star is fitted again."""

_SIGNIFICANT = 4.0
"""Decrease of chi-squared per source below which it is noise: it was 1.9 for a simulated star
without a disk, and 11 to 26 for stars with one."""

_GAIN = 0.02
"""Decrease of chi-squared per pixel below which the star is not fitted again."""


def fit_disk(fit: Refinement, *, inner: float = 0.25, progress: bool = False) -> Disk:
    """Fit extended light about a star together with the star.

    The light may have any shape, but not be negative. What is symmetric about the star, or seen in
    a single roll, is told from the star only by the prior on its wavefront: two rolls or more are
    best. Planets are part of the extended light, too: `detect` them without it first.

    Parameters
    ----------
    fit : Refinement
        Of the target. Its companions become part of the extended light.
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
        raise IncompatibleSetupError(f"fit_disk: the fit {fit.status.message}")
    if has_only_reference_stars(fit):
        raise IncompatibleSetupError(
            "fit_disk: expected frames of the target, got a reference star"
        )
    original = [frame.observation for frame in fit.frames]
    with ProgressBar("disk", shown=progress) as bar:
        sources = _fit_sources(fit, inner)
        first, gain = sources.gain, sources.gain
        if gain < _SIGNIFICANT * len(sources):
            _log.info("no extended light: %s", sources)
            sources, gain = sources.dark(), 0.0
        pixels = sum(int(original[k].combined().valid.sum()) for k in sources.light)
        for _ in range(_ROUNDS):
            bar.update(sources=len(sources))
            if gain < _GAIN * pixels:
                break
            fit = without_light(fit, sources.light, original)
            sources = _fit_sources(fit, inner, sources)
            gain = sources.gain
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
        gain=first,
    )


@dataclass(frozen=True, eq=False)
class _Sources:
    """Non-negative sources on a grid.

    Attributes
    ----------
    templates : Templates
    pixels : tuple of ndarray, (k,)
        Rows and columns.
    contrasts : ndarray, (k,)
    flux : float
        Flux of the star, to which contrasts are relative.
    light : dict of int to ndarray, (ny, nx)
        By frame.
    gain : float
        Decrease of chi-squared with respect to the sources from which these were fitted.
    """

    templates: Templates
    pixels: tuple[NDArray[np.int64], NDArray[np.int64]]
    contrasts: Image
    flux: float
    light: dict[int, Image]
    gain: float

    def __len__(self) -> int:
        return int((self.contrasts > 0).sum())

    @property
    def offsets(self) -> Image:
        """x, y from the star, arcsec, (k, 2)."""
        return np.asarray(self.templates.grid[self.pixels])

    def __str__(self) -> str:
        return (
            f"{len(self)} sources, {self.contrasts.sum():.3g} of the star's light, chi-squared "
            f"lower by {self.gain:.4g}"
        )

    def dark(self) -> _Sources:
        """Return the sources without light."""
        light = {k: np.zeros_like(each) for k, each in self.light.items()}
        return replace(self, contrasts=np.zeros_like(self.contrasts), light=light)


def _fit_sources(fit: Refinement, inner: float, start: _Sources | None = None) -> _Sources:
    """Sources in the frames of a fit, to which the light of `start` is added again."""
    ((linear, templates),) = groups_of([fit])
    # The same pixels in every round, although the star moves a little and with it their distances.
    pixels = _positions(templates.grid, inner) if start is None else start.pixels
    images = templates.at_pixels(*pixels)
    flux, before = fit.frames[0].flux, np.zeros(len(pixels[0]))
    if start is not None:
        linear = linear.without("companions", start.light)
        before = start.contrasts * (start.flux / flux)
    matrix, vector = (each.numpy() for each in linear.normal_equations(images))
    contrasts = _brightest(matrix, vector, before)
    light = {k: np.tensordot(contrasts, each.double().numpy(), 1) for k, each in images.items()}
    gain = _gain(matrix, vector, contrasts) - _gain(matrix, vector, before)
    sources = _Sources(templates, pixels, contrasts, flux, light, gain)
    _log.info("extended light: %s", sources)
    return sources


def _positions(grid: Image, inner: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
