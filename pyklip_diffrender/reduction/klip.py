"""KLIP by pyKLIP, for comparisons: subtracted frames, and their contrast curve (ADI and RDI).

An observer without a model of the telescope would get it. The planets that are added to the frames,
to measure how much of them KLIP leaves, have the images and the star of the model.
"""

from __future__ import annotations

import contextlib
import io
import math
import tempfile
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray
from pyklip.klip import klip_math, rotate
from scipy.ndimage import map_coordinates

from pyklip_diffrender.detection import Detection
from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.field import pixels_of
from pyklip_diffrender.detection.tails import student_snr
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.progress import counted
from pyklip_diffrender.io.tables import add_columns
from pyklip_diffrender.io.units import to_arcsec
from pyklip_diffrender.optics.grid import fft_convolve
from pyklip_diffrender.scene.aligned_frames import shift_frames
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.star_place import without_gaps

Image = NDArray[np.float64]

_LIMIT_SNR = 5.0

_MOST_KL_MODES = 5
"""Largest number of KL modes."""

_INNER_RADIUS_LAMBDA_D = 1.4
"""Radius in lambda/D within which KLIP does not subtract the star."""

_TRIALS = 4
"""Position angles at which planets are injected at every separation."""

_OTHER_ROLL_DEG = 1.0
"""Degrees between rolls that are references of each other."""

_FILTER_HALF_PIXELS = 10
"""Pixels from the middle of the matched filter to its edge."""

_CLOSE_PIXELS = 1.5
"""Pixels about the position of an injected planet in which its peak is sought."""


def klip_rdi(target: Image, references: Image) -> Image:
    """Subtract the star from `target` (ny, nx) with nine modes of pyKLIP's RDI.

    The star is in the middle of the array; `references` are (frames, ny, nx). The result, (ny, nx),
    is NaN in the innermost pixel and outside the largest annulus.
    """
    from pyklip import rdi
    from pyklip.instruments.Instrument import GenericData
    from pyklip.parallelized import klip_dataset

    ny, nx = target.shape
    center = np.array([(nx - 1) / 2, (ny - 1) / 2])
    stack = np.concatenate([target[None], references])
    names = np.array(["target"] + [f"reference {k}" for k in range(len(references))])
    dataset = GenericData(
        target[None].copy(),
        center[None],
        parangs=np.zeros(1),
        wvs=np.array([4.5e-6]),
        IWA=1.0,
        filenames=names[:1],
    )
    # pyKLIP prints messages and a progress bar.
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        library = rdi.PSFLibrary(stack, center, names, compute_correlation=True)
        library.prepare_library(dataset)
        klip_dataset(
            dataset,
            mode="RDI",
            outputdir=folder,
            fileprefix="klip",
            annuli=5,
            subsections=4,
            numbasis=[9],
            movement=0,
            psf_library=library,
            aligned_center=center,
            numthreads=1,
            algo="klip",
            verbose=False,
        )
        return np.array(dataset.output[0, 0, 0], dtype=np.float64)


