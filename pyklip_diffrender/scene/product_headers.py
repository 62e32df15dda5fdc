"""FITS headers of products: what was observed, how it was reduced, and world coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.io.headers import fits_text, known_number, known_text, set_keyword
from pyklip_diffrender.scene.observation import Observation

_OBSERVED = (
    "TELESCOP", "INSTRUME", "DETECTOR", "CHANNEL", "FILTER", "PUPIL", "CORONMSK", "SUBARRAY",
    "APERNAME", "EXP_TYPE", "PROGRAM", "TARGPROP", "TARGNAME", "TARG_RA", "TARG_DEC", "DATE-BEG",
)  # fmt: skip
"""Cards of the first frame that hold for its products."""

_REDUCED = {
    "software": "DRVERS",
    "status": "DRSTAT",
    "chi2_per_pixel": "DRCHI2",
    "model_error": "DRMODERR",
    "scatter": "DRERRFAC",
    "threshold": "DRTHRESH",
    "star_flux_density_jy": "DRSTARJY",
    "frames": "DRNFRAME",
    "seconds": "DRSECS",
    "opd": "DROPD",
    "opd_sha256": "DRSHA256",
    "pattern": "DRPATTRN",
}
"""Keywords of a reduction's provenance."""


def primary_hdu(
    observation: Observation, provenance: Mapping[str, Any], mjd: float | None = None
) -> fits.PrimaryHDU:
    """Make a primary HDU without data, with cards of the first frame, `observation`.

    Known entries of `provenance` become DR keywords, its observations lines of HISTORY; `mjd` is
    the mean of the mid-exposures, UTC.
    """
    hdu = fits.PrimaryHDU()
    header = hdu.header
    for key in _OBSERVED:
        if key in observation.header:
            header[key] = (observation.header[key], observation.header.comments[key])
    header["OBJECT"] = fits_text(observation.target)
    if observation.filter is not None:
        header["FILTER"] = fits_text(observation.filter)
    if observation.date is not None:
        header["DATE-BEG"] = observation.date.isot
    if mjd is not None:
        header["MJD-AVG"] = (mjd, "mean mid-exposure, UTC")
    for name, key in _REDUCED.items():
        if provenance.get(name) is not None:
            set_keyword(header, key, provenance[name])
    for name in provenance.get("observations", ()):
        header.add_history(fits_text(f"frame {name}"))
    return hdu


def world_coordinates(grid: NDArray[np.float64], observation: Observation) -> fits.Header:
    """WCS of the pixels of a frame; `grid`, (ny, nx, 2), is x, y from the star in arcsec.

    The star is at the reference coordinates of the frame (CRVAL), where the telescope pointed. If
    these or the orientation are not known, the coordinates are x, y from the star in arcsec.
    """
    columns, rows = grid.shape[1] - 1, grid.shape[0] - 1
    steps = np.diag(observation.pixelscale)
    if columns and rows:
        # Over the whole frame, because the difference of neighbours has more of rounding.
        ends = np.stack([grid[0, -1], grid[-1, 0]], axis=1)
        steps = (ends - grid[0, 0][:, None]) / (columns, rows)
    star = 1 - np.linalg.solve(steps, grid[0, 0])
    axes, unit, values = ("X", "Y"), "arcsec", (0.0, 0.0)
    ra, dec = (known_number(observation.header, key) for key in ("CRVAL1", "CRVAL2"))
    if observation.position_angles is not None and ra is not None and dec is not None:
        axes, unit, values = ("RA---TAN", "DEC--TAN"), "deg", (ra, dec)
        # With +y at the angle p east of north, and +x to the west where p is 0: east = -x cos p + y
        # sin p, north = x sin p + y cos p.
        angle = np.deg2rad(observation.position_angle)
        sine, cosine = np.sin(angle), np.cos(angle)
        steps = np.array([[-cosine, sine], [sine, cosine]]) @ steps / 3600
    header = fits.Header()
    header["WCSAXES"] = 2
    for k, axis in enumerate(axes):
        header[f"CTYPE{k + 1}"] = axis
        header[f"CUNIT{k + 1}"] = unit
        header[f"CRPIX{k + 1}"] = (float(star[k]), "the star")
        header[f"CRVAL{k + 1}"] = values[k]
        for j in range(2):
            header[f"CD{k + 1}_{j + 1}"] = float(steps[k, j])
    if unit == "deg":
        header["RADESYS"] = known_text(observation.header, "RADESYS") or "ICRS"
    return header
