"""Sequences whose images the real stpsf makes, reduced with the defaults: planets, errors, limits.

Run from the root of the project, with stpsf installed and its data named by STPSF_PATH::

    STPSF_PATH=... python -m benchmarks.stpsf_sequences --output FOLDER [--cases NAME ...]
        [--references N] [--repeat N] [--size PIXELS] [--age DAYS] [--brightness FACTOR]
        [--accuracy quick]

Each case has two rolls of a star with two planets, as calints files with the headers of MAST. The
images are stpsf's, with its internal wavefront errors, jitter, distortion, charge diffusion and
interpixel capacitance. The wavefront has drifted from stpsf's map, from which the reduction starts,
and from roll to roll; the star is a few milliarcseconds from the middle of the mask. The flat field
has an error of 2 % in every pixel, which nobody tells the reduction; pixels are bad, some of them
without a flag; and there are photon and read noise. With ``--references`` a second, brighter star
was observed at small dithers. Other numbers of ``--repeat`` have other wavefronts, flat fields,
bad pixels and noise, and ``--size`` is the side of the fitted square. With ``--age`` the map is so
many days old, and the wavefront has drifted accordingly; ``--brightness`` multiplies the light of
the star and its planets.

Prints a row for each case: planets that were found and missed, false candidates, pulls of flux and
position, scatter of the S/N without the candidates, limits over those for a known star beyond 0.5
arcsec, time of the processor and memory; then the rms of the pulls of everything that is finished
in FOLDER, which is not repeated.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import resource
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from scipy.ndimage import gaussian_filter, map_coordinates

import pyklip_diffrender as dr
from benchmarks.calints_files import calints
from benchmarks.stpsf_data import nircam, stop_of
from pyklip_diffrender.instrument import detector_place
from pyklip_diffrender.instrument.masks import filter_shift
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.reduction.klip import klip_curve
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.wavefront.opd import random_drift

ROLLS = (70.0, 80.0)
DRIFT, BETWEEN = 6e-9, 2e-9
"""Rms of the wavefront's change since a recent map, and between frames, m."""

CORRECTED_DAYS = 33.0
"""Days between corrections of the mirrors."""

STARS = ((0.002, -0.003), (-0.004, 0.001))
"""Places of the star behind the mask, arcsec."""

DITHERS = ((0.0, 0.0), (0.01, 0.01), (-0.01, 0.01), (0.01, -0.01), (-0.01, -0.01))
FLAT_ERROR = 0.02
FLAGGED, UNFLAGGED = 0.005, 4
"""Fraction of the pixels with a flag, and number of bad ones without one near the star."""

MARGIN = 8
"""Pixels of the frames beyond the fitted square, on each side."""

OVERSAMPLE = 4
"""Samples per pixel of stpsf's images."""

MATCHED = 0.08
"""arcsec from a planet within which a candidate is that planet."""

INNER = 0.5
KLIP_INNER = 0.3


@dataclass(frozen=True)
class Case:
    """A set-up, and planets with separations (arcsec) and position angles (deg) on the sky."""

    filter: str
    mask: str
    aperture: str
    planets: tuple[Planet, ...]
    nlambda: tuple[int, int] = (3, 3)
    """Number of wavelengths of the star and of planets. With one, planets behind the mask are 1.8
    mas from where those of a whole filter are in F210M, and 1 to 3 % too bright."""
    flux: float = 3e7
    size: int = 80
    """Side of the fitted square, pixels."""
    age: float | None = None
    """Days from the map to the frames, see `drift_in`; None: two days, without such a drift."""
    accuracy: Literal["full", "quick"] = "full"

    @property
    def name(self) -> str:
        return f"{self.filter} {self.mask}"

    @property
    def side(self) -> int:
        """Side of the frames, pixels."""
        return self.size + 2 * MARGIN

    @property
    def map_name(self) -> str:
        """Name of the file of the map, with its date."""
        date = Time("2022-10-03") - (2 if self.age is None else self.age) * u.day
        return f"opd_{date.isot[:10]}.fits"


def _planets(*places: tuple[float, float, float]) -> tuple[Planet, ...]:
    return tuple(Planet(*place) for place in places)


WIDE = (7, 3)
BAR = (9, 3)
"""Along a bar the star is bright, and three wavelengths would show as separate speckles."""

