"""Make the package's library of flat-field patterns from frames of stars without companions.

Two passes: stars are first fitted one by one, then again with what the other stars taught, so that
less of the wavefront's error is taken for the pattern.

    python examples/make_pattern_library.py FOLDER --opd MAP -o patterns.fits.gz \
        --stars HIP17695 G-7-34 --filters F444W F356W
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import pyklip_diffrender as dr
from pyklip_diffrender.pattern import (
    MeasuredPattern,
    combine_patterns,
    measure_patterns,
    pattern_pedestal,
    write_patterns,
)

log = logging.getLogger(__name__)

SIZE = 80


def fit_of(
    star: str, name: str, files: list[Path], opd: Path, others: list[MeasuredPattern]
) -> dr.Refinement:
    """Fit all rolls of a star together."""
    sequence = dr.Sequence.from_files(files, target=star, filter=name)
    model = dr.model_for(sequence.science[0], SIZE)
    frames = sequence.cutout(SIZE).science
    known = combine_patterns(others) if len(others) > 1 else None
    error = 0.01 if known is None else 0.002
    settings = dr.GaussNewton.nircam(max_companions=0, min_model_error=error)
    fit = dr.refine(model, frames, opd, settings=settings, systematics=known)
    log.info("%s %s: %s, chi2 %.2f", star, name, fit.status.name, fit.chi2_per_pixel)
    return fit


def main() -> None:
    """Fit all stars twice through every filter and write the patterns of their frames."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="calints or aligned files")
    parser.add_argument("--opd", type=Path, required=True)
    parser.add_argument("--stars", nargs="+", required=True)
    parser.add_argument("--filters", nargs="+", required=True)
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    log.setLevel(logging.INFO)
    files = sorted(options.folder.glob("*.fits*"))
    library = []
    for name in options.filters:
        first = {star: fit_of(star, name, files, options.opd, []) for star in options.stars}
        pedestal = pattern_pedestal(list(first.values()))
        log.info("%s: pedestal %.3g", name, pedestal)
        second = []
        for star in options.stars:
            others = [fit for other, fit in first.items() if other != star]
            known = measure_patterns(others, pedestal)
            second.append(fit_of(star, name, files, options.opd, known))
        pedestal = pattern_pedestal(second)
        log.info("%s: pedestal %.3g", name, pedestal)
        library += measure_patterns(second, pedestal)
        write_patterns(library, options.output)


if __name__ == "__main__":
    main()
