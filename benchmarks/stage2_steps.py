"""Steps that other pipelines apply to calibrated frames: which may stand before `reduce`?

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.stage2_steps --output docs/results/stage2_steps.ecsv

A source of 1e-4 at 0.8 arcsec is added to both rolls of G 7-34 in F444W, see
`benchmarks.neighbours`. The files are then changed as spaceKLIP's `ImageTools` change them, one
step at a time, with the arithmetic of spaceKLIP at commit 07eaf7d (it is not imported), and reduced
with ``accuracy="quick"`` and 40 pixels a side. A row says what became of the source and of the
limits, relative to the files without the step, or why the files were refused. spaceKLIP had aligned
the frames before.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.table import Table
from scipy.ndimage import fourier_shift, gaussian_filter, median_filter

import pyklip_diffrender as dr
from benchmarks.neighbours import NAMES, SIDE, light_of, sources_of, with_source
from benchmarks.provenance import provenance
from benchmarks.real_frames import DATA, opd_of
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.io.files import write_table

SOURCE = (1e-4, 0.8)
"""Contrast, and separation in arcsec."""

SIZE = 40
"""Side of the fitted square, pixels."""

BLUR = 1.15
"""Standard deviation in pixels of the Gaussian of `blur_frames(fact='auto')` in F444W."""

FILTER = 5.0
"""Standard deviation in pixels of the Gaussian that a high-pass filter subtracts here."""

DISTANT = 100
"""Pixels from the star from which a frame shows its background."""


def _away(hdus: fits.HDUList) -> Any:
    header = hdus["SCI"].header
    y, x = np.indices(hdus["SCI"].shape[-2:])
    return np.hypot(x - header["CRPIX1"] + 1, y - header["CRPIX2"] + 1)


def background(hdus: fits.HDUList) -> None:
    """Subtract the background, as `subtract_background` does, or the pipeline."""
    far = _away(hdus) > DISTANT
    for frame in hdus["SCI"].data:
        frame -= np.nanmedian(frame[far])


def median(hdus: fits.HDUList) -> None:
    """`subtract_median`, of the whole frame."""
    for frame in hdus["SCI"].data:
        frame -= np.nanmedian(frame)


def rows(hdus: fits.HDUList) -> None:
    """Subtract what each row has in common away from the star, as removal of 1/f noise does."""
    far = _away(hdus) > DISTANT
    for frame in hdus["SCI"].data:
        frame -= np.nanmedian(np.where(far, frame, np.nan), axis=1, keepdims=True)


def rows_with_star(hdus: fits.HDUList) -> None:
    """The same without a mask over the star."""
    hdus["SCI"].data -= np.nanmedian(hdus["SCI"].data, axis=2, keepdims=True)


def cleaned(hdus: fits.HDUList) -> None:
    """`fix_bad_pixels(method='localmed')`: flagged pixels get the median about them."""
    for frame, flags in zip(hdus["SCI"].data, hdus["DQ"].data, strict=True):
        bad = (flags & 1 > 0) | ~np.isfinite(frame)
        frame[bad] = median_filter(np.nan_to_num(frame), 3)[bad]
        flags[bad] = 0


def clipped(hdus: fits.HDUList) -> None:
    """`find_bad_pixels(method='sigclip')` and the median: also sharp structure of the star."""
    for frame, flags in zip(hdus["SCI"].data, hdus["DQ"].data, strict=True):
        smooth = median_filter(np.nan_to_num(frame), 3)
        left = frame - smooth
        bad = np.abs(left) > 5 * 1.4826 * np.nanmedian(np.abs(left))
        frame[bad] = smooth[bad]
        flags[bad] = 0


def zeros(hdus: fits.HDUList) -> None:
    """`replace_nans`: pixels without a value get 0, and keep their flags."""
    hdus["SCI"].data = np.nan_to_num(hdus["SCI"].data)


def padded(hdus: fits.HDUList) -> None:
    """`pad_frames` with NaN, 60 pixels on each side."""
    around = ((0, 0), (60, 60), (60, 60))
    for name, fill in (("SCI", np.nan), ("ERR", np.nan), ("DQ", 0)):
        hdus[name].data = np.pad(hdus[name].data, around, constant_values=fill)
    for key in ("CRPIX1", "CRPIX2"):
        hdus["SCI"].header[key] += 60


def cropped(hdus: fits.HDUList) -> None:
    """`crop_frames` to 150 pixels about the star."""
    header = hdus["SCI"].header
    x, y = (round(header[key]) - 1 - 75 for key in ("CRPIX1", "CRPIX2"))
    for name in ("SCI", "ERR", "DQ"):
        hdus[name].data = hdus[name].data[:, y : y + 151, x : x + 151].copy()
    header["CRPIX1"] -= x
    header["CRPIX2"] -= y


def _moved(hdus: fits.HDUList, stated: bool) -> None:
    shift = (0.31, -0.27)  # y, x
    for name in ("SCI", "ERR"):
        for frame in hdus[name].data:
            moved = np.fft.fftn(np.nan_to_num(frame))
            frame[...] = np.fft.ifftn(fourier_shift(moved, shift)).real
    if stated:
        header = hdus["SCI"].header
        header["CRPIX1"] += shift[1]
        header["CRPIX2"] += shift[0]
        hdus["IMSHIFTS"].data = hdus["IMSHIFTS"].data + np.array([shift[::-1]])


def recentred(hdus: fits.HDUList) -> None:
    """`recenter_frames`: shifted by a fraction of a pixel, which IMSHIFTS records."""
    _moved(hdus, True)


def recentred_silently(hdus: fits.HDUList) -> None:
    """The same by other software, which records it only in the place of the star."""
    record = hdus["IMSHIFTS"].data.copy()
    _moved(hdus, True)
    hdus["IMSHIFTS"].data = record


def blurred(hdus: fits.HDUList) -> None:
    """`blur_frames`."""
    for name in ("SCI", "ERR"):
        for frame in hdus[name].data:
            frame[...] = gaussian_filter(np.nan_to_num(frame), BLUR)
    hdus[0].header["BLURFWHM"] = BLUR * np.sqrt(8 * np.log(2))


def filtered(hdus: fits.HDUList) -> None:
    """`hpf`: a high-pass filter."""
    for frame in hdus["SCI"].data:
        frame -= gaussian_filter(np.nan_to_num(frame), FILTER)


STEPS: dict[str, Callable[[fits.HDUList], None]] = {
    "background": background,
    "median of the frame": median,
    "1/f, star masked": rows,
    "1/f, star not masked": rows_with_star,
    "flagged pixels": cleaned,
    "pixels found by clipping": clipped,
    "NaN to zero": zeros,
    "padding": padded,
    "cropping": cropped,
    "recentring, recorded": recentred,
    "recentring, not recorded": recentred_silently,
    "blurring": blurred,
    "high-pass filter": filtered,
}


def measured(folder: Path, opd: Path) -> dict[str, Any]:
    """Reduce the files of a folder; numbers, or the reason why there are none."""
    try:
        sequence = dr.ExposureSequence.from_files(folder)
        if len(sequence.science) < 2:
            return {"outcome": f"excluded: {'; '.join(map(str, sequence.excluded))}"}
        reduction = dr.reduce(sequence, opd, accuracy="quick", size=SIZE)
    except DiffrenderError as error:
        return {"outcome": f"refused: {error}"}
    curve = reduction.detection.contrast_curve
    candidates = reduction.detection.candidates
    off = np.abs(candidates["separation"].to_value("arcsec") - SOURCE[1])
    return {
        "outcome": reduction.fit.status.name,
        "candidates": len(candidates),
        "contrast": candidates["contrast"][off.argmin()] / SOURCE[0] if len(off) else np.nan,
        "chi2": reduction.fit.chi2_per_pixel,
        "star": reduction.fit.frames[0].flux,
        "separation": curve["separation"].to_value("arcsec"),
        "limit": np.asarray(curve["contrast"]) * reduction.fit.frames[0].flux,
    }


def main() -> None:
    """Reduce the files with each step."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=Path, default=DATA / "gto1184")
    parser.add_argument("--opd", type=Path, default=opd_of(DATA))
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    paths = sorted(options.frames.glob(NAMES))
    sequence = dr.ExposureSequence.from_files(paths)
    untouched = dr.reduce(sequence, options.opd, accuracy="quick", size=SIZE)
    lights = light_of(untouched, sequence.cutout(SIDE), sources_of(SOURCE))
    table: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as place:
        before = Path(place) / "before"
        before.mkdir()
        with_source(paths, before, sequence, lights)
        base = measured(before, options.opd)
        for name, step in {"none": lambda _: None, **STEPS}.items():
            folder = Path(place) / name.replace("/", "").replace(" ", "_")
            folder.mkdir()
            for path in before.iterdir():
                with fits.open(path) as hdus:
                    step(hdus)
                    hdus.writeto(folder / path.name)
            found = measured(folder, options.opd)
            row = {"step": name, "outcome": found["outcome"]}
            if "limit" in found:
                there = np.interp(base["separation"], found["separation"], found["limit"])
                row |= {
                    "candidates": found["candidates"], "contrast": found["contrast"],
                    "chi2": found["chi2"], "star": found["star"] / base["star"],
                    "limits": float(np.median(there / base["limit"])),
                }  # fmt: skip
            table.append(row)
            print(row, flush=True)
    numbers = ("candidates", "contrast", "chi2", "star", "limits")
    result = Table([{**dict.fromkeys(numbers, np.nan), **row} for row in table])
    result.round(dict.fromkeys(numbers, 3))
    result.meta = provenance("benchmarks.stage2_steps --output docs/results/stage2_steps.ecsv")
    result.meta["note"] = (
        "contrast: measured over true, of the added source; star and limits (median, in units of "
        "flux): over those without the step"
    )
    write_table(result, options.output)


if __name__ == "__main__":
    main()
