"""What is done with memory that arrays have freed."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from pyklip_diffrender import cli
from pyklip_diffrender.memory import keep_freed_memory

GLIBC = platform.libc_ver()[0] == "glibc"

# Pages that the system had to provide for ten arrays of 50 MB, one after the other.
COUNT = """
import resource
{first}
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
bytearray(50_000_000)
before = faults()
for _ in range(10):
    bytearray(50_000_000)
print((faults() - before) * resource.getpagesize())
"""


def provided(first: str) -> int:
    """Bytes, in a process of its own."""
    command = [sys.executable, "-c", COUNT.format(first=first)]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(not GLIBC, reason="only glibc has the setting")
def test_freed_memory_is_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith(("MALLOC_", "GLIBC_TUNABLES"))]:
        monkeypatch.delenv(name)
    as_it_comes = provided("")
    kept = provided("import pyklip_diffrender as dr; assert dr.keep_freed_memory()")
    assert kept < 0.1 * as_it_comes


def test_other_systems_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_freed_memory()


@pytest.mark.parametrize(("arguments", "calls"), [(["psf", "x.fits"], 1), (["bench"], 0)])
def test_commands_keep_their_own_memory(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], calls: int
) -> None:
    """Not that of a program which calls them, and not while they time others."""
    called: list[None] = []
    monkeypatch.setattr(cli, "keep_freed_memory", lambda: called.append(None))
    for name in ("_psf", "_bench"):
        monkeypatch.setattr(cli, name, lambda options: None)
    assert cli.main(arguments) == 0
    assert not called
    monkeypatch.setattr(sys, "argv", ["pyklip-diffrender", *arguments])
    assert cli.main() == 0
    assert len(called) == calls
