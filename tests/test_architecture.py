"""Data flows one way, and importing the package is cheap."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import pyklip_diffrender as dr

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "pyklip_diffrender"

LAYERS = (
    ("errors", "units", "files", "headers", "memory"),
    ("geometry", "zernike", "spectrum", "parameters", "orientation"),
    ("propagation", "streaming"),
    ("planes", "detector", "masks", "arrays", "rotation", "detector_effects"),
    ("cells", "route"),
    ("psf_file", "optics"),
    ("lattice",),
    ("nircam",),
    ("bridges",),
    ("observation", "scene", "simulation"),
    ("bases", "opd", "priors"),
    ("response", "multifidelity", "linear_file", "linear_model"),
    ("fidelity",),
    ("refinement",),
    ("metrics", "detection"),
    ("pyklip_backend",),
    ("demo", "report", "bench", "cli"),
)
"""All modules, in order: a module imports only from those before it, in its own row as well."""

OWNERS = {
    "matplotlib": "report",
    "mpl_toolkits": "report",
    "poppy": "bridges",
    "pyklip": "pyklip_backend",
    "stpsf": "bridges",
    "webbpsf": "bridges",
}
"""Libraries that one module alone may import."""

ORDER = tuple(name for layer in LAYERS for name in layer)


def imported_names(tree: ast.AST, inside: str) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything imported, at any depth.

    Parameters
    ----------
    tree : ast.AST
        A module.
    inside : str
        Dotted name of the package that the module is in, to resolve relative imports.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = inside.split(".")[: inside.count(".") + 2 - node.level] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            for alias in node.names:
                yield node.lineno, f"{source}.{alias.name}"
        elif isinstance(node, ast.Call) and node.args:
            function = node.func
            called = function.attr if isinstance(function, ast.Attribute) else None
            called = function.id if isinstance(function, ast.Name) else called
            first = node.args[0]
            if called in ("import_module", "__import__") and isinstance(first, ast.Constant):
                yield node.lineno, str(first.value)


def violations(sources: dict[Path, str]) -> list[str]:
    """What is wrong with the imports of modules, given as path below the package and text."""
    found = []
    for path, text in sorted(sources.items()):
        module = path.parts[0].removesuffix(".py")
        if module == "__init__":
            continue  # The lazy front of the package; tested by what it loads, below.
        if module not in ORDER:
            found.append(f"{path}: not in LAYERS; give it its place there")
            continue
        inside = ".".join([PACKAGE, *path.parts[:-1]])
        for line, name in imported_names(ast.parse(text), inside):
            top, *rest = name.split(".")
            if top in OWNERS and OWNERS[top] != module:
                found.append(f"{path}:{line}: only {OWNERS[top]} imports {top}")
            if top != PACKAGE or rest == ["__version__"] or rest[:1] == [module]:
                continue
            if not rest or rest[0] not in ORDER:
                found.append(f"{path}:{line}: imports {name} instead of the module it is in")
            elif ORDER.index(rest[0]) > ORDER.index(module):
                found.append(f"{path}:{line}: {rest[0]} comes after {module}")
    return found


def package_sources() -> dict[Path, str]:
    folder = ROOT / PACKAGE
    return {
        path.relative_to(folder): path.read_text(encoding="utf-8") for path in folder.rglob("*.py")
    }


def loaded_by(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after running `code`."""
    done = subprocess.run(
        [
            sys.executable,
            "-W",
            "error",
            "-c",
            # On a line of its own, whatever the code has printed.
            f"{code}\nimport json, sys\nprint()\nprint(json.dumps(sorted(sys.modules)))",
        ],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return {name.split(".")[0] for name in json.loads(done.stdout.splitlines()[-1])}


def test_imports_go_one_way() -> None:
    assert violations(package_sources()) == []


def test_the_table_lists_the_modules_that_there_are() -> None:
    modules = {path.parts[0].removesuffix(".py") for path in package_sources()} - {"__init__"}
    assert modules == set(ORDER)
    assert len(ORDER) == len(set(ORDER))


@pytest.mark.parametrize(
    ("path", "text", "complaint"),
    [
        ("units.py", "from pyklip_diffrender.opd import drift", "opd comes after units"),
        ("units.py", "import pyklip_diffrender.files", "files comes after units"),
        ("optics.py", "from .nircam import nircam_coronagraph", "nircam comes after optics"),
        ("optics.py", "from . import errors, nircam", "nircam comes after optics"),
        ("optics.py", "def f():\n    from pyklip_diffrender import cli", "optics.py:2: cli comes"),
        ("optics/planes.py", "from ..metrics import psnr", "metrics comes after optics"),
        ("optics.py", "import pyklip_diffrender as dr", "instead of the module it is in"),
        ("optics.py", "from pyklip_diffrender import Scene", "instead of the module it is in"),
        ("demo.py", "import pyklip.parallelized as p", "only pyklip_backend imports pyklip"),
        ("demo.py", "from importlib import import_module\nimport_module('pyklip.fm')", "demo.py:2"),
        ("nircam.py", "try:\n    import stpsf\nexcept ImportError:\n    pass", "only bridges"),
        ("cli.py", "import os, matplotlib.pyplot as plt", "only report imports matplotlib"),
        ("novelty.py", "", "not in LAYERS"),
    ],
)
def test_a_planted_violation_is_found(path: str, text: str, complaint: str) -> None:
    found = violations({Path(path): text})
    assert len(found) == 1
    assert complaint in found[0]


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("optics.py", "import torch\nfrom pyklip_diffrender.errors import ShapeError"),
        ("optics/planes.py", "from .stops import Stop\nfrom ..optics import lyot"),
        ("pyklip_backend.py", "import pyklip.fm\nfrom pyklip_diffrender import __version__"),
        ("report.py", "def f():\n    from matplotlib import pyplot"),
        ("bridges.py", "import poppy\nimport stpsf"),
    ],
)
def test_what_is_allowed_is_not_reported(path: str, text: str) -> None:
    assert violations({Path(path): text}) == []


