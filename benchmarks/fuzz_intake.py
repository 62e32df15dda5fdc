"""Folders as people have them: every frame is used rightly, excluded with a reason, or refused.

    python -m benchmarks.fuzz_intake --count 500 --output intake.jsonl
    python -m benchmarks.fuzz_intake --count 20 --frames calints --output intake.jsonl

Each folder has two rolls of a target and a reference star, of real frames if a folder of them is
given and simulated ones else, and one to three random mutations. What must become of it is known
from the untouched folder: the frames that are admitted must be the same, used once, as the same
star, with the same roll, epoch, brightness and place on the detector. A run that was stopped goes
on where it was.
"""

from __future__ import annotations

import argparse
import json
import logging
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table

import pyklip_diffrender as dr
from benchmarks.calints_files import calints, starlight
from benchmarks.intake_mutations import MUTATIONS, Folder
from benchmarks.provenance import provenance
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.io.files import write_table
from pyklip_diffrender.scene.exposure import Exposure
from pyklip_diffrender.scene.observation import Observation

_OUTCOMES = ("as untouched", "excluded", "refused", "wrongly refused", "wrong", "crash")


def make_frames(folder: Path, real: Path | None = None) -> Path:
    """Copy or simulate the untouched frames: two rolls of the target and a reference star."""
    folder.mkdir(parents=True, exist_ok=True)
    if real is None:
        name = "jw0118400{}001_03106_00001_nrcalong_calints.fits"
        for k, roll in ((1, 70.0), (2, 80.0)):
            calints(folder / name.format(k), observation=k, roll=roll,
                    date=f"2022-10-03T0{3 * k}:00:00")  # fmt: skip
        calints(folder / name.format(3), "HD 2", observation=3, roll=20.0, cards={"IS_PSF": True},
                date="2022-10-03T12:00:00", light=0.3 * starlight())  # fmt: skip
        return folder
    # G 7-34 with both rolls, and a roll of HIP 17695 to sort after them.
    for path in sorted(real.glob("*_03106_*calints.fits*")):
        observation = path.name[7:10]
        if observation not in ("003", "005", "006"):
            continue
        with fits.open(path) as hdus:
            hdus[0].header["IS_PSF"] = observation == "003"
            name = path.name.removesuffix(".gz")
            if observation == "003":
                name = f"z{name}"
            hdus.writeto(folder / name, overwrite=True)
    return folder


def _sequence(folder: Path) -> dr.ExposureSequence:
    return dr.ExposureSequence.from_files(folder, filter="F444W")


def run(frames: Path, seeds: Iterable[int], output: Path | None = None) -> list[dict[str, Any]]:
    """Check the folders of several seeds; returns one record for each.

    Parameters
    ----------
    frames : path
        Untouched frames, see `make_frames`.
    seeds : iterable of int
    output : path, optional
        JSON lines; seeds that are there are not repeated.
    """
    twin = {_source(each.name): each for each in _all(_sequence(frames))}
    records: list[dict[str, Any]] = []
    if output is not None and output.exists():
        records = [json.loads(line) for line in output.read_text(encoding="utf-8").splitlines()]
    known = {record["seed"] for record in records}
    for seed in seeds:
        if seed in known:
            continue
        record = check(frames, twin, seed)
        records.append(record)
        if output is not None:
            with output.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(record) + "\n")
    return records


