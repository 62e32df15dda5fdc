"""``pyklip.fm.klip_dataset`` with ``algo="diffrender"``: the forward model of a planet."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from astropy.io import fits
from backend_scene import ANGLES as THREE
from backend_scene import FLUX, LINEAR, NEW, NUMERICS, OLD, OPD, SKY, frames, generic, render
from pyklip import fm
from pyklip.fmlib.fmpsf import FMPlanetPSF
from pyklip.fmlib.nofm import NoFM
from pyklip.klip import rotate
from pyklip.parallelized import klip_dataset

from pyklip_diffrender.detection import detect
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.pyklip_backend import DiffrenderSettings, backend, register, unregister
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.wavefront.bases import default_basis

# Of pyKLIP's spline through the user's PSF.
pytestmark = pytest.mark.filterwarnings("ignore:.*rank deficient:UserWarning")

PIXEL, SIDE, STAMP = 0.062424185, 40, 17
ANGLES, CENTER = (15.0, 85.0), np.array([19.8, 19.4])
MODES = np.array([1, 3])
SEPARATION, PA, CONTRAST = 11.3, 25.0, 1e-6


@pytest.fixture(scope="module")
def model():
    return nircam_coronagraph("F444W", fov_pixels=SIDE, **NUMERICS)


def place(angle, flipx=False, separation=SEPARATION, pa=PA):
    """x, y in arcsec of the planet in a frame that pyKLIP turns by an angle."""
    direction = np.radians(90 + (-pa if flipx else pa) - angle)
    return PIXEL * separation * np.array([np.cos(direction), np.sin(direction)])


def image(model, opd, source, shift):
    source, shift = torch.as_tensor(source), torch.as_tensor(shift)
    with torch.no_grad():
        return FLUX * model(opd, star_offset=source, detector_shift=shift).double().numpy()


def shots(model, opd, flipx=False):
    """The star and its planet in every roll, without noise."""
    shift = PIXEL * (CENTER - (SIDE - 1) / 2)
    star = [image(model, opd, np.zeros(2), shift) + SKY for _ in ANGLES]
    planet = [CONTRAST * image(model, opd, place(angle, flipx), shift) for angle in ANGLES]
    return np.array(star), np.array(planet)


def dataset(cube, model, errors, **settings):
    made = generic(cube, ANGLES, center=CENTER)
    made.diffrender = DiffrenderSettings(
        **{"opd": OLD, "model": model, "error": errors, "settings": LINEAR, **settings}
    )
    return made


def planet_psf(opd, made, separation=SEPARATION, pa=PA, contrast=CONTRAST):
    """The planet as a user gives it: one PSF for each roll, half as bright, twice its flux."""
    camera = nircam_coronagraph("F444W", fov_pixels=STAMP, **NUMERICS)
    places = [place(angle, made.flipx, separation, pa) for angle in ANGLES]
    stamps = [[0.5 * image(camera, opd, each, -each)] for each in places]
    return FMPlanetPSF(
        made.input.shape, MODES, separation, pa, contrast, np.array(stamps), np.unique(made.wvs),
        flux_conversion=np.full(len(made.input), 2.0), spectrallib=[np.ones(1)],
        spectrallib_units="contrast", input_psfs_pas=np.array(ANGLES),
    )  # fmt: skip


def modelled(made, fm_class, folder, **options):
    """Forward model and product."""
    folder.mkdir(exist_ok=True)
    fm.klip_dataset(
        made, fm_class, **{
            "mode": "ADI", "annuli": 1, "subsections": 1, "numbasis": MODES, "movement": 0,
            "numthreads": 1, "outputdir": str(folder), "fileprefix": "x",
            "mute_progression": True, **options,
        },
    )  # fmt: skip
    paths = [folder / f"x-{kind}-KLmodes-all.fits" for kind in ("fmpsf", "klipped")]
    read = [fits.getdata(p).astype(float) if p.exists() else None for p in paths]
    return read[0], read[1]


@pytest.fixture(autouse=True)
def _registered():
    register(opd=OPD)
    yield
    unregister()


def added(model, truth, folder, flipx=False, highpass=False, **settings):
    """What a planet adds to the product, its forward model, its own image turned, the dataset."""
    star, planet = shots(model, truth, flipx)
    products = []
    for cube in (star, star + planet):
        made = dataset(cube, model, np.sqrt(star), **settings)
        made.flipx = flipx
        of_planet, product = modelled(
            made, planet_psf(truth, made), folder, algo="diffrender", highpass=highpass
        )
        products.append(product)
    np.testing.assert_array_equal(np.isnan(of_planet), np.isnan(product))
    difference = (products[1] - products[0])[0]
    # The pedestal that is subtracted from the product is not part of the model.
    difference -= np.nanmedian(difference - of_planet[0])
    turned = [rotate(*each, CENTER, flipx=flipx) for each in zip(planet, ANGLES, strict=True)]
    return difference, of_planet[0], np.nanmean(turned, axis=0), made


def near_planet():
    """Pixels of the product about the planet."""
    y, x = np.indices((SIDE, SIDE))
    direction = np.radians(PA)
    east, north = SEPARATION * np.sin(direction), SEPARATION * np.cos(direction)
    return np.asarray(np.hypot(x - CENTER[0] + east, y - CENTER[1] - north) < 7)


def away(image, other):
    """Root mean square of a difference about the planet, in units of that of an image."""
    near = near_planet()
    return float(np.sqrt(np.mean((image - other)[near] ** 2) / np.mean(image[near] ** 2)))


def test_the_forward_model_is_what_a_planet_adds_to_the_product(model, tmp_path):
    """The fit of flux and background is linear, so that the forward model is exact."""
    difference, of_planet, planet, made = added(model, OLD.data, tmp_path, flipx=True)
    assert away(difference, of_planet) < 0.015
    assert away(difference, planet) > 0.1
    assert np.shape(made.fmout) == np.shape(made.output) == (2, 2, SIDE, SIDE)
    assert np.shape(made.perturbmag) == (2, 2)

    of_all, header = fits.getdata(tmp_path / "x-fmpsf-KLmodes-all.fits", header=True)
    np.testing.assert_array_equal(of_all[0], of_all[1])
    assert (header["FM_SEP"], header["FM_PA"]) == (SEPARATION, PA)
    assert (header["PSFCENTX"], header["PSFCENTY"]) == tuple(CENTER)
    assert (header["KLMODE0"], header["KLMODE1"], header["DRALGO"]) == (1, 3, "diffrender")
    direction = np.radians(PA)
    x = CENTER[0] - SEPARATION * np.sin(direction)
    peak = np.unravel_index(np.nanargmax(of_planet), of_planet.shape)
    np.testing.assert_allclose(peak, (CENTER[1] + SEPARATION * np.cos(direction), x), atol=1.0)


def test_the_products_say_what_the_fit_knows_of_the_planet(model, tmp_path):
    """The planet itself, wherever the guess is, with the errors of photon noise and star."""
    star, planet = shots(model, OLD.data, flipx=True)
    made = dataset(star + planet, model, np.sqrt(star))
    made.flipx = True
    guess = planet_psf(OLD.data, made, SEPARATION + 0.4, PA - 2.0, 1.3 * CONTRAST)
    modelled(made, guess, tmp_path, algo="diffrender")
    result = made.diffrender_results[0].subtraction.fits[0].result
    direction = np.radians(PA)
    for kind in ("fmpsf", "klipped"):
        header = fits.getheader(tmp_path / f"x-{kind}-KLmodes-all.fits")
        assert header["DRFMFLUX"] == pytest.approx(1 / 1.3, rel=0.02)
        assert header["DRFMRA"] == pytest.approx(SEPARATION * np.sin(direction), abs=0.01)
        assert header["DRFMDE"] == pytest.approx(SEPARATION * np.cos(direction), abs=0.01)
        snr = detect(result).measure([place(ANGLES[0], flipx=True)])["snr"][0]
        # Position and flux are independent of each other to first order.
        assert header["DRFMFLUX"] / header["DRFMFERR"] == pytest.approx(snr, rel=0.1)
        assert 1 / snr < header["DRFMRAER"] < 3 / snr
        assert 1 / snr < header["DRFMDEER"] < 3 / snr


def test_errors_include_the_scatter_of_the_search(model, tmp_path, monkeypatch):
    """Three times the errors where the S/N of the search scatters by three."""
    star, planet = shots(model, OLD.data)
    axis = PIXEL * np.arange(-40.0, 41.0)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    distance = np.hypot(grid[..., 0], grid[..., 1])
    factor = ErrorFactor(2 + distance / (PIXEL * SEPARATION), np.full((81, 81), 50.0), grid)
    headers = []
    for found in (ErrorFactor.constant(1.0), factor):
        monkeypatch.setattr(
            "pyklip_diffrender.reduction.pipeline.detect",
            lambda fit, f=found, **options: replace(detect(fit, **options), error_factor=f),
        )
        made = dataset(star + planet, model, np.sqrt(star))
        modelled(made, planet_psf(OLD.data, made), tmp_path, algo="diffrender")
        headers.append(fits.getheader(tmp_path / "x-klipped-KLmodes-all.fits"))
    assert [each["DRFMFACT"] for each in headers] == pytest.approx([1.0, 3.0], rel=0.02)
    for name in ("DRFMFERR", "DRFMRAER", "DRFMDEER"):
        assert headers[1][name] == pytest.approx(3 * headers[0][name], rel=0.02)
    assert headers[1]["DRFMFLUX"] == headers[0]["DRFMFLUX"]


@pytest.mark.slow
def test_a_high_pass_filter_applies_to_the_forward_model(model, tmp_path):
    difference, of_planet, _, _ = added(model, OLD.data, tmp_path, highpass=8.0)
    star, planet = shots(model, OLD.data)
    made = dataset(star + planet, model, np.sqrt(star))
    plain = modelled(made, planet_psf(OLD.data, made), tmp_path, algo="diffrender")[0][0]
    # The user's PSF, which sets the flux, is not filtered here, so that only shapes compare.
    near = near_planet()
    alike = np.corrcoef([each[near] for each in (difference, of_planet, plain)])
    assert 1 - alike[0, 1] < 0.001
    assert 1 - alike[0, 2] > 0.003


@pytest.mark.slow
def test_a_planet_of_the_fit_loses_no_light(model, tmp_path):
    star, planet = shots(model, OLD.data)
    known = replace(LINEAR, companions=(Planet.from_offset(CONTRAST, *place(ANGLES[0])),))
    made = dataset(star + planet, model, np.sqrt(star), settings=known)
    of_planet, product = modelled(made, planet_psf(OLD.data, made), tmp_path, algo="diffrender")
    turned = [rotate(*each, CENTER) for each in zip(planet, ANGLES, strict=True)]
    assert away(of_planet[0], np.nanmean(turned, axis=0)) < 0.015
    assert away(of_planet[0], product[0] - np.nanmedian(product[0] - of_planet[0])) < 0.02


@pytest.mark.slow
def test_the_wavefront_takes_what_the_forward_model_says(model, tmp_path):
    fit = FitSettings(basis=default_basis(10.0), response_npix=128)
    difference, of_planet, planet, made = added(model, NEW, tmp_path, settings=fit)
    assert made.diffrender_results[0].subtraction.fits[0].result.status.name == "CONVERGED"
    assert away(difference, of_planet) < 0.1
    assert away(difference, planet) > 0.3


def test_without_a_forward_model_the_product_is_that_of_klip_dataset(model, tmp_path):
    cube = frames(THREE, np.random.default_rng(3))
    made = generic(cube, THREE)
    made.diffrender = DiffrenderSettings(subtractor=render)
    options = {
        "mode": "ADI", "annuli": 2, "subsections": 1, "numbasis": MODES, "movement": 0,
        "numthreads": 1, "outputdir": str(tmp_path), "fileprefix": "x", "algo": "diffrender",
        "aligned_center": [22.0, 24.0], "time_collapse": "weighted-mean",
    }  # fmt: skip
    _, product = modelled(made, NoFM(cube.shape, MODES), tmp_path, **options)
    assert not (tmp_path / "x-fmpsf-KLmodes-all.fits").exists()
    cards = fits.getheader(tmp_path / "x-klipped-KLmodes-all.fits")
    klip_dataset(made, verbose=False, **options)
    expected, header = fits.getdata(tmp_path / "x-KLmodes-all.fits", header=True)
    np.testing.assert_allclose(product, expected, atol=1e-4)
    for key in ("PSFCENTX", "PSFCENTY", "KLMODE1", "CTYPE3", "DRSTAT", "DRSHA256"):
        assert cards[key] == header[key]
    inside = modelled(made, NoFM(cube.shape, MODES), tmp_path, **{**options, "annuli": [(5, 9)]})[1]
    y, x = np.nonzero(np.isfinite(inside[0]))
    radius = np.hypot(x - 22, y - 24)
    assert (radius.min(), radius.max()) == pytest.approx((5, 9), abs=0.5)


def test_what_cannot_be_modelled_says_what_can(model, tmp_path):
    star, _ = shots(model, OLD.data)

    def run(fm_class=None, **settings):
        made = dataset(star, model, np.sqrt(star), **settings)
        fm_class = planet_psf(OLD.data, made) if fm_class is None else fm_class
        modelled(made, fm_class, tmp_path, algo="diffrender")

    class Other(NoFM):
        """Another forward model."""

    with pytest.raises(IncompatibleSetupError, match=r"Other is not .*FMPlanetPSF and NoFM"):
        run(Other(star.shape, MODES))
    with pytest.raises(IncompatibleSetupError, match="needs the linear model"):
        run(subtractor=render)
    planet = planet_psf(OLD.data, generic(star, ANGLES))
    planet.sep = 40.0
    with pytest.raises(IncompatibleSetupError, match=r"40\.0 pixels from the star, outside the 40"):
        run(planet)
    assert not list(tmp_path.iterdir())


def test_klip_forward_modelling_is_unchanged(tmp_path):
    cube = frames(THREE, np.random.default_rng(3))

    def run(**options):
        made = generic(cube, THREE)
        modelled(made, NoFM(cube.shape, MODES[:1]), tmp_path, numbasis=MODES[:1], **options)
        return np.asarray(made.output)

    unregister()
    expected = run()
    assert np.isfinite(expected).any()
    register(opd=OPD, subtractor=render)
    np.testing.assert_array_equal(run(), expected)
    with backend(force=False):
        np.testing.assert_array_equal(run(), expected)
    with backend():
        assert not np.array_equal(run(), expected, equal_nan=True)
    with pytest.raises(TypeError, match="algo"):
        run(algo="klip")
