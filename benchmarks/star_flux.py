"""How well do real frames determine the flux of their star? Fits with brighter and fainter stars.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.star_flux --target HIP17695 --filter F444W
    python -m benchmarks.star_flux --frames ../shared/data/hip65426_f444w_calints.fits.gz
        --opd ../shared/data/opd_2022-07-30.fits.gz

The rolls of a target are fitted by `reduce`, and again with the star's flux held within 0.3 % of
several values. It prints chi-squared and what is measured of the candidates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import pyklip_diffrender as dr
from benchmarks.real_options import real_frames_parser
from pyklip_diffrender.refinement import jansky_per_unit, with_star_flux

SHARES = (1.0, 0.9, 1.1, 1.2)


def main() -> None:
    """Fit with several fluxes."""
    parser = real_frames_parser(__doc__, target=None, band=None)
    options = parser.parse_args()
    sequence = dr.Sequence.from_files(options.frames, target=options.target, filter=options.filter)
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
