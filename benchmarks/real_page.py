"""All measurements of docs/validation/real_frames.md, in one run.

Run from the root of the project, with the frames of programmes 1184 and 1386 in ../shared/data::

    python -m benchmarks.real_page --output results --processes 2

Every measurement is a command of its own; what it prints is kept under its name with the commit and
the date, so that a run that was stopped goes on. Times are of a busy machine if there are several
processes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from benchmarks.provenance import provenance
from benchmarks.real_cases import FILTERS, STARS, cases
from benchmarks.real_frames import DATA, opd_of
from pyklip_diffrender.io.files import replacing

AXIS = "128.5"
"""Position angle of AU Mic's disk, degrees (MacGregor et al. 2013, ApJL 762, L21: 128.4 +- 0.1)."""


def measurements(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Name and command of each measurement, except for the tables of all cases."""
    for case in cases():
        options = ["--output", str(folder / "cases"), "--case", *case]
        yield "_".join(case).replace(" ", ""), ["benchmarks.real_cases", *options]
    options = ["--output", str(folder / "flat"), "--planets", "0", "--opd", "flat"]
    flat = ["G-7-34", "F444W", "pair", "library", "no references"]
    yield "flat", ["benchmarks.real_cases", *options, "--case", *flat]
    for star in (each for each, kind in STARS.items() if kind == "star"):
        for band in FILTERS:
            which = ["--target", star, "--filter", band]
            yield f"images_{star}_{band}", ["benchmarks.images", *which]
            yield f"images_{star}_{band}_gaussian", ["benchmarks.images", *which, "--gaussian"]
    for band in FILTERS:
        yield f"disks_{band}", ["benchmarks.disks", "--filter", band]
        which = ["--target", "V-AU-MIC", "--filter", band, "--disk", AXIS]
        yield f"images_V-AU-MIC_{band}", ["benchmarks.images", *which]
    frames = str(DATA / "hip65426_f444w_calints.fits.gz")
    opd = str(opd_of(DATA, "HIP-65426"))
    yield "star_flux", ["benchmarks.star_flux", "--frames", frames, "--opd", opd]
    products = str(folder / "hip65426")
    wide = ["reduce", frames, "--opd", opd, "-o", products, "--wide", "--overwrite"]
    yield "wide", ["pyklip_diffrender", *wide]


def measure(folder: Path, about: str, task: tuple[str, list[str]]) -> bool:
    """Run one command and keep what it prints, unless that is there already; False if it fails."""
    name, command = task
    path = folder / f"{name}.txt"
    if path.exists():
        return True
    done = subprocess.run(
        [sys.executable, "-m", *command],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
    )  # fmt: skip
    text = f"{about}\n{' '.join(command)}\n\n{done.stdout}"
    if done.returncode:
        print(f"{name} failed: {done.stdout[-2000:]}", file=sys.stderr)
        return False
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    print(name, flush=True)
    return True


def main() -> None:
    """Run all measurements that are missing, and print the tables of all cases."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    about = "\n".join(provenance("benchmarks.real_page --output results").values())
    with ThreadPoolExecutor(options.processes) as pool:
        tasks = partial(measure, options.output, about)
        complete = all(list(pool.map(tasks, measurements(options.output))))
    tables = ["benchmarks.real_cases", "--output", str(options.output / "cases"), "--tables"]
    if not (complete and measure(options.output, about, ("tables", tables))):
        sys.exit("some measurements failed; run the command again to go on with them")


if __name__ == "__main__":
    main()
