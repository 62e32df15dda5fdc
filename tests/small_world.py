"""A small world of calibrated files, and its reduction through every door of the package.

The target has two rolls in each of two filters and two epochs, and a reference star a frame in each
of them. A planet is in all rolls, and a source beyond the fitted pixels.
"""

import contextlib
import io
import json
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from astropy.io import fits
from test_spaceklip import KEY, StandIn, concatenation

import pyklip_diffrender as dr
from benchmarks.calints_files import calints
from pyklip_diffrender import cli, spaceklip
from pyklip_diffrender.detection import Detection, completeness
from pyklip_diffrender.options import OPTIONS, SPECTRA
from pyklip_diffrender.pattern import MeasuredPattern, PatternLibrary, combine_patterns
from pyklip_diffrender.pyklip_backend.registration import reduce_jwst_files
from pyklip_diffrender.reduction.pictures import ReportPictures
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.refinement.fit_file import text_of
from pyklip_diffrender.refinement.settings import nircam_settings
from pyklip_diffrender.scene.aligned_frames import mask_place
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.simulation import model_for

SIDE, SIZE, NPIX = 97, 28, 64
MIDDLE = (SIDE - 1) // 2
PIXEL = 0.0624
TARGET, REFERENCE, OTHER = "HD 1", "HD 2", "BD+20-1790"
FILTERS, DATES = ("F444W", "F356W"), ("2022-10-03", "2023-10-03")
FLUX, BRIGHTNESS = 1e8, 1.5
"""Of the target, in MJy/sr and pixels, and of the reference star in units of it."""

PLANET, BEYOND = Planet(1.4e-5, 0.7, 120.0), Planet(1e-5, 1.65, 290.0)
MOTION = (0.1, -0.05)
"""arcsec per year to the east and north."""

FLAT = 0.01
"""Standard deviation of the errors of the flat field."""

PIXAR_SR = 9.2e-14
STATED = (MIDDLE, MIDDLE - 0.25)
"""x, y of the star by the headers: nearer to the middle of its light, which is not symmetric."""


def small_model(observation, size=None, **options):
    """Make a model of one wavelength, that in the name of the filter."""
    wavelength = int(str(observation.filter)[1:4]) * 1e-8
    return model_for(observation, size, **(options | {"monochromatic": wavelength, "npix": NPIX}))


def small_settings(observation, **changes):
    """Make settings with few modes and unknowns."""
    few = {
        "free": ("star_offset", "detector_shift", "flux", "background"), "cycles": 4.0,
        "max_companions": 0, "response_npix": NPIX,
    }  # fmt: skip
    return nircam_settings(observation, **(changes | few))


def make_small(monkeypatch):
    """Small models and few modes in every door, and no pattern but that which is given.

    Nothing is drawn, which takes half of the time and has tests of its own, and completeness is of
    few planets.
    """
    for place, function in (
        ("reduction.pipeline.model_for", small_model),
        ("pyklip_backend.subtract.model_for", small_model),
        ("refinement.settings.nircam_settings", small_settings),
        ("pattern.choice.package_library", PatternLibrary),
        ("reduction.pipeline.completeness", partial(completeness, angles=4)),
        ("reduction.products.Klip.of", lambda _: None),
        ("reduction.products.ReportPictures.of", lambda *_: ReportPictures()),
        ("drawing.save", lambda _, path, **__: Path(path).write_bytes(b"no picture")),
        ("drawing.to_png", lambda *_, **__: b"no picture"),
    ):
        monkeypatch.setattr(f"pyklip_diffrender.{place}", function)


def header_of(filter_):
    """The set-up of all frames in a filter."""
    return fits.Header({
        "INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", "CORONMSK": "MASKA335R", "FILTER": filter_,
    })  # fmt: skip


def first_pixel(filter_):
    """Column and row on the detector of the first pixel of an array with the star in its middle."""
    column, row = np.round(mask_place(header_of(filter_), "") - STATED).astype(int).tolist()
    return column, row


