"""What a user's stpsf instrument is set to, asked without changing it."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits

from pyklip_diffrender.errors import CorruptFileError, DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.io.units import to_metres

__all__ = ["band", "data_errors", "kernel_files_left_open", "oversampling", "private_copy"]


def private_copy(nircam: Any) -> Any:
    """An instrument that shares data with the user's, but no settings."""
    instrument = copy.copy(nircam)
    instrument.options = dict(nircam.options)
    if hasattr(instrument.pupil, "v2v3"):
        # As calc_psf does: a telescope model has to know where in the field it is used.
        instrument.pupil = copy.deepcopy(instrument.pupil)
        position = instrument._tel_coords().to(u.arcsec)
        if instrument.pupil.v2v3 is None or not (instrument.pupil.v2v3 == position).all():
            instrument.pupil.v2v3 = position
            instrument.pupil.update_opd()
    return instrument


def oversampling(recipe: Mapping[str, Any]) -> tuple[int, int]:
    """Of the image planes and of the detector, by stpsf's rules."""
    both, fine, pixels = (
        recipe[name] for name in ("oversample", "fft_oversample", "detector_oversample")
    )
    if None not in (both, fine, pixels):
        raise IncompatibleSetupError(
            "give oversample, or detector_oversample with fft_oversample, not all three"
        )
    if both is None and fine is None and pixels is None:
        both = 4
    found = (fine if fine is not None else both, pixels if pixels is not None else both)
    if None in found:
        raise IncompatibleSetupError(
            f"fft_oversample={fine}, detector_oversample={pixels}: give both, or oversample"
        )
    return int(found[0]), int(found[1])


def band(instrument: Any, recipe: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    """Wavelengths (m) and weights, as stpsf has them."""
    monochromatic = recipe["monochromatic"]
    if monochromatic is not None:
        monochromatic = float(to_metres(monochromatic, "monochromatic"))
    with data_errors():
        wavelengths, weights = instrument._get_weights(
            source=recipe["source"], nlambda=recipe["nlambda"], monochromatic=monochromatic
        )
    waves = [float(w) for w in np.atleast_1d(wavelengths)]
    try:
        instrument._validate_config(wavelengths=waves)
    except RuntimeError as error:
        raise IncompatibleSetupError(
            f"wavelengths {min(waves):.4g} to {max(waves):.4g} m with {instrument.filter}: "
            f"{error}. Wavelengths are in metres"
        ) from error
    if monochromatic is not None:
        _warn_outside(instrument, monochromatic)
    return waves, [float(w) for w in np.atleast_1d(weights)]


def _warn_outside(instrument: Any, wavelength: float) -> None:
    """Stpsf lets a wavelength be outside the filter; say so."""
    path = instrument._filters[instrument.filter].filename
    if not os.path.exists(path):
        return  # Only broadband PSFs need the curve.
    table = fits.getdata(path, 1)
    used = np.asarray(table["THROUGHPUT"], dtype=float)
    passed = np.asarray(table["WAVELENGTH"], dtype=float)[used > 1e-3 * used.max()] * 1e-10
    if not passed.min() <= wavelength <= passed.max():
        warnings.warn(
            f"monochromatic: {wavelength:.4g} m is outside {instrument.filter} ({passed.min():.4g} "
            f"to {passed.max():.4g} m); the filter only names the PSF",
            DiffrenderWarning,
            stacklevel=4,
        )


@contextmanager
def data_errors() -> Iterator[None]:
    """Say which directory it is about when stpsf misses one of its files."""
    try:
        yield
    except (FileNotFoundError, OSError, RuntimeError) as error:
        if isinstance(error, CorruptFileError):
            raise
        raise CorruptFileError(
            f"stpsf could not read its data ({error}). STPSF_PATH is "
            f"{os.environ.get('STPSF_PATH')!r}; it must hold the complete stpsf data files, see "
            "https://stpsf.readthedocs.io/en/latest/installation.html"
        ) from error


@contextmanager
def kernel_files_left_open() -> Iterator[None]:
    """Files that stpsf 2.2 leaves open: those of its detector kernels (stpsf/detectors.py)."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "unclosed file", ResourceWarning)
        yield
