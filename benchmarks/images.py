"""Depth of the image in pyKLIP's products: this package and KLIP, by pyKLIP's own yardstick.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.images --target G-7-34 --filter F444W

The rolls of a target are reduced with KLIP (ADI+RDI, all other stars as references, 1 to 5 modes)
and with this package (image "cleaned"). The noise of each product is that
of `pyklip.klip.meas_contrast`; its throughput is that of planets injected with
`fakes.inject_planet`, a few times brighter than the noise so that both algorithms are linear, and
measured with `fakes.retrieve_planet_flux`. They have the image of a point source behind the Lyot
stop, or with ``--gaussian`` pyKLIP's Gaussian of width lambda/D. It prints 5-sigma limits in the
unit of the injected peaks, raw and after the Gaussian filter of `meas_contrast`, which both
products get then. With ``--disk ANGLE``, the position angle of an edge-on disk, noise and planets
are those beside it, more than 45 degrees from either side.
"""

from __future__ import annotations

import contextlib
import copy
import io
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyklip import fakes
from pyklip.instruments.JWST import JWSTData
from pyklip.klip import meas_contrast
from pyklip.parallelized import klip_dataset

import pyklip_diffrender as dr
from benchmarks.real_frames import real_frames_parser

Image = NDArray[np.float64]

SEPARATIONS = np.array([0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 2.3])
ANGLES = np.arange(20.0, 380.0, 60.0)
MODES = [1, 2, 3, 4, 5]
OURS = "cleaned"
STAMP = 41
"""Side of the image of a planet, pixels."""

BESIDE = 45.0
"""Smallest angle from the axis of a disk, degrees."""

STRENGTH = 8.0
"""Peaks of the injected planets over the standard deviation of the pixels of the ring."""

LEAST = 1e-3
"""Throughput below which a number of modes says nothing of planets."""


def reduced(dataset: Any, algo: str, modes: list[int]) -> Image:
    """Run `klip_dataset`; the images by number of modes, (modes, ny, nx).

    With a movement of 0, a frame would be one of its own references.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        klip_dataset(
            dataset, mode="ADI+RDI", outputdir=folder, fileprefix="x", annuli=1, subsections=1,
            numbasis=modes, movement=1, numthreads=1, psf_library=dataset.psflib,
            time_collapse="mean", algo=algo, verbose=False,
        )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # Pixels that no roll has.
        return np.asarray(np.nanmean(dataset.output[:, :, 0], axis=1), dtype=float)


def limits(image: Image, center: Image, scale: float, fwhm: float, smooth: bool) -> Image:
    """5-sigma limits of `meas_contrast` at the separations, before throughput."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # Rings without pixels.
        seps, contrast = meas_contrast(
            image, SEPARATIONS[0] / scale - fwhm, SEPARATIONS[-1] / scale + 2 * fwhm, fwhm,
            center=tuple(center), low_pass_filter=smooth,
        )  # fmt: skip
    return np.interp(SEPARATIONS, seps * scale, contrast)


def from_axis(angle: Image, axis: float) -> Image:
    """Angle from the nearer side of a disk's axis, degrees."""
    return np.abs((angle - axis + 90) % 180 - 90)


def beside(image: Image, center: Image, axis: float) -> Image:
    """An image with north up and east on the left, NaN but for what is beside a disk."""
    y, x = np.indices(image.shape)
    angle = np.degrees(np.arctan2(center[0] - x, y - center[1]))
    return np.where(from_axis(angle, axis) > BESIDE, image, np.nan)


def point_source(passband: str, like: dr.OpticalSystem) -> Image:
    """Image of a source far from the mask, with a peak of 1."""
    model = dr.nircam_coronagraph(
        passband, image_mask=None, pupil_mask="MASKRND", pixelscale=like.detector.pixelscale,
        npix=256, nlambda=5, fov_pixels=STAMP,
    )  # fmt: skip
    image = np.asarray(model().numpy(), dtype=float)
    return image / image.max()


