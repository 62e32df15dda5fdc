"""The names of files in the archive: the product, the exposure, and the detector."""

from __future__ import annotations

import re
from pathlib import Path

from astropy.io import fits

from pyklip_diffrender.io.headers import header_number, header_text

__all__ = ["detector_of", "identity_of", "level_of"]

_LEVEL = re.compile(r"_([a-z0-9]+)\.fits(\.gz)?$", re.IGNORECASE)
_LEVELS = (
    "calints", "crfints", "cal", "crf", "rateints", "rate", "uncal", "ramp", "jump", "dark",
    "trapsfilled", "i2d", "s2d", "psfsub", "psfalign", "psfstack", "x1d", "segm", "cat",
)  # fmt: skip
"""Products of the pipeline: those that can be used come first, the best of them in front."""

_STEPS = {"S_KLIP": "psfsub", "S_PSFALI": "psfalign", "S_PSFSTK": "psfstack", "S_RESAMP": "i2d"}
"""Steps of the pipeline after which frames are no longer those of a detector."""

_NAME = re.compile(
    r"jw(\d{5})(\d{3})(\d{3})_(\d{2})(\d)(\w{2})_(\d{5})(?:-seg(\d{3}))?_([a-z0-9]+)", re.IGNORECASE
)
"""Programme, observation, visit, visit group, parallel sequence, activity, exposure, segment and
detector in the name that the archive gives to a file."""

_IDENTITY = ("PROGRAM", "OBSERVTN", "VISIT", "VISITGRP", "SEQ_ID", "ACT_ID", "EXPOSURE")

_DETECTORS = {"NRCA5": "NRCALONG", "NRCB5": "NRCBLONG"}
"""Detectors whose apertures (APERNAME) have another name."""


def level_of(header: fits.Header, name: str, dimensions: int) -> str | None:
    """Product of the pipeline, from its steps, the unit, and the names of the file."""
    for key, level in _STEPS.items():
        if str(header.get(key, "")).strip().upper() == "COMPLETE":
            return level
    texts = (Path(name).name, header_text(header, "FILENAME", name) or "")
    named = [match[1].lower() for match in map(_LEVEL.search, texts) if match]
    known = [each for each in named if each in _LEVELS]
    # If the names disagree, the frames are what they are least useful as.
    stated = max(known, key=_LEVELS.index, default=None)
    unit = (header_text(header, "BUNIT", name) or "").upper().replace(" ", "")
    if unit in ("DN/S", "ADU/S", "COUNT/S") and stated in (None, "calints", "cal"):
        return "rateints" if dimensions == 3 else "rate"
    if stated == "calints" and dimensions == 2:
        return "cal"
    return stated


def detector_of(header: fits.Header, name: str) -> str | None:
    """Detector, from DETECTOR, APERNAME or the archive's name of the file; None if not stated."""
    stated = header_text(header, "DETECTOR", name)
    if stated is not None:
        return stated.upper()
    aperture = (header_text(header, "APERNAME", name) or "").upper().partition("_")[0]
    if re.fullmatch(r"NRC[AB]\d", aperture):
        return _DETECTORS.get(aperture, aperture)
    match = _NAME.search(Path(name).name)
    return match[9].upper() if match else None


def identity_of(header: fits.Header, name: str) -> str | None:
    """Name of the exposure, as the archive makes it; None if the header does not say."""
    detector = detector_of(header, name)
    parts = [str(header.get(key, "")).strip() for key in _IDENTITY]
    if detector is not None and all(each and each.upper() != "UNKNOWN" for each in parts):
        digits = [part.zfill(n) for part, n in zip(parts, (5, 3, 3, 2, 1, 2, 5), strict=True)]
        segment = header_number(header, "EXSEGNUM", name) or 1
        return _identified(digits, f"{segment:03.0f}", detector)
    for text in (header_text(header, "FILENAME", name) or "", Path(name).name):
        match = _NAME.search(text)
        if match:
            *digits, part, chip = match.groups()
            return _identified(digits, part or "001", chip)
    return None


def _identified(digits: list[str], segment: str, detector: str) -> str:
    program, observation, visit, group, sequence, activity, exposure = digits
    part = "" if segment == "001" else f"-seg{segment}"
    return (
        f"jw{program}{observation}{visit}_{group}{sequence}{activity}_{exposure}{part}_"
        f"{detector.lower()}"
    )
