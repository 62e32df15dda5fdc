"""Checks that take a second, before minutes of fitting."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError, ShapeError
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.dataset_frames import require_frames
from pyklip_diffrender.pyklip_backend.product_images import IMAGES

__all__ = ["check_arguments", "check_dataset", "check_settings"]


def check_dataset(dataset: Any) -> None:
    """Raise for a dataset without frames or without pixels."""
    if np.ndim(dataset.input) != 3:
        raise ShapeError(f"dataset.input: got shape {np.shape(dataset.input)}, expected 3-D")
    require_frames(dataset)
    if not np.isfinite(dataset.input).any():
        raise NoValidPixelsError(
            f"{list(map(str, dataset.filenames))}: every pixel of every frame is NaN, nothing "
            "is left to fit"
        )


def check_arguments(arguments: Mapping[str, Any]) -> None:
    """Raise for arguments of `klip_dataset` that do not go together."""
    dataset, mode = arguments["dataset"], str(arguments["mode"])
    if not any(part in mode.upper() for part in ("ADI", "RDI", "SDI")):
        raise IncompatibleSetupError(
            f"mode: got {mode!r}, expected ADI, RDI, SDI or a sum of them such as 'ADI+RDI'"
        )
    if mode.strip().upper() == "SDI" and len(np.unique(dataset.wvs)) == 1:
        raise IncompatibleSetupError(
            "mode: 'SDI' compares wavelengths, and this dataset has one. Use mode='ADI', or "
            "mode='RDI' with a psf_library: the star is rendered, so neither needs references"
        )
    wavelengths = np.unique(dataset.wvs)
    cubes, left_over = divmod(len(dataset.wvs), len(wavelengths))
    if left_over or not np.array_equal(dataset.wvs, np.tile(wavelengths, cubes)):
        raise IncompatibleSetupError(
            f"dataset.wvs: pyKLIP takes frames of {len(wavelengths)} wavelengths for slices of "
            "spectral cubes, one after the other from the shortest to the longest wavelength. "
            "These have another order. Make one dataset for each filter, and reduce them one by one"
        )
    if arguments["calibrate_flux"]:
        from pyklip.instruments.Instrument import Data

        if type(dataset).calibrate_output is Data.calibrate_output:
            raise IncompatibleSetupError(
                f"calibrate_flux: a {type(dataset).__name__} has no flux calibration of its own. "
                "Pass calibrate_flux=False; the products have the unit of the frames"
            )


def check_settings(settings: DiffrenderSettings) -> None:
    """Raise for settings of the default subtractor that it could not use."""
    if settings.threads is not None and settings.threads < 1:
        raise IncompatibleSetupError(f"threads: got {settings.threads}, expected 1 or more")
    if settings.image not in (None, *IMAGES):
        raise IncompatibleSetupError(
            f"image: got {settings.image!r}, expected one of {', '.join(IMAGES)}"
        )
    if settings.subtractor is not None:
        return
    from pyklip_diffrender.instrument.nircam import nircam_coronagraph
    from pyklip_diffrender.pattern.choice import as_request

    known = set(inspect.signature(nircam_coronagraph).parameters) - {"filter"}
    wrong = sorted(set(settings.model_options) - known)
    if wrong:
        raise IncompatibleSetupError(
            f"model_options: {', '.join(wrong)}: not known to nircam_coronagraph, which has "
            f"{', '.join(sorted(known))}"
        )
    if settings.systematics is not None:
        as_request(settings.systematics)
    if settings.max_chi2 is not None and not settings.max_chi2 > 0:
        raise IncompatibleSetupError(
            f"max_chi2: got {settings.max_chi2}, expected a positive number; inf for no limit"
        )
