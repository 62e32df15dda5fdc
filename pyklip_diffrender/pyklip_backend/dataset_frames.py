"""The frames of one wavelength of a pyKLIP dataset that a fit gets, by pointing.

Their files are judged as `ExposureSequence` judges files. The fit gets the pixels that the files
recorded, or the pixels of ``dataset.input``.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

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
    FrameDetails,
    NotRecordedError,
    Pointing,
    Recorded,
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


class Admitted(NamedTuple):
    """Frames of a dataset that are used, and what else its files say."""

    target: NDArray[np.bool_]  # (n,), frames of the target
    references: tuple[Observation, ...]  # of reference stars, from the dataset and the library


def library_files(dataset: Any, psf_library: Any) -> tuple[Path, ...]:
    """Files of a PSF library's frames, if `JWSTData` read it while the backend was registered."""
    paths = [Path(path) for path in getattr(dataset, REFERENCES, ())]
    chosen = np.asarray(psf_library.master_filenames)
    if psf_library.isgoodpsf is not None:
        chosen = chosen[psf_library.isgoodpsf]
    # pyKLIP appends the number of the integration to the name of the file.
    names = {str(name).rpartition("_INT")[0] for name in chosen}
    return tuple(path for path in paths if path.name in names)


def admit(source: SourceFrames, frames: NDArray[np.intp], library: Sequence[Path]) -> Admitted:
    """Judge the files of `frames`, indices in `source`, of one filter, and of the library.

    The target is the star of the first frame that is not marked as a reference (IS_PSF). Raises as
    `pyklip_diffrender.ExposureSequence.from_files`, and warns of every file that is not used, or
    not entirely.
    """
    paths = [source.paths[k] for k in frames]
    sequence = source.sequence
    known = sequence is not None
    if sequence is None:
        sequence = _sequence(source, frames, paths, library)
    others = {str(each.get("FILTER")) for each in source.headers} - {str(sequence.filter)}
    for row in sequence.rows:
        if known and row.use == "excluded":
            continue  # Whoever has judged the files has said so.
        if row.remark and row.exposure.filter not in others:
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
    return Admitted(np.array(used), sequence.references)


def _sequence(
    source: SourceFrames,
    frames: NDArray[np.intp],
    paths: Sequence[Path],
    library: Sequence[Path],
) -> ExposureSequence:
    """Sort the files of frames and of the library, opening none twice."""
    headers = [source.headers[k] for k in frames]
    first = next((k for k, h in enumerate(headers) if not is_reference(h)), 0)
    name = source.filenames[frames[first]]
    return ExposureSequence.of_opened(
        [source.files[path] for path in dict.fromkeys(paths)],
        [FrameFile.opened(path, lambda exposure: True) for path in library],
        target=next(iter(star_of(headers[first], name).names), None),
        filter=header_text(headers[first], "FILTER", name),
    )


# The frames of one wavelength of a pyKLIP dataset, with the recorded pixels where possible.


@dataclass(frozen=True, eq=False)
class Frames:
    """The m of n requested frames, of the target at one wavelength, that have any pixel to fit."""

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
    # (m,), by which the frames of ``dataset.input`` were multiplied since they were read; `data`
    # and `observation` have the unit of the files.
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
    >>> dataset.diffrender = dr.pyklip_backend.DiffrenderSettings(pixelscale=0.063)
    >>> observation = dr.pyklip_backend.observation_from_dataset(dataset)
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
    imgs = np.asarray(dataset.input)[index]
    return _gather(dataset, index, imgs, settings_of(dataset)).observation


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

    `imgs` (n, ny, nx) are frames `index` of ``dataset.input``, before any high-pass filter. Frames
    that `admit` excludes stay NaN in the products. Raises NoValidPixelsError if no frame has a
    valid pixel.
    """
    # Frames of reference stars may be among the dataset's: all are gathered, then the files judged.
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
    every = every if target.all() else replace(every, data=every.data[target])
    used = part_of(observation, target)
    return replace(
        every,
        observation=used,
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
    """Gather all frames of one wavelength, of whatever star; warns if the files are of no use."""
    source: SourceFrames | None = getattr(dataset, ATTRIBUTE, None)
    recorded: Recorded | None = None
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
        if unit is None:
            stated = header_text(header, "BUNIT", str(dataset.filenames[index[0]]))
            unit = u.Unit(stated or "", parse_strict="silent")
        pixelscale = source.pixelscale if pixelscale is None else pixelscale
    if recorded is not None:
        data, valid, error, centers, factor = recorded
        pixels = "recorded"
    else:
        data, error = native_float64(imgs), None
        valid = np.isfinite(data)
    if lost is not None:
        warnings.warn(
            f"the errors and original pixels of the files cannot be used: {lost}. The shifted "
            "pixels of dataset.input are fitted instead, which is slower and less deep",
            DiffrenderWarning,
            stacklevel=2,
        )
    if settings.error is not None:
        # Frames have the unit of the files by now, and given errors the dataset's.
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
        position_angles=native_float64(dataset.PAs)[index][usable],
        name=name,
        header=header,
    )
    mask_unusable(frames)
    return Frames(Observation(**frames), data, usable, pixels, noise, factor=factor[usable])


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


def _broadcast(error: Any, index: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.float64]:
    values = native_float64(error)
    try:
        return np.array(np.broadcast_to(values, shape)[index])
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