def test_importing_the_package_loads_nothing_heavy() -> None:
    loaded = loaded_by(f"import {PACKAGE}")
    assert PACKAGE in loaded
    assert not loaded & {"torch", "numpy", "scipy", "astropy", "photutils", *OWNERS}


def test_asking_for_help_loads_nothing_heavy() -> None:
    loaded = loaded_by(
        f"import sys\nfrom {PACKAGE}.cli import main\nsys.argv = ['pyklip-diffrender', '--help']\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code"
    )
    assert not loaded & {"torch", "scipy", "photutils", *OWNERS}


def test_the_numerical_core_needs_none_of_the_owned_libraries() -> None:
    core = [name for name in ORDER if name not in {*OWNERS.values(), "demo", "cli"}]
    loaded = loaded_by("\n".join(f"import {PACKAGE}.{name}" for name in core))
    assert "torch" in loaded
    assert not loaded & set(OWNERS)


@pytest.mark.parametrize("name", dr.__all__)
def test_public_name_resolves(name: str) -> None:
    value = getattr(dr, name)
    assert isinstance(value, str) if name == "__version__" else callable(value)
    assert name in dir(dr)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'klip'"):
        _ = dr.klip


def test_no_public_name_is_also_a_module() -> None:
    """Loading such a module would put it in the function's place."""
    assert not set(dr._MODULE_OF) & set(ORDER)


def test_type_checkers_see_the_names_that_are_loaded_lazily() -> None:
    tree = ast.parse((ROOT / PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    guarded = [
        node
        for node in tree.body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    assert len(guarded) == 1
    typed = {name.removeprefix(f"{PACKAGE}.") for _, name in imported_names(guarded[0], PACKAGE)}
    assert typed == {f"{module}.{name}" for name, module in dr._MODULE_OF.items()}
    assert set(dr.__all__) == {*dr._MODULE_OF, "__version__"}
