"""Replace what a function or method of pyKLIP does, in place, and restore it exactly."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable
from types import FunctionType
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError

logger = logging.getLogger(__name__)


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
            logger.warning("%s was changed by another package meanwhile", self.function.__name__)
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
            logger.warning("%s was changed by another package meanwhile", self._name)
            return
        setattr(self._owner, self._name, self._original)
