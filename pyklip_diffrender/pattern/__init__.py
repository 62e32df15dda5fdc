"""Everything that is learned of the flat field's error, and how fits of a target use it.

Fits themselves only know `DetectorPattern`, the pattern with its uncertainty.
"""

from __future__ import annotations

from pyklip_diffrender.pattern.choice import (
    PatternChoice,
    PatternRequest,
    as_request,
    choose_pattern,
    fit_with_pattern,
    is_known_beside,
    pattern_for_visit,
    place_on_detector,
    with_known_pattern,
)
from pyklip_diffrender.pattern.learn import learn_patterns
from pyklip_diffrender.pattern.library import (
    PatternLibrary,
    combine_libraries,
    known_pattern,
    package_library,
)
from pyklip_diffrender.pattern.measure import (
    MeasuredPattern,
    combine_patterns,
    learn_pattern,
    measure_patterns,
    pattern_size,
)

__all__ = [
    "MeasuredPattern",
    "PatternChoice",
    "PatternLibrary",
    "PatternRequest",
    "as_request",
    "choose_pattern",
    "combine_libraries",
    "combine_patterns",
    "fit_with_pattern",
    "is_known_beside",
    "known_pattern",
    "learn_pattern",
    "learn_patterns",
    "measure_patterns",
    "package_library",
    "pattern_for_visit",
    "pattern_size",
    "place_on_detector",
    "with_known_pattern",
]
