"""Tables of spectra as people have them: formats, units and where they are written, columns."""

import gzip
import logging

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Column, MaskedColumn, QTable, Table
from hypothesis import assume, given
from hypothesis import strategies as st

import pyklip_diffrender as dr
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError, UnitError
from pyklip_diffrender.instrument import planet_spectra
from pyklip_diffrender.instrument.spectrum import read_spectrum
from pyklip_diffrender.io.units import unit_of
from pyklip_diffrender.refinement import to_jansky

MARK = "\N{ZERO WIDTH NO-BREAK SPACE}"
MICRON = np.geomspace(1.4, 6.0, 300)
# A black body of 6000 K, of which a star of 1 Jy at 1.4 micron is made, with h c / k in micron K.
JANSKY = MICRON**-3.0 / np.expm1(14387.768775 / (MICRON * 6000))
JANSKY /= JANSKY[0]

# The constants of the conversions are written out, so that they are not astropy's: the speed of
# light is 2.99792458e14 um/s, and the energy of a photon 1.98644586e-8 erg Angstrom / wavelength.
PLACES = {
    "um": MICRON, "micron": MICRON, "MICRONS": MICRON, "nm": 1e3 * MICRON, "Angstrom": 1e4 * MICRON,
    "ANGSTROM": 1e4 * MICRON, "A": 1e4 * MICRON, "GHz": 2.99792458e5 / MICRON,
    "Hz": 2.99792458e14 / MICRON, "cm-1": 1e4 / MICRON,
}  # fmt: skip
FLAM = JANSKY * 2.99792458e-13 / MICRON**2
AB = -2.5 * np.log10(1e-23 * JANSKY) - 48.6
LEVELS = {
    "Jy": JANSKY, "JY": JANSKY, "mJy": 1e3 * JANSKY, "uJy": 1e6 * JANSKY,
    "FLAM": FLAM, "erg/s/cm2/A": FLAM, "ERG/CM2/S/A": FLAM, "10-13erg/s/cm2/Angstrom": 1e13 * FLAM,
    "FNU": 1e-23 * JANSKY, "erg/s/cm^2/Hz": 1e-23 * JANSKY,
    "W/m2/um": 10 * FLAM, "W m-2 um-1": 10 * FLAM, "Watt/m2/micron": 10 * FLAM,
    "photlam": FLAM * 1e4 * MICRON / 1.98644586e-8,
    "ABmag": AB, "mag(AB)": AB, "mag(ST)": -2.5 * np.log10(FLAM) - 21.1,
}  # fmt: skip


def rows(*columns):
    return "".join(" ".join(map("{:.9e}".format, row)) + "\n" for row in np.transpose(columns))


def text(heading, *columns):
    return lambda path: path.write_text(heading + rows(*columns), encoding="utf-8")


def table(kind, **columns):
    return lambda path: Table(columns).write(path, format=kind)


def with_unit(values, unit, **facts):
    return Column(values, unit=unit, **facts)


def as_fits(*columns):
    """A binary table of names, units as they are, and values."""

    def write(path):
        fits.BinTableHDU.from_columns(
            [fits.Column(name, "D", unit, array=values) for name, unit, values in columns]
        ).writeto(path)

    return write


