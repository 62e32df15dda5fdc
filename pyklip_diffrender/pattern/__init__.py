"""Everything that is learned of the flat field's error, and how fits of a target use it.

Fits themselves only know `Systematics`, the pattern with its uncertainty.
"""

from __future__ import annotations

from pyklip_diffrender.pattern.choice import (
    PatternChoice,
    PatternRequest,
    ReferenceFrames,
    as_request,
    choose_systematics,
    fit_with_pattern,
    is_known_beside,
    pattern_for_visit,
    place_on_detector,
    with_known_pattern,
)
from pyklip_diffrender.pattern.learn import learn_library
from pyklip_diffrender.pattern.library import (
    PatternLibrary,
    combine_libraries,
    known_systematics,
    package_library,
)
from pyklip_diffrender.pattern.measure import (
    MeasuredPattern,
    combine_patterns,
    lacks_pattern,
    learn_systematics,
    measure_patterns,
    pattern_pedestal,
    pattern_size,
)

__all__ = [
    "MeasuredPattern",
    "PatternChoice",
    "PatternLibrary",
    "PatternRequest",
    "ReferenceFrames",
    "as_request",
    "choose_systematics",
    "combine_libraries",
    "combine_patterns",
    "fit_with_pattern",
    "is_known_beside",
    "known_systematics",
    "lacks_pattern",
    "learn_library",
    "learn_systematics",
    "measure_patterns",
    "package_library",
    "pattern_for_visit",
    "pattern_pedestal",
    "pattern_size",
    "place_on_detector",
    "with_known_pattern",
]
