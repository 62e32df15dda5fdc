"""Damaged inputs: reading either works or raises a DiffrenderError, never anything else."""

from __future__ import annotations

import gzip
import json
import random
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.surveys import jobs
from pyklip_diffrender.surveys.config import read_config
from pyklip_diffrender.surveys.jobs import jobs_of

_HEADER = b"0123456789'=-./ ATFENZe\"{}[],:"
"""What headers, JSON and TOML are made of."""


def run(folder: Path, count: int) -> str:
    """Read `count` damaged files of each kind in turn; returns what became of them."""
    folder.mkdir(parents=True, exist_ok=True)
    kinds = _kinds(folder)
    outcomes: Counter[str] = Counter()
    for seed in range(count):
        rng = random.Random(seed)
        name, (content, read) = list(kinds.items())[seed % len(kinds)]
        packed = name.endswith(".fits") and rng.random() < 0.2
        damaged = mutated(gzip.compress(content, mtime=0) if packed else content, rng)
        path = folder / name
        path.write_bytes(damaged)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                read(path)
                outcomes["read"] += 1
            except DiffrenderError as error:
                if not str(error).strip():
                    raise AssertionError(f"mutation {seed} of {name}: no message") from error
                outcomes["refused"] += 1
            except BaseException as error:
                raise AssertionError(f"mutation {seed} of {name}: {error!r}") from error
    return (
        f"{count} mutations of {', '.join(kinds)}: {outcomes['refused']} refused with a "
        f"DiffrenderError, {outcomes['read']} read, nothing else"
    )


def mutated(content: bytes, rng: random.Random) -> bytes:
    """Cut short, or with bits flipped, bytes changed, blocks lost, zeroed or repeated."""
    data = bytearray(content)
    used = [k for k, byte in enumerate(content) if byte not in b" \0"] or [0]
    kind = rng.choice(["cut", "flip", "change", "change", "lose", "zero", "repeat", "insert"])
    start = rng.randrange(len(data))
    length = rng.choice([1, 8, 80, 2880])
    if kind == "cut":
        return bytes(data[:start])
    if kind in ("flip", "change"):
        for _ in range(rng.randint(1, 6)):
            k = rng.choice(used)
            data[k] = data[k] ^ (1 << rng.randrange(8)) if kind == "flip" else rng.choice(_HEADER)
    elif kind == "lose":
        del data[start : start + length]
    elif kind == "zero":
        data[start : start + length] = bytes(len(data[start : start + length]))
    elif kind == "repeat":
        data[start:start] = data[start : start + length]
    else:
        data[start:start] = rng.randbytes(rng.randint(1, 4))
    return bytes(data)


def _kinds(folder: Path) -> dict[str, tuple[bytes, Callable[[Path], Any]]]:
    """A small whole file of every kind, and what reads it."""
    from pyklip_diffrender.refinement import Refinement
    from pyklip_diffrender.scene.observation import Observation
    from pyklip_diffrender.wavefront.opd import random_opd, read_opd

    opd = fits.PrimaryHDU(random_opd(5, npix=16).data)
    opd.header["BUNIT"], opd.header["DATE-OBS"] = "m", "2022-08-11T01:02:03"
    opd.writeto(folder / "opd.fits")
    _frames(folder / "calints.fits")
    _fit(folder / "fit.fits")
    config = folder / "survey.toml"
    config.write_text(
        'workers = 2\nmemory_limit = "4 GB"\n\n[options]\nsize = 80\nthreshold = 5.0\n'
        'pattern = "auto"\nsettings = { cycles = [12.0, 18.0], robust = 3.0 }'
        '\n\n[injections]\ncontrasts = [1e-5, 3e-6]\nseparations = [0.5]\nangles = [0, 90.0]\n\n'
        '[[sequence]]\nname = "HIP 1"\nfiles = ["frames/a.fits"]\ntarget = "HIP 1"\n'
        'filter = "F444W"\nopd = "frames/map.fits"\n',
        encoding="utf-8",
    )  # fmt: skip
    frames = folder / "frames"
    frames.mkdir()
    for name in ("a.fits", "map.fits"):
        (frames / name).write_bytes(name.encode())
    record = folder / jobs.RECORD
    known = {"status": "finished", "products": {}, "job": {"key": folder.name}, "result": {}}
    record.write_text(json.dumps(known), encoding="utf-8")
    readers: dict[str, Callable[[Path], Any]] = {
        "calints.fits": Observation.from_fits,
        "opd.fits": read_opd,
        "fit.fits": Refinement.read,
        "survey.toml": lambda path: jobs_of(read_config(path)),
        # A damaged record is a job that is missing.
        jobs.RECORD: lambda path: jobs.read_record(path.parent),
    }
    return {name: ((folder / name).read_bytes(), read) for name, read in readers.items()}


def _frames(path: Path) -> None:
    rng = np.random.default_rng(1)
    data = rng.normal(10, 2, (2, 8, 10)).astype(np.float32)
    hdus = fits.HDUList([fits.PrimaryHDU()])
    hdus[0].header.update({"FILTER": "F444W", "DATE-BEG": "2022-07-30T02:03:04.5"})
    quality = np.zeros(data.shape, dtype=np.uint32)
    for name, array in (("SCI", data), ("ERR", np.ones_like(data)), ("DQ", quality)):
        hdus.append(fits.ImageHDU(array, name=name))
    hdus["SCI"].header.update(
        {
            "BUNIT": "MJy/sr", "PIXAR_A2": 0.00396, "CRPIX1": 6.0, "CRPIX2": 5.0,
            "ROLL_REF": 100.0, "V3I_YANG": -0.5, "VPARITY": -1,
        }
    )  # fmt: skip
    hdus.writeto(path)


def _fit(path: Path) -> None:
    import pyklip_diffrender as dr

    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    opd = dr.wavefront.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(dr.Star(exposure=20.0)), opd, seed=3)
    settings = dr.FitSettings(cycles=3, max_iterations=3)
    dr.refine(model, frame, opd, settings=settings).write(path)
