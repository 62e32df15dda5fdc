"""Extended light about a star: an image of it, and where it comes from."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.detection.detection_file import image_hdu
from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.detection.sky import Sky
from pyklip_diffrender.errors import CorruptFileError
from pyklip_diffrender.io.files import open_fits, require_new, write_fits
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.io.keywords import fits_unit, set_keyword
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates

__all__ = ["Disk"]


@dataclass(frozen=True, eq=False)
class Disk:
    """Extended light about a star.

    Attributes
    ----------
    fit : Refinement
        The star, fitted to the frames without the extended light.
    light : tuple of ndarray, (ny, nx)
        The extended light in every frame of the target, as the coronagraph shows it, in the data's
        unit.
    image : ndarray, (ny, nx)
        Frames minus the star, turned to the orientation of the first one and averaged, in the
        data's unit. It has the noise of the data and their resolution; NaN where no frame has a
        valid pixel.
    error : ndarray, (ny, nx)
        Standard deviation of `image` for a known star.
    grid : ndarray, (ny, nx, 2)
        x, y of the first frame's pixels from the star, arcsec.
    offsets : ndarray, (k, 2)
        x, y from the star of the sources that are not zero, arcsec, in the first frame.
    contrasts : ndarray, (k,)
        Their light as a fraction of the star's, before the coronagraph. Empty if there is no
        significant extended light; `light` is then 0.
    hides_points : ndarray of bool, (ny, nx)
        Where a point source of S/N 5 would count as extended light: mostly within two lambda/D of
        it. Limits for point sources do not hold there.
    gain : float
        Decrease of chi-squared by the sources in the frames' first fit, with the star marginalised.

    Examples
    --------
    With frames and wavefront maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", disk=True)  # doctest: +SKIP
    >>> result.disk.contrast, result.disk.orientation  # doctest: +SKIP
    """

    fit: Refinement
    light: tuple[Image, ...]
    image: Image
    error: Image
    grid: Image
    offsets: Image
    contrasts: Image
    hides_points: NDArray[np.bool_]
    gain: float

    def __repr__(self) -> str:
        return (
            f"<Disk: {len(self.contrasts)} sources, {self.contrast:.3g} of the star's light, "
            f"chi-squared lower by {self.gain:.4g}>"
        )

    def _repr_html_(self) -> str:
        angle = self.orientation
        return html_summary(
            f"Disk about {self.fit.frames[0].observation.target}",
            {
                "Light": f"{self.contrast:.3g} of the star's",
                "Sources": len(self.contrasts),
                "Decrease of chi-squared": f"{self.gain:.4g}",
                "Position angle of the long axis": None if angle is None else f"{angle:.1f} deg",
            },
        )

    @property
    def contrast(self) -> float:
        """All extended light as a fraction of the star's."""
        return float(self.contrasts.sum())

    @property
    def orientation(self) -> float | None:
        """Position angle of the long axis of the light, degrees east of north, from 0 to 180.

        The axis of the largest second moment of the sources about the star. None if there are no
        sources, or where the orientation of the frames is not known.
        """
        north = self.fit.frames[0].observation.position_angles
        if north is None or not len(self.contrasts):
            return None
        x, y = self.offsets.T
        # Twice the angle, so that both sides of the star count alike.
        doubled = 2 * np.arctan2(-x, y)
        weight = self.contrasts * (x**2 + y**2)
        angle = np.arctan2(weight @ np.sin(doubled), weight @ np.cos(doubled)) / 2
        return float((np.degrees(angle) + north[0]) % 180)

    def plot(self, ax: Any = None) -> NDArray[Any]:
        """Draw the frames without the star, and the extended light in the first one.

        A dashed line in the second encloses where a point source would count as extended light.

        Parameters
        ----------
        ax : two Axes, optional
            Default those of a new figure.

        Returns
        -------
        ndarray of Axes
        """
        axes = drawing.axes_for(ax, 2)
        observation = self.fit.frames[0].observation
        bar, north = drawing.unit_label(observation.unit), observation.north
        limit = float(np.nanpercentile(self.light[0], 99)) or float(np.nanmax(self.error))
        for each, image, title in (
            (axes[0], self.image, "frames without the star"),
            (axes[1], self.light[0], "extended light"),
        ):
            drawing.signed_image(each, image, self.grid, limit, bar=bar, title=title, north=north)
        if self.hides_points.any():
            axes[1].contour(
                *np.moveaxis(self.grid, -1, 0), self.hides_points, levels=[0.5],
                colors="0.3", linestyles="dashed", linewidths=1,
            )  # fmt: skip
        return np.array(axes)

    @property
    def table(self) -> QTable:
        """The sources: x, y, contrast."""
        x, y = self.offsets.T
        return QTable({"x": x * u.arcsec, "y": y * u.arcsec, "contrast": self.contrasts})

    def write(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write disk.fits; returns its path.

        Its extensions are IMAGE, IMAGE_ERROR, LIGHT (one for every frame), HIDES_POINTS (1 or 0),
        OFFSET_X, OFFSET_Y and the table SOURCES.

        Raises
        ------
        ExistingFileError
            If the file exists, and `overwrite` is False; it is also an `OSError`.
        """
        path = Path(folder) / "disk.fits"
        require_new([path], overwrite)
        first = self.fit.frames[0].observation
        unit, wcs = fits_unit(first.unit), world_coordinates(self.grid, first)
        shown = [each for each in self.fit.frames if not each.observation.reference]
        frames = [each.wcs for each in shown]
        sources = fits.BinTableHDU(self.table, name="SOURCES")
        set_keyword(sources.header, "DRGAIN", self.gain)
        hdus = fits.HDUList(
            [
                primary_hdu(first, self.fit.summary(), Sky.of([self.fit]).mjd),
                image_hdu(self.image, "IMAGE", unit, wcs),
                image_hdu(self.error, "IMAGE_ERROR", unit, wcs),
                *(
                    image_hdu(each, "LIGHT", unit, cards, k)
                    for k, (each, cards) in enumerate(zip(self.light, frames, strict=True), 1)
                ),
                image_hdu(np.asarray(self.hides_points, dtype=float), "HIDES_POINTS", "", wcs),
                image_hdu(self.grid[..., 0], "OFFSET_X", "arcsec", wcs),
                image_hdu(self.grid[..., 1], "OFFSET_Y", "arcsec", wcs),
                sources,
            ]
        )
        write_fits(hdus, path)
        return path

    @classmethod
    def read(cls, folder: str | os.PathLike[str], fit: Refinement) -> Disk:
        """Read disk.fits, which `write` wrote.

        Parameters
        ----------
        folder : path
        fit : Refinement
            The attribute `fit` of the disk that was written.

        Raises
        ------
        CorruptFileError
            If the file is missing, truncated, or was not written by `write`.
        """
        path = Path(folder) / "disk.fits"
        with open_fits(path) as hdus:
            try:
                table = hdus["SOURCES"].data
                lights = sum(each.name == "LIGHT" for each in hdus)
                arrays = {
                    name: native_float64(hdus[name].data)
                    for name in ("IMAGE", "IMAGE_ERROR", "HIDES_POINTS", "OFFSET_X", "OFFSET_Y")
                }
                return cls(
                    fit,
                    tuple(native_float64(hdus["LIGHT", k + 1].data) for k in range(lights)),
                    arrays["IMAGE"],
                    arrays["IMAGE_ERROR"],
                    np.stack([arrays["OFFSET_X"], arrays["OFFSET_Y"]], axis=-1),
                    np.stack([native_float64(table[name]) for name in "xy"], axis=1),
                    native_float64(table["contrast"]),
                    arrays["HIDES_POINTS"] > 0,
                    float(hdus["SOURCES"].header["DRGAIN"]),
                )
            except (KeyError, TypeError, ValueError) as error:
                raise CorruptFileError(
                    f"{path}: not a file of Disk.write ({error}). Reduce the frames again"
                ) from error
