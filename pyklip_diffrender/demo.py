"""The demo: a simulated planet near a star, with an OPD map that is 40 hours old.

The scene follows Feng et al. 2025, with a seeded wavefront in place of the measured one: 4.5 um,
beta Pictoris for two hours, 80 x 80 pixels; KLIP has nine dithered images of alpha Pictoris, taken
three hours later and 10 mas off (their appendix C).
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import Detection, detect
from pyklip_diffrender.detection.metrics import annulus_snr, star_model_error, throughput
from pyklip_diffrender.instrument.masks import lyot_openings
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.io.files import write_fits, write_table
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.reduction.klip import klip_rdi
from pyklip_diffrender.refinement import Refinement, refine
from pyklip_diffrender.scene.objects import (
    ALPHA_PICTORIS_W2,
    PAPER_SEGMENT_GAP,
    Planet,
    Scene,
    Star,
)
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.simulation import planet_photons, simulate, star_photons
from pyklip_diffrender.wavefront.opd import random_drift, random_opd
from pyklip_diffrender.wavefront.opd_map import OPDMap

_log = logging.getLogger(__name__)

Image = NDArray[np.float64]

DITHERS = (
    (0, 0), (0, 20), (-15, 15), (-20, 0), (-15, -15), (0, -20), (15, -15), (20, 0), (15, 15),
)  # fmt: skip
"""The 9-POINT-CIRCLE small-grid dither, mas."""


@dataclass
class DemoResult:
    """Everything that the demo computed."""

    model: OpticalSystem
    scene: Scene
    observation: Observation
    measured: OPDMap
    true_opd: Image
    fit: Refinement
    # Star-subtracted frames, photons: "initial", "KLIP", "refined", "detected" (refined again with
    # the detected planets in the model), "optimal".
    images: dict[str, Image]
    # (ny, nx), standard deviations, photons.
    noise: Image
    # One row per image: annulus SNR, planet throughput, star-model error, seconds.
    table: Table
    # Point sources with the wavefront marginalised.
    detection: Detection

    def __repr__(self) -> str:
        return f"<DemoResult: {self.fit!r}, {self.detection!r}>"


def simulate_references(model: OpticalSystem, opd: Image, *, seed: int) -> Image:
    """Nine dithered frames of the reference star, unscaled, (9, ny, nx) photons."""
    scene = Scene(star=Star(w2_magnitude=ALPHA_PICTORIS_W2, exposure=400.0))
    frames = []
    for k, (x, y) in enumerate(DITHERS):
        # The centre of the dithers is 10 mas from the position of the target star (appendix C).
        offset = ((x + 10) * 1e-3, y * 1e-3)
        frames.append(simulate(model, replace(scene, star_offset=offset), opd, seed=seed + k))
    return np.concatenate([frame.data for frame in frames])


def run_demo(
    *,
    contrast: float = 1e-6,
    separation: float = 0.6,
    hours: float = 40.0,
    size: int = 80,
    seed: int = 1,
    progress: bool = False,
    device: str = "cpu",
) -> DemoResult:
    """Simulate, refine, subtract, and run KLIP on the same frame of `size` pixels a side.

    The planet is at a `separation` in arcsec. The OPD map is `hours` old; `seed` determines
    wavefront, drift and noise.
    """
    planet = Planet(contrast, separation, 54.0)
    scene = Scene(planets=(planet,))
    model = nircam_coronagraph(
        "F444W", monochromatic=4.5e-6, fov_pixels=size, segment_gap=PAPER_SEGMENT_GAP, device=device
    )
    measured = random_opd(seed)
    true_opd = measured.data + random_drift(seed + 1000, hours).data
    observation = simulate(model, scene, true_opd, seed=seed)
    frame = observation.data[0]
    star = star_photons(model, scene, true_opd)
    faint = planet_photons(model, scene, planet, true_opd)
    noise = np.sqrt(star + scene.read_noise**2)

    began = time.perf_counter()
    outdated = star_photons(model, scene, measured)
    seconds = {"initial": time.perf_counter() - began}
    fit = refine(model, observation, measured, progress=progress)
    seconds["refined"] = fit.seconds
    began = time.perf_counter()
    detection = detect(fit, progress=progress)
    seconds["detected"] = fit.seconds + time.perf_counter() - began
    drift_later = measured.data + random_drift(seed + 1000, hours + 3).data
    references = simulate_references(model, drift_later, seed=seed + 2000)
    began = time.perf_counter()
    klip = klip_rdi(frame, references)
    seconds["KLIP"] = time.perf_counter() - began
    seconds["optimal"] = float("nan")

    images = {
        "initial": frame - outdated,
        "KLIP": klip,
        "refined": fit.frames[0].residual[0],
        "detected": detection.subtracted[0],
        "optimal": frame - star,
    }
    table = _compared(images, planet, faint, noise, model.detector.pixelscale, seconds)
    table.meta = {"contrast": contrast, "separation": separation, "hours": hours, "seed": seed}
    return DemoResult(
        model, scene, observation, measured, true_opd, fit, images, noise, table, detection
    )


def _compared(
    images: dict[str, Image],
    planet: Planet,
    faint: Image,
    noise: Image,
    scale: tuple[float, float],
    seconds: dict[str, float],
) -> Table:
    """A row of figures of merit for each image; `faint` is the image of the planet alone."""
    ny, nx = noise.shape
    center = ((nx - 1) / 2, (ny - 1) / 2)
    position = (center[0] + planet.offset[0] / scale[0], center[1] + planet.offset[1] / scale[1])
    radius = planet.separation / scale[0]
    rows = [
        (
            name,
            annulus_snr(image, position, center),
            throughput(image, faint, noise, position),
            # The residual of the star: the subtracted frame minus noise and planet.
            star_model_error(
                np.nan_to_num(images["optimal"] - image), np.zeros_like(noise), noise, center,
                radius - 1.5, radius + 1.5,
            ),
            seconds[name],
        )
        for name, image in images.items()
    ]  # fmt: skip
    table = Table(
        rows=rows, names=("star model", "annulus SNR", "planet throughput", "star error", "seconds")
    )
    for name, form in zip(table.colnames[1:], (".1f", ".2f", ".2f", ".1f"), strict=True):
        table[name].format = form
    return table


def write_demo(result: DemoResult, folder: Path) -> list[Path]:
    """Write images, wavefronts and the table; returns the paths."""
    primary = fits.PrimaryHDU()
    for key, value in result.fit.summary().items():
        primary.header[f"HIERARCH {key}"] = value
    hdus = fits.HDUList([primary, fits.ImageHDU(result.observation.data[0], name="FRAME")])
    hdus.extend(fits.ImageHDU(image, name=name.upper()) for name, image in result.images.items())
    for name, opd in (
        ("OPD_MEASURED", result.measured.data),
        ("OPD_TRUE", result.true_opd),
        ("OPD_REFINED", result.fit.wavefront),
    ):
        hdu = fits.ImageHDU(opd.astype(np.float32), name=name)
        hdu.header["BUNIT"] = "m"
        hdus.append(hdu)
    for hdu in hdus[1 : 2 + len(result.images)]:
        hdu.header["BUNIT"] = "photon"
    hdus.append(fits.ImageHDU(result.detection.snr.astype(np.float32), name="SNR"))
    images = folder / "demo.fits"
    write_fits(hdus, images)
    tables = {"demo.ecsv": result.table, "candidates.ecsv": result.detection.candidates}
    for name, table in tables.items():
        write_table(table, folder / name)
    return [images, *(folder / name for name in tables)]


# The figure of the demo.

_TITLES = {
    "initial": "Star from the {hours:.0f} h old wavefront",
    "KLIP": "KLIP, nine dithered references",
    "optimal": "The true star subtracted",
    "detected": "Star refined, the planet found in the model",
}


def draw_demo(result: DemoResult) -> Any:
    """Draw the frame, four subtractions over the noise, the wavefront's change and the S/N map."""
    figure, axes = drawing.new_figure(2, 4)
    grid, planet = result.fit.frames[0].grid, [result.scene.planets[0].offset]
    frame = np.maximum(result.observation.data[0], 1)
    drawing.star_image(
        axes[0, 0], frame, grid, drawing.light_norm(frame, result.noise), bar="photons",
        title="The frame: the occulted star\nhides the planet",
    )  # fmt: skip
    for ax, name in zip([*axes[0, 1:], axes[1, 0]], _TITLES, strict=True):
        facts = result.table[list(result.table["star model"]).index(name)]
        # Where residuals of the star dominate, the fraction of the planet's light has no meaning.
        kept = (
            f", planet light kept {100 * facts['planet throughput']:.0f} %"
            if facts["star error"] < 20
            else ""
        )
        title = _TITLES[name].format(hours=result.table.meta["hours"])
        drawing.signed_image(
            ax, result.images[name] / result.noise, grid, 6.0, places=planet,
            bar="residual / noise", title=f"{title}\nSNR {facts['annulus SNR']:.1f}{kept}",
        )  # fmt: skip
    _draw_changes(axes[1, 1:3], result)
    drawing.snr_map(
        axes[1, 3], result.detection.snr, grid, planet,
        title=f"Wavefront marginalised:\n{_strongest(result)}",
    )  # fmt: skip
    return figure


