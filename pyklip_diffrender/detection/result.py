"""The result of a detection: maps, candidates and contrast curve."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.detection.calibration import calibration_errors
from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.field import Image, require_inside
from pyklip_diffrender.detection.groups import Group, has_only_reference_stars, weigh
from pyklip_diffrender.detection.relinearise import without_light
from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.io.files import replacing, write_fits
from pyklip_diffrender.io.units import to_arcsec
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.refinement import FrameFit, Refinement

__all__ = ["Detection", "contrasts_at"]

_ROUNDS = 5
"""Largest number of refinements of the star for a bright extended source."""

_SETTLED = 0.2
"""The refinements end when its amplitude changes by less than this many standard deviations."""


def contrasts_at(groups: Sequence[Group], offsets: ArrayLike, scatter: float) -> QTable:
    """Contrasts of point sources at given positions, one at a time; see `Detection.measure`."""
    places = torch.from_numpy(np.atleast_2d(to_arcsec(offsets, "offsets")))
    if places.ndim != 2 or places.shape[1] != 2:
        raise ShapeError(f"offsets: got shape {tuple(places.shape)}, expected (k, 2)")
    require_inside(places.numpy(), groups[0][1].grid)
    products = weigh(groups, lambda templates: templates.at(places))
    error = scatter / products.information.sqrt().numpy()
    contrast = (products.numerator / products.information).numpy()
    snr = contrast / error
    calibration = scatter * calibration_errors(groups, places, torch.from_numpy(snr)).numpy()
    return QTable(
        {
            "x": places[:, 0].numpy() * u.arcsec,
            "y": places[:, 1].numpy() * u.arcsec,
            "contrast": contrast,
            "contrast_error": np.hypot(error, contrast * calibration),
            "snr": snr,
        }
    )


def _amplitude(linear: LinearModel, frame: int, shape: torch.Tensor) -> tuple[float, float]:
    products = linear.weigh({frame: shape[None]})
    information = float(products.information[0])
    return float(products.numerator[0]) / information, information**-0.5


def _less_star(frame: FrameFit) -> Image:
    """Residual of a frame of a reference star that was fitted without the target."""
    combined = frame.observation.combined()
    return np.where(combined.valid[0], combined.data[0] - frame.star, np.nan)


@dataclass(frozen=True)
class Detection:
    """Point sources in refined frames: maps, candidates, and the contrast curve.

    Everything is for point sources with the wavefront, alignment, flux and background of the star
    marginalised. Images have the first frame's pixels; positions are x, y from the star.

    Attributes
    ----------
    fits : tuple of Refinement
        Fits that were searched, after the last refinement.
    groups : tuple of (LinearModel, Templates)
        Linear model and templates of each fit of the target.
    contrast : ndarray, (ny, nx)
        Flux of a point source at every pixel over that of the star, before the coronagraph.
    error : ndarray, (ny, nx)
        Standard deviation of `contrast`, with the factor `scatter`.
    photon_error : ndarray, (ny, nx)
        Standard deviation of `contrast` for a known star.
    snr : ndarray, (ny, nx)
        contrast / error.
    residual_snr : ndarray, (ny, nx)
        The same after the candidates are removed from the data.
    scatter : float
        Factor by which all errors were multiplied, so that the S/N away from sources has a
        standard deviation of 1.
    candidates : Candidates
    threshold : float
        Smallest S/N of a candidate.
    contrast_curve : QTable
        See `contrast.contrast_table`.
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    """

    fits: tuple[Refinement, ...]
    groups: tuple[Group, ...]
    contrast: Image
    error: Image
    photon_error: Image
    snr: Image
    residual_snr: Image
    scatter: float
    candidates: Candidates
    threshold: float
    contrast_curve: QTable
    grid: Image

    def __repr__(self) -> str:
        return (
            f"<Detection: {len(self.candidates)} candidates above {self.threshold:g} sigma, "
            f"errors scaled by {self.scatter:.3g}>"
        )

    def __str__(self) -> str:
        """The candidates in words, at most 80 columns wide."""
        lines = [
            f"{row['separation'].value:7.3f} +- {row['separation_error'].value:.3f} arcsec  "
            f"{row['position_angle'].value:6.2f} +- {row['position_angle_error'].value:.2f} deg  "
            f"{row['contrast']:.2e} +- {row['contrast_error']:.1e}  {row['snr']:5.1f}"
            for row in self.table
        ]
        title = "    separation             position angle     contrast               S/N"
        none = [f"no candidate above S/N {self.threshold:g}"]
        return "\n".join([title, *lines] if lines else none)

    @property
    def north(self) -> float:
        """Position angle of the first frame's +y axis, degrees east of north; 0 if not known."""
        return self.fits[0].frames[0].observation.position_angle

    @cached_property
    def table(self) -> QTable:
        """The candidates, highest S/N first.

        Columns are separation; position angle east of north (counter-clockwise from +y of the
        first frame if its orientation is not known); contrast; magnitude difference; S/N; offsets
        in right ascension and declination; and x, y from the star on the first frame. Errors are
        standard deviations, with all parameters of the star marginalised. The error of the
        contrast includes the errors of the star's flux and of the source's own image (see
        `calibration.calibration_errors`). The S/N does not include them, because they do not
        change the significance of a source.
        """
        candidates, scatter, count = self.candidates, self.scatter, len(self.candidates)
        x, y = candidates.offsets.T.numpy()
        contrast = candidates.contrasts.numpy()
        errors = scatter * candidates.errors.numpy().reshape(-1, 3)
        covariance = candidates.covariance.numpy().reshape(3, count, 3, count)
        places = scatter**2 * np.einsum("akbk->kab", covariance)[:, 1:, 1:]
        separation = np.hypot(x, y)
        along = np.stack([x, y], axis=1) / separation[:, None]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        radial, tangential = (
            np.sqrt(np.einsum("ka,kab,kb->k", unit, places, unit)) for unit in (along, across)
        )
        angle = np.deg2rad(self.north) + np.arctan2(-x, y)
        contrast_error = np.hypot(errors[:, 0], contrast * self._calibration_errors)
        columns = {
            "separation": (separation * u.arcsec, ".4f"),
            "separation_error": (radial * u.arcsec, ".4f"),
            "position_angle": (np.rad2deg(angle) % 360 * u.deg, ".2f"),
            "position_angle_error": (np.rad2deg(tangential / separation) * u.deg, ".2f"),
            "contrast": (contrast, ".3e"),
            "contrast_error": (contrast_error, ".1e"),
            "delta_mag": (-2.5 * np.log10(contrast) * u.mag, ".3f"),
            "delta_mag_error": (2.5 / np.log(10) * contrast_error / contrast * u.mag, ".3f"),
            "snr": (contrast / errors[:, 0], ".1f"),
            "delta_ra": (separation * np.sin(angle) * u.arcsec, ".4f"),
            "delta_dec": (separation * np.cos(angle) * u.arcsec, ".4f"),
            "x": (x * u.arcsec, ".4f"),
            "y": (y * u.arcsec, ".4f"),
            "x_error": (errors[:, 1] * u.arcsec, ".4f"),
            "y_error": (errors[:, 2] * u.arcsec, ".4f"),
        }
        table = QTable({name: values for name, (values, _) in columns.items()})
        for name, (_, form) in columns.items():
            table[name].info.format = form
        table = table[np.argsort(-table["snr"])]
        table.meta = self._provenance()
        return table

    @cached_property
    def _calibration_errors(self) -> Image:
        """Relative calibration errors of the candidates' contrasts, (k,)."""
        candidates = self.candidates
        snr = candidates.contrasts / (self.scatter * candidates.errors[:, 0])
        return self.scatter * calibration_errors(self.groups, candidates.offsets, snr).numpy()

    def measure(self, offsets: ArrayLike) -> QTable:
        """Contrast of a point source at given positions, one at a time.

        Parameters
        ----------
        offsets : (k, 2)
            x, y from the star, arcsec, image orientation of the first frame.

        Returns
        -------
        QTable
            x, y, contrast, contrast_error, snr; errors as in `table`. The candidates are not
            removed from the data.

        Raises
        ------
        IncompatibleSetupError
            For a position outside the field.
        NonFiniteError, ShapeError, UnitError
        """
        return contrasts_at(self.groups, offsets, self.scatter)

    def measure_shape(self, image: ArrayLike, *, relinearise: float = 25.0) -> tuple[float, float]:
        """Measure an extended source of known shape in the first frame, such as a ring.

        Parameters
        ----------
        image : (ny, nx)
            Image of the source at amplitude 1 behind the coronagraph, in the data's unit.
        relinearise : float
            S/N (before `scatter`) above which the source is subtracted and the star refined
            again, until the amplitude has settled, so that it does not bias the wavefront. Only
            for a single frame.

        Returns
        -------
        amplitude, error : float
        """
        shape = torch.as_tensor(np.asarray(image, dtype=float))
        if shape.shape != self.snr.shape:
            raise ShapeError(f"image: got {tuple(shape.shape)}, expected {self.snr.shape}")
        linear, scatter = self.groups[0][0], self.scatter
        amplitude, error = _amplitude(linear, 0, shape)
        total, bright = amplitude, amplitude > relinearise * error
        alone = len(self.fits) == 1 and len(self.fits[0].frames) == 1
        for _ in range(_ROUNDS if bright and alone else 0):
            fit = without_light(self.fits[0], total * shape.numpy())
            amplitude, error = _amplitude(fit.star_only, 0, shape)
            total += amplitude
            scatter = 1.0 if fit.status.calibrated else self.scatter
            if abs(amplitude) < _SETTLED * error:
                break
        return total, scatter * error

    @cached_property
    def subtracted(self) -> tuple[Image, ...]:
        """Star-subtracted frames of all fits, with the candidates as part of the model.

        A fit without a companion in its model attributes some of its light to the star, so that
        `Refinement.residual` has lost that light. Here the candidates lose no light, only sources
        below the threshold do. Images (ny, nx) are in the order of `fits`, in the data's unit, and
        NaN where the data are masked; frames of one observation are averaged.
        """
        images: list[Image] = []
        groups = iter(self.groups)
        for fit in self.fits:
            if has_only_reference_stars(fit):
                images += [_less_star(frame) for frame in fit.frames]
                continue
            linear, templates = next(groups)
            light = self.candidates.light(templates)
            # Candidates are removed before the star is estimated, and added again afterwards.
            cleaned = linear.clean(light) if light else {}
            for k, frame in enumerate(linear.frames):
                left = linear.cleaned[k]
                if cleaned:
                    left = left - cleaned[k][0]
                image = left / frame.weight + light.get(k, torch.zeros(1))[0]
                images.append(torch.where(frame.weight > 0, image, torch.nan).numpy())
        return tuple(images)

    @cached_property
    def left_out(self) -> tuple[Image, Image]:
        """Residual of every 5 x 5 patch of the first frame for a fit without the patch.

        The second image is its standard deviation, without `scatter`. Both are (ny, nx) in the
        data's unit.
        """
        residual, deviation = self.groups[0][0].left_out(5, 0)
        return residual.numpy(), deviation.numpy()

    def _provenance(self) -> dict[str, object]:
        from pyklip_diffrender import __version__

        return {
            "software": f"pyklip_diffrender {__version__}",
            "observations": [f.observation.name for fit in self.fits for f in fit.frames],
            **self.fits[0].summary(),
            "scatter": self.scatter,
            "threshold": self.threshold,
            "orientation": (
                "position angles counter-clockwise from +y of the first frame"
                if self.fits[0].frames[0].observation.position_angles is None
                else "position angles east of north"
            ),
        }

    def plot(self, ax: Any = None) -> NDArray[Any]:
        """Draw the S/N map with the candidates, and the contrast curve.

        The map is in arcsec from the star; arrows point to north and east where the position angle
        of the first frame is known.

        Parameters
        ----------
        ax : two Axes, optional
            Default those of a new figure.

        Returns
        -------
        ndarray of Axes, (2,)
        """
        from pyklip_diffrender import plotting

        return plotting.plot_detection(self, ax)

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write maps (FITS), candidates and contrast curve (ECSV); returns the paths."""
        folder = Path(folder)
        primary = fits.PrimaryHDU()
        for key, value in self._provenance().items():
            text = ", ".join(value) if isinstance(value, list) else value
            primary.header[f"HIERARCH {key}"] = text
        unit = self.fits[0].frames[0].observation.unit.to_string("fits")
        hdus = fits.HDUList([primary])
        for name, image, image_unit in (
            ("SNR", self.snr, ""),
            ("RESIDUAL_SNR", self.residual_snr, ""),
            ("CONTRAST", self.contrast, ""),
            ("CONTRAST_ERROR", self.error, ""),
            ("PHOTON_ERROR", self.photon_error, ""),
            ("LEFT_OUT", self.left_out[0], unit),
            ("LEFT_OUT_ERROR", self.left_out[1], unit),
            ("OFFSET_X", self.grid[..., 0], "arcsec"),
            ("OFFSET_Y", self.grid[..., 1], "arcsec"),
        ):
            hdu = fits.ImageHDU(image.astype(np.float32), name=name)
            hdu.header["BUNIT"] = image_unit
            hdus.append(hdu)
        for k, image in enumerate(self.subtracted):
            hdu = fits.ImageHDU(image.astype(np.float32), name="SUBTRACTED", ver=k + 1)
            hdu.header["BUNIT"] = unit
            hdus.append(hdu)
        maps = folder / "detection.fits"
        write_fits(hdus, maps)
        written = [maps]
        for name, table in (("candidates", self.table), ("contrast", self.contrast_curve)):
            path = folder / f"{name}.ecsv"
            with replacing(path) as temporary:
                table.write(temporary, format="ascii.ecsv", overwrite=True)
            written.append(path)
        return written
