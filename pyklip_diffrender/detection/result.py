"""What a detection gives back: maps, candidates, contrast curve, and how they are written."""

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

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.relinearise import has_only_reference_stars, without_light
from pyklip_diffrender.detection.scale import scale_errors
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.io.files import replacing, write_fits
from pyklip_diffrender.io.units import require_finite, to_arcsec
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.refinement import FrameFit, Refinement

__all__ = ["Detection", "amplitudes"]

Image = NDArray[np.float64]

_ROUNDS = 5
"""How often the star is refined anew for a bright extended source, at most."""

_SETTLED = 0.2
"""Changes of its amplitude by less than so many of its errors end that."""


def amplitudes(
    groups: Sequence[tuple[LinearModel, Templates]], offsets: ArrayLike, scatter: float
) -> QTable:
    """Contrasts of point sources at some positions, one at a time; see `Detection.measure`."""
    places = torch.from_numpy(np.atleast_2d(to_arcsec(offsets, "offsets")))
    if places.ndim != 2 or places.shape[1] != 2:
        raise ShapeError(f"offsets: got shape {tuple(places.shape)}, expected (k, 2)")
    _require_inside(places.numpy(), groups[0][1].grid)
    numerator = torch.zeros(len(places), dtype=torch.float64)
    information = torch.zeros_like(numerator)
    for linear, templates in groups:
        weighed = linear.weigh(templates.at(places))
        numerator += weighed.numerator
        information += weighed.information
    error = scatter / information.sqrt().numpy()
    contrast = (numerator / information).numpy()
    snr = contrast / error
    scale = scatter * scale_errors(groups, places, torch.from_numpy(snr)).numpy()
    return QTable(
        {
            "x": places[:, 0].numpy() * u.arcsec,
            "y": places[:, 1].numpy() * u.arcsec,
            "contrast": contrast,
            "contrast_error": np.hypot(error, contrast * scale),
            "snr": snr,
        }
    )


def _require_inside(places: Image, grid: Image) -> None:
    """Refuse positions (k, 2) farther from the star than any pixel of a grid (ny, nx, 2)."""
    require_finite(places, "offsets")
    # Pixels have an extent; half a diagonal beyond their centres is still on the detector.
    pixel = np.hypot(*(grid[1, 1] - grid[0, 0])) if min(grid.shape[:2]) > 1 else 0.0
    reach = np.hypot(grid[..., 0], grid[..., 1]).max() + pixel / 2
    distance = np.hypot(places[:, 0], places[:, 1])
    if (distance > reach).any():
        x, y = places[np.argmax(distance)]
        raise IncompatibleSetupError(
            f"offsets: got ({x:.4g}, {y:.4g}) arcsec, {distance.max():.4g} arcsec from the star; "
            f"the corners of the field are within {reach:.3g} arcsec. Give x and y from the star "
            "in arcsec, or with their unit, such as [[-485, 353]] * u.mas"
        )


def _amplitude(linear: LinearModel, frame: int, shape: torch.Tensor) -> tuple[float, float]:
    weighed = linear.weigh({frame: shape[None]})
    information = float(weighed.information[0])
    return float(weighed.numerator[0]) / information, information**-0.5


