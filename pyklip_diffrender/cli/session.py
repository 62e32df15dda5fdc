"""Parts of all commands: messages and the log, outputs that may be written, the device."""

from __future__ import annotations

import logging
import os
import re
import shutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError

__all__ = ["PROGRAM", "Run", "with_options"]

PROGRAM = "pyklip-diffrender"

_log = logging.getLogger(__name__)


_ARGUMENTS = "|".join([
    "completeness", "contrast", "disk", "filter", "hours", "injections", "mask", "memory",
    "monochromatic", "offset", "opd", "overwrite", "program", "references", "resume", "separation",
    "size",
    "star_flux", "star_flux_error", "systematics", "target", "threshold", "wide",
])  # fmt: skip
"""Arguments that have the names of options of the command line."""

_OTHERS = {"image_mask": "mask"}
"""Arguments with other names than their options."""

_BOTH = re.compile(r"\w+(=True)? \((--[\w-]+)( on the command line)?\)")
_FIRST = re.compile(rf"(?<![\w.-])({_ARGUMENTS})(?=(, ({_ARGUMENTS}))*: )")
_ASSIGNED = re.compile(rf"(?<![\w.-])({_ARGUMENTS})=(True|\.\.\.)")
_CLASS = re.compile(r"\ban? [A-Z][a-z]+[A-Z]?\w*, (?=.* or )")
_QUANTITY = re.compile(r" or an? [\w ]+ \([^()]* \* u\.\w+\)")


def with_options(message: str) -> str:
    """Name options of the command line where a message names arguments of Python.

    Examples
    --------
    >>> with_options("threshold: got -3 sigma, expected a positive number")
    '--threshold: got -3 sigma, expected a positive number'
    >>> with_options("repeat the reduction with disk=True (--disk on the command line)")
    'repeat the reduction with --disk'
    >>> with_options("a.fits exists; replace it with overwrite=True")
    'a.fits exists; replace it with --overwrite'
    """
    for name, other in _OTHERS.items():
        message = message.replace(f"{name}: ", f"{other}: ")
    message = _QUANTITY.sub("", _CLASS.sub("", _BOTH.sub(r"\2", message)))
    for pattern in (_FIRST, _ASSIGNED):
        message = pattern.sub(lambda found: f"--{found[1].replace('_', '-')}", message)
    return message


class _OnTerminal(logging.StreamHandler):  # type: ignore[type-arg]
    """Messages on standard error that do not break a progress bar."""

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run

    def emit(self, record: logging.LogRecord) -> None:
        from tqdm import tqdm

        tqdm.write(self.format(record), file=sys.stderr)

    def format(self, record: logging.LogRecord) -> str:
        message = record.getMessage()
        if not self.run.configured:
            message = with_options(message)
        if record.levelno < logging.WARNING:
            return message
        warning = "warning: " if record.levelno == logging.WARNING else ""
        return f"{PROGRAM}: {warning}{message}"


