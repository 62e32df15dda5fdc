"""The result of a search over filters and epochs: candidates, limits and files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender._version import __version__
from pyklip_diffrender.detection.association import Hypotheses, Motion
from pyklip_diffrender.detection.field import (
    Image,
    Positions,
    deviations_and_correlation,
    separation_of,
)
from pyklip_diffrender.detection.measurement import magnitudes
from pyklip_diffrender.detection.sky_map import SkyMap, SkyStack, date_of, epochs_of
from pyklip_diffrender.instrument.spectrum import PlanetSpectra
from pyklip_diffrender.io.files import require_new, write_fits, write_table
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.tables import Column, add_columns, plain_rows
from pyklip_diffrender.refinement.fit_file import text_hdu

COMBINED = {
    "combined.fits": "maps of the combined search",
    "combined_candidates.ecsv": "candidates of the combined search",
    "combined_limits.ecsv": "limits of the combined search, by spectrum",
}
"""Files that `Combination.write` writes, with their content."""

FREE = "free"
"""The family of all spectra without negative fluxes, and the spectrum of its candidates."""

_LIMITS_STEP_ARCSEC = 0.1
"""Step of the separations of limits, arcsec."""


@dataclass(frozen=True, eq=False)
class CombinedSource:
    """One candidate of a search over filters and epochs."""

    place: Image  # (2,), east and north of the star at the epoch `mjd`, arcsec.
    covariance: Image  # (2, 2), of the place, arcsec^2.
    mjd: float
    search: str  # In which it is most significant.
    sigmas: float  # Significance in Gaussian standard deviations, before trials.
    false_alarm: float
    spectrum: str
    snr: float  # With that spectrum.
    chi2: float  # Chi-squared of the fluxes about the best listed spectrum; NaN without one.
    fluxes: SkyStack  # At the place, (filters,).
    hypotheses: Hypotheses | None
    # Date (MJD), place (2,) and covariance (2, 2) at each epoch where it was seen.
    sightings: tuple[tuple[float, Image, Image], ...]


@dataclass(frozen=True, eq=False)
class Combination:
    """Result of `combine`.

    Attributes
    ----------
    target : str
    maps : tuple of SkyMap
        Maps of the reductions that were searched together.
    left_out : tuple of (str, str)
        Reductions, and spectra of a file, that were not used, and why.
    spectra : PlanetSpectra
        In the filters of `maps`. If the star's flux density is not known, the only one has the same
        contrast in all filters.
    free : bool
        Whether any spectrum without negative fluxes was searched as well.
    unit : "Jy" or "contrast"
        Unit of the fluxes to which the spectra refer.
    threshold : float
        S/N of a candidate of a single search.
    thresholds : dict of str to float
        By search and family of spectra: the S/N that noise exceeds as rarely, in Gaussian standard
        deviations.
    expected_false_candidates : float
        Number of candidates that noise makes in all the searches: as many as in the search of a
        single filter with `threshold`.
    candidates : QTable
        One row for each source, the least probable false alarm first; every column has a
        description.
    sightings : QTable
        Place of each candidate at each epoch at which it was seen by itself: the number of the
        candidate (from 1), the date, offsets to the east and north with errors and correlation.
    limits : QTable
        Contrast of a planet that would be a candidate, by spectrum and separation.
    grid : ndarray, (ny, nx, 2)
        East and north of the star of the pixels of `snr`, arcsec.
    snr : ndarray, (spectra, ny, nx)
        S/N of a source with each spectrum that does not move; NaN where nothing is known.
    motion : Motion or None
        If there are several epochs.
    remarks : tuple of str
        What has to be known to read the result.

    Examples
    --------
    Of folders with the products of reductions, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> both = dr.combine(["products/F356W", "products/F444W"])  # doctest: +SKIP
    >>> both.candidates["contrast_F356W", "snr_F356W"]  # doctest: +SKIP
    """

    target: str
    maps: tuple[SkyMap, ...]
    left_out: tuple[tuple[str, str], ...]
    spectra: PlanetSpectra
    free: bool
    unit: str
    threshold: float
    thresholds: dict[str, float]
    expected_false_candidates: float
    candidates: QTable
    sightings: QTable
    limits: QTable
    grid: Image
    snr: Image
    motion: Motion | None = None
    remarks: tuple[str, ...] = ()

    def __repr__(self) -> str:
        count = len(self.candidates)
        return (
            f"<Combination of {len(self.maps)} reductions of {self.target}: {count} "
            f"candidate{'' if count == 1 else 's'}>"
        )

    @property
    def dates(self) -> list[float]:
        """Mean date of each epoch, MJD, in order of time."""
        return [date_of(each) for each in epochs_of(self.maps)]

    def to_dict(self) -> dict[str, Any]:
        """Return the search as plain values for JSON; names end in the unit of their values."""
        return {
            "target": self.target,
            "filters": list(self.spectra.filters),
            "reductions": [
                {"name": each.name, "filter": each.filter, "epoch_mjd": each.mjd,
                 "star_flux_density_Jy": each.star}
                for each in self.maps
            ],
            "left_out": [{"name": name, "reason": reason} for name, reason in self.left_out],
            "spectra": [
                {"name": name, "flux": dict(zip(self.spectra.filters, row.tolist(), strict=True))}
                for name, row in zip(self.spectra.names, self.spectra.flux, strict=True)
            ],
            "free": self.free,
            "flux_unit": self.unit,
            "threshold_snr": self.threshold,
            "thresholds_sigmas": self.thresholds,
            "expected_false_candidates": self.expected_false_candidates,
            "proper_motion_arcsec_per_year": (
                None if self.motion is None else list(self.motion.proper)
            ),
            "parallax_arcsec": None if self.motion is None else self.motion.parallax or None,
            "candidates": plain_rows(self.candidates),
            "sightings": plain_rows(self.sightings),
            "limits": plain_rows(self.limits),
            "remarks": list(self.remarks),
        }  # fmt: skip

    def write(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write the maps (``combined.fits``), the candidates and the limits (ECSV).

        The FITS file has the extensions SNR, a plane for each spectrum, EAST and NORTH of the star,
        arcsec, and FACTS, the content of `to_dict` as JSON text, one byte a pixel.

        Parameters
        ----------
        folder : path
            Made if it does not exist.
        overwrite : bool
            Replace the files of an earlier search.

        Raises
        ------
        ExistingFileError
            If one of the files exists, and `overwrite` is False; it is also an `OSError`.
        """
        paths = [Path(folder) / name for name in COMBINED]
        require_new(paths, overwrite)
        hdus = fits.HDUList([fits.PrimaryHDU()])
        hdus[0].header["OBJECT"] = fits_text(self.target)
        for name, values in (
            ("SNR", self.snr), ("EAST", self.grid[..., 0]), ("NORTH", self.grid[..., 1]),
        ):  # fmt: skip
            hdus.append(fits.ImageHDU(np.ascontiguousarray(values, dtype=np.float64), name=name))
            hdus[-1].header["BUNIT"] = "" if name == "SNR" else "arcsec"
        for k, name in enumerate(self.spectra.names, 1):
            hdus["SNR"].header[f"SPEC{k}"] = fits_text(name)
        hdus.append(text_hdu("FACTS", self.to_dict()))
        write_fits(hdus, paths[0])
        facts = {
            "software": __version__,
            "target": self.target,
            "filters": list(self.spectra.filters),
            "reductions": [each.name for each in self.maps],
        }
        write_table(self.candidates, paths[1], facts)
        write_table(self.limits, paths[2], facts)
        return paths


