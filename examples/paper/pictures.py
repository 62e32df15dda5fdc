"""Small images that belong to a table, stored as multiples of a hundredth of their range."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from astropy.io import fits
from matplotlib.axes import Axes
from numpy.typing import NDArray

from pyklip_diffrender.io.files import open_fits, write_fits

Image = NDArray[np.float64]


def image_path(table: Path) -> Path:
    """Path of the images of a table."""
    return table.with_suffix(".fits.gz")


def write_images(path: Path, images: Mapping[str, Image], limit: float) -> None:
    """Write images of one size, clipped to +-`limit`."""
    steps = np.stack([np.nan_to_num(image) for image in images.values()]) / limit * 100
    cube = np.clip(np.round(steps), -100, 100).astype(np.int16)
    header = fits.Header()
    header["LIMIT"] = (limit, "value of 100 steps")
    for k, name in enumerate(images):
        header[f"NAME{k}"] = name
    write_fits(fits.HDUList([fits.PrimaryHDU(cube, header)]), path)


def read_images(path: Path) -> dict[str, Image]:
    """Read images that `write_images` wrote."""
    with open_fits(path) as hdus:
        header, cube = hdus[0].header, np.asarray(hdus[0].data, dtype=float)
    return {header[f"NAME{k}"]: image * header["LIMIT"] / 100 for k, image in enumerate(cube)}


def show(ax: Axes, image: Image, title: str, limit: float, cmap: str = "RdBu_r") -> None:
    """An image without ticks."""
    ax.imshow(image, origin="lower", vmin=-limit, vmax=limit, cmap=cmap, interpolation="nearest")
    ax.set_title(title, fontsize=8, loc="left")
    ax.set_xticks([])
    ax.set_yticks([])
