"""Parts of all commands: messages, outputs that may be written, the device, shared options."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pyklip_diffrender.errors import ExistingFileError, IncompatibleSetupError
from pyklip_diffrender.options import OPTIONS, ReduceOptions

if TYPE_CHECKING:
    from pyklip_diffrender.io.files import OutputFolder

# Memory of this process.

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's ``mallopt``, from its header ``malloc.h``."""

_MMAP_THRESHOLD_BYTES = 2**25
"""Size of the largest arrays whose memory is kept, bytes: the most that glibc allows."""


def keep_freed_memory() -> None:
    """Let glibc use the memory of freed arrays again, up to 32 MB each, for later ones.

    By default it goes back to the system, which has to clear it for the next array: that is 6 % of
    the time of one roll. Larger arrays do go back, so that a reduction does not take more memory.
    Whoever has set a variable of glibc's allocator has chosen.
    """
    if any(name.startswith("MALLOC_") for name in os.environ):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _MMAP_THRESHOLD_BYTES)
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)


def _takes_text(stream: Any) -> bool:
    """Whether a standard stream exists and is open: under ``pythonw`` there is none."""
    if stream is None or stream.closed:
        return False
    try:
        stream.flush()
    except (OSError, ValueError):
        return False
    return True


@contextmanager
def open_streams() -> Iterator[None]:
    """Put an empty file in place of standard streams that are missing or closed."""
    # Without them, as under ``pythonw``, in a job of a scheduler or after ``2>&-``, the first
    # message or progress bar would end the program.
    before = {name: getattr(sys, name) for name in ("stdout", "stderr")}
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        try:
            for name, stream in before.items():
                if not _takes_text(stream):
                    setattr(sys, name, nowhere)
            yield
        finally:
            for name, stream in before.items():
                if getattr(sys, name) is nowhere:
                    setattr(sys, name, stream)


@contextmanager
def importing() -> Iterator[None]:
    """Import libraries without a search for garbage, and leave them out of later searches.

    Their objects stay until the end. Searching them takes a fifth of the time of the imports.
    Where torch is loaded, as in a notebook, the collector is left as it is: it would also leave out
    what the caller has, garbage included.
    """
    if "torch" in sys.modules or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


# Parts of all commands: messages and the log, outputs that may be written, the device.

PROGRAM = "pyklip-diffrender"

_log = logging.getLogger(__name__)


