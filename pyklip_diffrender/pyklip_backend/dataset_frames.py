"""The frames of a pyKLIP dataset that a fit gets, by pointing.

Their files are judged as `ExposureSequence` judges files. The fit gets the pixels that the files
recorded, or the pixels of ``dataset.input``.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from pyklip_diffrender.io.headers import header_text, known_text
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings, settings_of
from pyklip_diffrender.pyklip_backend.source_frames import (
    ATTRIBUTE,
    REFERENCES,
    NotRecordedError,
    Pointing,
    SourceFrames,
    part_of,
    pointings_of,
    recorded_frames,
    why_without_source,
)
from pyklip_diffrender.scene.exposure import beginning, is_reference, star_of
from pyklip_diffrender.scene.frame_file import FrameFile
from pyklip_diffrender.scene.integrations import checked_stacks, compressed, mask_unusable
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import ExposureSequence

_log = logging.getLogger(__name__)


# Files of a dataset and of its library of reference stars, judged as `ExposureSequence` judges
# files.


def library_files(dataset: Any, psf_library: Any) -> tuple[Path, ...]:
    """Files of a PSF library's frames, if `JWSTData` read it while the backend was registered."""
    paths = [Path(path) for path in getattr(dataset, REFERENCES, ())]
    chosen = np.asarray(psf_library.master_filenames)
    if psf_library.isgoodpsf is not None:
        chosen = chosen[psf_library.isgoodpsf]
    # pyKLIP appends the number of the integration to the name of the file.
    names = {str(name).rpartition("_INT")[0] for name in chosen}
    return tuple(path for path in paths if path.name in names)


def admit(
    source: SourceFrames, frames: NDArray[np.intp], library: Sequence[Path]
) -> tuple[NDArray[np.bool_], tuple[Observation, ...]]:
    """Judge the files of `frames`, indices in `source`, of one filter, and of the library.

    Returns a mask (n,) of the frames of the target that are used, and the frames of reference
    stars, from the dataset and the library.
    The target is the star of the first frame that is not marked as a reference (IS_PSF). Raises as
    `pyklip_diffrender.ExposureSequence.from_files`, and warns of every file that is not used, or
    not entirely.
    """
    paths = [source.details[k].path for k in frames]
    sequence = _sequence(source, frames, paths, library)
    for row in sequence.rows:
        if row.remark:
            what = "is not used: " if row.use == "excluded" else ""
            warnings.warn(
                f"{row.exposure.name}: {what}{row.remark}", DiffrenderWarning, stacklevel=2
            )
    uses = {row.path: row.use for row in sequence.rows if row.use != "excluded"}
    names = [(path, source.filenames[k]) for path, k in zip(paths, frames, strict=True)]
    again = [each in names[:k] for k, each in enumerate(names)]
    if any(again):
        warnings.warn(
            f"{sum(again)} frames are in the dataset twice, and are used once",
            DiffrenderWarning,
            stacklevel=2,
        )
    marked = sum(uses.get(path) == "reference" for path in paths)
    if marked:
        warnings.warn(
            f"{marked} of {len(paths)} frames of the dataset show a reference star and stay NaN in "
            "the products. Give them to JWSTData as psflib_filepaths",
            DiffrenderWarning,
            stacklevel=2,
        )
    used = [uses.get(path) == "target" and not a for path, a in zip(paths, again, strict=True)]
    return np.array(used), sequence.references


def _sequence(
    source: SourceFrames, frames: NDArray[np.intp], paths: Sequence[Path], library: Sequence[Path]
) -> ExposureSequence:
    """Sort the files of frames and of the library, opening none twice."""
    headers = [source.details[k].header for k in frames]
    first = next((k for k, h in enumerate(headers) if not is_reference(h)), 0)
    name = source.filenames[frames[first]]
    return ExposureSequence.of_opened(
        [source.files[path] for path in dict.fromkeys(paths)],
        [FrameFile.opened(path, lambda exposure: True) for path in library],
        target=next(iter(star_of(headers[first], name).names), None),
        filter=header_text(headers[first], "FILTER", name),
    )


# The frames of a pyKLIP dataset, with the recorded pixels where possible.


