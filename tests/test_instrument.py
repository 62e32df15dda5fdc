"""NIRCam's embedded facts: what the numbers do in a model, and where they come from."""

import itertools
from functools import partial

import numpy as np
import pytest
import torch
from astropy.io import fits
from astropy.table import Table

from pyklip_diffrender import instrument
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.masks import FILTERS, MASKS, filter_shift, is_short_wave
from pyklip_diffrender.instrument.nircam import (
    ChromaticAberration,
    internal_wavefront_error,
    nircam_coronagraph,
)
from pyklip_diffrender.instrument.spectrum import filter_throughput
from pyklip_diffrender.wavefront import random_opd

SMALL = {"npix": 128, "fov_pixels": 24}


@pytest.fixture(scope="module")
def opd():
    return torch.from_numpy(random_opd(5, npix=128).data)


@pytest.mark.parametrize(
    ("mask", "filter_name"),
    [("MASK335R", "F335M"), ("MASK430R", "f444w"), ("MASK335R", "F210M"), ("MASK210R", "F444W")],
)
def test_every_round_mask_hides_the_star_and_lets_a_planet_pass(mask, filter_name, opd):
    """Where half of a planet's light passes the mask, and beyond it, where all does."""
    model = nircam_coronagraph(filter_name, image_mask=mask, nlambda=2, **SMALL)
    clear = nircam_coronagraph(filter_name, image_mask=None, nlambda=2, **SMALL)
    assert model.between[0].name == mask
    scale = instrument.detector_place(mask, filter_name).pixelscale
    assert model.detector.pixelscale == (scale, scale)
    unocculted = float(clear(opd).sum())
    assert float(model(opd).sum()) < 0.03 * unocculted
    half = float(model(opd, (1.3 / MASKS[mask].sigma * 1.616, 0.0)).sum())
    outside = (1.02 * MASKS[mask].radius, 0.0)
    beyond = float(model(opd, outside).sum() / clear(opd, outside).sum())
    assert half < 0.8 * unocculted
    assert beyond == pytest.approx(1.0, abs=0.02)


def test_another_mask_brings_its_own_aberrations():
    masks = ("MASK210R", "MASK335R", "MASK430R")
    wavefront = internal_wavefront_error
    tables = {mask: wavefront(mask, short_wave=mask == "MASK210R") for mask in masks}
    rms = {mask: float(table[3:].norm() * 1e9) for mask, table in tables.items()}
    # The official table's column WFE_RMS, nm: of the lit part of the pupil, not of the circle.
    assert rms == pytest.approx({"MASK210R": 161, "MASK335R": 176, "MASK430R": 171}, rel=0.02)
    flipped = wavefront("MASK335R", flip=False)
    changed = (flipped != tables["MASK335R"]).nonzero().flatten() + 1
    # Noll's sines, which change sign with y: all odd ones that are not round.
    assert changed.tolist() == [j for j in range(3, 36, 2) if j != 11]


def test_focus_is_zero_where_the_table_was_made_and_tilt_at_the_reference():
    """Elsewhere as by hand from stpsf's polynomials, nm: the focus of F444W is not negligible."""
    long = ChromaticAberration(4.4e-6)
    assert long(3.23e-6)[4] == 0
    assert long(4.4e-6)[3] == 0
    assert long(4.39e-6)[4] * 1e9 == pytest.approx(32.6, abs=0.05)
    assert (long(4.39e-6)[3] - long(3.35e-6)[3]) * 1e9 == pytest.approx(-233.4, abs=0.05)
    short = ChromaticAberration(2.1e-6, short_wave=True)
    assert short(2.12e-6)[4] == 0
    assert short(2.0e-6)[4] * 1e9 == pytest.approx(-15.8, abs=0.05)
    assert short(2.0e-6)[3] * 1e9 == pytest.approx(-162.0, abs=0.05)


def test_places_on_the_detector_count_from_zero():
    """In the subarray of MASK335R, whose corner is at (491, 1501), it is (149.2, 173.6)."""
    place = instrument.detector_place("MASK335R", "F444W")
    assert place.detector == "NRCA5"
    assert np.subtract(place.center, (491, 1501)) == pytest.approx((149.2, 173.6))
    assert filter_shift("F335M") == filter_shift("F210M") == (0.0, 0.0)
    assert filter_shift("f444w") == (0.177, -0.205)


