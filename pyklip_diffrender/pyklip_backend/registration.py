"""Make ``algo="diffrender"`` work in pyKLIP, for good or for a block, and undo it exactly.

Scripts often hold `klip_dataset` itself (``from pyklip.parallelized import klip_dataset``) long
before this package is imported, so replacing the name in the module would not reach them. The
function object stays, and only its code is exchanged: the new code hands the call to
`dispatch`, which runs pyKLIP's own code for every other algorithm.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any, Unpack

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.pyklip_backend.capture import capturing_readdata
from pyklip_diffrender.pyklip_backend.exchange import ExchangedFunction, ExchangedMethod
from pyklip_diffrender.pyklip_backend.reduction import Reduction, mark_filtered
from pyklip_diffrender.pyklip_backend.settings import (
    DiffrenderSettings,
    OPDLike,
    Options,
    settings_of,
)

__all__ = ["ALGORITHM", "backend", "dispatch", "dispatch_fm", "is_registered"]
__all__ += ["register", "unregister"]

logger = logging.getLogger(__name__)

ALGORITHM = "diffrender"
"""What to give `klip_dataset` as `algo`."""


class _Hooks:
    """The exchanges in pyKLIP, there while anyone holds them."""

    def __init__(self) -> None:
        from pyklip import fm, parallelized

        self.klip_dataset = ExchangedFunction(
            parallelized.klip_dataset,
            _klip_dataset,
            ("klip_parallelized", "klip_parallelized_lite", "high_pass_filter_imgs"),
        )
        self.fm_klip_dataset = ExchangedFunction(fm.klip_dataset, _fm_klip_dataset, ())
        self._all: list[ExchangedFunction | ExchangedMethod] = [
            self.klip_dataset,
            self.fm_klip_dataset,
        ]
        try:
            from pyklip.instruments.JWST import JWSTData
        except ImportError as error:
            # It needs astroquery, which other instruments do not.
            logger.info("pyKLIP's JWST reader is not there to be extended: %s", error)
        else:
            self._all.append(ExchangedMethod(JWSTData, "readdata", capturing_readdata))

    def exchange(self) -> None:
        for one in self._all:
            one.exchange()

    def restore(self) -> None:
        for one in reversed(self._all):
            one.restore()


class _Registry:
    """Who holds the hooks, and the settings given to `register`."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.hooks: _Hooks | None = None
        self.registered = False
        self.blocks = 0
        self.defaults = DiffrenderSettings()

    def update(self) -> None:
        """Put the hooks in or out, as the holders want it."""
        wanted = self.registered or self.blocks > 0
        if wanted and self.hooks is None:
            hooks = _Hooks()
            hooks.exchange()
            self.hooks = hooks
        elif not wanted and self.hooks is not None:
            self.hooks.restore()
            self.hooks = None


_registry = _Registry()

_NO_BLOCK = (DiffrenderSettings(), False)
_block: ContextVar[tuple[DiffrenderSettings, bool]] = ContextVar("diffrender", default=_NO_BLOCK)
"""Settings of the `backend` blocks around here, and whether KLIP is redirected."""


def is_registered() -> bool:
    """Whether ``algo="diffrender"`` works right now."""
    return _registry.hooks is not None


def register(opd: OPDLike | None = None, model: Any = None, **options: Unpack[Options]) -> None:
    """Make ``klip_dataset(..., algo="diffrender")`` work until `unregister`.

    Calling it again changes the settings it is given and nothing else. From then on `JWSTData`
    keeps the recorded pixels, errors, flags and headers of the files it reads; register before
    making the dataset, so that the fit can use them.

    Parameters
    ----------
    opd : path, ndarray or Quantity, optional
        Default wavefront map, see `DiffrenderSettings`.
    model : optical model, optional
        Default model; by default the one for the dataset's filter.
    **options
        Other fields of `DiffrenderSettings`.

    Raises
    ------
    IncompatibleSetupError
        If pyKLIP is not as expected.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> dr.register(opd="R2022073003-NRCA3_FP1-1.fits")  # doctest: +SKIP
    >>> klip_dataset(dataset, mode="ADI", algo="diffrender")  # doctest: +SKIP
    """
    settings = DiffrenderSettings(opd=opd, model=model, **options)
    with _registry.lock:
        _registry.defaults = settings.over(_registry.defaults)
        _registry.registered = True
        try:
            _registry.update()
        except BaseException:
            _registry.registered = False
            raise