def _draw_changes(axes: Any, result: DemoResult) -> None:
    """Draw the true and the fitted change of the wavefront on one scale."""
    pupil = PupilGrid.full(result.model.npix, result.model.diameter)
    stop = polygon_coverage(lyot_openings("MASKRND"), pupil).numpy() > 0.5
    changes = [
        1e9 * (opd - result.measured.data) for opd in (result.true_opd, result.fit.wavefront)
    ]
    limit = float(np.percentile(np.abs(changes[0][stop]), 99.5))
    titles = (
        "True change of the wavefront\nseen through the Lyot stop",
        "Change fitted to one frame\n(prior, no reference star)",
    )
    for ax, change, title in zip(axes, changes, titles, strict=True):
        seen = np.where(stop, change - change[stop].mean(), np.nan)
        drawing.opd_map(ax, seen, result.model.diameter, title=title, limit=limit)


def _strongest(result: DemoResult) -> str:
    """Describe the strongest candidate."""
    table, truth = result.detection.candidates, result.scene.planets[0].contrast
    if not len(table):
        return f"nothing above {result.detection.threshold:g} sigma"
    return (
        f"S/N {table['snr'][0]:.1f}, flux {table['contrast'][0] / truth:.2f} "
        f"± {table['contrast_error'][0] / truth:.2f} of true"
    )
