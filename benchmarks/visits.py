"""Simulated visits with reference stars, reduced with the defaults: calibration of the joint fit.

Run from the root of the project::

    python -m benchmarks.visits --output FOLDER [--cases N] [--size PIXELS] [--jobs N] [--null]

Each visit has one or two rolls of a star with two planets, and one to nine small-grid dithers of a
reference star, as calints files. The images are those of a finer copy of the package's model with
another blur and other internal aberrations. The wavefront has drifted by 6 nm since the map from
which the reduction starts, and by 0.5 to 5 nm from frame to frame. The flat field has an error of
2 % in every pixel, which nobody tells the reduction, and some pixels are bad. References are half
to twice as bright as the target; some have another spectral type, a companion, or were not where
their header says.

Writes ``visits.ecsv`` with a row for every visit: planets that were found and missed, false
candidates, scatter of the S/N, the star's flux over the true one, and limits over those of a fit
without references, in units of flux; and ``visit_planets.ecsv`` with the pulls of every planet that
was found. With ``--null`` the visits have no planets and are reduced
with their references only, because planets that are not found widen the scatter of the S/N.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.table import Table

import pyklip_diffrender as dr
from benchmarks import stpsf_sequences as made
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.instrument import detector_place
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.sequence import ExposureSequence

NPIX = 512
DITHERS = (*made.DITHERS, (0.0, 0.02), (0.02, 0.0), (0.0, -0.02), (-0.02, 0.0))


@dataclass(frozen=True)
class Visit:
    """A visit: what is observed, and how far its frames differ."""

    number: int
    case: made.Case
    drift: float
    brightness: float
    dithers: int
    rolls: int
    temperature: float = 5700.0
    companion: float = 0.0
    displaced: bool = False


def visits(count: int, size: int) -> list[Visit]:
    """The first `count` visits of a fixed list, each with its own seed."""
    masks = (
        ("F444W", "MASK335R"), ("F356W", "MASK335R"), ("F210M", "MASK335R"),
        ("F200W", "MASK335R"), ("F460M", "MASKLWB"),
    )  # fmt: skip
    listed = []
    for k in range(count):
        rng = np.random.default_rng([7, k])
        filter, mask = masks[k % 5 if k % 2 else 0]
        case = replace(made.CASES.get(f"{filter} {mask}", made.CASES["F444W MASK335R"]),
                       filter=filter, mask=mask, size=size)  # fmt: skip
        if mask == "MASK335R":
            # Where single rolls of that size show planets of S/N 10 or so.
            bright, faint = (6e-5, 3e-5) if filter > "F300" else (1.5e-4, 6e-5)
            angles = rng.uniform(0, 360, 2)
            outer = 0.42 * size * (0.063 if filter > "F300" else 0.031)
            case = replace(case, planets=(Planet(bright, 0.65 * outer, angles[0]),
                                          Planet(faint, 0.9 * outer, angles[1])))  # fmt: skip
        special = k % 8
        listed.append(
            Visit(
                k, case, drift=(0.5e-9, 2e-9, 5e-9)[k % 3], brightness=(2.0, 1.0, 0.5)[k // 3 % 3],
                dithers=(5, 1, 9, 5)[k % 4], rolls=1 if k % 7 == 3 else 2,
                temperature=3300.0 if special == 5 else 5700.0,
                companion=1e-3 if special == 6 else 0.0, displaced=special == 7,
            )
        )  # fmt: skip
    return listed


def _headers(visit: Visit) -> dr.Observation:
    """An empty frame in the set-up of a visit, for its model."""
    place = detector_place(visit.case.mask, visit.case.filter, None)
    ones = np.ones((visit.case.side, visit.case.side))
    header = fits.Header(
        {"INSTRUME": "NIRCAM", "DETECTOR": place.header_detector,
         "CORONMSK": visit.case.mask.replace("MASK", "MASKA")}
    )  # fmt: skip
    return dr.Observation.from_arrays(
        ones, ones, unit="MJy/sr", pixelscale=place.siaf_pixelscale, filter=visit.case.filter,
        header=header,
    )  # fmt: skip


def write_frames(visit: Visit, folder: Path) -> Path:
    """Write the frames of a visit and the map of before; returns the map."""
    rng = np.random.default_rng([11, visit.number])
    case, side = visit.case, visit.case.side
    seeds = rng.integers(2**31, size=2 + visit.rolls + visit.dithers)
    opd = np.asarray(dr.wavefront.random_opd(int(seeds[0]), npix=NPIX, rms=6e-8).data)
    before = folder / made.MAP
    hdu = fits.PrimaryHDU(opd)
    hdu.header["BUNIT"] = "m"
    hdu.writeto(before, overwrite=True)
    changed = opd + made.changed(int(seeds[1]), made.DRIFT, NPIX)
    models = {
        temperature: dr.model_for(
            _headers(visit), side, npix=NPIX, nlambda=13, source=temperature, dtype=torch.float64
        )
        for temperature in {5700.0, visit.temperature}
    }
    truth = {
        "blur": 0.026 + 0.002 * rng.normal(),
        "si_zernikes": 2e-9 * rng.normal(size=parameter("si_zernikes").size),
    }
    flat = 1 + made.FLAT_ERROR * rng.normal(size=(side, side))
    flagged = rng.random((side, side)) < made.FLAGGED
    hot = rng.integers(side // 2 - 15, side // 2 + 15, (made.UNFLAGGED, 2))

    def image(model: Any, wavefront: np.ndarray, place: Any) -> np.ndarray:
        with torch.no_grad():
            light = model(torch.from_numpy(wavefront), star_offset=tuple(place), **truth)
        return np.asarray(light.numpy())

    def exposure(star: str, k: int, roll: float, light: np.ndarray) -> None:
        made.write(case, folder, star, k, roll, flat * case.flux * light, flagged, hot,
                    visit.number % 60)  # fmt: skip

    for k in range(visit.rolls):
        wavefront = changed + made.changed(int(seeds[2 + k]), visit.drift, NPIX)
        place, roll = np.array(made.STARS[k]), made.ROLLS[k]
        light = image(models[5700.0], wavefront, place)
        for planet in case.planets:
            away = place + planet.rotated(-roll).offset
            light = light + planet.contrast * image(models[5700.0], wavefront, away)
        exposure("HD 1", k + 1, roll, light)
    other = models[visit.temperature]
    for k in range(visit.dithers):
        wavefront = changed + made.changed(int(seeds[2 + visit.rolls + k]), visit.drift, NPIX)
        away = (0.03, -0.02) if visit.displaced and k == 0 else (0.0, 0.0)
        place = np.add(DITHERS[k], away)
        light = image(other, wavefront, place)
        if visit.companion:
            light = light + visit.companion * image(other, wavefront, np.add(place, (0.7, -0.5)))
        exposure("HD 2", k + 3, 120.0, visit.brightness * light)
    return before


def reduced(visit: Visit, folder: Path) -> dict[str, Any]:
    """Make a visit, reduce it with and without its references, and compare with the truth."""
    done = folder / "result.json"
    if done.is_file():
        return dict(json.loads(done.read_text(encoding="utf-8")))
    folder.mkdir(parents=True, exist_ok=True)
    before = write_frames(visit, folder)
    sequence = ExposureSequence.from_files(folder / "frames", target="HD 1")
    size, seconds, results, stars = visit.case.size, {}, {}, {}
    for use in ("joint", "off") if visit.case.planets else ("joint",):
        began = time.process_time()
        reduction = dr.reduce(sequence, before, size=size, references=use)
        seconds[use] = time.process_time() - began
        results[use] = made.compare(visit.case, reduction)
        stars[use] = reduction.fit.frames[0].flux / visit.case.flux
        if use == "joint":
            used = [each.use == "wavefront" for each in reduction.visit.contributions]
            remarks = "; ".join(
                dict.fromkeys(each.reason for each in reduction.visit.contributions if each.reason)
            )
    joint = results["joint"]
    result = {
        "visit": visit.number, "filter": visit.case.filter, "mask": visit.case.mask,
        "drift_nm": 1e9 * visit.drift, "brightness": visit.brightness, "dithers": visit.dithers,
        "rolls": visit.rolls,
        "special": "spectral type" if visit.temperature != 5700.0
        else "companion" if visit.companion else "displaced" if visit.displaced else "",
        "used": sum(used), "status": joint["status"], "chi2": joint["chi2"],
        "false": len(joint["false"]),
        "scatter": joint["snr_scatter"], "factor": joint["error_factor"],
        "star": stars["joint"], "cpu": seconds["joint"], "remarks": remarks,
    }  # fmt: skip
    if visit.case.planets:
        planets = [each for each in joint["planets"] if "snr" in each]
        alone = results["off"]
        ratio = np.array(alone["limits"]) / np.array(joint["limits"])
        ratio *= stars["off"] / stars["joint"]
        result |= {
            "found": len(planets), "found_alone": sum("snr" in each for each in alone["planets"]),
            "false_alone": len(alone["false"]),
            "deeper": float(np.median(ratio)), "deeper_least": float(np.min(ratio)),
            "over_known": joint["limits_over_known_star"],
            "star_alone": stars["off"], "cpu_alone": seconds["off"],
            "planets": [
                {"visit": visit.number, "contrast": each["contrast"],
                 "separation": each["separation"], "snr": each["snr"],
                 "contrast_pull": each["flux_pull"], "separation_pull": each["separation_pull"],
                 "angle_pull": each["angle_pull"],
                 # With the S/N as the error of a flux, which does not contain that of the star's.
                 "flux_pull": each["snr"] * (1 - 1 / (each["ratio"] * stars["joint"]))}
                for each in planets
            ],
        }  # fmt: skip
    done.write_text(json.dumps(result, indent=2), encoding="utf-8")
    return result


def _run(visit: Visit, folder: Path) -> dict[str, Any]:
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    try:
        return reduced(visit, folder)
    except DiffrenderError as error:
        return {"visit": visit.number, "status": f"{type(error).__name__}: {error}"}


def main() -> None:
    """Reduce the visits, and print and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--size", type=int, default=80)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--null", action="store_true", help="leave the planets out")
    options = parser.parse_args()
    listed = visits(options.cases, options.size)
    if options.null:
        listed = [replace(each, case=replace(each.case, planets=())) for each in listed]
    folders = [options.output / f"visit_{visit.number:02d}" for visit in listed]
    context = multiprocessing.get_context("spawn")
    rows = []
    with ProcessPoolExecutor(options.jobs, mp_context=context) as pool:
        for result in pool.map(_run, listed, folders):
            rows.append(result)
            print({k: v for k, v in result.items() if k != "planets"}, flush=True)
    whole = [row for row in rows if "chi2" in row]
    planets = [planet for row in whole for planet in row.pop("planets", ())]
    table = Table(whole)
    if planets:
        found = Table(planets)
        found.write(options.output / "visit_planets.ecsv", overwrite=True)
        for name in ("contrast_pull", "separation_pull", "angle_pull", "flux_pull"):
            pull = np.asarray(found[name])
            print(name, "rms", np.sqrt(np.mean(pull**2)), "mean", pull.mean(), len(pull))
    table.write(options.output / "visits.ecsv", overwrite=True)
    scatter = np.asarray(table["scatter"] * table["factor"])
    print("scatter before it is scaled", scatter.mean(), scatter.min(), scatter.max())
    print("false", sum(table["false"]))


if __name__ == "__main__":
    main()
