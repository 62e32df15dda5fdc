"""Observed frames: pixel values, errors, masks, and the position of the star."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.time import Time
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.errors import NoValidPixelsError, ShapeError
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.io.units import full_circle, half_circle, rotation_matrix, to_mask, to_unit
from pyklip_diffrender.scene.aligned_frames import on_detector_pixels
from pyklip_diffrender.scene.exposure import instrument_of, star_of
from pyklip_diffrender.scene.integrations import (
    calibrated_errors,
    checked_stacks,
    judge_integrations,
    mask_unusable,
    pointings,
    selected,
    unit_of_frames,
    weighted_mean,
)
from pyklip_diffrender.scene.jwst_files import read_calints, without_empty

# Boxes of pixels about the star: cutting them out of frames and putting them back.


@dataclass(frozen=True)
class Window:
    """A box in frames with the star in one place; it may reach beyond the edges of the frames."""

    y: int  # first row in the frame
    x: int  # first column in the frame
    shape: tuple[int, int]  # (ny, nx)

    @classmethod
    def about(cls, center: NDArray[np.float64], shape: tuple[int, int]) -> Window:
        """Return the box whose middle is within half a pixel of `center`, [x, y]."""
        # Pixel centres are whole numbers, so that the box from `first` has its middle at first +
        # (n - 1) / 2.
        ny, nx = shape
        return cls(round(center[1] - (ny - 1) / 2), round(center[0] - (nx - 1) / 2), shape)

    @classmethod
    def holding(cls, valid: NDArray[np.bool_]) -> Window:
        """Return the smallest box that holds all valid pixels of frames, (n, ny, nx)."""
        _, rows, columns = np.nonzero(valid)
        shape = (int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1)
        return cls(int(rows.min()), int(columns.min()), shape)

    def __contains__(self, other: Window) -> bool:
        (ny, nx), (other_ny, other_nx) = self.shape, other.shape
        return (
            self.y <= other.y
            and self.x <= other.x
            and self.y + ny >= other.y + other_ny
            and self.x + nx >= other.x + other_nx
        )

    def _overlap(self, frame: tuple[int, ...]) -> tuple[Any, Any]:
        """Return the slices of the overlap of box and frame, in the frame and in the box."""
        y0, x0 = max(self.y, 0), max(self.x, 0)
        y1 = max(min(self.y + self.shape[0], frame[0]), y0)
        x1 = max(min(self.x + self.shape[1], frame[1]), x0)
        return np.s_[..., y0:y1, x0:x1], np.s_[
            ..., y0 - self.y : y1 - self.y, x0 - self.x : x1 - self.x
        ]

    def cut(self, cube: NDArray[Any], fill: Any) -> NDArray[Any]:
        """Cut the box out of (n, Ny, Nx): (n, ny, nx), with `fill` outside the frame."""
        boxes = np.full((len(cube), *self.shape), fill, dtype=cube.dtype)
        in_frame, in_box = self._overlap(cube.shape[1:])
        boxes[in_box] = cube[in_frame]
        return boxes

    def paste(self, box: NDArray[np.float64], frame: tuple[int, int]) -> NDArray[np.float64]:
        """Put a box (ny, nx) back into a frame (Ny, Nx) of NaN."""
        out = np.full(frame, np.nan)
        in_frame, in_box = self._overlap(frame)
        out[in_frame] = box[in_box]
        return out


# The frames of a file, without the integrations and pixels that cannot be used.

_log = logging.getLogger(__name__)


def frames_in(
    hdus: fits.HDUList,
    path: str | os.PathLike[str],
    *,
    every_integration: bool,
    compact: bool = False,
    star: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Read and judge the calints file at that path, which is open: attributes as of `from_fits`.

    `compact` keeps pixels and errors in single precision if the file does.
    """
    frames, kept, original = _judged(hdus, path, compact=compact, star=star)
    if not every_integration:
        return frames if kept.all() else frames | selected(frames, np.flatnonzero(kept))
    if not original.all():
        # Frames of empty integrations have the pixels of the one before, and none is valid.
        frames |= selected(frames, np.maximum(np.cumsum(original) - 1, 0))
    every = original.copy()
    every[original] = kept
    mask_unusable(frames, np.broadcast_to(every[:, None, None], frames["valid"].shape))
    return frames


