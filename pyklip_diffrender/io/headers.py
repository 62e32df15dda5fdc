"""Read values of FITS headers with checks, because headers are often edited by hand."""

from __future__ import annotations

import math
import re
import unicodedata
from numbers import Real
from typing import Any

from astropy.io import fits
from astropy.time import Time

from pyklip_diffrender.errors import CorruptFileError

__all__ = [
    "card_error",
    "day_and_time",
    "fits_text",
    "header_date",
    "header_number",
    "header_text",
    "merged_header",
    "sensing_date",
]

_DATED_NAME = re.compile(r"(?<!\d)(20\d\d)-?([01]\d)-?([0-3]\d)")
"""A date in the name of a file: opd_2022-08-14.fits.gz, R2022081402-NRCA3_FP1-1.fits."""

_UNKNOWN = ("", "UNKNOWN", "NULL", "N/A", "UNDEFINED")
"""Texts of cards that state nothing."""


def merged_header(primary: fits.Header, extension: fits.Header, name: str) -> fits.Header:
    """Cards of the primary header, replaced and completed by those of an extension.

    `name` is the name of the file in messages.

    Raises
    ------
    CorruptFileError
        If a card cannot be read, or has invalid characters.
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
    """Return a text as FITS headers can hold it, in printable ASCII.

    Accents are left out, and other characters become question marks.

    Examples
    --------
    >>> fits_text("Übersicht β Pic.fits")
    'Ubersicht ? Pic.fits'
    """
    plain = unicodedata.normalize("NFKD", str(text))
    letters = (c for c in plain if not unicodedata.combining(c))
    return "".join(c if " " <= c <= "~" else "?" for c in letters)


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
    """Finite number of a card; `name` is that of the file.

    None if the card is missing, empty, or says that its value is not known.

    Raises
    ------
    CorruptFileError
        If the card holds something else.
    """
    value = _value(header, key)
    if value is None or (isinstance(value, str) and value.strip().upper() in _UNKNOWN):
        return None
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise card_error(name, key, value, "a finite number")
    return float(value)


def header_text(header: fits.Header, key: str, name: str) -> str | None:
    """Text of a card without blanks around it; `name` is that of the file.

    None if the card is missing, empty, or says that its value is not known (UNKNOWN, NULL, N/A).

    Raises
    ------
    CorruptFileError
        If the card holds something else.
    """
    value = _value(header, key)
    if value is not None and not isinstance(value, str):
        raise card_error(name, key, value, "text")
    text = (value or "").strip()
    return None if text.upper() in _UNKNOWN else text


def header_date(header: fits.Header, keys: tuple[str, ...], name: str) -> Time | None:
    """Date (UTC) of the first of several cards that has one; `name` is that of the file.

    Raises
    ------
    CorruptFileError
        If the card does not hold a date.
    """
    for key in keys:
        text = header_text(header, key, name)
        if text is None:
            continue
        try:
            return Time(text, scale="utc")
        except ValueError as error:
            raise card_error(name, key, text, "a date such as '2022-08-11T01:02:03'") from error
    return None


def day_and_time(header: fits.Header, name: str) -> Time | None:
    """Date (UTC) of DATE-OBS with TIME-OBS, None if one of them is missing; `name` is the file's.

    Raises
    ------
    CorruptFileError
        If together they are no date.
    """
    day, hour = (header_text(header, key, name) for key in ("DATE-OBS", "TIME-OBS"))
    if not (day and hour) or "T" in day:
        return None
    try:
        return Time(f"{day}T{hour}", scale="utc")
    except ValueError as error:
        expected = "a date such as '2022-08-11T01:02:03'"
        cards = "DATE-OBS with TIME-OBS"
        raise card_error(name, cards, f"{day}T{hour}", expected) from error


def sensing_date(header: fits.Header, name: str) -> Time | None:
    """Date (UTC) at which a wavefront map was sensed, None if it is not known.

    It is DATE-OBS with TIME-OBS, as MAST and stpsf write them, DATE-OBS alone, DATE-BEG, or else
    the date in the name of the file, `name`.

    Raises
    ------
    CorruptFileError
        If the cards do not hold a date.
    """
    split = day_and_time(header, name)
    if split is not None:
        return split
    stated = header_date(header, ("DATE-OBS", "DATE-BEG"), name)
    match = _DATED_NAME.search(name)
    if stated is not None or match is None:
        return stated
    try:
        return Time("-".join(match.groups()), scale="utc")
    except ValueError:  # Digits that are no date.
        return None
