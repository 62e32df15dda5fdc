"""Commands and code of README, documentation and docstrings: what they name exists, and is right.

Code cells of the tutorials are run by the build of the documentation.
"""

import ast
import builtins
import doctest
import importlib
import inspect
import re
import shlex
import tomllib
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path

import click
import pytest

import pyklip_diffrender as dr
from pyklip_diffrender.cli import application
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.wavefront.opd_map import OPDMap

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
PAGES += [path for path in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in path.parts]
PROGRAM = "pyklip-diffrender"

OBJECTS = {
    "detection": dr.Detection, "fit": dr.Refinement, "result": dr.Reduction,
    "sequence": dr.ExposureSequence, "wavefront": OPDMap,
}  # fmt: skip
"""Classes of variables that the documentation calls by these names."""

PACKAGES = (dr, dr.detection, dr.linear, dr.pattern, dr.pyklip_backend, dr.wavefront)
CLASSES = {
    name: getattr(package, name)
    for package in PACKAGES
    for name in package.__all__
    if inspect.isclass(getattr(package, name))
}
"""Classes that the text may call by their names alone."""


@dataclass(frozen=True)
class Block:
    """A fenced block of code."""

    page: str
    line: int
    language: str
    text: str

    def __str__(self):
        return f"{self.page}:{self.line}"


@cache
def blocks():
    found = []
    for path in PAGES:
        page, text = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        fenced = re.compile(r"^```+(.*)\n((?:.*\n)*?)[ \t]*```[ \t]*$", re.MULTILINE)
        assert not re.search("^```", fenced.sub("", text), re.MULTILINE), f"{page}: a block is open"
        for each in fenced.finditer(text):
            line = text.count("\n", 0, each.start(2)) + 1
            found.append(Block(page, line, each[1].strip(), each[2].removesuffix("\n")))
    return tuple(found)


def commands(program):
    """Where a program is called in blocks, by line, or in the text, and its arguments."""
    calls = []
    for block in blocks():
        if block.language in ("", "bash", "text"):
            text = block.text.replace("\\\n", " ")
            calls += [(str(block), line) for line in text.splitlines()]
    for path in PAGES:
        prose = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        quoted = re.findall(rf"`({program} [^`]+)`", prose.replace("\n", " "))
        calls += [(path.relative_to(ROOT).as_posix(), call) for call in quoted]
    for place, call in calls:
        for part in re.split(r"&&|\||\$ ", call.partition("#")[0]):
            # Environment variables may stand before the program.
            words = shlex.split(re.sub(r"^\s*(\w+=\S+ )*", "", part)) if program in part else []
            if words[: len(program.split())] == program.split() != words:
                yield place, words[len(program.split()) :]


