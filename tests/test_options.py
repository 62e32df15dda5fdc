"""Options of a reduction are declared once: Python, command line, surveys and pages follow."""

import ast
import inspect
from dataclasses import fields
from pathlib import Path

import click
import numpy as np
import pytest

import pyklip_diffrender as dr
from pyklip_diffrender import options as module
from pyklip_diffrender.cli import application
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.options import OPTIONS, ReduceKeywords
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.spaceklip import run_obs
from pyklip_diffrender.surveys.config import Options

SOURCE = Path(module.__file__)


def test_every_option_is_on_the_command_line_or_has_a_reason():
    command = application.commands["reduce"]
    params = {each.opts[-1]: each for each in command.params if isinstance(each, click.Option)}
    for option in OPTIONS.values():
        if option.not_on_command_line:
            assert option.flag not in params
            continue
        shown = params[option.flag]
        assert shown.help == option.help != ""
        if not option.is_switch:
            assert shown.default == option.default


def test_every_option_is_a_key_of_surveys_or_has_a_reason():
    keys = {name: value for name, value in vars(Options()).items() if name != "settings"}
    assert {name for name, each in OPTIONS.items() if not each.not_in_surveys} == set(keys)
    assert all(OPTIONS[name].default == value for name, value in keys.items())


def test_keywords_of_reduce_are_the_fields_with_their_types():
    keywords = {name: each.__forward_arg__ for name, each in ReduceKeywords.__annotations__.items()}
    assert keywords == {each.name: each.type for each in fields(ReduceOptions)}
    assert "Unpack[ReduceKeywords]" in str(inspect.signature(dr.reduce))


def test_the_docstring_describes_every_option():
    parameters = (inspect.getdoc(ReduceOptions) or "").partition("Parameters\n")[2]
    parameters = " ".join(parameters.partition("Attributes\n")[0].split())
    for option in OPTIONS.values():
        assert f"{option.name} : {option.stated_type} {option.meaning}" in parameters
        assert len(option.meaning) > 10


def test_settings_of_the_backend_are_unset_and_those_of_spaceklip_are_the_usual_ones():
    settings = {each.name: each.default for each in fields(dr.pyklip_backend.DiffrenderSettings)}
    shared = settings.keys() & OPTIONS.keys()
    assert {"threshold", "disk", "star_flux_error"} < shared
    assert all(settings[name] is None for name in shared)
    documented = " ".join((inspect.getdoc(dr.pyklip_backend.DiffrenderSettings) or "").split())
    # What differs from `reduce` is said there: the default, and where reference frames are from.
    for name in shared - {"pattern", "max_chi2", "size"}:
        assert OPTIONS[name].meaning in documented
    for name, each in inspect.signature(run_obs).parameters.items():
        if name in OPTIONS and each.kind is not each.VAR_KEYWORD:
            assert each.default == OPTIONS[name].default


def defaults(text):
    """Line, name and value of every constant default that is written out."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.arguments):
            named = [*zip(node.args[::-1], node.defaults[::-1], strict=False)]
            named += [*zip(node.kwonlyargs, node.kw_defaults, strict=True)]
            found += [(argument.lineno, argument.arg, value) for argument, value in named]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.append((node.lineno, node.target.id, node.value))
        elif isinstance(node, ast.Call):
            flag = next((each.value for each in node.args if isinstance(each, ast.Constant)), "")
            name = str(flag).removeprefix("--").replace("-", "_")
            given = [each.value for each in node.keywords if each.arg == "default"]
            found += [(node.lineno, name, value) for value in given]
    return [(k, name, each.value) for k, name, each in found if isinstance(each, ast.Constant)]


def test_no_default_is_repeated():
    """Outside the table, and the functions of which a reduction is made."""
    repeated = []
    for folder in ("reduction", "pyklip_backend", "spaceklip", "surveys", "cli"):
        for path in sorted((SOURCE.parent / folder).rglob("*.py")):
            for line, name, value in defaults(path.read_text(encoding="utf-8")):
                known = OPTIONS.get(name)
                if known is not None and value == known.default and value not in (None, False):
                    repeated.append(f"{path}:{line}: {name} = {value!r}")
    # The frames of learn have as many pixels only by chance.
    assert [each for each in repeated if "application.py" not in each] == []
    assert len(repeated) <= 1
    planted = "def f(*, star_flux_error: float = 0.05): ...\noption('--threshold', default=5.0)"
    assert {each[1:] for each in defaults(planted)} == {
        ("star_flux_error", 0.05), ("threshold", 5.0),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("size", 7, "7, expected a whole number of pixels, 8 or more"),
        ("size", 80.5, "8 or more"), ("injections", True, "a whole number, 0 or more"),
        ("threshold", float("inf"), "a positive number"), ("threshold", None, "a positive number"),
        ("wide", "no", "'no', expected true or false"), ("max_chi2", 0, "inf for no limit"),
        ("references", "both", "one of joint, pattern, off"), ("star_flux_error", 5, "0.05 for 5"),
        ("star_flux_error", 0.0, ""), ("star_flux_error", float("nan"), ""),
        ("injections", -1, "0 or more"), ("injections", 2.5, "0 or more"),
    ],
)  # fmt: skip
def test_values_that_are_not_allowed(name, value, words):
    with pytest.raises(IncompatibleSetupError, match=f"^{name}: got.*{words}"):
        ReduceOptions(**{name: value})


def test_values_are_kept_as_plain_ones():
    given = ReduceOptions(size=np.int64(40), threshold=np.float32(4), wide=np.True_)
    assert repr((given.size, given.threshold, given.wide)) == "(40, 4.0, True)"
