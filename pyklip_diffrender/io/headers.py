"""FITS headers: values and names read with checks, and the package's own keywords."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from typing import Any

from astropy import units as u
from astropy.io import fits
from astropy.time import Time

from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError

# Names of stars and filters, which archives and observers spell differently.

_SIMBAD = re.compile(r"(V|NAME|\*+)?\*?[\s_-]+", re.IGNORECASE)
"""Prefixes of names in SIMBAD, and of observers after it: V* AU Mic, V-AU-MIC, * bet Pic."""


_SIGN = re.compile(r"\+(?=\s*\d)")
"""A plus sign before digits, which belongs to the name: BD+20 1790 is not BD-20 1790."""


def same_name(first: str | None, second: str | None) -> bool:
    """Whether two names differ only in case, separators and SIMBAD's marks before the name.

    "V* AU Mic" is "au-mic". A plus sign before digits counts: "BD+20-1790" is not "BD-20-1790". A
    minus sign cannot be told from a dash.
    """
    names = [str(each) for each in (first, second)]
    return _plain(names[0]) == _plain(names[1]) or _bare(names[0]) == _bare(names[1])


def unknown_name(key: str, choice: str, names: Iterable[str | None]) -> IncompatibleSetupError:
    """Error for a name that is not among the known names."""
    known = sorted({str(name) for name in names})
    return IncompatibleSetupError(
        f"{key}: got {choice!r}, expected one of {', '.join(map(repr, known))}"
    )


def _plain(name: str) -> str:
    signed = _SIGN.sub("\x01", name.upper())
    return "".join(c for c in signed if c.isalnum() or c == "\x01")


def _bare(name: str) -> str:
    mark = _SIMBAD.match(name)
    return _plain(name[mark.end() :] if mark else name)


# Read values of FITS headers with checks, because headers are often edited by hand.

_DATED_NAME = re.compile(r"(?<!\d)(20\d\d)-?([01]\d)-?([0-3]\d)")
"""A date in the name of a file: opd_2022-08-14.fits.gz, R2022081402-NRCA3_FP1-1.fits."""

_NOTHING_STATED = ("", "UNKNOWN", "NULL", "N/A", "UNDEFINED")
"""Texts of cards that state nothing."""


def merged_header(primary: fits.Header, extension: fits.Header, name: str) -> fits.Header:
    """Cards of the primary header, replaced and completed by cards of an extension.

    CorruptFileError, with the `name` of the file, if a card cannot be read, or has invalid
    characters.
    """
    merged = primary.copy()
    try:
        merged.update(extension)
    except (ValueError, fits.VerifyError) as error:
        raise CorruptFileError(
            f"{name}: a card of its headers cannot be read ({error}). Correct it, or fetch the "
            "file again"
        ) from error
    return merged


def fits_text(text: object) -> str:
    """Return a text as FITS headers can hold it, in printable ASCII ("Übersicht β": "Ubersicht ?").

    Accents are left out, and other characters become question marks.
    """
    plain = unicodedata.normalize("NFKD", str(text))
    letters = (c for c in plain if not unicodedata.combining(c))
    return "".join(c if " " <= c <= "~" else "?" for c in letters)


def file_name(label: str) -> str:
    """Return a label as the name of a file or folder: letters, digits and .+-, 80 at most.

    Examples
    --------
    >>> file_name("β Pic, F444W")
    'Pic-F444W'
    """
    return re.sub(r"[^A-Za-z0-9.+-]+", "-", fits_text(label)).strip("-.")[:80]


def card_error(name: str, card: str, value: Any, expected: str) -> CorruptFileError:
    """Error for a card that does not hold what is expected."""
    return CorruptFileError(
        f"{name}: {card} is {value!r}, expected {expected}. Correct the header, or fetch the file "
        "again"
    )


def _value(header: fits.Header, key: str) -> Any:
    """Value of a card; None if it is missing or undefined."""
    value = header.get(key)
    return None if isinstance(value, fits.card.Undefined) else value


def header_number(header: fits.Header, key: str, name: str) -> float | None:
    """Finite number of a card; CorruptFileError if it holds something else.

    None if the card is missing, empty, or says that its value is not known.
    """
    value = _value(header, key)
    if value is None or (isinstance(value, str) and value.strip().upper() in _NOTHING_STATED):
        return None
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise card_error(name, key, value, "a finite number")
    return float(value)


def header_text(header: fits.Header, key: str, name: str) -> str | None:
    """Text of a card, without blanks around it; CorruptFileError if it holds something else.

    None if the card is missing, empty, or says that its value is not known (UNKNOWN, NULL, N/A).
    """
    value = _value(header, key)
    if value is not None and not isinstance(value, str):
        raise card_error(name, key, value, "text")
    text = (value or "").strip()
    return None if text.upper() in _NOTHING_STATED else text


def known_number(header: fits.Header, key: str) -> float | None:
    """Finite number of a card; None if it holds anything else.

    For values that are only reported, and must not end a reduction; see also `header_number`.
    """
    try:
        return header_number(header, key, "")
    except CorruptFileError:
        return None


def known_text(header: fits.Header, key: str) -> str | None:
    """Text of a card, also of a number; None if it is missing, or says that it is not known."""
    value = _value(header, key)
    text = "" if value is None else str(value).strip()
    return None if text.upper() in _NOTHING_STATED else text


def header_date(header: fits.Header, keys: tuple[str, ...], name: str) -> Time | None:
    """Date (UTC) of the first of several cards that has one; CorruptFileError if it is no date."""
    for key in keys:
        text = header_text(header, key, name)
        if text is not None:
            return _date(text.replace(" ", "T"), key, name)
    return None


def _date(text: str, cards: str, name: str) -> Time:
    """Date (UTC) that the text of cards states."""
    try:
        # With a format, because the guesses of astropy hold the errors of its trials, and with
        # them all that the callers have in memory, until garbage is collected.
        return Time(text, format="isot", scale="utc")
    except ValueError as error:
        raise card_error(name, cards, text, "a date such as '2022-08-11T01:02:03'") from error


def day_and_time(header: fits.Header, name: str) -> Time | None:
    """Date (UTC) of DATE-OBS with TIME-OBS, None if one of them is missing.

    CorruptFileError if together they are no date.
    """
    day, hour = (header_text(header, key, name) for key in ("DATE-OBS", "TIME-OBS"))
    if not (day and hour) or "T" in day:
        return None
    return _date(f"{day}T{hour}", "DATE-OBS with TIME-OBS", name)


def sensing_date(header: fits.Header, name: str) -> Time | None:
    """Date (UTC) at which an OPD map was sensed, None if it is not known.

    The date is DATE-OBS with TIME-OBS, as MAST and stpsf write them, DATE-OBS alone, DATE-BEG, or
    else the date in the name of the file, `name`. CorruptFileError if the cards do not hold a date.
    """
    split = day_and_time(header, name)
    if split is not None:
        return split
    stated = header_date(header, ("DATE-OBS", "DATE-BEG"), name)
    match = _DATED_NAME.search(name)
    if stated is not None or match is None:
        return stated
    try:
        return Time("-".join(match.groups()), format="isot", scale="utc")
    except ValueError:  # Digits that are no date.
        return None


# The package's own FITS keywords: one declaration of their names, comments and meanings.

_PIPELINE_UNIT = u.MJy / u.sr


@dataclass(frozen=True)
class Keyword:
    """A keyword of products."""

    name: str
    comment: str  # of the card; empty where the value leaves no room for one
    # "reduce" for files of reductions, fits and searches, "pyKLIP" for products of
    # ``algo="diffrender"``, "psf" for rendered images; several are separated by commas.
    files: str
    meaning: str = ""  # what the comment leaves out, for the documentation


_DECLARED = (
    Keyword("DRVERS", "version of pyklip_diffrender", "reduce, pyKLIP, psf"),
    Keyword("DRALGO", "star subtraction algorithm", "pyKLIP", "Always `diffrender`."),
    Keyword("DRIMAGE", "image in the products", "pyKLIP",
            "`cleaned` or `subtracted`, see `DiffrenderSettings.image`."),
    Keyword("DRSTAT", "how the refinement ended", "reduce, pyKLIP",
            "Name of a `Status`, such as `CONVERGED`; of several fits, the status with the "
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
    Keyword("DROPD", "OPD map at the start", "reduce, pyKLIP",
            "Name of its file, or `flat wavefront`."),
    Keyword("DRSHA256", "", "reduce, pyKLIP",
            "SHA-256 of the file of the OPD map, or of its array."),
    Keyword("DROPDDAT", "date of the OPD map", "pyKLIP", "Only for maps with a date."),
    Keyword("DROPDHRS", "[h] from the frames to the map", "pyKLIP",
            "From their mean date; negative for an earlier map."),
    Keyword("DRPATTRN", "detector pattern", "reduce, pyKLIP",
            "Its name, which lists the stars that it was learned from, or `none`."),
    Keyword("DRREFS", "reference frames that were used", "pyKLIP",
            "Integrations to which wavefront or pattern were fitted."),
    Keyword("DRREFUSE", "", "pyKLIP",
            "What the frames of reference stars were used for, and why some were not."),
    Keyword("DRTHRU", "median throughput of faint sources", "pyKLIP",
            "Median of `-throughput.fits` over the fitted pixels."),
    Keyword("DRTHSTEP", "pixels between computed positions", "pyKLIP", "Of `-throughput.fits`."),
    Keyword("DRFMFLUX", "fitted flux over the forward model's flux", "pyKLIP",
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
    """Set one of the package's keywords, with its comment; KeyError if it is not declared.

    Numbers that are not finite, which FITS headers cannot have, are written as text.
    """
    comment = KEYWORDS[name].comment
    if isinstance(value, float) and not math.isfinite(value):
        value = str(value)
    value = fits_text(value) if isinstance(value, str) else value
    # A value may fill the whole card.
    header[name] = (value, comment) if comment else value


def fits_unit(unit: u.UnitBase) -> str:
    """A unit for BUNIT: "MJy/sr" as JWST's pipeline spells its own, "adu s-1" as FITS does."""
    if unit == _PIPELINE_UNIT:
        return "MJy/sr"
    try:
        return str(unit.to_string("fits"))
    except ValueError:  # The standard does not know electrons, which frames may be in.
        return str(unit.to_string())
