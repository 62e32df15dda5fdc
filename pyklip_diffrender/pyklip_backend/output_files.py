"""Products of a dataset's reduction: images, throughput, and complete files with provenance."""

from __future__ import annotations

import math
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from astropy.io import fits
from astropy.time import Time
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates

from pyklip_diffrender._version import __version__
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.headers import fits_text, set_keyword
from pyklip_diffrender.pyklip_backend.dataset_frames import Frames
from pyklip_diffrender.pyklip_backend.subtract import Subtraction
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd_map import OPDMap

if TYPE_CHECKING:
    from pyklip_diffrender.detection.templates import Templates
    from pyklip_diffrender.imaging import SkyModel
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
    from pyklip_diffrender.refinement import Refinement

# The images that products carry in place of the frames minus their star.

Image = NDArray[np.float64]

_IMAGES_AT_ONCE = 320
"""Number of images of planets that are rendered at a time."""


def image_of(settings: DiffrenderSettings, subtraction: Subtraction) -> str:
    """Return which image the products carry, one of `IMAGES`.

    Raises IncompatibleSetupError if it needs the linear model of a fit, and there is none.
    """
    fitted = bool(subtraction.pointings)
    real = fitted and all(
        part.result.frames[part.index].observation.is_nircam for part in subtraction.pointings
    )
    image = settings.image or ("cleaned" if real else "subtracted")
    if image != "subtracted" and not fitted:
        raise IncompatibleSetupError(
            f"image: {image!r} needs the linear model of a fit, which a subtractor of "
            "your own does not have. Use image='subtracted'"
        )
    return image


class ProductImages:
    """Images of what is not star in the fitted frames of one wavelength."""

    def __init__(self, subtraction: Subtraction) -> None:
        self.pointings = subtraction.pointings
        self._disk = None if subtraction.reduction is None else subtraction.reduction.disk

    @cached_property
    def sky(self) -> SkyModel:
        """The model of the sky."""
        # Takes a second to import.
        from pyklip_diffrender.imaging import SkyModel

        # All pointings were fitted together.
        return SkyModel(self.pointings[0].result)

    def _peaks(self, templates: Templates) -> Image:
        """Peaks of planets of contrast 1 at the pixels of the first frame, (ny, nx)."""
        shape = templates.grid.shape[:2]
        rows, columns = (axis.ravel() for axis in np.indices(shape))
        peaks = []
        for start in range(0, len(rows), _IMAGES_AT_ONCE):
            part = slice(start, start + _IMAGES_AT_ONCE)
            row, column = rows[part], columns[part]
            images = templates.at_pixels(row, column)
            first = images[min(images)].double().numpy()
            peaks.append(first[np.arange(len(row)), row, column])
        return np.concatenate(peaks).reshape(shape)

    @cached_property
    def _extended(self) -> Image | None:
        """The disk, (ny, nx) north up, as the estimate of the sky without it would show it."""
        disk = self._disk
        if disk is None or not len(disk.offsets):
            return None
        templates = self.sky.templates
        angle = templates.origin.observation.position_angle
        # A point of the disk of contrast c has c times the peak of a planet of contrast 1 at the
        # nearest pixel; the estimate of the sky makes its image from that peak.
        away = disk.offsets[:, None] - templates.grid.reshape(-1, 2)
        pixels = np.hypot(*np.moveaxis(away, -1, 0)).argmin(axis=1)
        peaks = disk.contrasts * self._peaks(templates).ravel()[pixels]
        return self.sky.of_sources(disk.offsets, peaks, angle)

    def put_into(self, residuals: Image, added: Image | None = None) -> None:
        """Replace the fitted square of frames minus star (n, Ny, Nx) by the image of the sky.

        It is done in place. `added` is the light, (n, Ny, Nx), that copies of the frames have
        and the fitted frames do not.
        """
        sky = self._cleaned(added)
        for part in self.pointings:
            in_frame = self.sky.in_frame(sky, part.index)
            pasted = part.paste(in_frame, part.window)
            frames = residuals[part.pointing.frames]
            # Pixels without a value have none in the image either.
            shown = np.isfinite(pasted) & np.isfinite(frames)
            residuals[part.pointing.frames] = np.where(shown, pasted, frames)

    def _cleaned(self, added: Image | None) -> Image:
        """Posterior mean of the sky, north up."""
        light = dict(self.sky.light())
        if added is not None:
            for part in self.pointings:
                image = torch.from_numpy(part.mean_light(added))
                known = part.result.linear.frames[part.index].weight > 0
                light[part.index] = light[part.index] + torch.where(known, image, 0.0)[None]
        rest = np.asarray(self.sky.estimate(light)[0])
        return rest if self._extended is None else rest + self._extended


