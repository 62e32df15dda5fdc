"""KLIP itself, as pyKLIP has it, for comparisons."""

from __future__ import annotations

from pyklip_diffrender.pyklip_backend.klip.curve import (
    KlipSubtraction,
    klip_curve,
    klip_image,
    small_sample_factor,
)
from pyklip_diffrender.pyklip_backend.klip.rdi import klip_rdi

__all__ = ["KlipSubtraction", "klip_curve", "klip_image", "klip_rdi", "small_sample_factor"]