def means_in(
    hdus: fits.HDUList, path: str | os.PathLike[str], *, star: tuple[float, float] | None = None
) -> dict[str, Any]:
    """Read, judge and average the calints file at that path, which is open.

    The result has the attributes of the means of each of its pointings. Reading takes at most as
    much memory as the file has, however many integrations there are.
    """
    frames, kept, _ = _judged(hdus, path, compact=True, star=star)
    return frames | means_of_pointings(frames, np.flatnonzero(kept))


def means_of_pointings(frames: Mapping[str, Any], which: NDArray[np.intp]) -> dict[str, Any]:
    """Average the integrations `which` of each pointing: the attributes of `frames` that change.

    `frames` are the attributes of an `Observation` of single integrations; `which` are indices, at
    least one.
    """
    center, angles = frames["center"], frames["position_angles"]
    turns = None if angles is None else angles[which]
    groups = [which[group] for group in pointings(center[which], turns)]
    shape = (len(groups), *frames["data"].shape[1:])
    data, error, valid = np.empty(shape), np.empty(shape), np.empty(shape, dtype=bool)
    for k, group in enumerate(groups):
        data[k], error[k], valid[k] = weighted_mean(
            frames["data"], frames["error"], frames["valid"], group
        )
    ratios = frames.get("noise_ratios", ())
    return {
        "data": data,
        "error": error,
        "valid": valid,
        "center": np.stack([center[group].mean(axis=0) for group in groups]),
        "position_angles": None if angles is None else angles[[group[0] for group in groups]],
        "noise_ratios": tuple(_oddest([ratios[j] for j in g]) for g in groups) if ratios else (),
        "integrations": tuple(len(group) for group in groups),
    }


def _oddest(ratios: list[float]) -> float:
    """The ratio that is farthest from 1, by a factor; NaN if none is known."""
    known = [each for each in ratios if each > 0]
    return max(known, key=lambda each: abs(np.log(each)), default=np.nan)


def _judged(
    hdus: fits.HDUList,
    path: str | os.PathLike[str],
    *,
    compact: bool,
    star: tuple[float, float] | None,
) -> tuple[dict[str, Any], NDArray[np.bool_], NDArray[np.bool_]]:
    """Read and judge an open file, in place, so that its integrations are in memory once.

    Returns the attributes of the observation, which of its integrations are kept, (frames,), and
    which integrations of the file are not empty, (integrations,).
    """
    arguments, shifts = read_calints(hdus, path, compact=compact, star=star)
    arguments, shifts, empty = without_empty(arguments, shifts)
    frames = checked_stacks(**arguments)
    name = frames["name"]
    if shifts is not None:
        frames |= on_detector_pixels(arguments, frames["center"], shifts, is_measured=star is None)
    mask_unusable(frames)
    if instrument_of(frames["header"], name) == "NIRCAM":
        frames["error"], frames["noise_ratios"] = calibrated_errors(
            frames["data"], frames["error"], frames["valid"], frames["center"],
            frames["pixelscale"], name, out=frames["error"],
        )  # fmt: skip
    original = np.ones(len(frames["data"]), dtype=bool) if empty is None else empty.kept
    names = [f"integration {k + 1} of {len(original)}" for k in np.flatnonzero(original)]
    judgement = judge_integrations(frames, names)
    for remark in judgement.remarks:
        _log.warning("%s: %s", name, remark)
    frames["remarks"] = (*(() if empty is None else empty.remarks), *judgement.remarks)
    if not judgement.kept.any():
        raise NoValidPixelsError(f"{name}: no integration is left: {'; '.join(judgement.remarks)}")
    mask_unusable(frames)
    return frames, judgement.kept, original


