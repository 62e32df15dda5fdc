"""A star's flux in a filter from its spectrum, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table

import pyklip_diffrender as dr
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.instrument import filter_throughput

GRID = np.geomspace(1.0, 6.0, 400) * u.micron


def rayleigh_jeans(wavelength):
    return 2.0 * (wavelength / u.micron) ** -2 * u.Jy


def expected(filter):
    """The mean over photons, by a sum that shares no code with the package's."""
    wavelength, throughput = filter_throughput(filter)
    fine = np.linspace(wavelength[0], wavelength[-1], 20001)
    weight = np.interp(fine, wavelength, throughput)
    weight[weight < 0.01] = 0
    flux = 2.0 * (fine * 1e6) ** -2
    return float(np.trapezoid(flux * weight / fine, fine) / np.trapezoid(weight / fine, fine))


def as_text(path):
    np.savetxt(path / "star.txt", np.c_[GRID.value, rayleigh_jeans(GRID).value], header="um Jy")
    return path / "star.txt"


def as_ecsv(path):
    table = QTable({"nu": GRID.to(u.THz, u.spectral()), "flux": rayleigh_jeans(GRID).to(u.mJy)})
    table.write(path / "star.ecsv")
    return path / "star.ecsv"


def as_calspec(path):
    flam = rayleigh_jeans(GRID).to(u.erg / u.s / u.cm**2 / u.AA, u.spectral_density(GRID))
    columns = [
        fits.Column("WAVELENGTH", "D", "ANGSTROMS", array=GRID.to_value(u.AA)),
        fits.Column("FLUX", "D", "FLAM", array=flam.value),
    ]
    fits.BinTableHDU.from_columns(columns).writeto(path / "star.fits")
    return path / "star.fits"


def as_photometry(path):
    bands = np.repeat([1.66, 2.16, 3.35, 4.60, 11.6], 3) * u.micron
    # Two catalogues agree, and the third is wrong: the median is that of the two.
    flux = rayleigh_jeans(bands).value * np.tile([1.0, 1.0, 3.0], 5)
    table = Table({"sed_freq": bands.to(u.GHz, u.spectral()).value, "sed_flux": flux})
    table.write(path / "star.vot", format="votable")
    return path / "star.vot"


@pytest.mark.parametrize("write", [as_text, as_ecsv, as_calspec, as_photometry])
@pytest.mark.parametrize("filter", ["F200W", "F444W"])
def test_power_law_in_every_format(tmp_path, write, filter):
    flux = dr.star_flux_density(write(tmp_path), filter)
    # The package interpolates power laws exactly; what remains are the two quadratures.
    assert flux.to_value(u.Jy) == pytest.approx(expected(filter), rel=1e-4)


@pytest.mark.parametrize(
    ("text", "expected", "complaint"),
    [
        ("<html>no</html>", CorruptFileError, "wavelength in micron and flux density in Jy"),
        ("3.0 -1\n4.0 nan\n5.0 0.5\n", CorruptFileError, "1 of 3 samples"),
        (
            "0.5 1.0\n1.5 0.5\n2.2 0.3\n",
            IncompatibleSetupError, r"covers 0\.500 to 2\.200 micron",
        ),
        (
            "1.0 1.0\n2.0 0.5\n8.0 0.3\n",
            IncompatibleSetupError, r"no sample between 2\.00 and 8\.00 micron",
        ),
    ],
)  # fmt: skip
def test_files_that_do_not_say_the_flux(tmp_path, text, expected, complaint):
    path = tmp_path / "star.txt"
    path.write_text(text)
    with pytest.raises(expected, match=complaint):
        dr.star_flux_density(path, "F444W")


def test_spectral_type():
    # Type A0V is nearly a black body of 9600 K, and magnitude 0 in Ks is 666.8 Jy at 2.159 micron.
    wavelength = np.array([2.159, 2.09, 3.56, 4.42])
    flux = wavelength**-3 / np.expm1(14388 / (wavelength * 9600))
    for filter, ratio in zip(("F210M", "F356W", "F444W"), flux[1:] / flux[0], strict=True):
        expected = 666.8 * ratio
        assert dr.star_flux_density("A0V, K=0", filter).value == pytest.approx(expected, rel=0.02)
    # A magnitude is a factor of 2.512; other ways to write it mean the same.
    bright, faint = (dr.star_flux_density(f"M4, K={k}", "F356W").value for k in ("5", "6.0"))
    assert bright / faint == pytest.approx(10**0.4)
    assert dr.star_flux_density("M4V,K=5", "F356W").value == bright
    # Between K5 and M5 the table has no W1 - W2; it has to increase from one to the other.
    ratio = [
        dr.star_flux_density(star, "F460M") / dr.star_flux_density(star, "F356W")
        for star in ("K5V, K=5", "M0V, K=5", "M2.5V, K=5", "M5V, K=5")
    ]
    assert np.all(np.diff(ratio) > 0)


@pytest.mark.parametrize(
    ("star", "filter", "expected", "complaint"),
    [
        ("B2V, K=5", "F444W", IncompatibleSetupError, "got type B2, expected B5 to M9"),
        ("K0III, K=5", "F444W", FileNotFoundError, r'such as "A2V, K=6\.77"'),
        ("missing.txt", "F444W", FileNotFoundError, r"missing\.txt: no such file"),
        ("A0V, K=0", "F999W", IncompatibleSetupError, "F999W"),
    ],
)
def test_stars_that_are_not_known(star, filter, expected, complaint):
    with pytest.raises(expected, match=complaint):
        dr.star_flux_density(star, filter)