@dataclass(frozen=True, eq=False)
class Frames:
    """The m of n requested frames, of the target, that have any pixel to fit."""

    observation: Observation
    # (m, ny, nx). Unlike in `observation`, flagged pixels keep their values.
    data: NDArray[np.float64]
    # (n,), mask of these frames among those requested.
    usable: NDArray[np.bool_]
    # "recorded", or "as given" for the pixels of ``dataset.input``.
    pixels: str
    # Origin of the errors: "ERR", "given" or "estimated".
    noise: str
    # Frames of the target, by position of the star and orientation.
    pointings: tuple[Pointing, ...] = ()
    # Frames of reference stars in the dataset and the library, by pointing.
    references: tuple[Observation, ...] = ()

    def __repr__(self) -> str:
        return f"<Frames: {self.observation!r}, {len(self.pointings)} pointings>"


def observation_from_dataset(dataset: Any) -> Observation:
    """Make an `Observation` of the frames of a pyKLIP dataset.

    Parameters
    ----------
    dataset : pyklip.instruments.Instrument.Data
        `JWSTData`, `GenericData` or another one. From a `JWSTData` that was read after
        `register()` the recorded pixels, errors and flags are taken, otherwise the pixels of
        ``dataset.input``. Settings in ``dataset.diffrender`` apply.

    Returns
    -------
    Observation
        All frames, (n, ny, nx).

    Raises
    ------
    NoValidPixelsError
        If there is no frame, or no valid pixel.
    IncompatibleSetupError
        If the dataset has several wavelengths.

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
    >>> dataset.diffrender = dr.pyklip_backend.DiffrenderSettings(pixelscale=0.063)
    >>> observation = dr.pyklip_backend.observation_from_dataset(dataset)
    >>> len(observation), observation.shape
    (2, (16, 16))
    """
    require_frames(dataset)
    return _gather(dataset, np.asarray(dataset.input), settings_of(dataset)).observation


def date_of_frames(dataset: Any) -> Time | None:
    """Mean date of the frames, as far as it is known."""
    source: SourceFrames | None = getattr(dataset, ATTRIBUTE, None)
    if source is None:
        return None
    dates = [
        beginning(each.header, name)
        for each, name in zip(source.details, source.filenames, strict=True)
    ]
    known = [date for date in dates if date is not None]
    return Time(known).mean() if known else None


def require_frames(dataset: Any) -> None:
    """Raise for a dataset without frames, or with frames of several wavelengths."""
    if len(dataset.input) == 0:
        raise NoValidPixelsError("the dataset has no frames; check the list of files it was given")
    wavelengths = np.unique(dataset.wvs)
    if len(wavelengths) > 1:
        raise IncompatibleSetupError(
            f"dataset.wvs: got {len(wavelengths)} wavelengths ({wavelengths}), expected one. Make "
            "one dataset for each filter, and reduce them one by one"
        )


def frames_of(
    dataset: Any, imgs: NDArray[Any], settings: DiffrenderSettings, library: Sequence[Path] = ()
) -> Frames:
    """Gather the target's frames with their errors, masks and metadata.

    `imgs` (n, ny, nx) are the frames of ``dataset.input``, before any high-pass filter. Frames that
    `admit` excludes stay NaN in the products. Raises NoValidPixelsError if no frame has a valid
    pixel.
    """
    # Frames of reference stars may be among the dataset's: all are gathered, then the files judged.
    every = _gather(dataset, imgs, settings)
    observation, chosen = every.observation, np.flatnonzero(every.usable)
    source: SourceFrames | None = getattr(dataset, ATTRIBUTE, None)
    places = None if source is None else source.places(dataset)
    if source is None or places is None:
        return replace(every, pointings=tuple(pointings_of(observation)))
    target, references = admit(source, places[chosen], library)
    if not target.any():
        raise NoValidPixelsError(
            f"{observation.name}: none of these frames can be used; the warnings say why"
        )
    usable = every.usable.copy()
    usable[chosen[~target]] = False
    every = every if target.all() else replace(every, data=every.data[target])
    used = part_of(observation, target)
    details = [source.details[i] for i in places[chosen[target]]]
    if every.pixels != "recorded":
        details = [each._replace(first_pixel=None) for each in details]
    pointings = tuple(pointings_of(used, details))
    return replace(
        every, observation=used, usable=usable, pointings=pointings, references=references
    )


