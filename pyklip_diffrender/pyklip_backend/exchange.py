"""Exchange what a function or method does, in place, so that it can be put back exactly."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable
from types import FunctionType
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError

__all__ = ["ExchangedFunction", "ExchangedMethod"]

logger = logging.getLogger(__name__)


class ExchangedFunction:
    """A function that keeps its identity but runs other code until `restore`.

    Whoever imported the function earlier holds this very object, and so gets the other code too.

    Parameters
    ----------
    function : function
        The one to exchange.
    trampoline : function
        Its code replaces the function's. It is run with the *globals of the exchanged function*,
        so it must import what it uses.
    uses : sequence of str
        Names that the function must look up in its module, for `body` to replace.

    Raises
    ------
    IncompatibleSetupError
        If the function is not as expected, such as after a change in pyKLIP.
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
        self._code = function.__code__
        self._defaults = function.__defaults__
        self._kwdefaults = function.__kwdefaults__
        self._trampoline = trampoline.__code__

    def exchange(self) -> None:
        """Put the other code in."""
        self.function.__code__ = self._trampoline
        self.function.__defaults__ = None
        self.function.__kwdefaults__ = None
        # help() and inspect go on showing the arguments that count.
        self.function.__signature__ = self.signature  # type: ignore[attr-defined]

    def restore(self) -> None:
        """Put back the code and defaults there were, the same objects."""
        if self.function.__code__ is not self._trampoline:
            logger.warning("%s was changed by another package meanwhile", self.function.__name__)
            return
        self.function.__code__ = self._code
        self.function.__defaults__ = self._defaults
        self.function.__kwdefaults__ = self._kwdefaults
        del self.function.__signature__  # type: ignore[attr-defined]

    def body(self, **replaced: Callable[..., Any]) -> Callable[..., Any]:
        """The function as it was, with other functions behind some of its module's names."""
        module = self.function.__globals__
        copy = FunctionType(
            self._code,
            {**module, **replaced} if replaced else module,
            self.function.__name__,
            self._defaults,
        )
        copy.__kwdefaults__ = self._kwdefaults
        return copy


class ExchangedMethod:
    """A method of a class that is wrapped until `restore`."""

    def __init__(
        self, owner: type, name: str, wrap: Callable[[Callable[..., None]], Callable[..., None]]
    ) -> None:
        self._owner, self._name = owner, name
        self._original = vars(owner)[name]
        self._wrapped = wrap(self._original)

    def exchange(self) -> None:
        """Put the wrapped method in."""
        setattr(self._owner, self._name, self._wrapped)

    def restore(self) -> None:
        """Put back the method there was, the same object."""
        if vars(self._owner)[self._name] is not self._wrapped:
            logger.warning("%s was changed by another package meanwhile", self._name)
            return
        setattr(self._owner, self._name, self._original)
