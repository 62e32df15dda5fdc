"""Pairs of features on one small world: equal numbers, or a refusal before the work.

Whoever adds a feature adds an entry to `FEATURES`, and one to `REFUSED` for what it does not go
with. Every pair of levels of two features is then in one of the cases.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from pairwise import cases_of_pairs, is_possible, missing_pairs
from small_world import (
    DATES,
    DOORS,
    FILTERS,
    OTHER,
    PLANET,
    Refused,
    Request,
    World,
    make_small,
    through_python,
)

import pyklip_diffrender as dr
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.options import OPTIONS, SPECTRA
from pyklip_diffrender.refinement import fitting

pytestmark = [
    pytest.mark.usefixtures("offline"),
    # Where the pattern is known, one frame of a reference star adds nothing.
    pytest.mark.filterwarnings("ignore:.*no frame of the library is used"),
]


class Feature(NamedTuple):
    """A feature of the package and its levels."""

    # The usual one first. Levels of an option of `reduce` are its values.
    levels: tuple[Any, ...]
    # What a summary has if the level is another one.
    shown: Callable[[dict[str, Any]], Any] | None = None
    # Whether the search of a reduction depends on it.
    changes_numbers: bool = False


FEATURES = {
    "door": Feature(tuple(DOORS)),
    "filters": Feature((FILTERS[:1], FILTERS)),
    "epochs": Feature((DATES[:1], DATES)),
    "spectra": Feature((SPECTRA, ("flat",))),
    "reference_star": Feature(
        (False, True), lambda s: [each for each in s["frames"] if each["use"] != "target"],
        changes_numbers=True,
    ),
    "star": Feature(
        ("fitted", "flux", "sed"), lambda s: s["star"]["source"] == "star_flux",
        changes_numbers=True,
    ),
    "pattern_file": Feature(
        ("auto", "library", "file"), lambda s: OTHER in s["pattern"]["stars"],
        changes_numbers=True,
    ),
    "accuracy": Feature(
        ("full", "quick"), lambda s: s["accuracy"] == "quick", changes_numbers=True
    ),
    "disk": Feature((False, True), lambda s: s["disk"], changes_numbers=True),
    "wide": Feature((False, True), lambda s: s["wide_field"]),
    "injections": Feature((0, 1), lambda s: s["injections"]),
    "completeness": Feature((False, True), lambda s: s["completeness"]),
    "memory": Feature((None, "4 GB"), lambda s: s["settings"]["memory"]),
}  # fmt: skip
USUAL = {name: each.levels[0] for name, each in FEATURES.items()}


class Refusal(NamedTuple):
    """Levels that do not go together, and why."""

    # Those that refuse them; empty for every door.
    doors: str
    levels: dict[str, Any]
    error: type[Exception] | tuple[type[Exception], ...]
    message: str
    reason: str
    # Filters that are reduced nevertheless.
    goes_on: tuple[str, ...] = ()


ALONE = "a concatenation, as pyKLIP's dataset, has one wavefront"
NOT_IN_KLIP = "klip_dataset has no products for it"
REFUSED = [
    Refusal("", {"wide": True, "disk": True}, (IncompatibleSetupError, Refused, TypeError), "wide",
            "beyond the fitted pixels a disk would be taken for point sources"),
    Refusal("command", {"star": "flux", "filters": FILTERS}, Refused, "expected one for each",
            "a flux density is for one filter"),
    Refusal("command", {"pattern_file": "file", "filters": FILTERS}, Refused, "pattern",
            "a pattern is of one filter"),
    Refusal("spaceklip", {"pattern_file": "file", "filters": FILTERS}, IncompatibleSetupError,
            "pattern", "a pattern is of one filter; other concatenations go on", FILTERS[:1]),
    Refusal("pyklip", {"filters": FILTERS}, IncompatibleSetupError, "one dataset for each filter",
            "A dataset has one wavelength"),
    Refusal("pyklip spaceklip", {"epochs": DATES}, IncompatibleSetupError, "2 epochs", ALONE),
    Refusal("pyklip", {"spectra": ("flat",)}, TypeError, "'spectra'", ALONE),
    *(
        Refusal("pyklip spaceklip", {name: FEATURES[name].levels[1]}, TypeError, f"'{name}'",
                NOT_IN_KLIP)
        for name in ("wide", "injections", "completeness", "memory")
    ),
    Refusal("pyklip spaceklip", {"star": "sed"}, TypeError, "'star_sed'",
            "star_flux_density gives the number that they take"),
    Refusal("survey", {"star": "sed"}, IncompatibleSetupError, "'star_sed'",
            "star_flux_density gives the number that it takes"),
    *(
        Refusal("survey", {name: FEATURES[name].levels[1]}, IncompatibleSetupError, f"'{name}'",
                OPTIONS[name].not_in_surveys)
        for name in ("accuracy", "memory")
    ),
]  # fmt: skip
LEVELS = {name: each.levels for name, each in FEATURES.items()}
IMPOSSIBLE = [
    {**each.levels, **({"door": door} if door else {})}
    for each in REFUSED
    for door in each.doors.split() or [""]
]
CASES = cases_of_pairs(LEVELS, IMPOSSIBLE)


def label(case):
    """The door, and what else is unusual in a case."""
    words = [case["door"]]
    for name, (usual, *others) in LEVELS.items():
        if name != "door" and case[name] != usual:
            words.append(name if len(others) == 1 else f"{name}={case[name]}")
    return " ".join(words)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return World(tmp_path_factory.mktemp("world"))


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    make_small(monkeypatch)


def through_its_door(case, world, folder):
    return DOORS[case["door"]](request_of(case, world), folder)


def request_of(case, world):
    """What a user asks for."""
    options = {name: case[name] for name in case if name in OPTIONS and case[name] != USUAL[name]}
    others = {name: case[name] for name in case if name not in OPTIONS and name != "door"}
    return Request(world, options=options, **others)


def test_all_pairs_are_in_cases_or_refused():
    assert missing_pairs(CASES, LEVELS, IMPOSSIBLE) == []
    assert all(is_possible(case, IMPOSSIBLE) for case in CASES)
    for case in CASES:
        # Each one has a pair of its own, which is missed without it.
        assert missing_pairs([each for each in CASES if each != case], LEVELS, IMPOSSIBLE)
    few = {"a": (0, 1), "b": (0, 1), "c": (0, 1)}
    cases = cases_of_pairs(few, [{"a": 1, "b": 1}])
    assert missing_pairs(cases, few, []) == [(("a", 1), ("b", 1))]
    with pytest.raises(ValueError, match=r"every case with .* is refused"):
        cases_of_pairs(few, [{"a": 1, "b": 1, "c": 0}, {"a": 1, "b": 1, "c": 1}])


class Begun(Exception):
    """A fit would begin."""


def refused_by(error):
    """The error that is left of a group without those of fits that have begun."""
    if not isinstance(error, ExceptionGroup):
        return error
    _, rest = error.split(Begun)
    (left,) = rest.exceptions
    return left


def refusals():
    for each in REFUSED:
        for door in each.doors.split() or DOORS:
            case = {**USUAL, "door": door, **each.levels}
            yield pytest.param(case, each, id=label(case))


@pytest.mark.parametrize(("case", "refusal"), list(refusals()))
def test_what_does_not_go_together_is_refused_before_the_work(
    case, refusal, world, tmp_path, monkeypatch
):
    begun = []

    def fit_in_stages(problems, *_, **__):
        begun.append(problems[0].observation.filter)
        raise Begun

    monkeypatch.setattr(fitting, "fit_in_stages", fit_in_stages)
    # Doors wrap the error in their own; which it is, and its words, are asserted below.
    with pytest.raises(Exception) as caught:  # noqa: PT011
        through_its_door(case, world, tmp_path)
    assert tuple(begun) == refusal.goes_on
    assert isinstance(refused_by(caught.value), refusal.error)
    assert refusal.message in str(refused_by(caught.value))


@pytest.fixture(scope="module")
def searches():
    """Searches by what they depend on."""
    return {}


def expected(case, world, searches):
    """Searches by filter and date, each of the frames of that reduction alone, by `reduce`."""
    likelihood = {
        name: each.levels[0] if not each.changes_numbers else case[name]
        for name, each in FEATURES.items()
    }
    found = {}
    for filter_ in case["filters"]:
        for date in case["epochs"]:
            plain = {**likelihood, "filters": (filter_,), "epochs": (date,)}
            # Frames of the reference star teach the pattern at every epoch of the target.
            request = request_of(plain, world)._replace(reference_epochs=case["epochs"])
            key = (*plain.items(), case["epochs"] if case["reference_star"] else ())
            if key not in searches:
                (searches[key],) = through_python(request, None).searches
                assert_planet(searches[key])
            found[filter_, date] = searches[key]
    return found


def assert_planet(search):
    """Assert that the planet is the only candidate."""
    (row,) = search.candidates
    assert row["separation"].to_value("arcsec") == pytest.approx(PLANET.separation, abs=0.02)
    assert row["position_angle"].to_value("deg") == pytest.approx(PLANET.position_angle, abs=2)
    assert row["contrast"] == pytest.approx(PLANET.contrast, abs=3 * row["contrast_error"])


def numbers_of(search):
    candidates, curve = search.candidates, search.contrast_curve
    columns = ("separation", "position_angle", "contrast", "contrast_error", "snr")
    return {
        **{name: np.asarray(candidates[name]) for name in columns},
        "limits": np.asarray(curve["contrast"]),
        "separations": np.asarray(curve["separation"]),
        "star": np.asarray(search.sky.star),
    }


def assert_same(ours, others):
    """Assert equality up to sums in single precision, whose order depends on the memory."""
    assert ours.keys() == others.keys()
    for name, values in ours.items():
        np.testing.assert_allclose(values, others[name], rtol=1e-4, atol=1e-9, err_msg=name)


def is_quick(case):
    """Whether a case is one reduction in memory of which nothing takes long."""
    fast = ("wide", "memory", "spectra")
    return all(case[name] == USUAL[name] for name in FEATURES if name not in fast)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(each, id=label(each), marks=() if is_quick(each) else pytest.mark.slow)
        for each in CASES
    ],
)
def test_features_leave_the_numbers_of_others_alone(case, world, searches, tmp_path):
    found = through_its_door(case, world, tmp_path)
    alone = expected(case, world, searches)
    ours = {(s.observation.filter, s.observation.date.isot[:10]): s for s in found.searches}
    assert ours.keys() == alone.keys()
    for key, search in ours.items():
        assert_same(numbers_of(search), numbers_of(alone[key]))
    for summary in found.summaries:
        for name, each in FEATURES.items():
            if each.shown is not None:
                assert bool(each.shown(summary)) == (case[name] != USUAL[name]), name
    if len(ours) == 1:
        assert found.combined is None
        return
    assert "reason" not in found.combined
    combined = dr.combine(list(alone.values()), spectra=case["spectra"]).to_dict()
    assert len(found.combined["candidates"]) == len(combined["candidates"]) == 1
    for row, other in zip(found.combined["candidates"], combined["candidates"], strict=True):
        assert row["separation_arcsec"] == pytest.approx(PLANET.separation, abs=0.02)
        numbers, others = (
            {name: np.array(each[name]) for name in each if isinstance(each[name], float)}
            for each in (row, other)
        )
        assert_same(numbers, others)
