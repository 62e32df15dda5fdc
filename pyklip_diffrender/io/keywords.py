"""The package's own FITS keywords: one declaration of their names, comments and meanings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from astropy import units as u
from astropy.io import fits

from pyklip_diffrender.io.headers import fits_text

__all__ = ["KEYWORDS", "Keyword", "fits_unit", "set_keyword"]

_PIPELINE = u.MJy / u.sr


@dataclass(frozen=True)
class Keyword:
    """A keyword of products.

    Attributes
    ----------
    name : str
    comment : str
        Comment of the card; empty where the value leaves no room for one.
    files : str
        "reduce" for files of reductions, fits and searches, "pyKLIP" for products of
        ``algo="diffrender"``, "psf" for rendered images; several are separated by commas.
    meaning : str
        What the comment leaves out, for the documentation.
    """

    name: str
    comment: str
    files: str
    meaning: str = ""


_DECLARED = (
    Keyword("DRVERS", "version of pyklip_diffrender", "reduce, pyKLIP, psf"),
    Keyword("DRALGO", "star subtraction algorithm", "pyKLIP", "Always `diffrender`."),
    Keyword("DRIMAGE", "image in the products", "pyKLIP",
            "`cleaned`, `flux` or `subtracted`, see `DiffrenderSettings.image`."),
    Keyword("DRSTAT", "how the refinement ended", "reduce, pyKLIP",
            "Name of a `Status`, such as `CONVERGED`; of several fits, that of the one with the "
            "largest chi-squared."),
    Keyword("DRCHI2", "chi-squared per fitted pixel", "reduce, pyKLIP",
            "Of several fits, the largest."),
    Keyword("DRMODERR", "model error, fraction of the star", "reduce",
            "0 where the model explains the data."),
    Keyword("DRERRFAC", "median factor of the errors", "reduce",
            "Errors in the file include the factor."),
    Keyword("DRTHRESH", "smallest S/N of a candidate", "reduce"),
    Keyword("DRSTARJY", "[Jy] flux density of the star", "reduce",
            "In the filter, as contrasts refer to it."),
    Keyword("DRNFRAME", "number of fitted frames", "reduce"),
    Keyword("DRNFIT", "number of refinements", "pyKLIP"),
    Keyword("DRPIXELS", "pixels that were fitted", "pyKLIP"),
    Keyword("DRGAIN", "decrease of chi-squared by a disk", "reduce"),
    Keyword("DRFILLED", "flagged pixels replaced by neighbours", "pyKLIP"),
    Keyword("DRNOISE", "where the errors came from", "pyKLIP"),
    Keyword("DRKEPT", "companions in the model of the star", "pyKLIP",
            "Of several fits, the largest number. Their light is not subtracted."),
    Keyword("DRSECS", "[s] duration of the refinement", "reduce"),
    Keyword("DRFILT", "filter of the model", "pyKLIP"),
    Keyword("DROPD", "wavefront map at the start", "reduce, pyKLIP",
            "Name of its file, or `flat wavefront`."),
    Keyword("DRSHA256", "", "reduce, pyKLIP",
            "SHA-256 of the file of the wavefront map, or of its array."),
    Keyword("DROPDDAT", "date of the wavefront map", "pyKLIP", "Only for maps with a date."),
    Keyword("DROPDHRS", "[h] from the frames to the map", "pyKLIP",
            "From their mean date; negative for an earlier map."),
    Keyword("DRSYST", "flat-field pattern", "reduce, pyKLIP",
            "Its name, which lists the stars that it was learned from, or `none`."),
    Keyword("DRREFS", "reference frames that were used", "pyKLIP"),
    Keyword("DRTHRU", "median throughput of faint sources", "pyKLIP",
            "Median of `-throughput.fits` over the fitted pixels."),
    Keyword("DRTHSTEP", "pixels between computed positions", "pyKLIP", "Of `-throughput.fits`."),
    Keyword("DRFMFLUX", "fitted flux over that of the forward model", "pyKLIP",
            "Of forward models, as all keywords that begin with DRFM."),
    Keyword("DRFMFERR", "standard deviation of DRFMFLUX", "pyKLIP"),
    Keyword("DRFMFACT", "included factor for errors that are too small", "pyKLIP"),
    Keyword("DRFMRA", "[pixel] fitted position east of the star", "pyKLIP"),
    Keyword("DRFMRAER", "[pixel] standard deviation of DRFMRA", "pyKLIP"),
    Keyword("DRFMDE", "[pixel] fitted position north of the star", "pyKLIP"),
    Keyword("DRFMDEER", "[pixel] standard deviation of DRFMDE", "pyKLIP"),
    Keyword("DRPROP", "propagation through image planes", "psf"),
    Keyword("DRPREC", "floating point precision", "psf"),
    Keyword("DRSIFLIP", "SI WFE map flipped vertically", "psf", "As in stpsf from 2.2.0 on."),
)  # fmt: skip

KEYWORDS = {each.name: each for each in _DECLARED}
"""The keywords by name, in the order of the documentation."""


def set_keyword(header: fits.Header, name: str, value: Any) -> None:
    """Set one of the package's keywords, with its comment.

    Parameters
    ----------
    header : Header
        Changed.
    name : str
    value : str, bool, int or float
        Numbers that are not finite, which FITS headers cannot have, are written as text.

    Raises
    ------
    KeyError
        For a keyword that is not declared.
    """
    comment = KEYWORDS[name].comment
    if isinstance(value, float) and not math.isfinite(value):
        value = str(value)
    value = fits_text(value) if isinstance(value, str) else value
    # A value may fill the whole card.
    header[name] = (value, comment) if comment else value


def fits_unit(unit: u.UnitBase) -> str:
    """A unit for BUNIT, as JWST's pipeline spells its own.

    Examples
    --------
    >>> from astropy import units as u
    >>> fits_unit(u.Unit("MJy sr-1"))
    'MJy/sr'
    >>> fits_unit(u.adu / u.s)
    'adu s-1'
    """
    if unit == _PIPELINE:
        return "MJy/sr"
    try:
        return str(unit.to_string("fits"))
    except ValueError:  # The standard does not know electrons, which frames may be in.
        return str(unit.to_string())
