"""Frames that `calc_psf` of the real stpsf and poppy made, fitted with converted models."""

import numpy as np
import poppy
import pytest
from astropy import units as u
from astropy.io import fits
from poppy.poppy_core import PlaneType

import pyklip_diffrender as dr
from benchmarks.noisy_stars import READ_NOISE, observed
from benchmarks.stpsf_data import lopsided
from pyklip_diffrender.bridges import from_poppy, from_webbpsf
from pyklip_diffrender.instrument.masks import lyot_openings
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.refinement import FitSettings, Status
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import FourierModes


def check(model, before, later, images, planet, flux, seen, settings, seed=5):
    """The drift is recovered, and the planet measured.

    `images` are those of the star and of the planet's place by the other code, with the `later`
    wavefront; `seen` is where light passes the stop.
    """
    star, light = images
    truth, design = flux * star, np.stack([np.ones(seen.sum()), *np.nonzero(seen)], axis=1)

    def error_of(image):
        """Rms of a star model's error over the noise."""
        return float(np.sqrt(np.mean((image - truth) ** 2 / (truth + READ_NOISE**2))))

    def unseen_rms(opd):
        """Rms of a wavefront's error behind the stop, piston and tilt apart, m."""
        away = (opd - later)[seen]
        return float(np.std(away - design @ np.linalg.lstsq(design, away, rcond=None)[0]))

    frame = observed(truth + flux * planet.contrast * light, seed, model.detector.pixelscale)
    fit = dr.refine(model, frame, before, settings=settings)
    assert fit.status is Status.CONVERGED
    outdated = error_of(flux * model(before).numpy())
    assert outdated > 3
    assert error_of(fit.frames[0].star - fit.frames[0].values["background"][0]) < 0.15 * outdated
    assert unseen_rms(fit.wavefront) < 0.5 * unseen_rms(before)
    (row,) = dr.detect(fit).candidates
    away = abs(float(row["contrast"]) - planet.contrast)
    assert away < 3 * row["contrast_error"]
    assert away < 0.1 * planet.contrast
    for axis, true in zip("xy", planet.offset, strict=True):
        assert abs(row[axis].value - true) < 3 * row[f"{axis}_error"].value


def nircam(folder, npix, opd=None, **options):
    import stpsf

    instrument = stpsf.NIRCam()
    instrument.filter = "F444W"
    instrument.image_mask, instrument.pupil_mask = "MASK335R", "MASKRND"
    instrument.pupil = str(folder / f"jwst_pupil_RevW_npix{npix}.fits.gz")
    instrument.options.update(options)
    if opd is not None:
        instrument.pupilopd = opd
    return instrument


@pytest.mark.slow
def test_a_frame_made_by_stpsf(stpsf_path):
    """NIRCam's round mask after the telescope has drifted by 10 nm, with all of the detector.

    That conversions agree on STScI's own files at 1024 samples is shown in test_parity_stpsf.py.
    """
    npix = 256
    call = {"monochromatic": 4.5e-6, "fov_pixels": 40, "fft_oversample": 2}
    call["detector_oversample"] = 1
    with fits.open(stpsf_path / "JWST_OTE_OPD_cycle1_example_2022-07-30.fits") as hdus:
        opd = hdus[0].data + lopsided(npix, 77, 10e-9) * (hdus[0].data != 0)
        drifted = fits.HDUList([fits.PrimaryHDU(opd, hdus[0].header)])
    planet = Planet(3e-5, 0.7, 60.0)
    offset = dict(zip(("source_offset_x", "source_offset_y"), planet.offset, strict=True))
    images = (
        nircam(stpsf_path, npix, drifted, **options).calc_psf(**call)["DET_DIST"].data
        for options in ({}, offset)
    )
    model = from_webbpsf(nircam(stpsf_path, npix), add_distortion=True, **call)
    later = from_webbpsf(nircam(stpsf_path, npix, drifted), **call).entrance.opd
    stop = polygon_coverage(lyot_openings("MASKRND")[1:], PupilGrid.full(npix)).numpy() > 0.5
    check(
        model, model.entrance.opd.numpy(), later.numpy(), images, planet, 3e10,
        stop & model.entrance.lit.numpy(), FitSettings(cycles=8.0, response_npix=64), seed=8,
    )  # fmt: skip


DIAMETER = 2.4


def coronagraph(opd, planet=None):
    """A telescope of 2.4 m with one strut, a hard-edged spot and a ring-shaped stop."""
    npix = len(opd)
    y, x = (np.mgrid[:npix, :npix] - (npix - 1) / 2) * DIAMETER / npix
    radius = np.hypot(x, y)
    strut = (np.abs(x - 0.1) < 0.03) & (y > 0)
    system = poppy.OpticalSystem(oversample=1, npix=npix, verbose=False)
    system.pupil_diameter = DIAMETER * u.m
    sampling = {"pixelscale": DIAMETER / npix * u.m / u.pixel, "planetype": PlaneType.pupil}
    primary = ((radius < 0.5 * DIAMETER) & (radius > 0.18 * DIAMETER) & ~strut).astype(float)
    system.add_pupil(
        poppy.ArrayOpticalElement(name="primary", transmission=primary, opd=opd, **sampling)
    )
    system.add_inversion(axis="y")
    system.add_image(poppy.CircularOcculter(name="spot", radius=0.35))
    stop = stop_of(npix).astype(float)
    system.add_pupil(poppy.ArrayOpticalElement(name="stop", transmission=stop, **sampling))
    system.add_detector(pixelscale=0.06, fov_pixels=28, oversample=1)
    if planet is not None:
        system.source_offset_r = planet.separation
        system.source_offset_theta = planet.position_angle
    return system


def stop_of(npix):
    y, x = (np.mgrid[:npix, :npix] - (npix - 1) / 2) / npix
    return (np.hypot(x, y) < 0.42) & (np.hypot(x, y) > 0.24)


def test_a_frame_made_by_poppy():
    """Somebody's own coronagraph, whose modes are not those of JWST's segments."""
    npix, wave = 64, 1.6e-6
    before = lopsided(npix, 1, 30e-9)
    # A part of a map has lower frequencies across the pupil than the whole.
    later = before + lopsided(2 * npix, 2, 10e-9)[:npix, :npix]
    planet = Planet(1e-4, 0.7, 130.0)
    model = from_poppy(coronagraph(before), wave)
    images = (
        np.asarray(coronagraph(later, source).calc_psf(wave * u.m)[0].data, dtype=float)
        for source in (None, planet)
    )
    free = ("star_offset", "flux", "background")
    settings = FitSettings(basis=FourierModes(5.0), free=free, response_npix=npix)
    check(model, before, later, images, planet, 5e8, stop_of(npix), settings)


def test_the_segments_of_jwst_are_no_modes_of_another_telescope():
    """Even of one in which JWST would have a place."""
    osys = poppy.OpticalSystem(oversample=1, npix=64)
    osys.add_pupil(poppy.CircularAperture(radius=4.0, pad_factor=1.0))
    osys.add_detector(pixelscale=0.06, fov_pixels=16)
    model = from_poppy(osys, 4.4e-6)
    image = 1e6 * model().numpy()
    observation = Observation.from_arrays(image, np.sqrt(image + 1), pixelscale=0.06)
    settings = FitSettings(cycles=3, free=("flux",), response_npix=64)
    fit = dr.refine(model, observation, np.zeros((64, 64)), settings=settings)
    assert fit.basis.groups == ("texture",)
    assert fit.status.usable
