"""Measure how fast this package and others are, and how exact their answers.

Run from the root of the project, with the package installed:

    python -m benchmarks.speed --quick

It prints the table and writes it into a folder.
"""

from __future__ import annotations

import argparse
import logging
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.speed import Setting, run_bench, write_table
from pyklip_diffrender.errors import DiffrenderError

COMMAND = "python -m benchmarks.speed"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    command_line = argparse.ArgumentParser(prog=COMMAND, description=__doc__.splitlines()[0])
    command_line.add_argument("-v", "--verbose", action="store_true", help="show progress messages")
    command_line.add_argument(
        "-o", "--output", type=Path, default=Path("speed"), help="folder to write into"
    )
    command_line.add_argument(
        "--rows", nargs="+", metavar="ROW", help="measure only rows whose names begin like this"
    )
    command_line.add_argument(
        "--quick", action="store_true", help="small arrays and short repetitions"
    )
    command_line.add_argument(
        "--device", default="cpu", help="torch device of this package, such as cuda"
    )
    command_line.add_argument(
        "--stpsf-path", default="", help="data directory of stpsf (or STPSF_PATH)"
    )
    command_line.add_argument("--no-memory", action="store_true", help="skip memory measurement")
    return command_line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    command_line = parser()
    options = command_line.parse_args(arguments)
    logging.basicConfig(
        level=logging.INFO if options.verbose else logging.WARNING, format="%(message)s"
    )
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        command_line.error(f"--device {options.device}: this PyTorch finds no GPU")
    try:
        _run(options)
    except DiffrenderError as error:
        print(f"{COMMAND}: {error}", file=sys.stderr)
        return 1
    return 0


def _run(options: argparse.Namespace) -> None:
    flags = ["--quick"] * options.quick + (["--rows", *options.rows] if options.rows else [])
    table = run_bench(
        Setting(options.quick, options.device, options.stpsf_path),
        options.rows,
        budget=0.1 if options.quick else 2.0,
        memory=not options.no_memory,
        command=" ".join([COMMAND, shlex.join(flags)]).strip(),
    )
    table["row", "column", "precision", "seconds", "ratio", "error", "sigma"].pprint_all()
    print(f"wrote {write_table(table, options.output)}")


if __name__ == "__main__":
    sys.exit(main())
