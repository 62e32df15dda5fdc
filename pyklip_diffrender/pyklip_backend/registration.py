"""Make ``algo="diffrender"`` work in pyKLIP, permanently or in a block, and undo it exactly.

Scripts often hold `klip_dataset` itself (``from pyklip.parallelized import klip_dataset``) long
before this package is imported, so replacing the name in its module would not reach them. Instead
the function object stays and its code is replaced by a call of `dispatch`, which runs pyKLIP's own
code for every other algorithm.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from typing import Any

from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.pyklip_backend.backend_settings import (
    DiffrenderSettings,
    OPDLike,
    settings_of,
)
from pyklip_diffrender.pyklip_backend.child import announce, spawned_beside_klip
from pyklip_diffrender.pyklip_backend.forward_reduction import ForwardReduction
from pyklip_diffrender.pyklip_backend.klip_call import RESULTS, DatasetReduction, mark_filtered
from pyklip_diffrender.pyklip_backend.output_files import ReductionRecord
from pyklip_diffrender.pyklip_backend.patch import PatchedFunction, PatchedMethod
from pyklip_diffrender.pyklip_backend.source import keeping_references, keeping_source

__all__ = [
    "ALGORITHM",
    "backend",
    "dispatch",
    "dispatch_fm",
    "is_registered",
    "register",
    "unregister",
]

logger = logging.getLogger(__name__)

ALGORITHM = "diffrender"
"""Value of the argument `algo` of `klip_dataset`."""

BOTH = f"{ALGORITHM}+klip"
"""Name of the algorithm that writes KLIP's products beside those of this backend."""


class _Patches:
    """The changes to pyKLIP while the backend is in use."""

    def __init__(self) -> None:
        from pyklip import fm, parallelized

        self.klip_dataset = PatchedFunction(
            parallelized.klip_dataset,
            _klip_dataset,
            ("klip_parallelized", "klip_parallelized_lite", "high_pass_filter_imgs"),
        )
        self.fm_klip_dataset = PatchedFunction(
            fm.klip_dataset, _fm_klip_dataset, ("klip_parallelized", "high_pass_filter_imgs")
        )
        self._all: list[PatchedFunction | PatchedMethod] = [self.klip_dataset, self.fm_klip_dataset]
        try:
            from pyklip.instruments.JWST import JWSTData
        except ImportError as error:
            # It needs astroquery, which other instruments do not.
            logger.info("pyKLIP's JWST reader cannot be imported, so is not extended: %s", error)
        else:
            self._all.append(PatchedMethod(JWSTData, "readdata", keeping_source))
            self._all.append(PatchedMethod(JWSTData, "readpsflib", keeping_references))

    def apply(self) -> None:
        for patch in self._all:
            patch.apply()

    def restore(self) -> None:
        for patch in reversed(self._all):
            patch.restore()


