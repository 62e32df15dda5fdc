"""The same files, map and settings give one answer in every door of the package.

Doors are `reduce`, `klip_dataset` with ``algo="diffrender"``, `spaceklip.run_obs` and a survey.
"""

import contextlib
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from astropy.io import fits
from small_world import header_of
from test_spaceklip import KEY, StandIn, concatenation

import pyklip_diffrender as dr
from benchmarks.calints_files import SIDE, calints
from pyklip_diffrender import spaceklip
from pyklip_diffrender.detection import search
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.io.units import half_circle
from pyklip_diffrender.options import QUICK_SIDE
from pyklip_diffrender.pattern import PatternLibrary
from pyklip_diffrender.pattern.library import package_library
from pyklip_diffrender.pyklip_backend.registration import reduce_jwst_files
from pyklip_diffrender.refinement import FitSettings, fitting
from pyklip_diffrender.scene import frame_file
from pyklip_diffrender.scene.aligned_frames import shift_frames
from pyklip_diffrender.scene.observation import Observation, Window
from pyklip_diffrender.scene.simulation import model_for
from pyklip_diffrender.surveys import driver, jobs
from pyklip_diffrender.wavefront import random_opd

pytestmark = pytest.mark.usefixtures("offline")

SIZE = 36
OPD = 0.1 * random_opd(1, npix=128).data
"""Metres; so small that the star is as symmetric as real ones."""
FLUX = 5e8
"""Of the star, in MJy/sr and pixels: about 150 MJy/sr at the brightest pixel."""
PLANET = (4e-5, 0.9, 120.0)
"""Contrast, separation (arcsec) and position angle (degrees)."""
ROLLS = ((70.0, (88.7, 91.3)), (80.0, (87.9, 91.6)))
"""Roll angle, and x, y of the star: so near to each other that the rolls are cut alike, and so far
that each alone is cut elsewhere."""
SETTINGS = {"cycles": 3.0, "max_iterations": 15, "max_companions": 0, "response_npix": 128}


def small_model(observation, size=None, **options):
    """Make a model of one wavelength, that in the name of the filter."""
    wavelength = int(str(observation.filter)[1:4]) * 1e-8
    return model_for(observation, size, monochromatic=wavelength, npix=128, **options)


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """Small models without the package's library, whose pattern these frames do not have."""
    monkeypatch.setattr("pyklip_diffrender.reduction.pipeline.model_for", small_model)
    monkeypatch.setattr("pyklip_diffrender.pyklip_backend.subtract.model_for", small_model)
    monkeypatch.setattr("pyklip_diffrender.pattern.choice.package_library", PatternLibrary)
    monkeypatch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"no picture")


@pytest.fixture(scope="module")
def light():
    """Function of the roll angle and the star's place that makes star and planet, MJy/sr."""
    ones = np.ones((SIDE, SIDE))
    header = header_of("F444W")
    blank = Observation.from_arrays(ones, ones, pixelscale=0.0624, filter="F444W", header=header)
    model = small_model(blank)

    def image(roll, center):
        contrast, separation, angle = PLANET
        # The position angle of the +y axis is ROLL_REF minus V3I_YANG.
        turn = np.radians(angle - (roll + 0.05))
        place = separation * np.array([-np.sin(turn), np.cos(turn)])
        away = (np.array(center) - (SIDE - 1) / 2) * model.detector.pixelscale
        with torch.no_grad():
            star, planet = (
                model(OPD, star_offset=offset, detector_shift=tuple(away)).numpy()
                for offset in ((0.0, 0.0), tuple(place))
            )
        return np.asarray(FLUX * (star + contrast * planet), dtype=float)

    return image


