"""Sources beside a real star, from files to limits: are they found, and what do they cost?

Run from the root of the project::

    python -m benchmarks.neighbours FRAMES MAP -o neighbours.ecsv [--jobs N] [--fields N]

FRAMES is the folder with the calints files of programme 1184. A source is added to both rolls of
G 7-34 in F444W, as the fit of the untouched files renders it, with photon noise and the errors that
it adds, but without the detector pattern, which real companions hardly show. The changed files
are reduced with the defaults. A row says whether both files were used as before, whether the source
is among the companions of the fit and the candidates, its measured contrast and position, what was
found that the untouched frames do not show, and the ratio of the limits further than 1.5 lambda/D
from it to those without it. With --fields, as many fields of 300 stars take the place of the single
sources: of those that the limits without them would show, how many are found?
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.io.files import write_table
from pyklip_diffrender.scene.aligned_frames import shift_frames

NAMES = "jw0118400[56]001_03106_*calints.fits*"
ANGLE = 110.0
SIDE = 160
"""Pixels with light of the source; 80 are fitted."""
GAIN = 1.82
"""Electrons per count of NIRCam's long-wave detectors (JWST User Documentation, "NIRCam Detector
Performance")."""
CASES = (
    (1e-4, 0.6), (1e-4, 1.2), (1e-3, 0.4), (1e-3, 1.2), (1e-3, 2.0), (1e-2, 0.6), (1e-2, 1.2),
    (1e-2, 2.0), (0.1, 0.4), (0.1, 0.8), (0.1, 1.5), (0.1, 2.2), (1e-3, 3.2), (1e-2, 3.2),
)  # fmt: skip
"""Contrasts, and separations in arcsec."""
STARS, FIELD, EDGE, INNER = 300, 20.0, 4.9, 0.3
"""Stars in a field, its side, and how far from the star they are rendered, arcsec."""
FAINTEST, SLOPE = (5e-7, 1e-3), 0.75
"""Range of their contrasts, of which more than c are in proportion to c to the power of -0.75."""


def sources_of(case: tuple[float, float]) -> NDArray[Any]:
    """Contrast and x, y in arcsec of the sources of a case, (k, 3).

    It is the contrast and separation of one source; or 0 and the number of a field of stars.
    """
    contrast, separation = case
    if contrast:
        return np.array([[contrast, *dr.Planet(contrast, separation, ANGLE).offset]])
    rng = np.random.default_rng(int(separation))
    places = rng.uniform(-FIELD / 2, FIELD / 2, (STARS, 2))
    least, most = (each**-SLOPE for each in FAINTEST)
    contrasts = (least - rng.uniform(size=STARS) * (least - most)) ** (-1 / SLOPE)
    inside = (np.abs(places).max(axis=1) < EDGE) & (np.hypot(*places.T) > INNER)
    return np.column_stack([contrasts, places])[inside]


def light_of(
    reduction: dr.Reduction, cut: dr.ExposureSequence, sources: NDArray[Any]
) -> list[NDArray[Any]]:
    """Light of the sources in each frame of `cut`, (ny, nx), on the pixels of the detector."""
    frames = reduction.fit.frames
    lights = []
    for frame, part in zip(frames, cut.science, strict=True):
        roll = frame.observation.roll_from(frames[0].observation)
        light = np.zeros(part.shape)
        for contrast, *place in sources.tolist():
            planet = dr.Planet.from_offset(contrast, *place)
            x, y = frame.values["star_offset"] + planet.rotated(roll).offset
            one = frame.render(
                part.shape, tuple(part.center[0]), background=False, source=(float(x), float(y))
            )
            light += contrast * one.reshape(part.shape)
        lights.append(light)
    return lights


def with_source(
    paths: list[Path], folder: Path, sequence: dr.ExposureSequence, lights: list[NDArray[Any]]
) -> None:
    """Write the files with the light added, shifted as the alignment has shifted the frames.

    Parameters
    ----------
    paths : list of Path
        Of the two rolls.
    folder : Path
        For the changed files.
    sequence : ExposureSequence
        The untouched frames, on the pixels of the detector.
    lights : list of ndarray, (ny, nx)
        See `light_of`.
    """
    size = lights[0].shape[-1]
    windows, _ = sequence.windows((size, size))
    rng = np.random.default_rng(6)
    for path, frame, window, light in zip(paths, sequence.science, windows, lights, strict=True):
        with fits.open(path) as hdus:
            science = hdus["SCI"]
            stated = np.array([science.header[key] - 1 for key in ("CRPIX1", "CRPIX2")])
            per_unit = science.header["PHOTMJSR"] / (GAIN * hdus[0].header["EFFINTTM"])
            variance = per_unit * np.clip(light, 0, None)
            box = np.s_[:, window.y : window.y + size, window.x : window.x + size]
            whole = np.zeros((2, *science.shape[1:]))
            whole[0][box[1:]] = light + np.sqrt(variance) * rng.normal(size=light.shape)
            whole[1][box[1:]] = variance
            moved = shift_frames(whole, np.tile(stated - frame.center[0], (2, 1)))
            science.data += moved[:1]
            hdus["ERR"].data = np.sqrt(hdus["ERR"].data ** 2 + np.clip(moved[1:], 0, None))
            hdus.writeto(folder / path.name.removesuffix(".gz"))


def candidates_of(reduction: dr.Reduction) -> list[tuple[Any, float, float]]:
    """Rows of the candidates in all pixels that were searched, and their x, y, arcsec."""
    detection, wide = reduction.detection, reduction.wide
    rows = []
    for row in detection.candidates if wide is None else wide.candidates:
        angle = np.deg2rad(row["position_angle"].to_value("deg") - detection.north)
        r = row["separation"].to_value("arcsec")
        rows.append((row, -r * np.sin(angle), r * np.cos(angle)))
    return rows