class World:
    """Files in a folder."""

    def __init__(self, folder):
        self.folder = folder
        self.map = folder / "opd.fits"
        self._frames: dict[tuple[str, str, str], list[Path]] = {}
        opd = 0.1 * dr.wavefront.random_opd(1, npix=NPIX).data
        fits.PrimaryHDU(opd, fits.Header({"BUNIT": "m"})).writeto(self.map)
        self.opd = opd + dr.wavefront.random_opd(7, npix=NPIX, rms=2e-9).data

    def frames(self, filter_, date, star):
        """Files of a star, which are written when they are first asked for."""
        key, rolls = (filter_, date, star), (70.0, 80.0) if star == TARGET else (100.0,)
        if key not in self._frames:
            self._frames[key] = [self._written(*key, roll) for roll in rolls]
        return self._frames[key]

    @cached_property
    def flat(self):
        """Errors of the flat field in each filter, (SIDE, SIDE)."""
        return {
            name: FLAT * np.random.default_rng(k).normal(size=(SIDE, SIDE))
            for k, name in enumerate(FILTERS)
        }

    @cached_property
    def models(self):
        """Models of the whole frames in each filter."""
        ones = np.ones((SIDE, SIDE))
        return {
            name: small_model(Observation.from_arrays(
                ones, ones, pixelscale=PIXEL, filter=name, header=header_of(name)
            ))
            for name in FILTERS
        }  # fmt: skip

    def _written(self, filter_, date, star, roll):
        """Write a frame with the star in the middle, as the pipeline and spaceKLIP do."""

        def image(place):
            with torch.no_grad():
                return self.models[filter_](self.opd, star_offset=place).double().numpy()

        light = image((0.0, 0.0))
        for each in (PLANET, BEYOND) if star == TARGET else ():
            # The position angle of the +y axis is ROLL_REF minus V3I_YANG.
            light = light + each.contrast * image(each.rotated(-(roll + 0.05)).offset)
        light = light * (1 if star == TARGET else BRIGHTNESS) * FLUX
        column, row = first_pixel(filter_)
        number = 100 * FILTERS.index(filter_) + 10 * DATES.index(date) + int(roll) // 10
        cards = {
            "FILTER": filter_, "IS_PSF": star != TARGET, "MU_RA": MOTION[0], "MU_DEC": MOTION[1],
            "CRPIX1": STATED[0] + 1, "CRPIX2": STATED[1] + 1, "PIXAR_A2": PIXEL**2,
            "SUBSTRT1": column + 1, "SUBSTRT2": row + 1,
        }  # fmt: skip
        path = calints(
            self.folder / f"jw01184{number:03d}001_03106_00001_nrcalong_calints.fits", star,
            observation=number, roll=roll, date=f"{date}T0{int(roll) // 20}:00:00", cards=cards,
            light=light * (1 + self.flat[filter_]),
        )  # fmt: skip
        with fits.open(path, mode="update") as hdus:
            hdus["SCI"].header.update({
                "PIXAR_SR": PIXAR_SR, "CRVAL1": 100.0, "CRVAL2": 20.0, "CTYPE1": "RA---TAN",
                "CTYPE2": "DEC--TAN", "STARCENX": STATED[0] + 1, "STARCENY": STATED[1] + 1,
            })  # fmt: skip
            for name in ("IMSHIFTS", "MASKOFFS"):
                hdus.append(fits.ImageHDU(np.zeros((1, 2)), name=name))
        return path

    @cached_property
    def star_flux(self):
        """Flux densities of the target by filter, Jy."""
        opd = torch.from_numpy(self.opd)
        return {
            name: float(FLUX * model.transmission(opd)) * PIXAR_SR * 1e6
            for name, model in self.models.items()
        }

    @cached_property
    def star_sed(self):
        """File of a spectrum of the target."""
        path = self.folder / "star.txt"
        flux = np.mean(list(self.star_flux.values()))
        path.write_text("".join(f"{wavelength} {flux}\n" for wavelength in (2.0, 4.0, 6.0)))
        return path

    def patterns(self, filter_):
        """The pattern as two frames of another star show it."""
        seen, (column, row) = (slice(28, 69), slice(28, 69)), first_pixel(filter_)
        return [
            MeasuredPattern(
                OTHER, (self.flat[filter_] + 0.3 * FLAT * rng.normal(size=(SIDE, SIDE)))[seen],
                np.full((41, 41), (0.3 * FLAT) ** 2), (MIDDLE - 28.0, MIDDLE - 28.0),
                (column + 28, row + 28), filter_, "MASK335R", f"{filter_} {k}.fits",
                "2022-10-03", detector="NRCALONG",
            )
            for k, rng in enumerate(map(np.random.default_rng, (5, 6)))
        ]  # fmt: skip

    @cached_property
    def patterns_by_hand(self):
        """Files of patterns: a library of both filters, and one for each of them."""
        library = PatternLibrary(tuple(each for name in FILTERS for each in self.patterns(name)))
        return {
            "library": library.write(self.folder / "library.fits"),
            "file": {
                name: combine_patterns(self.patterns(name)).write(self.folder / f"{name}.fits")
                for name in FILTERS
            },
        }