def unregister() -> None:
    """Put pyKLIP back exactly as it was and forget the settings given to `register`.

    Inside a `backend` block, pyKLIP is put back when the block ends.
    """
    with _registry.lock:
        _registry.registered = False
        _registry.defaults = DiffrenderSettings()
        _registry.update()


@contextlib.contextmanager
def backend(
    name: str = ALGORITHM,
    *,
    opd: OPDLike | None = None,
    model: Any = None,
    force: bool = True,
    **options: Unpack[Options],
) -> Iterator[None]:
    """Use this backend within a block, without changing a line of what is called there.

    Parameters
    ----------
    name : str
        "diffrender", the only one there is.
    opd, model, **options
        As for `register`; they win over those of the dataset and of `register`.
    force : bool
        Also take over calls with ``algo="klip"``, as in code that hard-codes it. Other algorithms
        are never touched.

    Raises
    ------
    IncompatibleSetupError
        For an unknown name, or if pyKLIP is not as expected.

    Examples
    --------
    >>> with dr.backend(opd="opd.fits"):  # doctest: +SKIP
    ...     klip_dataset(dataset, mode="ADI+RDI", psf_library=library)
    """
    if name != ALGORITHM:
        raise IncompatibleSetupError(f"name: got {name!r}, the only backend is {ALGORITHM!r}")
    outer, _ = _block.get()
    settings = DiffrenderSettings(opd=opd, model=model, **options).over(outer)
    with _registry.lock:
        _registry.blocks += 1
        try:
            _registry.update()
        except BaseException:
            _registry.blocks -= 1
            raise
    token = _block.set((settings, force))
    try:
        yield
    finally:
        _block.reset(token)
        with _registry.lock:
            _registry.blocks -= 1
            _registry.update()


def _wanted(algo: Any) -> bool:
    """Whether a call with this `algo` is for this backend."""
    _, force = _block.get()
    name = str(algo).lower()
    return name == ALGORITHM or (force and name == "klip")


def _hooks() -> _Hooks:
    """The hooks that led here; they can only be gone if another thread took them out just now."""
    hooks = _registry.hooks
    if hooks is None:
        raise IncompatibleSetupError("diffrender was unregistered while klip_dataset was called")
    return hooks


def dispatch(*args: Any, **kwargs: Any) -> None:
    """Take a call of `pyklip.parallelized.klip_dataset`: ours, or pyKLIP's own code."""
    klip_dataset = _hooks().klip_dataset
    try:
        call = klip_dataset.signature.bind(*args, **kwargs)
    except TypeError:
        # pyKLIP's own code says it in its own words.
        klip_dataset.body()(*args, **kwargs)
        raise
    call.apply_defaults()
    arguments = call.arguments
    if _wanted(arguments["algo"]):
        settings, _ = _block.get()
        settings = settings.over(settings_of(arguments["dataset"])).over(_registry.defaults)
        Reduction(arguments, settings).run(klip_dataset.body)
    else:
        klip_dataset.body()(*args, **kwargs)
    if arguments["highpass"] not in (False, None):
        mark_filtered(arguments["dataset"])


def dispatch_fm(*args: Any, **kwargs: Any) -> Any:
    """Take a call of `pyklip.fm.klip_dataset`, which has no `algo` of its own.

    Raises
    ------
    IncompatibleSetupError
        If it is for this backend: forward modelling of KLIP's over-subtraction does not apply.
    """
    if _wanted(kwargs.get("algo", "klip")):
        raise IncompatibleSetupError(
            "pyklip.fm.klip_dataset is not supported by diffrender yet: it models how KLIP "
            "subtracts a companion from itself. Call it outside the backend block and without "
            "algo='diffrender', or use pyklip.parallelized.klip_dataset"
        )
    return _hooks().fm_klip_dataset.body()(*args, **kwargs)


def _klip_dataset(*args, **kwargs):  # type: ignore[no-untyped-def]
    # Runs in place of pyKLIP's code and with its globals: nothing of this module is in sight.
    from pyklip_diffrender.pyklip_backend.registration import dispatch

    return dispatch(*args, **kwargs)


def _fm_klip_dataset(*args, **kwargs):  # type: ignore[no-untyped-def]
    from pyklip_diffrender.pyklip_backend.registration import dispatch_fm

    return dispatch_fm(*args, **kwargs)
