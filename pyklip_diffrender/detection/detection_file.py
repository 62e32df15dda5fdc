"""Files of a detection: its maps and tables, and positions for programs that fit orbits."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.table import QTable, Table

from pyklip_diffrender._version import __version__
from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.error_factor import ErrorFactor, curve_table
from pyklip_diffrender.detection.field import Image, Sky
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import replacing, require_new, write_fits, write_table
from pyklip_diffrender.io.headers import fits_unit, known_text
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.refinement.fit_file import (
    image,
    observation_hdus,
    observation_of,
    reading,
    text_hdu,
)
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates

# Positions of candidates as programs that fit orbits read them.

_JD = 2400000.5


def _orbitize(table: QTable) -> Table:
    """Columns of orbitize!'s `read_file`: mas and degrees, objects numbered from 1.

    It takes the offsets of a row and leaves separation and position angle to the reader.
    """
    return Table(
        {
            "epoch": table["epoch_mjd"],
            "object": np.arange(1, len(table) + 1),
            "raoff": table["delta_ra"].to_value("mas"),
            "raoff_err": table["delta_ra_error"].to_value("mas"),
            "decoff": table["delta_dec"].to_value("mas"),
            "decoff_err": table["delta_dec_error"].to_value("mas"),
            "radec_corr": table["radec_corr"],
            "sep": table["separation"].to_value("mas"),
            "sep_err": table["separation_error"].to_value("mas"),
            "pa": table["position_angle"].to_value("deg"),
            "pa_err": table["position_angle_error"].to_value("deg"),
            "seppa_corr": table["seppa_corr"],
        }
    )


def _backtracks(table: QTable) -> Table:
    """Columns of backtracks, in its order; orbitize! reads them as well."""
    return Table(
        {
            "epoch": table["epoch_mjd"],
            "object": np.arange(1, len(table) + 1),
            "quant1": table["delta_ra"].to_value("mas"),
            "quant1_err": table["delta_ra_error"].to_value("mas"),
            "quant2": table["delta_dec"].to_value("mas"),
            "quant2_err": table["delta_dec_error"].to_value("mas"),
            "quant12_corr": table["radec_corr"],
            "quant_type": ["radec"] * len(table),
        }
    )


def _octofitter(table: QTable) -> Table:
    """Columns of Octofitter's relative astrometry: MJD and mas."""
    names = ("epoch", "object", "ra", "σ_ra", "dec", "σ_dec", "cor")
    plain = _backtracks(table)
    plain.remove_column("quant_type")
    plain.rename_columns(plain.colnames, list(names))
    return plain


def _orvara(table: QTable) -> Table:
    """Columns of orvara's relative astrometry: arcsec and degrees, companions from 0."""
    return Table(
        {
            "jd": np.asarray(table["epoch_mjd"]) + _JD,
            "sep": table["separation"].to_value("arcsec"),
            "sep_err": table["separation_error"].to_value("arcsec"),
            "pa": table["position_angle"].to_value("deg"),
            "pa_err": table["position_angle_error"].to_value("deg"),
            "corr": table["seppa_corr"],
            "companion": np.arange(len(table)),
        }
    )


_EXPORT_FORMATS: dict[str, tuple[Callable[[QTable], Table], str]] = {
    "orbitize": (_orbitize, "ascii.csv"),
    "backtracks": (_backtracks, "ascii.csv"),
    "octofitter": (_octofitter, "ascii.csv"),
    "orvara": (_orvara, "ascii.commented_header"),
}


