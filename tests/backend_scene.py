"""Small datasets for the tests of the backend, with a star that can be rendered exactly."""

import numpy as np
import small_files
from astropy.io import fits
from pyklip.parallelized import klip_dataset

from pyklip_diffrender.pyklip_backend import Fit, Subtraction
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.wavefront import random_opd
from pyklip_diffrender.wavefront.opd import as_opd_map, random_drift

SHAPE = (48, 44)
CENTER = (21.25, 24.5)
RIPPLE = 2e-9 * np.hypot(*np.mgrid[-32:32, -32:32])
OPD = as_opd_map(RIPPLE)
BACKGROUND = 3.0
ANGLES = (0.0, 20.0, 45.0)

NUMERICS = {"npix": 128, "occulter_sampling": 2.0, "monochromatic": 4.44e-6}
"""Of models that are fitted."""

OLD = random_opd(1, npix=128)
NEW = OLD.data + random_drift(2, 40.0, npix=128).data
FLUX, SKY = 1e10, 100.0
LINEAR = FitSettings(free=("flux", "background"), wavefront=False)


def in_place_of_fits(monkeypatch, subtract):
    """Give the backend another subtractor, which gets the references as the default one does."""
    monkeypatch.setattr(
        "pyklip_diffrender.pyklip_backend.klip_call.subtract_by_refinement", subtract
    )


def reduced(dataset, folder, prefix="x", **options):
    """Run klip_dataset and give name -> (data, header) of all files it left."""
    folder.mkdir(exist_ok=True)
    options = {
        "mode": "ADI", "annuli": 1, "subsections": 1, "numbasis": [1, 2], "movement": 0,
        "numthreads": 1, "verbose": False, "algo": "diffrender", **options,
    }  # fmt: skip
    klip_dataset(dataset, outputdir=str(folder), fileprefix=prefix, **options)
    return {path.name: fits.getdata(path, header=True) for path in sorted(folder.glob("*.fits"))}


def psf(x, y, shape=SHAPE):
    """A speckled star at (x, y), peak about 1: not round, so that flips and turns show."""
    j, i = np.indices(shape)
    dx, dy = i - x, j - y
    r2 = dx**2 + dy**2
    return np.exp(-r2 / 18) * (1 + 0.3 * np.cos(0.9 * dx + 0.4 * dy)) + 0.02 / (1 + r2 / 60)


def planet(x, y, shape=SHAPE):
    j, i = np.indices(shape)
    return np.exp(-((i - x) ** 2 + (j - y) ** 2) / (2 * 1.4**2))


def frames(angles, rng, noise=0.05):
    """Star, background and a companion 12 pixels up on the sky, one frame for each angle."""
    cube = []
    for angle in angles:
        # pyKLIP will turn the frame counter-clockwise by the angle: the companion is behind it.
        t = np.radians(90 - angle)
        companion = planet(CENTER[0] + 12 * np.cos(t), CENTER[1] + 12 * np.sin(t))
        cube.append(1000 * psf(*CENTER) + BACKGROUND + 2 * companion)
    return np.array(cube) + rng.normal(0, noise, (len(cube), *SHAPE))


def generic(imgs, angles, wvs=None, **kw):
    """Make a GenericData as in scripts: no FITS header anywhere."""
    from pyklip.instruments.Instrument import GenericData

    n = len(imgs)
    return GenericData(
        np.array(imgs), np.tile(kw.pop("center", CENTER), (n, 1)),
        parangs=np.asarray(angles, dtype=float),
        wvs=np.full(n, 4.44) if wvs is None else np.asarray(wvs), IWA=3,
        filenames=np.array([f"frame{i}" for i in range(n)]), **kw,
    )  # fmt: skip


def render(observation, opd, settings):
    """Least-squares fit of the true star and a background: an honest, tiny subtractor."""
    star = np.empty_like(observation.data)
    chi2 = 0.0
    for i, (x, y) in enumerate(observation.center):
        good = observation.valid[i]
        terms = np.stack([psf(x, y, star.shape[1:]), np.ones(star.shape[1:])])
        a, b = terms[:, good] / observation.error[i][good], observation.data[i][good]
        weights, *_ = np.linalg.lstsq(a.T, b / observation.error[i][good], rcond=None)
        star[i] = np.tensordot(weights, terms, 1)
        chi2 += float(np.mean(((star[i] - observation.data[i]) / observation.error[i])[good] ** 2))
    fit = Fit(tuple(range(len(star))), "CONVERGED", chi2 / len(star), observation)
    return Subtraction(star, (fit,))


def calints(path, rng, roll=0.0, center=(20.7, 25.2), nints=2, **cards):
    """Write a file as the JWST pipeline does and return its pixels; two pixels are flagged.

    `cards` are further ones of the primary header.
    """
    data = np.array([1000 * psf(*center) + BACKGROUND for _ in range(nints)])
    data += rng.normal(0, 0.05, data.shape)
    flags = np.zeros(data.shape, np.uint32)
    flags[:, 30, 30], data[:, 30, 30] = 1, 5e3
    flags[:, 8, 9] = 512
    primary = {
        "TELESCOP": "JWST", "EXP_TYPE": "NRC_CORON", "PUPIL": "MASKRND", "CORONMSK": "MASKA335R",
        "XOFFSET": 0.0, "YOFFSET": 0.0, "DATE-BEG": "2022-07-30T01:02:03", "TARGPROP": "TARGET",
    }  # fmt: skip
    small_files.calints(
        path, data.astype(np.float32), np.full(data.shape, 0.05, np.float32), flags,
        primary={**primary, **cards}, PIXAR_A2=0.062424185**2, CRPIX1=center[0] + 1,
        CRPIX2=center[1] + 1, CRVAL1=201.0, CRVAL2=-51.0, ROLL_REF=roll, V3I_YANG=0.0,
    )  # fmt: skip
    return data
