"""Limits as they are published: contrasts, magnitudes, and masses of an evolutionary model."""

from __future__ import annotations

import os
import re
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.detection.association import checked_motion
from pyklip_diffrender.detection.field import Sky
from pyklip_diffrender.detection.measurement import magnitudes
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.tables import Column, add_columns

Array = NDArray[np.float64]

_TEN_PARSECS = 0.1
"""Parallax at the distance of absolute magnitudes, arcsec."""


def published_limits(curve: QTable, detection: Any, isochrone: Any, parallax: Any) -> QTable:
    """Make the table of `Detection.limits`, of a contrast curve of the frames of a `Detection`."""
    sky, filter = detection.sky, detection.observation.filter
    contrast = np.asarray(curve["contrast"], dtype=float)
    columns: list[Column] = [
        ("separation", curve["separation"].value, u.arcsec, ".2f", "from the star"),
        ("contrast", contrast, None, ".2e",
         f"flux relative to the star at {curve.meta['sigmas']:g} sigma, median of all angles"),
        ("dmag", magnitudes(contrast)[0], u.mag, ".2f", "magnitude difference to the star"),
    ]  # fmt: skip
    if sky.star is not None and sky.vega is not None:
        magnitude = magnitudes(contrast * sky.star[0] / sky.vega)[0]
        columns.append(("mag", magnitude, u.mag, ".2f", f"apparent Vega magnitude in {filter}"))
    if isochrone is not None:
        columns.append(("mass", *_masses(contrast, sky, filter, isochrone, parallax)))
    table = add_columns(QTable(), columns)
    table.meta = {**detection.provenance, "sigmas": curve.meta["sigmas"]}
    return table


def _masses(
    contrast: Array, sky: Sky, filter: str | None, isochrone: Any, parallax: Any
) -> tuple[Array, u.UnitBase, str, str]:
    """Masses of planets at limits, with unit, format and description of their column."""
    angle = checked_motion(None, parallax)[1]
    if not angle:
        raise IncompatibleSetupError(
            f"parallax: got {parallax!r}, expected the star's, such as '9.3 mas': models "
            "state absolute magnitudes, or fluxes at 10 pc"
        )
    if sky.star is None:
        raise IncompatibleSetupError(
            "isochrone: masses need the flux density of the star, and the frames have no "
            "photometric calibration. Take frames in MJy/sr"
        )
    mass, unit, flux = _model(isochrone, filter or "", sky.vega)
    order = np.argsort(mass)
    mass, flux = mass[order], flux[order]
    # Every planet of this mass or more is as bright: where deuterium burns, more massive ones may
    # be fainter.
    least = np.minimum.accumulate(flux[::-1])[::-1]
    limit = contrast * sky.star[0] * (_TEN_PARSECS / angle) ** 2
    with np.errstate(divide="ignore"):
        places = np.log(limit), np.log(least), np.log(mass)
    about = "from which all are brighter than the limit; NaN outside the model"
    return np.exp(np.interp(*places, left=np.nan, right=np.nan)), unit, ".3g", about


def _model(isochrone: Any, filter: str, vega: float | None) -> tuple[Array, u.UnitBase, Array]:
    """Masses (n,) with their unit, and flux densities at 10 pc, Jy, of a model's table."""
    table = isochrone
    if isinstance(isochrone, str | os.PathLike):
        try:
            table = QTable.read(isochrone)
        except FileNotFoundError:
            raise
        except Exception as error:  # Readers of astropy raise anything.
            raise CorruptFileError(
                f"{isochrone}: not a table ({str(error).strip().splitlines()[0]}). Expected one "
                "that astropy reads, such as ECSV or CSV, with columns mass and the filter"
            ) from error
    table = QTable(table)
    names = {
        what: [name for name in table.colnames if re.fullmatch(pattern, name, re.IGNORECASE)]
        for what, pattern in (("mass", "mass"), (filter, rf"(.*[^a-z0-9])?{re.escape(filter)}"))
    }
    for what, found in names.items():
        if len(found) != 1 or not what:
            raise IncompatibleSetupError(
                f"isochrone: got {len(found)} columns of {what or 'an unknown filter'} among "
                f"{', '.join(table.colnames)}, expected one: the columns are mass, and the filter "
                f"({filter}) in Vega magnitudes, mag(AB), or a flux density at 10 pc"
            )
    masses = u.Quantity(table[names["mass"][0]])
    unit = u.jupiterMass if masses.unit == u.one else masses.unit
    different = len(np.unique(masses.value))
    if different < max(len(masses), 2):
        raise IncompatibleSetupError(
            f"isochrone: got {len(masses)} rows with {different} masses, expected each mass once, "
            "and two at least. Of several ages choose one: table[table['age'] == age]"
        )
    light = table[names[filter][0]]
    kind = getattr(light, "unit", None)
    if kind in (None, u.one, u.mag):
        if vega is None:
            raise IncompatibleSetupError(
                f"isochrone: the flux of Vega in {filter} is not known. Give the column in mag(AB)"
            )
        flux = vega * 10 ** (-0.4 * np.asarray(getattr(light, "value", light), dtype=float))
    else:
        try:
            flux = light.to_value(u.Jy)
        except u.UnitConversionError as error:
            raise IncompatibleSetupError(
                f"isochrone: got {names[filter][0]} in {kind}, expected mag, mag(AB) or a flux "
                "density such as Jy, at 10 pc"
            ) from error
    known = np.isfinite(flux) & (masses.value > 0)
    return masses.value[known], unit, np.asarray(flux, dtype=float)[known]