def written(folder, light, *, aligned, integrations=2):
    """Write two rolls of some integrations, as the pipeline or spaceKLIP does."""
    paths = []
    for k, (roll, center) in enumerate(ROLLS, 1):
        cards = {
            "CRPIX1": center[0] + 1, "CRPIX2": center[1] + 1, "PIXAR_A2": 0.0624**2,
            "SUBSTRT1": 640 - 88 + 1, "SUBSTRT2": 1674 - 91 + 1,
        }  # fmt: skip
        path = calints(
            folder / f"jw01184{k:03d}001_03106_00001_nrcalong_calints.fits",
            observation=k, roll=roll, integrations=integrations, cards=cards,
            light=light(roll, center),
        )  # fmt: skip
        with fits.open(path, mode="update") as hdus:
            science = hdus["SCI"].header
            science["PIXAR_SR"] = 9.2e-14
            science["CRVAL1"], science["CRVAL2"] = 100.0, 20.0
            science["CTYPE1"], science["CTYPE2"] = "RA---TAN", "DEC--TAN"
            if aligned:
                middle = np.array([SIDE - 1, SIDE - 1]) / 2
                shifts = np.tile(middle - center, (integrations, 1))
                for name in ("SCI", "ERR"):
                    moved = shift_frames(hdus[name].data.astype(float), shifts)
                    hdus[name].data = moved.astype(np.float32)
                science["CRPIX1"], science["CRPIX2"] = middle + 1
                science["STARCENX"], science["STARCENY"] = middle + 1
                hdus.append(fits.ImageHDU(shifts, name="IMSHIFTS"))
                hdus.append(fits.ImageHDU(np.zeros((integrations, 2)), name="MASKOFFS"))
        paths.append(path)
    return paths


def map_file(folder):
    """Write the OPD map, which surveys read from a file."""
    path = folder / "opd.fits"
    fits.PrimaryHDU(OPD, fits.Header({"BUNIT": "m"})).writeto(path, overwrite=True)
    return path


def settings_of(files):
    """Settings that do not take the files to be opened by the package."""
    passband = fits.getheader(files[0])["FILTER"]
    return FitSettings.nircam(passband, image_mask="MASK335R", **SETTINGS)


def through_reduce(files, folder):
    return dr.reduce(files, map_file(folder), size=SIZE, settings=settings_of(files))


def through_klip_dataset(files, folder):
    settings = {"opd": map_file(folder), "size": SIZE, "settings": settings_of(files)}
    reduce_jwst_files(files, folder=folder, prefix="x", **settings)


def through_spaceklip(files, folder):
    database = StandIn(folder, {KEY: concatenation([str(path) for path in files])})
    spaceklip.run_obs(database, opd=map_file(folder), size=SIZE, settings=settings_of(files))


def through_a_survey(files, folder):
    sequence = {"files": [str(each) for each in files], "opd": str(map_file(folder))}
    sequence |= {"size": SIZE, "settings": SETTINGS}
    dr.survey({"workers": 0, "sequence": [sequence]}, folder / "survey")


def shares_pattern(observations, pattern):
    """Whether frames show the same pixels of the detector, whose pattern is one unknown then."""
    places = {(each.first_pixel, each.shape) for each in observations}
    return pattern is not None and len(places) == 1 and None not in next(iter(places))


def assert_same_frames(ours, others, rtol=1e-6):
    """Assert that the same pixels are fitted, as an average for a fit that comes from a file."""
    assert len(ours) == len(others)
    for one, other in zip(ours, others, strict=True):
        assert (one.first_pixel, one.shape) == (other.first_pixel, other.shape)
        assert half_circle(one.position_angle - other.position_angle) == pytest.approx(0, abs=1e-9)
        assert one.star_offset == other.star_offset
        one, other = (each if len(each) == 1 else each.combined() for each in (one, other))
        np.testing.assert_allclose(other.center, one.center, atol=1e-6)
        np.testing.assert_array_equal(other.valid, one.valid)
        # A file has zeros in pixels that are left out.
        fitted = one.valid
        np.testing.assert_allclose(other.data[fitted], one.data[fitted], rtol=rtol, atol=1e-6)
        np.testing.assert_allclose(other.error[fitted], one.error[fitted], rtol=rtol)


class Stopped(Exception):
    """The fit would begin now."""


class Call(NamedTuple):
    """Arguments of a fit."""

    science: tuple[Observation, ...]
    opd: Any
    pattern: Any
    settings: Any


@pytest.fixture
def calls(monkeypatch):
    """Fits that would begin; all of them stop there."""
    begun = []

    def refine(model, science, opd, **options):
        begun.append(Call(tuple(science), opd, options["pattern"], options["settings"]))
        raise Stopped

    monkeypatch.setattr("pyklip_diffrender.reduction.pipeline.refine", refine)
    return begun


def counting(function, calls, name):
    """A function that also counts its calls."""

    def counted(*args, **options):
        calls[name] += 1
        return function(*args, **options)

    return counted


