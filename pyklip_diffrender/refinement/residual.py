"""Point sources in the residual of a fit, and bad pixels that the file does not flag."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter
from torch import Tensor

from pyklip_diffrender.instrument.masks import BEYOND_MASK_ARCSEC
from pyklip_diffrender.linear.model import LinearModel, TemplateProducts
from pyklip_diffrender.optics.grid import fft_convolve
from pyklip_diffrender.refinement.forward import Objective, State, pixel_grid
from pyklip_diffrender.scene.objects import Planet


def local_maxima(
    image: NDArray[np.float64], allowed: NDArray[np.bool_], threshold: float, *, size: int
) -> list[tuple[int, int]]:
    """Row and column of the `allowed` pixels above a threshold that are the maximum of a square.

    `image` is (ny, nx), NaN where unknown; the square about a pixel has the side `size`. The
    highest maximum is first.
    """
    filled = np.where(np.isnan(image), -math.inf, image)
    peaks = (filled == maximum_filter(filled, size=size)) & allowed & (filled > threshold)
    places = np.argwhere(peaks)[np.argsort(-filled[peaks], kind="stable")]
    return [(int(row), int(column)) for row, column in places]


# Bright companions in the residual of a fit.
#
# A companion as bright as the speckles of the star biases the fitted wavefront. A companion that is
# significant in the residual therefore gets its own parameters. Faint planets are found by the
# detection, which marginalises the wavefront.

INNER = 0.35
"""arcsec; closer to the star, the occulter distorts images and the star's errors dominate."""

_PEAK_FROM_COMPANION_ARCSEC = 0.15
"""arcsec, about lambda/D; closer to a known companion, peaks are its own residuals."""