def write_astrometry(
    table: QTable, path: str | os.PathLike[str], format: str, *, overwrite: bool = False
) -> Path:
    """Write the positions of candidates; see `Detection.write_astrometry`."""
    if format not in _EXPORT_FORMATS:
        raise IncompatibleSetupError(
            f"format: got {format!r}, expected one of {', '.join(_EXPORT_FORMATS)}"
        )
    missing = [
        what
        for column, what in (("delta_ra", "position angle"), ("epoch_mjd", "date"))
        if column not in table.colnames
    ]
    if missing:
        raise IncompatibleSetupError(
            f"the frames have no {' and no '.join(missing)}, which an orbit needs; their headers "
            "have them in ROLL_REF, and in EXPMID or DATE-BEG"
        )
    require_new([path], overwrite)
    convert, form = _EXPORT_FORMATS[format]
    plain = convert(table)
    for name in plain.colnames:
        if plain[name].dtype.kind == "f":
            plain[name].info.format = ".7f"
    with replacing(Path(path)) as temporary:
        plain.write(temporary, format=form, overwrite=True)
    return Path(path)


# Write a detection to files, and read it again.

_WCS = re.compile(r"WCSAXES|RADESYS|(CTYPE|CUNIT|CRPIX|CRVAL)[12]|CD[12]_[12]")

_OTHER = "detection_other.fits"
"""File of the search that is deeper at some separations, beside detection.fits."""

_MAPS = {
    "SNR": "snr",
    "RESIDUAL_SNR": "residual_snr",
    "CONTRAST": "contrast",
    "CONTRAST_ERROR": "error",
    "PHOTON_ERROR": "photon_error",
}
"""Attributes of a detection by the names of their extensions."""


def image_hdu(
    array: Image, name: str, unit: str, wcs: fits.Header | None = None, version: int = 1
) -> fits.ImageHDU:
    """Make an extension of an image in double precision."""
    hdu = fits.ImageHDU(np.asarray(array, dtype=np.float64), name=name, ver=version)
    hdu.header["BUNIT"] = unit
    hdu.header.update(wcs or {})
    return hdu


def _wcs_of(hdus: fits.HDUList, name: str, frame: int) -> fits.Header:
    """Return the cards of an extension that `world_coordinates` made."""
    header = hdus[name, frame + 1].header
    cards = [each for each in header.cards if _WCS.fullmatch(each.keyword)]
    return fits.Header(cards)


def _hdus_of(detection: Any) -> fits.HDUList:
    """The FITS extensions of a `Detection`, which it reads again."""
    unit = fits_unit(detection.observation.unit)
    about, data = observation_hdus(detection.observation, 0)
    wcs = world_coordinates(detection.grid, detection.observation)
    for hdu in data:
        hdu.header.update(wcs)
    facts = {
        "threshold": detection.threshold,
        "false_alarm": detection.false_alarm,
        "rings": _table_facts(detection.rings),
        "rolls": detection.rolls,
        "candidates": vars(detection.sources),
        "calibration_errors": detection._calibration_errors,
        "sky": vars(detection.sky),
        "contrast_curve": _table_facts(detection.contrast_curve),
        "observation": about,
        "provenance": detection.provenance,
        "fit": detection._digest,
    }
    return fits.HDUList(
        [
            primary_hdu(detection.observation, detection.provenance, detection.sky.mjd),
            *(
                image_hdu(getattr(detection, attribute), name, "", wcs)
                for name, attribute in _MAPS.items()
            ),
            *(
                image_hdu(np.broadcast_to(values, detection.snr.shape), name, "", wcs)
                for name, values in (
                    ("ERROR_FACTOR", detection.error_factor.factors),
                    ("FREEDOM", detection.error_factor.freedom),
                )
            ),
            image_hdu(np.asarray(detection.has_limits, dtype=float), "HAS_LIMITS", "", wcs),
            *(
                []
                if detection.of_other is None
                else [image_hdu(detection.of_other.astype(float), "OF_OTHER", "", wcs)]
            ),
            image_hdu(detection.grid[..., 0], "OFFSET_X", "arcsec", wcs),
            image_hdu(detection.grid[..., 1], "OFFSET_Y", "arcsec", wcs),
            *(
                image_hdu(each, "SUBTRACTED", unit, cards, k)
                for k, (each, cards) in enumerate(
                    zip(detection.subtracted, detection._wcs, strict=True), 1
                )
            ),
            *data,
            text_hdu("FACTS", facts),
        ]
    )


