"""What happens to files in real folders, and what must become of them.

Every mutation changes a folder of frames, and says which files may no longer be used (`bad`),
which must be used as before unless a reason is given (`doubtful`), and which are copies.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from scipy.ndimage import shift

import pyklip_diffrender as dr

Change = Callable[[fits.HDUList, np.random.Generator], None]


@dataclass
class Folder:
    """A folder with frames whose right treatment is known.

    Attributes
    ----------
    path : Path
    sources : dict of str to str
        Which of the unmutated files every file is made from, by name.
    bad : set of str
        Files that must not be used.
    doubtful : set of str
        Files that may be used if the result is that of the unmutated file, or excluded.
    unlike : set of str
        Files that are wrong in a way which only other frames of the star show.
    other : set of str
        Files that belong to another set-up or epoch: wrong beside others, right alone.
    lit : set of str
        Files with other sources, which must be used on the same pixels of the detector.
    segments : dict of str to str
        Files that are the first part of an exposure, and those with the second.
    done : list of str
        What was done.
    """

    path: Path
    sources: dict[str, str]
    bad: set[str] = field(default_factory=set)
    doubtful: set[str] = field(default_factory=set)
    unlike: set[str] = field(default_factory=set)
    other: set[str] = field(default_factory=set)
    lit: set[str] = field(default_factory=set)
    segments: dict[str, str] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)

    def change(self, name: str, change: Change, rng: np.random.Generator) -> None:
        """Edit a file in place."""
        with fits.open(self.path / name) as hdus:
            copy = fits.HDUList([hdu.copy() for hdu in hdus])
        change(copy, rng)
        copy.writeto(self.path / name, overwrite=True)

    def add(self, name: str, source: str, change: Change, rng: np.random.Generator) -> None:
        """Add a file that is made from another one."""
        with fits.open(self.path / source) as hdus:
            copy = fits.HDUList([hdu.copy() for hdu in hdus])
        change(copy, rng)
        copy.writeto(self.path / name, overwrite=True)
        self.sources[name] = self.sources[source]


Mutation = Callable[[Folder, str, np.random.Generator], None]
MUTATIONS: dict[str, Mutation] = {}


def _mutation(name: str) -> Callable[[Mutation], Mutation]:
    def register(function: Mutation) -> Mutation:
        MUTATIONS[name] = function
        return function

    return register


def _card(hdus: fits.HDUList, key: str) -> fits.Header:
    return next((h.header for h in hdus if key in h.header), hdus[0].header)


def _set(hdus: fits.HDUList, **cards: Any) -> None:
    for key, value in cards.items():
        key = key.replace("_", "-") if key in ("DATE_BEG", "DATE_OBS", "TIME_OBS") else key
        header = _card(hdus, key)
        if value is None:
            if key in header:
                del header[key]
        else:
            header[key] = (value, "")  # A comment may not fit beside a long name.


def _nothing(_hdus: fits.HDUList, _rng: np.random.Generator) -> None:
    """Leave a file as it is."""


# -- copies and other products ---------------------------------------------------------------------


def _product(level: str, change: Change) -> Mutation:
    def mutate(folder: Folder, name: str, rng: np.random.Generator) -> None:
        new = name.replace("calints", level)
        folder.add(new, name, change, rng)
        # One of the two is used.
        folder.doubtful |= {new, name}

    return mutate


def _to_rate(hdus: fits.HDUList, _: np.random.Generator) -> None:
    factor = float(_card(hdus, "PHOTMJSR").get("PHOTMJSR", 2.5))
    for key in ("SCI", "ERR"):
        hdus[key].data = hdus[key].data / factor
    _set(hdus, BUNIT="DN/s")


def _to_cal(hdus: fits.HDUList, _: np.random.Generator) -> None:
    for key in ("SCI", "ERR", "DQ"):
        hdus[key].data = hdus[key].data[0]


MUTATIONS["crfints"] = _product("a3001_crfints", _nothing)
MUTATIONS["rateints"] = _product("rateints", _to_rate)
MUTATIONS["cal"] = _product("cal", _to_cal)


def _other_product(level: str) -> Mutation:
    def mutate(folder: Folder, name: str, rng: np.random.Generator) -> None:
        new = f"jw01184-c1001_t00{rng.integers(9)}_nircam_f444w-maskrnd_{level}.fits"
        folder.add(new, name, lambda hdus, _: _set(hdus, OBSERVTN="050", FILENAME=new), rng)
        folder.bad.add(new)

    return mutate


for _level in ("i2d", "psfsub", "psfalign", "psfstack"):
    MUTATIONS[_level] = _other_product(_level)


@_mutation("gzip beside fits")
def _packed(folder: Folder, name: str, _: np.random.Generator) -> None:
    path = folder.path / name
    (folder.path / f"{name}.gz").write_bytes(gzip.compress(path.read_bytes(), 1))
    folder.sources[f"{name}.gz"] = folder.sources[name]
    folder.doubtful |= {name, f"{name}.gz"}


@_mutation("symlink")
def _link(folder: Folder, name: str, _: np.random.Generator) -> None:
    (folder.path / f"a_{name}").symlink_to(folder.path / name)
    folder.sources[f"a_{name}"] = folder.sources[name]
    folder.doubtful |= {name, f"a_{name}"}


# -- other sources in the field, products, segments ------------------------------------------------

_TRANSMISSION = ((0.0, 0.3, 0.5, 0.8, 1.2, 9.0), (0.01, 0.055, 0.26, 0.71, 0.95, 1.0))
"""Transmission of a source behind MASK335R at distances in arcsec, by the model."""

_BRIGHTEST = 900.0
"""Peaks of a source and of the star behind the mask, for sources as bright as the star."""


@cache
def _point_source() -> np.ndarray:
    """Image of a source outside the mask, with its peak of 1 in the middle, (201, 201)."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=512, fov_pixels=281)
    image = model(dr.wavefront.random_opd(1, npix=512), (0.0, 2.5)).double().detach().numpy()
    row, column = np.unravel_index(int(image.argmax()), image.shape)
    return np.asarray(image[row - 100 : row + 101, column - 100 : column + 101] / image.max())


