"""Small FITS files of the kinds that are read, in memory, whole or damaged."""

import gzip
import io
import warnings
from functools import lru_cache

import numpy as np
import small_files
from astropy.io import fits

from pyklip_diffrender.errors import CorruptFileError, DiffrenderError
from pyklip_diffrender.scene import Observation
from pyklip_diffrender.wavefront import OPDMap, random_opd, read_opd

READERS = {"opd": read_opd, "calints": Observation.from_fits}


@lru_cache(maxsize=1)
def wavefront():
    """16 x 16 samples, m."""
    return random_opd(5, npix=16).data


def opd_map():
    """A wavefront map."""
    hdu = fits.PrimaryHDU(wavefront())
    hdu.header.update({"BUNIT": "m", "DATE-OBS": "2022-08-11T01:02:03"})
    return fits.HDUList([hdu])


def calints(science=None, error=None, quality=None):
    """Two frames of 8 x 10; SCI, ERR or DQ may be given."""
    if science is None:
        science = np.random.default_rng(1).normal(10, 2, (2, 8, 10)).astype(np.float32)
    error = np.ones((2, 8, 10), dtype=np.float32) if error is None else error
    quality = np.zeros((2, 8, 10), dtype=np.uint32) if quality is None else quality
    stream = small_files.calints(io.BytesIO(), science, error, quality)
    stream.seek(0)
    return fits.open(stream)


@lru_cache(maxsize=16)
def content(kind, checksum=False, packed=False):
    """The bytes of a whole file."""
    stream = io.BytesIO()
    {"opd": opd_map, "calints": calints}[kind]().writeto(stream, checksum=checksum)
    return gzip.compress(stream.getvalue(), mtime=0) if packed else stream.getvalue()


def outcome(kind, path, damaged):
    """Read a damaged file: (result, whether there was a warning), or (None, True) for an error.

    Errors that are not the package's own go through.
    """
    path.write_bytes(damaged)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            return READERS[kind](path), bool(caught)
        except DiffrenderError as error:
            if isinstance(error, CorruptFileError) and path.name not in str(error):
                raise AssertionError("the message does not name the file") from error
            return None, True


def _arrays(result):
    if isinstance(result, OPDMap):
        return [result.data]
    return [result.data, result.error, result.valid, result.center, np.array(result.pixelscale)]


def same(result, truth):
    """Whether two results are the same in all numbers."""
    pairs = zip(_arrays(result), _arrays(truth), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs) and result.date == truth.date


def sane(result):
    """Whether a result is one that everything behind the reader can take."""
    finite = all(np.isfinite(a).all() for a in _arrays(result))
    if isinstance(result, OPDMap):
        return finite and result.data.ndim == 2 and result.data.dtype == np.dtype("=f8")
    shapes = {result.data.shape, result.error.shape, result.valid.shape}
    good = len(shapes) == 1 and result.data.ndim == 3 and bool((result.error > 0).all())
    return finite and good and min(result.pixelscale) > 0