def _maps_of(hdus: fits.HDUList) -> dict[str, Any]:
    """Return the maps, the error factor and the grid of a detection, by attribute.

    Raises `KeyError` if an extension is missing, `ValueError` if the images differ in shape.
    """
    maps: dict[str, Any] = {attribute: image(hdus, name, 0) for name, attribute in _MAPS.items()}
    maps["grid"] = np.stack([image(hdus, "OFFSET_X", 0), image(hdus, "OFFSET_Y", 0)], axis=-1)
    factors, freedom = image(hdus, "ERROR_FACTOR", 0), image(hdus, "FREEDOM", 0)
    maps["has_limits"] = image(hdus, "HAS_LIMITS", 0) > 0
    if "OF_OTHER" in hdus:
        maps["of_other"] = image(hdus, "OF_OTHER", 0) > 0
    shapes = {each.shape[:2] for each in (*maps.values(), factors, freedom)}
    if len(shapes) > 1 or maps["snr"].ndim != 2:
        raise ValueError(f"maps have the shapes {sorted(shapes)}")
    factor = ErrorFactor(factors, freedom, maps["grid"])
    if not factor.is_measured and np.ptp(factors) == 0:
        factor = ErrorFactor.constant(float(factors[0, 0]))
    return {**maps, "error_factor": factor}


