"""Wavefront modes: their size, place and orientation, and that sums and windows agree."""

import math

import numpy as np
import pytest
import torch

from pyklip_diffrender.instrument.masks import (
    TABULATED_GAP,
    is_jwst_pupil,
    jwst_pupil,
    jwst_segments,
)
from pyklip_diffrender.optics.grid import JWST_DIAMETER, PupilGrid, polygon_coverage, widen_polygon
from pyklip_diffrender.wavefront.bases import (
    FourierModes,
    JointBasis,
    SegmentMotions,
    coefficients_of,
)

GRID = PupilGrid.full(128)
SEGMENTS = SegmentMotions()
TEXTURE = FourierModes(5)
JOINT = JointBasis([SEGMENTS, TEXTURE])


def support(k):
    """Share of every pixel that lies on a segment, half the gaps around it included."""
    outline = list(jwst_segments().values())[k]
    return polygon_coverage([widen_polygon(outline, TABULATED_GAP / 2)], GRID)


def test_segment_modes_have_unit_rms_on_their_segment_and_tilts_no_piston():
    modes = SEGMENTS.modes(GRID, 0, len(SEGMENTS))
    assert modes.shape == (54, 128, 128)
    for k in range(18):
        cover = support(k)
        inside = cover > 0
        for mode in modes[3 * k : 3 * k + 3]:
            shape = torch.where(inside, mode / cover.clamp(min=1e-12), 0.0)
            rms = torch.sqrt((cover * shape**2).sum() / cover.sum())
            assert float(rms) == pytest.approx(1.0, rel=1e-9)
            assert not mode[~inside].any()
        for mode in modes[3 * k + 1 : 3 * k + 3]:
            assert abs(float(mode.sum() / mode.abs().sum())) < 1e-12


def test_all_pistons_together_fill_the_pupil():
    """No point of the pupil, gaps included, is left out or moved twice."""
    coefficients = torch.zeros(54, dtype=torch.float64)
    coefficients[0::3] = 1.0
    total = SEGMENTS.opd(coefficients, GRID)
    np.testing.assert_allclose(total[jwst_pupil(128) > 0.999], 1.0, atol=0.02)
    assert float(total.max()) < 1.02


@pytest.mark.parametrize("k", [0, 8, 15])
def test_a_tip_rises_along_x_and_a_tilt_along_y(k):
    """A plane: slope in its own axis, none in the other."""
    rows, columns = np.nonzero(support(k).numpy() > 0.999)
    modes = SEGMENTS.modes(GRID, 3 * k + 1, 3 * k + 3).numpy()
    # "Full" pixels that the outline touches are up to 0.1 % less than full.
    design = np.stack([columns, rows, np.ones_like(rows)], axis=1).astype(float)
    for axis, mode in enumerate(modes):
        slope, residual, *_ = np.linalg.lstsq(design, mode[rows, columns], rcond=None)
        assert slope[axis] > 0.1
        assert abs(slope[1 - axis]) < 1e-4
        assert float(residual[0]) / len(rows) < 1e-6


def test_segments_are_where_the_telescope_has_them():
    """A1 is at the top (+V3)."""
    assert next(iter(jwst_segments())).startswith("A1")
    piston = SEGMENTS.modes(GRID, 0, 1)[0]
    y = float((piston * GRID.y[:, None]).sum() / piston.sum())
    x = float((piston * GRID.x).sum() / piston.sum())
    assert (x, y) == pytest.approx((0.0, 1.32), abs=0.03)


def test_fourier_modes_are_the_cosines_and_sines_that_they_say():
    modes = TEXTURE.modes(GRID, 0, len(TEXTURE))
    x, y = GRID.x[None, :] / GRID.diameter, GRID.y[:, None] / GRID.diameter
    for k, (fx, fy) in enumerate(TEXTURE.cycles.tolist()):
        phase = 2 * math.pi * (fx * x + fy * y)
        for mode, wave in ((modes[2 * k], phase.cos()), (modes[2 * k + 1], phase.sin())):
            torch.testing.assert_close(mode, math.sqrt(2) * wave, rtol=0, atol=1e-12)
        assert (
            TEXTURE.frequencies[2 * k : 2 * k + 2].tolist() == [pytest.approx(np.hypot(fx, fy))] * 2
        )


