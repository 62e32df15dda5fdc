"""The table of results: one row for each job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from astropy import units as u
from astropy.table import MaskedColumn, Table

from pyklip_diffrender.surveys.folders import Record
from pyklip_diffrender.surveys.jobs import Job

__all__ = ["COLUMNS", "row", "table_of", "write_tables"]

_AT = (0.5, 1.0, 1.5, 2.0)
"""Separations of the limits, arcsec."""

COLUMNS: dict[str, type] = {
    "name": str,
    "status": str,
    "contrast": float,
    "snr": float,
    "target": str,
    "filter": str,
    "frames": int,
    "fit_status": str,
    "reduced_chi2": float,
    "error_factor": float,
    "candidates": int,
    "separation_arcsec": float,
    "position_angle_deg": float,
    "contrast_error": float,
    **{f"limit_{each:.1f}_arcsec": float for each in _AT},
    "injected_contrast": float,
    "injected_separation_arcsec": float,
    "injected_angle_deg": float,
    "recovered_contrast": float,
    "recovered_error": float,
    "recovered_snr": float,
    "recovered": bool,
    "seconds": float,
    "peak_memory_bytes": int,
    "ended": str,
    "host": str,
    "message": str,
    "traceback": str,
    "folder": str,
    "key": str,
}
"""Columns of the results and what they hold; all but name, status, folder and key may be masked.

Contrasts come first, because a table that is too wide to print loses its middle."""

_UNITS = {
    "separation_arcsec": u.arcsec,
    "position_angle_deg": u.deg,
    "injected_separation_arcsec": u.arcsec,
    "injected_angle_deg": u.deg,
    "seconds": u.s,
    "peak_memory_bytes": u.byte,
}
"""Contrasts, S/N and counts have none."""

_FORMATS = {"contrast": ".2e", "snr": ".1f"}

_UNITS = {"arcsec": u.arcsec, "deg": u.deg, "seconds": u.s, "bytes": u.byte}
"""Units by the last word of the name of a column; limits are contrasts at the separation there."""

_DESCRIPTIONS = {
    "name": "sequence: target and filter, unless the configuration names it",
    "status": "of the job: finished, failed or waiting",
    "contrast": "of the candidate with the highest S/N, relative to the star without coronagraph",
    "snr": "of that candidate",
    "fit_status": "how the fit of the star ended",
    "error_factor": "median factor by which errors were multiplied",
    "candidates": "number of candidates",
    "separation_arcsec": "of that candidate from the star",
    "position_angle_deg": "of that candidate, east of north",
    "contrast_error": "standard deviation of contrast",
    **{f"limit_{each:.1f}_arcsec": f"contrast limit at {each:g} arcsec" for each in _AT},
    "recovered": "whether a candidate is within 0.1 arcsec of the injected planet",
    "seconds": "duration of the job",
    "peak_memory_bytes": "largest memory of the job",
    "folder": "name of the folder with the products, in jobs",
    "ended": "time at which the job ended, UTC",
}


def row(job: Job, record: Record | None) -> dict[str, Any]:
    """One row: what is known of a job, which waits if it has no record."""
    record = record or {"status": "waiting"}
    result: Mapping[str, Any] = record.get("result") or {}
    values = {key: record.get(key, result.get(key)) for key in COLUMNS}
    values |= {"name": job.name, "folder": job.folder, "key": job.key}
    candidates = result.get("candidates")
    values["candidates"] = None if candidates is None else len(candidates)
    if candidates:
        best = max(candidates, key=lambda each: each["snr"])
        names = ("snr", "separation_arcsec", "position_angle_deg", "contrast", "contrast_error")
        values |= {key: best[key] for key in names}
    for limit in result.get("limits", ()):
        key = f"limit_{limit['separation_arcsec']:.1f}_arcsec"
        if key in values:
            values[key] = limit["contrast"]
    if job.injection is not None:
        planet, seen = job.injection, result.get("recovered", {})
        values |= {
            "injected_contrast": planet.contrast,
            "injected_separation_arcsec": planet.separation,
            "injected_angle_deg": planet.angle,
            "recovered_contrast": seen.get("contrast"),
            "recovered_error": seen.get("contrast_error"),
            "recovered_snr": seen.get("snr"),
            "recovered": seen.get("detected"),
        }
    return values


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The rows as a table, in which what is not known is masked."""
    table = Table()
    for name, kind in COLUMNS.items():
        values = [each[name] for each in rows]
        known = [kind() if value is None else kind(value) for value in values]
        table[name] = MaskedColumn(known, mask=[value is None for value in values], dtype=kind)
        table[name].unit = _UNITS.get(name)
        table[name].info.format = _FORMATS.get(name)
        table[name].unit = _unit(name)
        table[name].description = _DESCRIPTIONS.get(name, "")
    return table


def _unit(name: str) -> u.UnitBase | None:
    return None if name.startswith("limit_") else _UNITS.get(name.rpartition("_")[2])


def write_tables(rows: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """Write ``results.ecsv`` and, where pyarrow is installed, ``results.parquet``."""
    table_of(rows).write(folder / "results.ecsv", format="ascii.ecsv")
    if find_spec("pyarrow") is None:
        return
    import pyarrow as pa
    from pyarrow import parquet as files

    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    table = pa.Table.from_pylist(list(rows), schema=schema)
    files.write_table(table, folder / "results.parquet")
