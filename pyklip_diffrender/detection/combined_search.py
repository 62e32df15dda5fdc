"""One search over the filters, arms and epochs of a star.

Every reduction says of every position what the flux of a point source is, and its error, with all
unknowns of the star marginalised. Different fits share no unknowns, so a source with the spectrum s
(flux densities s_f in the filters) has the amplitude and the S/N

    a = sum(s_f F_f / e_f^2) / sum(s_f^2 / e_f^2),    S/N = a sqrt(sum(s_f^2 / e_f^2)),

where F_f and e_f are the flux density in a filter and its error, by the joint likelihood of
all frames. The spectrum is not known, and the highest S/N of a family of spectra has more trials
than one spectrum, see `Family`. In what follows, places are offsets from the star to the east and
to the north, arcsec.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pyklip_diffrender.detection.association import (
    Motion,
    checked_motion,
)
from pyklip_diffrender.detection.combined_result import (
    FREE,
    Combination,
    candidates_table,
    limits_table,
    sightings_table,
)
from pyklip_diffrender.detection.combined_sources import SourceSearch
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.detection.sky_map import (
    SkyMap,
    epochs_of,
)
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.spectrum import PlanetSpectra, planet_spectra, star_flux_density
from pyklip_diffrender.io.units import require_positive, to_arcsec
from pyklip_diffrender.refinement import Status
from pyklip_diffrender.scene.exposure import common_motion, star_of

Spectra = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]

_NOT_CALIBRATED = tuple(each.name for each in Status if not each.calibrated)
"""Statuses of fits whose noise alone does not give the errors of a search."""


def combine(
    reductions: Sequence[Any],
    *,
    spectra: Spectra = ("blackbody", "flat", FREE),
    star: str | os.PathLike[str] | None = None,
    proper_motion: Any = None,
    parallax: Any = None,
    mass: Any = 1.0,
    threshold: float | None = None,
    inner: float = 0.2,
) -> Combination:
    """Search the filters, arms and epochs of a star together.

    At every position the fluxes of the reductions and their errors are combined for each spectrum
    of a family. The highest S/N of a family has more trials than one spectrum, and the
    threshold is higher, so that a combined search has as many false candidates as a single one.

    Candidates of the single searches are known sources: their light is not searched again. Then
    each epoch is searched, and what no epoch shows is looked for in the sum of all epochs, added as
    if sources moved with the star, by no more than an orbit, and as if they stayed on the sky.
    Which sources of different epochs are one, and how each moves, is decided together: see
    `Hypotheses`.

    Parameters
    ----------
    reductions : sequence of Reduction, Detection or path
        A path is a folder with the products of a reduction, whose ``detection.fits`` is
        read. A fit that does not explain its data takes part if its errors were scaled to the
        scatter of the S/N, as they are in real frames; ``Combination.remarks`` names it. A
        reduction whose frames another one has is left out.
    spectra : str, path, or sequence of them
        "blackbody" (150 to 1,500 K), "flat" (the same flux density per frequency in all filters),
        the file of a table of spectra (see `planet_spectra`), and "free": any fluxes that are
        not negative.
    star : path or str, optional
        Spectrum or spectral type of the star, see `star_flux_density`, for frames without
        photometric calibration. With it or with calibrated frames, spectra are of flux densities.
        Without either, the only spectrum beside "free" is the star's own, with the same contrast
        in all filters.
    proper_motion : (2,), Quantity, or texts such as ("377 mas/yr", "-90 mas/yr"), optional
        Proper motion of the star to the east (with cos Dec) and to the north; numbers are arcsec
        per year. Default: from the header (MU_RA, MU_DEC). Needed for several epochs. Two zeros
        are a proper motion that is not known.
    parallax : float, Quantity, or text such as "45 mas", optional
        Parallax of the star; a number is in arcsec. Without it, parallax and orbital motion are
        neglected.
    mass : float or Quantity
        Mass of the star, which the reach of orbits depends on; a number is in solar masses.
    threshold : float, optional
        S/N of a candidate in a search of one filter. Default the largest of the reductions.
    inner : float or Quantity
        Smallest separation of candidates, arcsec.

    Returns
    -------
    Combination

    Raises
    ------
    IncompatibleSetupError
        For fewer than two reductions that can be used, with the reason for each that cannot; for
        reductions of different stars; for several epochs without a proper motion; for spectra that
        do not cover a filter; for a parallax or a proper motion that no star has.
    UnitError
        For a unit that is none of an angle, or of an angle per time.
    CorruptFileError
        If a product or a table of spectra cannot be read.

    Examples
    --------
    Of folders with the products of reductions, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> both = dr.combine(["products/F356W", "products/F444W"])  # doctest: +SKIP
    >>> print(both.candidates["separation", "spectrum", "snr", "verdict"])  # doctest: +SKIP
    """
    inner = float(to_arcsec(inner, "inner"))
    require_positive(threshold=threshold, inner=inner)
    proper, angle, mass = checked_motion(proper_motion, parallax, mass)
    detections = _named([_as_detection(each) for each in reductions])
    _require_one_star(detections)
    maps, left_out = _usable(detections, star)
    target = next(iter(detections.values())).observation.target if detections else "unknown"
    if len(maps) < 2:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out)
        raise IncompatibleSetupError(
            f"combine: got {len(detections)} reductions of {target}, of which {len(maps)} can be "
            f"used; expected two or more{f' ({reasons})' if reasons else ''}"
        )
    filters = tuple(dict.fromkeys(each.filter for each in maps))
    requests = [spectra] if isinstance(spectra, str | os.PathLike) else list(spectra)
    family, free, unit, remarks = _spectra(requests, filters, maps)
    motion = None
    if len(epochs_of(maps)) > 1:
        motion = _motion(detections, proper, angle, mass)
        if motion.parallax <= 0:
            remarks.append(
                "The star's parallax is not known: it is neglected, and so are orbits; a bound "
                "source is one that does not move. Give parallax= (--parallax)"
            )
    level = threshold or max(each.threshold for each in maps)
    searcher = SourceSearch(
        maps, family, motion, free=free, unit=unit, threshold=level, inner=inner
    )
    sources = searcher.sources()
    stack = searcher.stack(searcher.unmoved, searcher.grid)
    snr = np.einsum("kf...,f...->k...", stack.weights(family.flux), stack.snr)
    names = [f"{searcher.unmoved.name}, {each}" for each in ("spectra", FREE)]
    limit = next(searcher.thresholds[name] for name in names if name in searcher.thresholds)
    return Combination(
        target=target,
        maps=maps,
        left_out=(*left_out, *family.left_out),
        spectra=family,
        free=free,
        unit=unit,
        threshold=level,
        thresholds=searcher.thresholds,
        expected_false_candidates=searcher.alarms_of_single_search(),
        candidates=candidates_table(
            sources,
            filters,
            searcher.stars,
            jansky=unit == "Jy",
            dated=maps[0].mjd is not None,
        ),
        sightings=sightings_table(sources),
        limits=limits_table(stack, family, searcher.stars, searcher.grid, level=limit, inner=inner),
        grid=searcher.grid,
        snr=np.where(np.isfinite(stack.error).any(axis=0), snr, np.nan),
        motion=motion,
        remarks=(*remarks, *_about_errors(detections, maps), *searcher.remarks),
    )


def _about_errors(detections: Mapping[str, Detection], maps: Sequence[SkyMap]) -> list[str]:
    """Which of the combined reductions have errors that rest on the scatter of their S/N alone."""
    scaled = [
        f"{each.name} ({status}, errors multiplied by {detections[each.name].scatter:.2f})"
        for each in maps
        if (status := str(detections[each.name].provenance["status"])) in _NOT_CALIBRATED
    ]
    if not scaled:
        return []
    return [
        "Fits that did not converge to a model which explains their data take part with errors "
        f"that are scaled to the scatter of the S/N: {'; '.join(scaled)}"
    ]


def _as_detection(reduction: Any) -> Detection:
    if isinstance(reduction, str | os.PathLike):
        return Detection.read(reduction)
    detection = getattr(reduction, "detection", reduction)
    if not isinstance(detection, Detection):
        raise IncompatibleSetupError(
            f"combine: got a {type(reduction).__name__}, expected a Reduction, a Detection, or a "
            "folder with the products of a reduction"
        )
    return detection


def _named(detections: Sequence[Detection]) -> dict[str, Detection]:
    """Detections by filter and date, numbered where these are equal."""
    named: dict[str, Detection] = {}
    for each in detections:
        parts = [each.observation.filter or "unknown", (each.sky.date or "")[:10]]
        name = plain = " ".join(filter(None, parts))
        number = 1
        while name in named:
            number += 1
            name = f"{plain} ({number})"
        named[name] = each
    return named


def _require_one_star(detections: Mapping[str, Detection]) -> None:
    observations = [each.observation for each in detections.values()]
    for other in observations[1:]:
        first = observations[0]
        one, two = (star_of(each.header, each.name) for each in (first, other))
        # Headers of simulated frames name no star.
        if one.is_known and two.is_known and not one.is_same(two):
            raise IncompatibleSetupError(
                f"combine: got reductions of {first.target} and {other.target}, expected "
                "reductions of one star"
            )


def _usable(
    detections: Mapping[str, Detection], star: str | os.PathLike[str] | None
) -> tuple[tuple[SkyMap, ...], tuple[tuple[str, str], ...]]:
    """Maps of the reductions that can be combined, and the others with the reason."""
    maps, left_out = [], []
    shown: dict[tuple[str | None, float, str] | None, str] = {}
    dated = any(each.sky.mjd is not None for each in detections.values())
    for name, detection in detections.items():
        status = str(detection.provenance["status"])
        frames = _frames(detection)
        reason = ""
        if status in _NOT_CALIBRATED and not detection.error_factor.is_measured:
            reason = (
                f"its fit ended as {status}, and its errors are not scaled to the scatter of the "
                "S/N, so that they are wrong"
            )
        elif detection.sky.north is None:
            reason = "its frames have no position angle"
        elif detection.observation.filter is None:
            reason = "its frames have no filter"
        elif dated and detection.sky.mjd is None:
            reason = "its frames have no date, and others have"
        elif not np.isfinite(detection.error).any():
            reason = "it has no errors"
        elif frames in shown:
            reason = f"its frames are also in {shown[frames]}"
        if reason:
            left_out.append((name, reason))
            continue
        if frames is not None:
            shown[frames] = name
        each = SkyMap.of(detection, name)
        if each.star is None and star is not None:
            each = replace(each, star=float(star_flux_density(star, each.filter).value))
        maps.append(each)
    return tuple(maps), tuple(left_out)


def _frames(detection: Detection) -> tuple[str | None, float, str] | None:
    """Filter, date and first file of what was searched; None if the frames have no date."""
    mjd, observation = detection.sky.mjd, detection.observation
    return None if mjd is None else (observation.filter, mjd, observation.name)


def _spectra(
    requests: Sequence[Any], filters: tuple[str, ...], maps: Sequence[SkyMap]
) -> tuple[PlanetSpectra, bool, str, list[str]]:
    """Spectra, whether fluxes are free as well, the unit of fluxes, and remarks."""
    if not requests:
        raise IncompatibleSetupError(
            'spectra: got none, expected "blackbody", "flat", "free", or a table of spectra'
        )
    free = FREE in requests
    listed = [each for each in requests if each != FREE]
    if len(filters) == 1:
        return PlanetSpectra(("one filter",), filters, np.ones((1, 1))), False, "contrast", []
    if all(each.star is not None for each in maps):
        return planet_spectra(listed, filters), free, "Jy", []
    # Mistakes in the request are errors in any case.
    planet_spectra(listed, filters)
    unknown = ", ".join(each.name for each in maps if each.star is None)
    remark = (
        f"The star's flux density is not known ({unknown}), so that contrasts are not converted to "
        "flux densities: the listed spectra are replaced by the star's own, the same "
        "contrast in all filters. Give the star's spectrum with star= (--star-sed)"
    )
    own = PlanetSpectra(("as the star",), filters, np.ones((1, len(filters))))
    return own, free, "contrast", [remark]


def _motion(
    detections: Mapping[str, Detection],
    proper: tuple[float, float] | None,
    parallax: float,
    mass: float,
) -> Motion:
    """Motion of the star, from the arguments or the headers."""
    observations = [each.observation for each in detections.values()]
    if proper is None:
        proper = common_motion((each.header, each.name) for each in observations)
    if proper is None:
        raise IncompatibleSetupError(
            "combine: got reductions of several epochs, and no header has the star's proper motion "
            "(MU_RA, MU_DEC). Give proper_motion= (--proper-motion), or combine the reductions of "
            "each epoch alone"
        )
    stars = [star_of(each.header, each.name).coordinates for each in observations]
    coordinates = next((each for each in stars if each is not None), None)
    return Motion(proper, parallax, coordinates, mass)
