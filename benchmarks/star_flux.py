"""How well do real frames determine the flux of their star? Fits with brighter and fainter stars.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.star_flux --target HIP17695 --filter F444W
    python -m benchmarks.star_flux --frames ../shared/data/hip65426_f444w_calints.fits.gz
        --opd ../shared/data/opd_2022-07-30.fits.gz

The rolls of a target are fitted by `reduce`, and again with the star's flux held within 0.3 % of
several values. It prints chi-squared and what is measured of the candidates. With ``--flat`` it
fits every roll and all of them together from the map and from a flat wavefront, and prints the
star's flux of the second fit over that of the first. With ``--photometry FOLDER`` it compares the
flux densities of the fits that `benchmarks.real_cases` left in FOLDER with photometry of the
stars::

    python -m benchmarks.star_flux --photometry FOLDER --table docs/results/star_flux.ecsv
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy import units as u
from astropy.table import Table

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from benchmarks.real_frames import real_frames_parser
from pyklip_diffrender.io.files import write_table
from pyklip_diffrender.refinement import jansky_per_unit, with_star_flux

SHARES = (1.0, 0.9, 1.1, 1.2)


class Magnitudes(NamedTuple):
    """Spectral type, and magnitudes of 2MASS (Ks) and WISE; None where WISE saturates."""

    spectral_type: str
    ks: float
    w1: float | None = None
    w2: float | None = None


PHOTOMETRY = {
    "G-7-34": Magnitudes("M4.5V", 8.182, 8.005, 7.809),
    "HIP17695": Magnitudes("M3.0V", 6.933, 6.812, 6.659),
    "V-AU-MIC": Magnitudes("M0.5V", 4.529),
}
"""As tabulated by Cifuentes et al. (2020, A&A 642, A115), where the first two stars are named LTT
11392 and G 080-021."""

WISE_WAVELENGTHS, WISE_ZERO_POINTS = (3.3526, 4.6028), (309.540, 171.787)
"""Micron and Jy, of W1 and W2 (Jarrett et al. 2011, ApJ 735, 112)."""

PIVOT = {"F356W": 3.572, "F444W": 4.384}
"""Pivot wavelengths of the filters, micron, by their transmission."""


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


def flux_of_wise(star: str, band: str) -> float:
    """Flux density in Jy at a filter's pivot wavelength, by a power law between W1 and W2."""
    _, _, *magnitudes = PHOTOMETRY[star]
    if None in magnitudes:
        return np.nan
    flux = np.array(WISE_ZERO_POINTS) * 10 ** (-0.4 * np.array(magnitudes))
    return float(np.exp(np.interp(np.log(PIVOT[band]), np.log(WISE_WAVELENGTHS), np.log(flux))))


def flux_of_type(star: str, band: str) -> float:
    """Flux density in Jy of the spectrum of a dwarf of the star's type and Ks magnitude."""
    about = PHOTOMETRY[star]
    text = f"{about.spectral_type}, K={about.ks}"
    return float(dr.instrument.star_flux_density(text, band).to_value(u.Jy))


def beside_photometry(folder: Path) -> Table:
    """Make a table of the flux densities of fits and of photometry, one row for each fit."""
    rows = []
    for path in sorted(folder.glob("*/row.json")):
        row = json.loads(path.read_text())
        star, band = row["star"], row["filter"]
        if star in PHOTOMETRY:
            about = {name: row[name] for name in ("star", "filter", "rolls", "library")}
            rows.append({
                **about, "references": row["references"], "fitted": row["star Jy"],
                "wise": flux_of_wise(star, band),
                "type_and_ks": flux_of_type(star, band),
            })  # fmt: skip
    table = Table(rows)
    table.meta = provenance("benchmarks.star_flux --photometry FOLDER --table FILE")
    for name in ("fitted", "wise", "type_and_ks"):
        table[name].unit, table[name].format = "Jy", ".4g"
    table["wise"].description = "power law between W1 and W2"
    table["type_and_ks"].description = "star_flux_density of spectral type and Ks"
    return table


def main() -> None:
    """Fit with several fluxes."""
    parser = real_frames_parser(__doc__, target=None, band=None)
    parser.add_argument("--flat", action="store_true")
    parser.add_argument("--photometry", type=Path, help="folder of benchmarks.real_cases")
    parser.add_argument("--table", type=Path, help="file for the comparison with photometry (ECSV)")
    options = parser.parse_args()
    if options.photometry is not None:
        table = beside_photometry(options.photometry)
        table.pprint_all()
        if options.table is not None:
            write_table(table, options.table)
        return
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