class _Registry:
    """The users of the backend, and the settings given to `register`."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.patches: _Patches | None = None
        self.registered = False
        self.blocks = 0
        self.forcing = 0
        self.watching = False
        self.defaults = DiffrenderSettings()
        self.replace: bool | None = None

    def use(self, registered: bool, blocks: int, forcing: int | None = None) -> None:
        """Set the users; patch pyKLIP for the first and restore it after the last.

        Parameters
        ----------
        registered : bool
        blocks : int
            Number of `backend` blocks in all threads.
        forcing : int, optional
            Number of those that take over KLIP.
        """
        in_use = registered or blocks > 0 or self.watching
        if in_use and self.patches is None:
            patches = _Patches()
            patches.apply()
            self.patches = patches
        elif not in_use and self.patches is not None:
            self.patches.restore()
            self.patches = None
        self.registered, self.blocks = registered, blocks
        self.forcing = self.forcing if forcing is None else forcing
        announce(self.forcing > 0 or bool(self.replace))

    def watch(self) -> None:
        """Patch pyKLIP so that plain KLIP is mentioned, in a spawned process."""
        with self.lock:
            self.watching = True
            self.use(self.registered, self.blocks)


_registry = _Registry()

_NO_BLOCK = (DiffrenderSettings(), None)
_block: ContextVar[tuple[DiffrenderSettings, bool | None]] = ContextVar(
    "diffrender", default=_NO_BLOCK
)
"""Settings of the enclosing `backend` blocks, and whether they take over KLIP; None without."""

_warned: weakref.WeakSet[ReductionRecord] = weakref.WeakSet()
"""Reductions whose dataset, or a copy of it, was given to KLIP with a warning."""


def is_registered() -> bool:
    """Whether ``algo="diffrender"`` works at present."""
    return _registry.registered or _registry.blocks > 0


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
    with _registry.lock:
        _registry.replace = _registry.replace if replace is None else replace
        _registry.use(True, _registry.blocks)
        _registry.defaults = settings.over(_registry.defaults)


def unregister() -> None:
    """Restore pyKLIP exactly and forget the settings given to `register`.

    Inside a `backend` block, pyKLIP is restored when the block ends.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> dr.register(seed=1)
    >>> dr.unregister()
    """
    with _registry.lock:
        _registry.defaults = DiffrenderSettings()
        _registry.replace = None
        _registry.use(False, _registry.blocks)


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
    outer, _ = _block.get()
    settings = DiffrenderSettings(opd=opd, model=model, **options).over(outer)
    with _registry.lock:
        _registry.use(
            _registry.registered, _registry.blocks + 1, _registry.forcing + int(bool(force))
        )
    token = _block.set((settings, force))
    try:
        yield
    finally:
        _block.reset(token)
        with _registry.lock:
            _registry.use(
                _registry.registered, _registry.blocks - 1, _registry.forcing - int(bool(force))
            )


def _takes_klip() -> bool | None:
    """Whether calls with ``algo="klip"`` are for this backend; None if nobody has said so."""
    _, force = _block.get()
    return _registry.replace if force is None else force


def _name(algo: Any) -> str:
    """The argument `algo` in lower case and without spaces."""
    return "".join(str(algo).lower().split())


def _is_ours(algo: Any) -> bool:
    """Whether a call with this `algo` is for this backend."""
    name = _name(algo)
    return name in (ALGORITHM, BOTH) or (name == "klip" and bool(_takes_klip()))


def _outside_block() -> bool:
    """Whether a `backend` block was entered, but in other threads only."""
    return _registry.blocks > 0 and _block.get() is _NO_BLOCK


def _warn_of_klip(dataset: Any, function: str) -> None:
    """Warn if KLIP runs where this backend may be expected."""
    if _takes_klip() is None and (_registry.watching or (_registry.forcing and _outside_block())):
        place = "spawned process" if _registry.watching else "thread"
        warnings.warn(
            f"{function} runs KLIP in this {place}, to which the `with backend():` block or "
            "register(replace=True) that another one has entered does not extend. Call "
            f"register(replace=True, ...) or enter a block in the {place} itself",
            DiffrenderWarning,
            stacklevel=4,
        )
        return
    records = getattr(dataset, RESULTS, ())
    if not records or records[0] in _warned or _takes_klip() is not None:
        return
    _warned.add(records[0])
    warnings.warn(
        f"{function} runs KLIP on a dataset that was reduced with algo='diffrender' before. "
        "register(replace=True) or `with backend():` redirects calls of klip_dataset that ask for "
        "algo='klip'; register(replace=False) runs KLIP without this warning",
        DiffrenderWarning,
        stacklevel=4,
    )


def _patches() -> _Patches:
    """The patches that led to the present call; another thread may just have removed them."""
    patches = _registry.patches
    if patches is None:
        raise IncompatibleSetupError("diffrender was unregistered while klip_dataset was called")
    return patches


def _settings_for(dataset: Any) -> DiffrenderSettings:
    """Return the settings of the enclosing blocks, of the dataset and of `register`, merged."""
    settings, _ = _block.get()
    if _outside_block():
        warnings.warn(
            "settings of a `with backend():` block that another thread has entered do not hold in "
            "this thread. Enter a block in the thread itself, or give the settings to register()",
            DiffrenderWarning,
            stacklevel=4,
        )
    return settings.over(settings_of(dataset)).over(_registry.defaults)


def dispatch(*args: Any, **kwargs: Any) -> None:
    """Handle a call of `pyklip.parallelized.klip_dataset`: with this backend or pyKLIP's code."""
    klip_dataset = _patches().klip_dataset
    try:
        call = klip_dataset.signature.bind(*args, **kwargs)
    except TypeError:
        # Prefer the message of pyKLIP's own code.
        klip_dataset.original()(*args, **kwargs)
        raise
    call.apply_defaults()
    arguments = call.arguments
    if _is_ours(arguments["algo"]):
        settings = _settings_for(arguments["dataset"])
        before = dict(vars(arguments["dataset"]))
        DatasetReduction(arguments, settings).run(klip_dataset.original)
        if _name(arguments["algo"]) == BOTH:
            _run_klip(klip_dataset.original(), arguments, before)
    else:
        if str(arguments["algo"]).lower() == "klip":
            _warn_of_klip(arguments["dataset"], "klip_dataset")
        klip_dataset.original()(*args, **kwargs)
    if arguments["highpass"] not in (False, None):
        mark_filtered(arguments["dataset"])


