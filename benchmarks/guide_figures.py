"""Figures of the documentation, from small simulated scenes and the tables of docs/results.

    python -m benchmarks.guide_figures [--output docs/images] [NAME ...]

Every scene has its seed, so that a figure changes only with the package. Takes about three minutes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

import pyklip_diffrender as dr
from pyklip_diffrender import drawing

RESULTS = Path(__file__).parents[1] / "docs" / "results"

NPIX, SIDE, WAVELENGTH = 128, 40, 4.5e-6
SETTINGS = dr.FitSettings(cycles=6)
PLANET = dr.Planet(2e-6, 0.75, 120.0)
ROLLS = (0.0, 12.0)


@cache
def model() -> dr.OpticalSystem:
    """A coronagraph with few samples, at one wavelength."""
    return dr.nircam_coronagraph("F444W", monochromatic=WAVELENGTH, npix=NPIX, fov_pixels=SIDE)


def opd(seed: int = 1, change: float = 0.0) -> NDArray[np.float64]:
    """A wavefront, moved by a fraction of the way to another one, (npix, npix) in m."""
    first, other = (dr.wavefront.random_opd(each, npix=NPIX).data for each in (seed, seed + 1))
    return np.asarray(first + change * (other - first))


def frame(
    seed: int, roll: float = 0.0, planets: tuple[dr.Planet, ...] = (PLANET,)
) -> dr.Observation:
    """A simulated frame whose +y axis has the position angle `roll`."""
    turned = tuple(replace(each, position_angle=each.position_angle - roll) for each in planets)
    scene = dr.Scene(star=dr.Star(w2_magnitude=5.0), planets=turned)
    seen = dr.simulate(model(), scene, opd(change=0.03), seed=seed)
    return replace(seen, position_angles=np.array([roll]), name=f"roll {roll:g} deg")


@cache
def fitted() -> dr.Refinement:
    """A fit of two rolls with a planet."""
    frames = [frame(3 + k, roll) for k, roll in enumerate(ROLLS)]
    return dr.refine(model(), frames, opd(), settings=SETTINGS)


def detection_figure() -> Figure:
    """S/N map and contrast curve of two rolls."""
    figure, axes = drawing.new_figure(1, 2)
    dr.detect(fitted()).plot(axes[0])
    return figure


def status_figure() -> Figure:
    """A frame, its star and the residual, for a fit that explains it and one that does not."""
    figure, axes = drawing.new_figure(2, 3)
    figure.set_size_inches(13.8, 7.2)
    settings = dr.FitSettings(cycles=(6, 12))
    seen = frame(3, planets=())
    explained = dr.refine(model(), seen, opd(), settings=settings)
    pattern = 1 + 0.01 * np.random.default_rng(5).normal(size=(SIDE, SIDE))
    changed = replace(seen, data=seen.data * pattern)
    mismatched = dr.refine(model(), changed, opd(), settings=settings)
    # What the caption says.
    assert [each.status.name for each in (explained, mismatched)] == ["CONVERGED", "MODEL_MISMATCH"]
    for row, fit in zip(axes, (explained, mismatched), strict=True):
        fit.plot(row)
        row[0].set_ylabel(f"{fit.status.name}\ny from the star (arcsec)")
    return figure


def pattern_figure() -> Figure:
    """The library's detector pattern of F444W and F356W about the place of the star."""
    figure, axes = drawing.new_figure(1, 2)
    for ax, name in zip(axes[0], ("F444W", "F356W"), strict=True):
        ones = np.ones((80, 80))
        header = {"DETECTOR": "NRCALONG", "CORONMSK": "MASKA335R"}
        seen = dr.Observation.from_arrays(
            ones, ones, pixelscale=0.063, filter=name, header=fits.Header(header)
        )
        known = dr.known_pattern(seen)
        assert known is not None
        y, x = np.indices(known.value.shape)
        grid = np.stack([x - known.center[0], y - known.center[1]], axis=-1) * 0.063
        drawing.signed_image(
            ax, 100 * known.value, grid, 10.0, bar="% of the starlight", title=name
        )
    return figure


def first_figure() -> Figure:
    """The detection of the first example, whose code is that of the page."""
    page = (RESULTS.parent / "getting_started.md").read_text(encoding="utf-8")
    code = page.partition("```python\n")[2].partition("```")[0]
    variables: dict[str, Any] = {}
    exec(compile(code.replace('detection.write("products")\n', ""), "example", "exec"), variables)
    figure, axes = drawing.new_figure(1, 2)
    variables["detection"].plot(axes[0])
    return figure