def check(frames: Path, twin: dict[str, Observation], seed: int) -> dict[str, Any]:
    """Make the folder of a seed, admit its files, and compare them with the untouched ones."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as place:
        folder = _mutated(frames, Path(place) / "frames", seed, rng)
        record: dict[str, Any] = {"seed": seed, "mutations": folder.done}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                sequence = _sequence(folder.path)
        except DiffrenderError as error:
            outcome = "wrongly refused" if _is_usable(folder) else "refused"
            return record | {"outcome": outcome, "message": str(error)}
        except Exception as error:
            return record | {"outcome": "crash", "message": repr(error)}
        faults = _faults(sequence, folder, twin)
        if faults:
            return record | {"outcome": "wrong", "message": "; ".join(faults)}
        record["outcome"] = "excluded" if sequence.excluded else "as untouched"
        record["message"] = "; ".join(f"{name}: {reason}" for name, reason in sequence.excluded)
        return record


def _mutated(frames: Path, place: Path, seed: int, rng: np.random.Generator) -> Folder:
    shutil.copytree(frames, place)
    folder = Folder(place, {path.name: path.name for path in sorted(place.glob("*.fits"))})
    names = list(folder.sources)
    rng.shuffle(names)
    kinds = sorted(MUTATIONS)
    # Every kind once before any comes again.
    first = kinds[seed % len(kinds)]
    others = rng.choice(kinds, size=int(rng.integers(0, 3)), replace=False)
    for kind, name in zip([first, *others], names, strict=False):
        if (place / name).exists() and name not in folder.bad | folder.doubtful:
            MUTATIONS[str(kind)](folder, name, rng)
            folder.done.append(str(kind))
    return folder


def _is_usable(folder: Folder) -> bool:
    """Whether some frames of the target are as they were, and no others contradict them."""
    good = set(folder.sources) - folder.bad - folder.doubtful
    with_target = {source for source in folder.sources.values() if source in sorted(
        {*folder.sources.values()}
    )[:2]}  # fmt: skip
    return bool(good & with_target) and not folder.unlike and not folder.doubtful


def _source(name: str) -> str:
    return name.partition(" (pointing")[0].partition(" and ")[0]


def _all(sequence: dr.ExposureSequence) -> list[Observation]:
    return [*sequence.science, *sequence.references]


def _faults(
    sequence: dr.ExposureSequence, folder: Folder, twin: dict[str, Observation]
) -> list[str]:
    """What is wrong with an admitted sequence."""
    faults = []
    used: Counter[str] = Counter()
    for each in _all(sequence):
        name = _source(each.name)
        if name in folder.bad:
            faults.append(f"{name} is used")
            continue
        source = folder.sources[name]
        used[source] += 1
        if name in folder.other:
            # Files that were changed alike may be used together.
            if any(_source(other.name) not in folder.other for other in _all(sequence)):
                faults.append(f"{name} is used beside others")
            continue
        if name in folder.unlike:
            # A factor of two, or a mirror, is seen only beside other frames of the star.
            if sum(other.target == each.target for other in _all(sequence)) > 1:
                faults.append(f"{name} is used")
            continue
        several = len(sequence.science) > 1
        if name in folder.segments and not each.name.endswith(" and 1 more"):
            faults.append(f"{name} is not joined with its second segment")
        lit = name in folder.lit
        if lit and name not in folder.doubtful and each.first_pixel != twin[source].first_pixel:
            faults.append(f"{name}: its place on the detector is not known any more")
        faults += [f"{name}: {f}" for f in _differences(each, twin[source], several, lit=lit)]
    faults += [f"{source} is used {n} times" for source, n in used.items() if n > 1]
    reasons = dict(sequence.excluded)
    # Beside frames that do not state their set-up, others cannot be used.
    lone = any(
        _source(each.name) in folder.other
        or None in Exposure.of(each.header, each.name, each.data.shape).setup
        for each in sequence.science
    )
    for name, source in folder.sources.items():
        untouched = not lone and name not in folder.bad | folder.doubtful
        if untouched and name == source and not used[source]:
            faults.append(f"{name} is not used: {reasons.get(name)}")
        joined = name in folder.segments.values()
        used_names = {_source(e.name) for e in _all(sequence)}
        if name not in reasons and name not in used_names and not joined:
            faults.append(f"{name} is in no list")
    return faults + [f"{name}: no reason" for name, reason in reasons.items() if not reason]


def _differences(
    got: Observation, expected: Observation, several: bool, *, lit: bool = False
) -> list[str]:
    """In what an observation is not that of the untouched file.

    The orientation and the date need not be known of one roll alone. With `lit`, there are other
    sources in the field, and the pixels are not compared.
    """
    faults = []
    if got.reference != expected.reference:
        faults.append(f"used as {'reference' if got.reference else 'target'}")
    for name in ("unit", "filter", "pixelscale", "is_nircam"):
        if getattr(got, name) != getattr(expected, name):
            faults.append(f"{name} is {getattr(got, name)}")
    angles = [each.position_angles for each in (got, expected)]
    if not got.reference:
        if angles[0] is None or angles[1] is None:
            if several:
                faults.append("no position angle")
        elif abs(angles[0][0] - angles[1][0]) > 0.02:
            faults.append(f"position angle {angles[0][0]:.2f}")
    if got.date is None or expected.date is None:
        if several and not got.reference:
            faults.append("no date")
    elif abs(got.date.mjd - expected.date.mjd) > 1:
        faults.append(f"date {got.date}")
    if got.mid_date is not None and got.date is not None and abs(got.mid_date - got.date).jd > 2:
        faults.append(f"middle {got.mid_date}")
    if got.first_pixel not in (None, expected.first_pixel):
        faults.append(f"first pixel {got.first_pixel}, not {expected.first_pixel}")
    mine, other = got.combined(), expected.combined()
    if np.abs(mine.center - other.center).max() > 4.5:
        faults.append(f"star at {mine.center[0]}")
    both = mine.valid & other.valid
    if both.mean() < 0.9 * other.valid.mean():
        faults.append(f"only {both.mean():.0%} of the pixels")
    if not lit and got.first_pixel is not None and got.first_pixel == expected.first_pixel:
        # Frames whose shift is known no longer are resampled otherwise, and compared in brightness.
        away = np.abs(mine.data - other.data)[both] / other.error[both]
        if np.quantile(away, 0.99) > 1.0 or (away > 5).mean() > 1e-3:
            faults.append(f"pixels differ by {np.quantile(away, 0.99):.1f} standard deviations")
    return faults


def _counts(records: list[dict[str, Any]]) -> Table:
    """How often each kind of mutation, alone or with others, came out how."""
    table = Table(names=("mutation", *_OUTCOMES), dtype=("U64", *(int for _ in _OUTCOMES)))
    for kind in sorted(MUTATIONS):
        count = Counter(r["outcome"] for r in records if kind in r["mutations"])
        table.add_row((kind, *(count[each] for each in _OUTCOMES)))
    total = Counter(record["outcome"] for record in records)
    table.add_row((f"all {len(records)} folders", *(total[each] for each in _OUTCOMES)))
    return table


def main() -> None:
    """Run the checks and print how often each kind of mutation came out how."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--frames", type=Path, help="folder of real frames of programme 1184")
    parser.add_argument("--output", type=Path, help="JSON lines, from which a run goes on")
    parser.add_argument("--table", type=Path, help="for the counts by kind, ECSV")
    options = parser.parse_args()
    logging.getLogger("pyklip_diffrender").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as place:
        frames = make_frames(Path(place) / "untouched", options.frames)
        records = run(frames, range(options.count), options.output)
    table = _counts(records)
    table.pprint_all()
    if options.table is not None:
        command = f"benchmarks.fuzz_intake --count {options.count}"
        table.meta = provenance(command + " --frames FRAMES" * (options.frames is not None))
        write_table(table, options.table)
    for record in records:
        if record["outcome"] in ("wrong", "wrongly refused", "crash"):
            print(record)


if __name__ == "__main__":
    main()
