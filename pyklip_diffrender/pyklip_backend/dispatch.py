"""Calls of pyKLIP's `klip_dataset`, handled by this backend or by pyKLIP's own code.

Scripts often hold `klip_dataset` itself (``from pyklip.parallelized import klip_dataset``) long
before this package is imported, so replacing the name in its module would not reach them. Instead
the function object stays and its code is replaced by a call of `dispatch`, which runs pyKLIP's own
code for every other algorithm.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.pyklip_backend.forward_reduction import ForwardReduction
from pyklip_diffrender.pyklip_backend.klip_call import DatasetReduction, mark_filtered
from pyklip_diffrender.pyklip_backend.patch import PatchedFunction, PatchedMethod
from pyklip_diffrender.pyklip_backend.registry import (
    BOTH,
    REGISTRY,
    Patched,
    is_ours,
    name_of,
    settings_for,
    warn_of_klip,
)
from pyklip_diffrender.pyklip_backend.source import keeping_references, keeping_source

__all__ = ["Patches", "dispatch", "dispatch_fm"]

logger = logging.getLogger(__name__)


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
            logger.info("pyKLIP's JWST reader cannot be imported, so is not extended: %s", error)
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


def _patches() -> Patched:
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
        before = dict(vars(arguments["dataset"]))
        DatasetReduction(arguments, settings).run(klip_dataset.original)
        if name_of(arguments["algo"]) == BOTH:
            _run_klip(klip_dataset.original(), arguments, before)
    else:
        if str(arguments["algo"]).lower() == "klip":
            warn_of_klip(arguments["dataset"], "klip_dataset")
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
    if name_of(kwargs.get("algo")) == BOTH:
        raise IncompatibleSetupError(
            f"algo: pyklip.fm.klip_dataset takes 'diffrender' or 'klip', not {BOTH!r}, because an "
            "fm_class is for one of them. Call it twice"
        )
    if not is_ours(kwargs.get("algo", "klip")):
        warn_of_klip(args[0] if args else kwargs.get("dataset"), "pyklip.fm.klip_dataset")
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
    from pyklip_diffrender.pyklip_backend.dispatch import dispatch

    return dispatch(*args, **kwargs)


def _fm_klip_dataset(*args, **kwargs):  # type: ignore[no-untyped-def]
    from pyklip_diffrender.pyklip_backend.dispatch import dispatch_fm

    return dispatch_fm(*args, **kwargs)
