"""The deeper of two searches of the same frames at every separation.

Frames of reference stars make limits of a target deeper near the star, where the wavefront limits
them, and may make them shallower elsewhere, where their pattern is not quite the target's. Both
fits are valid measurements. At every separation the one with the deeper stated limit is used. The
choice rests on errors, not on the S/N, so that every pixel is searched once and thresholds and
false-alarm probabilities of a single search apply.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Image, is_within, separation_of
from pyklip_diffrender.detection.search_result import Detection

SAME_SOURCE_LAMBDA_D = 0.5
"""Largest distance of two searches' candidates that are one source. The searches share the target's
frames, so that their positions of a source differ by less than the error of either, a tenth of
lambda/D at S/N 5."""


def stated_limits(detection: Detection) -> tuple[Image, Image]:
    """Separations, arcsec, and stated limits in units of light, see `FrameFit.star_light`."""
    curve = detection.contrast_curve
    light = detection.fit.frames[0].star_light
    return curve["separation"].to_value("arcsec"), light * np.asarray(curve["contrast"])


def deeper(first: Detection, second: Detection) -> Detection:
    """Join two searches of the same frames: at every separation, the one with the deeper limit.

    Contrasts are relative to the star of the first search, whose fit the result has. It is the
    first search itself where the second is nowhere deeper.
    """
    separations, limits = stated_limits(first)
    theirs, their_limits = stated_limits(second)
    if not len(limits) or len(limits) != len(their_limits) or not np.allclose(separations, theirs):
        return first
    is_deeper = their_limits < limits
    if not is_deeper.any():
        return first
    # Between the separations of the curve, the nearest one decides.
    nearest = np.abs(separation_of(first.grid)[..., None] - separations).argmin(axis=-1)
    region = is_deeper[nearest]
    one, two = (each.fit.frames[0].star_light for each in (first, second))
    scale = two / one

    def chosen(one: Image, other: Image) -> Image:
        return np.where(region, other, one)

    factor, other = first.error_factor, second.error_factor
    sources, false_alarm = _joined_sources(first, second, region, scale)
    return replace(
        first,
        contrast=chosen(first.contrast, scale * second.contrast),
        error=chosen(first.error, scale * second.error),
        photon_error=chosen(first.photon_error, scale * second.photon_error),
        snr=chosen(first.snr, second.snr),
        residual_snr=chosen(first.residual_snr, second.residual_snr),
        error_factor=ErrorFactor(
            chosen(factor.factors, other.factors), chosen(factor.freedom, other.freedom), first.grid
        ),
        sources=sources,
        false_alarm=false_alarm,
        contrast_curve=_joined_curve(first, second, is_deeper, scale),
        has_limits=np.where(region, second.has_limits, first.has_limits),
        other=second,
        of_other=region,
    )


def _joined_curve(
    first: Detection, second: Detection, is_deeper: NDArray[np.bool_], scale: float
) -> QTable:
    """The contrast curve with the rows of the second search where these are deeper, (rows,)."""
    curve, theirs = first.contrast_curve.copy(), second.contrast_curve
    for name in ("contrast", "lowest", "highest", "known_star", "small_sample"):
        curve[name] = np.where(is_deeper, scale * theirs[name], curve[name])
    curve["error_factor"] = np.where(is_deeper, theirs["error_factor"], curve["error_factor"])
    curve["delta_mag"] = -2.5 * np.log10(curve["contrast"]) * u.mag
    star = first.sky.star_jansky
    if star is not None:
        curve["flux_density"] = star * curve["contrast"] * u.Jy
    for name in curve.colnames:
        curve[name].info.format = first.contrast_curve[name].info.format
        curve[name].info.description = first.contrast_curve[name].info.description
    return curve


def _joined_sources(
    first: Detection, second: Detection, region: NDArray[np.bool_], scale: float
) -> tuple[Candidates, Image]:
    """Candidates of both searches, each where its search is the deeper, and their false alarms."""
    searches = (first, second)
    places = [each.sources.offsets.numpy() for each in searches]
    # A source that both have is taken from the search of its place in the first one.
    resolution = first.contrast_curve.meta["resolution_arcsec"]
    away = np.hypot(*np.moveaxis(places[0][:, None] - places[1][None], -1, 0))
    in_second = is_within(region, first.grid, places[0])
    kept = [~in_second, is_within(region, first.grid, places[1])]
    for k, j in zip(*np.nonzero(away < SAME_SOURCE_LAMBDA_D * resolution), strict=True):
        kept[0][k], kept[1][j] = not in_second[k], bool(in_second[k])
    parts = [np.flatnonzero(each) for each in kept]
    count, one = sum(map(len, parts)), len(parts[0])
    covariance = torch.zeros(3 * count, 3 * count, dtype=torch.float64)
    # The two searches share the noise of the target's frames, but not at the places of two sources.
    for search, part, start, unit in zip(searches, parts, (0, one), (1.0, scale), strict=True):
        total = len(search.sources)
        rows = np.concatenate([part + k * total for k in range(3)])
        onto = np.concatenate([np.arange(start, start + len(part)) + k * count for k in range(3)])
        units = torch.ones(len(rows), dtype=torch.float64)
        units[: len(part)] = unit
        block = search.sources.covariance[rows][:, rows] * units[:, None] * units
        covariance[np.ix_(onto, onto)] = block
    own, theirs = (search.sources for search in searches)
    return (
        Candidates(
            torch.cat([own.offsets[parts[0]], theirs.offsets[parts[1]]]),
            torch.cat([own.contrasts[parts[0]], scale * theirs.contrasts[parts[1]]]),
            covariance,
            torch.cat([own.detection_errors[parts[0]], scale * theirs.detection_errors[parts[1]]]),
            own.converged and theirs.converged,
        ),
        np.concatenate([s.false_alarm[part] for s, part in zip(searches, parts, strict=True)]),
    )
