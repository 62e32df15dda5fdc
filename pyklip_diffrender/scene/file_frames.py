"""The frames of a file, without the integrations and pixels that cannot be used."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import NoValidPixelsError
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.scene.checked_frames import checked_stacks, mask_unusable, selected
from pyklip_diffrender.scene.exposure import instrument_of
from pyklip_diffrender.scene.integrations import Judgement, judge_pointings, pointings
from pyklip_diffrender.scene.jwst_files import on_detector_pixels, read_calints, without_empty
from pyklip_diffrender.scene.measured_noise import calibrated_errors, weighted_mean

__all__ = ["frames_in", "frames_of_file", "means_of_file", "means_of_pointings"]

_log = logging.getLogger(__name__)


def frames_of_file(
    path: str | os.PathLike[str],
    *,
    every_integration: bool,
    star: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Read and judge a calints file: the attributes of `Observation.from_fits`."""
    with open_fits(path, images=False) as hdus:
        return frames_in(hdus, path, every_integration=every_integration, star=star)


def frames_in(
    hdus: fits.HDUList,
    path: str | os.PathLike[str],
    *,
    every_integration: bool,
    star: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Read and judge the calints file at that path, which is open, see `frames_of_file`."""
    frames, kept, original = _judged(hdus, path, compact=False, star=star)
    if not every_integration:
        return frames if kept.all() else frames | selected(frames, np.flatnonzero(kept))
    # Frames of empty integrations have the pixels of the one before, and none is valid.
    frames |= selected(frames, np.maximum(np.cumsum(original) - 1, 0))
    every = original.copy()
    every[original] = kept
    mask_unusable(frames, np.broadcast_to(every[:, None, None], frames["valid"].shape))
    return frames


def means_of_file(
    path: str | os.PathLike[str], *, star: tuple[float, float] | None = None
) -> dict[str, Any]:
    """Read and judge a calints file, and average the integrations of each of its pointings.

    It takes at most as much memory as the file has, however many integrations there are; see
    `Observation.means_from_fits`.

    Returns
    -------
    dict
        The attributes of the observation.
    """
    with open_fits(path, images=False) as hdus:
        frames, kept, _ = _judged(hdus, path, compact=True, star=star)
    return frames | means_of_pointings(frames, np.flatnonzero(kept))


def means_of_pointings(frames: Mapping[str, Any], which: NDArray[np.intp]) -> dict[str, Any]:
    """Average the integrations of each pointing.

    Parameters
    ----------
    frames : mapping
        The attributes of an `Observation` of single integrations.
    which : ndarray of int
        Indices of the integrations that are used, at least one.

    Returns
    -------
    dict
        The attributes that change.
    """
    center, angles = frames["center"], frames["position_angles"]
    turns = None if angles is None else angles[which]
    groups = [which[group] for group in pointings(center[which], turns)]
    shape = (len(groups), *frames["data"].shape[1:])
    data, error, valid = np.empty(shape), np.empty(shape), np.empty(shape, dtype=bool)
    for k, group in enumerate(groups):
        data[k], error[k], valid[k] = weighted_mean(
            frames["data"], frames["error"], frames["valid"], group
        )
    ratios = frames.get("noise_ratios", ())
    return {
        "data": data,
        "error": error,
        "valid": valid,
        "center": np.stack([center[group].mean(axis=0) for group in groups]),
        "position_angles": None if angles is None else angles[[group[0] for group in groups]],
        "noise_ratios": tuple(_oddest([ratios[j] for j in g]) for g in groups) if ratios else (),
        "integrations": tuple(len(group) for group in groups),
    }


def _oddest(ratios: list[float]) -> float:
    """The ratio that is farthest from 1, by a factor; NaN if none is known."""
    known = [each for each in ratios if each > 0]
    return max(known, key=lambda each: abs(np.log(each)), default=np.nan)


def _judged(
    hdus: fits.HDUList,
    path: str | os.PathLike[str],
    *,
    compact: bool,
    star: tuple[float, float] | None,
) -> tuple[dict[str, Any], NDArray[np.bool_], NDArray[np.bool_]]:
    """Read and judge an open file, in place, so that its integrations are in memory once.

    The attributes of the observation; which of its integrations are kept, (frames,), and which of
    the file's are not empty, (integrations,).
    """
    arguments, shifts = read_calints(hdus, path, compact=compact, star=star)
    arguments, shifts, empty = without_empty(arguments, shifts)
    frames = checked_stacks(**arguments)
    name = frames["name"]
    if shifts is not None:
        frames |= on_detector_pixels(arguments, frames["center"], shifts, is_measured=star is None)
    mask_unusable(frames)
    if instrument_of(frames["header"], name) == "NIRCAM":
        frames["error"], frames["noise_ratios"] = calibrated_errors(
            frames["data"], frames["error"], frames["valid"], frames["center"],
            frames["pixelscale"], name, out=frames["error"],
        )  # fmt: skip
    original = np.ones(len(frames["data"]), dtype=bool) if empty is None else empty.kept
    judgement = _judgement(frames, original)
    frames["remarks"] = (*(() if empty is None else empty.remarks), *judgement.remarks)
    if not judgement.kept.any():
        raise NoValidPixelsError(f"{name}: no integration is left: {'; '.join(judgement.remarks)}")
    mask_unusable(frames)
    return frames, judgement.kept, original


def _judgement(frames: dict[str, Any], original: NDArray[np.bool_]) -> Judgement:
    """Compare the integrations that are left of a file with each other."""
    names = [f"integration {k + 1} of {len(original)}" for k in np.flatnonzero(original)]
    judgement = judge_pointings(
        frames["data"], frames["error"], frames["valid"], frames["center"],
        frames["position_angles"], frames["pixelscale"], names,
    )  # fmt: skip
    for remark in judgement.remarks:
        _log.warning("%s: %s", frames["name"], remark)
    return judgement
