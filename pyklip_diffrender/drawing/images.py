"""Images on the sky, in arcsec from the star, and on the pupil, in metres; the way of a source.

Every image is drawn with a colour bar as high as it; NaN is grey. On the sky, `grid` has the x and
y of the pixel centres, (ny, nx, 2), and `north` is the position angle of the image's +y axis,
degrees east of north: the image is turned with its pixels, so that north is up and east left. Where
`north` is None, because it is not known, y is up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.drawing.figures import (
    ACCENT,
    INK,
    circles,
    constrained,
    halo,
    label_sky,
    on_sky,
)
from pyklip_diffrender.io.units import east_and_north

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Image = NDArray[np.float64]

_LIGHT = "magma"
_SIGNED = "RdBu_r"

SNR_LINEAR = 5.0
"""Linear part of the scale for S/N."""


def star_image(
    ax: Axes, image: Image, grid: Image, norm: Any, *, bar: str, title: str,
    north: float | None = None,
) -> None:  # fmt: skip
    """Draw the light of a star and its surroundings on the scale `norm`, see `light_norm`."""
    style: dict[str, Any] = {"cmap": _LIGHT, "norm": norm}
    if hasattr(norm, "linear_width"):
        # Powers of ten in the logarithmic part only; in the linear part they would overlap.
        decades = np.arange(np.ceil(np.log10(norm.linear_width)), np.log10(norm.vmax))
        style["ticks"] = [0.0, *10.0**decades]
    _on_sky(ax, image, grid, north, bar=bar, title=title, **style)


def signed_image(
    ax: Axes, image: Image, grid: Image, limit: float, *, bar: str, title: str,
    places: ArrayLike = (), labels: Sequence[str] = (), north: float | None = None,
    linear: float | None = None,
) -> None:  # fmt: skip
    """Draw an image of either sign, to +-`limit`, with circles at `places`.

    The scale is linear within +-`linear` and logarithmic beyond, so that a bright source keeps its
    shape beside faint ones; without `linear` it is linear throughout.
    """
    style: dict[str, Any] = {"vmin": -limit, "vmax": limit}
    if linear is not None:
        from matplotlib.colors import AsinhNorm

        limit = max(limit, linear)
        style = {"norm": AsinhNorm(linear, -limit, limit), "ticks": _ticks(linear, limit)}
    _on_sky(ax, image, grid, north, bar=bar, title=title, cmap=_SIGNED, **style)
    circles(ax, on_sky(np.reshape(places, (-1, 2)), north), labels)


def snr_map(
    ax: Axes, snr: Image, grid: Image, places: ArrayLike = (), north: float | None = None, *,
    title: str = "", labels: Sequence[str] = (),
) -> None:  # fmt: skip
    """Draw a map of S/N with circles at candidates.

    The scale is linear where there is noise and logarithmic beyond, so that bright sources keep
    their shape.

    Parameters
    ----------
    ax : Axes
    snr : ndarray, (ny, nx)
    grid : ndarray, (ny, nx, 2)
    places : array, (k, 2)
        x and y of candidates, arcsec.
    north : float, optional
    title : str
    labels : sequence of str
        One for each of the places, or none.
    """
    signed_image(
        ax, snr, grid, float(np.nanmax(np.abs(snr))), bar="S/N of a point source", title=title,
        places=places, labels=labels, north=north, linear=SNR_LINEAR,
    )  # fmt: skip


def opd_map(ax: Axes, opd: Image, width: float, *, title: str, limit: float | None = None) -> None:
    """Draw a wavefront error (nm, NaN outside the pupil) on a pupil array of `width` metres.

    The scale goes to +-`limit`; by default few pixels exceed it.
    """
    if limit is None:
        limit = float(np.nanpercentile(np.abs(opd), 99.5)) or 1.0
    _on_pupil(
        ax, opd, width, bar="wavefront error (nm)", title=title, cmap=_SIGNED,
        vmin=-limit, vmax=limit,
    )  # fmt: skip


def pupil_image(
    ax: Axes, image: Image, width: float, *, bar: str, title: str, logarithmic: bool = False
) -> None:
    """Draw an amplitude from 0 to 1, or light on a logarithmic scale, on a pupil array."""
    style = {"cmap": _LIGHT, "norm": light_norm(image)} if logarithmic else {"cmap": "gray"}
    _on_pupil(ax, image, width, bar=bar, title=title, **style)


def light_norm(image: Image, noise: Image | None = None) -> Any:
    """Scale for light: logarithmic, and linear within three times the median noise if given."""
    from matplotlib.colors import AsinhNorm, LogNorm

    low, high = float(np.nanmin(image)), float(np.nanmax(image))
    if noise is None:
        return LogNorm(1e-6 * high, high, clip=True)
    width = 3 * float(np.nanmedian(noise))
    return AsinhNorm(width, vmin=max(low, -width), vmax=max(high, low + width))


def _ticks(linear: float, limit: float) -> list[float]:
    """0, and 1, 2 or 5 times a power of ten on both sides, from half of `linear` to `limit`."""
    decades = 10.0 ** np.arange(np.floor(np.log10(linear)), np.log10(limit) + 1)
    steps = np.outer(decades, [1, 2, 5]).ravel()
    steps = steps[(steps >= 0.5 * linear) & (steps <= limit)]
    # More of them would overlap.
    steps = steps[:: max(1, len(steps) // 4)]
    return [*(-steps[::-1]).tolist(), 0.0, *steps.tolist()]


def _on_sky(ax: Axes, image: Image, grid: Image, north: float | None, **style: Any) -> None:
    show_pixels(ax, image, grid[0, :, 0], grid[:, 0, 1], north=north, **style)
    ax.plot(0, 0, "+", color=INK, ms=11, mew=1.6, label="star", path_effects=halo())
    label_sky(ax, north is not None)


def _on_pupil(ax: Axes, image: Image, width: float, **style: Any) -> None:
    middles = ((np.arange(len(image)) + 0.5) / len(image) - 0.5) * width
    show_pixels(ax, image, middles, middles, **style)
    ax.set_xlabel("x in the pupil (m)")
    ax.set_ylabel("y in the pupil (m)")


def show_pixels(
    ax: Axes, image: Image, x: Image, y: Image, *, bar: str, title: str,
    ticks: Sequence[float] | None = None, north: float | None = None, **style: Any,
) -> None:  # fmt: skip
    """Draw an image whose pixels have their centres at `x` and `y`, with a colour bar.

    With `north`, the axes are offsets to the east and to the north, and the image is turned.
    """
    half_x, half_y = (abs(axis[-1] - axis[0]) / (2 * max(len(axis) - 1, 1)) for axis in (x, y))
    extent = (x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y)
    artist = ax.imshow(image, origin="lower", extent=extent, interpolation="nearest", **style)
    if north is not None:
        from matplotlib.transforms import Affine2D

        (a, c), (b, d) = east_and_north(north).tolist()
        artist.set_transform(Affine2D.from_values(a, b, c, d, 0.0, 0.0) + ax.transData)
        east, up = on_sky(list(product(extent[:2], extent[2:])), north).T
        ax.set_xlim(east.max(), east.min())
        ax.set_ylim(up.min(), up.max())
    ax.set_facecolor("0.75")
    ax.set_title(title, color=INK, loc="left")
    # An inset follows the image, whose box differs from the box of the axes.
    strip = ax.inset_axes((1.03, 0.0, 0.05, 1.0))
    low, high = np.array(artist.get_clim(), dtype=float)
    extend = ("neither", "max", "min", "both")[
        2 * bool(np.nanmin(image) < low) + bool(np.nanmax(image) > high)
    ]
    form = None if ticks is None else "%g"
    ax.figure.colorbar(artist, cax=strip, label=bar, extend=extend, ticks=ticks, format=form)


# A measured source: its pixels, and its way over the sky.


@dataclass(frozen=True, eq=False)
class Stamp:
    """The pixels about a source in one frame; NaN where they are masked or outside of it."""

    x: Image  # (n,), x of the pixels from the star, arcsec; y likewise.
    y: Image
    data: Image  # (n, n), the frame in its unit, as the others are.
    subtracted: Image  # (n, n), without the star and everything else that is not the source.
    model: Image  # (n, n), the source.
    noise: Image  # (n, n), standard deviations of the pixels.
    north: float | None  # Position angle of +y, degrees east of north.


def stamp_panels(stamp: Stamp, unit: str) -> Figure:
    """Draw data, star-subtracted data, model and residual of a source in one frame."""
    figure = constrained((4.8, 3.9), compress=True, w_pad=0.08)
    limit = max(float(np.nanmax(np.abs(stamp.model))), 3 * float(np.nanmedian(stamp.noise)))
    signed: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "bar": unit}
    light = {"cmap": "magma", "bar": unit}
    residual = (stamp.subtracted - stamp.model) / stamp.noise
    sigmas = {"cmap": "RdBu_r", "vmin": -5.0, "vmax": 5.0, "bar": "standard deviations"}
    axes: NDArray[Any] = figure.subplots(2, 2)
    for ax, title, image, style in (
        (axes[0, 0], "Data", stamp.data, light),
        (axes[0, 1], "Without the star", stamp.subtracted, signed),
        (axes[1, 0], "Model", stamp.model, signed),
        (axes[1, 1], "Residual", residual, sigmas),
    ):
        show_pixels(ax, image, stamp.x, stamp.y, title=title, north=stamp.north, **style)
        ax.locator_params(nbins=3)
        for each in (ax, *ax.child_axes):
            each.tick_params(labelsize="small")
        middle = on_sky((stamp.x.mean(), stamp.y.mean()), stamp.north)
        ax.plot(*middle, "+", color=INK, ms=8, path_effects=halo())
        label_sky(ax, stamp.north is not None, fontsize="small")
        ax.label_outer()
    return figure


@dataclass(frozen=True, eq=False)
class Epoch:
    """Sources that were measured at one date."""

    label: str
    # (k, 2), offsets from the star to the east and north, arcsec; errors are their deviations.
    places: Image
    errors: Image
    # (2,), where a source in the background would be that was at the place of the first epoch.
    background: Image | None


def sky_track(ax: Axes, epochs: Sequence[Epoch], start: Image, title: str) -> None:
    """Draw where sources were measured, and the way of one in the background; east is left.

    Epochs are in order of time, and `start` (2,) is the offset at the first of them of the source
    to which the view belongs, arcsec.
    """
    markers = "osD^vP*X"
    way = np.array([start, *(each.background for each in epochs if each.background is not None)])
    ax.plot(*way.T, "--", color=INK, lw=1, label="source in the background")
    near = max(0.15, 1.6 * float(np.abs(way - start).max()))
    for k, each in enumerate(epochs):
        marker = markers[k % len(markers)]
        inside = (np.abs(each.places - start) < near).all(axis=1)
        (x, y), (x_error, y_error) = each.places[inside].T, each.errors[inside].T
        ax.errorbar(
            x, y, y_error, x_error, fmt=marker, color=ACCENT, ms=6, capsize=2, label=each.label
        )
        if each.background is not None:
            ax.plot(*each.background, marker, mfc="white", mec=INK, ms=7, zorder=1)
    ax.set_xlim(start[0] + near, start[0] - near)
    ax.set_ylim(start[1] - near, start[1] + near)
    ax.set_box_aspect(1.0)
    ax.locator_params(nbins=5)
    label_sky(ax, oriented=True)
    ax.set_title(title, color=INK, loc="left")
    ax.legend(frameon=False, fontsize="small")
