"""The versions that the metadata promises: all bounded, and kept by what is installed."""

from __future__ import annotations

from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version

import pytest
from check_versions import lower_bounds, same
from packaging.version import Version


def test_what_is_installed_is_no_older_than_the_metadata_allow():
    bounds = lower_bounds()
    assert {"torch", "numpy", "scipy", "astropy", "photutils", "poppy", "pyklip", "jinja2"} <= set(
        bounds
    )
    assert {"jinja2", "dask", "pyarrow", "astroquery"} <= set(bounds)
    for name, bound in bounds.items():
        with suppress(PackageNotFoundError):  # of an extra
            assert Version(version(name)) >= Version(bound), name


def test_a_requirement_without_a_lower_bound_is_named(tmp_path):
    path = tmp_path / "pyproject.toml"
    path.write_text(
        '[project]\ndependencies = ["torch>=2.6", "scipy"]\n'
        "[project.optional-dependencies]\nwebbpsf = []\n"
    )
    with pytest.raises(ValueError, match=r"'scipy' has no lower bound"):
        lower_bounds(path)


@pytest.mark.parametrize(
    ("installed", "bound", "expected"),
    [
        ("2.10", "2.10.0", True),
        ("2.6.0+cu124", "2.6", True),
        ("2.1.0", "2.10", False),
        ("2.0.1", "2.0", False),
    ],
)
def test_a_version_is_the_bound_up_to_zeros(installed, bound, expected):
    assert same(installed, bound) is expected