def candidates_table(
    sources: Sequence[CombinedSource],
    filters: Sequence[str],
    stars: Mapping[str, float],
    *,
    jansky: bool,
    dated: bool,
) -> QTable:
    """Make the table of candidates; see `Combination.candidates`.

    `filters` are the filters with fluxes, and `stars` has the flux of the star by filter, in the
    same unit: Jy, or contrast if `jansky` is False. `dated` says whether the epoch is known.
    """
    count = len(sources)
    places = np.array([each.place for each in sources]).reshape(-1, 2)
    covariance = np.array([each.covariance for each in sources]).reshape(-1, 2, 2)
    # In a frame whose +y is north, x is west.
    west = np.diag([-1.0, 1.0])
    positions = Positions(places @ west, west @ covariance @ west)
    separation_error, angle_error, polar = deviations_and_correlation(positions.polar_covariance)

    def texts(values: Iterable[str]) -> NDArray[np.str_]:
        return np.array(list(values), dtype="U60")

    def numbers(name: str) -> Image:
        return np.array([getattr(each, name) for each in sources], dtype=float)

    columns: list[Column] = [
        ("separation", positions.separation, u.arcsec, ".4f", "from the star"),
        ("position_angle", positions.position_angle, u.deg, ".2f", "east of north"),
        ("snr", numbers("snr"), None, ".1f", "flux over its error, with the spectrum"),
        ("spectrum", texts(each.spectrum for each in sources), None, "",
         "with the highest S/N, or free"),
        ("sigmas", numbers("sigmas"), None, ".2f",
         "significance in Gaussian standard deviations, before trials"),
        ("false_alarm_probability", numbers("false_alarm"), None, ".1e",
         "of a peak anywhere, in any of the searches, with any spectrum"),
        ("search", texts(each.search for each in sources), None, "",
         "in which it is most significant"),
        ("separation_error", separation_error, u.arcsec, ".4f", "standard deviation"),
        ("position_angle_error", angle_error, u.deg, ".2f", "standard deviation"),
        ("seppa_corr", polar, None, ".3f", "correlation of separation and position angle"),
        *_offsets(places, covariance),
        ("spectrum_chi2", numbers("chi2"), None, ".1f",
         "of the fluxes about the best listed spectrum; as many degrees of freedom as there are "
         "filters, less one"),
    ]  # fmt: skip
    if dated:
        columns.append(("epoch_mjd", numbers("mjd"), None, ".5f", "of the position, UTC"))
    for k, name in enumerate(filters):
        columns += _fluxes(sources, k, name, stars[name], jansky=jansky)
    known = [each.hypotheses for each in sources if each.hypotheses is not None]
    if len(known) == count > 0:
        columns += [
            *(
                (f"probability_{name}", np.array([getattr(each, name) for each in known]), None,
                 ".3f", f"that it {about}, if all three are equally probable before")
                for name, about in (
                    ("bound", "moves with the star"),
                    ("background", "stays on the sky"),
                    ("neither", "does neither"),
                )
            ),
            ("ln_evidence_ratio", np.array([each.ln_ratio for each in known]), None, ".1f",
             "of a bound source to one in the background"),
            ("verdict", texts(each.verdict for each in known), None, "",
             "hypothesis of at least 99 %"),
        ]  # fmt: skip
    return add_columns(QTable(), columns)


