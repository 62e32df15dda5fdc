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
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.breakages.catalogue import BREAKAGES, Breakage

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "pyklip_diffrender"
PARTS = (PACKAGE, "benchmarks", "docs", "examples", "tests", "*.toml", "*.md", "*.cff")
TOO_LONG = 3600
"""Seconds after which tests that hang count as a failure."""


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
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider"]
    environment = {
        **os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip
    try:
        done = subprocess.run(
            [*command, *arguments], cwd=copy, env=environment, capture_output=True, text=True,
            check=False, timeout=TOO_LONG,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "(no end)"
    if done.returncode == 0:
        return None
    if done.returncode != 1 and "error" not in done.stdout:
        sys.exit(f"pytest cannot run: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return failed[1].removeprefix("tests/") if failed else "(collection)"


def judge(breakage: Breakage, copy: Path, likely_only: bool) -> dict[str, object]:
    """Break the copy, test it, and mend it."""
    path = place_of(breakage, copy)
    whole = path.read_text(encoding="utf-8")
    began = resource.getrusage(resource.RUSAGE_CHILDREN)
    likely = [f"tests/test_{name}.py" for name in breakage.tests.split()]
    likely = [name for name in likely if (copy / name).is_file()]
    stage = "likely files"
    try:
        path.write_text(whole.replace(breakage.old, breakage.new), encoding="utf-8")
        caught = failing_test(copy, likely) if likely else None
        if caught is None and not likely_only:
            stage = "all quick tests"
            caught = failing_test(copy, ["tests", *(f"--ignore={name}" for name in likely)])
    finally:
        path.write_text(whole, encoding="utf-8")
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime
    return {"caught": caught, "stage": stage, "cpu_seconds": round(seconds, 1)}


def table(results: dict[str, dict[str, object]]) -> str:
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
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout; default this one")
    parser.add_argument("--likely-only", action="store_true", help="not the rest of the tests")
    parser.add_argument("--check", action="store_true", help="only look for the texts")
    options = parser.parse_args()
    chosen = [each for each in BREAKAGES if not options.only or each.name in options.only]
    for breakage in chosen:
        place_of(breakage, options.root)
    if options.check:
        return 0
    results: dict[str, dict[str, object]] = {}
    if options.record and options.record.exists():
        results = json.loads(options.record.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory(prefix="breakages-") as folder:
        copy = copy_of(options.root.resolve(), Path(folder))
        for breakage in chosen:
            known = results.get(breakage.name)
            enough = options.likely_only or (known and known["stage"] == "all quick tests")
            if known and (known["caught"] or enough):
                continue
            results[breakage.name] = judge(breakage, copy, options.likely_only)
            print(breakage.name, results[breakage.name], flush=True)
            if options.record:
                text = json.dumps(results, indent=1) + "\n"
                options.record.write_text(text, encoding="utf-8")
    print(table({each.name: results[each.name] for each in chosen}))
    return int(any(results[each.name]["caught"] is None for each in chosen))


if __name__ == "__main__":
    sys.exit(main())
