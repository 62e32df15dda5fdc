"""The JWST primary mirror and NIRCam's Lyot stops, from embedded tables of their outlines.

Orientation: entrance pupil, x along +V2 and y along +V3 (see `pyklip_diffrender.optics.grid`).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.io.files import embedded_table
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage, widen_polygon

TABULATED_GAP = 7.68e-3
"""Distance between neighbouring segments of the embedded outlines, m."""


def _polygons(table: str, label: str, **where: str) -> dict[str, Tensor]:
    rows = embedded_table(table)
    for column, value in where.items():
        rows = rows[rows[column] == value]
    polygons = {}
    for name in dict.fromkeys(str(value) for value in rows[label]):
        chosen = rows[rows[label].astype(str) == name]
        polygons[name] = torch.from_numpy(
            np.stack([np.array(chosen["v2"]), np.array(chosen["v3"])], axis=1).astype(np.float64)
        )
    return polygons


@lru_cache(maxsize=1)
def jwst_segments() -> dict[str, Tensor]:
    """Outlines of the 18 primary-mirror segments, (vertices, 2) in m, by name."""
    return _polygons("jwst_primary_polygons", "name", kind="segment")


@lru_cache(maxsize=1)
def maskrnd_openings() -> list[Tensor]:
    """Outlines of the 14 openings of the MASKRND Lyot stop, (vertices, 2) in m at the primary."""
    return list(_polygons("nircam_maskrnd_openings", "opening").values())


@lru_cache(maxsize=1)
def maskbar_openings() -> list[Tensor]:
    """Outlines of the 14 openings of the MASKBAR Lyot stop, (vertices, 2) in m at the primary."""
    return list(_polygons("nircam_maskbar_openings", "opening").values())


@lru_cache(maxsize=4)
def _mirror_coverage(grid: PupilGrid) -> Tensor:
    return polygon_coverage(list(jwst_segments().values()), grid)


def is_jwst_pupil(lit: Tensor, diameter: float) -> bool:
    """Whether an aperture is JWST's primary mirror, up to struts and gaps.

    `lit` are the samples that transmit light, (npix, npix); `diameter` is the array's side, m.
    """
    mirror = _mirror_coverage(PupilGrid.full(len(lit), diameter))
    lit, full = lit.cpu(), mirror > 0.99
    # Struts and gaps cover at most 4 % of the mirror. A round pupil that fills as much of it has at
    # least 2 % of its light elsewhere, with 64 samples or more.
    inside = int((lit & (mirror > 0)).sum()) > 0.99 * int(lit.sum())
    return inside and int((lit & full).sum()) > 0.95 * int(full.sum())


def jwst_pupil(npix: int, segment_gap: float | None = None) -> Tensor:
    """Amplitude transmission of JWST's entrance pupil, (npix, npix) over 6.603464 m, float64.

    The transmission is the covered fraction of a pixel's area. `segment_gap` is the width of the
    gaps between the segments, m, by default 7.7 mm as in the embedded outlines.
    """
    # Struts of the secondary mirror as designed, stpsf's pupil "RevW". A map of 1024 samples and
    # these outlines differ by 0.1 to 0.2 %.
    # Where struts cross segment edges inside a pixel, the product of coverages is approximate, so
    # small arrays are averages of a fine one.
    fine = npix * max(1, -(-1024 // npix))
    grid = PupilGrid.full(fine)
    outlines = list(jwst_segments().values())
    if segment_gap is not None:
        # A gap becomes narrower by twice as much as each of the edges beside it moves outwards.
        growth = (TABULATED_GAP - segment_gap) / 2
        outlines = [widen_polygon(outline, growth) for outline in outlines]
    # Outlines without gaps overlap by up to a tenth of a millimetre where three of them meet.
    amplitude = polygon_coverage(outlines, grid).clamp(max=1.0)
    for strut in _polygons("jwst_primary_polygons", "name", kind="strut").values():
        amplitude = amplitude * (1 - polygon_coverage([strut], grid))
    return amplitude.reshape(npix, fine // npix, npix, fine // npix).mean(dim=(1, 3))