def one(frames: Path, opd: Path, base: dict[str, Any], case: tuple[float, float]) -> dict[str, Any]:
    """Reduce the files with one source."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    sources = sources_of(case)
    row: dict[str, Any] = {"contrast": case[0], "separation": case[1], "outcome": "as before"}
    paths = sorted(frames.glob(NAMES))
    sequence = dr.ExposureSequence.from_files(paths)
    with tempfile.TemporaryDirectory() as place:
        lights = light_of(base["untouched"], sequence.cutout(SIDE), sources)
        with_source(paths, Path(place), sequence, lights)
        try:
            changed = dr.ExposureSequence.from_files(place)
        except DiffrenderError as error:
            return row | {"outcome": f"refused: {error}"}
        if changed.excluded or len(changed.science) != len(sequence.science):
            row["outcome"] = f"excluded: {changed.excluded}"
        elif [each.first_pixel for each in changed.science] != base["first"]:
            row["outcome"] = "another first_pixel"
        try:
            reduction = dr.reduce(changed, opd, wide=base["wide"])
        except DiffrenderError as error:
            return row | {"outcome": f"no fit: {error}"}
    detection = reduction.detection
    without = base["untouched"].detection
    flux, before = (each.fit.frames[0].flux for each in (reduction, base["untouched"]))

    def away(places: NDArray[Any], others: NDArray[Any]) -> NDArray[Any]:
        """Distances (..., k) of places from others (k, 2)."""
        return np.hypot(*np.moveaxis(places[..., None, :] - others, -1, 0))

    # Those that are bright enough to be seen without the others.
    nearest = away(sources[:, 1:], without.grid.reshape(-1, 2)).argmin(axis=-1)
    limits = detection.threshold * without.error.ravel()[nearest]
    half = np.abs(without.grid).max()
    is_shown = (sources[:, 0] > limits) & (np.abs(sources[:, 1:]).max(axis=1) < half)
    is_shown |= len(sources) == 1
    shown = sources[is_shown]
    resolution = reduction.fit.model.resolution
    far = (away(detection.grid, shown[:, 1:]) > 1.5 * resolution).all(axis=-1)
    far &= (np.hypot(*np.moveaxis(detection.grid, -1, 0)) > 0.3) & np.isfinite(detection.error)
    ratio = (flux * detection.error / (before * without.error))[far]
    photon = (flux * detection.photon_error / (before * without.photon_error))[far]
    found, false = set(), 0
    known = np.array([[x, y] for _, x, y in candidates_of(base["untouched"])]).reshape(-1, 2)
    for candidate, *there in candidates_of(reduction):
        distances = away(np.array(there), sources[:, 1:])
        nearest = int(distances.argmin())
        if distances[nearest] > 0.5 * resolution:
            false += not (away(np.array(there), known) < 0.5 * resolution).any()
            continue
        found.add(nearest)
        measured = float(candidate["contrast"]) * flux / before
        deviation = float(candidate["contrast_error"]) * flux / before
        if len(sources) == 1:
            row["measured"] = measured / sources[0, 0]
            row["pull"] = (measured - sources[0, 0]) / deviation
            row["off_mas"] = 1e3 * float(distances[nearest])
    scatter = np.nanstd(np.clip(detection.residual_snr[far], -5, 5))
    return row | {
        "status": reduction.fit.status.name, "chi2": float(reduction.fit.chi2_per_pixel),
        "star": flux / before, "visible": len(shown), "false": false,
        "found": int(is_shown[list(found)].sum()),
        "companions": len(reduction.fit.planets),
        "limits": float(np.nanmedian(ratio)), "limits_90": float(np.nanpercentile(ratio, 90)),
        "limits_10": float(np.nanpercentile(ratio, 10)), "scatter": float(scatter),
        "photon_limits": float(np.nanmedian(photon)),
        "photon_limits_90": float(np.nanpercentile(photon, 90)),
    }  # fmt: skip


def main() -> None:
    """Reduce the untouched files and those with each source."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("frames", type=Path)
    parser.add_argument("map", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--wide", action="store_true", help="search the whole frames as well")
    parser.add_argument("--cases", nargs="+", metavar="CONTRAST,ARCSEC", help="instead of all")
    parser.add_argument("--fields", type=int, default=0, help="fields of stars, instead of all")
    options = parser.parse_args()
    cases: list[tuple[float, float]] = list(CASES)
    if options.cases:
        pairs = (case.split(",") for case in options.cases)
        cases = [(float(contrast), float(separation)) for contrast, separation in pairs]
    if options.fields:
        cases = [(0.0, float(number)) for number in range(options.fields)]
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    sequence = dr.ExposureSequence.from_files(sorted(options.frames.glob(NAMES)))
    untouched = dr.reduce(sequence, options.map, wide=options.wide)
    base = {
        "first": [each.first_pixel for each in sequence.science],
        "untouched": untouched,
        "wide": options.wide,
    }
    work = partial(one, options.frames, options.map, base)
    rows = []
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(work, cases):
            print(row, flush=True)
            rows.append(row)
            names = list(dict.fromkeys(name for row in rows for name in row))
            table = Table(rows=[{name: row.get(name, np.nan) for name in names} for row in rows])
            table.meta = provenance("benchmarks.neighbours FRAMES MAP")
            write_table(table, options.output)


if __name__ == "__main__":
    main()
