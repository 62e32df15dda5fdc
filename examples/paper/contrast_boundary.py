"""Contrast of a 5-sigma detection against separation, the paper's figure 6.

    python examples/paper/contrast_boundary.py --opd BEFORE AFTER --seeds 10

The OPD map is 40 h old. For methods that return a subtracted image, the contrast is 5 times
the noise over the light of a planet of contrast 1, both as defined for the paper's annulus SNR. The
noise is the scatter of the pixels of the planet's annulus (3 pixels wide) over the square root of
the number of pixels in the aperture (radius 1.5 pixels), in a frame without planets. The light is
the mean over the aperture, times the throughput of the method for planets of photon-limited S/N 5:
the difference of the subtracted frames with and without them, over that with the true star. A
second column has the same by matched filters: the scatter of the amplitudes on the ring, at least
the photon noise, over the throughput. For the marginalised estimate it is the closed form, the
median of the ring. The noise limit is the paper's: 5 times the mean photon noise of the
annulus, over the star's peak photons and the occulter's transmission; the photon limit is that of a
matched filter that knows the star. No small-sample correction, for no method. Adam takes half the
seeds.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.table import Table
from matplotlib.figure import Figure
from photutils.aperture import CircularAperture

import pyklip_diffrender as dr
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.instrument.masks import MASKS
from pyklip_diffrender.refinement import Refinement

sys.path.insert(0, str(Path(__file__).parent))
import published
from judging import COLOURS, Ring, pixel, select, separations, spread, throughput_of
from methods import QUICK, STEPS, all_of, references, with_planets
from scene import (
    Frame,
    Image,
    Planet,
    Scene,
    Setting,
    Star,
    frame,
    mapped,
    options,
    planet_photons,
    setting,
    timed_table,
)

HOURS = 40.0
INJECTED = 5.0
"""S/N of the injected planets if the star were known."""
APERTURE, HALF_WIDTH = 1.5, 1.5
"""Pixels."""
LIMITS = ("noise limit", "photon limit")
SUBTRACTIONS = ("initial", "KLIP", "Adam", "Gauss-Newton", "optimal")


def at_limit(setup: Setting, shot: Frame, separation: float, angle: float) -> Planet:
    """A planet of the photon-limited S/N `INJECTED`."""
    unit = Planet(1.0, separation, angle)
    light = planet_photons(setup.model, Scene(), unit, shot.opd)
    return Planet(INJECTED / float(np.linalg.norm(light / shot.noise)), separation, angle)


def paper_noise(setup: Setting, image: Image, separation: float) -> float:
    """Scatter of an annulus, for the mean of an aperture."""
    pixelscale = setup.model.detector.pixelscale[0]
    ring = np.abs(separations(setup) - separation) <= HALF_WIDTH * pixelscale
    return float(np.nanstd(image[ring]))


def noise_limit(setup: Setting, shot: Frame, separation: float) -> float:
    """The paper's fundamental limit (its appendix A)."""
    ring = (
        np.abs(separations(setup) - separation) <= HALF_WIDTH * setup.model.detector.pixelscale[0]
    )
    position = torch.tensor(separation, dtype=torch.float64)
    passed = (1 - float(MASKS["MASK335R"].complement(position, torch.zeros_like(position)))) ** 2
    return 5 * float(shot.noise[ring].mean()) / Star().peak_photons / passed


def one_seed(setup: Setting, places: tuple[float, ...], steps: int, seed: int) -> Table:
    """One row for each separation and method."""
    shot = frame(setup, HOURS, seed)
    frames = references(setup, HOURS, seed)
    empty = all_of(setup, shot, frames, steps)
    curve = dr.detect(empty["Gauss-Newton"].fit, separations=places).contrast_curve
    closed = {round(float(row["separation"].value), 3): row for row in curve}
    rows = []
    # Neighbours in separation are in different frames, and on other sides of the star.
    for group in filter(None, (places[::2], places[1::2])):
        planets = [at_limit(setup, shot, s, (54 + 150 * places.index(s)) % 360) for s in group]
        with_sources = with_planets(setup, shot, planets, seed)
        full = all_of(setup, with_sources, frames, steps)
        measured = together(full["Gauss-Newton"].fit, planets)
        for k, planet in enumerate(planets):
            row = closed[round(planet.separation, 3)]
            facts = {"separation": planet.separation, "seed": seed, "injected": planet.contrast}
            for values in one_place(setup, with_sources, k, empty, full):
                rows.append({**facts, **values})
            for name, limit in (
                ("noise limit", noise_limit(setup, shot, planet.separation)),
                ("photon limit", float(row["known_star"])),
                ("marginalised", float(row["contrast"])),
            ):
                share = measured[k] / planet.contrast if name == "marginalised" else math.nan
                values = {"method": name, "contrast": limit, "matched": limit, "throughput": share}
                rows.append({**facts, **values})
    return Table(rows=rows)