# How much of a faint point source's light the subtraction leaves, from the linear model of a fit.
#
# A source adds its image p to the data. Most of it is unlike anything that the wavefront can do to
# the star, but some is fitted as starlight, and subtracted. To first order the unknowns of the fit
# change by H^-1 G p, where G is the whitened Jacobian and H the curvature of the penalised
# chi-squared (see `linear.model`), and the star by the image of that change.
#
# Self-subtraction is larger in a source's wings than in its core, so that the fraction that is left
# depends on how the source is measured. Here it is the fraction of the peak: 1 - g . change / g . p
# with a Gaussian g of half the width of the source. `pyklip.fakes.gaussfit2d`, by which pyKLIP and
# spaceKLIP measure injected sources, adapts its Gaussian to the narrower core that is left, and
# agrees with this within 2 % (1 sigma) on NIRCam frames; a fit of the whole image would have about
# 18 % less.

SPACING = 2
"""Pixels between the positions at which the throughput is computed; between them it is
interpolated."""

_PEAK_FWHM_LAMBDA_D = 0.5
"""FWHM in lambda/D of the Gaussian with which a source's peak is measured."""

_PLACES_AT_A_TIME = 256


def throughput_map(
    fit: Refinement, spacing: int = SPACING, inner: float = 15.0
) -> NDArray[np.float64]:
    """Fraction (ny, nx) of a faint source's peak that is left, on the fit's first frame's pixels.

    It is the mean of all frames of the fit, for sources at the middles of the pixels. It is
    computed every `spacing` pixels, and at every pixel within `inner` pixels of the star and next
    to companions.
    """
    from pyklip_diffrender.detection.templates import Templates

    templates = Templates(fit)
    ny, nx = fit.frames[0].model.detector.shape
    rows, columns = (np.unique(np.append(np.arange(0, n, spacing), n - 1)) for n in (ny, nx))
    y, x = np.meshgrid(rows, columns, indexing="ij")
    coarse = _at(fit, templates, y.ravel(), x.ravel()).reshape(y.shape)
    every = np.moveaxis(np.indices((ny, nx)), 0, -1)
    filled = np.asarray(RegularGridInterpolator((rows, columns), coarse)(every))
    pixel = math.sqrt(math.prod(fit.model.detector.pixelscale))
    # Interpolation errs where the throughput changes from pixel to pixel: near the star, by up to
    # 15 %, and near companions, at whose places no light becomes star because they are part of the
    # model.
    dense = np.hypot(*templates.grid.transpose(2, 0, 1)) <= inner * pixel
    for _, *offset in fit.companions:
        dense |= np.hypot(*(templates.grid - offset).transpose(2, 0, 1)) <= 5 * pixel
    filled[dense] = _at(fit, templates, *np.nonzero(dense))
    return filled