def marginalised_figure() -> Figure:
    """A planet's image, what the wavefront can imitate of it, and what remains."""
    import torch

    fit = dr.refine(model(), frame(3, planets=()), opd(), settings=SETTINGS)
    linear, angle = fit.linear, np.deg2rad(PLANET.position_angle)
    place = (-PLANET.separation * np.sin(angle), PLANET.separation * np.cos(angle))
    with torch.no_grad():
        planet = model()(opd(), star_offset=place)
    white = (planet * linear.frames[0].weight).numpy()
    remaining = linear.clean({0: planet[None]})[0][0].numpy()
    images = {
        "a planet": white,
        "imitated by changes of the star": white - remaining,
        "what remains": remaining,
    }
    figure, axes = drawing.new_figure(1, 3)
    axis = (np.arange(SIDE) - (SIDE - 1) / 2) * 0.063
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    for ax, (title, image) in zip(axes[0], images.items(), strict=True):
        drawing.signed_image(
            ax, image / white.max(), grid, 0.6, bar="image / noise, of the peak", title=title
        )
    # The caption states how much of the S/N remains.
    share = float(np.sqrt(np.sum(white * remaining) / np.sum(white**2)))
    print(f"S/N that remains: {share:.2f}")
    return figure


def spaceklip_figure() -> Figure:
    """A faint planet in the image without the star and in the search of two rolls."""
    faint = replace(PLANET, contrast=7e-7)
    frames = [frame(3 + k, roll, planets=(faint,)) for k, roll in enumerate(ROLLS)]
    found = dr.detect(dr.refine(model(), frames, opd(), settings=SETTINGS))
    figure, axes = drawing.new_figure(1, 3)
    image = found.subtracted[0]
    axis = (np.arange(SIDE) - (SIDE - 1) / 2) * 0.063
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    limit = float(np.percentile(np.abs(image), 99))
    drawing.signed_image(axes[0, 0], image, grid, limit, bar="photons", title="without the star")
    found.plot(axes[0, 1:])
    return figure


def klip_figure() -> Figure:
    """The same two rolls in pyKLIP's products, with KLIP and with the backend."""
    from pyklip.instruments.Instrument import GenericData
    from pyklip.parallelized import klip_dataset

    frames = [frame(3 + k, roll) for k, roll in enumerate(ROLLS)]
    cube = np.concatenate([each.data for each in frames])
    center = np.full((len(cube), 2), (SIDE - 1) / 2)
    images = {}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for algorithm, title in (("klip", "KLIP"), ("diffrender", "this package")):
            dataset = GenericData(
                cube.copy(), center, parangs=np.array(ROLLS), wvs=np.ones(len(cube)),
                filenames=np.array([each.name for each in frames]), IWA=3,
            )  # fmt: skip
            settings = {
                "model": model(), "settings": SETTINGS, "size": SIDE, "filter": "F444W",
                "error": np.sqrt(np.maximum(cube, 1.0)), "opd": opd(),
            }  # fmt: skip
            # Inside the block of the backend, "klip" would be taken over as well.
            with dr.pyklip_backend.backend(**settings) if algorithm != "klip" else nullcontext():
                klip_dataset(
                    dataset, mode="ADI", annuli=1, subsections=1, movement=1, numbasis=[1],
                    outputdir=folder, fileprefix=algorithm, algo=algorithm, verbose=False,
                )  # fmt: skip
            images[title] = fits.getdata(Path(folder) / f"{algorithm}-KLmodes-all.fits")[0]
    figure, axes = drawing.new_figure(1, 2)
    limit = max(float(np.nanpercentile(np.abs(each), 99)) for each in images.values())
    angle = np.deg2rad(PLANET.position_angle)
    place = (-PLANET.separation * np.sin(angle), PLANET.separation * np.cos(angle))
    for ax, (title, image) in zip(axes[0], images.items(), strict=True):
        ny, nx = image.shape
        y, x = np.indices(image.shape)
        grid = np.stack([x - (nx - 1) / 2, y - (ny - 1) / 2], axis=-1) * 0.0624
        drawing.signed_image(ax, np.nan_to_num(image), grid, limit, bar="photons", title=title)
        ax.add_patch(Circle(place, 0.2, fill=False, color="k"))
    return figure


def survey_figure() -> Figure:
    """Limits of three stars, as the page of a survey shows them."""
    curves = []
    for k, magnitude in enumerate((3.0, 5.0, 7.0)):
        scene = dr.Scene(star=dr.Star(w2_magnitude=magnitude))
        seen = dr.simulate(model(), scene, opd(change=0.03), seed=10 + k)
        curve = dr.detect(dr.refine(model(), seen, opd(), settings=SETTINGS)).contrast_curve
        curves.append(
            (
                f"star of W2 = {magnitude:g} mag",
                curve["separation"].to_value("arcsec"),
                np.asarray(curve["contrast"]),
            )
        )
    figure, axes = drawing.new_figure(1, 1)
    drawing.survey_limits(axes[0, 0], curves, [], 5.0)
    return figure