def _run_klip(
    klip_dataset: Callable[..., None], arguments: Mapping[str, Any], before: Mapping[str, Any]
) -> None:
    """Write KLIP's products beside those of this backend, whose results stay in the dataset.

    Parameters
    ----------
    klip_dataset : callable
        pyKLIP's function.
    arguments : mapping
        Of the call.
    before : mapping
        Attributes of the dataset before the call, from which KLIP starts.
    """
    attributes = vars(arguments["dataset"])
    after = dict(attributes)
    attributes.clear()
    attributes.update(before)
    try:
        prefix = f"{arguments['fileprefix']}-klip"
        klip_dataset(**{**arguments, "algo": "klip", "fileprefix": prefix})
    finally:
        attributes.clear()
        attributes.update(after)


def dispatch_fm(*args: Any, **kwargs: Any) -> Any:
    """Handle a call of `pyklip.fm.klip_dataset`, to which this package adds an argument `algo`."""
    klip_dataset = _patches().fm_klip_dataset
    if _name(kwargs.get("algo")) == BOTH:
        raise IncompatibleSetupError(
            f"algo: pyklip.fm.klip_dataset takes 'diffrender' or 'klip', not {BOTH!r}, because an "
            "fm_class is for one of them. Call it twice"
        )
    if not _is_ours(kwargs.get("algo", "klip")):
        _warn_of_klip(args[0] if args else kwargs.get("dataset"), "pyklip.fm.klip_dataset")
        return klip_dataset.original()(*args, **kwargs)
    kwargs.pop("algo", None)
    call = klip_dataset.signature.bind(*args, **kwargs)
    call.apply_defaults()
    dataset = call.arguments["dataset"]
    ForwardReduction(call.arguments, _settings_for(dataset)).run(klip_dataset.original)
    if call.arguments["highpass"] not in (False, None):
        mark_filtered(dataset)
    return None


def _klip_dataset(*args, **kwargs):  # type: ignore[no-untyped-def]
    # Runs in place of pyKLIP's code, with its globals: names of this module are not available.
    from pyklip_diffrender.pyklip_backend.registration import dispatch

    return dispatch(*args, **kwargs)


def _fm_klip_dataset(*args, **kwargs):  # type: ignore[no-untyped-def]
    from pyklip_diffrender.pyklip_backend.registration import dispatch_fm

    return dispatch_fm(*args, **kwargs)


if spawned_beside_klip():
    _registry.watch()
