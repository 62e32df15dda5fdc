"""Figures of arrays, in one style. The only package that imports matplotlib, when it draws.

It knows no class of the package: the `plot` methods, the report and the demo pass arrays. The
colour maps can be distinguished by readers with colour vision deficiencies.
"""

from pyklip_diffrender.drawing.curves import (
    completeness,
    contrast_curve,
    injected_planets,
    survey_limits,
)
from pyklip_diffrender.drawing.figures import (
    axes_for,
    halo,
    new_figure,
    on_sky,
    panel,
    save,
    to_png,
    unit_label,
    wide_panel,
)
from pyklip_diffrender.drawing.images import (
    SNR_LINEAR,
    Epoch,
    Stamp,
    light_norm,
    opd_map,
    pupil_image,
    signed_image,
    sky_track,
    snr_map,
    stamp_panels,
    star_image,
)

__all__ = [
    "SNR_LINEAR",
    "Epoch",
    "Stamp",
    "axes_for",
    "completeness",
    "contrast_curve",
    "halo",
    "injected_planets",
    "light_norm",
    "new_figure",
    "on_sky",
    "opd_map",
    "panel",
    "pupil_image",
    "save",
    "signed_image",
    "sky_track",
    "snr_map",
    "stamp_panels",
    "star_image",
    "survey_limits",
    "to_png",
    "unit_label",
    "wide_panel",
]
