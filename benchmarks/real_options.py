"""Options of the scripts that reduce the real frames of one target."""

from __future__ import annotations

import argparse
from pathlib import Path


def real_frames_parser(
    doc: str | None, target: str | None = "G-7-34", band: str | None = "F444W"
) -> argparse.ArgumentParser:
    """Make a parser for the folder of frames, the OPD map, the target and the filter."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--frames", type=Path, default=Path("../shared/data/gto1184"))
    parser.add_argument("--opd", type=Path, default=Path("../shared/data/opd_2022-08-14.fits.gz"))
    parser.add_argument("--target", default=target)
    parser.add_argument("--filter", default=band)
    return parser
