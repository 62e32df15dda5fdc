"""Cases in which all pairs of levels of different features occur."""

import random
from itertools import combinations

_TRIES = 30
"""Cases of which the one with the most new pairs is taken."""


def pairs_in(case):
    """All pairs (feature, level), (feature, level) of a case, which is a dict."""
    return set(combinations(case.items(), 2))


def is_possible(case, refused):
    """Whether a case has none of the combinations of levels that are refused, which are dicts."""
    return not any(each.items() <= case.items() for each in refused)


def missing_pairs(cases, levels, refused):
    """Pairs of levels of different features that are neither in a case nor refused."""
    there = set().union(*map(pairs_in, cases))
    return [
        pair
        for one, other in combinations(levels, 2)
        for pair in (((one, a), (other, b)) for a in levels[one] for b in levels[other])
        if pair not in there and is_possible(dict(pair), refused)
    ]


def cases_of_pairs(levels, refused=()):
    """Cases with every pair that is not refused, from the levels by feature.

    Raises ValueError for a pair that would be in no case, so that `refused` has to name it.
    """
    wanted = missing_pairs([], levels, refused)
    chance, cases = random.Random(1), []
    while wanted:
        first = dict(wanted[0])
        tries = [_completed(first, levels, refused, wanted, chance) for _ in range(_TRIES)]
        if None in tries:
            raise ValueError(f"every case with {first} is refused, as no entry says")
        best = max(tries, key=lambda case: len(pairs_in(case).intersection(wanted)))
        cases.append(best)
        wanted = [pair for pair in wanted if pair not in pairs_in(best)]
    for case in cases[:]:
        others = [each for each in cases if each is not case]
        # The later ones may have all pairs of an earlier one.
        if not missing_pairs(others, levels, refused):
            cases = others
    return cases


def _completed(case, levels, refused, wanted, chance):
    """A possible case with the levels of an incomplete one, and many wanted pairs; else None."""
    missing = [name for name in levels if name not in case]
    if not missing:
        return {name: case[name] for name in levels}
    name = chance.choice(missing)

    def gain(level):
        more = (case | {name: level}).items()
        return sum((name, level) in pair and set(pair) <= more for pair in wanted)

    # Of levels that add as many pairs the first one, which is the usual one, comes first.
    for level in sorted(levels[name], key=gain, reverse=True):
        more = case | {name: level}
        if is_possible(more, refused):
            whole = _completed(more, levels, refused, wanted, chance)
            if whole is not None:
                return whole
    return None