REFUSED = {
    r"'MASKA335R'.*MASK335R": partial(instrument.detector_place, "MASKA335R", "F444W"),
    r"'F150W'.*F182M.*F480M": partial(instrument.detector_place, "MASK335R", "F150W"),
    r"F182M.*F480M, not for 'F277W'": partial(filter_shift, "F277W"),
    **{
        message: partial(nircam_coronagraph, "F444W", **argument)
        for message, argument in {
            "npix: got '128', expected a whole number": {"npix": "128"},
            r"npix: got 128\.5, expected a whole number": {"npix": 128.5},
            "nlambda: got 0, expected a whole number, 1 or more": {"nlambda": 0},
            "oversample: got 0, expected a whole number": {"oversample": 0},
            "defaults: got bogus, expected some of star_offset": {"defaults": {"bogus": 1.0}},
        }.items()
    },
}


@pytest.mark.parametrize("complaint", REFUSED)
def test_what_is_not_known_is_refused_with_what_is(complaint):
    with pytest.raises(IncompatibleSetupError, match=complaint):
        REFUSED[complaint]()


@pytest.mark.parametrize("name", FILTERS)
def test_filters_stay_as_close_to_the_official_ones_as_their_table_says(official_files, name):
    data = fits.getdata(official_files / "NIRCam" / "filters" / f"{name}_throughput.fits")
    truth = data["THROUGHPUT"] / data["THROUGHPUT"].max()
    wavelength, throughput = filter_throughput(name)
    # The ends are where the table, in units of 0.1 Angstrom, has been rounded.
    where = data["WAVELENGTH"] * 1e-10
    inside = (where >= wavelength[0] - 1e-11) & (where <= wavelength[-1] + 1e-11)
    mine = np.interp(where, wavelength, throughput) * inside
    assert np.abs(mine - truth).max() <= 0.002
    assert mine.sum() == pytest.approx(truth.sum(), rel=2e-3)


def test_aberrations_are_those_of_the_official_field_points(official_files):
    table = Table.read(official_files / "si_zernikes_coron_wfe.fits")
    places = [(r["instrument"].strip(), r["field_point_name"].strip()) for r in table]
    for short_wave, mask in itertools.product((True, False), MASKS):
        channel = f"NIRCam{'SW' if short_wave else 'LW'}A"
        row = table[places.index((channel, f"Z{mask[4:]}_A"))]
        truth = np.array([row[f"Zernike_{k}"] for k in range(1, 37)])
        mine = internal_wavefront_error(mask, short_wave=short_wave)
        np.testing.assert_allclose(mine, truth, rtol=1e-3, atol=1e-18)


@pytest.mark.parametrize(
    ("mask", "filter_name"), list(itertools.product(MASKS, ("F210M", "F444W")))
)
def test_pixels_and_places_are_those_of_the_siaf(mask, filter_name):
    pysiaf = pytest.importorskip("pysiaf")
    place = instrument.detector_place(mask, filter_name)
    assert place.short_wave == is_short_wave(filter_name)
    along = "" if place.place == "-" else f"_{place.place}"
    siaf = pysiaf.Siaf("NIRCam")
    aperture = siaf[f"{place.detector}_FULL_{mask}{along}"]
    scale = (aperture.XSciScale, aperture.YSciScale)
    assert place.siaf_pixelscale == pytest.approx(scale, abs=6e-9)
    whole = siaf[f"{place.detector}_FULL"].det_to_sci(aperture.XDetRef, aperture.YDetRef)
    # The places measured in flight are up to 3.4 pixels from those of the SIAF.
    assert np.add(place.center, 1) == pytest.approx(whole, abs=3.5)
    x, y = aperture.sci_to_idl(aperture.XSciRef + np.array([-40, 40]), np.full(2, aperture.YSciRef))
    assert place.siaf_shear == pytest.approx(np.diff(y) / np.diff(x), abs=1e-4)
