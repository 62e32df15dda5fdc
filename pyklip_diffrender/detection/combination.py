"""Frames of several rolls, turned to one orientation and averaged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from scipy.ndimage import map_coordinates

from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.detection.templates import Templates

__all__ = ["combine_frames"]


def combine_frames(
    templates: Templates,
    images: Mapping[int, Image],
    errors: Mapping[int, Image],
    offsets: Image,
) -> tuple[Image, Image]:
    """Average frames, weighted by their errors, at positions about the star.

    Parameters
    ----------
    templates : Templates
        Of the fit, which knows where the star is in every frame.
    images : mapping of int to ndarray, (ny, nx)
        By frame. Invalid pixels get no weight, but cubic splines reach over them: they need finite
        values.
    errors : mapping of int to ndarray, (ny, nx)
        Standard deviations; inf for invalid pixels.
    offsets : ndarray, (rows, columns, 2)
        Positions, x and y from the star in the first frame, arcsec.

    Returns
    -------
    image, error : ndarray, (rows, columns)
        NaN where no frame has a valid pixel.
    """
    shape = offsets.shape[:2]
    total, weights = np.zeros((2, *shape))
    for k, image in images.items():
        places = templates.pixels_of(k, torch.from_numpy(offsets.reshape(-1, 2)))
        values, weight = (
            map_coordinates(array, places, order=order, cval=0.0).reshape(shape)
            for array, order in ((image, 3), (errors[k] ** -2.0, 1))
        )
        total += weight * values
        weights += weight
    covered = weights > 0
    safe = np.where(covered, weights, 1.0)
    return np.where(covered, total / safe, np.nan), np.where(covered, safe**-0.5, np.nan)