def _searched_of(hdus: fits.HDUList, facts: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a detection that do not need its fit; raises as `_maps_of`."""
    curve = facts["contrast_curve"]
    return {
        "threshold": facts["threshold"],
        "sources": _candidates_of(facts["candidates"]),
        "false_alarm": np.array(facts["false_alarm"], dtype=float),
        "rings": QTable(_columns_of(facts["rings"]), meta=facts["rings"]["meta"]),
        "contrast_curve": curve_table(_columns_of(curve), curve["meta"]),
        **_maps_of(hdus),
    }


def _computed_of(hdus: fits.HDUList, facts: dict[str, Any]) -> dict[str, Any]:
    """Return the cached properties that a new detection computes from its fit, by name."""
    stars = sum(hdu.name == "SUBTRACTED" for hdu in hdus)
    return {
        "observation": observation_of(hdus, facts["observation"], 0),
        "subtracted": tuple(image(hdus, "SUBTRACTED", k) for k in range(stars)),
        "_wcs": tuple(_wcs_of(hdus, "SUBTRACTED", k) for k in range(stars)),
        "_calibration_errors": np.array(facts["calibration_errors"], dtype=float),
        "sky": Sky(**facts["sky"]),
        "provenance": {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in facts["provenance"].items()
        },
        "_digest": facts["fit"],
        "rolls": facts["rolls"],
    }


def _candidates_of(facts: dict[str, Any]) -> Candidates:
    """Make candidates from their attributes."""
    count = len(facts["contrasts"])
    shapes = {
        "offsets": (count, 2),
        "contrasts": (count,),
        "covariance": (3 * count, 3 * count),
        "detection_errors": (count,),
    }
    arrays = {
        name: torch.from_numpy(np.array(facts[name], dtype=np.float64).reshape(shape))
        for name, shape in shapes.items()
    }
    return Candidates(**arrays, converged=facts["converged"])


def _table_facts(table: QTable) -> dict[str, Any]:
    """Return the columns and the metadata of a table as settings that `text_hdu` writes."""
    return {"columns": {name: table[name] for name in table.colnames}, "meta": table.meta}


def _columns_of(facts: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of numbers of what `_table_facts` returned."""
    return {
        name: column if hasattr(column, "unit") else np.array(column, dtype=np.float64)
        for name, column in facts["columns"].items()
    }


def digest(fit: Refinement) -> str:
    """Return a hash of all fitted values, which identifies a fit also after it was written."""
    return hashlib.sha256(fit.star_only.vector.numpy().tobytes()).hexdigest()


def provenance_of(detection: Any) -> dict[str, object]:
    """Facts about the fit and the search of a `Detection`, by name."""
    first = detection.observation
    return {
        "software": __version__,
        "target": first.target,
        "filter": first.filter,
        "image_mask": known_text(first.header, "CORONMSK"),
        "observations": [each.observation.name for each in detection.fit.frames],
        **detection.fit.summary(),
        "scatter": detection.scatter,
        "threshold": detection.threshold,
        **detection.sky.facts,
        "orientation": (
            "position angles counter-clockwise from +y of the first frame"
            if detection.observation.position_angles is None
            else "position angles east of north"
        ),
    }


def write_detection(detection: Any, folder: Path, *, overwrite: bool) -> list[Path]:
    """Write a `Detection`; see its method `write`."""
    maps, positions = folder / "detection.fits", folder / "astrometry.csv"
    curve, limits = detection.contrast_curve.copy(), detection.limits()
    if "mag" in limits.colnames:
        curve["vega_mag"] = limits["mag"]
    tables = {folder / "candidates.ecsv": detection.candidates, folder / "contrast.ecsv": curve}
    beside = folder / _OTHER
    require_new([maps, *tables, positions, beside], overwrite)
    write_fits(_hdus_of(detection), maps)
    written = [maps]
    if detection.other is None:
        beside.unlink(missing_ok=True)
    else:
        write_fits(_hdus_of(detection.other), beside)
        written.append(beside)
    for path, table in tables.items():
        write_table(table, path, detection.provenance)
        written.append(path)
    if detection.sky.north is None or detection.sky.mjd is None:
        positions.unlink(missing_ok=True)
        return written
    return [*written, detection.write_astrometry(positions, overwrite=overwrite)]


def read_detection(path: Path, fit: Refinement | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a file of `write_detection`; see `Detection.read`.

    Returns the fields of the class, but for `other`, and the cached properties that a new detection
    computes from its fit, by name.
    """
    path = path / "detection.fits" if path.is_dir() else path
    with reading(path, "Detection") as (hdus, facts):
        if fit is not None:
            _require_searched(fit, facts["fit"], path)
        fields = {"stored_fit": fit, "path": path, **_searched_of(hdus, facts)}
        return fields, _computed_of(hdus, facts)


def searched_fit(path: Path, expected: str) -> Refinement:
    """The fit in the folder of a detection's file, with its linear model.

    Raises `IncompatibleSetupError` if there is no fit with a linear model, or one of another
    `digest` than `expected`.
    """
    fit = _fit_beside(path)
    _require_searched(fit, expected, path)
    return fit


def fit_name(detection: str) -> str:
    """Name of the file of the fit of a detection, by the name of the detection's file."""
    return "fit_other.fits" if detection == _OTHER else "fit.fits"


def other_file(path: Path) -> Path:
    """File of the search that is deeper at some separations, of a detection in a file."""
    return (path if path.is_dir() else path.parent) / _OTHER


def _fit_beside(path: Path) -> Refinement:
    """Read the fit that was written to the folder of a detection's file.

    Raises `IncompatibleSetupError` if there is none, or none with its linear model.
    """
    file = path.with_name(fit_name(path.name))
    if not file.is_file():
        raise IncompatibleSetupError(
            f"{path}: measurements need the linear model of the fit, and there is no {file.name} "
            "in the same folder. Pass the fit that was searched: Detection.read(path, fit=fit)"
        )
    fit = Refinement.read(file)
    if fit.stored_linear is None:
        raise IncompatibleSetupError(
            f"{file}: measurements need the linear model of the fit, and this file has none. Write "
            "the reduction with the option derivatives, or pass the fit that was "
            "searched: Detection.read(path, fit=fit)"
        )
    return fit


def _require_searched(fit: Refinement, expected: str, path: Path) -> None:
    """Raise for a fit of another `digest` than the one that was searched for a detection's file."""
    if digest(fit) != expected:
        raise IncompatibleSetupError(
            f"{path}: the fit is not the one that was searched for this detection. Pass the "
            "attribute `fit` of the detection that was written: Detection.read(path, fit=fit)"
        )