SHORT = _planets((1.5e-4, 0.45, 40.0), (4e-5, 0.75, 210.0))
CASES = {
    case.name: case
    for case in (
        Case("F210M", "MASK335R", "NRCA2_FULL_MASK335R", SHORT),
        Case("F460M", "MASKLWB", "NRCA5_FULL_MASKLWB_F460M",
             _planets((1e-4, 0.65, 80.0), (5e-5, 0.85, 240.0)), BAR),
        Case("F210M", "MASK210R", "NRCA2_FULL_MASK210R", SHORT),
        Case("F444W", "MASK335R", "NRCA5_FULL_MASK335R",
             _planets((5e-5, 0.65, 40.0), (2e-5, 0.85, 210.0)), WIDE),
        Case("F356W", "MASK430R", "NRCA5_FULL_MASK430R",
             _planets((5e-5, 0.70, 40.0), (2e-5, 0.85, 210.0)), WIDE),
        Case("F200W", "MASK335R", "NRCA2_FULL_MASK335R", SHORT, WIDE),
        Case("F210M", "MASKSWB", "NRCA4_FULL_MASKSWB_F210M",
             _planets((1.5e-4, 0.45, 80.0), (4e-5, 0.75, 240.0)), BAR),
    )
}  # fmt: skip


def drift_in(days: float) -> float:
    """Rms of the change of the wavefront within so many days, m.

    It drifts like a random walk, by 9 nm rms in 3.6 days (Feng et al. 2025, section 4). The mirrors
    are corrected every 29 to 36 days on average (JWST User Documentation, "Optics Performance and
    Stability"): then both wavefronts have drifted from the same one, each on a path of its own.
    """
    drift = 9e-9 * math.sqrt(min(days, CORRECTED_DAYS) / 3.6)
    return drift if days <= CORRECTED_DAYS else math.sqrt(2) * drift


def map_of(instrument: Any) -> tuple[np.ndarray, fits.Header]:
    """The OPD map that stpsf comes with, m."""
    path = Path(os.environ["STPSF_PATH"]) / Path(str(instrument.pupilopd)).name
    with fits.open(path) as hdus:
        scale = u.Unit(hdus[0].header["BUNIT"].rstrip("s")).to(u.m)
        data = hdus[0].data if hdus[0].data.ndim == 2 else hdus[0].data[0]
        return scale * data.astype(float), hdus[0].header.copy()


def image(
    instrument: Any, case: Case, opd: np.ndarray, header: fits.Header, place: tuple[float, float],
    nlambda: int,
) -> np.ndarray:  # fmt: skip
    """The image of a point source of unit flux at a place behind the mask, arcsec.

    With stpsf's charge diffusion and interpixel capacitance. Its distorted images have square
    pixels of the mean scale, which would displace planets by several mas, and are turned by the
    angle between aperture and telescope; these are on the detector's pixels by the SIAF.
    """
    import stpsf.constants
    import stpsf.detectors
    import stpsf.stpsf_core

    header["BUNIT"] = "meter"
    instrument.pupilopd = fits.HDUList([fits.PrimaryHDU(opd, header)])
    instrument.options["source_offset_x"], instrument.options["source_offset_y"] = place
    psf = instrument.calc_psf(
        nlambda=nlambda,
        fft_oversample=OVERSAMPLE,
        detector_oversample=OVERSAMPLE,
        fov_pixels=case.side,
    )
    fine, scale = psf["OVERSAMP"].data, psf["OVERSAMP"].header["PIXELSCL"]
    side = case.side
    middle = (side * OVERSAMPLE - 1) / 2
    y, x = (np.indices(fine.shape) - middle) / OVERSAMPLE
    aperture = stpsf.stpsf_core.get_siaf_with_caching("NIRCam")[case.aperture]
    sky = np.stack(aperture.sci_to_idl(x + aperture.XSciRef, y + aperture.YSciRef)[::-1])
    area = aperture.XSciScale * aperture.YSciScale / (OVERSAMPLE * scale) ** 2
    light = area * map_coordinates(fine, sky / scale + middle)
    channel = "NIRCAM_SW" if instrument.channel == "short" else "NIRCAM_LW"
    diffusion = stpsf.constants.INSTRUMENT_DETECTOR_CHARGE_DIFFUSION_DEFAULT_PARAMETERS[channel]
    light = gaussian_filter(light, diffusion / scale)
    detected = psf["DET_DIST"]
    detected.data = light.reshape(side, OVERSAMPLE, side, OVERSAMPLE).sum(axis=(1, 3))
    del detected.header["IPCINST"]  # With it stpsf would take the pixels as coupled already.
    stpsf.detectors.apply_detector_ipc(psf)
    return np.array(detected.data, dtype=float)


