"""One call of `klip_dataset` in which the star is rendered instead of estimated from references.

pyKLIP still checks the arguments, derotates, collapses, and writes the files. For the duration of
the call only `klip_parallelized` (and its lite version) is replaced by a function with the same
interface, and `high_pass_filter_imgs` by one that keeps the unfiltered frames for the fit.
"""

from __future__ import annotations

import dataclasses
import io
import logging
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    RefinementError,
    ShapeError,
)
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.keywords import set_keyword
from pyklip_diffrender.pyklip_backend.admitted import library_files
from pyklip_diffrender.pyklip_backend.backend_settings import (
    DiffrenderSettings,
    starting_opd,
    thread_limit,
)
from pyklip_diffrender.pyklip_backend.checks import (
    check_arguments,
    check_dataset,
    check_settings,
)
from pyklip_diffrender.pyklip_backend.dataset_frames import Frames, date_of_frames, frames_of
from pyklip_diffrender.pyklip_backend.injections import subtract_from_copy
from pyklip_diffrender.pyklip_backend.klip_frames import (
    aligned_before,
    annuli_of,
    fill,
    noise_cube,
    place,
    slices,
)
from pyklip_diffrender.pyklip_backend.output_files import (
    ReductionRecord,
    folder_and_prefix,
    provenance,
    staging,
    stamp,
)
from pyklip_diffrender.pyklip_backend.product_images import image_of
from pyklip_diffrender.pyklip_backend.source import ATTRIBUTE, attach_source
from pyklip_diffrender.pyklip_backend.subtract import Subtraction, subtract_by_refinement
from pyklip_diffrender.pyklip_backend.throughput import throughput_map, write_throughput
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["RESULTS", "DatasetReduction", "mark_filtered"]

logger = logging.getLogger(__name__)

RESULTS = "diffrender_results"
"""Attribute of the dataset with one `ReductionRecord` per wavelength after a reduction."""

_FILTERED = "_diffrender_filtered"


