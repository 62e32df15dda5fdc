"""Make ``algo="diffrender"`` work in pyKLIP, permanently or in a block, and undo it exactly."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings, OPDLike
from pyklip_diffrender.pyklip_backend.child import announce, spawned_beside_klip
from pyklip_diffrender.pyklip_backend.dispatch import Patches
from pyklip_diffrender.pyklip_backend.registry import ALGORITHM, BLOCK, REGISTRY

__all__ = ["ALGORITHM", "backend", "is_registered", "register", "unregister"]


def _use(registered: bool, blocks: int, forcing: int | None = None) -> None:
    """Set the users; patch pyKLIP for the first and restore it after the last.

    Parameters
    ----------
    registered : bool
    blocks : int
        Number of `backend` blocks in all threads.
    forcing : int, optional
        Number of those that take over KLIP.
    """
    in_use = registered or blocks > 0 or REGISTRY.watching
    if in_use and REGISTRY.patches is None:
        patches = Patches()
        patches.apply()
        REGISTRY.patches = patches
    elif not in_use and REGISTRY.patches is not None:
        REGISTRY.patches.restore()
        REGISTRY.patches = None
    REGISTRY.registered, REGISTRY.blocks = registered, blocks
    REGISTRY.forcing = REGISTRY.forcing if forcing is None else forcing
    announce(REGISTRY.forcing > 0 or bool(REGISTRY.replace))


def is_registered() -> bool:
    """Whether ``algo="diffrender"`` works at present."""
    return REGISTRY.registered or REGISTRY.blocks > 0


def register(
    opd: OPDLike | None = None, model: Any = None, *, replace: bool | None = None, **options: Any
) -> None:
    """Make ``klip_dataset(..., algo="diffrender")`` work until `unregister`.

    Calling it again changes only the settings that are given. While registered, `JWSTData` also
    keeps the recorded pixels, errors, flags and headers of the files it reads, for the fit to use;
    so register before making the dataset.

    Parameters
    ----------
    opd : path, ndarray or Quantity, optional
        Default wavefront map, see `DiffrenderSettings`.
    model : optical model, optional
        Default model; if not given, one is made for the dataset's filter.
    replace : bool, optional
        True takes over calls with ``algo="klip"`` as well, for code that hard-codes it. With False
        they run KLIP. By default they run KLIP too, with a warning if the same dataset was reduced
        by this backend before.
    **options
        Other fields of `DiffrenderSettings`.

    Raises
    ------
    IncompatibleSetupError
        If pyKLIP is not as expected.

    Examples
    --------
    With a wavefront map and a `dataset` that pyKLIP has read, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> dr.register(opd="R2022073003-NRCA3_FP1-1.fits")  # doctest: +SKIP
    >>> klip_dataset(dataset, mode="ADI", algo="diffrender")  # doctest: +SKIP
    """
    settings = DiffrenderSettings(opd=opd, model=model, **options)
    with REGISTRY.lock:
        REGISTRY.replace = REGISTRY.replace if replace is None else replace
        _use(True, REGISTRY.blocks)
        REGISTRY.defaults = settings.over(REGISTRY.defaults)


def unregister() -> None:
    """Restore pyKLIP exactly and forget the settings given to `register`.

    Inside a `backend` block, pyKLIP is restored when the block ends.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> dr.register(fit_pixels=64)
    >>> dr.unregister()
    """
    with REGISTRY.lock:
        REGISTRY.defaults = DiffrenderSettings()
        REGISTRY.replace = None
        _use(False, REGISTRY.blocks)


@contextlib.contextmanager
def backend(
    name: str = ALGORITHM,
    *,
    opd: OPDLike | None = None,
    model: Any = None,
    force: bool = True,
    **options: Any,
) -> Iterator[None]:
    """Use this backend within a block, without changing the code that is called there.

    The block holds for the thread that enters it, and for processes that are forked in it. Calls in
    other threads and in spawned processes run KLIP with a warning.

    Parameters
    ----------
    name : str
        Only "diffrender".
    opd, model, **options
        As for `register`; they override those of the dataset and of `register`.
    force : bool
        Also take over calls with ``algo="klip"``, for code that hard-codes it. Other algorithms
        are not affected.

    Raises
    ------
    IncompatibleSetupError
        For an unknown name, or if pyKLIP is not as expected.

    Examples
    --------
    With a wavefront map, a `dataset` and a `library` that pyKLIP has read:

    >>> with dr.backend(opd="opd.fits"):  # doctest: +SKIP
    ...     klip_dataset(dataset, mode="ADI+RDI", psf_library=library)
    """
    if name != ALGORITHM:
        raise IncompatibleSetupError(f"name: got {name!r}, the only backend is {ALGORITHM!r}")
    outer, _ = BLOCK.get()
    settings = DiffrenderSettings(opd=opd, model=model, **options).over(outer)
    with REGISTRY.lock:
        _use(REGISTRY.registered, REGISTRY.blocks + 1, REGISTRY.forcing + int(bool(force)))
    token = BLOCK.set((settings, force))
    try:
        yield
    finally:
        BLOCK.reset(token)
        with REGISTRY.lock:
            _use(REGISTRY.registered, REGISTRY.blocks - 1, REGISTRY.forcing - int(bool(force)))


if spawned_beside_klip():
    # So that plain KLIP is mentioned, in a spawned process.
    with REGISTRY.lock:
        REGISTRY.watching = True
        _use(REGISTRY.registered, REGISTRY.blocks)