def _with_source(contrast: float, separation: float, angle: float) -> Change:
    """Add a source at a position angle from north, degrees, to every integration."""

    def change(hdus: fits.HDUList, _: np.random.Generator) -> None:
        data, header = hdus["SCI"].data, hdus["SCI"].header
        x, y = (float(_card(hdus, key)[key]) - 1 for key in ("CRPIX1", "CRPIX2"))
        roll = float(header["ROLL_REF"]) + float(header.get("V3I_YANG", 0.0))
        turned = np.deg2rad(angle - roll)
        away = np.array([np.cos(turned), -np.sin(turned)]) * separation / 0.0628
        rows, columns = np.indices(data.shape[1:])
        near = np.hypot(columns - x, rows - y) < 9
        peak = float(np.nanmax(data[0][near]))
        place = np.array([y, x]) + away
        whole = np.round(place).astype(int)
        source = shift(_point_source(), place - whole, order=3)
        light = np.pad(np.zeros(data.shape[1:]), 400)
        row, column = whole + 400
        light[row - 100 : row + 101, column - 100 : column + 101] = source
        scale = contrast * _BRIGHTEST * peak * np.interp(separation, *_TRANSMISSION)
        data += (scale * light[400:-400, 400:-400]).astype(data.dtype)

    return change


def _in_all(change: Change) -> Mutation:
    """Change all frames of the target, which must then be used as before."""

    def mutate(folder: Folder, _: str, rng: np.random.Generator) -> None:
        names = sorted(folder.sources)
        with fits.open(folder.path / names[0]) as hdus:
            target = hdus[0].header["TARGPROP"]
        for name in names:
            if name in folder.bad | folder.doubtful or not (folder.path / name).exists():
                continue
            with fits.open(folder.path / name) as hdus:
                own = hdus[0].header.get("TARGPROP") == target
            if own:
                folder.change(name, change, rng)
                folder.lit.add(name)

    return mutate


def _neighbours(count: int, contrasts: tuple[float, float], least: float, most: float) -> Mutation:
    def mutate(folder: Folder, name: str, rng: np.random.Generator) -> None:
        for _ in range(count):
            contrast = float(np.exp(rng.uniform(*np.log(contrasts))))
            place = rng.uniform(least, most), rng.uniform(0.0, 360.0)
            _in_all(_with_source(contrast, *place))(folder, name, rng)

    return mutate


MUTATIONS["a neighbour"] = _neighbours(1, (1e-4, 0.03), 0.3, 6.0)
MUTATIONS["a binary"] = _neighbours(1, (0.03, 0.1), 0.3, 6.0)
MUTATIONS["two neighbours"] = _neighbours(2, (1e-4, 0.01), 0.5, 5.0)


