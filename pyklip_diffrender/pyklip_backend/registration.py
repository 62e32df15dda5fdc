"""Make ``algo="diffrender"`` work in pyKLIP, permanently or in a block, and undo it exactly."""

from __future__ import annotations

import contextlib
import inspect
import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path
from types import FunctionType
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.pyklip_backend.backend_settings import (
    DiffrenderSettings,
    OPDLike,
    settings_of,
)
from pyklip_diffrender.pyklip_backend.klip_call import (
    DatasetReduction,
    ForwardReduction,
    mark_filtered,
)
from pyklip_diffrender.pyklip_backend.source_frames import keeping_references, keeping_source

_log = logging.getLogger(__name__)


class PatchedFunction:
    """A function that keeps its identity but runs other code between `apply` and `restore`.

    The code is taken from `trampoline`, which runs with the globals of the patched function, so has
    to import what it uses. Raises IncompatibleSetupError if `function` does not look up `uses` in
    its module.
    """

    def __init__(
        self, function: Callable[..., Any], trampoline: Callable[..., Any], uses: tuple[str, ...]
    ) -> None:
        function = inspect.unwrap(function)
        name = f"{function.__module__}.{function.__qualname__}"
        if not isinstance(function, FunctionType) or function.__code__.co_freevars:
            raise IncompatibleSetupError(
                f"{name} was replaced by another package and cannot be extended. Register before "
                "that package changes it"
            )
        missing = [used for used in uses if used not in function.__code__.co_names]
        if missing:
            raise IncompatibleSetupError(
                f"{name} does not use {', '.join(missing)}: this version of pyKLIP is not "
                "supported. pyKLIP 2.10 is"
            )
        assert isinstance(trampoline, FunctionType)
        self.function = function
        self.signature = inspect.signature(function)
        # Only the code is replaced, because others that imported the function hold this same
        # object.
        self._saved = function.__code__, function.__defaults__, function.__kwdefaults__
        self._trampoline = trampoline.__code__

    def _set(self, code: Any, defaults: Any, kwdefaults: Any) -> None:
        self.function.__code__ = code
        self.function.__defaults__ = defaults
        self.function.__kwdefaults__ = kwdefaults

    def apply(self) -> None:
        """Put the trampoline in."""
        self._set(self._trampoline, None, None)
        # So that help() and inspect still show the arguments of the original.
        self.function.__signature__ = self.signature  # type: ignore[attr-defined]

    def restore(self) -> None:
        """Put back the same code and default objects as before."""
        if self.function.__code__ is not self._trampoline:
            _log.warning("%s was changed by another package meanwhile", self.function.__name__)
            return
        self._set(*self._saved)
        del self.function.__signature__  # type: ignore[attr-defined]

    def original(self, **replaced: Callable[..., Any]) -> Callable[..., Any]:
        """The unpatched function, with other functions behind some of its module's names."""
        module, (code, defaults, kwdefaults) = self.function.__globals__, self._saved
        namespace = {**module, **replaced} if replaced else module
        copy = FunctionType(code, namespace, self.function.__name__, defaults)
        copy.__kwdefaults__ = kwdefaults
        return copy


class PatchedMethod:
    """A method of a class that is wrapped between `apply` and `restore`."""

    def __init__(
        self, owner: type, name: str, wrap: Callable[[Callable[..., None]], Callable[..., None]]
    ) -> None:
        self._owner, self._name = owner, name
        self._original = vars(owner)[name]
        self._wrapped = wrap(self._original)

    def apply(self) -> None:
        """Put the wrapped method in."""
        setattr(self._owner, self._name, self._wrapped)

    def restore(self) -> None:
        """Put back the same method object as before."""
        if vars(self._owner)[self._name] is not self._wrapped:
            _log.warning("%s was changed by another package meanwhile", self._name)
            return
        setattr(self._owner, self._name, self._original)


# Who uses the backend in this process, with which settings, and which calls are for it.

ALGORITHM = "diffrender"
"""Value of the argument `algo` of `klip_dataset`."""


class Registry:
    """The users of the backend, and the settings given to `register`."""

    def __init__(self) -> None:
        # For changes of the others.
        self.lock = threading.RLock()
        # None while nobody uses the backend.
        self.patches: Patches | None = None
        self.registered = False
        # Number of `backend` blocks in all threads.
        self.blocks = 0
        self.defaults = DiffrenderSettings()
        # Whether `register` was told to take over KLIP.
        self.replace = False


REGISTRY = Registry()

BLOCK: ContextVar[tuple[DiffrenderSettings, bool | None]] = ContextVar(
    "diffrender", default=(DiffrenderSettings(), None)
)
"""Settings of the enclosing `backend` blocks, and whether they take over KLIP; None outside."""


def is_ours(algo: Any) -> bool:
    """Whether a call with this `algo` is for this backend."""
    _, force = BLOCK.get()
    takes_klip = REGISTRY.replace if force is None else force
    return str(algo).lower() in (ALGORITHM, *(["klip"] if takes_klip else []))


def settings_for(dataset: Any) -> DiffrenderSettings:
    """Return the settings of the enclosing blocks, of the dataset and of `register`, merged."""
    settings, _ = BLOCK.get()
    return settings.over(settings_of(dataset)).over(REGISTRY.defaults)