@dataclass(frozen=True)
class Observation:
    """A stack of coronagraphic frames.

    Attributes
    ----------
    data : ndarray, (frames, ny, nx), float64
        Pixel values; what is not valid is 0.
    error : ndarray, (frames, ny, nx)
        Standard deviations, in the same unit; 1 where not valid.
    valid : ndarray of bool, (frames, ny, nx)
    unit : Unit
        Unit of data and error; photons for simulations.
    pixelscale : tuple of float
        (x, y) arcsec per pixel.
    center : ndarray, (frames, 2)
        Approximate x, y of the star, 0-indexed pixels.
    filter : str or None
    date : Time or None
        Beginning of the exposure, UTC.
    mid_date : Time or None
        Middle of the exposure, UTC.
    position_angles : ndarray, (frames,), or None
        Position angles of the +y axis, degrees east of north, from 0 to 360; None where they are
        not known.
    star_offset : tuple of float or None
        x, y of the star relative to the occulter from the file, arcsec; the start of a fit.
    reference : bool
        Whether this is a reference star, whose frames have no companions of the target.
    first_pixel : tuple of int or None
        Column and row of the array's first pixel on the full detector, 0-indexed; None where it is
        not known, or where the array's pixels are not the detector's.
    name : str
    header : Header
        Primary and science headers of the file, merged.
    remarks : tuple of str
        Parts of the file that were left out when it was read, and why.
    noise_ratios : tuple of float
        Scatter of the file's pixels far from the star over their stated errors, for every frame,
        before the errors were corrected; NaN where it could not be measured.
    integrations : tuple of int
        Number of integrations of the detector that each frame averages; empty where each frame is
        one integration.

    Examples
    --------
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> ones = np.ones((2, 8, 8))
    >>> dr.Observation.from_arrays(ones, ones, pixelscale=0.063, filter="F444W")
    <Observation 'observation': 2 frames of 8 x 8 pixels, F444W, ph, no date>

    From a file, which the package does not contain:

    >>> frames = dr.Observation.from_fits("roll1_calints.fits")  # doctest: +SKIP
    """

    data: NDArray[np.float64]
    error: NDArray[np.float64]
    valid: NDArray[np.bool_]
    unit: u.UnitBase
    pixelscale: tuple[float, float]
    center: NDArray[np.float64]
    filter: str | None = None
    date: Time | None = None
    mid_date: Time | None = None
    position_angles: NDArray[np.float64] | None = None
    name: str = "observation"
    reference: bool = False
    star_offset: tuple[float, float] | None = None
    first_pixel: tuple[int, int] | None = None
    header: fits.Header = field(default_factory=fits.Header)
    remarks: tuple[str, ...] = ()
    noise_ratios: tuple[float, ...] = ()
    integrations: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.position_angles is not None:
            object.__setattr__(self, "position_angles", full_circle(self.position_angles))

    @classmethod
    def from_arrays(
        cls,
        data: Any,
        error: Any,
        *,
        valid: Any = None,
        unit: str | u.UnitBase = "photon",
        pixelscale: float | tuple[float, float],
        center: Any = None,
        **details: Any,
    ) -> Observation:
        """Make an observation of one frame or a stack, checking and copying.

        Parameters
        ----------
        data, error : array or Quantity, ([frames,] ny, nx)
            Pixels where either is not finite, or the error is not positive, are masked.
            Quantities are converted to `unit`.
        valid : array of bool, optional
        unit : str or Unit
        pixelscale : float, Quantity or (x, y)
            arcsec.
        center : (2,) or (frames, 2), optional
            x, y of the star, 0-indexed; default the middle of the array.
        **details
            Other attributes.

        Raises
        ------
        ShapeError
            Inconsistent shapes, or no frames.
        UnitError
            A unit that is unknown or does not convert.
        NonFiniteError
            A star position that is not a number.
        IncompatibleSetupError
            A pixel scale that is not a positive number.
        NoValidPixelsError
            A frame without valid pixels.
        """
        name = details.get("name", cls.name)
        unit = unit_of_frames(unit, name)
        frames = checked_stacks(
            to_unit(data, unit, f"{name}: data"),
            to_unit(error, unit, f"{name}: error"),
            valid=None if valid is None else to_mask(valid, f"{name}: valid"),
            unit=unit,
            pixelscale=pixelscale,
            center=center,
            **details,
        )
        mask_unusable(frames)
        return cls(**frames)

    @classmethod
    def from_fits(
        cls,
        path: str | os.PathLike[str],
        *,
        every_integration: bool = False,
        star: tuple[float, float] | None = None,
    ) -> Observation:
        """Read a JWST stage-2 coronagraphic file (calints).

        Uses SCI, ERR and DQ, BUNIT, FILTER, DATE-BEG (or DATE-OBS with TIME-OBS, or EXPSTART) and
        EXPMID, ROLL_REF and V3I_YANG, the aperture's pixel area, and the star's position from
        STARCENX/Y, else CRPIX1/2 (1-indexed) with the dither behind the mask, XOFFSET and YOFFSET.
        Of spaceKLIP's files also MASKOFFS, the position of the star from the mask, and the shifts
        of aligned frames (IMSHIFTS, or CENTER_SHIFT and ALIGN_SHIFT): they are undone, so that the
        frames have the pixels of the detector, whose flat-field errors then stay in their pixels.
        Errors of NIRCam frames are corrected for the noise that is measured far from the star, see
        `pyklip_diffrender.scene.integrations.calibrated_errors`. Integrations that are empty are
        left out, and three or more are compared with each other, see
        ``scene.integrations.judge_integrations``; `remarks` says what was left out.

        Parameters
        ----------
        path : path
        every_integration : bool
            Keep a frame for every integration; integrations that are left out have no valid pixel.
        star : tuple of float, optional
            x, y of the star in the file, pixels from 0, in place of what the header says.

        Raises
        ------
        CorruptFileError
            No such file, truncated, without an image in SCI, ERR or DQ, or with a card that does
            not hold what it should.
        UnitError
            SCI has no unit.
        ShapeError, NoValidPixelsError
            As `from_arrays`.
        """
        with open_fits(path, images=False) as hdus:
            return cls(**frames_in(hdus, path, every_integration=every_integration, star=star))

    @classmethod
    def means_from_fits(
        cls, path: str | os.PathLike[str], *, star: tuple[float, float] | None = None
    ) -> Observation:
        """Read a file as `from_fits` does, and average the integrations of each of its pointings.

        A fit takes such means in any case. A file of thousands of integrations is never in memory
        as a whole: reading takes at most as much memory as the file has bytes, and usually less.

        Parameters
        ----------
        path : path
        star : tuple of float, optional
            See `from_fits`.

        Returns
        -------
        Observation
            One frame for each pointing, see `pointings`; `integrations` says how many integrations
            each frame averages, and `noise_ratios` has the ratio that is farthest from one among
            them.

        Raises
        ------
        CorruptFileError, UnitError, ShapeError, NoValidPixelsError
            As `from_fits`.
        """
        with open_fits(path, images=False) as hdus:
            return cls(**means_in(hdus, path, star=star))

    def means(self) -> Observation:
        """Average the frames of each pointing, without frames that have no valid pixel.

        See `means_from_fits`.
        """
        used = np.flatnonzero(self.valid.any(axis=(1, 2)))
        return replace(self, **means_of_pointings(vars(self), used))

    def part(self, which: NDArray[np.intp]) -> Observation:
        """Select frames by their indices."""
        return replace(self, **selected(vars(self), which))

    def continues_in(self, other: Observation) -> bool:
        """Whether the frames of another observation can be added to these, as one pointing."""
        own, its = (
            (each.shape, each.unit, each.first_pixel, each.position_angles is None)
            for each in (self, other)
        )
        return own == its and len(self.followed_by([other]).pointings()) == 1

    def followed_by(self, others: Sequence[Observation]) -> Observation:
        """Add the frames of other observations of the exposure; see `continues_in`."""
        if not others:
            return self
        every = (self, *others)
        changed: dict[str, Any] = {
            key: np.concatenate([getattr(each, key) for each in every])
            for key in ("data", "error", "valid", "center", "position_angles")
            if getattr(self, key) is not None
        }
        # The mean of the integrations: each observation counts by its number of integrations.
        offsets = [each.star_offset for each in every if each.star_offset is not None]
        if len(offsets) == len(every):
            x, y = np.average(offsets, axis=0, weights=[each.count for each in every])
            changed["star_offset"] = (float(x), float(y))
        middles = [each.mid_date for each in every if each.mid_date is not None]
        if len(middles) == len(every):
            changed["mid_date"] = Time(middles).mean()
        dates = [each.date for each in every if each.date is not None]
        return replace(
            self,
            date=min(dates) if dates else None,
            name=f"{self.name} and {len(others)} more",
            remarks=tuple(remark for each in every for remark in each.remarks),
            noise_ratios=tuple(ratio for each in every for ratio in each.noise_ratios),
            integrations=tuple(count for each in every for count in each.counts)
            if any(each.integrations for each in every)
            else (),
            **changed,
        )

    def pointings(self) -> tuple[Observation, ...]:
        """Split frames that show the star at different places or orientations.

        Frames of one observation are averaged for a fit. Frames whose stars are more than 0.3
        pixels apart, or whose position angles differ by more than 0.05 degrees, are not of one
        pointing.
        """
        groups = list(pointings(self.center, self.position_angles))
        if len(groups) == 1:
            return (self,)
        return tuple(
            replace(self.part(group), name=f"{self.name} (pointing {k})")
            for k, group in enumerate(groups, 1)
        )

    def __len__(self) -> int:
        return len(self.data)

    def __repr__(self) -> str:
        ny, nx = self.shape
        day = "no date" if self.date is None else self.date.isot[:10]
        return (
            f"<Observation {self.name!r}: {len(self)} frame{'s' if len(self) > 1 else ''} of "
            f"{nx} x {ny} pixels, {self.filter or 'no filter'}, {self.unit}, {day}>"
        )

    @property
    def count(self) -> int:
        """Number of integrations, including the ones that frames average."""
        return sum(self.counts)

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of integrations that each frame averages; 1 where a frame is one integration."""
        return self.integrations or (1,) * len(self)

    @property
    def mean_center(self) -> NDArray[np.float64]:
        """Mean x, y of the star in all integrations, (2,), 0-indexed pixels."""
        return np.asarray(np.average(self.center, axis=0, weights=self.counts))

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Pixels that are not valid, (frames, ny, nx): True where astropy's masks are."""
        return ~self.valid

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return self.data.shape[1], self.data.shape[2]

    @property
    def target(self) -> str:
        """Name of the star: TARGPROP or TARGNAME, else the name of the observation."""
        names = star_of(self.header, self.name).names
        return names[0] if names else self.name

    @property
    def is_nircam(self) -> bool:
        """Whether the header says that these are real frames of NIRCam."""
        return instrument_of(self.header, self.name) == "NIRCAM"

    @property
    def north(self) -> float | None:
        """Position angle of the first frame's +y axis, degrees east of north; None if not known."""
        return None if self.position_angles is None else float(self.position_angles[0])

    @property
    def position_angle(self) -> float:
        """Position angle as `north`, but 0 if it is not known."""
        return self.north or 0.0

    def roll_from(self, other: Observation) -> float:
        """Angle by which the sky is rotated with respect to another observation.

        Returns
        -------
        float
            Degrees, counter-clockwise on the detector, from -180 to 180; 0 if either has no
            position angle.
        """
        if self.position_angles is None or other.position_angles is None:
            return 0.0
        return half_circle(other.position_angle - self.position_angle)

    def turned(self, places: ArrayLike, other: Observation) -> NDArray[np.float64]:
        """Rotate positions beside the star in another observation to where they are in this one.

        Parameters
        ----------
        places : array, (k, 2)
            x, y in any unit.
        other : Observation

        Returns
        -------
        ndarray, (k, 2)
        """
        matrix = rotation_matrix(self.roll_from(other))
        return np.reshape(places, (-1, 2)) @ matrix.T

    def cutout(self, size: int) -> Observation:
        """The `size` x `size` pixels about the star (whole pixels, without resampling).

        Raises
        ------
        ShapeError
            If the square is not inside the frame.
        """
        windows = [Window.about(center, (size, size)) for center in self.center]
        for window in windows:
            self._require_inside(window)
        return self._cut(windows)

    def within(self, window: Window, *, beyond_edges: bool = True) -> Observation:
        """Return the pixels in a box.

        Parameters
        ----------
        window : Window
        beyond_edges : bool
            Allow a box that reaches beyond the frames, where it is masked.

        Raises
        ------
        ShapeError
            If the box reaches beyond the frames and must not.
        NoValidPixelsError
            If a frame has no valid pixel there.
        """
        if not beyond_edges:
            self._require_inside(window)
        part = self._cut([window] * len(self))
        if not np.any(part.valid, axis=(1, 2)).all():
            raise NoValidPixelsError(
                f"{self.name}: no valid pixel within {window.shape[1]} x {window.shape[0]} "
                "pixels of the star. Check the star centre in the header, or fit more pixels: a "
                "larger size"
            )
        return part

    def _require_inside(self, window: Window) -> None:
        ny, nx = self.shape
        if window not in Window(0, 0, self.shape):
            x, y = self.center[0]
            raise ShapeError(
                f"{self.name}: {window.shape[1]} x {window.shape[0]} pixels about the star do not "
                f"fit into {nx} x {ny}. The star is at x, y = {x:.1f}, {y:.1f}, pixels from 0, "
                "with the shifts of an alignment undone. Check its place (star), or choose a "
                "smaller size"
            )

    def _cut(self, windows: list[Window]) -> Observation:
        """Cut one box out of every frame; all boxes have the same shape."""

        def cut(stack: NDArray[Any], fill: Any) -> NDArray[Any]:
            pairs = zip(windows, stack, strict=True)
            return np.concatenate([window.cut(frame[None], fill) for window, frame in pairs])

        # Frames that are cut at different pixels have no first pixel on the detector in common.
        corners = np.array([(window.x, window.y) for window in windows])
        origin = None
        if self.first_pixel is not None and (corners == corners[0]).all():
            column, row = self.first_pixel
            origin = (column + int(corners[0, 0]), row + int(corners[0, 1]))
        return replace(
            self,
            data=cut(self.data, 0.0),
            error=cut(self.error, 1.0),
            valid=cut(self.valid, False),
            center=self.center - corners,
            first_pixel=origin,
        )

    def plot(self, ax: Any = None, *, frame: int = 0) -> Any:
        """Draw a frame, in arcsec from the star; masked pixels are grey.

        North is up and east left where the position angle is known.

        Parameters
        ----------
        ax : Axes, optional
            Default: the axes of a new figure.
        frame : int

        Returns
        -------
        Axes
        """
        (ax,) = drawing.axes_for(ax, 1)
        valid = self.valid[frame]
        image = np.where(valid, self.data[frame], np.nan)
        ny, nx = self.shape
        pixels = np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), axis=-1)
        drawing.star_image(
            ax,
            image,
            (pixels - self.center[frame]) * self.pixelscale,
            drawing.light_norm(image, self.error[frame][valid]),
            bar=drawing.unit_label(self.unit),
            title=", ".join(filter(None, (self.target, self.filter))),
            north=None if self.position_angles is None else float(self.position_angles[frame]),
        )
        return ax

    def combined(self) -> Observation:
        """Average the frames, each weighted by its inverse median variance.

        The frames must see the star at the same place under the same wavefront.
        """
        data, error, valid = weighted_mean(self.data, self.error, self.valid)
        return replace(
            self,
            data=data[None],
            error=error[None],
            valid=valid[None],
            integrations=(self.count,),
            center=self.mean_center[None],
            position_angles=None if self.position_angles is None else self.position_angles[:1],
        )
