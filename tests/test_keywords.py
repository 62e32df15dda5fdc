"""The package's own FITS keywords have one declaration, and products one form of each."""

import math
import re
from pathlib import Path

import pytest
from astropy import units as u
from astropy.io import fits

from pyklip_diffrender.io.headers import KEYWORDS, fits_unit, set_keyword

ROOT = Path(__file__).resolve().parents[1]


def test_every_keyword_that_is_written_is_declared():
    """By texts of the package's modules that look like keywords of its own."""
    modules = (ROOT / "pyklip_diffrender").rglob("*.py")
    texts = [each.read_text(encoding="utf-8") for each in modules if each.name != "keywords.py"]
    written = set(re.findall(r"['\"](DR[A-Z0-9]{2,6})['\"]", "\n".join(texts)))
    # The names of a position and its error are formed from their beginning.
    formed = {f"DRFM{axis}{end}" for axis in ("RA", "DE") for end in ("", "ER")}
    assert written - {"DRFM"} | formed == set(KEYWORDS)


def test_keywords_fit_on_cards():
    assert all(len(name) <= 8 for name in KEYWORDS)
    header = fits.Header()
    for name, each in KEYWORDS.items():
        set_keyword(header, name, 1.5)
        assert header.comments[name] == each.comment
        assert each.comment or each.meaning
        assert set(each.files.split(", ")) <= {"reduce", "pyKLIP", "psf"}
    assert len(header.tostring()) % 2880 == 0


def test_values_are_such_as_headers_can_hold():
    header = fits.Header()
    set_keyword(header, "DRCHI2", math.nan)
    set_keyword(header, "DRSYST", "Übersicht β")
    assert (header["DRCHI2"], header["DRSYST"]) == ("nan", "Ubersicht ?")
    with pytest.raises(KeyError, match="DROPDNAM"):
        set_keyword(header, "DROPDNAM", "map.fits")


@pytest.mark.parametrize(
    ("unit", "text"), [("MJy sr-1", "MJy/sr"), ("electron / s", "electron / s"), ("", "")]
)
def test_units_are_spelled_as_the_pipeline_does(unit, text):
    assert fits_unit(u.Unit(unit)) == text
    assert u.Unit(text) == u.Unit(unit)