class Found(NamedTuple):
    """What a door finds."""

    searches: list[Detection]
    # Contents of summary.json in the same order; empty where a door makes none.
    summaries: list[dict[str, Any]]
    # Content of the combined search as JSON has it; None without one.
    combined: dict[str, Any] | None = None


class Refused(Exception):
    """A door has said no, by an exit status or in a table."""


class Request(NamedTuple):
    """Features of a reduction as a user states them, apart from options of `reduce`."""

    world: World
    filters: tuple[str, ...]
    epochs: tuple[str, ...]
    # Options of `reduce` by name, the same for all frames.
    options: dict[str, Any]
    reference_star: bool = False
    reference_epochs: tuple[str, ...] = ()  # Of the reference star, if not the target's.
    # "fitted", "flux" (a flux density in each filter) or "sed" (a file).
    star: str = "fitted"
    # "auto", "library" or "file" (one for each filter).
    pattern_file: str = "auto"
    spectra: tuple[str, ...] = SPECTRA

    @property
    def frames(self):
        """Files by filter, those of the target before those of the reference star."""
        stars = (TARGET, REFERENCE)[: 1 + self.reference_star]
        return {
            name: [
                path
                for star in stars
                for date in (star == REFERENCE and self.reference_epochs) or self.epochs
                for path in self.world.frames(name, date, star)
            ]
            for name in self.filters
        }

    @property
    def files(self):
        return [path for paths in self.frames.values() for path in paths]

    def pattern_option(self, filter_):
        """The option for the pattern in a filter."""
        if self.pattern_file == "auto":
            return {}
        pattern = self.world.patterns_by_hand[self.pattern_file]
        return {"pattern": str(pattern if self.pattern_file == "library" else pattern[filter_])}

    def options_in(self, filter_):
        """Options in a filter, with those for the pattern and the star's flux density."""
        options = self.options | self.pattern_option(filter_)
        if self.star == "flux":
            options["star_flux"] = self.world.star_flux[filter_]
        if self.star == "sed":
            options["star_sed"] = str(self.world.star_sed)
        return options


def through_python(request, folder):
    world, made = request.world, []
    for each in dr.ExposureSequence.by_filter_and_epoch(request.files, target=TARGET):
        options = request.options_in(each.filter)
        if "star_sed" in options:
            spectrum = options.pop("star_sed")
            options["star_flux"] = dr.instrument.star_flux_density(spectrum, each.filter)
        made.append(dr.reduce(each, world.map, size=SIZE, **options))
    combined = dr.combine(made, spectra=request.spectra).to_dict() if len(made) > 1 else None
    return Found([each.detection for each in made], list(map(summarise, made)), combined)


