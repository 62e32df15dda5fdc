"""pyKLIP's own tests, with this backend registered and without: outcomes and products must agree.

Run from the root of the project, with the source of the installed version of pyKLIP, whose frames
(`tests/data`) are in its repository but not in its package::

    python -m tests.benchmarks.pyklip_suite /path/to/pyklip

The tests run twice, each time on a copy of the source's tests. Tests without their data fail both
times. Every line is a test with both outcomes; the end says how many ran, how many passed, and how
many FITS products are equal bit by bit. The exit status is 1 if any outcome or product differs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from astropy.io import fits

_PLUGIN = """
from pyklip_diffrender.pyklip_backend import is_registered, register
register()
assert is_registered()
"""


def run(source: Path, folder: Path, registered: bool) -> dict[str, str]:
    """Outcome of every test, by its name."""
    shutil.copytree(source / "tests", folder / "tests")
    (folder / "registering.py").write_text(_PLUGIN)
    root = Path(__file__).parents[2]
    path = os.pathsep.join([str(folder), str(root), os.environ.get("PYTHONPATH", "")])
    options = (
        "-q --tb=no -p no:cacheprovider --rootdir . --continue-on-collection-errors "
        "--junit-xml=outcomes.xml"
    )
    command = [sys.executable, "-m", "pytest", *options.split(), "tests"]
    if registered:
        command += ["-p", "registering"]
    subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    outcomes = {}
    for case in ElementTree.parse(folder / "outcomes.xml").iter("testcase"):
        problems = [child for child in case if child.tag in ("failure", "error", "skipped")]
        text = f"{problems[0].tag}: {problems[0].get('message', '')}" if problems else "passed"
        name = f"{case.get('classname')}.{case.get('name')}"
        outcomes[name] = text.replace(str(folder), "").splitlines()[0][:100]
    return outcomes


def differences(one: Path, two: Path, source: Path) -> tuple[list[str], int]:
    """FITS products that differ, and the number of those that both folders have."""
    sides = [{path.relative_to(folder) for path in folder.rglob("*.fits")} for folder in (one, two)]
    products = {name for name in sides[0] & sides[1] if not (source / name).exists()}
    differing = [f"only in one folder: {name}" for name in sorted(sides[0] ^ sides[1])]
    for name in sorted(products):
        with fits.open(one / name) as first, fits.open(two / name) as second:
            same = len(first) == len(second) and all(
                np.array_equal(a.data, b.data, equal_nan=True)
                if a.data is not None and a.is_image and b.is_image
                else type(a) is type(b)
                for a, b in zip(first, second, strict=False)
            )
        if not same:
            differing.append(f"differs: {name}")
    return differing, len(products)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, help="folder of pyKLIP's source, with tests/")
    source = parser.parse_args().source.resolve()
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch) / name for name in ("without", "registered")]
        for folder in folders:
            folder.mkdir()
        outcomes = [run(source, folders[k], registered=bool(k)) for k in range(2)]
        names = sorted({*outcomes[0], *outcomes[1]})
        changed = 0
        for name in names:
            without, registered = (each.get(name, "not run") for each in outcomes)
            changed += without != registered
            print(f"{name}\n    {without}" + (f"\n    {registered}" * (without != registered)))
        differing, count = differences(*folders, source)
    for line in differing:
        print(line)
    passed = sum(outcome == "passed" for outcome in outcomes[1].values())
    print(f"{len(names)} tests, {passed} passed, {changed} outcomes differ; "
          f"{count} products, {len(differing)} differ")  # fmt: skip
    return int(changed > 0 or bool(differing))


if __name__ == "__main__":
    sys.exit(main())