def _gather(dataset: Any, imgs: NDArray[Any], settings: DiffrenderSettings) -> Frames:
    """Gather all frames, of whatever star; warns if the files are of no use."""
    source: SourceFrames | None = getattr(dataset, ATTRIBUTE, None)
    centers, pixels, noise = native_float64(dataset.centers), "as given", "ERR"
    header, unit, pixelscale = fits.Header(), settings.unit, settings.pixelscale
    lost = why_without_source(dataset)
    if source is not None:
        places = source.places(dataset)
        header = source.details[0 if places is None else places[0]].header
        try:
            data, valid, error, centers = recorded_frames(source, places, dataset, imgs)
            pixels = "recorded"
        except NotRecordedError as reason:
            lost = str(reason)
        if unit is None:
            stated = header_text(header, "BUNIT", str(dataset.filenames[0]))
            unit = u.Unit(stated or "", parse_strict="silent")
        pixelscale = source.pixelscale if pixelscale is None else pixelscale
    if pixels != "recorded":
        data = native_float64(imgs)
        valid, noise, error = np.isfinite(data), "estimated", _estimate(data)
    if lost is not None:
        warnings.warn(
            f"the errors and original pixels of the files cannot be used: {lost}. The shifted "
            "pixels of dataset.input are fitted instead, which is slower and less deep",
            DiffrenderWarning,
            stacklevel=2,
        )
    if settings.error is not None:
        noise, error = "given", _broadcast(settings.error, dataset.input.shape)
    with np.errstate(invalid="ignore"):
        valid &= np.isfinite(error) & (error > 0)

    names = [str(name) for name in dataset.filenames]
    name = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
    usable = _usable(valid, name)
    passband = settings.filter or _filter_name(dataset, header, float(dataset.wvs[0]))
    if pixelscale is None:
        known = passband is not None and passband.upper() in FILTERS
        pixelscale = detector_place(None, passband if passband and known else "F444W").pixelscale
    if not usable.all():
        data, error, valid = (compressed(each, usable) for each in (data, error, valid))
    # The errors and masks are its own, as the arrays that `Observation.from_arrays` would copy.
    frames = checked_stacks(
        data.copy(),
        error,
        valid=valid,
        unit=u.dimensionless_unscaled if unit is None else unit,
        pixelscale=pixelscale,
        center=centers[usable],
        filter=passband,
        date=beginning(header, name),
        position_angles=native_float64(dataset.PAs)[usable],
        name=name,
        header=header,
    )
    mask_unusable(frames)
    return Frames(Observation(**frames), data, usable, pixels, noise)


def _usable(valid: NDArray[np.bool_], name: str) -> NDArray[np.bool_]:
    """Mask of the frames that have any valid pixel, (n,)."""
    usable = np.asarray(valid.any(axis=(1, 2)))
    if not usable.any():
        raise NoValidPixelsError(
            f"{name}: every pixel of every frame is NaN or masked, nothing is left to fit. Look at "
            "the DQ flags (bits 1 and 512) and at the ERR extension"
        )
    if not usable.all():
        _log.warning(
            "%s: %d of %d frames have no valid pixel and stay NaN",
            name, int((~usable).sum()), len(usable),
        )  # fmt: skip
    return usable


def _broadcast(error: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    values = native_float64(error)
    try:
        return np.array(np.broadcast_to(values, shape))
    except ValueError as reason:
        raise ShapeError(
            f"error: got shape {values.shape}, expected a number, {shape[1:]} or {shape}"
        ) from reason


def _estimate(data: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scatter of the differences between neighbouring pixels of each frame, as (n, ny, nx)."""
    error = np.empty_like(data)
    for frame, out in zip(data, error, strict=True):
        # A difference of two pixels has sqrt(2) times their error, and the median of |x| of a
        # Gaussian is sigma / 1.4826. Neighbours share the smooth light of the star; its speckles
        # count as noise.
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
        name = known_text(header, keyword)
        if name in table:
            return name
    names = [name for name, microns in table.items() if np.isclose(1e-6 * microns, wavelength)]
    return str(names[0]) if len(names) == 1 else None
