"""Set-ups in which images are compared with those of stpsf, for `parity` and the tests."""

from functools import cache

import numpy as np

from benchmarks.stpsf_data import nircam
from pyklip_diffrender.bridges import from_webbpsf
from pyklip_diffrender.instrument import FLIGHT_ALIGNMENT
from pyklip_diffrender.instrument.nircam import nircam_coronagraph

CALL = {"monochromatic": 4.5e-6, "fft_oversample": 4, "detector_oversample": 2, "fov_pixels": 80}
FULL = {"fft_oversample": 2, "detector_oversample": 1, "fov_pixels": 80}
BARE = {"nd_squares": False}

# A wavelength of a filter, and that at which stpsf has no wedge tilt.
WAVES = {"F444W": (4.5e-6, 3.35e-6)}
# Mask and filter; stpsf's options, ours, and the limit on the mean difference in units of the mean
# light there.
EMBEDDED = {
    "MASK335R": ("MASK335R", "F444W", {}, {}, 5e-3),
    # Published for stpsf's options; poppy cuts the shifts to 13 and 7 samples.
    "flight alignment": (
        "MASK335R", "F444W",
        {"pupil_shift_x": -0.01347, "pupil_shift_y": -0.00762, "pupil_rotation": -0.567},
        {"defaults": FLIGHT_ALIGNMENT}, 5e-3,
    ),
    # The table's row, against what stpsf interpolates between field points: 5 nm of astigmatism.
    "embedded aberrations": ("MASK335R", "F444W", {}, {"si_wfe": True}, 0.01),
}  # fmt: skip


OFFSET = (0.05, -0.03)
"""Of the star from the mask, arcsec."""


@cache
def by_stpsf(official, case):
    """Image, OPD, and the Zernike coefficients of the instrument."""
    mask, band, options, _, _ = EMBEDDED[case]
    offset = dict(zip(("source_offset_x", "source_offset_y"), OFFSET, strict=True))
    options = {**BARE, "jitter": None, **offset, **options}
    instrument = nircam(official, npix=1024, band=band, image_mask=mask, **options)
    call = {**FULL, "monochromatic": WAVES[band][0]}
    image = instrument.calc_psf(**call, add_distortion=False)[1].data
    opd = from_webbpsf(instrument, **call).entrance.opd
    return image, opd, instrument._get_aberrations().zernike_coeffs


def differences(official, case, wrong):
    """Mean difference between the embedded coronagraph and stpsf, and the mean light, in rings."""
    mask, band, _, ours, _ = EMBEDDED[case]
    wavelength, tilt_free = WAVES[band]
    truth, opd, aberrations = by_stpsf(official, case)
    settings = {"image_mask": mask, "si_wfe": aberrations, "chromatic_reference": tilt_free}
    model = nircam_coronagraph(band, monochromatic=wavelength, **{**settings, **ours, **wrong})
    error = np.abs(model(opd, OFFSET).numpy() - truth)
    radius = np.hypot(*(np.mgrid[:80, :80] - 39.5))
    rings = [(a <= radius) & (radius < b) for a, b in ((0, 5), (5, 11), (11, 19), (19, 38))]
    return [float(error[ring].mean() / truth[ring].mean()) for ring in rings]
