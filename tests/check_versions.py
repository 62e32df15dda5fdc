"""Run the tests with the oldest and with the newest libraries that the metadata allow.

    python tests/check_versions.py                     # all three, the quick tier
    python tests/check_versions.py --end oldest        # one of them
    python tests/check_versions.py -- tests/test_optics.py -x

Each end gets a fresh virtual environment with this interpreter and is removed afterwards. The
oldest end pins every lower bound of ``pyproject.toml`` (the dependencies and the extras that users
have); the newest takes what pip prefers; "plain" does so without the extras, of which one caps
numpy. What follows ``--`` goes to pytest.

At the oldest end, deprecation warnings are not errors: old releases get them from newer libraries
underneath, and only their authors could act on them.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ENDS = ("oldest", "newest", "plain")
EXTRAS = ("archive", "survey", "webbpsf")
LENIENT = (
    "-Wdefault::DeprecationWarning",
    "-Wdefault::PendingDeprecationWarning",
    "-Wdefault::FutureWarning",
    "-Wdefault::astropy.utils.exceptions.AstropyDeprecationWarning",
)


def lower_bounds(pyproject=ROOT / "pyproject.toml"):
    """Lower bound of each requirement that a user of the package has, tools aside.

    Raises
    ------
    ValueError
        If a requirement has none.
    """
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    bounds = {}
    extras = project["optional-dependencies"]
    optional = [each for name in EXTRAS for each in extras.get(name, ())]
    for requirement in [*project["dependencies"], *optional]:
        found = re.match(r"([\w.-]+)(?:\[\w+\])?\s*>=\s*([\w.]+)", requirement)
        if not found:
            raise ValueError(f"{pyproject}: {requirement!r} has no lower bound (>=)")
        bounds[found[1]] = found[2]
    return bounds


def tools(pyproject=ROOT / "pyproject.toml"):
    """Requirements of the extra ``test`` without the extras that it takes along."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    own = f"{project['name']}["
    return [each for each in project["optional-dependencies"]["test"] if not each.startswith(own)]


def installed(python, names):
    """Versions in an environment."""
    program = (
        "import json; from importlib.metadata import distributions; "
        "print(json.dumps({each.name.lower(): each.version for each in distributions()}))"
    )
    done = subprocess.run([python, "-c", program], capture_output=True, text=True, check=True)
    versions = json.loads(done.stdout)
    return {name: versions[name.lower()] for name in names if name.lower() in versions}


def same(version, bound):
    """Whether a version is the bound, up to zeros and a local label: 2.10.0+cpu is 2.10."""
    parts = (re.sub(r"(\.0)+$", "", v.split("+")[0]) for v in (version, bound))
    return len(set(parts)) == 1


def check(end, folder, arguments):
    """Make an environment, run pytest in it; returns pytest's exit status."""
    bounds = lower_bounds()
    constraints = folder / "constraints.txt"
    pins = [f"{name}=={bound}" for name, bound in bounds.items()] if end == "oldest" else []
    constraints.write_text("".join(f"{pin}\n" for pin in pins), encoding="utf-8")
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    # What the caller has on the path must not stand in for what pip installs.
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    wanted = [str(ROOT), *tools()] if end == "plain" else [f"{ROOT}[test]"]
    install = [python, "-m", "pip", "install", "--quiet", "-c", constraints, *wanted]
    subprocess.run(install, check=True, env=env)
    versions = installed(python, list(bounds))
    print(f"{end}:", ", ".join(f"{name} {version}" for name, version in versions.items()))
    if end == "oldest":
        wrong = [name for name in bounds if not same(versions.get(name, "none"), bounds[name])]
        if wrong:
            print(f"not the oldest that is allowed: {', '.join(wrong)}", file=sys.stderr)
            return 1
    sys.stdout.flush()
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