def _at(
    fit: Refinement, templates: Templates, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """The throughput (k,) of sources at pixels, rows and columns (k,), of the first frame."""
    star = np.array([unknown.name != "companions" for unknown in fit.linear.unknowns])
    left = np.empty(len(rows))
    for start in range(0, len(rows), _PLACES_AT_A_TIME):
        part = slice(start, start + _PLACES_AT_A_TIME)
        images = templates.at_pixels(rows[part], columns[part])
        offsets = torch.from_numpy(templates.grid[rows[part], columns[part]])
        change = fit.linear.response(images)
        change[~star] = 0.0
        taken, total = np.zeros(len(offsets)), 0.0
        for k, image in images.items():
            # 1 - g . change / g . p, see above. The frames of a pointing are averaged, so that its
            # `count` of them weighs each.
            core = _cores(fit.frames[k].model, templates.pixels_of(k, offsets))
            peak = np.einsum("kyx,kyx->k", core, image.numpy())
            share = np.einsum("kyx,kyx->k", core, fit.linear.frames[k].image(change).numpy())
            count = fit.frames[k].observation.count
            # Where a frame does not show the source, nothing of it is taken.
            taken += count * np.divide(share, peak, out=np.zeros_like(share), where=peak > 0)
            total += count
        left[part] = 1 - taken / total
    return left


def _cores(model: OpticalSystem, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaussians (k, ny, nx) narrower than a source, about rows and columns `places` (2, k)."""
    detector = model.detector
    pixel = math.sqrt(math.prod(detector.pixelscale))
    fwhm = _PEAK_FWHM_LAMBDA_D * model.resolution / pixel
    y, x = (
        np.exp(-4 * math.log(2) * ((np.arange(count) - place[:, None]) / fwhm) ** 2)
        for count, place in zip(detector.shape, places, strict=True)
    )
    return np.asarray(y[:, :, None] * x[:, None, :])


def on_product(
    image: NDArray[np.float64],
    center: NDArray[np.float64],
    shape: tuple[int, int],
    product_center: NDArray[np.float64],
    angle: float,
    flipx: bool = False,
) -> NDArray[np.float64]:
    """Turn a map (ny, nx) of the first frame the way pyKLIP turns frames; NaN beyond its edges.

    The star is at x, y = `center` there, and at `product_center` of the product. pyKLIP turns by
    `angle`, in degrees counter-clockwise; `flipx` is as in `pyklip.klip.rotate`.
    """
    y, x = np.indices(shape)
    # The pixel of the product at x, y from the star, turned back clockwise:
    # x' = x cos + y sin, y' = y cos - x sin. A flip of x is undone first, because
    # `pyklip.klip.rotate` does it last.
    x, y = x - product_center[0], y - product_center[1]
    x = -x if flipx else x
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    places = [-x * sine + y * cosine + center[1], x * cosine + y * sine + center[0]]
    return np.asarray(map_coordinates(image, places, order=1, cval=np.nan))


def write_throughput(
    path: Path, dataset: Any, image: NDArray[np.float64], frame: Observation, *, is_turned: bool
) -> float:
    """Write a map of the throughput on the products' pixels, and return the fitted pixels' median.

    The map, `image` (ny, nx), is on the pixels of the first `frame`. With `is_turned` pyKLIP has
    turned north up.
    """
    center = np.asarray(dataset.output_centers[0], dtype=float)
    angle = frame.position_angle if is_turned else 0.0
    shape = dataset.output.shape[-2:]
    turned = on_product(image, frame.center[0], shape, center, angle, dataset.flipx)
    # NaN are pixels outside the fitted square, where nothing is taken and the throughput is 1.
    shown = ~np.isnan(dataset.output[0, :, 0]).all(axis=0)
    median = float(np.median(turned[shown & np.isfinite(turned)]))
    turned = np.where(shown, np.nan_to_num(turned, nan=1.0), np.nan)
    hdu = fits.PrimaryHDU(turned.astype(np.float32))
    hdu.header["BUNIT"] = ("", "fraction of a faint point source's peak")
    hdu.header["PSFCENTX"], hdu.header["PSFCENTY"] = center
    hdu.header["STARCENX"], hdu.header["STARCENY"] = center[0] + 1, center[1] + 1
    set_keyword(hdu.header, "DRTHSTEP", SPACING)
    hdu.header.add_comment(
        "Fraction of a faint point source's peak that the subtraction leaves, to first order in "
        "its light, before any high-pass filter. Computed at every DRTHSTEP pixels and next to "
        "the star and companions of the fit, interpolated elsewhere; 1 outside the fitted square. "
        "Detected companions that are in the model (DRKEPT) keep their light."
    )
    hdu.writeto(path)
    return median


# Output files that appear complete or not at all, with provenance in their headers.


@dataclass(frozen=True, eq=False)
class ReductionRecord:
    """How the frames of a dataset were reduced."""

    frames: Frames
    opd: OPDMap  # at the start of the fit
    subtraction: Subtraction
    filled: int  # flagged pixels that were replaced after the subtraction
    image: str = "subtracted"  # that the products carry, see `DiffrenderSettings`

    def __repr__(self) -> str:
        filter_ = self.frames.observation.filter or "given model"
        return (
            f"<ReductionRecord: {filter_}, {self.subtraction!r}, image {self.image!r}, map "
            f"{self.opd.name}>"
        )

    @cached_property
    def images(self) -> ProductImages:
        """Other images of the frames."""
        return ProductImages(self.subtraction)

    def __deepcopy__(self, memo: dict[int, Any]) -> ReductionRecord:
        """Itself: it never changes, and a contrast curve copies its dataset 120 times."""
        return self


def folder_and_prefix(folder: str | os.PathLike[str], prefix: str) -> tuple[Path, str]:
    """Split `outputdir` and `fileprefix`, which may begin with folders, into folder and names.

    Raises FileNotFoundError if there is no such folder (pyKLIP does not make it either), and
    PermissionError if nothing can be written there.
    """
    inside, name = os.path.split(str(prefix))
    path = (Path(folder or ".") / inside).resolve()
    argument = "fileprefix" if inside else "outputdir"
    if not path.is_dir():
        raise FileNotFoundError(f"{argument}: {path} is not a folder; make it first")
    if not os.access(path, os.W_OK | os.X_OK):
        raise PermissionError(f"{argument}: {path} cannot be written to")
    return path, name


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """Path of a temporary folder whose files are moved to `folder` if the block succeeds.

    If the block raises, they are deleted and `folder` is unchanged. The block makes the temporary
    folder.
    """
    # Inside `folder`, so that each move is one step on the same file system. The block makes it
    # when it has something to write: a process that is killed in a long fit then leaves nothing
    # behind.
    stage = folder / f".diffrender-{secrets.token_hex(6)}"
    try:
        yield stage
        for path in sorted(p for p in stage.rglob("*") if p.is_file()):
            target = folder / path.relative_to(stage)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    finally:
        if stage.exists():
            shutil.rmtree(stage)


_PARAMETERS = "subsect, minmove, numbasis, minrot: not used"
_SLICES = "as asked for; all slices are one image"
"""Comments on cards of KLIP's parameters and modes."""


def provenance(record: ReductionRecord) -> fits.Header:
    """Cards for a product: keywords, then HISTORY.

    Where there are several fits, chi2 and status are the worst fit's, and HISTORY has all.
    """
    frames, subtraction, opd = record.frames, record.subtraction, record.opd
    reduction = subtraction.reduction
    passband = frames.observation.filter
    header = fits.Header()
    values: dict[str, Any] = {
        "DRALGO": "diffrender",
        "DRVERS": __version__,
        "DROPD": opd.name,
        "DRSHA256": opd.sha256,
        "DRFILT": passband or "",
        "DRSTAT": subtraction.worst.status,
        "DRCHI2": subtraction.worst.chi2,
        "DRNFIT": len(subtraction.fits),
        "DRKEPT": subtraction.kept,
        "DRPATTRN": subtraction.pattern,
        "DRREFS": subtraction.references,
        # Empty for other subtractors.
        "DRREFUSE": "" if reduction is None else reduction.visit.in_words(),
        "DRPIXELS": frames.pixels,
        "DRFILLED": record.filled,
        "DRIMAGE": record.image,
        "DRNOISE": frames.noise,
    }
    dates = [pointing.observation.date for pointing in frames.pointings]
    known = [date for date in dates if date is not None]
    days = opd.days_after(Time(known).mean()) if known else None
    if opd.date is not None:
        values["DROPDDAT"] = opd.date.isot
    if days is not None:
        values["DROPDHRS"] = 24 * days
    for key, value in values.items():
        set_keyword(header, key, value)
    header.add_history(
        f"Star rendered and subtracted by pyklip_diffrender {__version__}; the "
        "KL modes are all the same image; subsections, movement, numbasis, minrot and the number "
        "of annuli are not used"
    )
    header.add_history("DRSHA256 is the SHA-256 of the OPD map's file, or of its array")
    line = (
        f"diffrender: {frames.observation.name}, {passband or 'given model'}, "
        f"opd {opd.name}, "
        f"{frames.pixels} pixels, errors {frames.noise}"
    )
    header.add_history(fits_text(line))
    for fit in subtraction.fits:
        header.add_history(
            f"diffrender: frames {', '.join(map(str, fit.frames))}: {fit.status}, "
            f"chi2/N {fit.chi2:.4g}"
        )
    for line in _fitted(subtraction):
        header.add_history(f"diffrender: {line}")
    return header


def _fitted(subtraction: Subtraction) -> Iterator[str]:
    """The settings of the fits, their companions, and the star of every pointing, in words."""
    for result in dict.fromkeys(part.result for part in subtraction.pointings):
        free, settings = ", ".join(result.settings.free), result.settings
        yield f"fit: free {free}, cycles {settings.cycles}, tolerance {settings.tolerance}"
        for contrast, x, y in result.companions:
            yield f"companion: contrast {contrast:.3g} at x {x:.4f}, y {y:.4f} arcsec from the star"
    for part in subtraction.pointings:
        x, y = -part.from_star(np.zeros(2))
        yield (
            f"frames {', '.join(map(str, part.pointing.frames))}: star at x {x:+.4f}, y {y:+.4f} "
            f"arcsec from its place in the file, flux {part.frame.flux:.6g}, background "
            f"{float(part.frame.values['background'][0]):.4g}"
        )


def stamp(folder: Path, cards: fits.Header, unit: str) -> None:
    """Add cards to the primary header of every FITS file in a folder; pixels stay as they are.

    `unit` stands for a missing BUNIT; empty if it is not known. The cards of KLIP's parameters
    stay, because programs read them, with a comment that says what they mean here.
    """
    for path in (p for p in folder.rglob("*") if ".fits" in p.suffixes):
        with fits.open(path, mode="update", memmap=False) as hdus:
            header = hdus[0].header
            header.extend(cards, strip=False, update=True)
            if unit and "BUNIT" not in header:
                header["BUNIT"] = unit
            for key in header:
                if key == "PSFPARAM" or key.startswith("KLMODE"):
                    header.comments[key] = _PARAMETERS if key == "PSFPARAM" else _SLICES