def _fluxes(
    sources: Sequence[CombinedSource], k: int, name: str, star: float, *, jansky: bool
) -> list[Column]:
    """Columns of the fluxes of sources in filter `k`, called `name`, where the star has `star`."""
    snr, error = (
        np.array([getattr(each.fluxes, kind)[k] for each in sources], dtype=float)
        for kind in ("snr", "error")
    )
    is_known = np.isfinite(error)
    snr, error = np.where(is_known, snr, np.nan), np.where(is_known, error, np.nan)
    columns: list[Column] = [
        (f"contrast_{name}", snr * error / star, None, ".3e", f"in {name}"),
        (f"contrast_error_{name}", error / star, None, ".1e",
         "without errors of the star's flux and of the source's image"),
        (f"snr_{name}", snr, None, ".1f", f"in {name} alone"),
    ]  # fmt: skip
    if jansky:
        columns += [
            (f"flux_density_{name}", snr * error, u.Jy, ".3e", f"in {name}"),
            (f"flux_density_error_{name}", error, u.Jy, ".1e", "without the calibration's error"),
        ]
    return columns


def sightings_table(sources: Sequence[CombinedSource]) -> QTable:
    """Make the table of places by epoch; see `Combination.sightings`."""
    rows = [(k, *seen) for k, each in enumerate(sources, 1) for seen in each.sightings]
    places = np.array([place for _, _, place, _ in rows]).reshape(-1, 2)
    covariance = np.array([each for *_, each in rows]).reshape(-1, 2, 2)
    numbers = np.array([each[0] for each in rows], dtype=int)
    dates = np.array([each[1] for each in rows], dtype=float)
    return add_columns(
        QTable(),
        [
            ("candidate", numbers, None, "", "row in the table of candidates, from 1"),
            ("epoch_mjd", dates, None, ".5f", "of the position, UTC"),
            *_offsets(places, covariance),
        ],
    )


