"""The short-wave arm: frames like those of MAST, from reading to the planet."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import small_files
import torch
from astropy import units as u
from astropy.io import fits

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.instrument import detector_place
from pyklip_diffrender.instrument.masks import filter_shift
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.reduction import reduce
from pyklip_diffrender.refinement import FitSettings, refine, settings_for
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.scene.simulation import model_for
from pyklip_diffrender.wavefront import random_opd

SIZE = 36
CENTER = np.array([31.3, 32.6])
PLANET = Planet(3e-4, 0.45, 60.0)
PHOTONS = 1e10  # Of the star, in a frame.
NOISE = 30.0
STAR = (0.002, -0.002)  # arcsec from the middle of the mask.


@cache
def scene(place):
    """Photons of a star and its planet behind MASK335R, 64 x 64 pixels."""
    scale = place.siaf_pixelscale
    model = nircam_coronagraph(
        "F210M" if place.short_wave else "F444W", image_mask="MASK335R",
        npix=256, nlambda=5, fov_pixels=64, pixelscale=scale, shear=place.siaf_shear,
        # Not where the fit starts.
        defaults={"lyot_shift": (-0.006, 0.004), "lyot_rotation": 0.2},
    )  # fmt: skip
    opd = random_opd(1, npix=256).data + random_opd(2, npix=256, rms=5e-9).data
    moved = {"detector_shift": tuple((CENTER - 31.5) * scale)}
    with torch.no_grad():
        light = model(opd, STAR, **moved)
        light += PLANET.contrast * model(opd, tuple(np.add(STAR, PLANET.offset)), **moved)
    return PHOTONS * light.numpy()


def calints(folder, filter="F210M"):
    """Write a frame as MAST delivers it."""
    place = detector_place("MASK335R", filter)
    counts = scene(place)
    sigma = np.sqrt(counts + NOISE**2)
    counts = counts + sigma * np.random.default_rng(0).normal(size=sigma.shape)
    corner = np.round(np.add(place.center, filter_shift(filter)) - CENTER) + 1
    primary = {
        "TELESCOP": "JWST", "EXP_TYPE": "NRC_CORON", "DETECTOR": place.header_detector,
        "MODULE": "A", "FILTER": filter, "PUPIL": "MASKRND", "CORONMSK": "MASKA335R",
        "SUBARRAY": "SUB320A335R", "APERNAME": f"{place.detector}_MASK335R",
        "TARGPROP": "HD 1", "SUBSTRT1": int(corner[0]), "SUBSTRT2": int(corner[1]),
    }  # fmt: skip
    area = float(np.prod(place.siaf_pixelscale))
    science = {"PIXAR_A2": area, "PIXAR_SR": area * 2.35e-11, "ROLL_REF": 0.0, "V3I_YANG": 0.0,
               "CRPIX1": CENTER[0] + 1, "CRPIX2": CENTER[1] + 1}  # fmt: skip
    path = folder / f"jw01000001001_03106_00001_{place.header_detector.lower()}_calints.fits"
    data, error = counts[None] / 1e3, sigma[None] / 1e3
    return small_files.calints(path, data, error, primary=primary, **science)


@pytest.mark.slow
def test_a_planet_is_where_it_is_and_nothing_else(tmp_path):
    """A map that is 5 nm rms off, a star and a stop off their places, and no detector pattern."""
    settings = FitSettings.nircam("F210M", cycles=(5.0,), max_iterations=8)
    frame, opd = calints(tmp_path), random_opd(1, npix=256)
    result = reduce([frame], opd, size=SIZE, settings=settings)
    assert result.pattern is None
    assert result.fit is result.detection.fit
    assert len(result.fit.companions) == 1
    table = result.detection.candidates
    assert len(table) == 1
    # Seven times the stated error, and the tenth by which the star's flux is uncertain.
    assert table["separation"][0].to_value(u.arcsec) == pytest.approx(PLANET.separation, abs=0.008)
    assert table["position_angle"][0].to_value(u.deg) == pytest.approx(60.0, abs=1.0)
    assert float(table["contrast"][0]) == pytest.approx(PLANET.contrast, rel=0.1)


def test_the_model_and_the_settings_are_those_of_the_detector(tmp_path):
    (frame,) = ExposureSequence.from_files([calints(tmp_path)]).science
    assert frame.first_pixel is not None  # The star is where the mask is on NRCA2.
    model = model_for(frame, SIZE)
    place = detector_place("MASK335R", "F210M")
    assert model.setup["filter"] == "F210M"
    assert model.detector.pixelscale == place.siaf_pixelscale
    assert model.between[0].name == "MASK335R"
    assert not model.defaults
    long = FitSettings.nircam("F444W")
    short = settings_for(frame)
    assert short.cycles == long.cycles == (18.0,)
    assert short.deviations["lyot_shift"] > 2 * long.deviations["lyot_shift"]
    ones, header = np.ones((160, 160)), fits.Header({"INSTRUME": "NIRCAM"})
    wide = Observation.from_arrays(ones, ones, pixelscale=0.031, filter="F182M", header=header)
    # A model that is given needs no mask in the header.
    frame.header.update({"CORONMSK": "NONE", "APERNAME": "NRCA2_FULL", "SUBARRAY": "FULL"})
    assert settings_for(frame).deviations == short.deviations
    # 44 cycles reach the edge; memory and time set the bound.
    assert settings_for(wide).cycles == (32.0,)


def test_frames_of_module_b_are_refused(tmp_path):
    """JWST does not observe with it, and its masks are at other places."""
    (frame,) = ExposureSequence.from_files([calints(tmp_path, "F444W")]).science
    frame.header.update({"CORONMSK": "MASKB335R", "SUBARRAY": "SUB320B335R", "MODULE": "B"})
    frame.header.update({"DETECTOR": "NRCBLONG", "APERNAME": "NRCB5_MASK335R"})
    with pytest.raises(IncompatibleSetupError, match="detector NRCBLONG, expected NRCALONG"):
        model_for(frame, SIZE)
    with pytest.raises(IncompatibleSetupError, match="have module B, the model A"):
        refine(nircam_coronagraph("F444W", npix=128, fov_pixels=64), [frame], "flat")
    for key in ("DETECTOR", "APERNAME"):
        del frame.header[key]
    with pytest.raises(IncompatibleSetupError, match="of module B, expected NRCALONG"):
        model_for(replace(frame, name="a frame"), SIZE)


def test_what_is_not_modelled_is_refused(tmp_path):
    path = calints(tmp_path)
    (frame,) = ExposureSequence.from_files([path]).science
    for detector in ("NRCA4", "NRCB1"):
        frame.header["DETECTOR"] = detector
        with pytest.raises(IncompatibleSetupError, match=f"{detector}, expected NRCA2"):
            model_for(frame, SIZE)
    fits.setval(path, "INSTRUME", value="MIRI")
    with pytest.raises(NoValidPixelsError, match="taken with MIRI; only NIRCam"):
        ExposureSequence.from_files([path])


def test_the_place_along_a_bar_is_that_of_the_header():
    ones = np.ones((24, 24))
    cards = {"INSTRUME": "NIRCAM", "CORONMSK": "MASKALWB", "APERNAME": "NRCA5_MASKLWB_NARROW"}
    header = fits.Header(cards)
    frame = Observation.from_arrays(ones, ones, pixelscale=0.063, filter="F335M", header=header)
    model = model_for(frame, monochromatic=3.35e-6)
    assert model.setup["pupil_mask"] == "MASKBAR"
    assert not model.defaults  # This stop was not measured in flight.
    known = FitSettings.nircam("F335M").deviations["lyot_rotation"]
    assert settings_for(frame).deviations["lyot_rotation"] > 2 * known
    # The narrow end is 8.3 arcsec from the middle of a bar of 20.
    assert model.between[0].reach[0] == pytest.approx(18.30, abs=0.01)
    # With fewer samples a copy of the star would be hidden as well, and be taken off twice.
    with pytest.raises(IncompatibleSetupError, match="npix: got 128"):
        model_for(frame, npix=128)
    opd = random_opd(1, npix=256)
    hidden, beside = (float(model(opd, (0.0, y)).sum()) for y in (0.0, 0.6))
    assert hidden < 0.05 * beside
