"""Settings for real NIRCam frames, where the model is not the telescope.

What each buys on frames of HIP 65426 is in the documentation, page "Real frames".
"""

from __future__ import annotations

from typing import Any

from pyklip_diffrender.instrument.nircam import SIAF_PIXELSCALE, SIAF_SHEAR
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["NIRCAM_FIT", "NIRCAM_MODEL"]

NIRCAM_MODEL: dict[str, Any] = {
    "nlambda": 7,
    "npix": 256,
    "occulter_sampling": 2.0,
    "pixelscale": SIAF_PIXELSCALE,
    "shear": SIAF_SHEAR,
}
"""Arguments of `nircam_coronagraph`. The pupil grid is coarse: its error, 2 % of the image, is
static, and the fit absorbs it (256 and 512 samples left the same residual)."""

NIRCAM_FIT: dict[str, Any] = {
    "free": (
        "star_offset",
        "lyot_shift",
        "lyot_rotation",
        "detector_shift",
        "blur",
        "si_zernikes",
        "flux",
        "background",
    ),
    # Pixel and charge diffusion (0.29 pixel each) make 0.42 pixel together.
    "start": {"blur": 0.026},
    "prior": WavefrontPrior(
        scales={"segment": 20.0, "texture": 18.0},
        knee=1.0,
        slope=1.0,
        fit_scales=False,
        amplitude_cycles=24.0,
        amplitude_scale=3.2,
        amplitude_slope=0.5,
    ),
    "companions": 1,
    "companion_threshold": 3.0,
    "robust": 3.0,
    "kappa_floor": 0.01,
    "max_iterations": 40,
    "relinearise": 0.3,
    "tolerance": 5e-4,
}
"""Arguments of `refine`. One percent of the star stays as model error; a companion as bright as
the speckles gets parameters of its own; pixels that no model explains lose their weight."""