def _offsets(places: Image, covariance: Image) -> list[Column]:
    """Columns of offsets (k, 2) to the east and north, arcsec, with covariances (k, 2, 2)."""
    east_error, north_error, correlation = deviations_and_correlation(covariance)
    return [
        ("delta_ra", places[:, 0], u.arcsec, ".4f", "offset to the east, dRA cos(Dec)"),
        ("delta_ra_error", east_error, u.arcsec, ".4f", "standard deviation"),
        ("delta_dec", places[:, 1], u.arcsec, ".4f", "offset to the north"),
        ("delta_dec_error", north_error, u.arcsec, ".4f", "standard deviation"),
        ("radec_corr", correlation, None, ".3f", "correlation of delta_ra and delta_dec"),
    ]


def limits_table(
    stack: SkyStack,
    spectra: PlanetSpectra,
    stars: Mapping[str, float],
    grid: Image,
    *,
    level: float,
    inner: float,
) -> QTable:
    """Make the table of limits at the threshold `level`; see `Combination.limits`.

    The stack is at the pixels of `grid` (ny, nx, 2), east and north, arcsec; `stars` has the flux
    of the star by filter in its unit, and `inner` is the smallest separation, arcsec.
    """
    distance = separation_of(grid)
    errors = stack.amplitude_errors(spectra.flux)
    weights = stack.weights(spectra.flux)
    known = np.isfinite(stack.error).any(axis=0)
    edge = float(np.abs(grid[known]).max(initial=0.0))
    half_width = abs(float(grid[1, 1, 1] - grid[0, 0, 1])) / 2
    rows = []
    for k, name in enumerate(spectra.names):
        # At the threshold the amplitude of a spectrum s is `level` times its error, and the flux in
        # filter f is that amplitude times s_f. Contrasts are stated for the filter with the most
        # weight.
        f = int(np.argmax(weights[k][:, known].mean(axis=1)))
        for separation in np.arange(inner, edge, _LIMITS_STEP_ARCSEC):
            ring = (np.abs(distance - separation) <= half_width) & np.isfinite(errors[k])
            if ring.any():
                flux = level * float(np.median(errors[k][ring])) * spectra.flux[k, f]
                contrast = flux / stars[spectra.filters[f]]
                rows.append((name, separation, spectra.filters[f], contrast))
    names, places, best, contrasts = zip(*rows, strict=True) if rows else ((),) * 4
    table = add_columns(
        QTable(),
        [
            ("spectrum", np.array(names, dtype="U60"), None, "", "of the planet"),
            ("separation", np.array(places, dtype=float), u.arcsec, ".2f", "from the star"),
            ("filter", np.array(best, dtype="U12"), None, "",
             "to which the contrast refers: the one in which such a planet is seen best"),
            ("contrast", np.array(contrasts, dtype=float), None, ".3e",
             "of a planet that reaches the threshold, median of the ring"),
            ("delta_mag", magnitudes(np.array(contrasts, dtype=float))[0], u.mag, ".3f",
             "magnitude difference to the star"),
        ]
    )  # fmt: skip
    table.meta["sigmas"] = level
    return table


def unmoved(maps: Sequence[SkyMap]) -> dict[str, Image]:
    """No offset for any of the maps, by their names."""
    return {each.name: np.zeros(2) for each in maps}


def scales_of(maps: Sequence[SkyMap], unit: str) -> dict[str, float]:
    """Flux of contrast 1, by the name of the map."""
    return {each.name: float(each.star or 1.0) if unit == "Jy" else 1.0 for each in maps}


def star_of_filter(maps: Sequence[SkyMap], name: str, scales: Mapping[str, float]) -> float:
    """Flux of the star in a filter, mean over its maps."""
    return float(np.mean([scales[each.name] for each in maps if each.filter == name]))
