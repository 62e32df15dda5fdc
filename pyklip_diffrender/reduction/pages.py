"""Pages of HTML that need no other file: templates, pictures, numbers and results in words."""

from __future__ import annotations

import math
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import groupby
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.io.progress import counted

if TYPE_CHECKING:
    from jinja2 import Environment

# Numbers and results in words.

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

_SMALLEST_STATED_PROBABILITY = 1e-9
"""Probabilities below this rest on tails that no noise is known to follow."""


def remark_on_map(days: float | None) -> str:
    """Remark on an OPD map so many days from the frames; empty for one of the same week."""
    # Maps are made every two days, and one of a week before is rarely the nearest.
    if days is None or abs(days) <= 7:
        return ""
    return (
        f"The OPD map was sensed {abs(days):.0f} days "
        f"{'before' if days > 0 else 'after'} the frames. JWST's is sensed every two days or so: a "
        "map nearer in time is a better start."
    )


def sentence(summary: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    parts = [_compact(summary)]
    if summary["extended"]:
        parts.insert(0, f"{summary['extended']}: fit extended light first, with the option disk.")
    if summary["disk"] is not None:
        parts.insert(0, _extended(summary))
    if summary["wide_field"] is not None:
        parts.append(_outside(summary))
    if summary["accuracy"] == "quick":
        parts.append(
            "This is a first look with a coarser model, whose limits differ from the limits "
            "of a full reduction."
        )
    return " ".join(parts)


def _outside(summary: Mapping[str, Any]) -> str:
    """How many sources there are beyond the fitted pixels."""
    shapes = [each["shape"] for each in summary["wide_field"]["candidates"]]
    kinds = {
        "more candidate": shapes.count("point"),
        "extended or blended source": shapes.count("extended"),
    }
    counts = [counted(n, kind) for kind, n in kinds.items() if n]
    if not counts:
        return "Nothing was found farther from the star, in the whole frames."
    verb = "is" if next(filter(None, kinds.values())) == 1 else "are"
    return f"Farther from the star, in the whole frames, there {verb} {' and '.join(counts)}."


def some_candidates(number: int) -> str:
    """A number of candidates, such as "no candidates"."""
    return counted(number, "candidate") if number else "no candidates"


def _extended(summary: Mapping[str, Any]) -> str:
    """The extended light in a sentence."""
    disk = summary["disk"]
    angle = disk["position_angle_deg"]
    along = "" if angle is None else f", its long axis at a position angle of {angle:.1f} deg"
    return f"Extended light of {scientific(disk['contrast'])} of the star's was fitted{along}."


def _compact(summary: Mapping[str, Any]) -> str:
    """Companions, or the limit, in a sentence or two."""
    candidates, threshold = summary["candidates"], summary["threshold_snr"]
    if not candidates:
        return " ".join([f"No companion above {threshold:g} sigma.", *_limit(summary)])
    first = candidates[0]
    measured = (
        f"{plus_minus(first['separation_arcsec'], first['separation_error_arcsec'])} arcsec, "
        f"position angle {position_angle(first, oriented=summary['oriented'])}, contrast "
        f"{scientific(first['contrast'], first['contrast_error'])}, S/N {first['snr']:.1f}."
    )
    if len(candidates) == 1:
        return f"One companion candidate at {measured}"
    return (
        f"{len(candidates)} companion candidates above {threshold:g} sigma, the most significant "
        f"at {measured}"
    )


def _limit(summary: Mapping[str, Any]) -> Sequence[str]:
    """The faintest planet that would have been seen near 1.5 arcsec, if that is known anywhere."""
    if not summary["limits"]:
        return []
    row = min(summary["limits"], key=lambda each: abs(each["separation_arcsec"] - 1.5))
    threshold = summary["threshold_snr"]
    contrast = row["contrast"] * threshold / summary["contrast_curve"]["sigmas"]
    return [
        f"A planet of contrast {scientific(contrast)} ({-2.5 * math.log10(contrast):.1f} mag "
        f"fainter than the star) at {row['separation_arcsec']:.3g} arcsec would have had an S/N of "
        f"{threshold:g}."
    ]


def position_angle(candidate: Mapping[str, Any], *, oriented: bool) -> str:
    """Position angle of a candidate, and what it is counted from."""
    angle = plus_minus(candidate["position_angle_deg"], candidate["position_angle_error_deg"])
    origin = "east of north" if oriented else "counter-clockwise from up in the frame"
    return f"{angle} deg {origin}"


def plus_minus(value: float, error: float) -> str:
    """Value and error, to the digits that the error allows."""
    places = _places(error)
    return f"{value:.{places}f} ± {error:.{places}f}"


def scientific(value: float, error: float | None = None) -> str:
    """A number times a power of ten, such as 4.5 × 10⁻⁶, perhaps with its error."""
    if value == 0:
        return "0"
    digits, exponent = f"{value:.1e}".split("e")
    power = int(exponent)
    ten = f"10{str(power).translate(_SUPERSCRIPTS)}"
    if error is None:
        return f"{digits} × {ten}"
    return f"({plus_minus(value / 10**power, error / 10**power)}) × {ten}"


def probability(value: float | None) -> str:
    """A probability of a false alarm; "not stated" for None."""
    if value is None:
        return "not stated"
    if value < _SMALLEST_STATED_PROBABILITY:
        return f"< {scientific(_SMALLEST_STATED_PROBABILITY).replace('1.0 × ', '')}"
    return scientific(value) if value < 0.01 else f"{value:.2f}"


def number(value: Any, form: str = ".3g", unit: str = "") -> str:
    """A number with its unit; "not known" for None."""
    return "not known" if value is None else f"{value:{form}}{unit and f' {unit}'}"


def _places(error: float) -> int:
    """Decimals that show an error with one digit, or two if the first is a 1."""
    if not error > 0 or not math.isfinite(error):
        return 3
    power = math.floor(math.log10(error))
    return max(0, -power + (error / 10**power < 2))


def depth_against_klip(curve: Mapping[str, Any], klip: Mapping[str, Any] | None) -> str:
    """Say in a sentence whose limits are deeper at which separations, and by how much.

    The curves are from a summary (separation_arcsec, contrast, small_sample), and are compared
    at KLIP's separations. Empty without KLIP, or if the curves have no separation in common.
    """
    if klip is None:
        return ""
    raw, corrected = (_deeper(curve, klip, name) for name in ("contrast", "small_sample"))
    if not raw and not corrected:
        return ""
    return (
        f"Without a small-sample correction of either, {raw or 'no limits can be compared'}; with "
        f"it, {corrected or 'no limits can be compared'}."
    )


def _deeper(curve: Mapping[str, Any], klip: Mapping[str, Any], name: str) -> str:
    """Where this package and where KLIP has the deeper limits of one kind."""
    places, ours, at, theirs = (
        np.array(values, dtype=float)
        for values in (
            curve["separation_arcsec"], curve[name], klip["separation_arcsec"], klip[name],
        )
    )  # fmt: skip
    if not len(places):
        return ""
    # Limits fall by orders of magnitude with the separation: their logarithms are interpolated.
    ratios = theirs / np.exp(np.interp(at, places, np.log(ours), np.nan, np.nan))
    known = [(s, r) for s, r in zip(at, ratios, strict=True) if math.isfinite(r)]
    parts = []
    for is_ours, run in groupby(known, lambda each: each[1] >= 1):
        separations, factors = np.array(list(run)).T
        if not is_ours:
            factors = 1 / factors
        span = _span(separations, ".2f")
        parts.append(
            f"{'this reduction' if is_ours else 'KLIP'} is {_span(factors, '.1f')} times deeper at "
            f"{span} arcsec"
        )
    return " and ".join(parts)


def _span(values: Sequence[float], form: str) -> str:
    """The range of values, or one number if its ends are written alike."""
    ends = [f"{each:{form}}" for each in (min(values), max(values))]
    return " to ".join(dict.fromkeys(ends))


# Pages of HTML that need no other file: their templates, pictures and numbers.


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure of a page and its caption."""

    figure: Any  # of matplotlib
    caption: str  # the first sentence also describes the picture to readers who do not see it

    @cached_property
    def uri(self) -> str:
        """The picture itself as the address of an image."""
        return f"data:image/png;base64,{b64encode(drawing.to_png(self.figure)).decode()}"


def curve_arrays(curve: Mapping[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Separations and contrasts of a curve in a summary, NaN for what is not known."""
    return np.array(curve["separation_arcsec"], float), np.array(curve["contrast"], float)


def render(template: str, **values: Any) -> str:
    """Make a page of a template; all values are escaped: headers of files may hold anything."""
    return _environment().get_template(template).render(values)


def _unbroken(text: str) -> str:
    """Text whose numbers are not broken over lines."""
    return re.sub(" ([±×]) ", "\u00a0\\1\u00a0", text)


@cache
def _environment() -> Environment:
    # Commands that write no page need no templates.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("pyklip_diffrender.reduction", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "count": counted,
        "number": number,
        "path": quote,
        "plus_minus": plus_minus,
        "probability": probability,
        "scientific": scientific,
        "unbroken": _unbroken,
    }
    return environment