def main() -> None:
    """Compare the depths at several separations."""
    parser = real_frames_parser(__doc__)
    parser.add_argument("--gaussian", action="store_true")
    parser.add_argument("--disk", type=float, metavar="ANGLE")
    options = parser.parse_args()
    sequence = dr.ExposureSequence.from_files(
        options.frames, target=options.target, filter=options.filter
    )
    names = [
        [str(next(options.frames.rglob(Path(each.name).name))) for each in part]
        for part in (sequence.science, sequence.references)
    ]
    dr.register(opd=options.opd)
    dataset = JWSTData(*names, center_include_offset=False)
    plain = {name: copy.deepcopy(dataset) for name in ("KLIP", OURS)}
    images = {"KLIP": reduced(plain["KLIP"], "klip", MODES)}
    first = plain[OURS]
    first.diffrender = dr.pyklip_backend.DiffrenderSettings(
        image=OURS, disk=options.disk is not None
    )
    images[OURS] = reduced(first, "diffrender", [1])
    fit = first.diffrender_results[0].subtraction.fits[0].result
    model = fit.model
    scale = float(np.mean(model.detector.pixelscale))
    resolution = float(model.bandpass.mean_wavelength) / model.diameter
    fwhm = float(np.degrees(resolution)) * 3600 / scale
    center = np.asarray(plain["KLIP"].output_centers[0], dtype=float)
    print(f"{options.target} {options.filter}: {fit!r}")
    kept = {name: np.zeros((len(each), len(SEPARATIONS))) for name, each in images.items()}
    stamp = None if options.gaussian else point_source(options.filter, model)
    background, angles = images, ANGLES + 137.5 * np.arange(len(SEPARATIONS))[:, None]
    if options.disk is not None:
        background = {
            name: np.array([beside(image, center, options.disk) for image in each])
            for name, each in images.items()
        }
        # Those of the whole ring, on the two arcs beside the disk.
        angles = options.disk + 90 + BESIDE * (angles % 360 - 180) / 180
        angles[:, ::2] += 180
    noise = limits(background["KLIP"][0], center, scale, fwhm, False) / 5
    for k, separation in enumerate(SEPARATIONS):
        for angle in angles[k]:
            peak = STRENGTH * noise[k]
            place = (separation / scale, angle)
            for name in images:
                copied = copy.deepcopy(dataset)
                if name == OURS:
                    # The frames are fitted once.
                    copied.diffrender = dr.pyklip_backend.DiffrenderSettings(
                        image=name, injected_into=first
                    )
                planets = [peak if stamp is None else peak * stamp] * len(copied.input)
                fakes.inject_planet(
                    copied.input, copied.centers, planets, copied.wcs, *place, fwhm=fwhm
                )
                algo, modes = ("klip", MODES) if name == "KLIP" else ("diffrender", [1])
                for m, image in enumerate(reduced(copied, algo, modes) - images[name]):
                    flux = fakes.retrieve_planet_flux(
                        image, center, copied.output_wcs[0], *place, searchrad=4, guessfwhm=fwhm
                    )
                    kept[name][m, k] += flux / peak / len(ANGLES)
    for smooth in (False, True):
        best = {
            name: np.nanmin(
                [limits(image, center, scale, fwhm, smooth) / np.where(left > LEAST, left, np.nan)
                 for image, left in zip(each, kept[name], strict=True)],
                axis=0,
            )
            for name, each in background.items()
        }  # fmt: skip
        print("after the Gaussian filter" if smooth else "raw", "image, KLIP, ours, ratio, kept")
        ratio = best["KLIP"] / best[OURS]
        for k, separation in enumerate(SEPARATIONS):
            values = best["KLIP"][k], best[OURS][k], ratio[k]
            print(f"{separation:.1f}  {values[0]:.3g}  {values[1]:.3g}  {values[2]:.2f}"
                  f"  {kept[OURS][0, k]:.2f}")  # fmt: skip
        print(f"median ratio {np.median(ratio):.2f}", flush=True)


if __name__ == "__main__":
    main()
