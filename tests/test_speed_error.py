"""The benchmark of speed and error: its tables, and small versions of its measurements."""

from __future__ import annotations
