"""Planets injected into real frames: this package and KLIP (pyKLIP's) on the same frames.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.injections --target G-7-34 --filter F444W --planets 21

For the rolls of one target, with all other stars as KLIP's references, it prints the 5-sigma limits
of `reduce` (closed form) and of KLIP (`klip_curve`), both with the small-sample correction, and
what `reduce` recovers of planets that are injected at 1.6 times its limit: bias, coverage, S/N.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import pyklip_diffrender as dr
from benchmarks.real_options import real_frames_parser
from pyklip_diffrender.pyklip_backend.klip import klip_curve
from pyklip_diffrender.reduction import summarise

SEPARATIONS = np.array([0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 2.3])
SIZE = 80


def main() -> None:
    """Compare limits, then inject."""
    parser = real_frames_parser(__doc__)
    parser.add_argument("--planets", type=int, default=21)
    parser.add_argument("--output", type=Path, help="folder for the products")
    options = parser.parse_args()
    sequence = dr.Sequence.from_files(options.frames, target=options.target, filter=options.filter)
    began = time.perf_counter()
    base = dr.reduce(replace(sequence, references=()), options.opd, injections=options.planets)
    distant = np.hypot(base.detection.grid[..., 0], base.detection.grid[..., 1]) > 0.3
    print(base)
    print(
        f"{time.perf_counter() - began:.0f} s; chi2 {base.fit.chi2_per_pixel:.3f}, errors scaled "
        f"by {base.detection.scatter:.3f}, S/N beyond 0.3 arcsec: deviation "
        f"{np.nanstd(base.detection.residual_snr[distant]):.3f}, "
        f"{np.nanmin(base.detection.residual_snr[distant]):.1f} to "
        f"{np.nanmax(base.detection.residual_snr[distant]):.1f}",
        flush=True,
    )
    curve = base.detection.contrast_curve
    ours, star_known, corrected = (
        np.interp(SEPARATIONS, curve["separation"].value, curve[name])
        for name in ("contrast", "known_star", "small_sample")
    )
    klip = klip_curve(base.detection, sequence.cutout(SIZE).references, SEPARATIONS)
    theirs, modes = np.asarray(klip["contrast"]), klip["modes"]
    print(
        "small-sample correction: ours, KLIP, ratio (modes of KLIP); without it: ours, star known"
    )
    for row in zip(
        SEPARATIONS, corrected, theirs, theirs / corrected, modes, ours, star_known, strict=True
    ):
        print("{:.1f}  {:.2e}  {:.2e}  {:.2f} ({})  {:.2e}  {:.2e}".format(*row), flush=True)
    print(f"median ratio {np.median(theirs / corrected):.2f}")
    if base.injections is not None:
        print("\n".join(base.injections.pformat(max_lines=-1)))
        about = summarise(base)["injections"]
        print({key: value for key, value in about.items() if key != "planets"})
    if options.output is not None:
        base.write(options.output)


if __name__ == "__main__":
    main()
