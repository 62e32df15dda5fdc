"""Copies of reduced frames to which faint sources were added: self-subtraction without a fit.

A contrast curve by injection reduces the same frames a hundred times, with other planets in each.
Light that is added to the data changes the star by the image of H^-1 G (light), to first order (see
`linear.model`), so that the fit to the frames without it is all that is needed. The result depends
on nothing else, and not on the order of the copies.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.pyklip_backend.dataset_frames import Frames
from pyklip_diffrender.pyklip_backend.output_files import ReductionRecord
from pyklip_diffrender.pyklip_backend.subtract import Subtraction

__all__ = ["subtract_from_copy"]

_SAME_PLACE = 0.01
"""Pixels between the stars in frames and in their copies; centres are single precision."""


def subtract_from_copy(record: ReductionRecord, frames: Frames) -> Subtraction:
    """The star in copies of reduced frames, which differ by faint sources.

    Parameters
    ----------
    record : ReductionRecord
        Of the frames without the sources.
    frames : Frames

    Raises
    ------
    IncompatibleSetupError
        If these are other frames, or their fit has no linear model.
    """
    _require_copy(record, frames)
    before = record.subtraction
    added = frames.data - record.frames.data
    star = before.star.copy()
    for result in dict.fromkeys(part.result for part in before.pointings):
        parts = [part for part in before.pointings if part.result is result]
        light = {}
        for part in parts:
            light[part.index] = torch.from_numpy(part.mean_light(added))[None]
        change = result.linear.response(light)[:, 0]
        for part in parts:
            star[part.pointing.frames] += part.change_in_frames(change)
    return dataclasses.replace(before, star=star)


def _require_copy(record: ReductionRecord, frames: Frames) -> None:
    """Raise for frames that are not copies of the reduced ones with a little light added."""
    fits = record.subtraction.fits
    if any(getattr(fit.result, "linear", None) is None for fit in fits):
        raise IncompatibleSetupError(
            "injected_into: its fits have no linear model; reduce it with a GaussNewton fit"
        )
    now, then = frames.observation, record.frames.observation
    same = now.data.shape == then.data.shape and frames.pixels == record.frames.pixels
    if same:
        difference = np.abs(frames.data - record.frames.data) / then.error
        # Sources change few pixels by more than the noise.
        same = bool(
            np.abs(now.center - then.center).max() < _SAME_PLACE
            and np.median(difference[now.valid & then.valid]) < 1
        )
    if not same:
        raise IncompatibleSetupError(
            f"{now.name}: not a copy of the frames of injected_into to which faint sources were "
            "added. Give the dataset that was reduced before the sources were added, read from the "
            "same files"
        )