def klip_curve(
    detection: Detection, references: Sequence[Observation] = (), separations: Any = None
) -> QTable:
    """5-sigma contrast curve of KLIP for the frames that were searched.

    Columns are as of `Detection.contrast_curve`; a contrast is NaN where no light of a planet is
    left or the detection has no limits, and throughput the fraction of a planet's image behind the
    mask. `references` are cut to the same pixels; `separations` are in arcsec, by default twelve
    from 2 lambda/D to the edge. Raises IncompatibleSetupError if a roll has no references, or no
    separation is in the frames.
    """
    templates, resolution = detection.templates, detection.contrast_curve.meta["resolution_arcsec"]
    # The light of all candidates is subtracted first, whether the fit has them as companions or
    # only the search found them: they are noise of neither method.
    klip = KlipSubtraction(templates, references, resolution, candidates=detection.sources)
    # The corners' smaller coordinates.
    edge = np.abs(klip.grid[[0, -1], [0, -1]]).min() - resolution / 2
    if separations is None:
        separations = np.geomspace(2 * resolution, max(edge, 2 * resolution), 12)
    separations = np.atleast_1d(to_arcsec(separations, "separations"))
    separations = separations[separations <= edge]
    if not len(separations):
        raise IncompatibleSetupError(
            f"separations: got none within {edge:.3g} arcsec, where rings are complete"
        )
    plain = klip.images(klip.science)
    has_limits = _has_limits(detection, klip.grid)
    rings = [has_limits & (np.abs(klip.distance - each) < resolution / 2) for each in separations]
    # No pixels, no noise, as in a ring inside KLIP's mask.
    noise = np.array(
        [[image[ring].std() if ring.any() else 0.0 for ring in rings] for image in plain]
    )
    # limit = 5 noise / response, with the noise in a ring of width lambda/D, where the detection
    # has limits, and the response to an injected planet of contrast 1. At every separation the
    # number of modes is the one with the best limit.
    # So faint that the modes hardly change.
    contrasts = _LIMIT_SNR * noise.min(axis=0) / klip.norm
    response, alone = np.zeros_like(noise), np.zeros(len(separations))
    for s, separation in enumerate(separations):
        # Evenly spread at every separation, and from one separation to the next by the golden
        # angle, 137.5 degrees, so that no direction is preferred.
        angles = np.radians(137.5 * s + 360 / _TRIALS * np.arange(_TRIALS))
        wanted = separation * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        rows, columns = np.array([klip.pixel(each) for each in wanted]).T
        light = templates.at_pixels(rows, columns)
        alone[s] = light[0].double().square().sum(dim=(1, 2)).sqrt().mean()
        # One by one: near the mask the wings of planets farther out are as bright as what is left.
        for n, place in enumerate(templates.grid[rows, columns]):
            planets = contrasts[s] * np.array([each[n].double().numpy() for each in light.values()])
            added = klip.science + shift_frames(planets, klip.shifts)
            changes = klip.images(added) - plain
            close = (
                np.hypot(*np.moveaxis(klip.grid - place, -1, 0)) < _CLOSE_PIXELS * klip.pixelscale
            )
            response[:, s] += changes[:, close].max(axis=1) / _TRIALS
    # No noise, no planet: a ring inside KLIP's mask.
    response = np.divide(response, contrasts, out=np.zeros_like(response), where=contrasts > 0)
    useful = (response > 0) & (noise > 0)
    limits = np.divide(_LIMIT_SNR * noise, response, out=np.full_like(noise, np.inf), where=useful)
    best = limits.argmin(axis=0), np.arange(len(separations))
    limit = np.where(np.isfinite(limits[best]), limits[best], np.nan)
    corrected = limit * small_sample_factor(separations, resolution, _LIMIT_SNR)
    label = klip.label(klip.modes[0], klip.modes[-1])
    return add_columns(
        QTable(meta={"sigmas": _LIMIT_SNR, "resolution_arcsec": resolution, "label": label}),
        [
            ("separation", separations, u.arcsec, ".3f", "from the star"),
            ("contrast", limit, None, ".2e", "limit with the best number of modes"),
            ("small_sample", corrected, None, ".2e", "limit with the small-sample correction"),
            ("modes", best[0] + 1, None, "", "best number of modes"),
            ("throughput", response[best] / alone, None, ".2f", "of injected planets"),
        ],
    )


def _has_limits(detection: Detection, grid: Image) -> NDArray[np.bool_]:
    """Where a detection has limits, on another grid, (ny, nx)."""
    columns, rows = np.moveaxis(pixels_of(detection.grid, grid), -1, 0)
    known = detection.has_limits.astype(float)
    return map_coordinates(known, [rows, columns], order=0, mode="grid-constant") > 0