CALSPEC = as_fits(
    ("WAVELENGTH", "ANGSTROMS", 1e4 * MICRON), ("FLUX", "FLAM", FLAM),
    ("STATERROR", "FLAM", 0.01 * FLAM), ("SYSERROR", "FLAM", 0.02 * FLAM),
    ("FWHM", "ANGSTROMS", 10 + 0 * MICRON), ("DATAQUAL", None, 1 + 0 * MICRON),
)  # fmt: skip
SVO = """# BT-Settl (CIFIST)
# teff = 6000 K (value for the effective temperature)
# logg = 4.5 log(cm/s2) (value for the logarithm of the gravity)
# column 1: WAVELENGTH (ANGSTROM), Wavelength in Angstrom
# column 2: FLUX (ERG/CM2/S/A), Flux in erg/cm2/s/A
"""
FILES = {
    "spaceKLIP's starfile": ("star.txt", text("", MICRON, JANSKY)),
    "header of units": ("star.txt", text("# um mJy\n", MICRON, 1e3 * JANSKY)),
    "synphot": ("star.dat", text("# WAVELENGTH FLUX\n# ANGSTROM FLAM\n", 1e4 * MICRON, FLAM)),
    "SVO": ("lte060.txt", text(SVO, 1e4 * MICRON, FLAM)),
    "header of prose": (
        "star.txt",
        text("# HD 1, 10 pc away\n# Wavelength in um\n# Flux: W/m2/um\n", MICRON, 10 * FLAM),
    ),
    "nested brackets": (
        "star.txt", text("# wave [nm], F (erg/(s cm2 Angstrom))\n", 1e3 * MICRON, FLAM),
    ),
    "brackets with blanks": (
        "star.txt", text("# flux (W / m2 / um) wave (um)\n", 10 * FLAM, MICRON),
    ),
    "CSV": (
        "star.csv",
        lambda path: path.write_text(
            "wave_nm,flux_W/m2/um\n" + rows(1e3 * MICRON, 10 * FLAM).replace(" ", ",")
        ),
    ),
    "ECSV": ("star.ecsv", lambda path: QTable({
        "nu": PLACES["GHz"][::-1] * u.GHz, "f": 10 * FLAM[::-1] * u.Unit("W / (m2 um)"),
    }).write(path)),
    "CDS": ("table.mrt", table(
        "ascii.mrt", wl=with_unit(MICRON, "um", description="Wavelength"),
        F=with_unit(1e3 * JANSKY, "mJy", description="Flux density"),
        e_F=with_unit(JANSKY, "mJy", description="Uncertainty"),
    )),
    "IPAC": ("table.tbl", table(
        "ascii.ipac", wavelength=with_unit(MICRON, "micron"), flux=with_unit(JANSKY, "Jy"),
    )),
    "CALSPEC": ("star.fits", CALSPEC),
    "model of CALSPEC": ("star_mod.fits", as_fits(
        ("WAVELENGTH", "ANGSTROMS", 1e4 * MICRON), ("CONTINUUM", "FLAM", 1.1 * FLAM),
        ("FLUX", "FLAM", FLAM),
    )),
    "flags": (
        "star.txt", text("# wave_um quality star_mJy\n", MICRON, 0 * MICRON, 1e3 * JANSKY),
    ),
    "x1d": ("star_x1d.fits", as_fits(
        ("WAVELENGTH", "um", MICRON), ("FLUX", "Jy", JANSKY), ("FLUX_ERROR", "Jy", 0.1 * JANSKY),
        ("FLUX_VAR_POISSON", "Jy2", JANSKY**2), ("SURF_BRIGHT", "MJy/sr", 1e2 * JANSKY),
        ("BACKGROUND", "MJy/sr", JANSKY), ("NPIXELS", None, 3 + 0 * MICRON),
    )),
    # As pandeia 2026.7 writes it (report.py, `_1dfits`).
    "JWST ETC": ("lineplot_target.fits", as_fits(
        ("WAVELENGTH", "um", MICRON), ("target", None, 1e3 * JANSKY),
    )),
    "ETC's source": ("source_spectrum.fits", as_fits(
        ("wavelength", "micron", MICRON), ("flux", "mJy", 1e3 * JANSKY),
    )),
    "VizieR": ("vizier.vot", table(
        "votable", _RAJ2000=with_unit(0 * MICRON, "deg"), _tabname=["II/328/allwise"] * len(MICRON),
        sed_freq=with_unit(PLACES["GHz"], "GHz"), sed_flux=with_unit(JANSKY, "Jy"),
        sed_eflux=MaskedColumn(JANSKY, unit="Jy", mask=MICRON > 2),
    )),
    "VOTable": ("spectrum.xml", table(
        "votable", lambda_=with_unit(1e3 * MICRON, "nm"), F=with_unit(10 * FLAM, "W m-2 um-1"),
        delta=with_unit(FLAM, "W m-2 um-1", meta={"ucd": "stat.error;phot.flux"}),
    )),
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "dress"),
    [(kind, "") for kind in FILES]
    + [(kind, "packed") for kind in ("synphot", "ECSV", "CALSPEC", "VizieR")]
    + [(kind, "byte-order mark") for kind in ("spaceKLIP's starfile", "SVO", "ECSV", "VizieR")],
)
def test_one_star_in_every_format(tmp_path, kind, dress):
    name, write = FILES[kind]
    path = tmp_path / name
    write(path)
    if dress == "byte-order mark":
        path.write_bytes(MARK.encode() + path.read_bytes())
    if dress == "packed":
        path = path.with_name(f"{name}.gz")
        path.write_bytes(gzip.compress((tmp_path / name).read_bytes()))
    wavelength, flux = read_spectrum(path)
    # Nine digits are written.
    np.testing.assert_allclose(wavelength, 1e-6 * MICRON, rtol=1e-8)
    np.testing.assert_allclose(flux, JANSKY, rtol=1e-7)