def through_command(request, folder):
    world = request.world
    arguments = ["reduce", *map(str, request.files), "--target", TARGET, "--opd", str(world.map)]
    arguments += ["--size", str(SIZE), "-o", str(folder)]
    for name, value in (request.options | request.pattern_option(request.filters[-1])).items():
        option = OPTIONS[name]
        arguments += [option.flag] if option.is_switch else [option.flag, str(value)]
    if request.star == "flux":
        arguments += ["--star-flux", str(world.star_flux[request.filters[0]])]
    if request.star == "sed":
        arguments += ["--star-sed", str(world.star_sed)]
    if request.spectra != SPECTRA:
        arguments += [word for each in request.spectra for word in ("--spectra", each)]
    messages = io.StringIO()
    with contextlib.redirect_stderr(messages), contextlib.redirect_stdout(io.StringIO()):
        status = cli.main(arguments)
    if status:
        raise Refused(messages.getvalue())
    data = folder / "comparison.json"
    combined = json.loads(data.read_text())["combined"] if data.exists() else None
    return Found(*_products(path.parent for path in folder.rglob("detection.fits")), combined)


def _products(folders):
    """Searches and summaries in folders."""
    folders = sorted(folders)
    return (
        [Detection.read(each) for each in folders],
        [json.loads((each / "summary.json").read_text()) for each in folders],
    )


def through_klip_dataset(request, folder):
    world, options = request.world, request.options_in(request.filters[0])
    if request.spectra != SPECTRA:
        options["spectra"] = request.spectra
    science, references = _by_use(request.files)
    dataset = reduce_jwst_files(
        science, references, folder=folder, prefix="x", opd=world.map, size=SIZE, **options
    )
    made = [record.subtraction.reduction for record in dataset.diffrender_results]
    return Found([each.detection for each in made], list(map(summarise, made)))


def _by_use(files):
    """Files of the target, and of the reference star."""
    marked = [fits.getheader(path)["IS_PSF"] for path in files]
    return tuple(
        [path for path, psf in zip(files, marked, strict=True) if psf == use] for use in (0, 1)
    )


def through_spaceklip(request, folder):
    world, options = request.world, request.options_in(request.filters[0])
    if "star_flux" in options:
        options["star_flux"] = {name: world.star_flux[name] for name in request.frames}
    tables = {}
    for name, files in request.frames.items():
        tables[KEY.replace("F444W", name)] = table = concatenation(list(map(str, files)))
        table["FILTER"] = name
        table["TYPE"] = ["REF" if path in _by_use(files)[1] else "SCI" for path in files]
    database = StandIn(folder, tables)
    searches = spaceklip.run_obs(
        database, opd=world.map, size=SIZE, spectra=request.spectra, **options
    )
    combined = None
    for path in folder.rglob("combined.fits"):
        with fits.open(path) as hdus:
            combined = text_of(hdus, "FACTS")
    return Found(list(searches.values()), [], combined)


def through_a_survey(request, folder):
    world, sequences = request.world, []
    for name, files in request.frames.items():
        options = request.options_in(name)
        if "injections" in options:
            options["injections"] = {"contrasts": [4e-5], "separations": [0.6], "angles": [300.0]}
        sequences.append({
            "files": list(map(str, files)), "opd": str(world.map), "size": SIZE, "target": TARGET,
            "name": name, **options,
        })  # fmt: skip
    config = {"workers": 0, "sequence": sequences}
    if request.spectra != SPECTRA:
        config["combined"] = {"spectra": list(request.spectra)}
    table = dr.survey(config, folder)
    failed = table[table["status"] == "failed"]
    if len(failed):
        raise Refused("\n".join(failed["message"]))
    plain = table["injected_contrast"].mask
    for row in table[~plain]:
        away = row["recovered_contrast"] - row["injected_contrast"]
        assert row["recovered"]
        assert abs(away) < 3 * row["recovered_error"]
        assert not (folder / "jobs" / row["folder"] / "fit.fits").exists()
    searches, summaries = _products(folder / "jobs" / name for name in table["folder"][plain])
    for each in summaries:
        each["injections"] = np.sum(~plain)  # These are jobs of their own.
    combined = table.meta["combined"]
    return Found(searches, summaries, combined[0] if combined else None)


DOORS = {
    "python": through_python,
    "command": through_command,
    "pyklip": through_klip_dataset,
    "spaceklip": through_spaceklip,
    "survey": through_a_survey,
}