def test_documented_commands_parse(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs/reference/command_line.md").read_text(encoding="utf-8")
    Path("run.toml").write_text(page.partition("```toml\n")[2].partition("```")[0])
    calls = [call for call in commands(PROGRAM) if call[1][0] != "COMMAND"]
    assert len(calls) > 20
    for place, (name, *rest) in calls:
        assert name in application.commands, f"{place}: no command {name}"
        command = application.commands[name]
        if place.endswith(".md"):  # In the text a command need not be complete.
            options = {option for each in command.params for option in each.opts}
            assert {word for word in rest if word.startswith("-")} <= options, place
            continue
        try:
            # In the context of the program, whose options for help the commands take over.
            parent = click.Context(application, info_name=PROGRAM, **application.context_settings)
            command.make_context(name, rest, parent=parent)
        except click.UsageError as error:
            pytest.fail(f"{place}: {error.format_message()}")


@pytest.mark.parametrize("program", ["python -m", "python"])
def test_documented_scripts_have_the_options(program):
    checked = 0
    for place, (script, *arguments) in commands(program):
        if script.startswith("benchmarks"):
            path = ROOT / script.replace(".", "/")
            sources = list(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
        elif script.startswith(("examples/", "tests/")):
            sources = [ROOT / script]
        else:
            continue
        for source in sources:
            assert source.exists(), f"{place}: there is no {script}"
        # Some share options in a module beside them.
        sources += [ROOT / "benchmarks" / "real_frames.py", ROOT / "examples/paper/scene.py"]
        code = "".join(source.read_text(encoding="utf-8") for source in sources)
        for option in arguments:
            if option.startswith("--") and option != "--help":
                assert f'"{option}"' in code, f"{place}: {script} has no option {option}"
        checked += 1
    assert checked > 2


PYTHON = [block for block in blocks() if block.language == "python"]


def test_names_and_arguments_in_documented_code_exist():
    for block, node in ((each, node) for each in PYTHON for node in ast.walk(ast.parse(each.text))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pyklip_diffrender"):
            module = importlib.import_module(node.module or "")
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")
        if isinstance(node, ast.Attribute):
            owner = named(node.value)
            if owner is not None:
                assert node.attr in members(owner), f"{block}: no {ast.unparse(node)}"
        if isinstance(node, ast.Call):
            require_arguments(block, node)


def named(node):
    """The package, module or class that code names; None for anything else."""
    if isinstance(node, ast.Name):
        return dr if node.id == "dr" else OBJECTS.get(node.id)
    if isinstance(node, ast.Attribute):
        found = getattr(named(node.value), node.attr, None)
        return found if inspect.ismodule(found) or inspect.isclass(found) else None
    return None


def members(owner):
    names = {*dir(owner), *getattr(owner, "__all__", ())}
    if is_dataclass(owner):
        names |= {each.name for each in fields(owner)}
    return names


def require_arguments(block, call):
    """Check the keywords of calls of the package's functions and methods."""
    owner = named(call.func.value) if isinstance(call.func, ast.Attribute) else None
    function = getattr(owner, call.func.attr, None) if owner is not None else None
    if function is None:
        return
    parameters = inspect.signature(function).parameters
    taken = {name for name, each in parameters.items() if each.kind is not each.VAR_KEYWORD}
    # Keywords of these are fields of a class with settings.
    taken |= {
        each.name
        for each in (*fields(dr.pyklip_backend.DiffrenderSettings), *fields(ReduceOptions))
    }
    for keyword in call.keywords:
        assert keyword.arg is None or keyword.arg in taken, (
            f"{block}: {ast.unparse(call.func)} takes no {keyword.arg}"
        )


@pytest.mark.parametrize("page", sorted({block.page for block in PYTHON}))
def test_documented_code_imports_names_before_it_uses_them(page):
    def bound(tree):
        aliases = (n for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom))
        return {(a.asname or a.name).split(".")[0] for each in aliases for a in each.names}

    imported = {name for block in PYTHON for name in bound(ast.parse(block.text))}
    known = set(dir(builtins))
    # Cells of tutorials come before the other code of their pages.
    for cell in (b for b in blocks() if b.page == page and b.language.startswith("{code-cell}")):
        code = re.sub(
            r"\A---\n.*?\n---\n|^:[^\n]*\n", "", cell.text, flags=re.DOTALL | re.MULTILINE
        )
        known |= bound(ast.parse(code))
    for block in (each for each in PYTHON if each.page == page):
        if page == "README.md":  # Readers paste its blocks alone.
            known = set(dir(builtins))
        for statement in ast.parse(block.text).body:
            names = [n for n in ast.walk(statement) if isinstance(n, ast.Name)]
            loaded = {n.id for n in names if isinstance(n.ctx, ast.Load)}
            missing = (loaded & imported) - known - bound(statement)
            assert not missing, f"{block}: {', '.join(sorted(missing))} is used before its import"
            known |= bound(statement) | {n.id for n in names if isinstance(n.ctx, ast.Store)}


def test_attributes_and_files_that_the_text_names_exist():
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
        for owner, name in re.findall(r"`(?:dr\.)?([A-Z]\w+)\.(\w+)", prose):
            if owner in CLASSES and path.name != "changelog.md":
                assert name in members(CLASSES[owner]), f"{path.name}: no {owner}.{name}"
        for name in re.findall(r"`dr\.(\w+(?:\.\w+)*)", prose):
            assert attrgetter(name)(dr) is not None, f"{path.name}: no dr.{name}"
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text) if path in PAGES[:2] else ():
            exists = target.startswith("http") or (ROOT / target).exists()
            assert exists, f"{path.name}: {target}"


NAMES = sorted(
    name
    for name in dr.__all__
    if not name.startswith("__")
    and not (inspect.isclass(each := getattr(dr, name)) and issubclass(each, Warning | Exception))
)


def takes_long(name):
    """Whether the examples of a name fit, which takes seconds."""
    lines = (inspect.getdoc(getattr(dr, name)) or "").splitlines()
    return any("dr.refine(" in line for line in lines if "SKIP" not in line)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if takes_long(name) else name for name in NAMES],
)
def test_examples_of_public_names_give_what_they_say(name):
    assert ">>>" in (inspect.getdoc(getattr(dr, name)) or "")
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    # Without the names of the module: a reader does not have them.
    for each in doctest.DocTestFinder().find(getattr(dr, name), name, globs={}):
        runner.run(each)
    assert runner.summarize(verbose=False).failed == 0


@pytest.mark.slow
def test_the_first_example_gives_what_the_page_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = [block for block in blocks() if block.page == "docs/getting_started.md"]
    (code,) = (block.text for block in page if "dr.simulate(" in block.text)
    (stated,) = (block.text for block in page if block.language == "text")
    exec(compile(code, "getting_started.md", "exec"), {})
    shown = capsys.readouterr().out
    for line in stated.splitlines():
        assert line.strip() in shown
    assert (tmp_path / "products" / "candidates.ecsv").exists()


def test_the_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for name, phrase in {
        "CITATION.cff": "version: {}\n",
        "docs/reference/citation.md": "version = {{{}}}",
        "CHANGELOG.md": "## [{}] - ",
    }.items():
        assert phrase.format(project["version"]) in (ROOT / name).read_text("utf-8"), name