STYLES = {
    "suffix": "{label}_{unit}", "brackets": "{label} ({unit})", "square": "{label} [{unit}]",
    "close": "{label}({unit})", "fraction": "{label}/{unit}",
}  # fmt: skip


@given(
    place=st.sampled_from(list(PLACES)), level=st.sampled_from(list(LEVELS)),
    style=st.sampled_from(list(STYLES)), order=st.permutations(range(4)), comma=st.booleans(),
    label=st.sampled_from(["flux", "Flux", "F", "star"]), seed=st.integers(0, 2**16),
)  # fmt: skip
def test_any_order_of_columns_and_rows(
    tmp_path_factory, place, level, style, order, comma, label, seed
):
    # Without brackets, a blank ends the unit.
    assume(" " not in level or style in ("brackets", "square", "close"))
    name = STYLES[style].format
    columns = [
        (name(label="wave", unit=place), PLACES[place]),
        (name(label=label, unit=level), LEVELS[level]),
        (name(label="flux_err", unit=level), 0.1 * LEVELS[level]),
        ("T (K)", 6000 + 0 * MICRON),
    ]
    shuffled = np.random.default_rng(seed).permutation(len(MICRON))
    titles, values = zip(*(columns[k] for k in order), strict=True)
    separator = ", " if comma else " "
    path = tmp_path_factory.mktemp("star") / "star.txt"
    text(f"# {separator.join(titles)}\n", *(each[shuffled] for each in values))(path)
    wavelength, flux = read_spectrum(path)
    np.testing.assert_allclose(wavelength, 1e-6 * MICRON, rtol=1e-8)
    # Of nine digits of a magnitude, 1e-8.
    np.testing.assert_allclose(flux, JANSKY, rtol=3e-7)