class _Matched(NamedTuple):
    """Sums of a matched filter over the pixels of one frame, at the places of all its pixels.

    With the residual r and the image t of a point source at a place, the contrast

        a = sum(r t / sigma^2) / sum(t^2 / sigma^2)

    minimises chi-squared, and its error is the inverse square root of the denominator.
    """

    numerator: NDArray[np.float64]  # (ny, nx)
    information: NDArray[np.float64]
    grid: NDArray[np.float64]  # (ny, nx, 2), x and y from the star, arcsec

    def at(self, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Both sums at places, (..., 2), between pixels; 0 beyond them."""
        first, steps = self.grid[0, 0], self.grid[[0, 1], [1, 0]] - self.grid[0, 0]
        column, row = np.moveaxis((places - first) @ np.linalg.inv(steps), -1, 0)
        numerator, information = (
            map_coordinates(each, [row, column], order=1)
            for each in (self.numerator, self.information)
        )
        return numerator, information


def _matched(objective: Objective, state: State, k: int, kappa: float) -> _Matched:
    """The matched filter of a point source on the residual of frame `k`."""
    point, forward = state.points[k], objective.forwards[k]
    unknowns, problem, model = point.unknowns, forward.problem, forward.coarse
    residual = torch.where(problem.valid, problem.data - point.total, 0.0).cpu().numpy()
    sigma = torch.where(problem.valid, objective.sigma(k, point, kappa), math.inf).cpu().numpy()
    values = unknowns.values(point.vector)
    star = values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu()
    # The template is an image in the middle of the array of a source beyond the mask.
    displacement = torch.tensor(BEYOND_MASK_ARCSEC, dtype=torch.float64)
    centred = {
        **values,
        "star_offset": star + displacement,
        "detector_shift": -(star + displacement),
    }
    with torch.no_grad():
        image = model(forward.coarse_opd(point), **centred).double().cpu().numpy()
    template = unknowns.level("flux", point.vector) * image[::-1, ::-1]
    weight = sigma**-2.0
    # Convolution with the reversed template has the sums at all places.
    return _Matched(
        numerator=fft_convolve(residual * weight, template),
        information=np.maximum(fft_convolve(weight, template**2), 0.0),
        grid=pixel_grid(model, values),
    )


def bright_companions(
    objective: Objective,
    state: State,
    kappa: float,
    *,
    most: int,
    threshold: float,
    inner: float = INNER,
) -> list[Planet]:
    """Find at most `most` point sources in the residuals of all frames of the target.

    Highest S/N first, at the positions of pixels of the first one, in the orientation of the fit.
    `threshold` is the smallest S/N, in units of the scatter (median absolute deviation) of the S/N
    map, further than `inner` arcsec from the star.
    """
    shown = [k for k, each in enumerate(state.unknowns.frames) if each.shows_companions]
    if most < 1 or not shown:
        return []
    first, unknowns = shown[0], state.points[shown[0]].unknowns
    sums = _matched(objective, state, first, kappa)
    numerator, information = sums.numerator.copy(), sums.information.copy()
    places = sums.grid
    # Sources turn with the sky from one roll to the next, and errors of the star's model do not.
    for k in shown[1:]:
        turn = (state.points[k].unknowns.turn @ unknowns.turn.T).numpy()
        more = _matched(objective, state, k, kappa).at(places @ turn.T)
        numerator += more[0]
        information += more[1]
    snr = numerator / np.sqrt(np.maximum(information, 1e-300))
    valid = objective.forwards[first].problem.valid.cpu().numpy()
    allowed = (np.hypot(places[..., 0], places[..., 1]) > inner) & valid
    positions = unknowns.sources(state.points[first].vector)[:, 1:] @ unknowns.turn.T
    for known in positions.numpy():
        allowed &= np.hypot(*np.moveaxis(places - known, -1, 0)) > _PEAK_FROM_COMPANION_ARCSEC
    if not allowed.any():  # The frames do not reach beyond `inner`.
        return []
    scatter = 1.4826 * float(np.median(np.abs(snr[allowed] - np.median(snr[allowed]))))
    return [
        Planet.from_offset(
            float(numerator[peak] / information[peak]), *map(float, places[peak])
        ).rotated(-unknowns.roll)
        for peak in local_maxima(snr, allowed, threshold * scatter, size=7)[:most]
    ]


def with_dominant(objective: Objective, state: State, kappa: float) -> State:
    """Add the most significant companion, with levels that follow from star and companion together.

    The state is one whose companion may outshine what the mask leaves of the star, so that its
    levels are wrong.
    """
    added = bright_companions(objective, state, kappa, most=1, threshold=0.0)
    if not added or state.flux <= 0:
        return state
    unknowns, vector = state.unknowns.with_companions(added, state.vector)
    points = objective.at(unknowns, vector).points
    problems = [forward.problem for forward in objective.forwards]
    stars = [problem.gain * point.image for problem, point in zip(problems, points, strict=True)]
    companions = [
        (point.total - before.total)
        / (before.unknowns.level("flux", before.vector) * added[0].contrast)
        for point, before in zip(points, state.points, strict=True)
    ]
    k = [each.shows_companions for each in unknowns.frames].index(True)
    valid = problems[k].valid
    # Least squares of d = F star + L companion + b, in which no noise is assumed, have the flux F
    # and the contrast L / F.
    columns = torch.stack([stars[k], companions[k], torch.ones_like(stars[k])])[:, valid]
    flux, light, _ = torch.linalg.lstsq(columns.T, problems[k].data[valid]).solution.tolist()
    if min(flux, light) <= 0:
        return state
    vector = vector.clone()
    vector[unknowns.where("companions")][-3] = light / flux
    for frame, part, problem, star, companion in zip(
        unknowns.frames, unknowns.rows, problems, stars, companions, strict=True
    ):
        free = set(frame.linear) - set(frame.deviations)
        names = tuple(name for name in ("flux", "background") if name in free)
        flat = torch.full_like(problem.sigma, float(problem.sigma.median()))
        levels = problem.flux_and_background(star + light / flux * companion, flat, names)
        for name, level in zip(("flux", "background"), levels, strict=True):
            if name in names:
                vector[part.rows[frame.where(name)]] = level
    return objective.at(unknowns, vector)


# Bad pixels that the file does not flag.
#
# A hot pixel that stands out of the star's image looks like a point source to a matched filter, and
# in one roll nothing else tells them apart. Its neighbours do: a point source lights several
# pixels. Two hypotheses are therefore compared for every pixel that deviates, with the star
# marginalised in both: that it alone is wrong, and that a point source is near it. Near a companion
# of the fit they are compared twice: in place of the companion, which may be the bad pixel itself,
# and beside it.

_OUTLIER_SIGMAS = 6.0
"""Deviation of an outlier in standard deviations, of the prediction from all other pixels."""

_OUTLIER_CHI2_RATIO = 1.3
"""Smallest ratio of the chi-squared explained by an outlier and by a point source. The ratio was 4
to 30 for bad pixels of NIRCam. For the brightest pixel of a planet it is below 0.2 in F444W, and
cannot exceed 1, which it approaches where the image of a point is as sharp as a pixel."""

_OUTLIER_CONTRIBUTION_SIGMAS = 2.0
"""Smallest contribution of an outlier to Sigma^-1 r, which is less than the outlier's deviation
where the fit has taken a part of it."""

_OUTLIER_BESIDE_COMPANION_PIXELS = 2.0
"""Pixels between an outlier and a companion that may be nothing but the outlier."""

_OUTLIER_COMPANION_RATIO = 0.3
"""Smallest deviation of an outlier beside such a companion, relative to the companion's brightest
pixel. The model of the companion's image may be wrong by more than the noise, and a second source
would explain that no better than a single pixel."""

_MOST_COMPARED_PIXELS = 50
"""Largest number of pixels of a frame that are compared, largest deviation first."""


def isolated_outliers(objective: Objective, state: State, linear: LinearModel) -> list[Tensor]:
    """Find pixels that deviate while their neighbours do not: a mask, (ny, nx), for each frame.

    `linear` is about the state, with the full weights of all pixels.
    """
    companions = {k: (point.total - point.star).cpu() for k, point in enumerate(state.points)}
    star_only: LinearModel | None = None
    outliers = []
    for k, (forward, point) in enumerate(zip(objective.forwards, state.points, strict=True)):
        unknowns = point.unknowns
        grid = torch.from_numpy(pixel_grid(forward.model, unknowns.values(point.vector)))
        scale = torch.tensor(forward.model.detector.pixelscale, dtype=torch.float64)
        companions_at = unknowns.sources(point.vector)[:, 1:] @ unknowns.turn.T
        # The rival of a bad pixel is a point source at any of 25 places within a pixel of it.
        steps = torch.linspace(-1.0, 1.0, 5, dtype=torch.float64)
        beside = torch.cartesian_prod(steps, steps) * scale
        mask = torch.zeros(grid.shape[:2], dtype=torch.bool)
        for row, column in _deviating(linear, k):
            place = grid[row, column]
            distances = ((companions_at - place) / scale).norm(dim=1)
            pixel = torch.tensor([[row, column]])
            sources = {k: forward.sources(point, place + beside).cpu()}
            models = [linear]
            if bool((distances < _OUTLIER_BESIDE_COMPANION_PIXELS).any()):
                if star_only is None:
                    star_only = linear.without("companions", companions)
                light = companions[k][max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
                products = linear.weigh_pixels(k, pixel)
                amplitude = products.numerator / products.information.clamp(min=1e-300)
                exceeds = float(amplitude.abs()) > _OUTLIER_COMPANION_RATIO * float(light.max())
                models = [star_only, linear] if exceeds else [star_only]
            mask[row, column] = any(
                bool(
                    _explained(model.weigh_pixels(k, pixel))
                    > _OUTLIER_CHI2_RATIO * _explained(model.weigh(sources)).max()
                )
                for model in models
            )
        outliers.append(mask)
    return outliers


def _deviating(linear: LinearModel, k: int) -> list[tuple[int, int]]:
    """Row and column of pixels that deviate more than their neighbours, largest deviation first."""
    cleaned = linear.cleaned[k]
    places = torch.nonzero(cleaned.abs() > _OUTLIER_CONTRIBUTION_SIGMAS)
    if not len(places):
        return []
    deviations = torch.zeros_like(cleaned)
    explained = _explained(linear.weigh_pixels(k, places))
    deviations[places[:, 0], places[:, 1]] = explained.sqrt()
    peaks = local_maxima(deviations.numpy(), deviations.numpy() > 0, _OUTLIER_SIGMAS, size=3)
    return peaks[:_MOST_COMPARED_PIXELS]


def _explained(products: TemplateProducts) -> Tensor:
    """Decrease of chi-squared by each template, (templates,)."""
    # The amplitude a = p . Sigma^-1 r / p . Sigma^-1 p lowers chi-squared by a^2 p . Sigma^-1 p.
    return products.numerator**2 / products.information.clamp(min=1e-300)
