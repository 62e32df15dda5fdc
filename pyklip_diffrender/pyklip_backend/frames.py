"""The frames of one wavelength of a pyKLIP dataset, on the pixels that were recorded if possible.

pyKLIP hands over ``dataset.input``. For JWST these frames were shifted to the centre of the array
when they were read, so noise is correlated and sharp speckles ring. If the recorded frames were
captured, the fit gets those, plus whatever was added to ``dataset.input`` since (an injected
companion, say), and only what is left after the subtraction is shifted.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError, ShapeError
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE
from pyklip_diffrender.io.headers import header_date
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.pyklip_backend.capture import SourceFrames, source_frames_of
from pyklip_diffrender.pyklip_backend.settings import DiffrenderSettings, settings_of
from pyklip_diffrender.scene.observation import Observation

__all__ = ["Frames", "frames_of", "observation_from_dataset"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Frames:
    """n frames of one wavelength, and where they sit.

    Attributes
    ----------
    data, error : ndarray
        (n, ny, nx) pixels and their standard deviations.
    valid : ndarray
        (n, ny, nx) bool, False where a pixel must not be fitted.
    centers : ndarray
        (n, 2) star centres [x, y] in `data`, 0-indexed.
    position_angles : ndarray
        (n,) degrees by which pyKLIP will turn the frames counter-clockwise.
    wavelength : float
        As in ``dataset.wvs``.
    filter : str or None
        Filter name, None if nothing tells.
    pixelscale : float or (x, y)
        Arcsec per pixel.
    unit : Unit
        Unit of `data`.
    header : Header
        Header of the first frame; empty if there is none.
    name : str
        Names of the frames, for messages.
    pixels : str
        "recorded", or "as given" for the pixels of ``dataset.input``.
    noise : str
        "ERR", "given" or "estimated".
    """

    data: NDArray[np.float64]
    error: NDArray[np.float64]
    valid: NDArray[np.bool_]
    centers: NDArray[np.float64]
    position_angles: NDArray[np.float64]
    wavelength: float
    filter: str | None
    pixelscale: float | tuple[float, float]
    unit: u.UnitBase
    header: fits.Header
    name: str
    pixels: str
    noise: str

    def observation(self, usable: NDArray[np.bool_]) -> Observation:
        """The frames picked by `usable` (n,) bool as what the fit takes."""
        return Observation.from_arrays(
            self.data[usable],
            self.error[usable],
            valid=self.valid[usable],
            unit=self.unit,
            pixelscale=self.pixelscale,
            center=self.centers[usable],
            filter=self.filter,
            date=header_date(self.header, ("DATE-BEG", "DATE-OBS"), self.name),
            position_angles=self.position_angles[usable],
            name=self.name,
            header=self.header,
        )

    def usable(self) -> NDArray[np.bool_]:
        """(n,) bool: which frames have any pixel to fit.

        Raises
        ------
        NoValidPixelsError
            If none has.
        """
        usable = np.asarray(np.any(self.valid, axis=(1, 2)))
        if not usable.any():
            raise NoValidPixelsError(
                f"{self.name}: every pixel of every frame is NaN or masked, nothing is left to "
                "fit. Look at the DQ flags (bits 1 and 512) and at the ERR extension"
            )
        if not usable.all():
            logger.warning(
                "%s: %d of %d frames have no valid pixel and stay NaN",
                self.name, int((~usable).sum()), len(usable),
            )  # fmt: skip
        return usable


def observation_from_dataset(dataset: Any, wavelength: float | None = None) -> Observation:
    """Take an `Observation` from a pyKLIP dataset.

    Parameters
    ----------
    dataset : pyklip.instruments.Instrument.Data
        `JWSTData`, `GenericData` or another one. A `JWSTData` that was read after `register()`
        gives its recorded pixels, errors and flags; any other the pixels of ``dataset.input``.
        ``dataset.diffrender`` is taken into account.
    wavelength : float, optional
        Which frames, as in ``dataset.wvs``; needed if these differ.

    Returns
    -------
    Observation
        All frames of that wavelength, (n, ny, nx).

    Raises
    ------
    NoValidPixelsError
        If there is no frame, or no valid pixel.
    IncompatibleSetupError
        If the dataset has several wavelengths and none was chosen.
    """
    if len(dataset.input) == 0:
        raise NoValidPixelsError("the dataset has no frames; check the list of files it was given")
    waves = np.unique(dataset.wvs)
    if wavelength is None:
        if len(waves) > 1:
            raise IncompatibleSetupError(
                f"wavelength: the dataset has {len(waves)} of them ({waves}), choose one"
            )
        wavelength = waves[0]
    index = np.flatnonzero(np.asarray(dataset.wvs) == wavelength)
    if index.size == 0:
        raise IncompatibleSetupError(f"wavelength: got {wavelength}, the dataset has {waves}")
    imgs = np.asarray(dataset.input)[index]
    frames = frames_of(dataset, index, imgs, settings_of(dataset))
    return frames.observation(frames.usable())


def frames_of(
    dataset: Any, index: NDArray[np.intp], imgs: NDArray[Any], settings: DiffrenderSettings
) -> Frames:
    """Gather frames of one wavelength with their errors and all that is known about them.

    Parameters
    ----------
    dataset : pyklip.instruments.Instrument.Data
        The dataset they belong to.
    index : ndarray
        (n,) their places in the dataset.
    imgs : ndarray
        (n, ny, nx) the frames, as in ``dataset.input`` before any high-pass filter.
    settings : DiffrenderSettings
        What was given besides.
    """
    imgs = native_float64(imgs)
    source = source_frames_of(dataset)
    header = fits.Header() if source is None else source.headers[0]
    if source is not None and source.belongs_to(dataset):
        header = source.headers[index[0]]
        recorded = _recorded(source, index, imgs)
    else:
        recorded = None
    if source is not None and recorded is None:
        logger.warning("the dataset was changed since it was read: its pixels are taken as given")
    if recorded is None:
        data, centers = imgs, native_float64(dataset.centers)[index]
        valid = np.isfinite(data)
    else:
        assert source is not None
        (data, valid), centers = recorded, source.centers[index]

    if settings.error is not None:
        noise, error = "given", _broadcast(settings.error, index, dataset.input.shape)
    elif recorded is not None and source is not None and source.error is not None:
        noise, error = "ERR", native_float64(source.error[index])
    else:
        noise, error = "estimated", _estimate(data)
    with np.errstate(invalid="ignore"):
        valid &= np.isfinite(error) & (error > 0)
    unit, pixelscale = settings.unit, settings.pixelscale
    if source is not None:
        unit = source.unit if unit is None else unit
        pixelscale = source.pixelscale if pixelscale is None else pixelscale
    if pixelscale is None:
        pixelscale = NIRCAM_LW_PIXELSCALE
    wavelength = float(np.asarray(dataset.wvs)[index[0]])
    names = [str(n) for n in np.asarray(dataset.filenames)[index]]
    return Frames(
        data=data,
        error=error,
        valid=valid,
        centers=centers,
        position_angles=native_float64(dataset.PAs)[index],
        wavelength=wavelength,
        filter=settings.filter or _filter_name(dataset, header, wavelength),
        pixelscale=pixelscale,
        unit=u.dimensionless_unscaled if unit is None else unit,
        header=header,
        name=names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more",
        pixels="as given" if recorded is None else "recorded",
        noise=noise,
    )


def _recorded(
    source: SourceFrames, index: NDArray[np.intp], imgs: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Recorded pixels plus what `imgs` gained since they were read, and which are valid.

    None if pixels that were NaN have a value now: there is no recorded one to add to.
    """
    from pyklip.klip import align_and_scale

    before = native_float64(source.as_read[index])
    if np.any(np.isnan(before) & np.isfinite(imgs)):
        return None
    data = native_float64(source.data[index])
    valid = source.usable[index] & np.isfinite(data)
    for i, frame in enumerate(index):
        shift = {
            "new_center": source.centers[frame],
            "old_center": source.as_read_centers[frame],
        }
        gained = imgs[i] - before[i]
        masked = np.isnan(imgs[i]) & np.isfinite(before[i])
        gained[~np.isfinite(gained)] = 0.0
        if gained.any():
            # Beyond the edge of the shifted frame nothing is known to have been added.
            data[i] += np.nan_to_num(align_and_scale(gained, **shift))
        if masked.any():
            # A pixel that was masked by hand spoils every recorded pixel it was made from.
            valid[i] &= np.nan_to_num(align_and_scale(masked.astype(float), **shift)) < 0.1
    return data, valid