def assert_same_call(one, other):
    assert_same_frames(one.science, other.science)
    assert one.settings == other.settings
    assert one.opd.sha256 == other.opd.sha256
    ours, others = one.pattern, other.pattern
    assert (ours is None) == (others is None)
    if ours is not None:
        assert ours.name == others.name
        np.testing.assert_array_equal(ours.value, others.value)
        np.testing.assert_array_equal(ours.error, others.error)
    assert shares_pattern(one.science, ours) == shares_pattern(other.science, others)


@pytest.fixture(scope="module")
def expected():
    """What `reduce` begins with, for unaligned and aligned files."""
    return {}


@pytest.mark.parametrize(
    ("door", "aligned"),
    [(through_klip_dataset, False), (through_klip_dataset, True), (through_spaceklip, True),
     (through_a_survey, False)],
)  # fmt: skip
def test_every_door_begins_the_same_fit(door, aligned, light, tmp_path, calls, expected):
    files = written(tmp_path, light, aligned=aligned)
    for each in (door,) if aligned in expected else (through_reduce, door):
        with contextlib.suppress(Stopped, ExceptionGroup, DiffrenderError):
            each(files, tmp_path)
    first = expected.setdefault(aligned, calls[0])
    # What is compared is worth comparing: alone, each roll would be cut elsewhere.
    assert shares_pattern(first.science, first.pattern)
    assert len({Window.about(each.center[0], each.shape) for each in first.science}) == 2
    assert first is not calls[-1]
    assert_same_call(first, calls[-1])


def test_a_first_look_is_the_same_in_every_door(light, tmp_path, calls, monkeypatch):
    files, made = written(tmp_path, light, aligned=True), []

    def model(observation, size=None, **options):
        made.append({"size": size, **{name: options[name] for name in ("npix", "nlambda")}})
        return small_model(observation, size)

    for place in ("reduction.pipeline", "pyklip_backend.subtract"):
        monkeypatch.setattr(f"pyklip_diffrender.{place}.model_for", model)
    quick = {"opd": map_file(tmp_path), "accuracy": "quick"}
    database = StandIn(tmp_path, {KEY: concatenation([str(path) for path in files])})
    for door in (
        lambda: dr.reduce(files, **quick),
        lambda: reduce_jwst_files(files, folder=tmp_path, prefix="x", **quick),
        lambda: spaceklip.run_obs(database, **quick),
    ):
        with contextlib.suppress(Stopped, ExceptionGroup, DiffrenderError):
            door()
    assert made[0]["size"] == QUICK_SIDE
    assert made[0]["nlambda"] in (3, 7)
    assert made[0] == made[1] == made[2]
    first, *others = calls
    assert first.settings.cycles[0] < FitSettings.nircam("F444W").cycles[0]
    assert len(others) == 2
    for each in others:
        assert_same_call(first, each)


@pytest.mark.parametrize(
    "door", [through_reduce, through_klip_dataset, through_spaceklip, through_a_survey]
)
def test_files_are_opened_and_judged_as_often_as_needed(door, light, tmp_path, calls, monkeypatch):
    files = written(tmp_path, light, aligned=door is not through_a_survey)
    if door is through_a_survey:
        # It also makes sure that files do not change between plan and job.
        monkeypatch.setattr(jobs, "sha256", lambda path: str(path))
        monkeypatch.setattr(driver, "sha256", lambda path: str(path))
    opened = Counter()
    open_path, open_fits = Path.open, fits.open

    def count_path(path, *args, **options):
        opened[path.name] += 1
        return open_path(path, *args, **options)

    def count_open(name, *args, **options):
        # Others are files that this package has opened already.
        if isinstance(name, str | Path):
            opened[Path(name).name] += 1
        return open_fits(name, *args, **options)

    monkeypatch.setattr(Path, "open", count_path)
    monkeypatch.setattr(fits, "open", count_open)
    judge = counting(frame_file.why_few_pixels, opened, "judged")
    monkeypatch.setattr(frame_file, "why_few_pixels", judge)
    with contextlib.suppress(Stopped, ExceptionGroup, DiffrenderError):
        door(files, tmp_path)
    assert len(calls) == 1
    # Files of spaceKLIP's concatenations are sorted before they are read like other datasets.
    more = door is through_spaceklip
    assert opened["judged"] == len(files) * (1 + more)
    assert {opened[path.name] for path in files} == {2 + more}


