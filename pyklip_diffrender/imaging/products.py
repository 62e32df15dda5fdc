"""Images of a reduction that one takes away: the cleaned sky and the matched filter."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from pyklip_diffrender.detection import Detection
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.imaging.sky import SkyModel
from pyklip_diffrender.io.files import write_fits
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates

__all__ = ["SkyImages", "peak_of_source", "sky_images"]

Image = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SkyImages:
    """Images of everything but the star, with north up and the star in the middle.

    Attributes
    ----------
    cleaned : ndarray, (ny, nx)
        Posterior mean of the sky, see `SkyModel`, in the unit of the frames; NaN beyond them.
    cleaned_error : ndarray, (ny, nx)
        Its standard deviation.
    throughput : ndarray, (ny, nx)
        Fraction of the peak of a faint point source that `cleaned` keeps.
    flux : ndarray, (ny, nx)
        Brightest pixel, without a coronagraph, of the point source at every pixel that fits the
        frames best (matched filter), in the unit of the frames.
    flux_error : ndarray, (ny, nx)
        Its standard deviation; 5 times it is the detection limit.
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    observation : Observation
        The first frame.
    provenance : mapping
        Of the fit, for headers.
    """

    cleaned: Image
    cleaned_error: Image
    throughput: Image
    flux: Image
    flux_error: Image
    grid: Image
    observation: Observation
    provenance: Mapping[str, object]

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write ``cleaned.fits`` and ``flux.fits``, atomically; returns the paths.

        ``cleaned.fits`` has the extensions IMAGE, ERROR and THROUGHPUT, ``flux.fits`` has IMAGE and
        ERROR, single precision, all with world coordinates.
        """
        if self.observation.position_angles is None:
            upright = self.observation
        else:
            angles = np.zeros_like(self.observation.position_angles)
            upright = replace(self.observation, position_angles=angles)
        cards = world_coordinates(self.grid, upright)
        unit = self.observation.unit.to_string("fits")
        files = {
            "cleaned.fits": {
                "IMAGE": (self.cleaned, unit),
                "ERROR": (self.cleaned_error, unit),
                "THROUGHPUT": (self.throughput, ""),
            },
            "flux.fits": {"IMAGE": (self.flux, unit), "ERROR": (self.flux_error, unit)},
        }
        written = []
        for name, images in files.items():
            hdus = [primary_hdu(self.observation, self.provenance)]
            inner = self.throughput[np.isfinite(self.throughput)]
            hdus[0].header["DRTHRU"] = (
                float(np.median(inner)) if name == "cleaned.fits" and inner.size else 1.0,
                "median throughput of faint sources",
            )
            for label, (image, its_unit) in images.items():
                hdu = fits.ImageHDU(image.astype(np.float32), cards.copy(), name=label)
                hdu.header["BUNIT"] = its_unit
                hdus.append(hdu)
            written.append(Path(folder) / name)
            write_fits(fits.HDUList(hdus), written[-1])
        return written


def sky_images(detection: Detection) -> SkyImages:
    """Make the images of a searched fit.

    Parameters
    ----------
    detection : Detection
        With its fits.
    """
    fits_ = detection.fits
    model, first = SkyModel(fits_), fits_[0].frames[0]
    covered = model.covered
    places = np.moveaxis(model.pixels_in_frame(first.grid, first.observation.position_angle), -1, 0)
    peak = peak_of_source(Templates(fits_[0], first))

    def turned(image: Image, order: int) -> Image:
        filled = np.where(np.isfinite(image), image, 0.0)
        return np.asarray(map_coordinates(filled, places, order=order, cval=np.nan))

    factor = np.ones_like(detection.error)
    if detection.error_factor is not None:
        factor = detection.error_factor.at(np.hypot(*np.moveaxis(model.grid, -1, 0)))
    return SkyImages(
        cleaned=np.where(covered, model.estimate()[0], np.nan),
        cleaned_error=factor * model.deviation(),
        throughput=turned(model.throughput(), 1),
        flux=peak * turned(detection.contrast, 3),
        flux_error=peak * turned(detection.error, 1),
        grid=model.grid,
        observation=first.observation,
        provenance=fits_[0].summary(),
    )


def peak_of_source(templates: Templates) -> float:
    """Return the brightest pixel of an unocculted source that is as bright as the star."""
    ny, nx = templates.origin.observation.shape
    # Halfway to the edge the mask does not matter.
    row, column = np.array([ny // 2]), np.array([(3 * nx) // 4])
    return float(next(iter(templates.at_pixels(row, column).values()))[0].max())