def time_figure() -> Figure:
    """How times of fits (`benchmarks.growth`) and surveys (`benchmarks.survey_growth`) grow."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    fits, surveys = figure.subplots(1, 2)
    table = Table.read(RESULTS / "growth.ecsv")
    for k, name in enumerate(dict.fromkeys(map(str, table["size"]))):
        rows = table[table["size"] == name]
        size = rows["value"] / rows["value"][0]
        fits.loglog(size, rows["fit"], f"C{k}o-", label=f"{name} from {rows['value'][0]:g}")
        fits.loglog(size, rows["counted"], f"C{k}--", lw=1)
    fits.plot([], [], "k--", lw=1, label="counted operations")
    fits.set(xlabel="size over the smallest", ylabel="processor time of a fit (s)")
    table = Table.read(RESULTS / "survey_growth.ecsv")
    for k, workers in enumerate(sorted(set(map(int, table["workers"])))):
        for kind, style in (("simulated", "-"), ("measured", "o")):
            rows = table[(table["workers"] == workers) & (table["kind"] == kind)]
            label = f"{workers} worker{'s' if workers > 1 else ''}" if style == "-" else None
            surveys.loglog(rows["stars"], rows["seconds"], f"C{k}{style}", label=label)
    surveys.plot([], [], "ko", label="measured")
    surveys.set(xlabel="stars of a survey", ylabel="time of a survey (s)")
    for ax in (fits, surveys):
        ax.legend(frameon=False, fontsize=8)
    return figure


def bridge_figure() -> Figure:
    """An image of poppy, that of the converted model, and their difference."""
    import poppy
    import torch
    from astropy import units as u

    primary = poppy.CompoundAnalyticOptic(
        [
            poppy.CircularAperture(radius=1.2),
            poppy.SecondaryObscuration(secondary_radius=0.3, support_width=0.04, n_supports=4),
        ]
    )
    osys = poppy.OpticalSystem(npix=128, oversample=4)
    osys.add_pupil(primary)
    osys.add_image(poppy.CircularOcculter(radius=0.25))
    osys.add_pupil(poppy.CircularAperture(radius=1.0))
    osys.add_detector(pixelscale=0.05, fov_pixels=SIDE, oversample=1)
    theirs = osys.calc_psf(WAVELENGTH * u.m)[0].data
    with torch.no_grad():
        ours = dr.from_poppy(osys, wavelength=WAVELENGTH)().numpy()
    figure, axes = drawing.new_figure(1, 3)
    axis = (np.arange(SIDE) - (SIDE - 1) / 2) * 0.05
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    peak = theirs.max()
    images = {"poppy": theirs, "from_poppy": ours, "difference": ours - theirs}
    for ax, (title, image) in zip(axes[0], images.items(), strict=True):
        limit = float(np.abs(image).max() / peak)
        drawing.signed_image(ax, image / peak, grid, limit, bar="of the peak", title=title)
    return figure


def limits_figure() -> Figure:
    """Limits of two rolls of real stars, KLIP's, and those for a known star."""
    table = Table.read(RESULTS / "real_pairs_limits.ecsv")
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    pairs = list(dict.fromkeys((str(row["star"]), str(row["filter"])) for row in table))
    for ax, (star, band) in zip(figure.subplots(1, len(pairs), sharey=True), pairs, strict=True):
        rows = table[(table["star"] == star) & (table["filter"] == band)]
        for column, label, style in (
            ("klip_small_sample", "KLIP", "C1s--"),
            ("limit_small_sample", "this package", "C0o-"),
            ("known_star", "star known exactly", "0.5"),
        ):
            ax.semilogy(rows["separation"], rows[column], style, label=label, ms=4)
        ax.set(title=f"{star}, {band}", xlabel="separation (arcsec)")
    figure.axes[0].set_ylabel("5-sigma contrast")
    figure.axes[0].legend(frameon=False, fontsize=8)
    return figure


def hard_cases_figure() -> Figure:
    """Error of the fitted star in hard cases, by the status of the fit."""
    table = Table.read(RESULTS / "stability_fits.ecsv")
    colors = {"CONVERGED": "C0", "MODEL_MISMATCH": "C1", "DIVERGED": "C3"}
    figure = Figure(figsize=(9, 5), layout="constrained")
    ax = figure.subplots()
    places = np.arange(len(table))[::-1]
    for status, color in colors.items():
        chosen = np.asarray(table["status"]) == status
        ax.plot(np.asarray(table["error"])[chosen], places[chosen], "o", color=color, label=status)
    ax.set_yticks(places, list(map(str, table["case"])), fontsize=8)
    ax.set_xscale("log")
    ax.set_xlabel("rms error of the fitted star (sigma)")
    ax.grid(axis="x", alpha=0.3)
    ax.legend(frameon=False)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "guide_real_frames": detection_figure,
    "guide_getting_started": first_figure,
    "guide_concepts": marginalised_figure,
    "guide_status": status_figure,
    "guide_detector_pattern": pattern_figure,
    "guide_pyklip": klip_figure,
    "guide_spaceklip": spaceklip_figure,
    "guide_survey": survey_figure,
    "guide_resources": time_figure,
    "guide_bridges": bridge_figure,
    "real_limits": limits_figure,
    "hard_cases": hard_cases_figure,
}
"""Figures by the names of their files."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=RESULTS.parent / "images")
    parser.add_argument("names", nargs="*", metavar="NAME", default=list(FIGURES))
    options = parser.parse_args(arguments)
    for name in options.names:
        path = options.output / f"{name}.png"
        drawing.save(FIGURES[name](), path, dpi=110)
        print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
