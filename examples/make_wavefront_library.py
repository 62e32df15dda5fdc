"""Make the package's library of static wavefronts from fits of stars, as `reduce` writes them.

    python examples/make_wavefront_library.py FIT.fits [FIT.fits ...] -o wavefronts.fits.gz

The fits are those of `pyklip-diffrender reduce`, which leaves what the target itself has taught out
of the library. A fit that started from a static wavefront counts with the sum of both.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pyklip_diffrender as dr
from pyklip_diffrender.refinement.static_wavefront import write_wavefronts
from pyklip_diffrender.refinement.wavefront_learning import measure_wavefronts


def main() -> None:
    """Write one static wavefront for every fit."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("fits", type=Path, nargs="+", metavar="FIT")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    measured = []
    for path in options.fits:
        measured += measure_wavefronts([dr.Refinement.read(path)])
    write_wavefronts(measured, options.output)


if __name__ == "__main__":
    main()