def _less_star(frame: FrameFit) -> Image:
    """Residual of a frame of a reference star that shares nothing with the others."""
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
        What was searched, after the last refinement.
    groups : tuple of (LinearModel, Templates)
    contrast : ndarray, (ny, nx)
        Of a point source at every pixel, relative to the star's light before the coronagraph.
    error : ndarray, (ny, nx)
        Its standard deviation, `scatter` included.
    photon_error : ndarray, (ny, nx)
        What it would be if the star were known.
    snr : ndarray, (ny, nx)
        contrast / error.
    residual_snr : ndarray, (ny, nx)
        The same once the candidates are taken out of the data.
    scatter : float
        Factor by which all errors were multiplied, so that S/N away from sources has a standard
        deviation of 1; exactly 1 where the fit explains its data.
    candidates : Candidates
    threshold : float
        S/N above which something is a candidate.
    contrast_curve : QTable
        See `contrast.contrast_table`.
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    """

    fits: tuple[Refinement, ...]
    groups: tuple[tuple[LinearModel, Templates], ...]
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
        first frame if its orientation is not known); offsets in right ascension and declination;
        contrast; magnitude difference; S/N; and x, y from the star on the first frame. Errors are
        standard deviations, with all parameters of the star marginalised. The error of the
        contrast includes those of the star's flux and of the source's own image (see
        `scale.scale_errors`); the S/N, which asks whether there is a source at all, does not.
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
        contrast_error = np.hypot(errors[:, 0], contrast * self._scale_errors)
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
    def _scale_errors(self) -> Image:
        """Of the candidates' contrasts, relative, (k,)."""
        found = self.candidates
        snr = found.contrasts / (self.scatter * found.errors[:, 0])
        return self.scatter * scale_errors(self.groups, found.offsets, snr).numpy()

    def measure(self, offsets: ArrayLike) -> QTable:
        """Contrast of a point source at given positions, one at a time.

        Parameters
        ----------
        offsets : (k, 2)
            x, y from the star, arcsec, image orientation of the first frame.

        Returns
        -------
        QTable
            x, y, contrast, contrast_error, snr; errors as in `table`. The other candidates stay
            in the data.

        Raises
        ------
        IncompatibleSetupError
            For a position outside the field.
        NonFiniteError, ShapeError, UnitError
        """
        return amplitudes(self.groups, offsets, self.scatter)

    def measure_shape(self, image: ArrayLike, *, relinearise: float = 25.0) -> tuple[float, float]:
        """Amplitude of an extended source of known shape in the first frame, such as a ring.

        Parameters
        ----------
        image : (ny, nx)
            What it looks like at amplitude 1, in the data's unit, behind the coronagraph.
        relinearise : float
            When it is brighter than so many of its errors (before `scatter`), the star of a single
            frame is refined anew without it, until its amplitude has settled: no wavefront
            explains its light.

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
        """Every fit's frame less the star, when the candidates are part of the model.

        A fit that knows nothing of a companion takes some of its light for the star's: what
        `Refinement.residual` leaves has lost it. Here candidates lose nothing, only sources below
        the threshold do. In the order of `fits`, (ny, nx) each, in the data's unit; frames that
        were refined as one observation are averaged; NaN where the data are masked.
        """
        images: list[Image] = []
        groups = iter(self.groups)
        for fit in self.fits:
            if has_only_reference_stars(fit):
                images += [_less_star(frame) for frame in fit.frames]
                continue
            linear, templates = next(groups)
            light = self.candidates.light(templates)
            # Taken out before the star is estimated, and put back afterwards.
            imitated = linear.clean(light) if len(self.candidates) else {}
            for k, frame in enumerate(linear.frames):
                left = linear.cleaned[k]
                if imitated:
                    left = left - imitated[k][0]
                image = left / frame.weight + light.get(k, torch.zeros(1))[0]
                images.append(torch.where(frame.weight > 0, image, torch.nan).numpy())
        return tuple(images)

    @cached_property
    def left_out(self) -> tuple[Image, Image]:
        """Residual of every 5 x 5 patch of the first frame as a fit that never saw it leaves it.

        And its standard deviation (without `scatter`), both (ny, nx) in the data's unit.
        """
        residual, deviation = self.groups[0][0].left_out(5, 0)
        return residual.numpy(), deviation.numpy()

    def _provenance(self) -> dict[str, object]:
        from pyklip_diffrender import __version__

        return {
            "software": f"pyklip_diffrender {__version__}",
            "observations": [f.observation.name for fit in self.fits for f in fit.frames],
            **{key: value for key, value in self.fits[0].summary().items()},
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
