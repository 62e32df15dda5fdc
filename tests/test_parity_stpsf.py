"""Parity with stpsf at 256 samples across the pupil; `benchmarks/parity.py` has 1024."""

import numpy as np
import pytest
import torch

from benchmarks.parity_cases import BARE, CALL, EMBEDDED, FULL, differences
from benchmarks.stpsf_data import lyot_stop, nircam
from pyklip_diffrender.bridges import from_webbpsf
from pyklip_diffrender.instrument import detector_place
from pyklip_diffrender.instrument.masks import MASKS, BarMask, lyot_openings
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.optics.grid import JWST_DIAMETER
from pyklip_diffrender.optics.planes import LyotStop

NPIX = 256
SHORT = {"monochromatic": 2.0e-6}

ALIGNED = {
    "pupil_shift_x": 0.012, "pupil_shift_y": -0.02, "pupil_rotation": 1.3,
    "source_offset_x": 0.02, "source_offset_y": 0.01,
}  # fmt: skip
# Several options at once, which all have to be right. All but the first need ``--full``.
CASES = {
    "on axis": (BARE, {}),
    "F335M, 3 wavelengths, everything moved": (
        {**ALIGNED, "band": "F335M", "coron_shift_x": 0.3, "coron_shift_y": -0.2},
        {"monochromatic": None, "nlambda": 3},
    ),
    "2 arcsec, jitter and diffusion": (
        {"source_offset_r": 2.0, "source_offset_theta": 50.0, "jitter_sigma": 0.03,
         "charge_diffusion_sigma": 0.02, **BARE},
        {"fov_pixels": (60, 40), "detector_oversample": 3},
    ),
    "MASK430R, module B, no jitter, no IPC, no diffusion": (
        {"image_mask": "MASK430R", "aperture": "NRCB5_MASK430R", "jitter": None, "add_ipc": False,
         "charge_diffusion_sigma": 0}, {},
    ),
    "MASK210R, long wave": (
        {"image_mask": "MASK210R", "aperture": "NRCA5_FULL_MASK210R", "source_offset_x": 0.3}, {},
    ),
    "MASK335R, short wave, stop moved": (
        {"band": "F200W", "aperture": "NRCA2_FULL_MASK335R", **ALIGNED}, SHORT,
    ),
    "MASKLWB": ({"image_mask": "MASKLWB", "pupil_mask": "MASKLWB"}, {}),
    "MASKSWB, module B": (
        {"image_mask": "MASKSWB", "pupil_mask": "MASKSWB", "band": "F200W",
         "aperture": "NRCB3_MASKSWB"}, SHORT,
    ),
    "no occulter": ({"image_mask": None}, {}),
    "no Lyot stop": ({"pupil_mask": None}, {}),
}  # fmt: skip


@pytest.mark.parametrize(
    "case", ["on axis", *(pytest.param(each, marks=pytest.mark.slow) for each in list(CASES)[1:])]
)
def test_images_agree_to_rounding(stpsf_path, case):
    """Much closer than required: both sample the same points, of however fine a transform."""
    options, changes = CASES[case]
    instrument = nircam(stpsf_path, **options)
    call = {**CALL, "fft_oversample": 2, **changes}
    truth = instrument.calc_psf(**call)
    model = from_webbpsf(instrument, **call)
    psf = model.calc_psf()
    assert set(model.propagation.values()) <= {"compact"}
    for mine, theirs in zip(psf, truth, strict=True):
        assert np.abs(mine.data - theirs.data).max() <= 1e-11 * theirs.data.max()
    image = from_webbpsf(instrument, add_distortion=True, **call)().numpy()
    assert np.abs(image - truth["DET_DIST"].data).max() <= 1e-11 * truth["DET_DIST"].data.max()


def test_the_stop_moves_and_turns_as_in_stpsf(stpsf_path):
    """Shifts of whole samples, for poppy cuts the rest off; y and the rotation change sign."""
    shift, angle = (-5 / NPIX, 3 / NPIX), 1.5
    options = {"pupil_shift_x": shift[0], "pupil_shift_y": -shift[1], "pupil_rotation": -angle}
    call = {**CALL, "fft_oversample": 2, "detector_oversample": 1}
    model = from_webbpsf(nircam(stpsf_path, **BARE), **call)
    truth = nircam(stpsf_path, **BARE, **options).calc_psf(**call)[1].data
    # The synthetic stop lacks the first opening.
    openings = lyot_openings("MASKRND")[1:]
    stop = LyotStop(openings, NPIX, JWST_DIAMETER, torch.float64, torch.device("cpu"))
    assert np.abs(stop.amplitude({}).numpy().sum() - lyot_stop(NPIX).sum()) < 1e-9
    planes = [stop if plane.name == "MASKRND" else plane for plane in model.between]
    system = OpticalSystem(model.entrance, planes, model.detector, model.bandpass)

    def away(x, y, turn):
        image = system(lyot_shift=(x * shift[0], y * shift[1]), lyot_rotation=turn * angle)
        return float(np.abs(image.numpy() - truth).max() / truth.max())

    # scipy's cubic rotation of 256 samples, against polygons.
    assert away(1, 1, 1) < 0.01
    assert min(away(-1, 1, 1), away(1, -1, 1), away(1, 1, -1), away(0, 0, 0)) > 0.1


