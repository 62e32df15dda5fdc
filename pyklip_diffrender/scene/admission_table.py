"""The table of admission: one row for each file, what it is used for, and what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from astropy import units as u
from astropy.table import QTable

from pyklip_diffrender.scene.exposure import Exposure
from pyklip_diffrender.scene.observation import Observation

__all__ = ["SHORT", "Row", "rows_table"]

SHORT = ("use", "star", "date", "position_angle", "integrations", "file")
"""Columns for a screen."""


@dataclass(frozen=True, eq=False)
class Row:
    """A file in the table of a sequence.

    Attributes
    ----------
    use : "target", "reference" or "excluded"
    star : str
    exposure : Exposure
        Facts from the header.
    observation : Observation or None
        The frames, unless they are excluded.
    remark : str
        Why the file is excluded, or what of it was left out.
    path : Path or None
        Of the file, where there is one.
    """

    use: Literal["target", "reference", "excluded"]
    star: str
    exposure: Exposure
    observation: Observation | None = None
    remark: str = ""
    path: Path | None = None

    @property
    def time(self) -> float:
        """Modified Julian date of the beginning; 0 where it is not known."""
        date = self.exposure.date if self.observation is None else self.observation.date
        return 0.0 if date is None else float(date.mjd)

    def values(self) -> dict[str, object]:
        """Columns of the table."""
        exposure, frames = self.exposure, self.observation
        angle = exposure.position_angle
        offset: tuple[float, float] | None = None
        date, count = exposure.date, exposure.integrations
        if frames is not None:
            angle, offset = frames.north, frames.star_offset
            date, count = frames.date, frames.count
        elif any(exposure.offset):
            offset = exposure.offset
        place = exposure.star.coordinates
        return {
            "use": self.use,
            "star": self.star or next(iter(exposure.star.names), ""),
            "date": "" if date is None else date.isot[:16],
            "position_angle": np.nan if angle is None else angle,
            "integrations": count or 0,
            "file": exposure.name,
            "remark": self.remark,
            "level": exposure.level or "",
            "exp_type": exposure.exposure_type or "",
            "exposure": exposure.identity or "",
            "ra": np.nan if place is None else place[0],
            "dec": np.nan if place is None else place[1],
            "mask": exposure.mask or "",
            "filter": exposure.filter or "",
            "detector": exposure.detector or "",
            "stop": exposure.stop or "",
            "subarray": exposure.subarray or "",
            "offset_x": np.nan if offset is None else offset[0],
            "offset_y": np.nan if offset is None else offset[1],
            "unit": exposure.unit or "",
        }


_UNITS = {
    "position_angle": u.deg, "ra": u.deg, "dec": u.deg, "offset_x": u.arcsec, "offset_y": u.arcsec,
}  # fmt: skip


def rows_table(rows: Sequence[Row]) -> QTable:
    """Make the table; see `pyklip_diffrender.Sequence.table`."""
    values = [row.values() for row in rows]
    table = QTable({name: [each[name] for each in values] for name in values[0]})
    for name, unit in _UNITS.items():
        table[name] = np.asarray(table[name], dtype=float) * unit
    table["position_angle"].info.format = ".2f"
    return table
