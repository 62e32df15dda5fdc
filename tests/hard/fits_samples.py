"""Small FITS files of the kinds that are read, in memory, whole or damaged."""

from __future__ import annotations

import gzip
import io
import tempfile
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from astropy.io import fits

from pyklip_diffrender.errors import CorruptFileError, DiffrenderError
from pyklip_diffrender.linear.model import LinearFrame, LinearModel
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd import OPDMap, random_opd, read_opd

__all__ = ["READERS", "calints", "content", "opd_map", "outcome", "same", "sane", "wavefront"]

Result = OPDMap | Observation | LinearModel

READERS: dict[str, Callable[[Path], Result]] = {
    "opd": read_opd, "calints": Observation.from_fits, "linear": LinearModel.load,
}  # fmt: skip


@lru_cache(maxsize=1)
def wavefront() -> np.ndarray:
    """16 x 16 samples, m."""
    return random_opd(5, npix=16).data


def opd_map(data: np.ndarray | None = None) -> fits.HDUList:
    """A wavefront map."""
    hdu = fits.PrimaryHDU(wavefront() if data is None else data)
    hdu.header["BUNIT"] = "m"
    hdu.header["DATE-OBS"] = "2022-08-11T01:02:03"
    return fits.HDUList([hdu])


def calints(**planes: np.ndarray) -> fits.HDUList:
    """Two frames of 8 x 10; SCI, ERR or DQ may be given."""
    rng = np.random.default_rng(1)
    data = rng.normal(10, 2, (2, 8, 10)).astype(np.float32)
    arrays = {
        "SCI": data, "ERR": np.ones_like(data), "DQ": np.zeros(data.shape, dtype=np.uint32),
        **planes,
    }  # fmt: skip
    hdus = fits.HDUList([fits.PrimaryHDU()])
    hdus[0].header["FILTER"] = "F444W"
    hdus[0].header["DATE-BEG"] = "2022-07-30T02:03:04.5"
    for name, array in arrays.items():
        hdus.append(fits.ImageHDU(array, name=name))
    science = {
        "BUNIT": "MJy/sr", "PIXAR_A2": 0.00396, "CRPIX1": 6.0, "CRPIX2": 5.0, "ROLL_REF": 100.0,
        "V3I_YANG": -0.5, "VPARITY": -1,
    }  # fmt: skip
    hdus["SCI"].header.update(science)
    return hdus


def linear() -> fits.HDUList:
    """Two frames of 3 x 4 pixels: a flux each, two modes, by one of which they may differ."""

    def random(*shape: int, seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    frames = tuple(
        LinearFrame(
            random(3, 4, seed=k), random(3, 4, seed=10 + k).abs(), random(3, 3, 4, seed=k).float(),
            torch.tensor(rows), torch.tensor(drift, dtype=torch.int64), 1,
        )
        for k, rows, drift in ((1, [0, 2, 3], []), (2, [1, 2, 3], [4]))
    )  # fmt: skip
    deviation = torch.tensor([np.inf, np.inf, 1.0, 2.0, 0.5], dtype=torch.float64)
    names = ("flux[0]", "flux[1]", "modes[0]", "modes[1]", "drift[0]")
    square = random(5, 5, seed=5)
    model = LinearModel(
        names, frames, random(5, seed=6), 0 * deviation.clamp(max=1), deviation, square @ square.T
    )
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "linear.fits")
        return fits.open(io.BytesIO((Path(folder) / "linear.fits").read_bytes()))


_MAKERS: dict[str, Callable[[], fits.HDUList]] = {
    "opd": opd_map, "calints": calints, "linear": linear
}  # fmt: skip


@lru_cache(maxsize=16)
def content(kind: str, checksum: bool = False, packed: bool = False) -> bytes:
    """The bytes of a whole file."""
    stream = io.BytesIO()
    _MAKERS[kind]().writeto(stream, checksum=checksum)
    return gzip.compress(stream.getvalue(), mtime=0) if packed else stream.getvalue()


def outcome(kind: str, path: Path, damaged: bytes) -> tuple[Result | None, bool]:
    """Read a damaged file: (result, whether there was a warning), or (None, True) for an error.

    Errors that are not the package's own go through.
    """
    path.write_bytes(damaged)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            return READERS[kind](path), bool(caught)
        except CorruptFileError as error:
            if path.name not in str(error):
                raise AssertionError("the message does not name the file") from error
            return None, True
        except DiffrenderError:
            return None, True


def _arrays(result: Result) -> list[np.ndarray]:
    if isinstance(result, OPDMap):
        return [result.data]
    if isinstance(result, LinearModel):
        parts = ("residual", "weight", "jacobian", "rows", "drift")
        ours = [getattr(frame, part) for frame in result.frames for part in parts]
        ours += [result.vector, result.mean, 1 / result.deviation, result.curvature]
        return [array.numpy() for array in ours] + [np.array([f.modes for f in result.frames])]
    return [result.data, result.error, result.valid, result.center, np.array(result.pixelscale)]


def _words(result: Result) -> object:
    return result.names if isinstance(result, LinearModel) else result.date


def same(result: Result, truth: Result) -> bool:
    """Whether two results are the same in all numbers."""
    pairs = zip(_arrays(result), _arrays(truth), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs) and _words(result) == _words(truth)


def sane(result: Result) -> bool:
    """Whether a result is one that everything behind the reader can take."""
    finite = all(np.isfinite(a).all() for a in _arrays(result))
    if isinstance(result, OPDMap):
        return finite and result.data.ndim == 2 and result.data.dtype == np.dtype("=f8")
    if isinstance(result, LinearModel):
        size = len(result.names)
        good = {len(result.vector), len(result.mean), len(result.deviation)} == {size}
        # Takes rows and places apart as everything behind does.
        shapes = {f.onto_unknowns(f.jacobian.flatten(1), size).shape for f in result.frames}
        return finite and good and shapes == {(size, 12)}
    shapes = {result.data.shape, result.error.shape, result.valid.shape}
    good = len(shapes) == 1 and result.data.ndim == 3 and bool((result.error > 0).all())
    return finite and good and min(result.pixelscale) > 0