def klip_image(
    detection: Detection,
    references: Sequence[Observation],
    science: Sequence[Observation] | None,
    modes: int,
) -> tuple[Image, Image, str]:
    """Subtract the star from the frames that were searched with KLIP, and combine them.

    Returns the image (ny, nx) in the data's unit, NaN close to the star, turned counter-clockwise
    to the orientation of `Detection.north`; x, y (ny, nx, 2) of its pixels from the star, arcsec;
    and a label. `science` takes the place of the fit's frames, from which a disk may have been
    subtracted.
    """
    resolution = detection.contrast_curve.meta["resolution_arcsec"]
    klip = KlipSubtraction(detection.templates, references, resolution, science)
    used = min(modes, len(klip.modes))
    image = klip.residuals(klip.science, detection.north)[used - 1]
    shown = np.where(klip._zone, image, np.nan)
    return shown, klip.grid, klip.label(used, used)


def small_sample_factor(
    separation: NDArray[np.float64], resolution: float, sigmas: float = 5.0
) -> NDArray[np.float64]:
    """Factor of a detection threshold when the noise is estimated from few resolution elements.

    `separation` has the unit of `resolution`, lambda/D; inf for fewer than three elements.
    """
    # D. Mawet et al., "Fundamental limitations of high contrast imaging set by small sample
    # statistics", ApJ 792, 97 (2014), section 3.2: with n = 2 pi r / resolution elements, the false
    # alarm probability of `sigmas` Gaussian standard deviations belongs to a value of Student's t
    # with n - 2 degrees of freedom, times sqrt(1 + 1 / (n - 1)).
    elements = np.floor(2 * math.pi * np.asarray(separation, dtype=float) / resolution)
    freedom = np.maximum(elements - 2, 1)
    threshold = student_snr(sigmas, freedom) * np.sqrt(1 + 1 / np.maximum(elements - 1, 1))
    return np.where(elements >= 3, threshold / sigmas, np.inf)


