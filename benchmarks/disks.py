"""Extended light in real frames: this package and KLIP (pyKLIP's) on the same frames.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.disks --filter F444W --figure docs/images/au_mic.png

It fits the edge-on disk of AU Mic with `reduce(disk=True)`, and subtracts the star with KLIP
(ADI+RDI: the other roll and four frames of two other stars). It prints the 5-sigma limits of both
for point sources where these would not count as the disk's light, KLIP's for frames from which the
fitted disk was subtracted. Then it injects the sources of this disk into the frames of HIP 17695,
which has none, and prints how much of that known light each keeps.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import pyklip_diffrender as dr
from benchmarks.real_frames import real_frames_parser
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.drawing import halo, light_norm, save
from pyklip_diffrender.reduction.klip import KlipSubtraction, klip_curve
from pyklip_diffrender.scene.aligned_frames import shift_frames

Image = NDArray[np.float64]

SIZE = 80
SEPARATIONS = np.array([0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 2.3])


def amount(image: Image, light: Image, distance: Image) -> float:
    """How much of the light an image has, beyond 0.4 arcsec from the star."""
    outside = (distance > 0.4) & np.isfinite(image)
    return float((image * light)[outside].sum() / (light**2)[outside].sum())


def klip_of(base: dr.Reduction, sequence: dr.ExposureSequence) -> KlipSubtraction:
    """KLIP for the frames as they were taken, with those of all other stars of the sequence."""
    resolution = base.detection.contrast_curve.meta["resolution_arcsec"]
    references = sequence.cutout(SIZE).references
    templates = Templates(base.fit)
    return KlipSubtraction(templates, references, resolution, base.sequence.science)


def draw(reduction: dr.Reduction, subtracted: Image, path: Path) -> None:
    """The frame, KLIP and this package side by side, in type that a phone shows, too."""
    import matplotlib
    from matplotlib.figure import Figure

    disk = reduction.disk
    assert disk is not None
    half = (disk.grid[0, 1, 0] - disk.grid[0, 0, 0]) / 2
    extent = [
        side + sign * half
        for k in (0, 1)
        for side, sign in ((disk.grid[..., k].min(), -1), (disk.grid[..., k].max(), 1))
    ]
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
        _compass(axes[0], frame.position_angle)
        bar = {"orientation": "horizontal", "pad": 0.03, "aspect": 12}
        figure.colorbar(artists[0], ax=axes[0], label="MJy/sr", ticks=(1, 100), extend="min",
                        format="%g", **bar)  # fmt: skip
        figure.colorbar(artists[2], ax=axes[1:], label="MJy/sr", ticks=(-10, 0, 10), extend="both",
                        **{**bar, "aspect": 25})  # fmt: skip
        save(figure, path, dpi=300)


def _compass(ax: Any, position_angle: float) -> None:
    """Draw arrows to north and east in the lower left corner, for a +y axis at an angle."""
    angle = np.deg2rad(position_angle)
    north, east = np.array([[np.sin(angle), np.cos(angle)], [-np.cos(angle), np.sin(angle)]])
    # Whichever way the arrows point, they stay inside.
    tail = 14.0 - 30.0 * np.minimum(0.0, np.minimum(north, east))
    for letter, arrow in (("N", north), ("E", east)):
        style = {"arrowstyle": "<-", "lw": 1.4, "shrinkB": 0, "path_effects": halo()}
        ax.annotate(
            letter, tail, tail + 30.0 * arrow, xycoords="axes points", textcoords="axes points",
            ha="center", va="center", path_effects=halo(), arrowprops=style,
        )  # fmt: skip


def main() -> None:
    """Reduce AU Mic, and HIP 17695 with its disk."""
    parser = real_frames_parser(__doc__, target=None)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()

    def read(target: str) -> dr.ExposureSequence:
        return dr.ExposureSequence.from_files(options.frames, target=target, filter=options.filter)

    sequence = read("V-AU-MIC")
    reduction = dr.reduce(replace(sequence, references=()), options.opd, disk=True)
    disk = reduction.disk
    assert disk is not None
    print(reduction)
    print(disk, f"position angle {disk.orientation:.2f} deg, chi2 {disk.fit.chi2_per_pixel:.2f}")
    curve = reduction.detection.contrast_curve
    ours, corrected = (
        np.interp(SEPARATIONS, curve["separation"].value, curve[name])
        for name in ("contrast", "small_sample")
    )
    references = sequence.cutout(SIZE).references
    theirs = np.asarray(klip_curve(reduction.detection, references, SEPARATIONS)["small_sample"])
    print("5-sigma limits: ours; with small-sample correction: ours, KLIP, ratio")
    for row in zip(SEPARATIONS, ours, corrected, theirs, theirs / corrected, strict=True):
        print("{:.1f}  {:.2e}  {:.2e}  {:.2e}  {:.2f}".format(*row))
    klip = klip_of(reduction, sequence)
    subtracted = klip.residuals(klip.science)
    if options.figure:
        draw(reduction, subtracted[-1], options.figure)

    sequence = read("HIP17695")
    bare = dr.reduce(replace(sequence, references=()), options.opd)
    # At the same places from the other star, in units of it.
    images = Templates(bare.fit).at(torch.from_numpy(disk.offsets))
    contrasts = np.asarray(disk.contrasts)
    light = [np.tensordot(contrasts, each.numpy(), 1) for each in images.values()]
    science = tuple(
        replace(each, data=each.data + image)
        for each, image in zip(bare.sequence.science, light, strict=True)
    )
    found = dr.reduce(replace(bare.sequence, science=science), options.opd,
                      pattern=bare.pattern or "off", disk=True)  # fmt: skip
    assert found.disk is not None
    star_only = replace(bare.sequence, science=science)
    alone = dr.refine(bare.fit.model, star_only.science, bare.fit.initial,
                      pattern=bare.pattern)  # fmt: skip
    print("HIP 17695 with the disk:", found.disk)
    klip = klip_of(bare, sequence)
    kept = amount(found.disk.light[0], light[0], klip.distance)
    image = amount(found.disk.image, light[0], klip.distance)
    print(f"fitted together: {kept:.3f} of the light, image {image:.3f}")
    left = np.nan_to_num(alone.frames[0].residual[0])
    print(f"star fitted alone: {amount(left, light[0], klip.distance):.3f}")
    aligned = shift_frames(np.array(light), klip.shifts)
    changes = klip.residuals(klip.science + aligned) - klip.residuals(klip.science)
    for count, change in zip(klip.modes, changes, strict=True):
        print(f"KLIP, {count} modes: {amount(change, aligned[0], klip.distance):.3f}")


if __name__ == "__main__":
    torch.manual_seed(0)
    main()