@pytest.fixture
def official(official_files, monkeypatch):
    """STScI's files, as STPSF_PATH."""
    monkeypatch.setenv("STPSF_PATH", str(official_files))
    return official_files


# Every mask in both channels: stpsf's apertures by filter.
PLACES = {
    "F200W": (
        "NRCA2_FULL_MASK210R", "NRCA2_FULL_MASK335R", "NRCA2_FULL_MASK430R",
        "NRCA4_FULL_MASKLWB_F444W", "NRCA4_FULL_MASKSWB_F200W",
    ),
    "F335M": ("NRCA5_FULL_MASKLWB_NARROW",),
    "F444W": (
        "NRCA5_FULL_MASK210R", "NRCA5_FULL_MASK335R", "NRCA5_FULL_MASK430R",
        "NRCA5_FULL_MASKLWB_F444W", "NRCA5_FULL_MASKSWB_F200W",
    ),
}  # fmt: skip


def mask_and_place(aperture):
    """The mask of an aperture, and the place along a bar; None if it does not name one."""
    return (*aperture.replace("_FULL", "").split("_")[1:], None)[:2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("aperture", "band", "wavelength"),
    [
        ("NRCA5_FULL_MASK335R", "F444W", 4.5e-6), ("NRCA4_FULL_MASKSWB_F200W", "F200W", 2.0e-6),
        ("NRCA5_FULL_MASKLWB_F444W", "F444W", 4.5e-6),
    ],
)  # fmt: skip
def test_the_embedded_occulter_is_that_of_stpsf(stpsf_path, aperture, band, wavelength):
    """For a star off the axis, everything else being stpsf's, cells of 1/4 lambda/D in both."""
    # The ends of a bar are sharp, and stpsf's FFT has its points half a cell elsewhere. A bar that
    # was mirrored, or 0.1 arcsec away, would change more than a percent.
    mask, place = mask_and_place(aperture)
    call = {**FULL, "fft_oversample": 4, "fov_pixels": 60, "monochromatic": wavelength}
    embedded = nircam_coronagraph(
        band, image_mask=mask, bar_place=place, npix=NPIX, occulter_sampling=4,
        route="planes",
    )  # fmt: skip
    options = {**BARE, "source_offset_x": 0.35, "source_offset_y": -0.2}
    instrument = nircam(stpsf_path, band=band, image_mask=mask, aperture=aperture, **options)
    truth = instrument.calc_psf(**call)[1].data
    model = from_webbpsf(instrument, **call)
    assert embedded.detector.pixelscale == pytest.approx(model.detector.pixelscale, abs=1e-9)
    planes = [embedded.between[0] if plane.name == mask else plane for plane in model.between]
    assert embedded.between[0] in planes
    system = OpticalSystem(model.entrance, planes, model.detector, model.bandpass)
    image = system().numpy()  # The star is where stpsf has it, as part of the entrance.
    limit = 1e-3 if mask.endswith("WB") else 1e-8
    assert np.abs(image - truth).max() <= limit * truth.max()


@pytest.mark.parametrize(
    ("band", "aperture"), [(band, each) for band, names in PLACES.items() for each in names]
)
def test_the_embedded_transmission_is_that_of_stpsf(stpsf_path, band, aperture):
    """Point by point, to the rounding of tabulated places along the bars."""
    from stpsf.optics import NIRCam_BandLimitedCoron

    mask, along = mask_and_place(aperture)
    place = detector_place(mask, band, along)
    ours = MASKS[mask]
    options = {}
    if isinstance(ours, BarMask):
        ours = ours.at(place.offset)
        options["auto_offset"] = "narrow" if along == "NARROW" else along
    theirs = NIRCam_BandLimitedCoron(name=mask, module="A", nd_squares=False, **options)
    truth = theirs.sample(npix=401, grid_size=24, what="amplitude")
    axis = (torch.arange(401, dtype=torch.float64) - 200) * 24 / 401
    mine = 1 - ours.complement(axis[None, :], axis[:, None]).numpy()
    assert truth.min() < 1e-3
    assert np.abs(mine - truth).max() <= (1e-14 if ours.stop == "MASKRND" else 1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("case", EMBEDDED)
def test_the_embedded_coronagraph_is_that_of_the_official_files(official, case):
    """What is left: the outlines of pupil (0.2 %) and stop (0.1 %), and poppy's Zernike circle."""
    assert max(differences(official, case, {})) < EMBEDDED[case][-1]
