"""Run the tests with the oldest and with the newest libraries that the metadata allow.

    python -m benchmarks.check_versions                     # all three, the quick tier
    python -m benchmarks.check_versions --end oldest        # one of them
    python -m benchmarks.check_versions -- tests/test_optics.py -x

Each end gets a fresh virtual environment with this interpreter and is removed afterwards. The
oldest end pins every lower bound of ``pyproject.toml`` (the dependencies and the extras that users
have); the newest takes what pip prefers; "plain" does so without the extras, of which one caps
numpy. What follows ``--`` goes to pytest.

At the oldest end, deprecation warnings are not errors: old releases get them from newer libraries
underneath, and only their authors could act on them.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OPTIONAL = PROJECT["optional-dependencies"]
ENDS = ("oldest", "newest", "plain")
EXTRAS = ("archive", "survey", "webbpsf")
LENIENT = (
    "-Wdefault::DeprecationWarning",
    "-Wdefault::PendingDeprecationWarning",
    "-Wdefault::FutureWarning",
    "-Wdefault::astropy.utils.exceptions.AstropyDeprecationWarning",
)


def lower_bounds():
    """Lower bound of each requirement that a user of the package has; tools have none."""
    bounds = {}
    for requirement in [*PROJECT["dependencies"], *(each for n in EXTRAS for each in OPTIONAL[n])]:
        found = re.match(r"([\w.-]+)(?:\[\w+\])?\s*>=\s*([\w.]+)", requirement)
        if not found:
            raise ValueError(f"pyproject.toml: {requirement!r} has no lower bound (>=)")
        bounds[found[1]] = found[2]
    return bounds


def check(end, folder, arguments):
    """Make an environment, run pytest in it; returns pytest's exit status."""
    constraints = folder / "constraints.txt"
    bounds = lower_bounds() if end == "oldest" else {}
    pins = "".join(f"{name}=={bound}\n" for name, bound in bounds.items())
    constraints.write_text(pins, encoding="utf-8")
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    # What the caller has on the path must not stand in for what pip installs.
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    # The extra "test" without the extras that it takes along.
    tools = [each for each in OPTIONAL["test"] if not each.startswith(f"{PROJECT['name']}[")]
    wanted = [str(ROOT), *tools] if end == "plain" else [f"{ROOT}[test]"]
    install = [python, "-m", "pip", "install", "--quiet", "-c", constraints, *wanted]
    subprocess.run(install, check=True, env=env)
    print(f"{end}:", flush=True)
    subprocess.run([python, "-m", "pip", "freeze"], check=True, env=env)
    command = [python, "-m", "pytest", "-p", "no:cacheprovider"]
    command += LENIENT if end == "oldest" else ()
    return subprocess.run([*command, *arguments], cwd=ROOT, env=env, check=False).returncode


def main():
    """Run the command line; returns the exit status, 0 if all passed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--end", choices=ENDS, help="default: all, one after the other")
    parser.add_argument("pytest", nargs="*", help="arguments of pytest, after --")
    options = parser.parse_args()
    failed = []
    for end in [options.end] if options.end else ENDS:
        with tempfile.TemporaryDirectory(prefix=f"versions-{end}-") as folder:
            if check(end, Path(folder), options.pytest):
                failed.append(end)
    print("failed: " + ", ".join(failed) if failed else "passed")
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
