"""The result of a search of whole frames."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import QTable
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from pyklip_diffrender import drawing
from pyklip_diffrender.detection.candidate_tables import in_words
from pyklip_diffrender.detection.detection_file import image_hdu
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Image, pixel_width, pixels_of
from pyklip_diffrender.detection.figure import draw_curve
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.io.files import require_new, write_fits, write_table
from pyklip_diffrender.io.geometry import rotation_matrix
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates

__all__ = ["WideField"]


@dataclass(frozen=True, eq=False)
class WideField:
    """Sources in whole frames.

    About the star the maps are those of the `Detection`, with the star marginalised. Elsewhere
    they are those of a matched filter on the frames without the star, extrapolated from its fit,
    and without the background. Images have the first frame's pixels.

    Attributes
    ----------
    detection : Detection
        The search of the pixels about the star.
    threshold : float
        Smallest S/N of a candidate.
    contrast, error, snr : ndarray, (ny, nx)
        As those of `Detection`; NaN where nothing is known.
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    error_factor : ErrorFactor
        Factor by which errors outside the fitted pixels were multiplied.
    candidates : QTable
        Candidates, highest S/N first, those of the detection included; columns as in
        `Detection.candidates`, and fit_chi2, shape, fwhm_major, fwhm_minor and axis_angle. An
        extended source, or several that are blended, are one row with the contrast of all of its
        light.
    contrast_curve : QTable
        See `contrast.contrast_table`.
    light : tuple of ndarray, (ny, nx)
        Light of the sources outside the fitted pixels in every frame, in the data's unit.

    Examples
    --------
    With frames and wavefront maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", wide=True)  # doctest: +SKIP
    >>> print(result.wide)  # doctest: +SKIP
    """

    detection: Detection
    threshold: float
    contrast: Image
    error: Image
    snr: Image
    grid: Image
    error_factor: ErrorFactor
    candidates: QTable
    contrast_curve: QTable
    light: tuple[Image, ...] = ()

    def __repr__(self) -> str:
        ny, nx = self.snr.shape
        return f"<WideField: {nx} x {ny} pixels, {len(self.candidates)} candidates>"

    def __str__(self) -> str:
        """The candidates in words, at most 80 columns wide."""
        return in_words(self.candidates, self.threshold)

    def _repr_html_(self) -> str:
        ny, nx = self.snr.shape
        facts = {"Star": self.observation.target, "Pixels": f"{nx} x {ny}"}
        title = f"WideField: {len(self.candidates)} candidates above {self.threshold:g} sigma"
        columns = ("separation", "position_angle", "contrast", "contrast_error", "snr", "shape")
        return html_summary(title, facts, self.candidates, columns)

    @property
    def observation(self) -> Observation:
        """The first frame, as far as it was fitted."""
        return self.detection.observation

    @property
    def north(self) -> float:
        """Position angle of the first frame's +y axis, degrees east of north; 0 if not known."""
        return self.detection.north

    def subtracted(
        self, whole: Sequence[Observation], cut: Sequence[Observation]
    ) -> tuple[Observation, ...] | None:
        """The fitted pixels without the light of sources outside them.

        Parameters
        ----------
        whole, cut : sequence of Observation
            All frames, and the cutouts that were fitted.

        Returns
        -------
        tuple of Observation or None
            None if there is too little of that light to be seen.
        """
        cleaned, seen = [], 0.0
        for light, frame, part in zip(self.light, whole, cut, strict=True):
            column, row = np.rint(frame.center[0] - part.center[0]).astype(int)
            ny, nx = part.shape
            inside = light[row : row + ny, column : column + nx]
            combined = part.combined()
            ratio = np.where(combined.valid[0], inside / combined.error[0], 0.0)
            seen = max(seen, float(np.sqrt((ratio**2).sum())))
            cleaned.append(replace(part, data=part.data - inside))
        return tuple(cleaned) if seen > self.threshold else None

    def plot(self, ax: Any = None) -> NDArray[Any]:
        """Draw the S/N map with the candidates, and the contrast curve.

        North is up, or +y of the first frame where its orientation is not known. The candidates are
        numbered as in the table.

        Parameters
        ----------
        ax : two Axes, optional
            Default those of a new figure.

        Returns
        -------
        ndarray of Axes, (2,)
        """
        axes = drawing.axes_for(ax, 2)
        grid, to_sky = self._sky_grid()
        columns, rows = np.moveaxis(pixels_of(self.grid, grid @ to_sky), -1, 0)
        snr = map_coordinates(self.snr, [rows, columns], order=1, cval=np.nan)
        table = self.candidates
        count = len(table)
        drawing.snr_map(
            axes[0], snr, grid,
            np.stack([table["x"].value, table["y"].value], axis=1) @ to_sky.T,
            None if self.observation.position_angles is None else 0.0,
            title=f"{count} candidate{'' if count == 1 else 's'} above S/N {self.threshold:g}",
            labels=[str(k) for k in range(1, count + 1)],
        )  # fmt: skip
        draw_curve(axes[1], self)
        return np.array(axes)

    def _sky_grid(self) -> tuple[Image, Image]:
        """x, y of pixels from the star with north up, (n, m, 2), and the rotation to them."""
        to_sky = rotation_matrix(self.north)
        edges = self.grid[[0, 0, -1, -1], [0, -1, 0, -1]] @ to_sky.T
        step = pixel_width(self.grid)
        low, high = np.floor(edges.min(axis=0) / step), np.ceil(edges.max(axis=0) / step)
        x, y = (step * np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
        return np.stack(np.meshgrid(x, y), axis=-1), to_sky

    def write(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write wide_field.fits (maps), and candidates and contrast curve as ECSV tables.

        Raises
        ------
        ExistingFileError
            If one of the files exists, and `overwrite` is False; it is also an `OSError`.
        """
        folder = Path(folder)
        tables = {
            folder / "wide_field_candidates.ecsv": self.candidates,
            folder / "wide_field_contrast.ecsv": self.contrast_curve,
        }
        written = [folder / "wide_field.fits", *tables]
        require_new(written, overwrite)
        about = self.detection
        wcs = world_coordinates(self.grid, self.observation)
        hdus = fits.HDUList(
            [
                primary_hdu(self.observation, about.provenance, about.sky.mjd),
                image_hdu(self.snr, "SNR", "", wcs),
                image_hdu(self.contrast, "CONTRAST", "", wcs),
                image_hdu(self.error, "CONTRAST_ERROR", "", wcs),
                image_hdu(self.grid[..., 0], "OFFSET_X", "arcsec", wcs),
                image_hdu(self.grid[..., 1], "OFFSET_Y", "arcsec", wcs),
            ]
        )
        write_fits(hdus, written[0])
        for path, table in tables.items():
            write_table(table, path)
        return written
