"""Flips and quarter turns of positions, arrays and FFT lattices say the same."""

from __future__ import annotations

from itertools import product

import pytest
import torch

from pyklip_diffrender.bridges.sampled_planes import Orientation


def random(size):
    """The same numbers in every run."""
    generator = torch.Generator().manual_seed(size)
    return torch.rand(size, size, generator=generator, dtype=torch.float64)


TURNS = [
    Orientation.quarter_turns(count).then(Orientation.inversion(axis) if axis else Orientation())
    for count, axis in product(range(4), (None, "x"))
]


def test_there_are_eight():
    assert len(set(TURNS)) == 8
    assert {first.then(second) for first, second in product(TURNS, TURNS)} == set(TURNS)
    for turn in TURNS:
        assert turn.then(turn.inverse) == Orientation()
        assert turn.sense == turn.inverse.sense


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("size", [5, 6])
def test_an_array_follows_its_positions(turn, size):
    array = random(size)
    turned = turn.apply(array)
    middle = (size - 1) / 2
    for y, x in product(range(size), range(size)):
        new_x, new_y = turn.positions(torch.tensor(x - middle), torch.tensor(y - middle))
        assert turned[round(float(new_y) + middle), round(float(new_x) + middle)] == array[y, x]


@pytest.mark.parametrize("turn", TURNS)
def test_a_lattice_turns_as_the_transform_of_a_turned_pupil(turn):
    """Turning the pupil turns its power spectrum, whose middle is sample n // 2."""
    pupil = random(8)

    def power(field):
        return torch.fft.fftshift(torch.fft.ifft2(field)).abs() ** 2

    assert torch.allclose(power(turn.apply(pupil)), turn.apply_to_lattice(power(pupil)))
    other = random(9)[:8, :8]
    assert not torch.allclose(power(other), turn.apply_to_lattice(power(pupil)))


def test_counter_clockwise_is_from_x_to_y():
    x, y = Orientation.quarter_turns(1).positions(torch.tensor(1.0), torch.tensor(0.0))
    assert (float(x), float(y)) == (0.0, 1.0)
