"""The frames of a file, without the integrations and pixels that cannot be used."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.scene.checked_frames import checked_frames, selected
from pyklip_diffrender.scene.exposure import instrument_of
from pyklip_diffrender.scene.integrations import Judgement, judge_pointings
from pyklip_diffrender.scene.jwst_files import on_detector_pixels, read_calints, without_empty
from pyklip_diffrender.scene.measured_noise import calibrated_errors

__all__ = ["frames_in", "frames_of_file"]

_log = logging.getLogger(__name__)


def frames_of_file(path: str | os.PathLike[str], *, every_integration: bool) -> dict[str, Any]:
    """Read and judge a calints file: the attributes of `Observation.from_fits`."""
    with open_fits(path) as hdus:
        return frames_in(hdus, Path(path).name, every_integration=every_integration)


def frames_in(hdus: fits.HDUList, name: str, *, every_integration: bool) -> dict[str, Any]:
    """Read and judge the calints file of that name, which is open, see `frames_of_file`."""
    arguments, shifts = read_calints(hdus, name)
    arguments, shifts, empty = without_empty(arguments, shifts)
    frames = checked_frames(**arguments)
    if shifts is not None:
        frames |= on_detector_pixels(arguments, frames["center"], shifts)
    if instrument_of(frames["header"], name) == "NIRCAM":
        frames["error"], frames["noise_ratios"] = calibrated_errors(
            frames["data"], frames["error"], frames["valid"], frames["center"],
            frames["pixelscale"], name,
        )  # fmt: skip
    original = np.ones(len(frames["data"]), dtype=bool) if empty is None else empty.kept
    judgement = _judgement(frames, original)
    frames["remarks"] = (*(() if empty is None else empty.remarks), *judgement.remarks)
    kept = judgement.kept
    frames |= _masked(frames, judgement.valid)
    if not every_integration:
        return frames if kept.all() else frames | selected(frames, np.flatnonzero(kept))
    # Frames of empty integrations have the pixels of the one before, and none is valid.
    frames |= selected(frames, np.maximum(np.cumsum(original) - 1, 0))
    every = original.copy()
    every[original] = kept
    return frames | _masked(frames, frames["valid"] & every[:, None, None])


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


def _masked(frames: dict[str, Any], valid: NDArray[np.bool_]) -> dict[str, Any]:
    """The arrays with other valid pixels."""
    return {
        "data": np.where(valid, frames["data"], 0.0),
        "error": np.where(valid, frames["error"], 1.0),
        "valid": valid,
    }
