"""One `klip_dataset` call in which the star is rendered instead of estimated from references.

pyKLIP goes on doing what it does: it checks the arguments, derotates, collapses, and has the
dataset write the files. Only `klip_parallelized` (and its lite twin) is another function for the
duration of the call, with the same contract; `high_pass_filter_imgs` is followed so that the fit
sees frames before they are filtered.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    IncompatibleSetupError,
    NoValidPixelsError,
    RefinementError,
    ShapeError,
)
from pyklip_diffrender.pyklip_backend.frames import Frames, frames_of
from pyklip_diffrender.pyklip_backend.placement import (
    aligned_before,
    annuli_of,
    fill,
    noise_cube,
    place,
    slices,
)
from pyklip_diffrender.pyklip_backend.products import (
    Made,
    provenance,
    require_folder,
    staging,
    stamp,
)
from pyklip_diffrender.pyklip_backend.settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.subtract import subtract_by_refinement
from pyklip_diffrender.pyklip_backend.wavefront import starting_opd
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["RESULTS", "Reduction", "mark_filtered"]

logger = logging.getLogger(__name__)

RESULTS = "diffrender_results"
"""Attribute of the dataset with one `Made` for each wavelength after a reduction."""

_FILTERED = "_diffrender_filtered"


class Reduction:
    """A call of `klip_dataset` with ``algo="diffrender"``.

    Parameters
    ----------
    arguments : mapping
        All arguments of the call, defaults included.
    settings : DiffrenderSettings
        What the call, the dataset and the registration say together.
    """

    def __init__(self, arguments: Mapping[str, Any], settings: DiffrenderSettings) -> None:
        self.arguments = dict(arguments)
        self.dataset = arguments["dataset"]
        self.settings = settings
        self.made: list[Made] = []
        self._unfiltered: NDArray[Any] | None = None
        self._filter: Callable[[NDArray[Any]], NDArray[Any]] | None = None

    def run(self, klip_dataset: Callable[..., Callable[..., None]]) -> None:
        """Do the whole call, or raise and leave dataset and output folder as they were.

        Parameters
        ----------
        klip_dataset : callable
            Gives pyKLIP's own `klip_dataset` when it is called with the functions to use in it in
            place of those of the same name in its module.

        Raises
        ------
        DiffrenderError
            For bad input and failed fits; also what pyKLIP raises on its arguments.
        """
        self._check()
        opd = starting_opd(self.settings.opd)
        folder = require_folder(self.arguments["outputdir"])
        before = dict(vars(self.dataset))

        def subtract(*args: Any, **kwargs: Any) -> tuple[Any, ...]:
            return self._klip_parallelized(opd, *args, **kwargs)

        reduce = klip_dataset(
            klip_parallelized=subtract,
            klip_parallelized_lite=subtract,
            high_pass_filter_imgs=self._high_pass,
        )
        try:
            with staging(folder) as stage:
                reduce(**{**self.arguments, "outputdir": str(stage)})
                stamp(stage, provenance(self.made))
        except BaseException:
            vars(self.dataset).clear()
            vars(self.dataset).update(before)
            raise
        setattr(self.dataset, RESULTS, tuple(self.made))
        logger.info("products of %r are in %s", self.arguments["fileprefix"], folder)

    def _check(self) -> None:
        """Find what cannot work before anything is changed."""
        dataset, mode = self.dataset, str(self.arguments["mode"])
        if np.ndim(dataset.input) != 3:
            raise ShapeError(f"dataset.input: got shape {np.shape(dataset.input)}, expected 3-D")
        if len(dataset.input) == 0:
            raise NoValidPixelsError(
                "the dataset has no frames; check the list of files it was given"
            )
        if not np.isfinite(dataset.input).any():
            raise NoValidPixelsError(
                f"{list(map(str, dataset.filenames))}: every pixel of every frame is NaN, nothing "
                "is left to fit"
            )
        if not any(part in mode.upper() for part in ("ADI", "RDI", "SDI")):
            raise IncompatibleSetupError(
                f"mode: got {mode!r}, expected ADI, RDI, SDI or a sum of them such as 'ADI+RDI'"
            )
        if mode.strip().upper() == "SDI" and len(np.unique(dataset.wvs)) == 1:
            raise IncompatibleSetupError(
                "mode: 'SDI' compares wavelengths, and this dataset has one. Use mode='ADI', or "
                "mode='RDI' with a psf_library: the star is rendered, so neither needs references"
            )
        if getattr(dataset, _FILTERED, None) is dataset.input:
            raise IncompatibleSetupError(
                "dataset.input was high-pass filtered by an earlier call of klip_dataset, and a "
                "star cannot be fitted to filtered frames. Make the dataset again, or give each "
                "call with highpass=True its own copy.deepcopy(dataset)"
            )

    def _high_pass(
        self, imgs: NDArray[Any], numthreads: int | None = None, filtersize: float = 10
    ) -> NDArray[Any]:
        """Stand in for `high_pass_filter_imgs`: remember the frames and the filter."""
        from pyklip.klip import high_pass_filter

        def apply(frame: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(high_pass_filter(np.array(frame), filtersize))

        self._unfiltered = np.array(imgs)
        self._filter = apply
        return np.array([apply(frame) for frame in imgs])

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
        """Stand in for `pyklip.parallelized.klip_parallelized`.

        Returns
        -------
        sub_imgs : ndarray
            (b, n, ny, nx), one equal slice for each of the b entries of numbasis.
        aligned_center : sequence
            [x, y] on which all of them are centred.
        noise : ndarray
            (b, n, ny, nx) if asked for, else ``[1.]``.
        aligned : ndarray
            (wavelengths, n, ny, nx) frames before the subtraction, if asked for.
        """
        index = np.flatnonzero(np.isin(self.dataset.wvs, np.unique(wvs)))
        center = kw.get("aligned_center")
        center = np.mean(centers, axis=0) if center is None else np.asarray(center, dtype=float)
        annuli = annuli_of(
            imgs, centers, IWA, kw.get("OWA"), kw["annuli"], kw.get("annuli_spacing", "constant")
        )
        unfiltered = imgs if self._unfiltered is None else self._unfiltered[index]
        placed = np.full(imgs.shape, np.nan)
        for wave in np.unique(wvs):
            which = np.flatnonzero(wvs == wave)
            frames = frames_of(
                self.dataset, index[which], unfiltered[which], self._settings_at(wave)
            )
            residual = self._subtract(frames, opd, self._settings_at(wave))
            for i, frame, old in zip(which, residual, frames.centers, strict=True):
                placed[i] = place(frame, old, center, annuli)
        placed[np.isnan(imgs)] = np.nan

        count, dtype = len(np.atleast_1d(kw["numbasis"])), kw.get("dtype")
        noise: NDArray[Any] = np.array([1.0])
        if kw.get("compute_noise_cube"):
            maps = noise_cube(placed, center, annuli, kw.get("numthreads"))
            noise = np.repeat(maps[np.newaxis], count, axis=0)
        outputs: tuple[Any, ...] = (slices(placed, count, dtype), list(center), noise)
        if kw.get("save_aligned"):
            outputs += (aligned_before(imgs, centers, wvs, center, dtype),)
        return outputs

    def _settings_at(self, wave: float) -> DiffrenderSettings:
        """The settings with the one model for this wavelength."""
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
        """Frames minus their star, (n, ny, nx), filtered if the call asks for it."""
        usable = frames.usable()
        subtractor = settings.subtractor or subtract_by_refinement
        found = subtractor(frames.observation(usable), opd, settings)
        residual = np.full(frames.data.shape, np.nan)
        if found.star.shape != residual[usable].shape:
            raise ShapeError(
                f"star: got shape {found.star.shape}, expected {residual[usable].shape}"
            )
        residual[usable] = frames.data[usable] - found.star
        lost = usable & ~np.any(np.isfinite(residual) & frames.valid, axis=(1, 2))
        if lost.any():
            raise RefinementError(
                f"{frames.name}: the rendered star has no finite pixel in {int(lost.sum())} frames",
                found.worst.result,
            )
        filled = sum(fill(residual[i], frames.valid[i]) for i in np.flatnonzero(usable))
        self.made.append(Made(frames, opd, found, filled))
        if self._filter is not None:
            for i in np.flatnonzero(usable):
                residual[i] = self._filter(residual[i])
        return residual


def mark_filtered(dataset: Any) -> None:
    """Remember that ``dataset.input`` is filtered; a deep copy remembers it too."""
    setattr(dataset, _FILTERED, dataset.input)
