"""Masks and units of every container of numbers: container x mask x unit."""

from itertools import product

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.nddata import CCDData, InverseVariance
from astropy.table import Column, MaskedColumn, QTable, Table
from astropy.utils.masked import Masked

import pyklip_diffrender as dr
from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError, UnitError
from pyklip_diffrender.io import native_float64, to_metres, to_unit
from pyklip_diffrender.io.units import to_mask

VALUES = np.arange(1.0, 13.0).reshape(3, 4)
MASK = VALUES % 5 == 0
SURFACE = u.MJy / u.sr


def quantity(values, mask, unit):
    values = values if mask is None else Masked(values, mask=mask)
    return values if unit is None else values << unit


def numpy_masked(values, mask, unit):
    assert unit is None
    return np.ma.MaskedArray(values, mask=np.zeros(values.shape, bool) if mask is None else mask)


def column(values, mask, unit):
    return Column(values, unit=unit) if mask is None else MaskedColumn(values, mask=mask, unit=unit)


def of_table(values, mask, unit):
    return QTable({"flux": quantity(values, mask, unit)})["flux"]


def part(mask, k):
    return None if mask is None else mask[k]


def rows_of_quantities(values, mask, unit):
    assert mask is None
    return [tuple(row) for row in quantity(values, mask, unit)]


CONTAINERS = [
    quantity, numpy_masked, column, of_table, rows_of_quantities,
]  # fmt: skip


@pytest.mark.parametrize("mask", [None, MASK], ids=["all", "masked"])
@pytest.mark.parametrize(
    ("container", "unit"),
    # Arrays of numpy have no units.
    [pair for pair in product(CONTAINERS, (None, u.Jy / u.sr)) if pair[0] is not numpy_masked]
    + [(numpy_masked, None)],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_masked_values_are_nan_and_units_are_converted(container, mask, unit):
    before = VALUES.copy()
    if mask is not None and container is rows_of_quantities:
        with pytest.raises(IncompatibleSetupError, match="data: got a list with masked members"):
            to_unit(list(quantity(before, mask, unit)), SURFACE, "data")
        return
    value = container(before, mask, unit)
    factor = 1.0 if unit is None else float(unit.to(SURFACE))
    got = to_unit(value, SURFACE, "data")
    expected = np.where(MASK, np.nan, VALUES) if mask is not None else VALUES
    assert got.dtype == np.float64
    assert got.flags.c_contiguous
    np.testing.assert_allclose(got, factor * expected, rtol=1e-14)
    got[:] = 7
    np.testing.assert_array_equal(before, VALUES)
    np.testing.assert_allclose(native_float64(value), expected, rtol=1e-14)
    if unit is not None:
        with pytest.raises(UnitError, match="data: got the unit"):
            to_unit(value, u.s, "data")


def test_a_column_in_centimetres_is_a_length():
    assert to_metres(Table({"x": Column([150.0], unit="cm")})["x"], "x") == pytest.approx([1.5])


def test_masks_of_masks():
    valid = np.ma.MaskedArray(np.ones((3, 4), bool), mask=MASK)
    got = dr.Observation.from_arrays(VALUES, VALUES, valid=valid, pixelscale=0.063)
    np.testing.assert_array_equal(got.valid[0], ~MASK)
    np.testing.assert_array_equal(
        to_mask([[1, 0], [0, 1]], "valid"), [[True, False], [False, True]]
    )
    with pytest.raises(IncompatibleSetupError, match="valid: got numbers, expected True or False"):
        to_mask(VALUES, "valid")


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (Masked(VALUES + 1j, mask=MASK), IncompatibleSetupError, "data: got complex numbers"),
        (torch.ones(2, dtype=torch.complex128), IncompatibleSetupError, "got complex numbers"),
        ([1.0, 2j], IncompatibleSetupError, "data: got complex numbers"),
        (np.array(["2022-08-11"], "M8[D]"), IncompatibleSetupError, "data: got dates"),
        (InverseVariance(VALUES), IncompatibleSetupError, "data: got InverseVariance"),
        (CCDData(VALUES, unit=SURFACE), IncompatibleSetupError, "data: got CCDData"),
        ([CCDData(VALUES, unit=SURFACE)], IncompatibleSetupError, "masked members"),
        ([np.ma.MaskedArray(VALUES)], IncompatibleSetupError, "masked members"),
        (object(), IncompatibleSetupError, "data: got object"),
        (["a", "b"], IncompatibleSetupError, "data: got list.*expected real numbers"),
        ([1 * SURFACE, 2.0], UnitError, "data: got members of different units"),
        ([1 * SURFACE, 2.0 * u.m], UnitError, "data: got members of different units"),
        ([[1.0, 2.0], [3.0]], ShapeError, "data: got members of different shapes"),
        ([[1.0, 2.0] * SURFACE, [3.0] * SURFACE], ShapeError, "members of different shapes"),
    ],
)
def test_what_cannot_be_taken_is_refused_by_name(value, error, words):
    with pytest.raises(error, match=words):
        to_unit(value, SURFACE, "data")


def test_a_position_in_another_unit_than_pixels_is_refused():
    with pytest.raises(UnitError, match="center: got the unit 'arcsec'"):
        dr.Observation.from_arrays(VALUES, VALUES, pixelscale=0.063, center=[1, 2] * u.arcsec)