def _crowd(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    data = hdus["SCI"].data
    rows, columns = np.indices(data.shape[1:])
    x, y = (float(_card(hdus, key)[key]) - 1 for key in ("CRPIX1", "CRPIX2"))
    peak = float(np.nanmax(data[0][np.hypot(columns - x, rows - y) < 9]))
    light = np.zeros(data.shape[1:])
    for a, b in rng.uniform(0, 1, (300, 2)) * data.shape[:0:-1]:
        light += 10 ** rng.uniform(-3, 0) * np.exp(
            -((columns - a) ** 2 + (rows - b) ** 2) / (2 * 1.1**2)
        )
    data += (peak * light).astype(data.dtype)


def _nebula(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    data, error = hdus["SCI"].data, float(np.nanmedian(hdus["ERR"].data))
    rows, columns = np.indices(data.shape[1:])
    a, b = rng.uniform(0, 1, 2) * data.shape[:0:-1]
    width = rng.uniform(15, 60)
    light = np.exp(-((columns - a) ** 2 + (rows - b) ** 2) / (2 * width**2))
    data += (error * rng.uniform(3, 30) * light).astype(data.dtype)


MUTATIONS["300 field stars"] = _in_all(_crowd)
MUTATIONS["a nebula"] = _in_all(_nebula)


@_mutation("products of the package, several")
def _products(folder: Folder, name: str, rng: np.random.Generator) -> None:
    for k in range(int(rng.integers(1, 6))):
        keep = ("detection", "images", "fit")[k % 3]

        def change(hdus: fits.HDUList, _: np.random.Generator, keep: str = keep) -> None:
            hdus[0].header["DRVERS"] = "1.0"
            if keep != "images":
                del hdus["SCI"]
            hdus[-1].header["EXTNAME"] = keep.upper()

        folder.add(f"{keep}{k}.fits", name, change, rng)
        folder.bad.add(f"{keep}{k}.fits")


@_mutation("products of pyKLIP, several")
def _klip_products(folder: Folder, name: str, rng: np.random.Generator) -> None:
    def change(hdus: fits.HDUList, _: np.random.Generator) -> None:
        hdus[0].header["PSFSUB"], hdus[0].header["PYKLIPV"] = "pyKLIP", "2.8"

    for k in range(int(rng.integers(1, 6))):
        folder.add(f"klip{k}-KLmodes-all.fits", name, change, rng)
        folder.bad.add(f"klip{k}-KLmodes-all.fits")


@_mutation("unusable files of another set-up, several")
def _unusable_others(folder: Folder, name: str, rng: np.random.Generator) -> None:
    cards: dict[str, Any] = [
        {"CORONMSK": "MASKA430R", "SUBARRAY": "SUB320A430R", "APERNAME": "NRCA5_MASK430R"},
        {"FILTER": "F356W"}, {"BUNIT": "Jy"}, {"PUPIL": "MASKBAR"},
    ][rng.integers(4)]  # fmt: skip

    def change(hdus: fits.HDUList, _: np.random.Generator) -> None:
        _set(hdus, **cards, OBSERVTN=f"{rng.integers(20, 90):03d}", FILENAME="other.fits")
        if rng.random() < 0.5:
            del hdus["ERR"]
        else:
            hdus["SCI"].data = np.zeros_like(hdus["SCI"].data)

    for k in range(int(rng.integers(1, 6))):
        folder.add(f"other{k}.fits", name, change, rng)
        folder.bad.add(f"other{k}.fits")


@_mutation("segments of an exposure")
def _segments(folder: Folder, name: str, rng: np.random.Generator) -> None:
    # Two independent halves with the noise of a longer exposure each.
    with fits.open(folder.path / name) as hdus:
        error = np.nan_to_num(hdus["ERR"].data)
        noise = (rng.normal(size=error.shape) * np.abs(error)).astype(np.float32)

    def changed(sign: float, segment: int) -> Change:
        def change(hdus: fits.HDUList, _: np.random.Generator) -> None:
            hdus["SCI"].data = (hdus["SCI"].data + sign * noise).astype(np.float32)
            hdus["ERR"].data = (hdus["ERR"].data * np.sqrt(2)).astype(np.float32)
            _set(hdus, EXSEGNUM=segment, EXSEGTOT=2)

        return change

    folder.add(f"z-seg002_{name}", name, changed(-1.0, 2), rng)
    folder.change(name, changed(1.0, 1), rng)
    folder.segments[name] = f"z-seg002_{name}"


# -- cards -----------------------------------------------------------------------------------------


def _changed(change: Change, *marks: str) -> Mutation:
    """Change a file, which then belongs to these sets of the folder."""

    def mutate(folder: Folder, name: str, rng: np.random.Generator) -> None:
        folder.change(name, change, rng)
        for mark in marks:
            getattr(folder, mark).add(name)

    return mutate


def _cards(*marks: str, **cards: Any) -> Mutation:
    """Set cards; without marks, these make the file unusable."""
    return _changed(lambda hdus, _: _set(hdus, **cards), *(marks or ("bad",)))


MUTATIONS["target acquisition"] = _cards(EXP_TYPE="NRC_TACQ")
MUTATIONS["confirmation image"] = _cards(EXP_TYPE="NRC_TACONFIRM")
MUTATIONS["background"] = _cards(BKGDTARG=True)


OTHER = ("doubtful", "other")
"""Marks of files of another set-up or epoch."""

MUTATIONS["another mask"] = _cards(
    *OTHER, CORONMSK="MASKA430R", SUBARRAY="SUB320A430R", APERNAME="NRCA5_MASK430R"
)
MUTATIONS["another detector"] = _cards(*OTHER, DETECTOR="NRCBLONG", MODULE="B")
MUTATIONS["another stop"] = _cards(*OTHER, PUPIL="MASKBAR")
MUTATIONS["another filter"] = _cards(FILTER="F356W")
MUTATIONS["another unit"] = _cards(*OTHER, BUNIT="DN/s")
MUTATIONS["no unit"] = _cards(BUNIT=None)
MUTATIONS["an unknown unit"] = _cards(BUNIT="parsnips")
MUTATIONS["no pixel area"] = _cards(PIXAR_A2=None)
MUTATIONS["a negative pixel area"] = _cards(PIXAR_A2=-0.0039)
MUTATIONS["the pixel area of another detector"] = _cards(PIXAR_A2=0.00096)
MUTATIONS["a date before the launch"] = _cards(DATE_BEG="0001-01-01T00:00:00")
MUTATIONS["a middle of another year"] = _cards(EXPMID=59000.5)
MUTATIONS["angles that do not add up"] = _cards(PA_APER=12.0)
MUTATIONS["XOFFSET in mas"] = _cards(XOFFSET=20.0, YOFFSET=-10.0)
MUTATIONS["contradicting masks"] = _cards(CORONMSK="MASKA430R")
MUTATIONS["text for a number"] = _cards(ROLL_REF="seventy")
MUTATIONS["another epoch"] = _cards(
    *OTHER, DATE_BEG="2023-12-01T06:00:00", DATE_OBS="2023-12-01", EXPMID=60279.3, EXPSTART=60279.25
)


def _missing(*keys: str) -> Mutation:
    """Cards that are missing, empty or unknown: used if others say the same, else excluded."""

    def mutate(folder: Folder, name: str, rng: np.random.Generator) -> None:
        value = rng.choice(np.array([None, "", "UNKNOWN"], dtype=object))
        folder.change(name, lambda hdus, _: _set(hdus, **dict.fromkeys(keys, value)), rng)
        folder.doubtful.add(name)

    return mutate


for _keys in (
    ("INSTRUME",), ("EXPMID",), ("ROLL_REF",), ("V3I_YANG",),
    ("ROLL_REF", "V3I_YANG", "PA_APER"), ("TARGPROP",),
    ("TARGPROP", "TARGNAME"), ("TARG_RA", "TARG_DEC"), ("CORONMSK",), ("CORONMSK", "APERNAME"),
    ("CORONMSK", "APERNAME", "SUBARRAY"), ("DETECTOR",), ("DETECTOR", "APERNAME", "FILENAME"),
    ("DATE_BEG",), ("DATE_BEG", "TIME_OBS"), ("DATE_BEG", "DATE_OBS", "EXPSTART"), ("IS_PSF",),
    ("EXP_TYPE",), ("PUPIL",), ("FILTER",), ("SUBARRAY",), ("APERNAME",), ("OBSERVTN",),
    ("SUBSTRT1", "SUBSTRT2"),
    ("TARGPROP", "TARGNAME", "TARG_RA", "TARG_DEC", "RA_REF", "DEC_REF", "IS_PSF"),
):  # fmt: skip
    MUTATIONS[f"without {', '.join(_keys)}"] = _missing(*_keys)


MUTATIONS["another spelling of the unit"] = _cards("doubtful", BUNIT="MJy sr-1")
MUTATIONS["a middle of zero"] = _cards("doubtful", EXPMID=0.0)
MUTATIONS["SUBSTRT of the full frame"] = _cards("doubtful", SUBSTRT1=1, SUBSTRT2=1)


MUTATIONS["APERNAME of the full frame"] = _cards("doubtful", APERNAME="NRCA5_FULL_MASK335R")


@_mutation("a reference with the target's name")
def _namesake(folder: Folder, name: str, rng: np.random.Generator) -> None:
    names = sorted(folder.sources)
    if not folder.bad.isdisjoint((names[0], names[-1])):
        return  # They may be incomplete.
    with fits.open(folder.path / names[0]) as hdus:
        target = hdus[0].header["TARGPROP"]
    folder.change(names[-1], lambda hdus, _: _set(hdus, TARGPROP=target, TARGNAME=target), rng)
    folder.doubtful.add(names[-1])


def _crpix(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    for key in ("CRPIX1", "CRPIX2"):
        _set(hdus, **{key: round(float(_card(hdus, key)[key]) + rng.uniform(-3, 3), 4)})


MUTATIONS["CRPIX off by three pixels"] = _changed(_crpix, "doubtful")


# -- pixels ----------------------------------------------------------------------------------------


def _peak(hdus: fits.HDUList) -> tuple[int, int]:
    frame = np.nan_to_num(np.atleast_3d(hdus["SCI"].data)[0])
    row, column = np.unravel_index(int(frame.argmax()), frame.shape)
    return int(row), int(column)


def _hole(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    row, column = _peak(hdus)
    hdus[rng.choice(["SCI", "ERR"])].data[0, row, column] = np.nan


def _holes(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    data = hdus[rng.choice(["SCI", "ERR"])].data
    for _ in range(200):
        data[0, rng.integers(data.shape[1]), rng.integers(data.shape[2])] = rng.choice(
            [np.nan, np.inf]
        )


def _cosmic_ray(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    row, column = rng.integers(60, 250, 2) % hdus["SCI"].data.shape[1]
    hdus["SCI"].data[0, row, column] += 50 * hdus["ERR"].data[0, row, column]


def _flags(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    data = hdus["DQ"].data
    for _ in range(100):
        data[0, rng.integers(data.shape[1]), rng.integers(data.shape[2])] = 1


def _scaled(factor: float) -> Change:
    def change(hdus: fits.HDUList, _: np.random.Generator) -> None:
        for key in ("SCI", "ERR"):
            hdus[key].data = hdus[key].data * np.float32(factor)

    return change


def _moved(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    angle = rng.uniform(0, 2 * np.pi)
    by = np.round(24 * np.array([np.sin(angle), np.cos(angle)])).astype(int)
    for key in ("SCI", "ERR"):
        hdus[key].data = np.roll(hdus[key].data, tuple(by), axis=(1, 2))


def _mirrored(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    axes = ((1,), (2,), (1, 2))[rng.integers(3)]
    for key in ("SCI", "ERR", "DQ"):
        hdus[key].data = np.flip(hdus[key].data, axes).copy()
    ny, nx = hdus["SCI"].data.shape[1:]
    header = hdus["SCI"].header
    for axis, size, key in ((1, ny, "CRPIX2"), (2, nx, "CRPIX1")):
        if axis in axes and key in header:
            header[key] = size + 1 - header[key]


def _errors(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    hdus["ERR"].data = hdus["ERR"].data * np.float32(rng.choice([0.03, 30.0]))


def _blank(hdus: fits.HDUList, rng: np.random.Generator) -> None:
    hdus["SCI"].data = rng.normal(0, 1, hdus["SCI"].data.shape).astype(np.float32) * np.nanmedian(
        hdus["ERR"].data
    )


def _negative(hdus: fits.HDUList, _: np.random.Generator) -> None:
    hdus["SCI"].data = -hdus["SCI"].data


def _four(hdus: fits.HDUList, _: np.random.Generator) -> None:
    for key in ("SCI", "ERR", "DQ"):
        hdus[key].data = hdus[key].data[None]


def _big_endian(hdus: fits.HDUList, _: np.random.Generator) -> None:
    hdus["SCI"].data = hdus["SCI"].data.astype(">f8")


def _zero(hdus: fits.HDUList, _: np.random.Generator) -> None:
    hdus["SCI"].data = np.zeros_like(hdus["SCI"].data)


def _masked(hdus: fits.HDUList, _: np.random.Generator) -> None:
    hdus["DQ"].data = np.ones_like(hdus["DQ"].data)


MUTATIONS["a hole at the peak"] = _changed(_hole, "doubtful")
MUTATIONS["holes"] = _changed(_holes, "doubtful")
MUTATIONS["a missed cosmic ray"] = _changed(_cosmic_ray, "doubtful")
MUTATIONS["flagged pixels"] = _changed(_flags, "doubtful")
for _factor in (1e-3, 1e3):
    MUTATIONS[f"pixels times {_factor:g}"] = _changed(_scaled(_factor), "bad")


MUTATIONS["pixels times 0.4"] = _changed(_scaled(0.4), "doubtful", "unlike")
MUTATIONS["pixels times 2.5"] = _changed(_scaled(2.5), "doubtful", "unlike")
MUTATIONS["mirrored or turned"] = _changed(_mirrored, "doubtful", "unlike")
MUTATIONS["star off the mask"] = _changed(_moved, "bad")
MUTATIONS["errors of another unit"] = _changed(_errors, "bad")
MUTATIONS["negative pixels"] = _changed(_negative, "bad")
MUTATIONS["four dimensions"] = _changed(_four, "bad")
MUTATIONS["double precision"] = _changed(_big_endian, "doubtful")
MUTATIONS["no star"] = _changed(_blank, "bad")
MUTATIONS["zeros"] = _changed(_zero, "bad")
MUTATIONS["all flagged"] = _changed(_masked, "bad")


def _lost(key: str) -> Mutation:
    def remove(hdus: fits.HDUList, _: np.random.Generator) -> None:
        del hdus[key]

    return _changed(remove, "bad")


MUTATIONS["no SCI"], MUTATIONS["no ERR"] = _lost("SCI"), _lost("ERR")


@_mutation("truncated")
def _truncated(folder: Folder, name: str, rng: np.random.Generator) -> None:
    path = folder.path / name
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * rng.uniform(0.1, 0.95))])
    folder.bad.add(name)


@_mutation("files that are no frames")
def _junk(folder: Folder, _: str, rng: np.random.Generator) -> None:
    for k, content in enumerate((b"", b"not FITS", rng.bytes(5000))):
        (folder.path / f"junk{k}.fits").write_bytes(content)
        folder.bad.add(f"junk{k}.fits")
    (folder.path / "notes.txt").write_text("notes", encoding="utf-8")


@_mutation("one bad integration of several")
def _cube(folder: Folder, name: str, rng: np.random.Generator) -> None:
    def change(hdus: fits.HDUList, rng: np.random.Generator) -> None:
        count, bad = 6, int(rng.integers(6))
        error = np.nan_to_num(hdus["ERR"].data, nan=1.0) * 0.5
        noise = rng.normal(size=(count, *error.shape[1:])) * np.abs(error)
        # The mean of the good ones is the frame itself.
        good = np.arange(count) != bad
        noise[good] -= noise[good].mean(axis=0)
        frames = (hdus["SCI"].data + noise).astype(np.float32)
        flags = np.repeat(hdus["DQ"].data, count, axis=0)
        kind = rng.choice(["zero", "flagged", "afterglow", "dim"])
        if kind == "zero":
            frames[bad] = 0
        elif kind == "flagged":
            flags[bad] = 1
        elif kind == "dim":
            frames[bad] *= 0.5
        else:
            row, column = _peak(hdus)
            y, x = np.indices(frames.shape[1:])
            near = np.exp(-((x - column - 12) ** 2 + (y - row + 9) ** 2) / 60)
            frames[bad] += 0.3 * np.nanmax(hdus["SCI"].data) * near
        hdus["SCI"].data, hdus["DQ"].data = frames, flags
        hdus["ERR"].data = np.repeat(hdus["ERR"].data, count, axis=0)
        for key in ("IMSHIFTS", "MASKOFFS"):
            if key in hdus:
                hdus[key].data = np.repeat(hdus[key].data, count, axis=0)

    folder.change(name, change, rng)
    folder.doubtful.add(name)