class KlipSubtraction:
    """Aligned frames of a fit and of reference stars, and their subtraction with KLIP.

    `resolution` is lambda/D, arcsec; `science` takes the place of the fit's frames, from which a
    disk may have been subtracted; the light of `candidates` is subtracted. Raises
    IncompatibleSetupError if a roll has no references.
    """

    def __init__(
        self,
        templates: Templates,
        references: Sequence[Observation],
        resolution: float,
        science: Sequence[Observation] | None = None,
        *,
        candidates: Candidates | None = None,
    ) -> None:
        frames = templates.frames
        self.rolls = list(templates.rolls.values())
        star = torch.zeros(1, 2, dtype=torch.float64)
        places = np.array([templates.pixels_of(k, star)[::-1, 0] for k in frames])
        recorded = np.array([each.observation.center.mean(axis=0) for each in frames.values()])
        # The fit knows by how much the recorded positions are off; the references, whose positions
        # were recorded in the same way, are taken to be off by as much.
        others = [
            each.center.mean(axis=0) + (places - recorded).mean(axis=0) for each in references
        ]
        # (2,), x, y of the star in aligned frames, and (frames, 2), how far they are moved, pixels.
        self.center = np.round(places[0])
        self.shifts = self.center - places
        if science is None:
            science = [frame.observation for frame in frames.values()]
        images = np.array([_filled(each) for each in science])
        if candidates is not None and len(candidates):
            light = candidates.light(templates)
            images -= np.array([light[k][0].numpy() for k in frames])
        # (frames, ny, nx), and a list of (ny, nx): aligned, the star at `center`.
        self.science = shift_frames(images, self.shifts)
        self.references = [
            shift_frames(_filled(each)[None], (self.center - place)[None])[0]
            for each, place in zip(references, others, strict=True)
        ]
        self._templates = templates
        scales = templates.origin.observation.pixelscale
        self.pixelscale = float(np.sqrt(scales[0] * scales[1]))
        y, x = np.indices(self.science[0].shape)
        # (ny, nx, 2) and (ny, nx): x, y of the pixels from the star, and the distance, arcsec.
        self.grid = (np.stack([x, y], axis=-1) - self.center) * scales
        self.distance = np.hypot(self.grid[..., 0], self.grid[..., 1])
        self._zone = self.distance > _INNER_RADIUS_LAMBDA_D * resolution
        self._library = [
            [j for j, other in enumerate(self.rolls) if abs(other - roll) > _OTHER_ROLL_DEG]
            for roll in self.rolls
        ]
        fewest = min(map(len, self._library)) + len(self.references)
        if not fewest:
            raise IncompatibleSetupError(
                "klip_curve: got a roll without references, expected frames of reference stars or "
                f"rolls that differ by more than {_OTHER_ROLL_DEG:g} degree"
            )
        # (modes,), numbers of Karhunen-Loeve modes.
        self.modes = np.arange(1, min(_MOST_KL_MODES, fewest) + 1)
        # Halfway to the edge the mask does not matter.
        row, column = self.pixel(np.array([self.grid[0, -1, 0] / 2, 0.0]))
        image = templates.at_pixels(np.array([row]), np.array([column]))[0][0].double().numpy()
        side = 2 * _FILTER_HALF_PIXELS + 1
        kernel = np.pad(image, _FILTER_HALF_PIXELS)[row : row + side, column : column + side]
        self.norm = float(np.sqrt((kernel**2).sum()))
        """Peak of a planet of contrast 1 in a smoothed image before any subtraction."""
        self._kernel = kernel[::-1, ::-1] / self.norm

    def label(self, fewest: int, most: int) -> str:
        """Observing strategies, number of reference frames, and a range of numbers of modes."""
        strategies = ["ADI"] if any(self._library) else []
        reference = "other roll" if len(self.rolls) == 2 else "other rolls"
        if self.references:
            strategies.append("RDI")
            reference = counted(len(self.references), "reference frame")
        modes = f"{'' if fewest == most else f'{fewest} to '}{counted(most, 'mode')}"
        return f"KLIP {'+'.join(strategies)} ({reference}, {modes})"

    def pixel(self, place: Image) -> tuple[int, int]:
        """Row and column of the pixel of the first frame next to x, y in arcsec."""
        away = np.hypot(*np.moveaxis(self._templates.grid - place, -1, 0))
        row, column = np.unravel_index(int(away.argmin()), away.shape)
        return int(row), int(column)

    def residuals(self, science: Image, north: float = 0.0) -> Image:
        """Frames minus star, averaged, turned by `north` from the first roll: (modes, ny, nx).

        `north` is in degrees counter-clockwise.
        """
        total = np.zeros((len(self.modes), *self.distance.shape))
        for frame, roll, others in zip(science, self.rolls, self._library, strict=True):
            # Every roll is projected onto the Karhunen-Loeve modes of the other rolls and all
            # frames of reference stars; the covariance of these gives the modes.
            frames = [*(science[j] for j in others), *self.references]
            library = np.array([each[self._zone] for each in frames])
            # numpy gives the covariance of a single reference as a number.
            covariance = np.atleast_2d(np.cov(library))
            residual = np.zeros_like(total)
            residual[:, self._zone] = klip_math(
                frame[self._zone], library, self.modes, covar_psfs=covariance
            ).T
            turned = [rotate(each, north - roll, self.center) for each in residual]
            total += np.nan_to_num(turned) / len(science)
        return total

    def images(self, science: Image) -> Image:
        """The residuals smoothed with the image of a planet, (modes, ny, nx)."""
        residuals = self.residuals(science)
        return fft_convolve(residuals, self._kernel)


def _filled(observation: Observation) -> Image:
    """The mean of the frames, masked pixels interpolated between their neighbours."""
    mean = observation.combined()
    return without_gaps(np.where(mean.valid[0], mean.data[0], np.nan))
