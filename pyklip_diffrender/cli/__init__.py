"""The command line. Nothing heavy is imported before a command needs it."""

from __future__ import annotations

from pyklip_diffrender.cli.application import application, main

__all__ = ["application", "main"]