def test_the_opd_is_the_sum_of_the_modes_in_any_window_and_slice():
    """Of both kinds of mode; whatever the window, a mode of a segment that it cuts is the same."""
    window = PupilGrid(128, GRID.diameter, (9, 70), (40, 127))
    generator = torch.Generator().manual_seed(8)
    coefficients = torch.randn(len(JOINT), dtype=torch.float64, generator=generator)
    coefficients.requires_grad_()
    weight = torch.randn(window.shape, dtype=torch.float64, generator=generator)
    whole = JOINT.modes(GRID, 0, len(JOINT))
    modes = JOINT.modes(window, 0, len(JOINT))
    torch.testing.assert_close(modes, whole[:, 9:70, 40:127], rtol=0, atol=1e-12)
    expected = torch.tensordot(coefficients, modes, dims=1)
    opd = JOINT.opd(coefficients, window)
    torch.testing.assert_close(opd, expected, rtol=0, atol=1e-11)
    (slope,) = torch.autograd.grad((weight * opd).sum(), coefficients)
    torch.testing.assert_close(slope, (weight * modes).sum(dim=(1, 2)), rtol=0, atol=1e-9)
    for start, stop in ((0, 1), (1, 2), (3, 8), (50, 61), (len(JOINT) - 3, len(JOINT))):
        assert torch.equal(JOINT.modes(window, start, stop), modes[start:stop])


def test_coefficients_of_maps_make_these_maps_on_the_mirror():
    """As nearly as the ridge leaves them."""
    rng = np.random.default_rng(5)
    true = torch.from_numpy(rng.normal(size=(2, len(JOINT))))
    lit = SEGMENTS.modes(GRID, 0, len(SEGMENTS)).abs().sum(dim=0) > 0
    maps = torch.stack([torch.where(lit, JOINT.opd(each, GRID), 0.0) for each in true])
    fitted = coefficients_of(maps, JOINT, GRID)
    for found, opd in zip(fitted, maps, strict=True):
        residual = (JOINT.opd(found, GRID) - opd)[lit]
        assert float(residual.norm() / opd[lit].norm()) < 0.02
    # A segment without a map has no motions.
    maps[:, support(4) > 0] = 0.0
    alone = coefficients_of(maps, SEGMENTS, GRID)
    assert not alone[:, 12:15].any()
    assert alone[:, :12].all()


def test_the_joint_basis_keeps_kinds_apart():
    assert JOINT.groups == ("segment", "texture")
    assert JOINT.group_index.tolist() == [0] * 54 + [1] * len(TEXTURE)
    assert not JOINT.frequencies[:54].any()
    torch.testing.assert_close(JOINT.frequencies[54:], TEXTURE.frequencies)


def test_the_aperture_tells_jwst_from_other_telescopes():
    npix = 64
    for options in ({}, {"segment_gap": 0.03}):
        assert is_jwst_pupil(jwst_pupil(npix, **options) > 0, JWST_DIAMETER)
    padded = torch.nn.functional.pad(jwst_pupil(npix) > 0, (npix // 4,) * 4)
    assert is_jwst_pupil(padded, 1.5 * JWST_DIAMETER)
    for side in (2.4, JWST_DIAMETER, 8.0):
        grid = PupilGrid.full(npix, side)
        radius = torch.hypot(grid.x, grid.y[:, None])
        for outer in np.arange(1.2, side / 2, 0.4):
            for inner in (0.0, 0.2, 0.3):
                disc = (radius < outer) & (radius >= inner * outer)
                assert not is_jwst_pupil(disc, side)