def _broadcast(error: Any, index: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.float64]:
    values = native_float64(error)
    try:
        return np.array(np.broadcast_to(values, shape)[index])
    except ValueError as problem:
        raise ShapeError(
            f"error: got shape {values.shape}, expected a number, {shape[1:]} or {shape}"
        ) from problem


def _estimate(data: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scatter of neighbouring pixels' differences, one number a frame: speckles count as noise."""
    error = np.empty_like(data)
    for frame, out in zip(data, error, strict=True):
        steps = np.diff(frame, axis=1)
        steps = np.abs(steps[np.isfinite(steps)])
        sigma = 1.4826 / np.sqrt(2) * float(np.median(steps)) if steps.size else 0.0
        # A noiseless frame, or one that is mostly zeros, still needs a positive error.
        peak = float(np.max(np.abs(frame), where=np.isfinite(frame), initial=0.0))
        out[:] = max(sigma, 1e-6 * peak) or 1.0
    return error


def _filter_name(dataset: Any, header: fits.Header, wavelength: float) -> str | None:
    """From the header; else from the table of wavelengths that a `JWSTData` carries."""
    table = getattr(dataset, "wave_nircam", {})
    for keyword in ("PUPIL", "FILTER"):
        # As pyKLIP chooses: a narrow filter sits in the pupil wheel, MASKRND does not count.
        if header.get(keyword) in table:
            return str(header[keyword])
    names = [name for name, microns in table.items() if np.isclose(1e-6 * microns, wavelength)]
    return str(names[0]) if len(names) == 1 else None
