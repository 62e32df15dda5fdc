"""Every public name has an example in its docstring, and the examples give what they say."""

from __future__ import annotations

import doctest
import inspect

import pytest

import pyklip_diffrender as dr

NAMES = sorted(
    name
    for name in dr.__all__
    if not name.startswith("__")
    and not (inspect.isclass(each := getattr(dr, name)) and issubclass(each, Warning | Exception))
)


def takes_long(name):
    """Whether the examples of a name fit, which takes seconds."""
    text = inspect.getdoc(getattr(dr, name)) or ""
    return any(
        call in line for line in text.splitlines() for call in ("dr.refine(",) if "SKIP" not in line
    )


def test_public_names_have_examples():
    without = {name for name in NAMES if ">>>" not in (inspect.getdoc(getattr(dr, name)) or "")}
    assert not without


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if takes_long(name) else name for name in NAMES],
)
def test_examples_give_what_they_say(name):
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    # Without the names of the module: a reader does not have them.
    for each in doctest.DocTestFinder().find(getattr(dr, name), name, globs={}):
        runner.run(each)
    assert runner.summarize(verbose=False).failed == 0