class _OnTerminal(logging.StreamHandler):  # type: ignore[type-arg]
    """Messages on standard error that do not break a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        from tqdm import tqdm

        tqdm.write(self.format(record), file=sys.stderr)

    def format(self, record: logging.LogRecord) -> str:
        message = record.getMessage()
        if record.levelno < logging.WARNING:
            return message
        warning = "warning: " if record.levelno == logging.WARNING else ""
        return f"{PROGRAM}: {warning}{message}"


_LEAST_ROOM_BYTES = 1e8
"""Room for the products of two rolls of 80 x 80 pixels, which take 30 MB, and of more frames."""


@dataclass
class Run:
    """One run of a command."""

    # Whether to show progress bars.
    progress: bool = False
    # Device of PyTorch.
    device: str = ReduceOptions.device
    _on_terminal: logging.Handler = field(default_factory=_OnTerminal)

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
            logging.getLogger().removeHandler(self._on_terminal)
            self._on_terminal.close()

    def configure(self, *, verbose: bool, quiet: bool, device: str, threads: int | None) -> None:
        """Take what the options of all commands say."""
        # Away from a terminal a bar is noise: the stages and a line a minute take its place.
        is_terminal = sys.stderr.isatty()
        self.progress = is_terminal and not quiet
        stages = not (quiet or is_terminal)
        threshold = logging.DEBUG if verbose else logging.WARNING
        self._on_terminal.addFilter(
            lambda record: (
                record.levelno >= threshold or (stages and record.name.endswith(".progress"))
            )
        )
        logging.getLogger().addHandler(self._on_terminal)
        logging.getLogger("pyklip_diffrender").setLevel(logging.DEBUG if verbose else logging.INFO)
        self.device = device
        if device != "cpu":
            _require_device(device)
        if threads is not None:
            import torch

            torch.set_num_threads(threads)


def claim_folder(folder: Path, products: tuple[str, ...]) -> None:
    """Raise IncompatibleSetupError if products cannot be written."""
    for path in (folder, *(folder / name for name in products)):
        _require_no_broken_link(path)
    # The folder, or the nearest one above it that exists.
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    _require_room(folder, existing)


def claim_file(path: Path) -> None:
    """Raise IncompatibleSetupError if a file cannot be written."""
    _require_no_broken_link(path)
    if not path.absolute().parent.is_dir():
        raise IncompatibleSetupError(f"--output: there is no folder {path.parent} to write into")
    if path.is_dir():
        raise IncompatibleSetupError(f"--output: {path} is a folder, expected a file")
    _require_room(path, path.absolute().parent)


def _require_room(output: Path, folder: Path) -> None:
    """Raise IncompatibleSetupError if an output cannot be written to a folder, or has no room."""
    if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):
        raise IncompatibleSetupError(f"{output} cannot be written: no permission in {folder}")
    disk = shutil.disk_usage(folder)
    if not disk.total:
        raise IncompatibleSetupError(
            f"{output} cannot be written: {folder} is of the system, and takes no files. "
            "Choose another place"
        )
    if disk.free < _LEAST_ROOM_BYTES:
        raise IncompatibleSetupError(
            f"{output}: got {disk.free / 1e6:.0f} MB of room on the disk, expected at least "
            f"{_LEAST_ROOM_BYTES / 1e6:.0f} MB. Make room, or choose another place"
        )


def require_in_place(*outputs: OutputFolder) -> None:
    """Raise ExistingFileError, at the end of a run, if products are not where they should be."""
    from pyklip_diffrender.io.files import moved_aside

    elsewhere = [each for each in outputs if each.folder != each.asked]
    if elsewhere:
        asked, used = (
            ", ".join(str(getattr(each, name)) for each in elsewhere)
            for name in ("asked", "folder")
        )
        raise ExistingFileError(moved_aside(asked, used))


def _require_no_broken_link(path: Path) -> None:
    """Refuse a path with a link in it that leads nowhere, or in a circle."""
    for part in (*reversed(path.absolute().parents), path.absolute()):
        if part.is_symlink() and not os.path.exists(part):
            raise IncompatibleSetupError(
                f"--output: {part} is a link to {os.readlink(part)}, which does not exist or leads "
                "back to itself. Make what it points to, remove the link, or choose another place"
            )


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


# Options that commands share, and help by section.

Decorator = Callable[[Any], Any]

_GENERAL = "General"


class _Option(click.Option):
    """An option that the help lists in a section."""

    def __init__(self, *declarations: Any, section: str = "Options", **settings: Any) -> None:
        super().__init__(*declarations, **settings)
        self.section = section


def option(*declarations: str, section: str = "Options", **settings: Any) -> Decorator:
    """An option, by default in the first section of the help."""
    return click.option(*declarations, cls=_Option, section=section, **settings)


def declared(name: str, **changes: Any) -> Decorator:
    """The option of the command line for one of `ReduceOptions`."""
    each = OPTIONS[name]
    settings: dict[str, Any] = {"help": each.help, "metavar": each.metavar}
    settings["section"] = each.section
    if each.is_switch:
        settings["is_flag"] = True
    else:
        type_: Any = str if each.text else each.kind
        if each.path:
            # A path that is not converted: shells complete files, and a name stays as it is.
            type_ = click.Path()
        elif each.choices:
            type_ = click.Choice(each.choices)
        elif each.kind is int:
            type_ = click.IntRange(min=each.least)
        settings |= {"type": type_, "default": each.default}
        settings["show_default"] = each.default is not None
    return option(each.flag, **(settings | changes))


def _all(*decorators: Decorator) -> Decorator:
    def decorated(function: Any) -> Any:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorated


def file_type(**settings: Any) -> click.Path:
    """A path of a file or folder; whether it exists is for the package to say."""
    return click.Path(path_type=Path, **settings)


class _Wavefront(click.types.StringParamType):
    """Name of an OPD map, or a word in place of it; says what there is if it is missing."""

    def get_missing_message(self, param: click.Parameter, ctx: click.Context | None) -> str:
        return (
            "Name the FITS file of an OPD map or a folder of maps, say mast to fetch the map "
            "of the date, or flat to start without one (contrasts are then uncertain by 40 %)."
        )


class Command(click.Command):
    """A command with the general options, and with help by section."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections of the options."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            # Arguments are explained in the first paragraphs.
            if record is not None and not isinstance(param, click.Argument):
                sections.setdefault(getattr(param, "section", _GENERAL), []).append(record)
        # The same for all commands, so at the end.
        sections[_GENERAL] = sections.pop(_GENERAL)
        for name, records in sections.items():
            with formatter.section(name):
                formatter.write_dl(records)

    def invoke(self, ctx: click.Context) -> Any:
        """Apply the general options, then run the command with its own."""
        general = {name: ctx.params.pop(name) for name in COMMON}
        ctx.ensure_object(Run).configure(**general)
        return super().invoke(ctx)