@dataclass
class Run:
    """One run of a command.

    Attributes
    ----------
    progress : bool
        Whether to show progress bars.
    device : str
        PyTorch device.
    configured : bool
        Whether names in messages are keys of a configuration file, as those of surveys, and no
        options of the command line.
    """

    progress: bool = False
    device: str = "cpu"
    configured: bool = False
    _output: Path | None = None
    _before: dict[Path, int] = field(default_factory=dict)
    _handlers: list[logging.Handler] = field(default_factory=list)

    @contextmanager
    def messages(self) -> Iterator[None]:
        """Show warnings as messages, each once, and take down the handlers afterwards."""
        shown: set[str] = set()

        def show(message: Warning | str, *_: Any, **__: Any) -> None:
            if str(message) not in shown:
                shown.add(str(message))
                _log.warning("%s", message)

        package = logging.getLogger("pyklip_diffrender")
        level = package.level
        try:
            with warnings.catch_warnings():
                warnings.showwarning = show
                yield
        finally:
            package.setLevel(level)
            for handler in self._handlers:
                logging.getLogger().removeHandler(handler)
                handler.close()

    def configure(
        self, *, verbose: bool, quiet: bool, log_file: Path | None, device: str, threads: int | None
    ) -> None:
        """Take what the options of all commands say."""
        on_terminal = _OnTerminal(self)
        # Away from a terminal a bar is noise: the stages and a line a minute take its place.
        is_terminal = sys.stderr.isatty()
        self.progress = is_terminal and not quiet
        stages = not (quiet or is_terminal)
        threshold = logging.DEBUG if verbose else logging.WARNING
        on_terminal.addFilter(
            lambda record: (
                record.levelno >= threshold or (stages and record.name.endswith(".progress"))
            )
        )
        self._add(on_terminal)
        logging.getLogger("pyklip_diffrender").setLevel(logging.DEBUG if verbose else logging.INFO)
        if log_file is not None:
            try:
                log_file.parent.mkdir(parents=True, exist_ok=True)
                to_file = logging.FileHandler(log_file, encoding="utf-8")
            except OSError as error:
                raise IncompatibleSetupError(f"--log-file: {error}") from error
            to_file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
            self._add(to_file)
        self.device = device
        if device != "cpu":
            _require_device(device)
        if threads is not None:
            import torch

            torch.set_num_threads(threads)

    def _add(self, handler: logging.Handler) -> None:
        logging.getLogger().addHandler(handler)
        self._handlers.append(handler)

    def claim_folder(self, folder: Path, products: tuple[str, ...], overwrite: bool) -> None:
        """Refuse, before any work, products that could not be written or would be replaced.

        Raises
        ------
        IncompatibleSetupError
        """
        if folder.exists() and not folder.is_dir():
            raise IncompatibleSetupError(f"--output: {folder} is a file, expected a folder")
        self._claim(folder, _existing(folder), [folder / name for name in products], overwrite)

    def claim_file(self, path: Path, overwrite: bool) -> None:
        """Refuse, before any work, a file that could not be written or would be replaced.

        Raises
        ------
        IncompatibleSetupError
        """
        if not path.absolute().parent.is_dir():
            raise IncompatibleSetupError(
                f"--output: there is no folder {path.parent} to write into"
            )
        if path.is_dir():
            raise IncompatibleSetupError(f"--output: {path} is a folder, expected a file")
        self._claim(path, path.absolute().parent, [path], overwrite)

    def _claim(self, output: Path, folder: Path, products: list[Path], overwrite: bool) -> None:
        taken = [path for path in products if path.exists()]
        if taken and not overwrite:
            verb = "exists" if len(taken) == 1 else "exist"
            raise IncompatibleSetupError(
                f"{', '.join(map(str, taken))} {verb}; choose another place, or replace with "
                "--overwrite"
            )
        if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):
            raise IncompatibleSetupError(f"{output} cannot be written: no permission in {folder}")
        self._output, self._before = output, _files(output)

    def require_room(self, folder: Path, size: float) -> None:
        """Refuse, before any work, products for which there is no room on the disk.

        Raises
        ------
        IncompatibleSetupError
        """
        free = shutil.disk_usage(_existing(folder)).free
        if free < size:
            raise IncompatibleSetupError(
                f"--output: {folder} has {free / 1e6:.0f} MB of room, expected at least "
                f"{size / 1e6:.0f} MB. Make room, or choose another place"
            )

    def left(self) -> str:
        """Files that an interrupted run has left, as a sentence."""
        output = self._output
        written = [] if output is None else _files(output).items() - self._before.items()
        if not written:
            return "nothing was written"
        names = sorted(path.name for path, _ in written)
        return f"these files in {output} are new and complete: {', '.join(names)}"


def _existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists."""
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def _files(output: Path) -> dict[Path, int]:
    """Files and the times at which they were written; temporary ones have a dot."""
    inside = output.iterdir() if output.is_dir() else [output]
    return {
        path: path.stat().st_mtime_ns
        for path in inside
        if path.is_file() and not path.name.startswith(".")
    }


def _require_device(name: str) -> None:
    """Raise an exception unless PyTorch knows a device and has it."""
    import torch

    try:
        torch.zeros(1, dtype=torch.float64, device=name)
    except (RuntimeError, AssertionError, TypeError, NotImplementedError) as error:
        raise IncompatibleSetupError(
            f"--device: PyTorch {torch.__version__} cannot use {name!r} here, expected 'cpu', or "
            f"'cuda' with a GPU and a build for it ({str(error).splitlines()[0]})"
        ) from error
