"""The table of parity with stpsf, at 256 samples across the pupil.

`tests/benchmarks/parity.py` measures the same at 1024 and writes docs/parity.md.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pyklip_diffrender.bridges import from_webbpsf

NPIX = 256
CALL = {
    "monochromatic": 4.5e-6,
    "fft_oversample": 8,
    "detector_oversample": 2,
    "fov_pixels": 80,
}
BROAD = {"monochromatic": None, "nlambda": 9, "fft_oversample": 4}
SHORT = {"monochromatic": 2.0e-6}
BARE = {"nd_squares": False}

CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "on axis": (BARE, {}),
    "0.6 arcsec": ({**BARE, "source_offset_x": 0.5, "source_offset_y": -0.33}, {}),
    "2 arcsec": ({**BARE, "source_offset_r": 2.0, "source_offset_theta": 50.0}, {}),
    "ND squares": ({}, {}),
    "ND squares, 0.6 arcsec": ({"source_offset_x": -0.2, "source_offset_y": 0.57}, {}),
    "F444W, 9 wavelengths": (BARE, BROAD),
    "F335M, 9 wavelengths": ({**BARE, "band": "F335M"}, BROAD),
    "pupil shift, rotation, offset": (
        {
            "pupil_shift_x": 0.012,
            "pupil_shift_y": -0.02,
            "pupil_rotation": 1.3,
            "source_offset_x": 0.02,
            "source_offset_y": 0.01,
        },
        {},
    ),
    "shifted occulter": ({"coron_shift_x": 0.3, "coron_shift_y": -0.2}, {}),
    "jitter and diffusion": (
        {"jitter_sigma": 0.03, "charge_diffusion_sigma": 0.02},
        {"fov_pixels": (60, 40), "detector_oversample": 3},
    ),
    "no jitter, no IPC, no diffusion": (
        {"jitter": None, "add_ipc": False, "charge_diffusion_sigma": 0},
        {},
    ),
    "MASK430R": ({"image_mask": "MASK430R"}, {}),
    "MASK210R": ({"image_mask": "MASK210R", "band": "F200W"}, SHORT),
    "MASKLWB": ({"image_mask": "MASKLWB", "pupil_mask": "MASKLWB"}, {}),
    "MASKSWB": ({"image_mask": "MASKSWB", "pupil_mask": "MASKSWB", "band": "F200W"}, SHORT),
    "no occulter": ({"image_mask": None}, {}),
    "no Lyot stop": ({"pupil_mask": None}, {}),
}
QUICK = ("on axis", "ND squares, 0.6 arcsec", "jitter and diffusion", "no Lyot stop")
"""The others need ``--full``."""


def nircam(
    folder: Path,
    npix: int = NPIX,
    band: str = "F444W",
    image_mask: str | None = "MASK335R",
    pupil_mask: str | None = "MASKRND",
    **options: Any,
) -> Any:
    """A configured stpsf.NIRCam."""
    import stpsf

    instrument = stpsf.NIRCam()
    instrument.filter = band
    instrument.image_mask, instrument.pupil_mask = image_mask, pupil_mask
    instrument.pupil = str(folder / f"jwst_pupil_RevW_npix{npix}.fits.gz")
    instrument.options.update(options)
    return instrument


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES],
)
def test_images_agree_to_rounding(stpsf_path: Path, case: str) -> None:
    """Much closer than required: both sample the same points."""
    options, changes = CASES[case]
    instrument, call = nircam(stpsf_path, **options), {**CALL, **changes}
    truth = instrument.calc_psf(**call)
    model = from_webbpsf(instrument, **call)
    psf = model.calc_psf()
    assert set(model.propagation.values()) <= {"compact"}
    for mine, theirs in zip(psf, truth, strict=True):
        assert np.abs(mine.data - theirs.data).max() <= 1e-11 * theirs.data.max()
    for distorted, name in ((False, "DET_SAMP"), (True, "DET_DIST")):
        image = from_webbpsf(instrument, add_distortion=distorted, **call)().numpy()
        assert np.abs(image - truth[name].data).max() <= 1e-11 * truth[name].data.max()


def test_the_default_sampling_is_good_enough(stpsf_path: Path) -> None:
    """4 points per lambda/D against stpsf at 8: what a user of either sees."""
    call = {**CALL, "fov_pixels": 60}
    for options in (BARE, {}):
        instrument = nircam(stpsf_path, **options)
        truth = instrument.calc_psf(**call)[1].data
        image = from_webbpsf(instrument, **{**call, "fft_oversample": 4})().numpy()
        assert np.abs(image - truth).max() <= (1e-7 if options else 1e-3) * truth.max()


@pytest.mark.parametrize("propagation", ["compact", "fft"])
def test_either_propagation(stpsf_path: Path, propagation: str) -> None:
    instrument = nircam(stpsf_path)
    call = {**CALL, "fft_oversample": 4, "detector_oversample": 1}
    truth = instrument.calc_psf(**call)[0].data
    model = from_webbpsf(instrument, propagation=propagation, **call)
    assert model.propagation == {"MASK335R": propagation}
    assert np.linalg.norm(model().numpy() - truth) <= 1e-12 * np.linalg.norm(truth)


TURNS: dict[str, Callable[[Any], Any]] = {
    "flipped in x": lambda a: a.flip(-1),
    "flipped in y": lambda a: a.flip(-2),
    "transposed": lambda a: a.mT,
    "nothing": lambda a: 0 * a,
}


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
def test_the_table_would_notice(stpsf_path: Path, turn: Callable[[Any], Any]) -> None:
    """Neither the OPD nor the image has a symmetry that would let an error pass."""
    instrument = nircam(stpsf_path)
    call = {**CALL, "fft_oversample": 2, "detector_oversample": 1}
    model = from_webbpsf(instrument, **call)
    truth = instrument.calc_psf(**call)[1].data
    for image in (turn(model()), model(turn(model.entrance.opd))):
        assert np.abs(image.numpy() - truth).max() > 1e-3 * truth.max()