class DatasetReduction:
    """A call of `klip_dataset` with ``algo="diffrender"``.

    Parameters
    ----------
    arguments : mapping
        All arguments of the call, defaults included.
    settings : DiffrenderSettings
        Merged settings of the call, the dataset and the registration.
    """

    def __init__(self, arguments: Mapping[str, Any], settings: DiffrenderSettings) -> None:
        self.arguments = dict(arguments)
        self.dataset = arguments["dataset"]
        self.settings = settings
        self.records: list[ReductionRecord] = []
        self._unfiltered: NDArray[Any] | None = None
        self._filter: Callable[[NDArray[Any]], NDArray[Any]] | None = None

    def run(self, klip_dataset: Callable[..., Callable[..., None]]) -> None:
        """Do the whole call, or raise and leave dataset and output folder as they were.

        Parameters
        ----------
        klip_dataset : callable
            Takes replacements for functions of pyKLIP's module by name, and returns pyKLIP's
            `klip_dataset` using these; see `PatchedFunction.original`.

        Raises
        ------
        DiffrenderError
            For bad input and failed fits. pyKLIP's own errors pass through.
        """
        before, names = dict(vars(self.dataset)), self.dataset.filenames
        try:
            attach_source(self.dataset, self.settings.files)
            self._check()
            opd = self._opd()
            folder, prefix = folder_and_prefix(
                self.arguments["outputdir"], self.arguments["fileprefix"]
            )
            # FITS headers, to which pyKLIP writes them, hold ASCII only.
            self.dataset.filenames = np.array([fits_text(n) for n in self.dataset.filenames])
            with staging(folder) as stage, thread_limit(self.settings.threads):

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
                cards = provenance(self.records)
                self._write_extras(stage, prefix, cards)
                stamp(stage, cards)
        except BaseException as error:
            vars(self.dataset).clear()
            vars(self.dataset).update(before)
            _say_on_screen(error)
            raise
        self.dataset.filenames = names
        setattr(self.dataset, RESULTS, tuple(self.records))
        logger.info("products of %r are in %s", self.arguments["fileprefix"], folder)

    def _check(self) -> None:
        """Raise for input that cannot work, before anything is changed."""
        dataset = self.dataset
        check_dataset(dataset)
        check_arguments(self.arguments)
        check_settings(self.settings)
        for wave in np.unique(dataset.wvs):
            self._settings_at(wave)
        if getattr(dataset, _FILTERED, None) is dataset.input:
            raise IncompatibleSetupError(
                "dataset.input was high-pass filtered by an earlier call of klip_dataset, and a "
                "star cannot be fitted to filtered frames. Make the dataset again, or give each "
                "call with highpass=True its own copy.deepcopy(dataset)"
            )

        if self.settings.injected_into is not None:
            count, expected = len(self._before_injection), len(np.unique(dataset.wvs))
            if count != expected:
                raise IncompatibleSetupError(
                    f"injected_into: it was reduced at {count} wavelengths, and this dataset has "
                    f"{expected}. Reduce it with algo='diffrender' before sources are added"
                )

    def _opd(self) -> OPDMap:
        """The wavefront map to start from."""
        before = self._before_injection
        if before:
            return before[0].opd
        return starting_opd(self.settings, date_of_frames(self.dataset))

    @property
    def _before_injection(self) -> Sequence[ReductionRecord]:
        """How the dataset was reduced of which this one is a copy with faint sources."""
        return getattr(self.settings.injected_into, RESULTS, ())

    @property
    def _rdi(self) -> bool:
        return "RDI" in str(self.arguments["mode"]).upper()

    def _reference_files(self) -> tuple[Path, ...]:
        """Files of the reference frames that the call gives."""
        library = self.arguments["psf_library"]
        if library is None or not self._rdi:
            return ()
        return library_files(self.dataset, library)

    @property
    def _verbose(self) -> bool:
        return bool(self.arguments["verbose"])

    def _tell(self, line: str) -> None:
        """Say what is being done, as pyKLIP does."""
        logger.info(line)
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

    def _in_place_of_klip(self, opd: OPDMap, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Do what the `klip_parallelized` of the patched module does."""
        return self._klip_parallelized(opd, *args, **kwargs)

    def _klip_parallelized(
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
        """Replace `pyklip.parallelized.klip_parallelized`.

        Returns
        -------
        sub_imgs : ndarray
            (b, n, ny, nx), one equal slice for each of the b entries of numbasis.
        aligned_center : sequence
            [x, y] of their common centre.
        noise : ndarray
            (b, n, ny, nx) if requested, else ``[1.]``.
        aligned : ndarray
            (wavelengths, n, ny, nx) unsubtracted frames, if requested.
        """
        index = np.flatnonzero(np.isin(self.dataset.wvs, np.unique(wvs)))
        center = kw.get("aligned_center")
        center = np.mean(centers, axis=0) if center is None else np.asarray(center, dtype=float)
        annuli = annuli_of(
            imgs, centers, IWA, kw.get("OWA"), kw["annuli"], kw.get("annuli_spacing", "constant")
        )
        unfiltered = imgs if self._unfiltered is None else self._unfiltered[index]
        placed = np.full(imgs.shape, np.nan)
        library = self._reference_files()
        if self._rdi and not library and hasattr(self.dataset, ATTRIBUTE):
            warnings.warn(
                "the frames of psf_library are not used, because their files are not known: make "
                "the JWSTData that reads them after register()",
                DiffrenderWarning,
                stacklevel=2,
            )
        gathered = []
        # All files are judged before the first fit.
        for wave in np.unique(wvs):
            of_wave, settings = np.flatnonzero(wvs == wave), self._settings_at(wave)
            frames = frames_of(self.dataset, index[of_wave], unfiltered[of_wave], settings, library)
            gathered.append((of_wave, frames, settings))
        for of_wave, frames, settings in gathered:
            residuals = self._subtract(frames, opd, settings)
            for i, residual, old_center in zip(
                of_wave[frames.usable], residuals, frames.observation.center, strict=True
            ):
                placed[i] = place(residual, old_center, center, annuli)
        placed[np.isnan(imgs)] = np.nan

        count, dtype = len(np.atleast_1d(kw["numbasis"])), kw.get("dtype")
        noise: NDArray[Any] = np.array([1.0])
        if kw.get("compute_noise_cube"):
            noise = noise_cube(placed, center, annuli, count, kw.get("numthreads"))
        outputs: tuple[Any, ...] = (slices(placed, count, dtype), list(center), noise)
        if kw.get("save_aligned"):
            outputs += (aligned_before(imgs, centers, wvs, center, dtype),)
        return outputs

    def _write_extras(self, stage: Path, prefix: str, cards: fits.Header) -> None:
        """Write what pyKLIP does not: the throughput map, with its median in all products.

        Fits without a linear model have none, and copies with added sources that of the original.
        """
        if self._before_injection:
            return
        results = [fit.result for record in self.records for fit in record.subtraction.fits]
        linear = all(getattr(result, "linear", None) is not None for result in results)
        if not linear or len(results) != len(self.records):
            return
        self._tell("throughput of faint sources")
        median = write_throughput(
            stage / f"{prefix}-throughput.fits",
            self.dataset,
            list(map(self._throughput, self.records, results)),
            [result.frames[0].observation for result in results],
            is_turned=not self.arguments["skip_derot"],
        )
        set_keyword(cards, "DRTHRU", median)

    def _throughput(self, record: ReductionRecord, result: Any) -> NDArray[np.float64]:
        """Fraction of a faint source's peak that the products have, on the first frame's pixels."""
        if record.image == "cleaned":
            return record.images.sky.throughput()
        if record.image == "flux":
            return np.ones(result.frames[0].grid.shape[:2])  # It is marginalised over the star.
        return throughput_map(result)

    def _image(self, subtraction: Subtraction) -> str:
        """Return which image the products carry."""
        return image_of(self.settings, subtraction)

    def _settings_at(self, wave: float) -> DiffrenderSettings:
        """The settings with the model for this wavelength."""
        model = self.settings.model
        if not isinstance(model, Mapping):
            if model is not None and len(np.unique(self.dataset.wvs)) > 1:
                raise IncompatibleSetupError(
                    f"model: the dataset has wavelengths {np.unique(self.dataset.wvs)} and one "
                    "model was given. Give a mapping from wavelength to model"
                )
            return self.settings
        for key, value in model.items():
            if np.isclose(float(key), wave, rtol=1e-6, atol=0.0):
                return dataclasses.replace(self.settings, model=value)
        raise IncompatibleSetupError(f"model: none for wavelength {wave}, only for {list(model)}")

    def _subtract(
        self, frames: Frames, opd: OPDMap, settings: DiffrenderSettings
    ) -> NDArray[np.float64]:
        """Subtract the star from frames; high-pass filtered if the call asks for it.

        Returns
        -------
        ndarray, (m, ny, nx)
            In the unit of ``dataset.input``.
        """
        observation = frames.observation
        before = self._before_injection
        if before:
            subtraction = subtract_from_copy(before[len(self.records)], frames)
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
        record = ReductionRecord(frames, opd, subtraction, filled, image)
        if image != "subtracted":
            self._tell(f"image of the products: {image}")
            # The model of the sky is that of the fit, also for copies with added sources.
            original = before[len(self.records)] if before else record
            added = frames.data - original.frames.data if before else None
            original.images.put_into(residuals, image, added)
        self.records.append(record)
        residuals *= frames.factor[:, np.newaxis, np.newaxis]
        if self._filter is not None:
            residuals = np.array([self._filter(residual) for residual in residuals])
        return residuals


def _say_on_screen(error: BaseException) -> None:
    """Print an error while stderr goes to memory.

    spaceKLIP does that while it injects sources, so that nobody would see what ended the program.
    """
    if isinstance(sys.stderr, io.StringIO) and sys.__stderr__ is not None:
        print(f"diffrender: {type(error).__name__}: {error}", file=sys.__stderr__)


def mark_filtered(dataset: Any) -> None:
    """Mark ``dataset.input`` as filtered; the mark is kept in deep copies."""
    setattr(dataset, _FILTERED, dataset.input)
