"""Search for point sources in refined frames."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pyklip_diffrender.detection.candidates import (
    Candidates,
    Maps,
    count_rolls,
    lacks_candidates,
    refine_candidates,
    with_companions,
    with_position_of_star,
)
from pyklip_diffrender.detection.error_factor import (
    ErrorFactor,
    Significance,
    contrast_table,
    structures_in_single_roll,
)
from pyklip_diffrender.detection.field import (
    Image,
    Sky,
    curve_separations,
    far_from,
    pixel_width,
    reaching,
    ring_pixels,
    separation_of,
)
from pyklip_diffrender.detection.measurement import chi2_by_ring, significance_of
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import require_positive, to_arcsec
from pyklip_diffrender.refinement import Refinement, Status
from pyklip_diffrender.refinement.residual import local_maxima

# Candidates that are side lobes of a source nearer to the star than the search goes.
#
# Such a source can end a fit at a wrong wavefront, whose residuals elsewhere look like planets.


def side_lobes(
    maps: Maps,
    snr: Image,
    candidates: Candidates,
    factor: ErrorFactor,
    threshold: float,
    inner: float,
) -> Tensor:
    """Which candidates are not significant beside a source within the inner limit, (k,).

    `snr` (ny, nx) is without the candidates, before errors are multiplied by the factor;
    `threshold` is for Gaussian noise, and `inner` the smallest separation of candidates,
    arcsec.
    """
    none = torch.zeros(len(candidates), dtype=torch.bool)
    if not len(candidates):
        return none
    # The source starts at the highest peak there, is fitted together with the candidates, and must
    # be significant beside them. A planet keeps its S/N, because the two images differ.
    scaled = np.where(separation_of(maps.grid) < inner, snr / factor.of(maps.grid), -np.inf)
    peak = np.unravel_index(np.nanargmax(scaled), scaled.shape)
    contrast = float(snr[peak] / np.sqrt(maps.information[peak]))
    both = candidates.with_one_more(maps.grid[peak], contrast)
    both = refine_candidates(maps.templates, both, pixel_width(maps.grid) / 2)
    sigmas = both.snr(factor)
    # The map has less of a source between pixels, and of one that the candidates stand for.
    if separation_of(both.offsets.numpy())[-1] >= inner or sigmas[-1] < threshold:
        return none
    return torch.from_numpy(sigmas[:-1] < factor.threshold(threshold, candidates.offsets))


# Planets that have bent the wavefront of a fit so far that the search does not list them.
#
# A planet that is missing in the model of a fit can end it at a wrong wavefront, whose residuals
# hide the planet and can look like another one. Such fits do not explain their data, even with the
# candidates of a search. The highest peaks of the S/N that are left, without the factor that their
# own scatter has raised, are then tried as companions.

_log = logging.getLogger(__name__)

_MOST_TRIED_PEAKS = 3
"""Largest number of peaks that are tried, each with a fit of its own."""

_SUBTRACTION_RESIDUAL_PIXELS = 2.0
"""Pixels between a candidate and a peak that is not what its subtraction left."""

_TRIED_PEAK_SNR = 5.0
"""S/N of a peak that is tried, without a factor."""

_COMPANION_CHI2_RATIO = 0.9
"""Largest ratio of chi-squared with to without a companion. A planet that ends a fit at a
wrong wavefront dominates chi-squared; errors of the model do not go away with one companion."""

_UNEXPLAINED = (Status.MODEL_MISMATCH, Status.ITERATION_LIMIT)


def with_raised_peaks(
    maps: Maps, candidates: Candidates, inner: float, progress: bool = False
) -> Refinement | None:
    """Refine the star again with the candidates and one of the highest peaks as companions.

    The fit has the companion that lowers chi-squared most, or the first that explains
    the data. None if none lowers it enough, or if the fit of the maps explains its data already.
    """
    fit = maps.templates.fit
    if not _unexplained(fit):
        return None
    snr = maps.snr(maps.without(candidates))
    allowed = reaching(maps.grid, inner)
    allowed &= far_from(
        maps.grid, candidates.offsets, _SUBTRACTION_RESIDUAL_PIXELS * pixel_width(maps.grid)
    )
    best, least = None, _COMPANION_CHI2_RATIO * fit.chi2_per_pixel
    for peak in local_maxima(snr, allowed, _TRIED_PEAK_SNR, size=7)[:_MOST_TRIED_PEAKS]:
        contrast = float(snr[peak] / np.sqrt(maps.information[peak]))
        tried = candidates.with_one_more(maps.grid[peak], contrast)
        refined = with_companions(fit, tried, progress)
        chi2 = refined.chi2_per_pixel
        _log.info("a companion at %s lowers chi-squared to %.3g", maps.grid[peak], chi2)
        if refined.status.usable and chi2 < least:
            best, least = refined, chi2
            if not _unexplained(best):
                break
    return best


def _unexplained(fit: Refinement) -> bool:
    return fit.status in _UNEXPLAINED and fit.chi2_per_pixel > 1


_MAX_CANDIDATES = 10
"""Largest number of candidates. More of them about one star are parts of something extended, and
all positions are fitted again with every one that is added."""

_POSITION_STEPS = 6
"""Largest number of steps of the positions while candidates are added or dropped. Point sources
settle in these; parts of something extended do not, and would take most of the time."""

_HIDDEN_PEAK_THRESHOLD_RATIO = 0.8
"""Part of the threshold above which a peak in several rolls is tried as a candidate though its S/N
is below: the side lobes of a source raise the scatter by which it is judged. In a single roll, the
light of structures of the detector would pass."""


@dataclass(frozen=True)
class _Outcome:
    """Candidates of one search, in the order in which they were found, and the maps of the fit."""

    maps: Maps
    candidates: Candidates
    factor: ErrorFactor
    significance: Significance


def detect(
    fit: Refinement,
    *,
    threshold: float = 5.0,
    inner: float = 0.2,
    scatter: float | None = None,
    separations: ArrayLike | None = None,
    without_limits: NDArray[np.bool_] | None = None,
    relinearise: float = 25.0,
    progress: bool = False,
) -> Detection:
    """Look for point sources in refined frames.

    Parameters
    ----------
    fit : Refinement
        Of all frames of the target that are searched together.
    threshold : float
        S/N above which a source is a candidate in Gaussian noise. Where errors are scaled to the
        scatter of the S/N, the S/N must be higher, so that noise exceeds it as rarely.
    inner : float or Quantity
        Smallest separation of candidates, arcsec.
    scatter : float, optional
        Factor by which all errors are multiplied. By default it is the square root of the reduced
        chi-squared with the candidates removed if the fit explains its data, and at least 1. On
        real frames, and if it does not explain its data, it is the standard deviation of the
        S/N away from candidates if that is larger, which depends on the star's light in the pixels
        and on the separation (see `ErrorFactor`): errors of the model that neighbouring pixels
        share do not show in chi-squared.
    separations : array or Quantity, optional
        Separations of the contrast curve, arcsec. Default every 0.1 from 0.2 to the nearest edge.
    without_limits : ndarray of bool, (ny, nx), optional
        Pixels of the first frame that the contrast curve leaves out: see ``hides_points`` of
        `Disk`. Separations without a pixel left have no row.
    relinearise : float
        S/N of a candidate above which the star is refined again with the candidates in the model,
        because bright sources bias the wavefront about which the model is linearised. Where the fit
        does not explain its data, any candidate may be the reason, and `threshold` is used instead.
    progress : bool
        Show progress bars.

    Returns
    -------
    Detection

    Raises
    ------
    IncompatibleSetupError
        For several fits, for a fit that failed or was read without its linear model, for a fit
        whose first frame is of a reference star, for a threshold or separation that is not
        positive, or if `without_limits` has another shape than the first frame.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> scene = dr.Scene(planets=(dr.Planet(1e-5, 0.6, 120.0),))
    >>> frames = dr.simulate(model, scene, opd, seed=3)
    >>> fit = dr.refine(model, frames, opd, settings=dr.FitSettings(cycles=6))
    >>> len(dr.detect(fit).candidates)
    1
    """
    fit = _checked(fit)
    inner = float(to_arcsec(inner, "inner"))
    require_positive(threshold=threshold, inner=inner, scatter=scatter)
    if without_limits is not None:
        _require_shape(np.shape(without_limits), fit.frames[0].grid.shape[:2])

    outcome = _searched(fit, threshold, inner, scatter, relinearise, progress)
    return _detection(outcome, threshold, separations, without_limits)


def _searched(
    fit: Refinement,
    threshold: float,
    inner: float,
    scatter: float | None,
    relinearise: float,
    progress: bool,
) -> _Outcome:
    """The last search, with the star refined beside bright candidates; see `detect`."""

    def look(fit: Refinement, known: Candidates) -> _Outcome:
        maps = Maps(Templates(fit), progress)
        search = _PeakSearch(maps, threshold, inner, scatter)
        return _Outcome(maps, *search.run(known))

    def look_and_refine(fit: Refinement) -> _Outcome:
        """Search, and search again with the candidates as companions if some are bright."""
        last = look(fit, Candidates.of_fit(fit))
        if len(last.candidates) >= _MAX_CANDIDATES:
            return last
        least = relinearise if fit.status.calibrated else min(relinearise, threshold)
        bright = last.candidates.snr(last.factor) > least
        if not (bright.any() and lacks_candidates(fit, last.candidates)):
            return last
        return look(with_companions(fit, last.candidates, progress), last.candidates)

    last = look_and_refine(fit)
    if len(last.candidates) < _MAX_CANDIDATES:
        better = with_raised_peaks(last.maps, last.candidates, inner, progress)
        last = last if better is None else look_and_refine(better)
    if len(last.candidates) >= _MAX_CANDIDATES:
        _log.warning(
            "%d candidates, the most that are looked for: parts of something extended? The star is "
            "not refined with them in the model",
            len(last.candidates),
        )
    if not last.candidates.converged:
        _log.warning(
            "the positions of %d candidates did not settle; two of them may be one source, or the "
            "star's own error", len(last.candidates)
        )  # fmt: skip
    return last


def _detection(
    outcome: _Outcome,
    threshold: float,
    separations: ArrayLike | None,
    without_limits: NDArray[np.bool_] | None,
) -> Detection:
    """The maps, candidates and contrast curve of a search; see `detect`."""
    maps, candidates, factor = outcome.maps, outcome.candidates, outcome.factor
    fit = maps.templates.fit
    information = np.where(maps.information > 0, maps.information, np.nan)
    photon = np.where(maps.photon > 0, maps.photon, np.nan) ** -0.5
    factors = factor.of(maps.grid)
    error = factors / np.sqrt(information)
    separations = curve_separations(maps.grid, separations)
    has_limits = np.isfinite(error)
    if without_limits is not None:
        has_limits &= ~np.asarray(without_limits, dtype=bool)
    rings = [
        np.array(ring)[:, has_limits[ring]]
        for ring in ring_pixels(maps.grid, separations, most=error.size)
    ]
    return Detection(
        stored_fit=fit,
        contrast=maps.numerator / information,
        error=error,
        photon_error=photon,
        snr=maps.snr() / factors,
        residual_snr=maps.snr(maps.without(candidates)) / factors,
        error_factor=factor,
        sources=with_position_of_star(maps.templates, candidates),
        false_alarm=_false_alarms(outcome),
        rings=chi2_by_ring(maps.templates, candidates.offsets, factor),
        threshold=threshold,
        contrast_curve=contrast_table(
            separations,
            [error[*ring] for ring in rings],
            [photon[*ring] for ring in rings],
            fit.model.resolution,
            factor,
            Sky.of(fit).star_jansky,
        ),
        has_limits=has_limits,
        grid=maps.grid,
    )


def _false_alarms(outcome: _Outcome) -> NDArray[np.float64]:
    """Probabilities of noise making the candidates, (k,); NaN where the noise is not known."""
    fit, candidates, factor = outcome.maps.templates.fit, outcome.candidates, outcome.factor
    # The noise of a fit that does not explain its data is not known.
    if not fit.status.calibrated:
        return np.full(len(candidates), np.nan)
    snr = candidates.snr(factor)
    false_alarm = outcome.significance.false_alarms(factor, snr, candidates.offsets)
    if count_rolls(fit) == 1 and fit.frames[0].observation.is_nircam:
        # Either noise or a structure of the detector, which only a second roll can tell.
        return 1 - (1 - false_alarm) * (1 - structures_in_single_roll(snr))
    return false_alarm


def _require_shape(actual: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if actual != expected:
        raise IncompatibleSetupError(
            f"without_limits: got the shape {actual}; expected the first frame's, {expected}"
        )


def _checked(fit: object) -> Refinement:
    """Return the fit; raise an exception if it is none, or if it failed."""
    if not isinstance(fit, Refinement):
        count = f" of {len(fit)}" if isinstance(fit, list | tuple) else ""
        raise IncompatibleSetupError(
            f"detect: got a {type(fit).__name__}{count}, expected one Refinement. Fit frames of "
            "one filter and date together, refine(model, [frame, ...], opd), and search that fit; "
            "or search each fit alone, and combine([detection, ...]) the searches"
        )
    if not fit.status.usable:
        raise IncompatibleSetupError(f"detect: the fit ended as {fit.status}")
    return fit


@dataclass(frozen=True)
class _Peaks:
    """How far a search for peaks has come."""

    candidates: Candidates  # In the order in which they were found.
    # (k, 2), positions of peaks that were no candidates after all. They would be the highest for
    # ever.
    dismissed: Tensor
    # (ny, nx), pixels whose sources are nearer to the star than the search goes.
    within: NDArray[np.bool_]
    hides: bool = False  # Whether light from there has explained peaks elsewhere.


# Let p be the image of a planet of contrast 1 at a pixel, r the residual of the fit, and Sigma the
# covariance of noise and starlight with the wavefront marginalised. The maps have
#
#     numerator N = p . Sigma^-1 r,    information I = p . Sigma^-1 p
#
# for every pixel, so that the contrast is N / I and its S/N is N / sqrt(I) with the errors that the
# noise explains. Errors are multiplied by a factor f, which grows with the scatter of the S/N.
# Candidates at offsets o with contrasts c take N = sum c p(o) . Sigma^-1 p from the maps, and with
# it their side lobes and their share of the scatter. So f falls when a planet becomes a candidate
# and grows when a candidate is dropped, and a search repeats three steps:
#
# 1. `_added`: the highest peak that is left and significant becomes a candidate, and all of them
#    are fitted together, with their positions.
# 2. `_dropped`: where no peak is left, the weakest candidate that is not significant with the
#    present factor is dropped.
# 3. `_settled`: where none is dropped either, positions are fitted until they move no more.


@dataclass(frozen=True)
class _PeakSearch:
    """A search of maps for peaks, one after the other, until none is left."""

    maps: Maps
    threshold: float
    inner: float
    scatter: float | None

    def run(self, start: Candidates) -> tuple[Candidates, ErrorFactor, Significance]:
        """Candidates in the order in which they were found, and the factor for the errors."""
        maps, peaks = self.maps, self._begun(start)
        # With m for `_MAX_CANDIDATES`: none is added after m were dropped, and no more than m are
        # left to be dropped then. So at most 2 m are dropped and 2 m added, but for peaks of
        # sources within `inner`, each of which takes a pixel from the search.
        for _ in range(4 * _MAX_CANDIDATES + peaks.within.size + 1):
            snr, offsets = maps.snr(maps.without(peaks.candidates)), peaks.candidates.offsets
            significance = significance_of(maps, offsets, self.inner, self.scatter)
            found = self._added(peaks, snr, significance)
            if found is None:
                factor = significance.factor(snr, offsets)
                found = self._dropped(peaks, snr, factor)
            if found is None:
                return self._settled(peaks.candidates), factor, significance
            peaks = found
        raise RuntimeError("the search for peaks did not end")

    def _begun(self, start: Candidates) -> _Peaks:
        """Begin with the companions of the fit that are significant.

        It may have taken a residual for a companion while its wavefront was still wrong.
        """
        candidates, unscaled = self._fitted(start), ErrorFactor.constant(1.0)
        while len(candidates) and candidates.snr(unscaled).min() < self.threshold:
            weakest = int(candidates.snr(unscaled).argmin())
            candidates = self._fitted(candidates.without(weakest))
        return _Peaks(
            candidates,
            torch.zeros(0, 2, dtype=torch.float64),
            np.zeros(self.maps.grid.shape[:2], dtype=bool),
        )

    def _added(self, peaks: _Peaks, snr: Image, significance: Significance) -> _Peaks | None:
        """Make the highest peak that is left a candidate; None if none is significant."""
        grid, candidates = self.maps.grid, peaks.candidates
        allowed = far_from(grid, peaks.dismissed, 2 * pixel_width(grid)) & ~peaks.within
        if max(len(candidates), len(peaks.dismissed)) >= _MAX_CANDIDATES:
            return None
        peak = significance.next_peak(snr, candidates.offsets, self.threshold, allowed)
        is_significant = peak is not None
        if peak is None and count_rolls(self.maps.templates.fit) > 1:
            lowest = _HIDDEN_PEAK_THRESHOLD_RATIO * self.threshold
            peak = next(iter(significance.peaks(snr, candidates.offsets, lowest, allowed)), None)
        if peak is None:
            return None
        contrast = float(snr[peak] / np.sqrt(self.maps.information[peak]))
        more = self._fitted(candidates.with_one_more(grid[peak], contrast))
        if not is_significant and not self._is_significant(more, significance):
            return None
        within = peaks.within
        if separation_of(more.offsets.numpy())[-1] < self.inner:
            within = within.copy()
            within[peak] = True
            more = self._fitted(more.without(len(more) - 1))
        _log.info("candidates at %s arcsec", more.offsets.tolist())
        return replace(peaks, candidates=more, within=within)

    def _is_significant(self, candidates: Candidates, significance: Significance) -> bool:
        """Whether the last candidate is significant where the light of all of them is removed."""
        snr = self.maps.snr(self.maps.without(candidates))
        factor = significance.factor(snr, candidates.offsets)
        margin = candidates.snr(factor) - factor.threshold(self.threshold, candidates.offsets)
        return bool(margin[-1] >= 0)

    def _dropped(self, peaks: _Peaks, snr: Image, factor: ErrorFactor) -> _Peaks | None:
        """Drop the weakest candidate that is none with the present factor; None if all are."""
        candidates = peaks.candidates
        # The factor may have grown since a candidate was accepted. Side lobes of a source within
        # `inner` are no candidates, however significant they are.
        margin = candidates.snr(factor) - factor.threshold(self.threshold, candidates.offsets)
        if not len(candidates) or margin.min() >= 0:
            lobes = side_lobes(self.maps, snr, candidates, factor, self.threshold, self.inner)
            if not lobes.any():
                return None
            margin = np.where(lobes, margin, np.inf)
            if not peaks.hides:
                _log.warning(
                    "light within %.2f arcsec is not the star's; peaks that it explains elsewhere "
                    "are no candidates", self.inner
                )  # fmt: skip
            peaks = replace(peaks, hides=True)
        weakest = int(margin.argmin())
        return replace(
            peaks,
            candidates=self._fitted(candidates.without(weakest)),
            dismissed=torch.cat([peaks.dismissed, candidates.offsets[weakest, None]]),
        )

    def _settled(self, candidates: Candidates) -> Candidates:
        """Fit positions until they move no more, if the last fit ended before."""
        if candidates.converged:
            return candidates
        return refine_candidates(self.maps.templates, candidates, reach=self._reach)

    def _fitted(self, candidates: Candidates) -> Candidates:
        """All candidates fitted together, with their positions, by a few steps."""
        return refine_candidates(self.maps.templates, candidates, self._reach, _POSITION_STEPS)

    @property
    def _reach(self) -> float:
        """Largest move of a candidate in one step, arcsec."""
        return pixel_width(self.maps.grid) / 2
