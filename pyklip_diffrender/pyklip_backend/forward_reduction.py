"""One call of `pyklip.fm.klip_dataset` in which the star is rendered.

As for `parallelized.klip_dataset`, pyKLIP checks the arguments, collapses, and writes the files.
Its `klip_parallelized` of `pyklip.fm` also turns the frames to north.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.forward_model import (
    check_forward_model,
    is_planet,
    planet_in_frames,
)
from pyklip_diffrender.pyklip_backend.klip_call import DatasetReduction
from pyklip_diffrender.pyklip_backend.klip_frames import fill
from pyklip_diffrender.pyklip_backend.planet_fit import planet_cards
from pyklip_diffrender.pyklip_backend.subtract import Subtraction
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["ForwardReduction"]


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
        """Return "subtracted": the forward model is that of a planet in the frames minus star."""
        return "subtracted"

    @property
    def _verbose(self) -> bool:
        return not self.arguments["mute_progression"]

    def _write_extras(self, stage: Path, prefix: str, cards: fits.Header) -> None:
        """Add what the fit says of the planet; the forward model says how much is left of it."""
        cards.extend(self._planet_cards)

    def _in_place_of_klip(
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
        """Replace `pyklip.fm.klip_parallelized`.

        Returns
        -------
        sub_imgs : ndarray
            (b, n, ny, nx), turned to north; one equal slice for each entry of numbasis.
        fmout : ndarray or None
            The planet in them, likewise.
        perturbmag : ndarray or None
            (n, b) largest change of the star because of the planet, over the standard deviation of
            the star.
        aligned_center : sequence
            [x, y] of their common centre.
        noise : ndarray
            (b, n, ny, nx) if requested, else ``[1.]``.
        """
        unturned, center, noise = self._klip_parallelized(
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
        """The planet in all frames (n, ny, nx), star at `center`, and how much the star took.

        Its image goes through all steps that the frames went through.
        """
        from pyklip.klip import align_and_scale

        self._tell("forward model of the planet")
        images, taken = np.full(shape, np.nan), np.full(shape[0], np.nan)
        for record, wave in zip(self.records, np.unique(wvs), strict=True):
            frames = np.flatnonzero(wvs == wave)[record.frames.usable]
            planets = planet_in_frames(
                self.fm_class,
                record.subtraction.pointings,
                frames,
                parangs[frames],
                wave,
                flipx,
                self._filter,
            )
            if len(self.records) == 1:
                first = next(part for part in record.subtraction.pointings if part.index == 0)
                k, reduction = int(first.pointing.frames[0]), record.subtraction.reduction
                self._planet_cards = planet_cards(
                    first,
                    replace(planets[k], contrast=planets[k].contrast / record.frames.factor[k]),
                    parangs[frames[k]],
                    flipx,
                    None if reduction is None else reduction.detection.error_factor,
                )
            for k, planet in planets.items():
                fill(planet.left, record.frames.observation.valid[k])
                image = planet.left if self._filter is None else self._filter(planet.left)
                images[frames[k]] = align_and_scale(
                    image, new_center=center, old_center=planet.center
                )
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