def with_companion(path, folder):
    """A copy of a file with a source of 300 MJy/sr at its brightest, 1.2 arcsec away."""
    copy = folder / path.name.removesuffix(".gz")
    with fits.open(path) as hdus:
        science = hdus["SCI"]
        x, y = (science.header[key] - 1 for key in ("CRPIX1", "CRPIX2"))
        rows, columns = np.indices(science.shape[-2:])
        square = (columns - x - 15) ** 2 + (rows - y - 12) ** 2
        science.data += (300 * np.exp(-square / 2.5)).astype(np.float32)
        hdus.writeto(copy)
    return copy


OTHER_DOORS = (through_klip_dataset, through_spaceklip, through_a_survey)


@pytest.mark.parametrize(
    ("visits", "exposure", "doors"),
    [
        ("34", "03106", OTHER_DOORS[:1]),
        ("3", "03107", OTHER_DOORS[:1]),
        *(
            pytest.param(visits, exposure, OTHER_DOORS, marks=pytest.mark.slow)
            # Both rolls of each star in each filter, and single rolls of two stars.
            for exposure in ("03106", "03107")
            for visits in ("12", "34", "56", "2", "5")
        ),
    ],
)  # fmt: skip
def test_real_rolls_are_the_same_in_every_door(
    visits, exposure, doors, shared_data, tmp_path, calls, monkeypatch
):
    """Frames, map and pattern of the library, without a fit; a pair has a bright source."""
    monkeypatch.setattr("pyklip_diffrender.pattern.choice.package_library", package_library)
    files = sorted((shared_data / "gto1184").glob(f"jw0118400[{visits}]001_{exposure}*"))
    assert len(files) == len(visits)
    if visits == "56":
        files = [with_companion(each, tmp_path) for each in files]
    for door in (through_reduce, *doors):
        with contextlib.suppress(Stopped, ExceptionGroup, DiffrenderError):
            door(files, tmp_path)
    assert len(calls) == 1 + len(doors)
    for call in calls[1:]:
        assert_same_call(calls[0], call)


@pytest.mark.slow
@pytest.mark.parametrize("door", OTHER_DOORS)
def test_every_door_fits_and_searches_once(door, light, tmp_path, monkeypatch):
    made = Counter()
    monkeypatch.setattr(search, "Detection", counting(search.Detection, made, "Detection"))
    fit_in_stages = fitting.fit_in_stages

    def fitted(problems, settings, *rest, **keywords):
        # Rough fits only tell whether a frame shows the library's pattern, and where; fits that
        # continue another one have its values.
        made["fit_in_stages"] += settings.min_model_error < 0.05 and not rest
        return fit_in_stages(problems, settings, *rest, **keywords)

    monkeypatch.setattr(fitting, "fit_in_stages", fitted)
    door(written(tmp_path, light, aligned=True), tmp_path)
    assert made == {"Detection": 1, "fit_in_stages": 1}


@pytest.mark.slow
def test_a_fit_does_not_depend_on_how_an_exposure_was_cut_into_files(light, tmp_path):
    """Segments are no rolls, from whose differences a pattern might be learned."""
    (whole, _) = written(tmp_path, light, aligned=False, integrations=4)
    parts = []
    for k in (0, 1):
        parts.append(tmp_path / f"{whole.name[:25]}-seg00{k + 1}_nrcalong_calints.fits")
        with fits.open(whole) as hdus:
            for name in ("SCI", "ERR", "DQ"):
                hdus[name].data = hdus[name].data[2 * k : 2 * k + 2]
            hdus[0].header["EXSEGNUM"] = k + 1
            hdus.writeto(parts[k])
    one, two = (through_reduce(files, tmp_path) for files in ([whole], parts))
    assert [len(each.fit.frames) for each in (one, two)] == [1, 1]
    assert [each.fit.frames[0].observation.count for each in (one, two)] == [4, 4]
    assert one.fit.status is two.fit.status
    assert one.pattern is two.pattern is None
    # The means of segments are weighted by errors that are measured in each.
    assert two.fit.chi2_per_pixel == pytest.approx(one.fit.chi2_per_pixel, rel=1e-3)
    limits = [np.asarray(each.detection.contrast_curve["contrast"]) for each in (one, two)]
    np.testing.assert_allclose(limits[1], limits[0], rtol=0.01)
