"""The versions that the metadata promises: all bounded, and kept by what is installed."""

from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version

from packaging.version import Version

from benchmarks.check_versions import lower_bounds


def test_what_is_installed_is_no_older_than_the_metadata_allow():
    bounds = lower_bounds()
    assert {"torch", "numpy", "jinja2", "dask", "pyarrow", "astroquery", "stpsf"} <= set(bounds)
    for name, bound in bounds.items():
        with suppress(PackageNotFoundError):  # of an extra
            assert Version(version(name)) >= Version(bound), name
