"""Wavefront modes: their size, place and orientation, and that sums and windows agree."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pyklip_diffrender.instrument import TABULATED_GAP, is_jwst_pupil, jwst_pupil, jwst_segments
from pyklip_diffrender.optics import JWST_DIAMETER, PupilGrid, polygon_coverage, widen_polygon
from pyklip_diffrender.wavefront import FourierModes, JointBasis, SegmentMotions

GRID = PupilGrid.full(128)


@pytest.fixture(scope="module")
def segments():
    return SegmentMotions()


def support(k):
    """Share of every pixel that lies on a segment, half the gaps around it included."""
    outline = list(jwst_segments().values())[k]
    return polygon_coverage([widen_polygon(outline, TABULATED_GAP / 2)], GRID)


def bases():
    return [SegmentMotions(), FourierModes(5), JointBasis([SegmentMotions(), FourierModes(5)])]


def test_segment_modes_have_unit_rms_on_their_segment(segments):
    modes = segments.modes(GRID, 0, len(segments))
    assert modes.shape == (54, 128, 128)
    for k in range(18):
        cover = support(k)
        inside = cover > 0
        for mode in modes[3 * k : 3 * k + 3]:
            shape = torch.where(inside, mode / cover.clamp(min=1e-12), 0.0)
            rms = torch.sqrt((cover * shape**2).sum() / cover.sum())
            assert float(rms) == pytest.approx(1.0, rel=1e-9)
            assert not mode[~inside].any()


def test_tips_and_tilts_have_no_piston(segments):
    modes = segments.modes(GRID, 0, len(segments))
    for k in (1, 2, 28, 53):
        assert abs(float(modes[k].sum() / modes[k].abs().sum())) < 1e-12


def test_all_pistons_together_fill_the_pupil(segments):
    """No point of the pupil, gaps included, is left out or moved twice."""
    coefficients = torch.zeros(54, dtype=torch.float64)
    coefficients[0::3] = 1.0
    total = segments.opd(coefficients, GRID)
    np.testing.assert_allclose(total[jwst_pupil(128) > 0.999], 1.0, atol=0.02)
    assert float(total.max()) < 1.02


def test_a_tip_rises_along_x_and_a_tilt_along_y(segments):
    for k in (0, 3, 8, 15):
        rows, columns = np.nonzero(support(k).numpy() > 0.999)
        tip, tilt = (segments.modes(GRID, 3 * k + j, 3 * k + j + 1)[0].numpy() for j in (1, 2))
        # At coefficient 1 a plane: slope in its own axis, none in the other. "Full" pixels that
        # the outline touches are up to 0.1 % less than full.
        design = np.stack([columns, rows, np.ones_like(rows)], axis=1).astype(float)
        for mode, axis in ((tip, 0), (tilt, 1)):
            slope, residual, *_ = np.linalg.lstsq(design, mode[rows, columns], rcond=None)
            assert slope[axis] > 0.1
            assert abs(slope[1 - axis]) < 1e-4
            assert float(residual[0]) / len(rows) < 1e-6


def test_segments_are_where_the_telescope_has_them(segments):
    """A1 at the top (+V3) and the names in their sequence around the ring."""
    assert segments.names[0].startswith("A1")
    assert segments.names[0].endswith("piston")
    assert segments.names[1].endswith("tip")
    assert segments.names[2].endswith("tilt")
    piston = segments.modes(GRID, 0, 1)[0]
    y = float((piston * GRID.y[:, None]).sum() / piston.sum())
    x = float((piston * GRID.x).sum() / piston.sum())
    assert y == pytest.approx(1.32, abs=0.03)
    assert x == pytest.approx(0.0, abs=0.03)


def test_fourier_modes_are_orthonormal_over_the_array():
    basis = FourierModes(6)
    grid = PupilGrid.full(32)
    modes = basis.modes(grid, 0, len(basis)).flatten(1)
    gram = modes @ modes.T / modes.shape[1]
    torch.testing.assert_close(gram, torch.eye(len(basis), dtype=torch.float64), rtol=0, atol=1e-12)


def test_fourier_modes_are_the_cosines_and_sines_that_they_say():
    basis = FourierModes(4)
    modes = basis.modes(GRID, 0, len(basis))
    x, y = GRID.x[None, :] / GRID.diameter, GRID.y[:, None] / GRID.diameter
    for k, (fx, fy) in enumerate(basis.cycles.tolist()):
        phase = 2 * math.pi * (fx * x + fy * y)
        for mode, wave in ((modes[2 * k], phase.cos()), (modes[2 * k + 1], phase.sin())):
            torch.testing.assert_close(mode, math.sqrt(2) * wave, rtol=0, atol=1e-12)
        assert float(basis.frequencies[2 * k]) == pytest.approx(math.hypot(fx, fy))
        assert basis.frequencies[2 * k] == basis.frequencies[2 * k + 1]


@pytest.mark.parametrize("basis", bases(), ids=lambda b: type(b).__name__)
@pytest.mark.parametrize("grid", [GRID, PupilGrid(128, GRID.diameter, (9, 70), (40, 127))])
def test_the_opd_is_the_sum_of_the_modes(basis, grid):
    generator = torch.Generator().manual_seed(8)
    coefficients = torch.randn(len(basis), dtype=torch.float64, generator=generator)
    modes = basis.modes(grid, 0, len(basis))
    expected = torch.tensordot(coefficients, modes, dims=1)
    torch.testing.assert_close(basis.opd(coefficients, grid), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("basis", bases(), ids=lambda b: type(b).__name__)
def test_modes_in_a_window_are_the_window_of_the_modes(basis):
    window = PupilGrid(128, GRID.diameter, (9, 70), (40, 127))
    whole = basis.modes(GRID, 0, len(basis))[:, 9:70, 40:127]
    modes = basis.modes(window, 0, len(basis))
    if isinstance(basis, FourierModes):
        torch.testing.assert_close(modes, whole, rtol=0, atol=1e-12)
        return
    # Whatever the window, a mode of a segment that it cuts must stay the same mode.
    torch.testing.assert_close(modes, whole, rtol=0, atol=1e-9)


@pytest.mark.parametrize("basis", bases(), ids=lambda b: type(b).__name__)
def test_any_slice_of_the_modes_is_a_slice_of_them_all(basis):
    every = basis.modes(GRID, 0, len(basis))
    for start, stop in ((0, 1), (1, 2), (3, 8), (50, 61), (len(basis) - 3, len(basis))):
        torch.testing.assert_close(
            basis.modes(GRID, start, min(stop, len(basis))), every[start:stop], rtol=0, atol=0
        )


@pytest.mark.parametrize("basis", bases(), ids=lambda b: type(b).__name__)
def test_the_opd_has_the_modes_as_its_derivative(basis):
    grid = PupilGrid.full(24)
    zero = torch.zeros(len(basis), dtype=torch.float64)
    (slope,) = torch.func.jacrev(lambda c: (basis.opd(c, grid),))(zero)
    torch.testing.assert_close(
        slope.movedim(-1, 0), basis.modes(grid, 0, len(basis)), rtol=0, atol=1e-12
    )


def test_a_fine_basis_binned_is_the_coarse_basis(segments):
    coefficients = torch.randn(54, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    fine = segments.opd(coefficients, PupilGrid.full(512))
    binned = fine.reshape(128, 4, 128, 4).mean(dim=(1, 3))
    coarse = segments.opd(coefficients, GRID)
    # Ramps on pixels cut by an edge differ by a fraction of a pixel of the ramp.
    assert float((coarse - binned).abs().max()) < 0.05 * float(coarse.abs().max())
    assert float((coarse - binned).square().mean().sqrt()) < 0.005 * float(coarse.std())


def test_the_joint_basis_keeps_kinds_apart():
    parts = [SegmentMotions(), FourierModes(3)]
    basis = JointBasis(parts)
    assert len(basis) == 54 + len(parts[1])
    assert basis.groups == ("segment", "texture")
    assert basis.group_index.tolist() == [0] * 54 + [1] * len(parts[1])
    assert not basis.frequencies[:54].any()
    torch.testing.assert_close(basis.frequencies[54:], parts[1].frequencies)


@pytest.mark.parametrize("npix", [64, 256])
def test_the_aperture_tells_jwst_from_other_telescopes(npix):
    for options in ({}, {"pupil": "flight"}, {"segment_gap": 0.03}):
        assert is_jwst_pupil(jwst_pupil(npix, **options) > 0, JWST_DIAMETER)
    padded = torch.nn.functional.pad(jwst_pupil(npix) > 0, (npix // 4,) * 4)
    assert is_jwst_pupil(padded, 1.5 * JWST_DIAMETER)
    for side in (2.4, JWST_DIAMETER, 8.0):
        grid = PupilGrid.full(npix, side)
        radius = torch.hypot(grid.x, grid.y[:, None])
        for outer in np.arange(1.2, side / 2, 0.2):
            for inner in (0.0, 0.2, 0.3):
                disc = (radius < outer) & (radius >= inner * outer)
                assert not is_jwst_pupil(disc, side)
