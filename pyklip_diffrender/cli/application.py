"""The program: its commands, its messages and its exit status."""

from __future__ import annotations

import logging
import os
from collections import abc
from typing import Any

import click

from pyklip_diffrender._version import __version__
from pyklip_diffrender.cli import commands
from pyklip_diffrender.cli.doctor import doctor
from pyklip_diffrender.cli.learning import learn
from pyklip_diffrender.cli.session import PROGRAM, Run, open_streams
from pyklip_diffrender.cli.shared_options import common
from pyklip_diffrender.errors import DiffrenderError

__all__ = ["application", "main"]

_log = logging.getLogger(__name__)


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    subcommand_metavar="COMMAND ...",
)
@click.version_option(__version__, prog_name=PROGRAM, message="%(prog)s %(version)s")
@common
def application(**_: Any) -> None:
    """Find planets in JWST coronagraphic images by refining the wavefront.

    `pyklip-diffrender COMMAND --help` explains a command. The general options may stand before
    the command or after it.
    """


for _command in (
    commands.demo,
    commands.reduce_frames,
    commands.detect_in_file,
    learn,
    commands.survey,
    commands.psf,
    doctor,
):
    application.add_command(_command)


def main(arguments: abc.Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns
    -------
    int
        Exit status: 0, 1 for an error that a message explains, 2 for wrong options, 130 if
        interrupted.
    """
    # Threads of PyTorch that wait in a loop take the processor from other processes. Libraries read
    # this when they are loaded, which is later.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    run = Run()
    with open_streams(), run.messages():
        try:
            status = application.main(arguments, prog_name=PROGRAM, standalone_mode=False, obj=run)
        except click.ClickException as error:
            error.show()
            return error.exit_code
        except (click.Abort, KeyboardInterrupt):
            _log.error("interrupted; %s", run.left())
            return 130
        except (DiffrenderError, OSError) as error:
            _log.error("%s", error)
            return 1
        except (MemoryError, RuntimeError) as error:
            # PyTorch has errors of its own for memory on the processor and on the GPU.
            if isinstance(error, RuntimeError) and "memory" not in str(error):
                raise
            _log.error("not enough memory; a smaller --size or fewer frames need less (%s)", error)
            return 1
    return status if isinstance(status, int) else 0