def write_frames(case: Case, folder: Path, references: int = 0, repeat: int = 0) -> Path:
    """Write the frames of a case and the map of before; returns the map."""
    instrument = nircam(Path(os.environ["STPSF_PATH"]), case.mask, stop_of(case.mask), case.filter,
                        1024, aperture=case.aperture, nd_squares=False)  # fmt: skip
    opd, header = map_of(instrument)
    before = folder / case.map_name
    hdu = fits.PrimaryHDU(opd, header)
    hdu.header["BUNIT"] = "m"
    if case.age is not None:
        hdu.header["DATE-OBS"] = case.map_name[4:14]
    hdu.writeto(before, overwrite=True)
    # Of its own for every case: errors of planets at the same place are independent.
    rng = np.random.default_rng([*case.name.encode(), *([repeat] if repeat else [])])
    seeds = rng.integers(2**31, size=1 + len(ROLLS) + references)
    side = case.side
    flat = 1 + FLAT_ERROR * rng.normal(size=(side, side))
    flagged = rng.random((side, side)) < FLAGGED
    hot = rng.integers(side // 2 - 15, side // 2 + 15, (UNFLAGGED, 2))
    drifted = opd + changed(int(seeds[0]), DRIFT, len(opd))
    if case.age is not None:
        hours = drift_in(case.age) / 9e-9 * 86  # It drifts by 9 nm in 86 hours.
        drift = random_drift(int(seeds[0]), hours, npix=256).data
        drifted = drifted + np.asarray(resample(drift, len(opd)))
    for k, (roll, star) in enumerate(zip(ROLLS, STARS, strict=True), 1):
        now = drifted + changed(int(seeds[k]), BETWEEN, len(opd))
        light = image(instrument, case, now, header, star, case.nlambda[0])
        for planet in case.planets:
            away = np.add(star, planet.rotated(-roll).offset)
            source = image(instrument, case, now, header, (away[0], away[1]), case.nlambda[1])
            light = light + planet.contrast * source
        write(case, folder, "HD 1", k, roll, flat * case.flux * light, flagged, hot, repeat)
    for k, dither in enumerate(DITHERS[:references], len(ROLLS) + 1):
        now = drifted + changed(int(seeds[k]), BETWEEN, len(opd))
        light = image(instrument, case, now, header, dither, case.nlambda[0])
        light = 2 * flat * case.flux * light
        write(case, folder, "HD 2", k, 120.0, light, flagged, hot, repeat)
    return before


def changed(seed: int, rms: float, npix: int) -> np.ndarray:
    """A change of the wavefront, m."""
    return np.asarray(resample(dr.wavefront.random_opd(seed, npix=256, rms=rms).data, npix))


def write(
    case: Case, folder: Path, star: str, k: int, roll: float, light: np.ndarray,
    flagged: np.ndarray, hot: np.ndarray, repeat: int,
) -> None:  # fmt: skip
    """Write a calints file of a case, with bad pixels and noise."""
    place = detector_place(case.mask, case.filter, case.aperture.rpartition("_")[2]
                           if case.mask.endswith("WB") else None)  # fmt: skip
    middle = (case.side - 1) / 2
    corner = np.round(np.add(place.center, filter_shift(case.filter)) - middle).astype(int) + 1
    pixel = place.siaf_pixelscale
    cards = {
        "DETECTOR": place.header_detector, "FILTER": case.filter,
        "CORONMSK": case.mask.replace("MASK", "MASKA"), "SUBARRAY": "FULL",
        "PUPIL": "MASKBAR" if case.mask.endswith("WB") else "MASKRND",
        "APERNAME": case.aperture, "IS_PSF": star != "HD 1",
        "CRPIX1": middle + 1, "CRPIX2": middle + 1, "V3I_YANG": 0.0,
        "PIXAR_A2": pixel[0] * pixel[1], "PIXAR_SR": pixel[0] * pixel[1] * 2.35044e-11,
        "SUBSTRT1": int(corner[0]), "SUBSTRT2": int(corner[1]),
    }  # fmt: skip

    def spoil(arrays: dict[str, np.ndarray]) -> None:
        arrays["SCI"][:, flagged] = 1e3
        arrays["DQ"][:, flagged] = 1
        for row, column in hot:
            arrays["SCI"][:, row, column] += 20 * arrays["ERR"][:, row, column]

    # The noise is drawn by the date.
    minute = list(CASES).index(case.name) if case.name in CASES else len(CASES)
    name = f"jw01184{k:03d}001_03106_00001_{place.header_detector.lower()}_calints.fits"
    path = folder / "frames" / name
    path.unlink(missing_ok=True)
    calints(
        path, star, observation=k, roll=roll, cards=cards, light=light, change=spoil,
        date=f"2022-10-03T{k:02}:{minute:02}:{repeat:02}",
    )  # fmt: skip


def reduced(case: Case, folder: Path, references: int = 0, repeat: int = 0) -> dict[str, Any]:
    """Make the frames of a case, reduce them with the defaults, and compare with the truth."""
    done = folder / ("result.json" if case.accuracy == "full" else f"{case.accuracy}.json")
    if done.is_file():
        result: dict[str, Any] = json.loads(done.read_text(encoding="utf-8"))
        return result
    folder.mkdir(parents=True, exist_ok=True)
    made = time.process_time()
    before = folder / case.map_name
    if len(list((folder / "frames").glob("*.fits"))) < len(ROLLS) + references:
        before = write_frames(case, folder, references, repeat)
    made = time.process_time() - made
    sequence = ExposureSequence.from_files(folder / "frames", target="HD 1")
    began = time.process_time()
    size = case.size if case.accuracy == "full" else None
    reduction = dr.reduce(sequence, before, size=size, accuracy=case.accuracy)
    seconds = time.process_time() - began
    result = (
        compare(case, reduction)
        | klip_ratios(reduction)
        | {
            "references": [each.use for each in reduction.visit.contributions],
            "gain": reduction.visit.gain,
            "cpu_stpsf": made,
            "cpu": seconds,
            "memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        }
    )
    done.write_text(json.dumps(result, indent=2), encoding="utf-8")
    return result


def klip_ratios(reduction: dr.Reduction) -> dict[str, Any]:
    """Limits of KLIP with the same references over ours, raw and with small-sample corrections."""
    ours = reduction.detection.contrast_curve
    inside = ours["separation"].to_value("arcsec") >= KLIP_INNER
    separations = ours["separation"][inside]
    klip = klip_curve(reduction.detection, reduction.sequence.references, separations)
    ours = ours[inside][: len(klip)]
    return {
        "klip_separations": [float(each.to_value("arcsec")) for each in klip["separation"]],
        "klip_over_ours_raw": (
            np.asarray(klip["contrast"]) / np.asarray(ours["contrast"])
        ).tolist(),
        "klip_over_ours_corrected": (
            np.asarray(klip["small_sample"]) / np.asarray(ours["small_sample"])
        ).tolist(),
        "klip_modes": np.asarray(klip["modes"]).tolist(),
    }


def compare(case: Case, reduction: dr.Reduction) -> dict[str, Any]:
    """The candidates beside the planets, the scatter of the S/N, and the limits."""
    detection = reduction.detection
    table = detection.candidates
    places = [_sky(row["separation"], row["position_angle"]) for row in table]
    left, planets = set(range(len(table))), []
    for planet in case.planets:
        truth = _sky(planet.separation * u.arcsec, planet.position_angle * u.deg)
        near = [k for k in left if np.hypot(*(places[k] - truth)) < MATCHED]
        row: dict[str, Any] = {"contrast": planet.contrast, "separation": planet.separation}
        if near:
            k = min(near, key=lambda j: float(np.hypot(*(places[j] - truth))))
            left.remove(k)
            found = table[k]
            error = float(found["contrast_error"])
            along = float((found["separation"].to_value("arcsec") - planet.separation)
                          / found["separation_error"].to_value("arcsec"))  # fmt: skip
            turn = (found["position_angle"].to_value("deg") - planet.position_angle + 180) % 360
            row |= {
                "snr": float(found["snr"]),
                "ratio": float(found["contrast"]) / planet.contrast,
                "flux_pull": (float(found["contrast"]) - planet.contrast) / error,
                "separation_pull": along,
                "angle_pull": (turn - 180) / found["position_angle_error"].to_value("deg"),
                "away_mas": 1e3 * float(np.hypot(*(places[k] - truth))),
            }
        planets.append(row)
    curve = detection.contrast_curve
    beyond = curve["separation"].to_value("arcsec") >= INNER
    ratio = np.asarray(curve["contrast"] / curve["known_star"])[beyond]
    distant = np.hypot(detection.grid[..., 0], detection.grid[..., 1]) > 0.3
    return {
        "case": case.name,
        "size": case.size,
        "status": reduction.fit.status.name,
        "chi2": reduction.fit.chi2_per_pixel,
        "planets": planets,
        "false": [
            {"snr": float(table["snr"][k]), "place": places[k].tolist()} for k in sorted(left)
        ],
        "snr_scatter": float(np.nanstd(detection.residual_snr[distant])),
        "error_factor": float(detection.scatter),
        "limits_over_known_star": float(np.median(ratio)) if len(ratio) else None,
        "limits": [float(each) for each in curve["contrast"]],
        "separations": [float(each.to_value("arcsec")) for each in curve["separation"]],
    }


def _sky(separation: u.Quantity, angle: u.Quantity) -> np.ndarray:
    """Offset to the east and north, arcsec."""
    r, t = separation.to_value(u.arcsec), angle.to_value(u.rad)
    return np.array([r * np.sin(t), r * np.cos(t)])


def rows_of(results: list[dict[str, Any]]) -> Table:
    """One row for each planet."""
    about = ("case", "status", "snr_scatter", "limits_over_known_star", "cpu", "memory_gb")
    measured = ("snr", "ratio", "flux_pull", "separation_pull", "angle_pull", "away_mas")
    rows = []
    for result in results:
        shared = {name: result[name] for name in about} | {"false": len(result["false"])}
        rows += [shared | dict.fromkeys(measured, np.nan) | each for each in result["planets"]]
    table = Table(rows)
    for name in table.colnames:
        if table[name].dtype.kind == "f":
            table[name].format = ".3g"
    return table


def print_pulls(table: Table) -> None:
    """Print number, mean and rms of the pulls of all planets that were found."""
    for name in ("flux_pull", "separation_pull", "angle_pull"):
        values = table[name][np.isfinite(table[name])]
        print(f"{name} of {len(values)} planets: mean {np.mean(values):+.2f}, rms "
              f"{np.sqrt(np.mean(values**2)):.2f}")  # fmt: skip


def _run(case: Case, folder: Path, references: int, repeat: int) -> dict[str, Any]:
    warnings.simplefilter("ignore")
    return reduced(case, folder, references, repeat)


def main() -> None:
    """Run the cases one after another, each in a process of its own, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--references", type=int, default=0, choices=range(len(DITHERS) + 1))
    parser.add_argument("--repeat", type=int, default=0, choices=range(60))
    parser.add_argument("--size", type=int, default=Case.size)
    parser.add_argument("--age", type=float, help="days from the map to the frames")
    parser.add_argument("--brightness", type=float, default=1.0)
    parser.add_argument("--accuracy", default=Case.accuracy, choices=["full", "quick"])
    options = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    for name in options.cases:
        again = f"_{options.repeat}" if options.repeat else ""
        other = f"_size{options.size}" if options.size != Case.size else ""
        other += "" if options.age is None else f"_age{options.age:g}"
        other += "" if options.brightness == 1 else f"_brightness{options.brightness:g}"
        folder = options.output / f"{name.replace(' ', '_')}_{options.references}{again}{other}"
        case = replace(
            CASES[name],
            size=options.size,
            flux=options.brightness * CASES[name].flux,
            age=options.age,
            accuracy=options.accuracy,
        )
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            try:
                about = (case, folder, options.references, options.repeat)
                result = pool.submit(_run, *about).result()
            except Exception as error:
                print(f"{name}: {type(error).__name__}: {error}", flush=True)
            else:
                rows_of([result]).pprint_all()
    done = sorted(options.output.glob("*/*.json"))
    print_pulls(rows_of([json.loads(path.read_text(encoding="utf-8")) for path in done]))


if __name__ == "__main__":
    main()
