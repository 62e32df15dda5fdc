"""The frames of one wavelength of a pyKLIP dataset, with the recorded pixels where possible.

The fit gets the pixels that the files recorded, see `recorded`, or those of ``dataset.input``.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.time import Time
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    NoValidPixelsError,
    ShapeError,
)
from pyklip_diffrender.instrument.masks import FILTERS, detector_place
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.pyklip_backend.admitted import admit
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings, settings_of
from pyklip_diffrender.pyklip_backend.pointings import (
    FrameDetails,
    Pointing,
    part_of,
    pointings_of,
)
from pyklip_diffrender.pyklip_backend.recorded import NotRecordedError, recorded_frames
from pyklip_diffrender.pyklip_backend.source import (
    ATTRIBUTE,
    SourceFrames,
    attach_source,
    why_without_source,
)
from pyklip_diffrender.scene.exposure import beginning
from pyklip_diffrender.scene.observation import Observation

__all__ = ["Frames", "date_of_frames", "frames_of", "observation_from_dataset", "require_frames"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Frames:
    """The target's frames of one wavelength that have any pixel to fit.

    Attributes
    ----------
    observation : Observation
        These frames, with errors and masks.
    data : ndarray, (m, ny, nx)
        Their pixels. Unlike in `observation`, flagged pixels keep their values.
    usable : ndarray of bool, (n,)
        Mask of these frames among those requested.
    pixels : str
        "recorded", or "as given" for the pixels of ``dataset.input``.
    noise : str
        Origin of the errors: "ERR", "given" or "estimated".
    pointings : tuple of Pointing
        Frames of the target, grouped by star position and orientation.
    references : tuple of Observation
        Frames of reference stars in the dataset and the library, by pointing.
    factor : ndarray, (m,)
        By which the frames of ``dataset.input`` were multiplied since they were read; `data` and
        `observation` have the unit of the files.
    """

    observation: Observation
    data: NDArray[np.float64]
    usable: NDArray[np.bool_]
    pixels: str
    noise: str
    pointings: tuple[Pointing, ...] = ()
    references: tuple[Observation, ...] = ()
    factor: NDArray[np.float64] = field(default_factory=lambda: np.ones(1))

    def __repr__(self) -> str:
        return f"<Frames: {self.observation!r}, {len(self.pointings)} pointings>"


def observation_from_dataset(dataset: Any, wavelength: float | None = None) -> Observation:
    """Make an `Observation` of the frames of a pyKLIP dataset.

    Parameters
    ----------
    dataset : pyklip.instruments.Instrument.Data
        `JWSTData`, `GenericData` or another one. From a `JWSTData` that was read after
        `register()` the recorded pixels, errors and flags are taken, otherwise the pixels of
        ``dataset.input``. Settings in ``dataset.diffrender`` apply.
    wavelength : float, optional
        Selects frames by their value in ``dataset.wvs``; needed if there are several.

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

    Warns
    -----
    DiffrenderWarning
        If the errors and original pixels of the files cannot be used, with the reason.

    Examples
    --------
    >>> import numpy as np
    >>> from pyklip.instruments.Instrument import GenericData
    >>> import pyklip_diffrender as dr
    >>> images = np.random.default_rng(1).normal(size=(2, 16, 16))
    >>> dataset = GenericData(images, np.full((2, 2), 7.5), filenames=["roll 1", "roll 2"])
    >>> dataset.diffrender = dr.DiffrenderSettings(pixelscale=0.063)
    >>> observation = dr.observation_from_dataset(dataset)
    >>> len(observation), observation.shape
    (2, (16, 16))
    """
    require_frames(dataset)
    wavelengths = np.unique(dataset.wvs)
    if wavelength is None:
        if len(wavelengths) > 1:
            raise IncompatibleSetupError(
                f"wavelength: the dataset has {len(wavelengths)} of them ({wavelengths}), choose "
                "one"
            )
        wavelength = wavelengths[0]
    index = np.flatnonzero(np.asarray(dataset.wvs) == wavelength)
    if index.size == 0:
        raise IncompatibleSetupError(f"wavelength: got {wavelength}, the dataset has {wavelengths}")
    imgs, settings = np.asarray(dataset.input)[index], settings_of(dataset)
    attach_source(dataset, settings.files)
    return _gather(dataset, index, imgs, settings).observation


def date_of_frames(dataset: Any) -> Time | None:
    """Mean date of the frames, as far as it is known."""
    source: SourceFrames | None = getattr(dataset, ATTRIBUTE, None)
    if source is None:
        return None
    dates = [
        beginning(header, name)
        for header, name in zip(source.headers, source.filenames, strict=True)
    ]
    known = [date for date in dates if date is not None]
    return Time(known).mean() if known else None


def require_frames(dataset: Any) -> None:
    """Raise `NoValidPixelsError` for a dataset without frames."""
    if len(dataset.input) == 0:
        raise NoValidPixelsError("the dataset has no frames; check the list of files it was given")


def frames_of(
    dataset: Any,
    index: NDArray[np.intp],
    imgs: NDArray[Any],
    settings: DiffrenderSettings,
    library: Sequence[Path] = (),
) -> Frames:
    """Gather the target's frames of one wavelength with their errors, masks and metadata.

    Frames from files are judged by header and pixels, see `admit`; those that are not used stay NaN
    in the products.

    Parameters
    ----------
    dataset : pyklip.instruments.Instrument.Data
        The dataset that the frames belong to.
    index : ndarray, (n,)
        Their indices in the dataset.
    imgs : ndarray, (n, ny, nx)
        The frames, as in ``dataset.input`` before any high-pass filter.
    settings : DiffrenderSettings
        Its `error`, `unit`, `pixelscale` and `filter` replace those of the dataset.
    library : sequence of Path
        Files of reference stars.

    Raises
    ------
    NoValidPixelsError
        If no frame has a valid pixel.
    IncompatibleSetupError
        If the files cannot be reduced together.

    Warns
    -----
    DiffrenderWarning
        For every file that is not used, or not entirely, with the reason.
    """
    every = _gather(dataset, index, imgs, settings)
    observation, chosen = every.observation, index[every.usable]
    source: SourceFrames | None = getattr(dataset, ATTRIBUTE, None)
    places = None if source is None else source.places(dataset)
    if source is None or places is None:
        return replace(every, pointings=tuple(pointings_of(observation)))
    recorded = every.pixels == "recorded"
    details = [
        FrameDetails(
            source.paths[i].name,
            source.headers[i],
            source.first_pixels[i] if recorded else None,
            source.star_offsets[i],
        )
        for i in places[chosen]
    ]
    target, references = admit(source, places[chosen], library)
    if not target.any():
        raise NoValidPixelsError(
            f"{observation.name}: none of these frames can be used; the warnings say why"
        )
    usable = every.usable.copy()
    usable[np.flatnonzero(usable)[~target]] = False
    used = part_of(observation, target)
    return replace(
        every,
        observation=used,
        data=every.data[target],
        usable=usable,
        pointings=tuple(
            pointings_of(used, [d for d, yes in zip(details, target, strict=True) if yes])
        ),
        references=references,
        factor=every.factor[target],
    )


def _gather(
    dataset: Any, index: NDArray[np.intp], imgs: NDArray[Any], settings: DiffrenderSettings
) -> Frames:
    """Gather all frames of one wavelength, of whatever star.

    Warns
    -----
    DiffrenderWarning
        If the files' pixels, errors, flags or headers cannot be used.
    """
    imgs = native_float64(imgs)
    source: SourceFrames | None = getattr(dataset, ATTRIBUTE, None)
    data, valid, error = imgs, np.isfinite(imgs), None
    centers, pixels, noise = native_float64(dataset.centers)[index], "as given", "ERR"
    header, unit, pixelscale = fits.Header(), settings.unit, settings.pixelscale
    factor, lost = np.ones(len(imgs)), why_without_source(dataset)
    if source is not None:
        places = source.places(dataset)
        header = source.headers[0 if places is None else places[index[0]]]
        try:
            recorded = recorded_frames(source, places, dataset, index, imgs)
        except NotRecordedError as reason:
            lost = str(reason)
        else:
            data, valid, error, centers, factor = recorded
            pixels = "recorded"
        if unit is None:
            unit = u.Unit(header.get("BUNIT", ""), parse_strict="silent")
        pixelscale = source.pixelscale if pixelscale is None else pixelscale
    if lost is not None:
        warnings.warn(
            f"the errors and original pixels of the files cannot be used: {lost}. The shifted "
            "pixels of dataset.input are fitted instead, which is slower and less deep",
            DiffrenderWarning,
            stacklevel=2,
        )
    if settings.error is not None:
        error = _broadcast(settings.error, index, dataset.input.shape) / factor[:, None, None]
        noise = "given"
    elif error is None:
        noise, error = "estimated", _estimate(data)
    with np.errstate(invalid="ignore"):
        valid &= np.isfinite(error) & (error > 0)

    names = [str(name) for name in np.asarray(dataset.filenames)[index]]
    name = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
    usable = _usable(valid, name)
    wavelength = float(np.asarray(dataset.wvs)[index[0]])
    passband = settings.filter or _filter_name(dataset, header, wavelength)
    if pixelscale is None:
        known = passband is not None and passband.upper() in FILTERS
        pixelscale = detector_place(None, passband if passband and known else "F444W").pixelscale
    observation = Observation.from_arrays(
        data[usable],
        error[usable],
        valid=valid[usable],
        unit=u.dimensionless_unscaled if unit is None else unit,
        pixelscale=pixelscale,
        center=centers[usable],
        filter=passband,
        date=beginning(header, name),
        position_angles=native_float64(dataset.PAs)[index][usable],
        name=name,
        header=header,
    )
    return Frames(observation, data[usable], usable, pixels, noise, factor=factor[usable])


def _usable(valid: NDArray[np.bool_], name: str) -> NDArray[np.bool_]:
    """Mask of the frames that have any valid pixel, (n,)."""
    usable = np.asarray(valid.any(axis=(1, 2)))
    if not usable.any():
        raise NoValidPixelsError(
            f"{name}: every pixel of every frame is NaN or masked, nothing is left to fit. Look at "
            "the DQ flags (bits 1 and 512) and at the ERR extension"
        )
    if not usable.all():
        logger.warning(
            "%s: %d of %d frames have no valid pixel and stay NaN",
            name, int((~usable).sum()), len(usable),
        )  # fmt: skip
    return usable


def _broadcast(error: Any, index: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.float64]:
    values = native_float64(error)
    try:
        return np.array(np.broadcast_to(values, shape)[index])
    except ValueError as reason:
        raise ShapeError(
            f"error: got shape {values.shape}, expected a number, {shape[1:]} or {shape}"
        ) from reason


def _estimate(data: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scatter of the differences between neighbouring pixels, one number per frame.

    Speckles count as noise.
    """
    error = np.empty_like(data)
    for frame, out in zip(data, error, strict=True):
        steps = np.diff(frame, axis=1)
        steps = np.abs(steps[np.isfinite(steps)])
        sigma = 1.4826 / np.sqrt(2) * float(np.median(steps)) if steps.size else 0.0
        # A frame without noise, or mostly of zeros, still needs a positive error.
        peak = float(np.max(np.abs(frame), where=np.isfinite(frame), initial=0.0))
        out[:] = max(sigma, 1e-6 * peak) or 1.0
    return error


def _filter_name(dataset: Any, header: fits.Header, wavelength: float) -> str | None:
    """Filter from the header, else from the table of wavelengths that a `JWSTData` has."""
    table = getattr(dataset, "wave_nircam", {})
    for keyword in ("PUPIL", "FILTER"):
        # As in pyKLIP: a narrow filter sits in the pupil wheel, where MASKRND is no filter.
        if header.get(keyword) in table:
            return str(header[keyword])
    names = [name for name, microns in table.items() if np.isclose(1e-6 * microns, wavelength)]
    return str(names[0]) if len(names) == 1 else None
