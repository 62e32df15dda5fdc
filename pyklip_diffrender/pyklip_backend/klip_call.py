"""One call of `klip_dataset` in which the star is rendered instead of estimated from references.

pyKLIP still checks the arguments, derotates, collapses, and writes the files. For the duration of
the call only `klip_parallelized` (and its lite version) is replaced by a function with the same
interface, and `high_pass_filter_imgs` by one that keeps the unfiltered frames for the fit.
"""

from __future__ import annotations

import ctypes
import io
import logging
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.stats import sigma_clipped_stats
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    NoValidPixelsError,
    RefinementError,
    ShapeError,
)
from pyklip_diffrender.io.headers import fits_text, fits_unit, set_keyword
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings, starting_opd
from pyklip_diffrender.pyklip_backend.dataset_frames import (
    Frames,
    date_of_frames,
    frames_of,
    library_files,
    require_frames,
)
from pyklip_diffrender.pyklip_backend.forward_model import (
    check_forward_model,
    is_planet,
    planet_cards,
    planet_in_frames,
)
from pyklip_diffrender.pyklip_backend.output_files import (
    ReductionRecord,
    folder_and_prefix,
    image_of,
    provenance,
    staging,
    stamp,
    throughput_map,
    write_throughput,
)
from pyklip_diffrender.pyklip_backend.source_frames import ATTRIBUTE, why_without_source
from pyklip_diffrender.pyklip_backend.subtract import Subtraction, subtract_by_refinement
from pyklip_diffrender.wavefront.opd_map import OPDMap

# Place and mask subtracted frames the way pyKLIP's `klip_parallelized` does.


@dataclass(frozen=True)
class Annuli:
    """The annuli that pyKLIP would use, reduced to what matters without KLIP."""

    inner: float  # pixels; r < inner and r >= outer are NaN in a product
    outer: float
    width: float  # pixels, of the narrowest annulus, over which pyKLIP measures noise


def annuli_of(
    imgs: NDArray[Any],
    centers: NDArray[Any],
    inner: float,
    outer: float | None,
    annuli: int | Sequence[tuple[float, float]],
    spacing: str,
) -> Annuli:
    """Find the annuli of frames (n, ny, nx), star at x, y = `centers` (n, 2), by pyKLIP's rules.

    `inner` and `outer` are IWA and OWA in pixels, `outer` None for the whole image. `annuli` is a
    number or a sequence of radii (inner, outer) in pixels; `spacing` is "constant", "log" or
    "linear".
    """
    from pyklip.klip import define_annuli_bounds

    if np.ndim(annuli):
        inners, outers = np.array(annuli, dtype=float).reshape(-1, 2).T
        return Annuli(inners.min(), outers.max(), (outers - inners).min())
    # Without OWA, pyKLIP takes the distance of the nearest NaN pixels, or of the corners, to divide
    # the annuli, but lets the last one reach over the whole image.
    edge = outer
    if edge is None:
        y, x = np.indices(imgs.shape[1:])
        squared = (x - centers[0][0]) ** 2 + (y - centers[0][1]) ** 2
        bad = np.isnan(imgs[0])
        edge = np.sqrt(np.percentile(squared[bad], 1) if bad.any() else squared.max())
    bounds = [tuple(b) for b in define_annuli_bounds(annuli, inner, edge, spacing)]
    if outer is None:
        bounds[-1] = (bounds[-1][0], imgs.shape[1])
    return Annuli(bounds[0][0], bounds[-1][1], min(b - a for a, b in bounds))


