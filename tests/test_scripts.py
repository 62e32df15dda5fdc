"""Every benchmark and every example can be imported and says what its options are.

What they measure is checked where they are run, by hand; nothing here runs a fit.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted(
    path.relative_to(ROOT).as_posix()
    for folder in ("benchmarks", "examples")
    for path in (ROOT / folder).rglob("*.py")
    if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")
)
WITHOUT_OPTIONS = ("examples/paper/summary.py",)


def run(script, monkeypatch):
    if script.startswith("benchmarks/"):
        name = script.removesuffix(".py").removesuffix("/__main__").replace("/", ".")
        # Another test may have imported it.
        monkeypatch.delitem(sys.modules, name, raising=False)
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(str(ROOT / script), run_name="__main__")


@pytest.mark.parametrize("script", [each for each in SCRIPTS if each not in WITHOUT_OPTIONS])
def test_help(script, monkeypatch, capsys):
    if "slurm" in script:
        pytest.importorskip("dask_jobqueue")
    if script.startswith("examples/"):
        monkeypatch.syspath_prepend((ROOT / script).parent)
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit) as ended:
        run(script, monkeypatch)
    assert not ended.value.code
    assert capsys.readouterr().out.startswith("usage:")
