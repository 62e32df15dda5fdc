"""Reductions of real frames have the numbers that were frozen."""

import numpy as np
import pytest
from astropy.table import QTable

from benchmarks.golden import CASES, IN_TESTS, TABLE, differences


def test_every_case_is_frozen_and_a_difference_shows():
    frozen = QTable.read(TABLE)
    assert set(frozen["case"]) == set(CASES)
    for case in CASES:
        rows = frozen[frozen["case"] == case]
        numbers = dict(zip(rows["number"], rows["value"].astype(float), strict=True))
        assert np.isfinite(list(numbers.values())).all()
        assert differences(case, numbers, frozen) == []
        # Two per cent are too much for any of them but places and counts.
        for name, value in numbers.items():
            if not name.startswith(("place", "snr")) and value:
                assert differences(case, numbers | {name: 1.02 * value}, frozen)
        numbers.pop("chi2", None)
        assert differences(case, numbers, frozen) or "chi2" not in rows["number"]


@pytest.mark.slow
@pytest.mark.parametrize("case", IN_TESTS)
def test_numbers_are_those_that_were_frozen(case, shared_data):
    assert differences(case, CASES[case](shared_data), QTable.read(TABLE)) == []