def together(fit: Refinement, planets: list[Planet]) -> Image:
    """Contrasts of planets measured together, for their wings overlap."""
    places = torch.tensor([p.offset for p in planets]).double()
    templates = Templates(fit).at(places)
    matrix, vector = fit.star_only.normal_equations(templates)
    return torch.linalg.solve(matrix, vector).numpy()


def one_place(
    setup: Setting, with_sources: Frame, which: int, empty: dict[str, Any], full: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """The 5-sigma contrasts of the methods that leave an image."""
    planet = with_sources.planets[which][0]
    position = pixel(setup, planet.offset)
    ring = Ring(setup, with_sources, which)
    aperture = CircularAperture(position, APERTURE)
    (count,), _ = aperture.do_photometry(np.ones_like(with_sources.star), method="center")
    (light,), _ = aperture.do_photometry(with_sources.planets[which][1], method="center")
    unit = light / count / planet.contrast
    # With the true star: 1, but for the planet's own noise and the wings of the other planets.
    difference = full["optimal"].image - empty["optimal"].image
    total = throughput_of(setup, with_sources, difference, np.zeros_like(difference), which)
    for name, without in empty.items():
        share = throughput_of(setup, with_sources, full[name].image, without.image, which) / total
        noise = paper_noise(setup, without.image, planet.separation) / math.sqrt(count)
        yield {
            "method": name,
            # Where a method removed the planet altogether there is no contrast to be seen.
            "contrast": 5 * noise / unit / share if share > 0 else math.inf,
            "matched": 5 * ring.noise(without.image) / share if share > 0 else math.inf,
            "throughput": share,
        }


def medians(table: Table, method: str, column: str = "contrast") -> tuple[Image, Image]:
    """Separations, and median, 16 and 84 percentile at each of them, (3, k)."""
    part = select(table, method=method)
    places = np.unique(part["separation"])
    return places, np.transpose([spread(select(part, separation=s)[column]) for s in places])


def draw(table: Table) -> Figure:
    """Draw the contrast curves with those of the paper, and the throughput of the planets."""
    figure = Figure(figsize=(15, 5), layout="constrained")
    panels = figure.subplots(1, 3)
    styles = {"noise limit": ("#b03030", ":"), "photon limit": ("#1b1f24", "--")}
    for ax, column in zip(panels, ("contrast", "matched", "throughput"), strict=True):
        for name in (*LIMITS, *SUBTRACTIONS, "marginalised"):
            places, (middle, low, high) = medians(table, name, column)
            if not len(places) or not np.isfinite(middle).any():
                continue
            colour, style = styles.get(name, (COLOURS.get(name, "k"), "-"))
            ax.plot(places, middle, style, color=colour, label=name)
            ax.fill_between(places, low, high, color=colour, alpha=0.15, lw=0)
        ax.set_xlabel("arcsec", fontsize=9)
    for name, colour in (("noise limit", "#b03030"), ("theirs", COLOURS["Adam"]),
                         ("KLIP", COLOURS["KLIP"])):  # fmt: skip
        panels[0].plot(
            published.SEPARATIONS, published.BOUNDARY[name], "o", ms=3.5, mfc="none", color=colour,
            label=f"{name}, published",
        )  # fmt: skip
    titles = ("5-sigma contrast, annulus SNR", "5-sigma contrast, matched filters",
              "Planet's light kept")  # fmt: skip
    for ax, title in zip(panels, titles, strict=True):
        ax.set_title(title, fontsize=10, loc="left")
        ax.set_yscale("log")
    panels[2].set_yscale("linear")
    panels[2].axhline(1, color="0.7", lw=0.8, zorder=0)
    panels[2].set_ylim(0, 1.5)
    panels[0].legend(frameon=False, fontsize=7)
    return figure


def main() -> None:
    """Run the study."""
    parser = options(__doc__.splitlines()[0])
    parser.set_defaults(seeds=10)
    arguments = parser.parse_args()
    setup = setting(
        tuple(arguments.opd) if arguments.opd else None, **(QUICK if arguments.quick else {})
    )
    if arguments.quick:
        jobs = [(setup, published.SEPARATIONS[2:3], 200, 0)]
    else:
        jobs = [
            (setup, published.SEPARATIONS, STEPS if seed < (arguments.seeds + 1) // 2 else 0, seed)
            for seed in range(arguments.seeds)
        ]
    name = "contrast_boundary_measured" if arguments.opd else "contrast_boundary_generator"
    table = timed_table(
        lambda: mapped(one_seed, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for method in (*LIMITS, *SUBTRACTIONS, "marginalised"):
        for column in ("contrast", "matched", "throughput"):
            _, (middle, _, _) = medians(table, method, column)
            print(f"{method:13s} {column:10s}", *(f"{value:.2e}" for value in middle))


if __name__ == "__main__":
    main()