@pytest.mark.parametrize(
    ("heading", "columns", "words"),
    [
        # Numbers that cannot be true, with the unit that was probably meant.
        ("", (1e4 * MICRON, JANSKY), ["1.4e+04 to 6e+04 micron", "In Angstrom"]),
        ("", (1e3 * MICRON, JANSKY), ["1400 to 6000 micron", "In nm it"]),
        ("", (MICRON, 10 * FLAM), ["Jy, expected 1e-06 to 100000 Jy", "In W / (m2 um)"]),
        ("", (MICRON, 1e6 * JANSKY), ["In uJy it"]),
        ("# wave_um flux_MJy\n", (MICRON, JANSKY), ["flux_MJy: got ", "e+05 Jy"]),
        # Units that are not clear.
        ("# WAVELENGTH FLUX\n# MICRON MJY\n", (MICRON, JANSKY), ["'MJY'", "mJy or MJy"]),
        ("# wave_um flux\n", (MICRON, JANSKY), ["flux (no unit)", "units of both, or of none"]),
        ("# wave flux_mJy\n", (MICRON, JANSKY), ["wave (no unit)", "units of both, or of none"]),
        ("# um erg s-1 cm-2 A-1\n", (MICRON, FLAM), ["um, 1 / s", "one such unit"]),
        ("# nm\n# 400 mJy at 4 um\n", (MICRON, JANSKY), ["nm, um", "one such unit"]),
        ("# freq flux\n", (1 / MICRON, JANSKY), ["freq (no unit)", "a unit of frequencies"]),
        # No flux densities.
        ("# wave_um flux (cts/s)\n", (MICRON, JANSKY), ["(cts/s)", "one column of flux densities"]),
        ("# wave_um flux [bananas]\n", (MICRON, JANSKY), ["(bananas)", "one column of flux"]),
        ("# wave_um log_flux_Jy\n", (MICRON, 2 + JANSKY), ["(logarithm)", "one column of flux"]),
        ("# wave_um Kmag\n", (MICRON, 5 + JANSKY), ["Kmag (mag)", "one column of flux densities"]),
        ("# wave_um MJy/sr\n", (MICRON, JANSKY), ["MJy/sr (MJy / sr)", "one column of flux"]),
        ("# wave_um flux_err_mJy\n", (MICRON, JANSKY), ["wave_um (um)", "one column of flux"]),
        # Columns that are not clear.
        ("", (MICRON, JANSKY, JANSKY), ["col1 (no unit), col2", "one column of flux densities"]),
        ("# wave_um A_Jy B_Jy\n", (MICRON, JANSKY, JANSKY), ["A_Jy (Jy), B_Jy (Jy)", "one column"]),
        ("# wave_um flux_A flux_B\n", (MICRON, JANSKY, JANSKY), ["flux_A (no unit), flux_B"]),
        ("# wave1_um wave2_um flux_Jy\n", (MICRON, MICRON, JANSKY), ["one column of wavelengths"]),
    ],
)  # fmt: skip
def test_what_is_not_clear_or_cannot_be_true_is_refused(tmp_path, heading, columns, words):
    path = tmp_path / "star.txt"
    text(heading, *columns)(path)
    with pytest.raises(IncompatibleSetupError) as refused:
        dr.instrument.star_flux_density(path, "F444W")
    message = str(refused.value)
    assert message.startswith(f"{path}: ")
    assert [word for word in words if word not in message] == []
    assert len(message) < len(str(path)) + 320


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("star.txt", b"<html><body>no</body></html>\n", "not a table of numbers"),
        ("star.txt", b"wave flux\n1 2\n3\n", "not a table of numbers"),
        ("star.txt", b"", "not a table of numbers"),
        ("star.txt", b"# wave_\xb5m flux_Jy\n1 2\n3 4\n", "not a table of numbers"),  # Latin-1.
        ("star.vot", b"<?xml version='1.0'?><VOTABLE><RESOURCE>", "not a table of numbers"),
        ("star.gz", gzip.compress(rows(MICRON, JANSKY).encode())[:-9], "not a table of numbers"),
        ("star.fits", b"SIMPLE  = cut", "not a complete FITS file"),
    ],
)  # fmt: skip
def test_files_that_are_no_table(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(CorruptFileError) as refused:
        read_spectrum(path)
    assert str(refused.value).startswith(str(path))
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_images_are_no_table(tmp_path):
    fits.PrimaryHDU(np.ones((3, 3))).writeto(tmp_path / "image.fits")
    with pytest.raises(CorruptFileError, match=r"image\.fits: .*has no table"):
        read_spectrum(tmp_path / "image.fits")


def test_assumed_units_are_logged(tmp_path, caplog):
    path = tmp_path / "star.txt"
    text("", MICRON, JANSKY)(path)
    with caplog.at_level(logging.WARNING):
        read_spectrum(path)
    assert f"{path} has no units; micron and Jy are assumed" in caplog.text
    caplog.clear()
    text("# um Jy\n", MICRON, JANSKY)(path)
    read_spectrum(path)
    assert not caplog.records


def test_spectra_of_planets_are_all_columns_but_errors(tmp_path):
    path = tmp_path / "planets.txt"
    columns = (MICRON, 10 * FLAM, FLAM, JANSKY, JANSKY, AB, JANSKY)
    heading = "# wave_um 150K_W/m2/um e_150K_W/m2/um 300K_mJy/sr 300K_err_mJy/sr old_ABmag T\n"
    text(heading, *columns)(path)
    spectra = planet_spectra(path, ["F356W", "F444W"])
    assert spectra.names == ("150K_W/m2/um", "300K_mJy/sr", "old_ABmag")
    ((name, reason),) = spectra.left_out
    assert name == "T"
    assert "T (no unit); expected flux densities" in reason
    # One shape: all of them are the star.
    np.testing.assert_allclose(spectra.flux[1:], spectra.flux[[0, 0]], rtol=1e-7)
    # Without units they are flux densities per frequency; letters are planets, not errors.
    text("# wave b c d e\n", MICRON, JANSKY, JANSKY, JANSKY, JANSKY)(path)
    assert planet_spectra(path, ["F356W", "F444W"]).names == ("b", "c", "d", "e")
    np.testing.assert_allclose(planet_spectra(path, ["F356W", "F444W"]).flux[0], spectra.flux[0])
    text("", 1e4 * MICRON, JANSKY)(path)
    with pytest.raises(IncompatibleSetupError, match=r"planets\.txt: col1.*In Angstrom"):
        planet_spectra(path, ["F356W", "F444W"])


@pytest.mark.parametrize(
    ("star", "jansky"),
    [
        (0.45, 0.45), ("0.45", 0.45), ("403 mJy", 0.403), ("403mJy", 0.403), ("4.03e5 uJy", 0.403),
        (403 * u.mJy, 0.403), ("4e-24 erg/s/cm2/Hz", 0.4), ("4E-24 FNU", 0.4),
        # 3631 Jy are the AB magnitude 0, to 1e-4.
        ("7.2 mag(AB)", 3631 * 10**-2.88), ("7.2 ABmag", 3631 * 10**-2.88),
        ("7.2 AB mag", 3631 * 10**-2.88), (7.2 * u.ABmag, 3631 * 10**-2.88),
    ],
)  # fmt: skip
def test_flux_of_a_star_in_words(star, jansky):
    assert to_jansky(star) == pytest.approx(jansky, rel=1e-4)


@pytest.mark.parametrize(
    ("star", "words"),
    [
        ("5.3 mag(ST)", "an AB magnitude, such as"), ("5.3 mag", "A Vega magnitude is not"),
        ("5.3 Vega", "A Vega magnitude is not"), ("6e-14 W/m2/um", "per frequency"),
        ("403 MJY", "such as '0.45 Jy'"), ("bright", "such as '0.45 Jy' or '403 mJy'"),
        (6.5e-14, r"In W / \(m2 um\)"), (0.0, "expected 1e-06"), ("403 MJy", "expected 1e-06"),
        (np.nan, "expected 1e-06"), (3 * u.m, "expected a flux"), (None, "expected a flux"),
        ([0.1, 0.2], "expected a flux"),
    ],
)  # fmt: skip
def test_what_is_no_flux_of_a_star_is_refused(star, words):
    with pytest.raises(IncompatibleSetupError, match=f"star_flux: got .*{words}"):
        to_jansky(star)


def test_spellings_of_units():
    for text_, unit in (
        ("ANGSTROMS", u.AA), ("Microns", u.um), ("NM", u.nm), ("GHZ", u.GHz), ("mjy", u.mJy),
        ("MJy", u.MJy), ("PHOTLAM", u.photon / u.s / u.cm**2 / u.AA), ("[Jy]", u.Jy),
        ("\u00b5m", u.um), ("\u00c5", u.AA), ("MAG(AB)", u.ABmag), ("AB", u.ABmag),
        ("10**-17 erg/s/cm2/A", 1e-17 * u.erg / u.s / u.cm**2 / u.AA),
    ):  # fmt: skip
        assert unit_of(text_) == unit, text_
    for text_ in ("", "4.4um", "7.2", "flux", "HD", "star A", "in", "-", "Vega"):
        assert unit_of(text_) is None, text_
    with pytest.raises(UnitError, match="mJy or MJy"):
        unit_of("MJY")
