"""pyKLIP's own tests, with this backend registered and without: outcomes and products must agree.

Run from the root of the project, with the source of the installed version of pyKLIP, whose frames
(`tests/data`) are in its repository but not in its package::

    python -m benchmarks.pyklip_suite /path/to/pyklip

The tests run twice, each time on a copy of the source's tests. Tests without their data fail both
times. `--stand-ins` makes frames for those that look for cubes of beta Pic by GPI: they run and
leave products, but fail where they require the planet. Every line is a test with both outcomes; the
end says how many ran, how many passed, and how many FITS products are equal bit by bit. The exit
status is 1 if any outcome or product differs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from astropy.io import fits
from scipy.ndimage import gaussian_filter, zoom

_PLUGIN = """
from pyklip_diffrender.pyklip_backend import is_registered, register
register()
assert is_registered()
"""


def write_stand_ins(folder: Path) -> None:
    """Three cubes with the keywords of GPI: a halo of speckles and four satellite spots."""
    rng = np.random.default_rng(1)
    y, x = np.indices((281, 281)) - 140.0
    speckles = gaussian_filter(rng.normal(size=(281, 281)), 1.5) * np.exp(-np.hypot(x, y) / 40)
    for k, number in enumerate(("092", "099", "111")):
        cube, header = np.empty((37, 281, 281), np.float32), fits.Header()
        for wave in range(37):
            scale = 1 + 0.005 * wave
            spots = 40 * scale * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
            image = 1e4 * zoom(speckles, scale, order=1)
            first = [(side - 281) // 2 for side in image.shape]
            image = image[first[0] : first[0] + 281, first[1] : first[1] + 281]
            for spot, (dx, dy) in enumerate(spots):
                image = image + 300 * np.exp(-((x - dx) ** 2 + (y - dy) ** 2) / 3)
                header[f"SATS{wave}_{spot}"] = f"{dx + 140:.3f} {dy + 140:.3f}"
                header[f"SATF{wave}_{spot}"] = 300.0
            cube[wave] = image + rng.normal(0, 3, image.shape)
        cube[:, np.hypot(x, y) > 135] = np.nan
        header.update(
            {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CTYPE3": "WAVE", "CRVAL1": 86.8,
             "CRVAL2": -51.1, "CRVAL3": 1.12, "CD3_3": 0.0065, "AVPARANG": 10.0 * k, "COADDS0": 1,
             "ITIME0": 6e7, "CD1_1": 4e-6, "CD2_2": 4e-6, "CD1_2": 0.0, "CD2_1": 0.0}
        )  # fmt: skip
        primary = fits.Header(
            {"OBJECT": "stand-in", "IFSFILT": "IFSFILT_J_G1", "OCCULTER": "FPM_J_G1",
             "APODIZER": "APOD_J_G1", "UTSTART": "04:00:00.0", "HA": "+00:10:00.00",
             "TAMBIENT": 10.0, "PRESSUR2": 7.3e4}
        )  # fmt: skip
        fits.HDUList([fits.PrimaryHDU(header=primary), fits.ImageHDU(cube, header)]).writeto(
            folder / f"S20131210S0{number}_spdc_distorcorr.fits"
        )


def run(source: Path, folder: Path, registered: bool, stand_ins: bool) -> dict[str, str]:
    """Outcome of every test, by its name."""
    shutil.copytree(source / "tests", folder / "tests")
    if stand_ins:
        write_stand_ins(folder / "tests" / "data")
    (folder / "registering.py").write_text(_PLUGIN)
    root = Path(__file__).parents[1]
    path = os.pathsep.join([str(folder), str(root), os.environ.get("PYTHONPATH", "")])
    options = (
        "-q --tb=no -p no:cacheprovider --rootdir . --continue-on-collection-errors "
        "--junit-xml=outcomes.xml"
    )
    command = [sys.executable, "-m", "pytest", *options.split(), "tests"]
    if registered:
        command += ["-p", "registering"]
    subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    outcomes = {}
    for case in ElementTree.parse(folder / "outcomes.xml").iter("testcase"):
        problems = [child for child in case if child.tag in ("failure", "error", "skipped")]
        text = f"{problems[0].tag}: {problems[0].get('message', '')}" if problems else "passed"
        name = f"{case.get('classname')}.{case.get('name')}"
        outcomes[name] = text.replace(str(folder), "").splitlines()[0][:100]
    return outcomes


def differences(one: Path, two: Path, source: Path) -> tuple[list[str], int]:
    """FITS products that differ, and the number of those that both folders have."""
    sides = [{path.relative_to(folder) for path in folder.rglob("*.fits")} for folder in (one, two)]
    products = {name for name in sides[0] & sides[1] if not (source / name).exists()}
    differing = [f"only in one folder: {name}" for name in sorted(sides[0] ^ sides[1])]
    for name in sorted(products):
        with fits.open(one / name) as first, fits.open(two / name) as second:
            same = len(first) == len(second) and all(
                np.array_equal(a.data, b.data, equal_nan=True)
                if a.data is not None and a.is_image and b.is_image
                else type(a) is type(b)
                for a, b in zip(first, second, strict=False)
            )
        if not same:
            differing.append(f"differs: {name}")
    return differing, len(products)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, help="folder of pyKLIP's source, with tests/")
    parser.add_argument("--stand-ins", action="store_true", help="make frames by GPI")
    options = parser.parse_args()
    source = options.source.resolve()
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch) / name for name in ("without", "registered")]
        for folder in folders:
            folder.mkdir()
        outcomes = [run(source, folders[k], bool(k), options.stand_ins) for k in range(2)]
        names = sorted({*outcomes[0], *outcomes[1]})
        changed = 0
        for name in names:
            without, registered = (each.get(name, "not run") for each in outcomes)
            changed += without != registered
            print(f"{name}\n    {without}" + (f"\n    {registered}" * (without != registered)))
        differing, count = differences(*folders, source)
    for line in differing:
        print(line)
    passed = sum(outcome == "passed" for outcome in outcomes[1].values())
    print(f"{len(names)} tests, {passed} passed, {changed} outcomes differ; "
          f"{count} products, {len(differing)} differ")  # fmt: skip
    return int(changed > 0 or bool(differing))


if __name__ == "__main__":
    sys.exit(main())
