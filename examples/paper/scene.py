"""Functions shared by the studies: the paper's scene, command-line options, and tables.

The scene is that of Feng et al. 2025: beta Pictoris for two hours at 4.5 um, 80 x 80 pixels, an
OPD map that is some hours old. With ``--opd before.fits after.fits`` (two measured maps, 86
hours apart) the drift is real; otherwise both maps are simulated.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context, set_start_method
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.table import Table, vstack
from numpy.typing import NDArray

import pyklip_diffrender as dr
from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.scene.objects import PAPER_SEGMENT_GAP, Planet, Scene, Star
from pyklip_diffrender.scene.simulation import planet_photons, simulate, star_photons
from pyklip_diffrender.wavefront.opd import random_drift, random_opd, read_opd, resample

Image = NDArray[np.float64]

WAVELENGTH = 4.5e-6

BETWEEN_MAPS = 86.0
"""Hours between the two measured maps."""


@dataclass(frozen=True)
class Setting:
    """A model and how its wavefront drifts.

    Attributes
    ----------
    model : OpticalSystem
    measured : ndarray, (npix, npix)
        The OPD map at the start of a fit, m.
    before, after : str
        Paths of measured maps, or "" for the embedded generator.
    """

    model: OpticalSystem
    measured: Image
    before: str
    after: str
    seed: int

    def drifted(self, hours: float) -> Image:
        """The true wavefront, some hours after the map."""
        if self.before:
            later = resample(read_opd(self.after).data, self.model.npix)
            return self.measured + hours / BETWEEN_MAPS * (later - self.measured)
        change = random_drift(self.seed + 1000, hours, npix=self.model.npix).data
        return self.measured + change

    def redrawn(self, seed: int) -> Setting:
        """The setting with another simulated wavefront and drift; measured maps are kept.

        Errors include the uncertainty of the wavefront. Frames of the same wavefront share one draw
        of it, even if their noise differs.
        """
        if self.before:
            return self
        return replace(self, measured=random_opd(seed, npix=self.model.npix).data, seed=seed)

    @property
    def name(self) -> str:
        """Origin of the wavefronts."""
        return "measured maps" if self.before else f"generator, seed {self.seed}"


def setting(opd: tuple[str, str] | None, seed: int = 1, **changes: Any) -> Setting:
    """The paper's model, with settings changed by name."""
    arguments = {
        "monochromatic": WAVELENGTH,
        "fov_pixels": 80,
        "segment_gap": PAPER_SEGMENT_GAP,
        "occulter_sampling": 2.0,
        **changes,
    }
    model = dr.nircam_coronagraph("F444W", **arguments)
    if opd is None:
        return Setting(model, random_opd(seed, npix=model.npix).data, "", "", seed)
    measured = resample(read_opd(opd[0]).data, model.npix)
    return Setting(model, measured, opd[0], opd[1], seed)


@dataclass(frozen=True)
class Frame:
    """A simulated frame with its true star, planets and wavefront.

    Attributes
    ----------
    observation : Observation
    star : ndarray, (ny, nx)
        Expected photons of the star.
    noise : ndarray, (ny, nx)
        Standard deviation of the star's photons and the read noise.
    planets : tuple of (Planet, ndarray)
        With their expected photons.
    opd : ndarray
        The true wavefront, m.
    """

    observation: dr.Observation
    star: Image
    noise: Image
    planets: tuple[tuple[Planet, Image], ...]
    opd: Image

    @property
    def known_star(self) -> Image:
        """The frame minus the true star, the optimal subtraction."""
        return self.observation.data[0] - self.star


def frame(
    setup: Setting,
    hours: float,
    seed: int,
    planets: Iterable[Planet] = (),
    star: Star | None = None,
    **scene: Any,
) -> Frame:
    """Simulate one frame."""
    opd = setup.drifted(hours)
    sky = Scene(star=star or Star(), planets=tuple(planets), **scene)
    observation = simulate(setup.model, sky, opd, seed=seed)
    shining = star_photons(setup.model, sky, opd)
    noise = np.sqrt(shining + sky.background + sky.read_noise**2)
    light = tuple((p, planet_photons(setup.model, sky, p, opd)) for p in sky.planets)
    return Frame(observation, shining, noise, light, opd)


# -- running and writing -------------------------------------------------------------------------


def options(description: str) -> argparse.ArgumentParser:
    """Make a parser with the options of every study."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--opd", nargs=2, metavar=("BEFORE", "AFTER"), help="measured OPD maps")
    parser.add_argument("--seeds", type=int, default=20, help="noise realisations")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="few seeds and points, coarse pupil")
    parser.add_argument("-o", "--output", type=Path, default=Path("results"))
    return parser


def _begin_process() -> None:
    torch.set_num_threads(1)
    # pyKLIP makes a pool for every subtraction; spawned, it would import everything anew.
    set_start_method("fork", force=True)


def mapped(work: Callable[..., Table], jobs: list[tuple[Any, ...]], processes: int) -> Table:
    """Run jobs, in processes of one thread each, and stack their tables in order."""
    if processes == 1:
        return vstack([work(*job) for job in jobs], metadata_conflicts="silent")
    with ProcessPoolExecutor(processes, get_context("spawn"), _begin_process) as pool:
        tables = list(pool.map(work, *zip(*jobs, strict=True)))
    return vstack(tables, metadata_conflicts="silent")


def write_table(table: Table, path: Path, seconds: float) -> None:
    """Write a table with the command that made it."""
    for name in table.colnames:
        if table[name].dtype.kind == "f":
            table[name].info.format = ".5g"
    table.meta = {
        "command": " ".join(["python", *_without_folders(sys.argv)]),
        "date": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}",
        "seconds": round(seconds),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, torch {torch.__version__}",
    }
    with replacing(path) as temporary:
        table.write(temporary, format="ascii.ecsv", overwrite=True)
    print(f"wrote {path}")


def _without_folders(words: list[str]) -> list[str]:
    """Arguments with paths relative to the project, or by name only if they are outside it."""
    root = Path.cwd()
    shortened = []
    for word in words:
        path = Path(word)
        if path.is_absolute() and path.is_relative_to(root):
            word = str(path.relative_to(root))
        elif path.is_absolute():
            word = path.name
        shortened.append(word)
    return shortened


def timed_table(work: Callable[[], Table], path: Path) -> Table:
    """Run a study, write its table, and return it."""
    began = time.perf_counter()
    table = work()
    write_table(table, path, time.perf_counter() - began)
    return table