COMMON = ("verbose", "quiet", "device", "threads")
"""Options of all commands."""

common = _all(
    option("-v", "--verbose", is_flag=True, section=_GENERAL, help="Log every step of a fit."),
    option("-q", "--quiet", is_flag=True, section=_GENERAL, help="Show no progress."),
    declared("device"),
    option("--threads", type=click.IntRange(min=1), metavar="N", section=_GENERAL,
           help="Number of threads; default: PyTorch's choice."),
)  # fmt: skip


def outputs(default: str | None = None, *, file: str | None = None) -> Decorator:
    """Where to write, a folder or the file that is described, and what to do if it is there."""
    needed: dict[str, Any] = {"required": True}
    if default is not None:
        needed = {"default": Path(default), "show_default": True}
    kind, help_ = "FOLDER", "Folder for the products; made if it does not exist."
    if file is not None:
        kind, help_ = "FILE", file
    output = option(
        "-o", "--output", type=file_type(), metavar=kind, section="Output", help=help_, **needed
    )
    overwrite = option(
        "--overwrite", is_flag=True, section="Output", help="Replace products of an earlier run."
    )
    return _all(output, overwrite, common)


archive = _all(
    option("--program", type=int, metavar="NUMBER", section="Frames",
           help="Fetch the frames of this JWST programme from MAST, in place of FRAMES."),
    option("--cache", type=file_type(), metavar="FOLDER", section="Frames",
           help="Folder for fetched frames; default: in the user's cache."),
)  # fmt: skip


def require_frames(frames: Sequence[Path], program: int | None) -> None:
    """Raise `click.UsageError` unless there are either files or a programme."""
    if not frames and program is None:
        raise click.UsageError("Missing argument 'FRAMES...', or the option --program.")
    if frames and program is not None:
        raise click.UsageError("Give either FRAMES or --program.")


wavefront = _all(
    option("--opd", required=True, type=_Wavefront(), metavar="FILE|FOLDER|flat|mast",
           section="OPD map",
           help="OPD map to start from: a FITS file; a folder of maps, of which one is "
           "chosen by its date; mast for the maps of MAST, through stpsf; or flat, with which a "
           "fit takes longer and contrasts are uncertain by 40 % unless --star-flux is given."),
    option("--opd-date", type=click.Choice(["nearest", "before", "after", "interpolate"]),
           section="OPD map",
           help="Which map of a folder or of MAST, with respect to the frames; default: nearest."),
)  # fmt: skip

search = _all(
    *(
        declared(name) for name, each in OPTIONS.items()
        if not each.not_on_command_line and each.section != _GENERAL
    ),
    # A path that is not converted: shells complete files, and a name stays as it is.
    option("--star-sed", type=click.Path(), metavar="FILE", section="Brightness of the star",
           help="Spectrum or photometry of the star, in place of --star-flux: a table in text, "
                "FITS or VOTable with units; without any they are micron and Jy. "
                'Or a dwarf\'s spectral type and K magnitude, such as "A2V, K=6.77".'),
    option("--dry-run", is_flag=True, section="Output",
           help="Make all checks, show frames, OPD map and steps, and stop."),
    option("--derivatives", is_flag=True, section="Output",
           help="Keep the fit's derivatives in fit.fits, which then takes ten times the space: "
           "they are needed to search the fit again."),
)  # fmt: skip

together = _all(
    option("--spectra", metavar="blackbody|flat|free|FILE", multiple=True,
           section="Filters and epochs",
           help="Spectra of planets for the combined search of several filters or epochs; may be "
                "repeated: black bodies of 150 to 1,500 K, the same flux density in all filters, "
                "any fluxes, or a table of spectra with a column of wavelengths. "
                "Default: blackbody, flat and free."),
    option("--proper-motion", nargs=2, metavar="EAST NORTH", section="Filters and epochs",
           help='Proper motion of the star, to tell companions from background sources: arcsec per '
                'year, or with a unit, such as "377 mas/yr". Default: from the headers.'),
    option("--parallax", metavar="ANGLE", section="Filters and epochs",
           help='Parallax of the star, for the motion of background sources and of orbits between '
                'epochs: arcsec, or with a unit, such as "45 mas". Default: neglected.'),
)  # fmt: skip
