"""How often the hypotheses about the motion of sources are true, by the probability stated.

Run from the root of the project::

    python -m benchmarks.reliability --output docs/results/reliability.ecsv [--systems 40]

Systems of one to five companions (on Keplerian orbits), background stars and sources that are seen
once, of S/N 5 to 25 in maps of smooth noise, beside stars that move by 4 to 50 mas a year, so that
many hypotheses are not clear. The table has the stated probability and the frequency by bin, and
the last rows have the standard deviations of the pulls of places and fluxes.

With ``--data ../shared/data`` planets are injected into the rolls of two M dwarfs instead, each
reduced alone, as if the second roll were of 400 days later: two companions, a background source,
and one that is new.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy.table import QTable
from astropy.time import TimeDelta

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from benchmarks.real_frames import frames_of, opd_of
from benchmarks.synthetic_searches import found
from pyklip_diffrender import drawing
from pyklip_diffrender.detection import Motion, with_planets

YEAR = 365.25
KINDS = ("bound", "background", "neither")
FILTERS = ("F444W", "F356W")


def kepler(rng, start, circular, years):
    """Offsets (k, 2) on a random orbit that is at `start`, (2,), in the first of the years.

    `circular` is the speed, arcsec per year, of a circular orbit with that projected separation.
    """
    eccentricity, cosine = rng.uniform(0, 0.9), rng.uniform(-1, 1)
    periastron, mean = rng.uniform(0, 2 * np.pi, 2)

    def place(anomaly):
        eccentric = np.array(anomaly, dtype=float)
        for _ in range(100):
            error = eccentric - eccentricity * np.sin(eccentric) - anomaly
            eccentric -= error / (1 - eccentricity * np.cos(eccentric))
        x = np.cos(eccentric) - eccentricity
        y = np.sqrt(1 - eccentricity**2) * np.sin(eccentric)
        sine, cosine_ = np.sin(periastron), np.cos(periastron)
        return (x * cosine_ - y * sine) + 1j * (x * sine + y * cosine_) * cosine

    # In units of the semi-major axis; turned and scaled so that the first place is `start`.
    first, target = place(mean), complex(*start)
    separation = abs(target)
    frequency = circular / separation * abs(first) ** 1.5
    moved = place(mean + frequency * (years - years[0])) * target / first
    return np.stack([moved.real, moved.imag], axis=-1)


@dataclass
class Truth:
    kind: str
    places: np.ndarray  # (epochs, 2)
    snr: float
    epochs: list


def system(seed, epochs=2, filters=1, *, snr=(5.0, 25.0), proper=(0.004, 0.05), sources=(1, 5)):
    """Truth, dates and combined search of a star that moves slowly."""
    rng = np.random.default_rng(seed)
    dates = 59900 + np.concatenate([[0], np.sort(rng.uniform(150, 1400, epochs - 1))])
    years, angle = (dates - dates[0]) / YEAR, rng.uniform(0, 2 * np.pi)
    speed = rng.uniform(*proper) * np.array([np.cos(angle), np.sin(angle)])
    motion = Motion(tuple(speed), rng.uniform(0.005, 0.05), (80.0, -30.0))
    truth, present = [], [[[] for _ in range(filters)] for _ in dates]
    for _ in range(rng.integers(sources[0], sources[1] + 1)):
        kind = str(rng.choice(KINDS))
        while True:
            angle, separation = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 1.6)
            start = separation * np.array([np.cos(angle), np.sin(angle)])
            if all(np.hypot(*(start - each.places[0])) > 0.25 for each in truth):
                break
        places = np.tile(start, (epochs, 1))
        if kind == "bound":
            places = kepler(rng, start, float(motion.orbital(separation)), years)
        elif kind == "background":
            own = rng.normal(0, 0.003, 2)
            places = places + [motion.background(dates[0], each) for each in dates]
            places = places + own * years[:, None]
        height = np.exp(rng.uniform(*np.log(snr)))
        colours = np.append(1.0, rng.uniform(0.4, 1.2, filters - 1))
        seen = list(range(epochs)) if kind != "neither" else [int(rng.integers(epochs))]
        for k in seen:
            for f in range(filters):
                present[k][f].append((*places[k], height * colours[f]))
        truth.append(Truth(kind, places, height, seen))
    header = {"TARGPROP": "star", "TARG_RA": 80.0, "TARG_DEC": -30.0}
    reductions = [
        found(
            FILTERS[f], 1000 * seed + 10 * k + f, present[k][f], mjd=date, side=81, header=header,
            north=rng.uniform(0, 360),
        )
        for k, date in enumerate(dates)
        for f in range(filters)
    ]  # fmt: skip
    both = dr.combine(reductions, proper_motion=motion.proper, parallax=motion.parallax)
    return truth, dates, both


@dataclass
class Reliability:
    stated: np.ndarray  # Probabilities of all hypotheses.
    true: np.ndarray  # Whether they are true.
    place_pulls: np.ndarray
    flux_pulls: np.ndarray
    unexplained: int  # Candidates that are no source.
    missed: int


def reliability(systems):
    """Compare what is stated of candidates with the truth."""
    stated, true, place_pulls, flux_pulls, unexplained, missed = [], [], [], [], 0, 0
    for truth, dates, both in systems:
        found_ = set()
        for row in both.candidates:
            k = int(np.argmin(np.abs(dates - row["epoch_mjd"])))
            place = np.array([row["delta_ra"].value, row["delta_dec"].value])
            away = [np.hypot(*(place - t.places[k])) if k in t.epochs else np.inf for t in truth]
            source = int(np.argmin(away))
            if away[source] > 0.12:
                unexplained += 1
                continue
            found_.add(source)
            own = truth[source]
            stated += [row[f"probability_{kind}"] for kind in KINDS]
            true += [own.kind == kind for kind in KINDS]
            errors = np.array([row["delta_ra_error"].value, row["delta_dec_error"].value])
            place_pulls += ((place - own.places[k]) / errors).tolist()
            error = row["contrast_error_F444W"]
            flux_pulls.append((row["contrast_F444W"] - own.snr * 1e-6) / error)
        missed += len(truth) - len(found_)
    arrays = (np.array(each, dtype=float) for each in (stated, true, place_pulls, flux_pulls))
    return Reliability(*arrays, unexplained, missed)


PROPER = np.array([0.25, -0.30])
"""Proper motion of the real stars, which have others, arcsec per year."""

LATER = 400.0
"""Days by which the second roll is later."""

SOURCES = (
    ("bound", (0.75, 0.55), 1e-4),
    ("bound", (-0.90, 0.35), 5e-5),
    ("background", (0.20, 1.00), 8e-5),
    ("neither", (-0.50, -1.05), 9e-5),
)
"""Kind, place at the first epoch (at the second: "neither"), contrast in F444W; .7 in F356W."""


def real_system(data, star):
    """Truth, dates and combined search of sources injected into real rolls."""
    opd, reductions, dates = opd_of(data), [], [0.0, 0.0]
    moved = -PROPER * LATER / YEAR
    for band, colour in zip(FILTERS, (1.0, 0.7), strict=True):
        sequence = frames_of(data, star, band)
        for k, roll in enumerate(sequence.science):
            alone = replace(sequence, science=(roll,), references=())
            (frame,) = dr.reduce(alone, opd, accuracy="quick").fit.frames
            planets = []
            for kind, start, contrast in SOURCES:
                place = np.array(start) + (moved if (kind, k) == ("background", 1) else 0)
                if (kind, k) != ("neither", 0):
                    angle = np.degrees(np.arctan2(*place)) - frame.observation.north
                    planets.append(dr.Planet(colour * contrast, np.hypot(*place), angle))
            (shown,) = with_planets([frame], planets)
            later = TimeDelta(LATER * k, format="jd")
            middle = None if shown.mid_date is None else shown.mid_date + later
            shown = replace(shown, date=shown.date + later, mid_date=middle)
            found = dr.reduce(replace(alone, science=(shown,)), opd, accuracy="quick").detection
            reductions.append(found)
            dates[k] = found.sky.mjd
    both = dr.combine(reductions, proper_motion=PROPER)
    truth = [
        Truth(
            kind,
            np.array([start, np.array(start) + (moved if kind == "background" else 0)]),
            1e6 * contrast,
            [1] if kind == "neither" else [0, 1],
        )
        for kind, start, contrast in SOURCES
    ]
    return truth, np.array(dates), both


EDGES = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)
SETS = {"two epochs": (2, 1), "three epochs": (3, 1), "two epochs, two filters": (2, 2)}


def main():
    """Simulate, compare, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path)
    parser.add_argument("--systems", type=int, default=40)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--data", type=Path, help="inject into the real frames of this folder")
    options = parser.parse_args()
    if options.data is not None:
        for star in ("G-7-34", "HIP17695"):
            truth, dates, both = real_system(options.data, star)
            result = reliability([(truth, dates, both)])
            print(star, "missed", result.missed, "false", result.unexplained)
            print("probability of the truth", np.round(result.stated[result.true > 0], 6))
            print("pulls of places", np.round(result.place_pulls, 2))
            print("left out", both.left_out)
        return
    rows, results = [], []
    for name, (epochs, filters) in SETS.items():
        result = reliability([system(seed, epochs, filters) for seed in range(options.systems)])
        results.append(result)
        for low, high in itertools.pairwise(EDGES):
            top = result.stated <= high if high == 1 else result.stated < high
            chosen = (result.stated >= low) & top
            if chosen.any():
                stated, true = result.stated[chosen].mean(), result.true[chosen].mean()
                rows.append((name, f"{low:g} to {high:g}", int(chosen.sum()), stated, true))
        for label, pulls in (("place", result.place_pulls), ("flux", result.flux_pulls)):
            rows.append((name, f"pulls of the {label}", len(pulls), 1.0, float(np.std(pulls))))
        rows.append((name, "missed", result.missed, 0.0, float(result.unexplained)))
        print(name, "missed", result.missed, "unexplained", result.unexplained, flush=True)
    table = QTable(rows=rows, names=("set", "bin", "number", "stated", "measured"))
    table.meta = provenance(f"benchmarks.reliability --systems {options.systems}")
    for name in ("stated", "measured"):
        table[name].info.format = ".4f"
    if options.output is not None:
        table.write(options.output, format="ascii.ecsv", overwrite=True)
    table.pprint_all()
    if options.figure is not None:
        draw(results, options.figure)


def draw(results, path):
    """Draw the frequency with which hypotheses are true, by their probability."""
    stated = np.concatenate([each.stated for each in results])
    true = np.concatenate([each.true for each in results])
    ax = drawing.panel()
    ax.plot([0, 1], [0, 1], "--", color=drawing.figures.INK, lw=1)
    for low, high in itertools.pairwise(EDGES):
        chosen = (stated >= low) & (stated <= high if high == 1 else stated < high)
        # The error is that of the expected share, so that a share of 0 or 1 has one, too.
        mean, share = stated[chosen].mean(), true[chosen].mean()
        error = np.sqrt(mean * (1 - mean) / chosen.sum())
        ax.errorbar(mean, share, error, fmt="o", color=drawing.figures.ACCENT, capsize=2)
    ax.set_xlabel("stated probability")
    ax.set_ylabel("share that is true")
    ax.set_box_aspect(1.0)
    drawing.save(ax.figure, path)


if __name__ == "__main__":
    main()
