"""Calints files as the pipeline writes them, with a star behind the mask, and changes to them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

SIDE = 180
CENTER = (88.0, 91.0)
"""x, y of the star, 0-indexed."""

PLACES = {"HD 1": (100.0, 20.0), "HD 2": (101.5, 19.0), "BD+20-1790": (110.0, 20.2)}
"""Right ascension and declination of stars, degrees."""


_WAVES = ((0.9, 0.3, 0.3), (-0.8, 0.5, -0.3), (0.2, -1.2, 0.3), (-0.6, -0.7, -0.3))
"""Wave numbers along x and y of the field of the speckles, and growth of their phases, radians per
pixel."""


def starlight(offset: tuple[float, float] = (0.0, 0.0), side: int = SIDE) -> np.ndarray:
    """A ring of speckles about a star behind a mask, nearly symmetric about it; x, y in pixels.

    Mirrored or turned it looks different, as on real frames.
    """
    y, x = np.indices((side, side))
    dx, dy = x - CENTER[0] - offset[0], y - CENTER[1] - offset[1]
    r = np.hypot(dx, dy)
    field = np.ones_like(r)
    for kx, ky, phase in _WAVES:
        # The farther out, the less symmetric.
        field += 0.5 * np.cos(kx * dx + ky * dy + phase * np.maximum(r - 5, 0))
    return np.asarray(28 * np.exp(-(((r - 6) / 5) ** 2)) * field**2)


def calints(
    path: Path,
    star: str = "HD 1",
    *,
    observation: int = 1,
    roll: float = 70.0,
    date: str = "2022-10-03T06:00:00",
    integrations: int = 1,
    cards: Mapping[str, Any] | None = None,
    light: np.ndarray | None = None,
    change: Any = None,
) -> Path:
    """Write a file; None for a card leaves it out, and `change` may edit SCI, ERR and DQ."""
    ra, dec = PLACES.get(star, (50.0, -30.0))
    primary: dict[str, Any] = {
        "TELESCOP": "JWST", "INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "MODULE": "A",
        "FILTER": "F444W", "PUPIL": "MASKRND", "CORONMSK": "MASKA335R", "SUBARRAY": "SUB320A335R",
        "APERNAME": "NRCA5_MASK335R", "EXP_TYPE": "NRC_CORON", "TARGPROP": star, "TARGNAME": star,
        "TARG_RA": ra, "TARG_DEC": dec, "PROGRAM": "01184", "OBSERVTN": f"{observation:03d}",
        "VISIT": "001", "VISITGRP": "03", "SEQ_ID": "1", "ACT_ID": "06", "EXPOSURE": "1",
        "DATE-BEG": date, "DATE-OBS": date[:10], "TIME-OBS": date[11:] + ".000", "IS_PSF": False,
        "XOFFSET": 0.0, "YOFFSET": 0.0,
    }  # fmt: skip
    science: dict[str, Any] = {
        "BUNIT": "MJy/sr", "PIXAR_A2": 0.0039, "CRPIX1": CENTER[0] + 1, "CRPIX2": CENTER[1] + 1,
        "ROLL_REF": roll, "V3I_YANG": 0.05, "VPARITY": -1, "PHOTMJSR": 2.5,
    }  # fmt: skip
    for key, value in (cards or {}).items():
        (science if key in science else primary)[key] = value
    seed = int(hashlib.sha256(f"{star} {observation} {date}".encode()).hexdigest()[:8], 16)
    rng = np.random.default_rng(seed)
    mean = starlight() if light is None else light
    error = np.sqrt(0.25 + 0.01 * np.abs(mean))
    shape = (integrations, *mean.shape)
    arrays = {
        "SCI": mean + error * rng.normal(size=shape),
        "ERR": np.broadcast_to(error, shape).copy(),
        "DQ": np.zeros(shape, dtype=np.int32),
    }
    if change is not None:
        change(arrays)
    hdus = [fits.PrimaryHDU()]
    hdus += [
        fits.ImageHDU(array if name == "DQ" else array.astype(np.float32), name=name)
        for name, array in arrays.items()
    ]
    for hdu, values in ((hdus[0], primary), (hdus[1], science)):
        for key, value in values.items():
            if value is not None:
                hdu.header[key] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    fits.HDUList(hdus).writeto(path)
    return path
