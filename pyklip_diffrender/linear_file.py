"""The file of a linear model, read with all its parts checked against each other."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import CorruptFileError
from pyklip_diffrender.files import open_fits
from pyklip_diffrender.headers import header_number
from pyklip_diffrender.units import native_float64

__all__ = ["read_linear"]

_PARTS = ("RESIDUAL", "WEIGHT", "JACOBIAN", "ROWS", "DRIFT")
"""Extensions of every frame, in this order."""

_COLUMNS = ("NAME", "VECTOR", "MEAN", "DEVIATION")


def read_linear(path: str | os.PathLike[str]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Read what `LinearModel.save` wrote.

    Returns
    -------
    model : dict
        Attributes of the `LinearModel`, without its frames.
    frames : list of dict
        Attributes of each `LinearFrame`.

    Raises
    ------
    CorruptFileError
        If it is another file, or its parts do not go together.
    """
    path = Path(path)
    with open_fits(path) as hdus:
        count, rest = divmod(len(hdus) - 3, len(_PARTS))
        there = [(hdu.name, hdu.ver) for hdu in hdus[1:]]
        wanted = [("UNKNOWNS", 1), ("CURVATURE", 1)]
        wanted += [(part, k) for k in range(1, count + 1) for part in _PARTS]
        if count < 1 or rest or there != wanted:
            raise CorruptFileError(
                f"{path}: not a linear model: its extensions are {there}, expected UNKNOWNS, "
                f"CURVATURE and, for every frame, {', '.join(_PARTS)}; a file that "
                "LinearModel.save wrote"
            )
        model = _unknowns(hdus["UNKNOWNS"], path)
        size = len(model["names"])
        model["curvature"] = torch.from_numpy(_image(hdus["CURVATURE"], (size, size), path))
        frames = [_frame(hdus, k, size, path) for k in range(1, count + 1)]
    # A file may end between two frames; then nothing is left of what the later ones see alone.
    seen = torch.cat([frame[part] for frame in frames for part in ("rows", "drift")]).unique()
    if len(seen) != size:
        raise CorruptFileError(
            f"{path}: {size - len(seen)} of {size} unknowns appear in none of its {count} frames. "
            "Some frames are missing; make the file again"
        )
    return model, frames


def _unknowns(hdu: Any, path: Path) -> dict[str, Any]:
    names = getattr(hdu.columns, "names", ()) if hasattr(hdu, "columns") else ()
    if tuple(names) != _COLUMNS or hdu.data is None:
        raise CorruptFileError(
            f"{path}: UNKNOWNS has the columns {list(names)}, expected {list(_COLUMNS)}"
        )
    table = hdu.data
    numbers = {}
    for name in _COLUMNS[1:]:
        column = table[name]
        good = column.ndim == 1 and column.dtype.kind == "f"
        # Without a prior the deviation is infinite.
        if not good or not (column > 0 if name == "DEVIATION" else np.isfinite(column)).all():
            raise CorruptFileError(
                f"{path}: {name} of UNKNOWNS is not what it should be, expected "
                f"{'positive' if name == 'DEVIATION' else 'finite'} numbers"
            )
        numbers[name.lower()] = torch.from_numpy(native_float64(column))
    return {"names": tuple(str(name) for name in table["NAME"]), **numbers}


def _image(hdu: Any, shape: tuple[int, ...], path: Path) -> NDArray[np.float64]:
    """Finite numbers of a shape, where -1 stands for any length."""
    if not hdu.is_image:
        raise CorruptFileError(f"{path}: {hdu.name} is a table, expected an image")
    if hdu.data is None:  # FITS has no empty images.
        return np.zeros([max(0, n) for n in shape])
    array = native_float64(hdu.data)
    fits_in = array.ndim == len(shape) and all(
        want in (-1, got) for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits_in or not np.isfinite(array).all():
        raise CorruptFileError(
            f"{path}: {hdu.name} {hdu.ver} has the shape {array.shape}, or is not finite; "
            f"expected numbers of the shape {shape} (-1: any length)"
        )
    return array


def _places(hdu: Any, shape: tuple[int], size: int, path: Path) -> torch.Tensor:
    """Indices among `size` unknowns."""
    array = _image(hdu, shape, path)
    if ((array < 0) | (array >= size) | (array % 1 != 0)).any():
        raise CorruptFileError(f"{path}: {hdu.name} {hdu.ver} names unknowns that are not there")
    return torch.from_numpy(array).to(torch.int64)


def _frame(hdus: fits.HDUList, version: int, size: int, path: Path) -> dict[str, Any]:
    parts = {name: hdus[name, version] for name in _PARTS}
    residual = _image(parts["RESIDUAL"], (-1, -1), path)
    weight = _image(parts["WEIGHT"], residual.shape, path)
    jacobian = _image(parts["JACOBIAN"], (-1, *residual.shape), path)
    modes = header_number(parts["RESIDUAL"].header, "FIRSTMOD", str(path))
    drift = _places(parts["DRIFT"], (-1,), size, path)
    if modes is None or modes % 1 or not 0 <= modes <= len(jacobian) - len(drift):
        raise CorruptFileError(
            f"{path}: RESIDUAL {version} has FIRSTMOD {modes}, expected the place of the first "
            f"mode among {len(jacobian)} rows"
        )
    return {
        "residual": torch.from_numpy(residual),
        "weight": torch.from_numpy(weight),
        "jacobian": torch.from_numpy(jacobian).to(torch.float32),
        "rows": _places(parts["ROWS"], (len(jacobian),), size, path),
        "drift": drift,
        "modes": int(modes),
    }
