"""How well do real frames determine the flux of their star? Fits with brighter and fainter stars.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.star_flux --target HIP17695 --filter F444W
    python -m benchmarks.star_flux --frames ../shared/data/hip65426_f444w_calints.fits.gz
        --opd ../shared/data/opd_2022-07-30.fits.gz

The rolls of a target are fitted by `reduce`, and again with the star's flux held within 0.3 % of
several values. It prints chi-squared and what is measured of the candidates. With ``--flat`` it
fits every roll and all of them together from the map and from a flat wavefront, and prints the
star's flux of the second fit over that of the first.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import pyklip_diffrender as dr
from benchmarks.real_frames import real_frames_parser
from pyklip_diffrender.refinement import jansky_per_unit, with_star_flux

SHARES = (1.0, 0.9, 1.1, 1.2)


def from_flat(sequence: dr.ExposureSequence, opd: Path) -> None:
    """Print the star's flux of fits from a flat wavefront over that of fits from a map."""
    rolls = {f"roll {k + 1}": (each,) for k, each in enumerate(sequence.science)}
    if len(sequence.science) > 1:
        rolls["all rolls"] = sequence.science
    for name, science in rolls.items():
        alone = replace(sequence, science=science, references=())
        measured, flat = (dr.reduce(alone, each).fit for each in (opd, "flat"))
        print(
            f"{sequence.target}, {sequence.filter}, {name}: "
            f"{flat.frames[0].flux / measured.frames[0].flux:.2f} "
            f"({measured.status.name} from the map, {flat.status.name} from a flat wavefront)",
            flush=True,
        )


def main() -> None:
    """Fit with several fluxes."""
    parser = real_frames_parser(__doc__, target=None, band=None)
    parser.add_argument("--flat", action="store_true")
    options = parser.parse_args()
    sequence = dr.ExposureSequence.from_files(
        options.frames, target=options.target, filter=options.filter
    )
    if options.flat:
        from_flat(sequence, options.opd)
        return
    first = dr.reduce(replace(sequence, references=()), options.opd).fit
    jansky = np.mean([frame.flux * (jansky_per_unit(frame) or np.nan) for frame in first.frames])
    print(f"{sequence.target}: {jansky:.4f} Jy; times it, chi-squared per pixel, candidates")
    for share in (None, *SHARES):
        fit = first if share is None else with_star_flux(first, share * float(jansky), 0.05)
        seen = [
            f"contrast {row['contrast']:.3e}, {row['flux_density']:.3e}, S/N {row['snr']:.1f}"
            for row in dr.detect(fit).candidates
        ]
        print(
            f"{share or 'fitted'}  {fit.chi2_per_pixel:.4f}  {'; '.join(seen) or 'none'}",
            flush=True,
        )


if __name__ == "__main__":
    main()