# Calls of pyKLIP's `klip_dataset`, handled by this backend or by pyKLIP's own code.
#
# Scripts often hold `klip_dataset` itself (``from pyklip.parallelized import klip_dataset``) long
# before this package is imported, so replacing the name in its module would not reach them. Instead
# the function object stays and its code is replaced by a call of `dispatch`, which runs pyKLIP's
# own code for every other algorithm.


class Patches:
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
            _log.info("pyKLIP's JWST reader cannot be imported, so is not extended: %s", error)
        else:
            self._all.append(PatchedMethod(JWSTData, "readdata", keeping_source))
            self._all.append(PatchedMethod(JWSTData, "readpsflib", keeping_references))

    def apply(self) -> None:
        """Change pyKLIP."""
        for patch in self._all:
            patch.apply()

    def restore(self) -> None:
        """Undo the changes exactly."""
        for patch in reversed(self._all):
            patch.restore()


def _patches() -> Patches:
    """The patches that led to the present call; another thread may just have removed them."""
    patches = REGISTRY.patches
    if patches is None:
        raise IncompatibleSetupError("diffrender was unregistered while klip_dataset was called")
    return patches


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
    if is_ours(arguments["algo"]):
        settings = settings_for(arguments["dataset"])
        DatasetReduction(arguments, settings).run(klip_dataset.original)
    else:
        klip_dataset.original()(*args, **kwargs)
    if arguments["highpass"] not in (False, None):
        mark_filtered(arguments["dataset"])


def dispatch_fm(*args: Any, **kwargs: Any) -> Any:
    """Handle a call of `pyklip.fm.klip_dataset`, to which this package adds an argument `algo`."""
    klip_dataset = _patches().fm_klip_dataset
    if not is_ours(kwargs.get("algo", "klip")):
        return klip_dataset.original()(*args, **kwargs)
    kwargs.pop("algo", None)
    call = klip_dataset.signature.bind(*args, **kwargs)
    call.apply_defaults()
    dataset = call.arguments["dataset"]
    ForwardReduction(call.arguments, settings_for(dataset)).run(klip_dataset.original)
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


def _use(registered: bool, blocks: int) -> None:
    """Set the users; patch pyKLIP for the first and restore it after the last.

    `blocks` is the number of `backend` blocks in all threads.
    """
    in_use = registered or blocks > 0
    if in_use and REGISTRY.patches is None:
        patches = Patches()
        patches.apply()
        REGISTRY.patches = patches
    elif not in_use and REGISTRY.patches is not None:
        REGISTRY.patches.restore()
        REGISTRY.patches = None
    REGISTRY.registered, REGISTRY.blocks = registered, blocks


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
        Default OPD map, see `DiffrenderSettings`.
    model : optical model, optional
        Default model; if not given, one is made for the dataset's filter.
    replace : bool, optional
        True takes over calls with ``algo="klip"`` as well, for code that hard-codes it. With False,
        as at first, they run KLIP.
    **options
        Other fields of `DiffrenderSettings`.

    Raises
    ------
    IncompatibleSetupError
        If pyKLIP is not as expected.

    Examples
    --------
    With an OPD map and a `dataset` that pyKLIP has read, which the package does not contain:

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
    >>> dr.register(size=64)
    >>> dr.pyklip_backend.unregister()
    """
    with REGISTRY.lock:
        REGISTRY.defaults = DiffrenderSettings()
        REGISTRY.replace = False
        _use(False, REGISTRY.blocks)


@contextlib.contextmanager
def backend(
    *, opd: OPDLike | None = None, model: Any = None, force: bool = True, **options: Any
) -> Iterator[None]:
    """Use this backend within a block, without changing the code that is called there.

    The block holds for the thread that enters it, and for processes that are forked in it. In other
    threads and in spawned processes, ``algo="klip"`` remains KLIP; call `register` with
    ``replace=True`` there.

    Parameters
    ----------
    opd, model, **options
        As for `register`; they take precedence over the dataset's and `register`'s.
    force : bool
        Also take over calls with ``algo="klip"``, for code that hard-codes it. Other algorithms
        are not affected.

    Raises
    ------
    IncompatibleSetupError
        If pyKLIP is not as expected.

    Examples
    --------
    With an OPD map, a `dataset` and a `library` that pyKLIP has read:

    >>> with dr.pyklip_backend.backend(opd="opd.fits"):  # doctest: +SKIP
    ...     klip_dataset(dataset, mode="ADI+RDI", psf_library=library)
    """
    outer, _ = BLOCK.get()
    settings = DiffrenderSettings(opd=opd, model=model, **options).over(outer)
    with REGISTRY.lock:
        _use(REGISTRY.registered, REGISTRY.blocks + 1)
    token = BLOCK.set((settings, force))
    try:
        yield
    finally:
        BLOCK.reset(token)
        with REGISTRY.lock:
            _use(REGISTRY.registered, REGISTRY.blocks - 1)


# A reduction of JWST files by `klip_dataset` in one call.


def reduce_jwst_files(
    science: Iterable[str | os.PathLike[str]],
    references: Iterable[str | os.PathLike[str]] = (),
    *,
    folder: str | os.PathLike[str],
    prefix: str,
    verbose: bool = False,
    **settings: Any,
) -> Any:
    """Subtract the star from all rolls together, write pyKLIP's products, return the `JWSTData`.

    The files have the star at STARCENX, STARCENY. The names of the products, in `folder`, begin
    with `prefix`; `settings` are fields of `DiffrenderSettings`. Raises as `klip_dataset`.
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
