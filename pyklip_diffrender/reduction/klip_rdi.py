"""KLIP by pyKLIP on arrays in memory, for comparisons."""

from __future__ import annotations

import contextlib
import io
import tempfile

import numpy as np
from numpy.typing import NDArray

__all__ = ["klip_rdi"]


def klip_rdi(
    target: NDArray[np.float64],
    references: NDArray[np.float64],
    *,
    numbasis: int = 9,
) -> NDArray[np.float64]:
    """Subtract the star with pyKLIP's reference differential imaging.

    Parameters
    ----------
    target : ndarray, (ny, nx)
        The frame, with the star in the middle of the array.
    references : ndarray, (frames, ny, nx)
        Frames of a reference star.
    numbasis : int
        Karhunen-Loeve modes.

    Returns
    -------
    ndarray, (ny, nx)
        The subtracted frame; NaN in the innermost pixel and outside the largest annulus.
    """
    from pyklip import rdi
    from pyklip.instruments.Instrument import GenericData
    from pyklip.parallelized import klip_dataset

    ny, nx = target.shape
    center = np.array([(nx - 1) / 2, (ny - 1) / 2])
    stack = np.concatenate([target[None], references])
    names = np.array(["target"] + [f"reference {k}" for k in range(len(references))])
    dataset = GenericData(
        target[None].copy(),
        center[None],
        parangs=np.zeros(1),
        wvs=np.array([4.5e-6]),
        IWA=1.0,
        filenames=names[:1],
    )
    # pyKLIP prints messages and a progress bar.
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        library = rdi.PSFLibrary(stack, center, names, compute_correlation=True)
        library.prepare_library(dataset)
        klip_dataset(
            dataset,
            mode="RDI",
            outputdir=folder,
            fileprefix="klip",
            annuli=5,
            subsections=4,
            numbasis=[numbasis],
            movement=0,
            psf_library=library,
            aligned_center=center,
            numthreads=1,
            algo="klip",
            verbose=False,
        )
        return np.array(dataset.output[0, 0, 0], dtype=np.float64)
