"""The real frames that scripts reduce, and the options that name them."""

from __future__ import annotations

import argparse
from pathlib import Path

import pyklip_diffrender as dr

DATA = Path("../shared/data")


def opd_of(data: Path, star: str = "") -> Path:
    """The OPD map nearest to the frames of a star."""
    return data / ("opd_2022-07-30.fits.gz" if star == "HIP-65426" else "opd_2022-08-14.fits.gz")


def frames_of(data: Path, star: str, band: str = "F444W") -> dr.ExposureSequence:
    """Frames of a star in a filter, and those of all other stars as references."""
    if star == "HIP-65426":
        return dr.ExposureSequence.from_files([data / "hip65426_f444w_calints.fits.gz"])
    return dr.ExposureSequence.from_files(data / "gto1184", target=star, filter=band)


def real_frames_parser(
    doc: str | None, target: str | None = "G-7-34", band: str | None = "F444W"
) -> argparse.ArgumentParser:
    """Make a parser for the folder of frames, the OPD map, the target and the filter."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--frames", type=Path, default=DATA / "gto1184")
    parser.add_argument("--opd", type=Path, default=opd_of(DATA))
    parser.add_argument("--target", default=target)
    parser.add_argument("--filter", default=band)
    return parser
