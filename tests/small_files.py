"""Small calibrated files, with headers as the JWST pipeline writes them."""

import numpy as np
from astropy.io import fits

AREA = 0.00396
"""arcsec^2 of a pixel."""

PRIMARY = {"FILTER": "F444W", "DATE-BEG": "2022-07-30T02:03:04.5", "INSTRUME": "NIRCAM"}
SCIENCE = {
    "BUNIT": "MJy/sr", "PIXAR_A2": AREA, "CRPIX1": 6.0, "CRPIX2": 5.0, "ROLL_REF": 100.0,
    "V3I_YANG": -0.5, "VPARITY": -1,
}  # fmt: skip


def calints(path, data, error=None, quality=None, *, leave_out=(), primary=None, **science):
    """Write SCI, ERR and DQ but for those left out; cards that are None are not there."""
    error = np.ones_like(data) if error is None else error
    quality = np.zeros(data.shape, dtype=np.uint32) if quality is None else quality
    hdus = [fits.PrimaryHDU()]
    for name, array in (("SCI", data), ("ERR", error), ("DQ", quality)):
        if name not in leave_out:
            hdus.append(fits.ImageHDU(array, name=name))
    headers = ({**PRIMARY, **(primary or {})}, {**SCIENCE, **science})
    for hdu, cards in zip(hdus, headers, strict=False):
        hdu.header.update({key: value for key, value in cards.items() if value is not None})
    fits.HDUList(hdus).writeto(path)
    return path
