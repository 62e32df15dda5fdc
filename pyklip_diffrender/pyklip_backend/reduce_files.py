"""A reduction of JWST files by `klip_dataset` in one call."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pyklip_diffrender.pyklip_backend.registration import ALGORITHM, backend

__all__ = ["reduce_jwst_files"]


def reduce_jwst_files(
    science: Iterable[str | os.PathLike[str]],
    references: Iterable[str | os.PathLike[str]] = (),
    *,
    folder: str | os.PathLike[str],
    prefix: str,
    verbose: bool = False,
    **settings: Any,
) -> Any:
    """Subtract the star from all rolls together and write pyKLIP's products.

    Parameters
    ----------
    science, references : iterable of path
        Files of the target and of reference stars, with the star at STARCENX, STARCENY.
    folder : path
        Of the products.
    prefix : str
        First part of their names.
    verbose : bool
        Print what is being done.
    **settings
        Fields of `DiffrenderSettings`.

    Returns
    -------
    JWSTData
        The reduced dataset, with its fits in ``diffrender_results``.

    Raises
    ------
    DiffrenderError
        See `klip_dataset` in the guide to pyKLIP scripts.
    """
    from pyklip.instruments.JWST import JWSTData
    from pyklip.parallelized import klip_dataset

    others = [str(Path(path)) for path in references]
    with backend(force=False, **settings):
        dataset = JWSTData(
            [str(Path(path)) for path in science],
            others or None,
            highpass=False,
            center_include_offset=False,
            center_keywords=["STARCENX", "STARCENY"],
        )
        klip_dataset(
            dataset,
            mode="ADI+RDI" if others else "ADI",
            outputdir=str(folder),
            fileprefix=prefix,
            annuli=1,
            subsections=1,
            numbasis=[1],
            movement=1,
            psf_library=dataset.psflib,
            # The middle of the array, where spaceKLIP has the star; pyKLIP's own choice is half a
            # pixel off for an even side.
            aligned_center=list(dataset.centers[0]),
            algo=ALGORITHM,
            verbose=verbose,
        )
    return dataset