def fill(residual: NDArray[np.float64], good: NDArray[np.bool_]) -> int:
    """Replace pixels of frame minus star (ny, nx) that are not `good` by their neighbours' median.

    In place; returns the number of pixels. Only good neighbours count: a pixel that has none within
    two pixels becomes NaN. NaN pixels stay NaN.
    """
    # The spline that shifts and rotates frames would spread each bad pixel over a dozen others.
    trusted = np.where(good, residual, np.nan)
    flagged = np.argwhere(~good & np.isfinite(residual))
    for y, x in flagged:
        for reach in (1, 2):
            near = trusted[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
            near = near[np.isfinite(near)]
            if near.size:
                break
        residual[y, x] = np.median(near) if near.size else np.nan
    return len(flagged)


def place(
    residual: NDArray[np.float64],
    old_center: NDArray[np.float64],
    new_center: NDArray[np.float64],
    annuli: Annuli,
) -> NDArray[np.float64]:
    """Shift frame minus star (ny, nx) from star x, y `old_center` to `new_center`, and mask it.

    The sigma-clipped median is subtracted.
    """
    from pyklip.klip import align_and_scale

    placed = np.asarray(align_and_scale(residual, new_center=new_center, old_center=old_center))
    y, x = np.indices(placed.shape)
    r = np.hypot(x - new_center[0], y - new_center[1])
    placed[(r < annuli.inner) | (r >= annuli.outer)] = np.nan
    kept = np.isfinite(placed)
    if kept.any():
        # Companions do not change a clipped median. KLIP makes the mean of each section zero, and
        # code that reads its products relies on that.
        placed -= sigma_clipped_stats(placed[kept])[1]
    return placed


def noise_cube(
    frames: NDArray[np.float64],
    center: NDArray[np.float64],
    annuli: Annuli,
    count: int,
    numthreads: int | None,
) -> NDArray[np.float64]:
    """Azimuthal scatter of frames (n, ny, nx) as measured by pyKLIP, (count, n, ny, nx)."""
    from pyklip.parallelized import generate_noise_maps

    maps = generate_noise_maps(
        frames, center, annuli.width, IWA=annuli.inner, OWA=annuli.outer, numthreads=numthreads
    )
    return np.repeat(np.asarray(maps)[np.newaxis], count, axis=0)


def aligned_before(
    imgs: NDArray[Any], centers: NDArray[Any], center: NDArray[np.float64], dtype: Any
) -> NDArray[Any]:
    """Frames for save_aligned, centred: (1, n, ny, nx), for one wavelength."""
    from pyklip.klip import align_and_scale

    frames = [
        align_and_scale(img, new_center=center, old_center=old)
        for img, old in zip(imgs, centers, strict=True)
    ]
    return np.array([frames], dtype=dtype)


# Checks that take a second, before minutes of fitting.


def check_dataset(dataset: Any) -> None:
    """Raise for a dataset without frames or pixels, or with several wavelengths."""
    if np.ndim(dataset.input) != 3:
        raise ShapeError(f"dataset.input: got shape {np.shape(dataset.input)}, expected 3-D")
    require_frames(dataset)
    if not np.isfinite(dataset.input).any():
        raise NoValidPixelsError(
            f"{list(map(str, dataset.filenames))}: every pixel of every frame is NaN, nothing "
            "is left to fit"
        )


def check_arguments(arguments: Mapping[str, Any]) -> None:
    """Raise for arguments of `klip_dataset` that do not go together."""
    dataset, mode = arguments["dataset"], str(arguments["mode"])
    if not any(part in mode.upper() for part in ("ADI", "RDI")):
        raise IncompatibleSetupError(
            f"mode: got {mode!r}, expected 'ADI', or 'RDI' or 'ADI+RDI' with a psf_library: the "
            "star is rendered, so none of them needs references"
        )
    if arguments["calibrate_flux"]:
        from pyklip.instruments.Instrument import Data

        if type(dataset).calibrate_output is Data.calibrate_output:
            raise IncompatibleSetupError(
                f"calibrate_flux: a {type(dataset).__name__} has no flux calibration of its own. "
                "Pass calibrate_flux=False; the products have the unit of the frames"
            )


# Copies of reduced frames to which faint sources were added: self-subtraction without a fit.
#
# A contrast curve by injection reduces the same frames a hundred times, with other planets in each.
# Light that is added to the data changes the star by the image of H^-1 G (light), to first order
# (see `linear.model`), so that the fit to the frames without it is all that is needed. The result
# depends on nothing else, and not on the order of the copies.

_SAME_STAR_PIXELS = 0.01
"""Pixels between the stars in frames and in their copies; centres are single precision."""


def is_linear(subtraction: Subtraction) -> bool:
    """Whether the star is of a single fit that has a linear model."""
    (first, *others) = subtraction.fits
    return not others and getattr(first.result, "linear", None) is not None


def subtract_from_copy(record: ReductionRecord, frames: Frames) -> Subtraction:
    """The star in copies of the frames of `record`, which differ by faint sources.

    Raises IncompatibleSetupError if these are other frames, or their fit has no linear model.
    """
    _require_copy(record, frames)
    before = record.subtraction
    added = frames.data - record.frames.data
    star = before.star.copy()
    # Star of the copy = star + J H^-1 G (added light), where every pointing has the added light
    # that the fit would have averaged. Outside the fitted square only the background changes.
    for result in dict.fromkeys(part.result for part in before.pointings):
        parts = [part for part in before.pointings if part.result is result]
        light = {}
        for part in parts:
            light[part.index] = torch.from_numpy(part.mean_light(added))[None]
        change = result.linear.response(light)[:, 0]
        for part in parts:
            star[part.pointing.frames] += part.change_in_frames(change)
    return replace(before, star=star)


def _require_copy(record: ReductionRecord, frames: Frames) -> None:
    """Raise for frames that are not copies of the reduced ones with a little light added."""
    if not is_linear(record.subtraction):
        raise IncompatibleSetupError(
            "injected_into: its fits have no linear model; reduce it without a `subtractor`"
        )
    now, then = frames.observation, record.frames.observation
    same = now.data.shape == then.data.shape and frames.pixels == record.frames.pixels
    if same:
        difference = np.abs(frames.data - record.frames.data) / then.error
        # Sources change few pixels by more than the noise.
        same = bool(
            np.abs(now.center - then.center).max() < _SAME_STAR_PIXELS
            and np.median(difference[now.valid & then.valid]) < 1
        )
    if not same:
        raise IncompatibleSetupError(
            f"{now.name}: not a copy of the frames of injected_into to which faint sources were "
            "added. Give the dataset that was reduced before the sources were added, read from the "
            "same files"
        )


_log = logging.getLogger(__name__)

RESULTS = "diffrender_results"
"""Attribute of the dataset with its `ReductionRecord`, the only one, after a reduction."""

_FILTERED = "_diffrender_filtered"


class DatasetReduction:
    """A call of `klip_dataset` with ``algo="diffrender"``.

    `arguments` are all of the call, defaults included; `settings` are merged.
    """

    def __init__(self, arguments: Mapping[str, Any], settings: DiffrenderSettings) -> None:
        self.arguments = dict(arguments)
        self.dataset = arguments["dataset"]
        self.settings = settings
        self.record: ReductionRecord | None = None
        self._unfiltered: NDArray[Any] | None = None
        self._filter: Callable[[NDArray[Any]], NDArray[Any]] | None = None

    def run(self, klip_dataset: Callable[..., Callable[..., None]]) -> None:
        """Do the whole call, or raise and leave dataset and output folder as they were.

        `klip_dataset` takes replacements for functions of pyKLIP's module by name, and returns the
        `klip_dataset` that uses them; see `PatchedFunction.original`. Raises DiffrenderError, and
        pyKLIP's own errors.
        """
        before, names = dict(vars(self.dataset)), self.dataset.filenames
        try:
            self._check()
            opd = self._opd()
            folder, prefix = folder_and_prefix(
                self.arguments["outputdir"], self.arguments["fileprefix"]
            )
            # FITS headers, to which pyKLIP writes them, hold ASCII only.
            self.dataset.filenames = np.array([fits_text(n) for n in self.dataset.filenames])
            with staging(folder) as stage:

                def subtract(*args: Any, **kwargs: Any) -> tuple[Any, ...]:
                    subtracted = self._in_place_of_klip(opd, *args, **kwargs)
                    stage.mkdir(exist_ok=True)
                    return subtracted

                reduce = klip_dataset(
                    klip_parallelized=subtract,
                    klip_parallelized_lite=subtract,
                    high_pass_filter_imgs=self._high_pass,
                )
                reduce(**{**self.arguments, "outputdir": str(stage), "fileprefix": prefix})
                assert self.record is not None
                cards = provenance(self.record)
                self._write_extras(self.record, stage, prefix, cards)
                calibrated = bool(self.arguments["calibrate_flux"])
                unit = self.record.frames.observation.unit
                stamp(stage, cards, "" if calibrated else fits_unit(unit))
        except BaseException as error:
            vars(self.dataset).clear()
            vars(self.dataset).update(before)
            _say_on_screen(error)
            raise
        self.dataset.filenames = names
        setattr(self.dataset, RESULTS, (self.record,))
        _log.info("products of %r are in %s", self.arguments["fileprefix"], folder)

    def _check(self) -> None:
        """Raise for input that cannot work, before anything is changed."""
        dataset = self.dataset
        check_dataset(dataset)
        check_arguments(self.arguments)
        if getattr(dataset, _FILTERED, None) is dataset.input:
            raise IncompatibleSetupError(
                "dataset.input was high-pass filtered by an earlier call of klip_dataset, and a "
                "star cannot be fitted to filtered frames. Make the dataset again, or give each "
                "call with highpass=True its own copy.deepcopy(dataset)"
            )
        if self.settings.injected_into is not None and self._before_injection is None:
            raise IncompatibleSetupError(
                "injected_into: it was not reduced. Reduce it with algo='diffrender' before "
                "sources are added"
            )

    def _opd(self) -> OPDMap:
        """The OPD map to start from."""
        before = self._before_injection
        if before is not None:
            return before.opd
        try:
            return starting_opd(self.settings, date_of_frames(self.dataset))
        except IncompatibleSetupError as error:
            reason = why_without_source(self.dataset)
            if reason is not None:
                error.add_note(f"The date is not known, because {reason}")
            raise

    @property
    def _before_injection(self) -> ReductionRecord | None:
        """Record of the dataset that this one copies, before faint sources were added."""
        return next(iter(getattr(self.settings.injected_into, RESULTS, ())), None)

    @property
    def _rdi(self) -> bool:
        return "RDI" in str(self.arguments["mode"]).upper()

    @property
    def _verbose(self) -> bool:
        return bool(self.arguments["verbose"])

    def _tell(self, line: str) -> None:
        """Say what is being done, as pyKLIP does."""
        _log.info(line)
        # Its verbose=True prints, and whoever asks for it has no handler for our log.
        if self._verbose:
            print(f"diffrender: {line}", flush=True)

    def _high_pass(
        self, imgs: NDArray[Any], numthreads: int | None = None, filtersize: float = 10
    ) -> NDArray[Any]:
        """Replace `high_pass_filter_imgs`; keeps the unfiltered frames and the filter."""
        from pyklip.klip import high_pass_filter

        def apply(frame: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(high_pass_filter(np.array(frame), filtersize))

        self._unfiltered = np.array(imgs)
        self._filter = apply
        return np.array([apply(frame) for frame in imgs])

    def _in_place_of_klip(
        self,
        opd: OPDMap,
        imgs: NDArray[Any],
        centers: NDArray[Any],
        parangs: NDArray[Any],
        wvs: NDArray[Any],
        filenums: NDArray[Any],
        IWA: float,
        **kw: Any,
    ) -> tuple[Any, ...]:
        """Replace `pyklip.parallelized.klip_parallelized`, with the same results.

        They are sub_imgs (b, n, ny, nx), one equal slice for each of the b entries of numbasis; x,
        y of the common centre; noise, (b, n, ny, nx) if requested, else ``[1.]``; and, if
        requested, the unsubtracted frames (1, n, ny, nx).
        """
        center = kw.get("aligned_center")
        center = np.mean(centers, axis=0) if center is None else np.asarray(center, dtype=float)
        annuli = annuli_of(
            imgs, centers, IWA, kw.get("OWA"), kw["annuli"], kw.get("annuli_spacing", "constant")
        )
        unfiltered = imgs if self._unfiltered is None else self._unfiltered
        placed = np.full(imgs.shape, np.nan)
        library: tuple[Path, ...] = ()
        if self._rdi and self.arguments["psf_library"] is not None:
            library = library_files(self.dataset, self.arguments["psf_library"])
        if self._rdi and not library and hasattr(self.dataset, ATTRIBUTE):
            warnings.warn(
                "the frames of psf_library are not used, because their files are not known: make "
                "the JWSTData that reads them after register()",
                DiffrenderWarning,
                stacklevel=2,
            )
        frames = frames_of(self.dataset, unfiltered, self.settings, library)
        residuals = self._subtract(frames, opd)
        for i, residual, old_center in zip(
            np.flatnonzero(frames.usable), residuals, frames.observation.center, strict=True
        ):
            placed[i] = place(residual, old_center, center, annuli)
        placed[np.isnan(imgs)] = np.nan

        count = len(np.atleast_1d(kw["numbasis"]))
        # Single precision unless the call says otherwise.
        dtype = np.dtype(kw.get("dtype") or ctypes.c_float)
        # Without a KL cut-off there is one result, but pyKLIP's later steps expect a slice for each
        # entry of numbasis.
        cube = np.repeat(placed.astype(dtype)[np.newaxis], count, axis=0)
        noise: NDArray[Any] = np.array([1.0])
        if kw.get("compute_noise_cube"):
            noise = noise_cube(placed, center, annuli, count, kw.get("numthreads"))
        outputs: tuple[Any, ...] = (cube, list(center), noise)
        if kw.get("save_aligned"):
            outputs += (aligned_before(imgs, centers, center, dtype),)
        return outputs

    def _write_extras(
        self, record: ReductionRecord, stage: Path, prefix: str, cards: fits.Header
    ) -> None:
        """Write what pyKLIP does not: the throughput map, with its median in all products.

        Fits without a linear model have no map, and copies with added sources have the original's.
        """
        if self._before_injection is not None or not is_linear(record.subtraction):
            return
        self._tell("throughput of faint sources")
        (fit,) = record.subtraction.fits
        if record.image == "cleaned":
            throughput = record.images.sky.throughput()
        else:
            throughput = throughput_map(fit.result)
        median = write_throughput(
            stage / f"{prefix}-throughput.fits",
            self.dataset,
            throughput,
            fit.result.frames[0].observation,
            is_turned=not self.arguments["skip_derot"],
        )
        set_keyword(cards, "DRTHRU", median)

    def _image(self, subtraction: Subtraction) -> str:
        """Return which image the products carry."""
        return image_of(self.settings, subtraction)

    def _subtract(self, frames: Frames, opd: OPDMap) -> NDArray[np.float64]:
        """Frames minus star, (m, ny, nx), filtered if asked for."""
        observation, settings = frames.observation, self.settings
        before = self._before_injection
        if before is not None:
            subtraction = subtract_from_copy(before, frames)
        elif settings.subtractor is not None:
            subtraction = settings.subtractor(observation, opd, settings)
        else:
            subtraction = subtract_by_refinement(
                observation,
                opd,
                settings,
                pointings=frames.pointings,
                references=frames.references if self._rdi else (),
                tell=self._tell,
            )
        if subtraction.star.shape != frames.data.shape:
            raise ShapeError(
                f"star: got shape {subtraction.star.shape}, expected {frames.data.shape}"
            )
        residuals = frames.data - subtraction.star
        lost = ~np.any(np.isfinite(residuals) & observation.valid, axis=(1, 2))
        if lost.any():
            raise RefinementError(
                f"{observation.name}: the rendered star has no finite pixel in {int(lost.sum())} "
                "frames",
                subtraction.worst.result,
            )
        filled = sum(map(fill, residuals, observation.valid))
        image = self._image(subtraction)
        self.record = ReductionRecord(frames, opd, subtraction, filled, image)
        if image != "subtracted":
            self._tell(f"image of the products: {image}")
            # The model of the sky is the fit's, also for copies with added sources.
            original = self.record if before is None else before
            added = None if before is None else frames.data - before.frames.data
            original.images.put_into(residuals, added)
        if self._filter is not None:
            residuals = np.array([self._filter(residual) for residual in residuals])
        return residuals


def _say_on_screen(error: BaseException) -> None:
    """Print an error while stderr goes to memory, as in spaceKLIP while it injects sources."""
    if isinstance(sys.stderr, io.StringIO) and sys.__stderr__ is not None:
        print(f"diffrender: {type(error).__name__}: {error}", file=sys.__stderr__)


def mark_filtered(dataset: Any) -> None:
    """Mark ``dataset.input`` as filtered; the mark is kept in deep copies."""
    setattr(dataset, _FILTERED, dataset.input)


# One call of `pyklip.fm.klip_dataset` in which the star is rendered.
#
# As for `parallelized.klip_dataset`, pyKLIP checks the arguments, collapses, and writes the files.
# Its `klip_parallelized` of `pyklip.fm` also turns the frames to north.


class ForwardReduction(DatasetReduction):
    """A call of `pyklip.fm.klip_dataset` for this backend; see `DatasetReduction`."""

    def __init__(self, arguments: Mapping[str, Any], settings: DiffrenderSettings) -> None:
        super().__init__(arguments, settings)
        self.fm_class = arguments["fm_class"]
        self._planet_cards = fits.Header()

    def _check(self) -> None:
        check_forward_model(self.fm_class, self.settings)
        super()._check()

    def _image(self, subtraction: Subtraction) -> str:
        """Return "subtracted": the forward model is for a planet in the frames minus star."""
        return "subtracted"

    @property
    def _verbose(self) -> bool:
        return not self.arguments["mute_progression"]

    def _write_extras(
        self, record: ReductionRecord, stage: Path, prefix: str, cards: fits.Header
    ) -> None:
        """Add what the fit says of the planet; the forward model says how much is left of it."""
        cards.extend(self._planet_cards)

    def _in_place_of_klip(  # type: ignore[override]
        self,
        opd: OPDMap,
        imgs: NDArray[Any],
        centers: NDArray[Any],
        parangs: NDArray[Any],
        wvs: NDArray[Any],
        IWA: float,
        *args: Any,
        **kw: Any,
    ) -> tuple[Any, ...]:
        """Replace `pyklip.fm.klip_parallelized`, with the same results.

        They are sub_imgs, fmout, perturbmag, the common centre (x, y), and noise. The first two are
        (b, n, ny, nx), turned to north: one equal slice for each of the b entries of numbasis.
        perturbmag is (n, b), the largest change of the star because of the planet over the standard
        deviation of the star. Without a planet, it and fmout are None. Noise is (b, n, ny, nx) if
        requested, else ``[1.]``.
        """
        unturned, center, noise = super()._in_place_of_klip(
            opd, imgs, centers, parangs, wvs, np.arange(len(imgs)), IWA, **kw
        )
        cube = _turned(unturned[0], parangs, center, kw["flipx"])
        hidden, count = np.isnan(cube), len(unturned)
        if noise.ndim > 1:
            noise = _repeated(_turned(noise[0], parangs, center, kw["flipx"]), hidden, count)
        fmout, perturbmag = None, None
        if is_planet(self.fm_class):
            planets, taken = self._planets(imgs.shape, parangs, wvs, np.array(center), kw["flipx"])
            # The spline that turns frames depends on which pixels are masked.
            planets[np.isnan(unturned[0])] = np.nan
            turned = _turned(planets, parangs, center, kw["flipx"])
            fmout = _repeated(turned.astype(unturned.dtype), hidden, count)
            perturbmag = np.repeat(taken[:, np.newaxis], count, axis=1)
        return (
            _repeated(cube.astype(unturned.dtype), hidden, count),
            fmout,
            perturbmag,
            center,
            noise,
        )

    def _planets(
        self,
        shape: tuple[int, ...],
        parangs: NDArray[Any],
        wvs: NDArray[Any],
        center: NDArray[np.float64],
        flipx: bool,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The planet in all frames (n, ny, nx), star at `center`, and how much the star took."""
        from pyklip.klip import align_and_scale

        self._tell("forward model of the planet")
        images, taken = np.full(shape, np.nan), np.full(shape[0], np.nan)
        record = self.record
        assert record is not None
        frames = np.flatnonzero(record.frames.usable)
        planets = planet_in_frames(
            self.fm_class,
            record.subtraction.pointings,
            frames,
            parangs[frames],
            wvs[0],
            flipx,
            self._filter,
        )
        first = next(part for part in record.subtraction.pointings if part.index == 0)
        k, reduction = int(first.pointing.frames[0]), record.subtraction.reduction
        self._planet_cards = planet_cards(
            first,
            planets[k],
            parangs[frames[k]],
            flipx,
            None if reduction is None else reduction.detection.error_factor,
        )
        for k, planet in planets.items():
            fill(planet.left, record.frames.observation.valid[k])
            image = planet.left if self._filter is None else self._filter(planet.left)
            images[frames[k]] = align_and_scale(image, new_center=center, old_center=planet.center)
            taken[frames[k]] = planet.taken
        return images, taken


def _turned(
    frames: NDArray[Any], angles: NDArray[Any], center: Any, flipx: bool
) -> NDArray[np.float64]:
    """Frames turned to north by pyKLIP."""
    from pyklip.klip import rotate

    return np.array(
        [
            rotate(np.asarray(frame, dtype=np.float64), angle, center, flipx=flipx)
            for frame, angle in zip(frames, angles, strict=True)
        ]
    )


def _repeated(frames: NDArray[Any], hidden: NDArray[np.bool_], count: int) -> NDArray[Any]:
    """Equal slices (count, n, ny, nx), NaN where the subtracted frames are."""
    return np.repeat(np.where(hidden, np.nan, frames)[np.newaxis], count, axis=0)
