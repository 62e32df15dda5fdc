"""Everything that is learned of the flat field's error, and how fits of a target use it.

Fits themselves only know `Systematics`, the pattern with its uncertainty.
"""

from __future__ import annotations

from pyklip_diffrender.pattern.choice import (
    PatternChoice,
    PatternRequest,
    ReferenceFrames,
    choose_systematics,
    require_request,
)
from pyklip_diffrender.pattern.fit import fit_with_pattern
from pyklip_diffrender.pattern.library import known_systematics, read_patterns, write_patterns
from pyklip_diffrender.pattern.measure import (
    MeasuredPattern,
    combine_patterns,
    learn_systematics,
    measure_patterns,
)
from pyklip_diffrender.pattern.pedestal import pattern_pedestal
from pyklip_diffrender.pattern.placement import place_on_detector
from pyklip_diffrender.pattern.presence import lacks_pattern, pattern_size

__all__ = [
    "MeasuredPattern",
    "PatternChoice",
    "PatternRequest",
    "ReferenceFrames",
    "choose_systematics",
    "combine_patterns",
    "fit_with_pattern",
    "known_systematics",
    "lacks_pattern",
    "learn_systematics",
    "measure_patterns",
    "pattern_pedestal",
    "pattern_size",
    "place_on_detector",
    "read_patterns",
    "require_request",
    "write_patterns",
]
