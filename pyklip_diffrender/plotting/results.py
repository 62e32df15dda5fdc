"""Implementations of the `plot` methods of observations, systems, refinements and detections.

The colour maps can be distinguished by readers with colour vision deficiencies.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from pyklip_diffrender.plotting.panels import (
    ACCENT,
    INK,
    axes_for,
    detector_extent,
    draw_compass,
    extent_of,
    label_sky,
    light_norm,
    mark,
    show,
    turned,
    unit_label,
)

if TYPE_CHECKING:
    from astropy.table import QTable
    from matplotlib.axes import Axes

    from pyklip_diffrender.detection import Detection, Disk, WideField
    from pyklip_diffrender.optics.grid import PupilGrid
    from pyklip_diffrender.optics.planes import Wavefront
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.refinement import Refinement
    from pyklip_diffrender.scene.observation import Observation

__all__ = [
    "plot_detection",
    "plot_disk",
    "plot_observation",
    "plot_refinement",
    "plot_system",
]

_LIGHT = "magma"
_SIGNED = "RdBu_r"
_LIMIT = 5.0
"""Of the scale for residuals, and of its linear part for S/N, in standard deviations."""

_LABELLED = 4
"""Largest number of candidates that are labelled: the labels of more would overlap."""

_KLIP = "#b3541e"
"""A brown, lighter than the green of the curve that it is drawn beside."""

_SNR_TICKS = (-100, -50, -20, -10, -5, 0, 5, 10, 20, 50, 100)

_DECADES = 6
"""Of the image of a system."""


def plot_observation(observation: Observation, ax: Any = None, *, frame: int = 0) -> Axes:
    """See `Observation.plot`."""
    (ax,) = axes_for(ax, 1)
    center, scale = observation.center[frame], observation.pixelscale
    ny, nx = observation.shape
    extent = extent_of(
        (np.arange(nx) - center[0]) * scale[0], (np.arange(ny) - center[1]) * scale[1]
    )
    valid = observation.valid[frame]
    image = np.where(valid, observation.data[frame], np.nan)
    norm = light_norm(image, observation.error[frame][valid])
    details = [observation.target, observation.filter]
    title = ", ".join(each for each in details if each)
    show(ax, image, extent, bar=unit_label(observation.unit), title=title, cmap=_LIGHT, norm=norm)
    label_sky(ax)
    if observation.position_angles is not None:
        draw_compass(ax, float(observation.position_angles[frame]))
    return ax


def plot_system(system: OpticalSystem, ax: Any = None, *, opd: Any = None) -> NDArray[Any]:
    """See `OpticalSystem.plot`."""
    pupil, phase, stop, image = axes_for(ax, 4)
    mean = system.bandpass.mean_wavelength
    wavelength = min(system.bandpass.wavelengths, key=lambda each: abs(each - mean))
    full = system.entrance.full
    with torch.no_grad():
        checked, values = system.opd(opd), system.values({})
        wavefront = system.pupil_field(checked, wavelength, values)
        first = _whole(wavefront, full)
        for plane, onto in zip(system.planes, system.windows(values), strict=True):
            wavefront = plane.apply(wavefront, values, onto)
        light = system(checked).double().cpu().numpy()
        map_ = 1e9 * checked.real.double().cpu().numpy()
    extent = extent_of(full.x.numpy(), full.y.numpy())
    amplitude, behind = first / first.max(), (_whole(wavefront, full) / first.max()) ** 2
    show(
        pupil, amplitude, extent, bar="amplitude", title=system.entrance.name,
        cmap="gray", vmin=0, vmax=1,
    )  # fmt: skip
    map_ = np.where(system.entrance.lit.cpu().numpy(), map_, np.nan)
    limit = float(np.nanpercentile(np.abs(map_), 99.5)) or 1.0
    show(
        phase, map_, extent, bar="nm", title="wavefront error",
        cmap=_SIGNED, vmin=-limit, vmax=limit,
    )  # fmt: skip
    show(
        stop, behind, extent, bar="light, 1 in the first pupil", title="light in the last pupil",
        cmap=_LIGHT, norm=_log(behind),
    )  # fmt: skip
    for axes in (pupil, phase, stop):
        axes.set_xlabel("m")
    title = f"star on the axis, {1e6 * mean:.2f} um"
    show(
        image, light, detector_extent(system.detector, values), bar="fraction of the star's light",
        title=title, cmap=_LIGHT, norm=_log(light),
    )  # fmt: skip
    image.set_xlabel("x from the optical axis (arcsec)")
    image.set_ylabel("y from the optical axis (arcsec)")
    return np.array([pupil, phase, stop, image])


def plot_refinement(fit: Refinement, ax: Any = None, *, frame: int = 0) -> NDArray[Any]:
    """See `Refinement.plot`."""
    data_axes, middle, right = axes_for(ax, 3)
    part = fit.frames[frame]
    observation = part.observation.combined()
    valid, noise = observation.valid[0], observation.error[0]
    data = np.where(valid, observation.data[0], np.nan)
    extent = detector_extent(part.model.detector, part.optical_values)
    unit = unit_label(observation.unit)
    norm = light_norm(data, noise[valid])
    show(data_axes, data, extent, bar=unit, title="data", cmap=_LIGHT, norm=norm)
    show(middle, part.star, extent, bar=unit, title="star model", cmap=_LIGHT, norm=norm)
    show(
        right, (data - part.star) / noise, extent, bar="standard deviations",
        title="residual / noise", cmap=_SIGNED, vmin=-_LIMIT, vmax=_LIMIT,
    )  # fmt: skip
    label_sky(data_axes, middle, right)
    if len(fit.companions) and not observation.reference:
        mark(right, turned(fit.companions[:, 1:], observation, fit.frames[0].observation))
    if observation.position_angles is not None:
        draw_compass(data_axes, observation.position_angle)
    return np.array([data_axes, middle, right])


def plot_detection(
    detection: Detection | WideField, ax: Any = None, klip: QTable | None = None
) -> NDArray[Any]:
    """See `Detection.plot`; `klip` is the contrast curve of KLIP."""
    snr_axes, right = axes_for(ax, 2)
    extent, table = extent_of(detection.grid[0, :, 0], detection.grid[:, 0, 1]), detection.table
    plural = "" if len(table) == 1 else "s"
    title = f"{len(table)} candidate{plural} above S/N {detection.threshold:g}"
    show(
        snr_axes, detection.snr, extent, bar="S/N of a point source", title=title, cmap=_SIGNED,
        norm=_snr_norm(detection.snr), ticks=_SNR_TICKS,
    )  # fmt: skip
    label_sky(snr_axes)
    places = np.stack([table["x"].value, table["y"].value], axis=1)
    labels = [f"S/N {snr:.1f}" for snr in table["snr"]] if len(table) <= _LABELLED else []
    mark(snr_axes, places, labels)
    if detection.observation.position_angles is not None:
        draw_compass(snr_axes, detection.north)

    curve = detection.contrast_curve
    separation = curve["separation"].value
    right.fill_between(
        separation, curve["lowest"], curve["highest"], color=ACCENT, alpha=0.15, lw=0,
        label="range of angles",
    )  # fmt: skip
    right.semilogy(separation, curve["contrast"], color=ACCENT, label="median")
    if detection.error_factor.is_measured:
        right.semilogy(
            separation, curve["small_sample"], ":", color=ACCENT, label="median, few samples"
        )
    right.semilogy(separation, curve["known_star"], "--", color=INK, label="star known exactly")
    if klip is not None:
        right.semilogy(
            klip["separation"].value, klip["contrast"], "s-", color=_KLIP, ms=3.5, label="KLIP"
        )
    if len(table):
        right.errorbar(
            table["separation"].value, table["contrast"], table["contrast_error"],
            table["separation_error"].value, "o", color=INK, mfc="white", label="candidates",
        )  # fmt: skip
    right.set_box_aspect(1.0)
    right.set_xlabel("separation (arcsec)")
    right.set_ylabel(f"contrast at {curve.meta['sigmas']:g} sigma")
    # Below the axes: candidates may be anywhere in them.
    right.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    return np.array([snr_axes, right])


def plot_disk(disk: Disk, ax: Any = None) -> NDArray[Any]:
    """See `Disk.plot`."""
    axes = axes_for(ax, 2)
    observation = disk.fit.frames[0].observation
    extent = extent_of(disk.grid[0, :, 0], disk.grid[:, 0, 1])
    limit = float(np.nanpercentile(disk.light[0], 99)) or float(np.nanmax(disk.error))
    for each, image, title in (
        (axes[0], disk.image, "frames without the star"),
        (axes[1], disk.light[0], "extended light"),
    ):
        show(
            each, image, extent, bar=unit_label(observation.unit), title=title, cmap=_SIGNED,
            vmin=-limit, vmax=limit,
        )  # fmt: skip
        label_sky(each)
        if observation.position_angles is not None:
            draw_compass(each, observation.position_angle)
    return np.array(axes)


def _snr_norm(snr: NDArray[np.float64]) -> Any:
    """Linear where there is noise, logarithmic beyond, so that bright sources keep their shape."""
    from matplotlib.colors import AsinhNorm

    limit = max(_LIMIT, float(np.nanmax(np.abs(snr))))
    return AsinhNorm(_LIMIT, -limit, limit)


def _whole(wavefront: Wavefront, full: PupilGrid) -> NDArray[np.float64]:
    """Amplitude of a wavefront on the whole pupil array."""
    return np.asarray(wavefront.grid.crop(wavefront.field.abs(), full).double().cpu().numpy())


def _log(light: NDArray[np.float64]) -> Any:
    from matplotlib.colors import LogNorm

    brightest = float(light.max())
    return LogNorm(brightest * 10.0**-_DECADES, brightest, clip=True)
