"""Extended light in real frames: this package and KLIP (pyKLIP's) on the same frames.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m tests.benchmarks.disks --filter F444W --figure docs/images/au_mic.png

It fits the edge-on disk of AU Mic with `reduce(disk=True)`, and subtracts the star with KLIP
(ADI+RDI: the other roll and four frames of two other stars). Then it injects the sources of this
disk into the frames of HIP 17695, which has none, and prints how much of that known light each
keeps.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import pyklip_diffrender as dr
from pyklip_diffrender.plotting.panels import save
from tests.benchmarks.injections import MODES, PIXEL, SIZE, aligned, planet, subtraction

Image = NDArray[np.float64]


def amount(image: Image, light: Image) -> float:
    """How much of the light an image has, beyond 0.4 arcsec from the star."""
    y, x = np.indices(light.shape)
    outside = (np.hypot(x - SIZE / 2, y - SIZE / 2) * PIXEL > 0.4) & np.isfinite(image)
    return float((image * light)[outside].sum() / (light**2)[outside].sum())


def klip(frames: list[Image], base: dr.Reduction, folder: Path) -> list[Image]:
    """Rolls without the star, turned onto the first one, for each number of modes."""
    references = [aligned(folder / each.name) for each in base.sequence.references]
    science = base.sequence.science
    rolls = [each.roll_from(science[0]) for each in science]
    return subtraction(frames, references, rolls)


def rendered(base: dr.Reduction, disk: dr.Disk, shifts: list[Image]) -> list[Image]:
    """Light of the sources of a disk in all frames of another star, which is at the shifts."""
    images = []
    for frame, each, shift in zip(base.fit.frames, base.sequence.science, shifts, strict=True):
        roll = each.roll_from(base.sequence.science[0])
        sources = zip(disk.offsets, disk.contrasts, strict=True)
        images.append(sum(c * planet(frame, roll, offset, shift) for offset, c in sources))
    return images


def draw(reduction: dr.Reduction, subtracted: Image, path: Path) -> None:
    """The frame, KLIP and this package side by side, in type that a phone shows, too."""
    import matplotlib
    from matplotlib.figure import Figure

    from pyklip_diffrender.plotting.panels import draw_compass, extent_of, halo, light_norm

    disk = reduction.disk
    assert disk is not None
    extent = extent_of(disk.grid[0, :, 0], disk.grid[:, 0, 1])
    frame = reduction.sequence.science[0].combined()
    data = np.where(frame.valid[0], frame.data[0], np.nan)
    limit = float(np.nanpercentile(disk.light[0], 99))
    on_disk = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    panels = [
        ("one frame", data,
         {"cmap": "magma", "norm": light_norm(data, frame.error[0][frame.valid[0]])}),
        ("KLIP", subtracted, on_disk),
        ("this package", disk.image, on_disk),
    ]  # fmt: skip
    with matplotlib.rc_context({"font.size": 11, "axes.titlesize": 13}):
        figure = Figure(figsize=(6.6, 3.25), layout="compressed")
        axes = figure.subplots(1, 3, sharey=True)
        artists = []
        for ax, (title, image, style) in zip(axes, panels, strict=True):
            artists.append(ax.imshow(image, origin="lower", extent=extent, **style))
            ax.set(title=title, facecolor="0.75", xticks=(-2, 0, 2), yticks=(-2, 0, 2))
            ax.plot(0, 0, "+", color="black", ms=9, mew=1.6, path_effects=halo())
        axes[0].set_ylabel("arcsec")
        draw_compass(axes[0], frame.position_angle)
        bar = {"orientation": "horizontal", "pad": 0.03, "aspect": 12}
        figure.colorbar(artists[0], ax=axes[0], label="MJy/sr", ticks=(1, 100), extend="min",
                        format="%g", **bar)  # fmt: skip
        figure.colorbar(artists[2], ax=axes[1:], label="MJy/sr", ticks=(-10, 0, 10), extend="both",
                        **{**bar, "aspect": 25})  # fmt: skip
        save(figure, path, dpi=300)


def main() -> None:
    """Reduce AU Mic, and HIP 17695 with its disk."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=Path, default=Path("../shared/data/gto1184"))
    parser.add_argument("--opd", type=Path, default=Path("../shared/data/opd_2022-08-14.fits.gz"))
    parser.add_argument("--filter", default="F444W")
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()

    def read(target: str) -> dr.Sequence:
        return dr.Sequence.from_files(options.frames, target=target, filter=options.filter)

    sequence = read("V-AU-MIC")
    reduction = dr.reduce(replace(sequence, references=()), options.opd, disk=True)
    reduction = replace(reduction, sequence=replace(reduction.sequence,
                                                    references=sequence.references))  # fmt: skip
    disk = reduction.disk
    assert disk is not None
    print(reduction)
    print(disk, f"position angle {disk.orientation:.2f} deg, chi2 {disk.fit.chi2_per_pixel:.2f}")
    curve = reduction.detection.contrast_curve
    for separation in (0.5, 1.0, 1.5, 2.0):
        limit = np.interp(separation, curve["separation"].value, curve["contrast"])
        print(f"5-sigma contrast at {separation} arcsec: {limit:.2e}")
    files = [options.frames / each.name for each in reduction.sequence.science]
    subtracted = klip([aligned(each) for each in files], reduction, options.frames)
    if options.figure:
        draw(reduction, subtracted[-1], options.figure)

    sequence = read("HIP17695")
    bare = dr.reduce(replace(sequence, references=()), options.opd)
    shifts = [np.asarray(frame.values["detector_shift"]) for frame in bare.fit.frames]
    light = rendered(bare, disk, shifts)
    science = tuple(
        replace(each, data=each.data + image)
        for each, image in zip(bare.sequence.science, light, strict=True)
    )
    found = dr.reduce(replace(bare.sequence, science=science), options.opd,
                      systematics=bare.systematics or "off", disk=True)  # fmt: skip
    assert found.disk is not None
    star_only = replace(bare.sequence, science=science)
    alone = dr.refine(bare.fit.model, star_only.science, bare.fit.initial,
                      systematics=bare.systematics)  # fmt: skip
    print("HIP 17695 with the disk:", found.disk)
    print(f"fitted together: {amount(found.disk.light[0], light[0]):.3f} of the light, image "
          f"{amount(found.disk.image, light[0]):.3f}")  # fmt: skip
    left = np.nan_to_num(alone.frames[0].residual[0])
    print(f"star fitted alone: {amount(left, light[0]):.3f}")
    references = replace(bare, sequence=replace(bare.sequence, references=sequence.references))
    files = [options.frames / each.name for each in sequence.science]
    plain = [aligned(each) for each in files]
    # In KLIP's frames the star is in the middle of a pixel.
    on_aligned = rendered(bare, disk, [np.full(2, 0.5 * PIXEL)] * len(plain))
    with_disk = [frame + image for frame, image in zip(plain, on_aligned, strict=True)]
    for count, with_, without in zip(
        MODES, klip(with_disk, references, options.frames), klip(plain, references, options.frames),
        strict=True,
    ):  # fmt: skip
        print(f"KLIP, {count} modes: {amount(with_ - without, on_aligned[0]):.3f}")


if __name__ == "__main__":
    torch.manual_seed(0)
    main()
