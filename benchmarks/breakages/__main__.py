"""Break the package on purpose, one line at a time, and count what the quick tests notice.

    python -m benchmarks.breakages --record breakages.json          # all; goes on where it stopped
    python -m benchmarks.breakages --only fourier-sign roll-sign    # some
    python -m benchmarks.breakages --check                          # is every text there once?

The package is broken in a copy of the checkout. The test files named with a breakage are run first,
then the rest of the quick tests, both up to the first failure, in one process with one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import traceback
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.breakages.catalogue import BREAKAGES, Breakage

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "pyklip_diffrender"
PARTS = (PACKAGE, "benchmarks", "docs", "examples", "tests", "*.toml", "*.md", "*.cff")
LIBRARIES = (
    "torch", "scipy.stats", "scipy.optimize", "astropy.table", "astropy.wcs", "matplotlib.pyplot",
    "photutils.aperture", "poppy", "pyklip.klip", "pyklip.fm",
)  # fmt: skip
"""Imported once, because that takes longer than most tests."""
TOO_LONG = 3600
"""Seconds after which tests that hang count as a failure."""

Result = dict[str, Any]
"""What became of a breakage: the test that noticed it or None, the stage, and the CPU time."""


def place_of(breakage: Breakage, root: Path) -> Path:
    """Return the module with the text of a breakage.

    Raises
    ------
    SystemExit
        If the text is not there exactly once.
    """
    modules = sorted((root / PACKAGE).rglob("*.py"))
    counts = {path: path.read_text(encoding="utf-8").count(breakage.old) for path in modules}
    places = [path for path, count in counts.items() for _ in range(count)]
    if len(places) != 1:
        where = ", ".join(str(path.relative_to(root)) for path in places) or "nowhere"
        sys.exit(f"{breakage.name}: expected the text once, got it {len(places)} times ({where})")
    return places[0]


def copy_of(root: Path, folder: Path) -> Path:
    """Copy what tests need, compiled so that a module that changes is compiled again."""
    copy = folder / "checkout"
    copy.mkdir()
    for path in [each for part in PARTS for each in sorted(root.glob(part))]:
        if path.is_dir():
            ignored = shutil.ignore_patterns("__pycache__", "_build", "generated")
            shutil.copytree(path, copy / path.name, ignore=ignored)
        else:
            shutil.copy(path, copy)
    # By the content: a copy is made, broken and mended within the second that times are good for.
    compiler = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash"]
    subprocess.run([*compiler, str(copy / PACKAGE), str(copy / "tests")], check=True)
    return copy


def failing_test(copy: Path, arguments: list[str]) -> str | None:
    """Return the first quick test that fails, None if all pass."""
    report = copy / "pytest.txt"
    process = os.fork()
    if process == 0:
        with report.open("wb") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
            signal.alarm(TOO_LONG)
            code = 3
            try:
                code = run_pytest(copy, arguments)
            except BaseException:
                traceback.print_exc()
            finally:
                # Nothing of the parent's is done twice, such as removing the copy.
                sys.stderr.flush()
                os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if code == 0:
        return None
    text = report.read_text(encoding="utf-8")
    failed = re.search(r"^(?:FAILED|ERROR) (\S+::\S+)", text, re.MULTILINE)
    if failed and code == 1:
        return failed[1].removeprefix("tests/")
    if code == -signal.SIGALRM:
        return "(no end)"
    if "not found:" in text:
        return None  # The test of an earlier run is no more.
    sys.exit(f"pytest cannot run: {text[-2000:]}")


def run_pytest(copy: Path, arguments: list[str]) -> int:
    """Run the tests of the copy in this process, which has the libraries but not the package."""
    os.chdir(copy)
    os.environ |= {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    sys.dont_write_bytecode = True
    sys.path[:] = [str(copy), *(each for each in sys.path if Path(each or ".").resolve() != ROOT)]
    for name in [each for each in sys.modules if each.split(".")[0] == "benchmarks"]:
        del sys.modules[name]
    import pytest

    return int(pytest.main(["-x", "-q", "-n0", "-p", "no:cacheprovider", *arguments]))


def judge(breakage: Breakage, copy: Path, before: str | None, likely_only: bool) -> Result:
    """Break the copy, test it, and mend it.

    Parameters
    ----------
    breakage : Breakage
    copy : Path
    before : str or None
        The test that noticed it in an earlier run, which is run first.
    likely_only : bool
        Leave out the test files that are not named with the breakage.
    """
    path = place_of(breakage, copy)
    whole = path.read_text(encoding="utf-8")
    began = resource.getrusage(resource.RUSAGE_CHILDREN)
    places = [Path("tests") / name for name in breakage.tests.split()]
    likely = [f"{place.parent}/test_{place.name}.py" for place in places]
    likely = [name for name in likely if (copy / name).is_file()]
    stages = {"likely files": likely} if likely else {}
    if before and (copy / "tests" / before.split("::")[0]).is_file():
        stages = {"test of an earlier run": [f"tests/{before}"], **stages}
    if not likely_only:
        stages["all quick tests"] = ["tests", *(f"--ignore={name}" for name in likely)]
    caught, stage = None, ""
    try:
        path.write_text(whole.replace(breakage.old, breakage.new), encoding="utf-8")
        while stages and not caught:
            stage = next(iter(stages))
            caught = failing_test(copy, stages.pop(stage))
    finally:
        path.write_text(whole, encoding="utf-8")
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime
    return {"caught": caught, "stage": stage, "cpu_seconds": round(seconds, 1)}


def table(results: dict[str, Result]) -> str:
    """Markdown, with the number caught."""
    lines = ["| breakage | property | noticed by | CPU, s |", "|---|---|---|---|"]
    known = [(each, results[each.name]) for each in BREAKAGES if each.name in results]
    for breakage, result in known:
        missed = f"**missed** ({result['stage']})"
        lines.append(
            f"| {breakage.name} | {breakage.lost} | {result['caught'] or missed} | "
            f"{result['cpu_seconds']} |"
        )
    caught = sum(result["caught"] is not None for _, result in known)
    return "\n".join([*lines, "", f"{caught} of {len(known)} noticed"])


def main() -> int:
    """Run the command line; returns the exit status, 0 if all that were tried are noticed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [each.name for each in BREAKAGES]
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help="some of them")
    parser.add_argument("--record", type=Path, help="JSON file to add results to, and go on from")
    parser.add_argument(
        "--again", action="store_true", help="also what is recorded, the same test first"
    )
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout; default this one")
    parser.add_argument("--likely-only", action="store_true", help="not the rest of the tests")
    parser.add_argument("--check", action="store_true", help="only look for the texts")
    options = parser.parse_args()
    chosen = [each for each in BREAKAGES if not options.only or each.name in options.only]
    for breakage in chosen:
        place_of(breakage, options.root)
    if options.check:
        return 0
    os.environ |= {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    for name in LIBRARIES:
        import_module(name)
    results: dict[str, Result] = {}
    if options.record and options.record.exists():
        results = json.loads(options.record.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory(prefix="breakages-") as folder:
        copy = copy_of(options.root.resolve(), Path(folder))
        for breakage in chosen:
            known = results.get(breakage.name, {})
            enough = options.likely_only or known.get("stage") == "all quick tests"
            if known and (known["caught"] or enough) and not options.again:
                continue
            before = known.get("caught")
            results[breakage.name] = judge(breakage, copy, before, options.likely_only)
            print(breakage.name, results[breakage.name], flush=True)
            if options.record:
                text = json.dumps(results, indent=1) + "\n"
                options.record.write_text(text, encoding="utf-8")
        # What fails without a breakage notices none.
        noticing = sorted(
            {f"tests/{each['caught']}" for each in results.values() if each["caught"]}
        )
        failed = failing_test(copy, noticing) if noticing else None
        if failed:
            sys.exit(f"{failed} fails in the whole package")
    print(table({each.name: results[each.name] for each in chosen}))
    return int(any(results[each.name]["caught"] is None for each in chosen))


if __name__ == "__main__":
    sys.exit(main())
