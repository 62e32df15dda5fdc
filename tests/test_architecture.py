"""Data flows one way, importing the package is cheap, and its requirements are what it needs."""

import ast
import json
import re
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from packaging.version import Version

import pyklip_diffrender as dr
from benchmarks.check_versions import lower_bounds

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "pyklip_diffrender"

PACKAGES = (
    "_version", "errors", "parameters", "io", "drawing", "archive", "optics", "instrument",
    "wavefront", "scene", "linear", "refinement", "pattern", "detection", "imaging", "options",
    "reduction", "pyklip_backend", "spaceklip", "demo", "surveys", "cli", "bridges",
)  # fmt: skip
"""Top-level modules and packages in order: each imports only from those before it.

Imports in functions and under TYPE_CHECKING count.
Inside a package, and inside packages of that package, imports must form no circle.
"""

OWNERS = {
    "astroquery": ("archive",), "dask": ("surveys",), "distributed": ("surveys",),
    "jinja2": ("reduction.pages",), "matplotlib": ("drawing",), "mpl_toolkits": ("drawing",),
    "poppy": ("bridges",), "pyklip": ("pyklip_backend", "reduction.klip"),
    "spaceKLIP": ("spaceklip",), "stpsf": ("bridges", "wavefront.wss"), "webbpsf": ("bridges",),
}  # fmt: skip
"""Libraries, and the packages or modules that alone may import them."""


def imported_names(tree, inside):
    """Line and absolute dotted name of everything imported, at any depth.

    `inside` is the dotted name of the package that the module is in, to resolve relative imports.
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
            called = getattr(node.func, "attr", getattr(node.func, "id", None))
            first = node.args[0]
            if called in ("import_module", "__import__") and isinstance(first, ast.Constant):
                yield node.lineno, str(first.value)


def violations(sources):
    """What is wrong with the imports of modules, given as path below the package and text."""
    found = []
    modules = {".".join(path.with_suffix("").parts): path for path in sources}
    imports = {name: set() for name in modules}
    for name, path in sorted(modules.items()):
        package = path.parts[0].removesuffix(".py")
        if package in ("__init__", "__main__"):
            continue  # The lazy front of the package; tested by what it loads, below.
        inside = ".".join([PACKAGE, *path.parts[:-1]])
        for line, imported in imported_names(ast.parse(sources[path]), inside):
            top, _, rest = imported.partition(".")
            owners = OWNERS.get(top)
            if owners and not any(f"{name}.".startswith(f"{owner}.") for owner in owners):
                found.append(f"{path}:{line}: only {' and '.join(owners)} may import {top}")
            if top != PACKAGE:
                continue
            other = rest.split(".")[0]
            if other not in PACKAGES:
                found.append(f"{path}:{line}: imports {imported} instead of the module it is in")
            elif PACKAGES.index(other) > PACKAGES.index(package):
                found.append(f"{path}:{line}: {other} comes after {package}")
            elif other == package:
                imports[name] |= {_module_of(rest, modules)} - {name, ""}
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        found.append(f"a circle of imports: {' -> '.join(error.args[1])}")
    return found


def _module_of(name, modules):
    """The module that a dotted name below the package is, or is in; "" if there is none."""
    while name:
        for candidate in (name, f"{name}.__init__"):
            if candidate in modules:
                return candidate
        name = name.rpartition(".")[0]
    return ""


def loaded_by(code):
    """Top-level modules that a fresh interpreter has loaded after running `code`."""
    # On a line of its own, whatever the code has printed.
    code += "\nimport json, sys\nprint()\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=ROOT, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return {name.split(".")[0] for name in json.loads(done.stdout.splitlines()[-1])}


def test_imports_go_one_way():
    folder = ROOT / PACKAGE
    sources = {
        path.relative_to(folder): path.read_text(encoding="utf-8") for path in folder.rglob("*.py")
    }
    special = {"__init__", "__main__"}
    modules = {path.parts[0].removesuffix(".py") for path in sources} - special
    assert sorted(modules) == sorted(PACKAGES)
    assert violations(sources) == []
    # No two modules have one name.
    names = Counter(path.stem for path in sources)
    assert {name for name, count in names.items() if count > 1} <= special


HELP = f"""
import sys
from {PACKAGE}.cli import main
sys.argv = ['pyklip-diffrender', '--help']
try:
    main()
except SystemExit as stop:
    assert not stop.code
"""


@pytest.mark.parametrize("code", [f"import {PACKAGE}", HELP], ids=["import", "help"])
def test_importing_the_package_and_asking_for_help_loads_nothing_heavy(code):
    loaded = loaded_by(code)
    assert PACKAGE in loaded
    assert not loaded & {"torch", "scipy", "photutils", *OWNERS}
    assert code is HELP or not loaded & {"numpy", "astropy"}


@pytest.mark.slow
def test_the_numerical_core_needs_none_of_the_owned_libraries():
    core = [name for name in PACKAGES if name not in {*sum(OWNERS.values(), ()), "demo", "cli"}]
    loaded = loaded_by("\n".join(f"import {PACKAGE}.{name}" for name in core))
    assert "torch" in loaded
    assert not loaded & set(OWNERS)


def test_public_names_resolve():
    for name in dr.__all__:
        value = getattr(dr, name)
        assert isinstance(value, str) if name == "__version__" else callable(value)
    assert dir(dr) == sorted({*dr.__all__, *dr._SUBMODULES})
    # Loading a module of that name would put it in the function's place.
    assert not set(dr._MODULE_OF) & set(PACKAGES)


@pytest.mark.slow
def test_documented_names_of_submodules_load_in_a_fresh_interpreter():
    page = (ROOT / "docs/reference/api.md").read_text(encoding="utf-8")
    names = re.findall(r"^   ((?:[a-z]\w*\.)+\w+)$", page, re.MULTILINE)
    assert {name.split(".")[0] for name in names} >= {"bridges", "drawing", "spaceklip"}
    # The first of each module in the state of a fresh interpreter, with no other package loaded.
    forget = f"for m in [m for m in sys.modules if m.startswith('{PACKAGE}')]: del sys.modules[m]"
    lines, before = ["import sys"], ""
    for name in names:
        lines += [f"{forget}\nimport {PACKAGE} as dr"] * (name.rpartition(".")[0] != before)
        lines.append(f"dr.{name}")
        before = name.rpartition(".")[0]
    loaded_by("\n".join(lines))


def test_type_checkers_see_the_names_that_are_loaded_lazily():
    tree = ast.parse((ROOT / PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (guarded,) = (
        node for node in tree.body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )  # fmt: skip
    typed = {name.removeprefix(f"{PACKAGE}.") for _, name in imported_names(guarded, PACKAGE)}
    assert typed == {f"{module}.{name}" for name, module in dr._MODULE_OF.items()}
    assert set(dr.__all__) == {*dr._MODULE_OF, "__version__"}


def test_what_is_installed_is_no_older_than_the_metadata_allow():
    bounds = lower_bounds()
    assert {"torch", "numpy", "jinja2", "dask", "astroquery", "stpsf"} <= set(bounds)
    for name, bound in bounds.items():
        with suppress(PackageNotFoundError):  # of an extra
            assert Version(version(name)) >= Version(bound), name
