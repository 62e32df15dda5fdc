"""The version of the installed distribution."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("pyklip-diffrender")
except PackageNotFoundError:
    # A source tree that was put on the path without being installed.
    __version__ = "0+unknown"
