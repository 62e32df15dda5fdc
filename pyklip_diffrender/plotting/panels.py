"""Parts of figures: images with axes in arcseconds, colour bars, a compass."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from math import cos, radians, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.io.geometry import rotation_matrix
from pyklip_diffrender.io.units import ARCSEC

if TYPE_CHECKING:
    from astropy.units import UnitBase
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from pyklip_diffrender.optics.detector import Detector
    from pyklip_diffrender.optics.planes import Values
    from pyklip_diffrender.scene.observation import Observation

__all__ = [
    "ACCENT",
    "INK",
    "Extent",
    "axes_for",
    "detector_extent",
    "draw_compass",
    "draw_image",
    "extent_of",
    "halo",
    "label_sky",
    "light_norm",
    "mark",
    "save",
    "show",
    "to_png",
    "turned",
    "unit_label",
]

INK = "#1b1f24"
ACCENT = "#0b6e4f"
"""A dark green, distinct from both ends of the red and blue maps."""

_COMPASS = 30.0
"""From the tail of an arrow to its letter, points."""

Extent = tuple[float, float, float, float]
"""Left, right, bottom and top edge of an image."""


def save(figure: Figure, path: str | Path, dpi: int = 150) -> None:
    """Write a figure in one step."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi, facecolor="white")


def to_png(figure: Figure, dpi: int = 150) -> bytes:
    """The file that `save` would write."""
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, facecolor="white")
    return stream.getvalue()


def draw_image(
    ax: Axes,
    image: NDArray[np.float64],
    pixelscale: float,
    *,
    limits: tuple[float, float],
    cmap: str,
    title: str,
    norm: Any = None,
) -> Any:
    """Show an image with its axes in arcseconds from the middle, y up.

    Returns
    -------
    AxesImage
    """
    half_y, half_x = (n * pixelscale / 2 for n in image.shape)
    artist = ax.imshow(
        image,
        origin="lower",
        extent=(-half_x, half_x, -half_y, half_y),
        cmap=cmap,
        interpolation="nearest",
        **({"norm": norm} if norm is not None else {"vmin": limits[0], "vmax": limits[1]}),
    )
    ax.set_title(title, fontsize=10, color=INK, loc="left")
    ax.tick_params(labelsize=8, colors=INK)
    return artist


def axes_for(ax: Any, count: int) -> Sequence[Axes]:
    """Return the axes of the caller, or those of a new figure with one row.

    Raises
    ------
    IncompatibleSetupError
        For another number of axes.
    """
    if ax is None:
        from matplotlib import pyplot

        size = (4.6 * count, 4.0)
        ax = pyplot.subplots(1, count, figsize=size, layout="compressed")[1]
    axes: list[Axes] = list(np.ravel(ax))
    if len(axes) != count:
        raise IncompatibleSetupError(
            f"ax: got {len(axes)} axes, expected {count}, such as pyplot.subplots(1, {count})[1]"
        )
    return axes


def extent_of(x: NDArray[np.float64], y: NDArray[np.float64]) -> Extent:
    """Edges of an image whose pixels have their centres at `x` and `y`."""
    half_x, half_y = (abs(axis[-1] - axis[0]) / (2 * max(len(axis) - 1, 1)) for axis in (x, y))
    return x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y


def detector_extent(detector: Detector, values: Values) -> Extent:
    """Edges of a detector in arcsec from the star."""
    star = values["star_offset"].cpu().numpy() if "star_offset" in values else np.zeros(2)
    x, y = (
        axis.reshape(-1, detector.oversample).mean(dim=1).cpu().numpy() / ARCSEC
        for axis in detector.axes(values)
    )
    return extent_of(x - star[0], y - star[1])


def label_sky(*axes: Axes) -> None:
    """Label axes whose origin is the star, and mark the star with a cross."""
    for ax in axes:
        ax.plot(0, 0, "+", color=INK, ms=11, mew=1.6, label="star", path_effects=halo())
        ax.set_xlabel("x from the star (arcsec)")
    axes[0].set_ylabel("y from the star (arcsec)")


def turned(places: ArrayLike, frame: Observation, first: Observation) -> NDArray[np.float64]:
    """Rotate positions (k, 2) from the orientation of the first frame to that of another frame."""
    return np.reshape(places, (-1, 2)) @ rotation_matrix(frame.roll_from(first)).T


def show(
    ax: Axes,
    image: NDArray[np.float64],
    extent: Extent,
    *,
    bar: str,
    title: str,
    ticks: Sequence[float] | None = None,
    **style: Any,
) -> AxesImage:
    """Show an image, y up, with a colour bar as high as it; NaN is grey."""
    artist = ax.imshow(image, origin="lower", extent=extent, interpolation="nearest", **style)
    ax.set_facecolor("0.75")
    ax.set_title(title, color=INK, loc="left")
    # An inset follows the image, whose box differs from that of the axes.
    strip = ax.inset_axes((1.03, 0.0, 0.05, 1.0))
    low, high = np.array(artist.get_clim(), dtype=float)
    extend = ("neither", "max", "min", "both")[
        2 * bool(np.nanmin(image) < low) + bool(np.nanmax(image) > high)
    ]
    form = None if ticks is None else "%g"
    ax.figure.colorbar(artist, cax=strip, label=bar, extend=extend, ticks=ticks, format=form)
    return artist


def light_norm(image: NDArray[np.float64], noise: NDArray[np.float64]) -> Any:
    """Linear around zero within three times the median noise, logarithmic beyond."""
    from matplotlib.colors import AsinhNorm

    width = 3 * float(np.median(noise))
    low, high = float(np.nanmin(image)), float(np.nanmax(image))
    return AsinhNorm(width, vmin=max(low, -width), vmax=max(high, low + width))


def halo() -> list[Any]:
    """Effects that make dark lines and text legible on any image."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=3.5, foreground="white")]


def mark(ax: Axes, places: ArrayLike, labels: Sequence[str] = ()) -> None:
    """Draw circles around positions (k, 2), with labels."""
    x, y = np.reshape(places, (-1, 2)).T
    ax.plot(
        x, y, "o", mfc="none", mec=INK, ms=15, mew=1.6, label="companions", path_effects=halo()
    )  # fmt: skip
    for label, place in zip(labels, zip(x, y, strict=True), strict=False):
        ax.annotate(
            label, place, (0, 11), textcoords="offset points", color=INK, ha="center", va="bottom",
            path_effects=halo(),
        )  # fmt: skip


def draw_compass(ax: Axes, position_angle: float) -> None:
    """Arrows to north and east in the lower left corner.

    Parameters
    ----------
    ax : Axes
    position_angle : float
        Of the image's +y axis, degrees east of north.
    """
    angle = radians(position_angle)
    # Whichever way the arrows point, they stay inside.
    north, east = (sin(angle), cos(angle)), (-cos(angle), sin(angle))
    margin = 14.0
    x, y = (margin - _COMPASS * min(0.0, north[k], east[k]) for k in range(2))
    for letter, arrow in (("N", north), ("E", east)):
        ax.annotate(
            letter, (x, y), (x + _COMPASS * arrow[0], y + _COMPASS * arrow[1]),
            xycoords="axes points", textcoords="axes points", color=INK, ha="center", va="center",
            path_effects=halo(),
            arrowprops={
                "arrowstyle": "<-", "color": INK, "lw": 1.4, "shrinkB": 0, "path_effects": halo(),
            },
        )  # fmt: skip


def unit_label(unit: UnitBase) -> str:
    """A unit as text for a colour bar."""
    names = getattr(unit, "long_names", [])
    return str(names[0] if names else unit.to_string())
