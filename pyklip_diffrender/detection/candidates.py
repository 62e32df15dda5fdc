"""Point sources in refined frames with the star marginalised: maps, joint fits, and errors."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pyklip_diffrender.detection.error_factor import ErrorFactor, compact_structures
from pyklip_diffrender.detection.field import Image, pixel_width
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.linear.model import LinearFrame
from pyklip_diffrender.linear.response import NANOMETRE, coarse_copy, downsample
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.refinement import FrameFit, Refinement, refine_again, star_flux_error
from pyklip_diffrender.refinement.settings import SAME_ROLL_DEG
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation

_log = logging.getLogger(__name__)

_MOST_STEPS = 12
_STILL_SIGMAS = 0.02
"""A position whose step is shorter than this many standard deviations stays where it is, so that
its images are used again; the fit ends when all steps are shorter."""


@dataclass(frozen=True)
class Candidates:
    """Point sources fitted together."""

    offsets: Tensor  # (k, 2), x, y from the star, arcsec.
    contrasts: Tensor  # (k,).
    # (3 k, 3 k), of all contrasts, then all x, then all y, with the star marginalised; 0 where not
    # known.
    covariance: Tensor
    # (k,), standard deviations of the contrasts for known positions, as in a map of S/N; 0 where
    # not known. Errors in `covariance` include what the uncertain positions add.
    detection_errors: Tensor
    converged: bool = True

    def snr(self, factor: ErrorFactor) -> Image:
        """S/N of the candidates, (k,), with their errors multiplied by the factor."""
        # Its square is the difference in chi-squared that a candidate makes. It is what a map of
        # S/N shows at the fitted position, so that thresholds and false-alarm probabilities of the
        # map's maximum apply.
        errors = self.detection_errors.numpy() * factor.of(self.offsets)
        return np.asarray(self.contrasts.numpy() / errors)

    def __len__(self) -> int:
        return len(self.contrasts)

    @classmethod
    def at(cls, offsets: ArrayLike, contrasts: ArrayLike) -> Candidates:
        """Make starting values from x, y (k, 2) and contrasts (k,)."""
        places = torch.from_numpy(np.asarray(offsets, dtype=float).reshape(-1, 2))
        count = 3 * len(places)
        return cls(
            places,
            torch.from_numpy(np.asarray(contrasts, dtype=float)),
            torch.zeros(count, count, dtype=torch.float64),
            torch.zeros(len(places), dtype=torch.float64),
        )

    @classmethod
    def of_fit(cls, fit: Refinement) -> Candidates:
        """Return the companions that were part of a refinement."""
        return cls.at(fit.companions[:, 1:], fit.companions[:, 0])

    def with_one_more(self, offset: Image, contrast: float) -> Candidates:
        """Starting values with one more source."""
        return Candidates.at(np.vstack([self.offsets, offset]), np.append(self.contrasts, contrast))

    def without(self, index: int) -> Candidates:
        """Starting values without one source."""
        keep = np.arange(len(self)) != index
        return Candidates.at(self.offsets[keep], self.contrasts[keep])

    def planets(self) -> tuple[Planet, ...]:
        """Planets in the first frame; negative contrasts become 0."""
        rows = torch.column_stack([self.contrasts.clamp(min=0), self.offsets]).tolist()
        return tuple(Planet.from_offset(*row) for row in rows)

    def light(self, templates: Templates) -> dict[int, Tensor]:
        """Image of all candidates together, (1, ny, nx) by frame, in the data's unit."""
        if not len(self):
            return {}
        return {
            frame: torch.tensordot(self.contrasts, images, dims=1)[None]
            for frame, images in templates.at(self.offsets).items()
        }

    @property
    def errors(self) -> Tensor:
        """Standard deviations of contrast, x and y, (k, 3)."""
        return self.covariance.diagonal().clamp(min=0).sqrt().reshape(3, -1).T


def refine_candidates(
    templates: Templates, candidates: Candidates, reach: float, iterations: int = _MOST_STEPS
) -> Candidates:
    """Fit contrasts and positions of all candidates together, with the star marginalised.

    `reach` is the longest step of a position, arcsec.
    """
    if not len(candidates):
        return candidates
    count = len(candidates)
    offsets, contrasts = candidates.offsets.clone(), candidates.contrasts.clone()
    # Gauss-Newton steps. With the images p_j and contrasts c_j of the sources, the columns B are
    # p_j, c_j dp_j/dx and c_j dp_j/dy, and a step is
    #
    #     (B Sigma^-1 B^T)^-1 B Sigma^-1 (r - sum_j c_j p_j)
    #
    # The inverse of the part by contrasts alone has the errors for known positions.
    identity = torch.eye(3 * count, dtype=torch.float64)
    covariance, converged = identity, False
    detection_errors = torch.ones(count, dtype=torch.float64)
    for _ in range(iterations):
        # The model is linear in contrasts. The column of a position is slope times contrast.
        columns = {
            frame: torch.cat([part[0], *(contrasts[:, None, None] * part[1:])])
            for frame, part in templates.at(offsets, slopes=True).items()
        }
        matrix, gradient = templates.linear.normal_equations(columns)
        vector = gradient - matrix[:, :count] @ contrasts
        # The ridge keeps positions where they are if the contrast is near 0.
        scale = matrix.diagonal().clamp(min=1e-300).sqrt()
        ridge = 1e-9 * identity
        system = matrix / scale[:, None] / scale + ridge
        covariance = torch.linalg.inv(system) / scale[:, None] / scale
        of_contrasts = torch.linalg.inv(system[:count, :count])
        detection_errors = of_contrasts.diagonal().clamp(min=0).sqrt() / scale[:count]
        step = covariance @ vector
        contrasts = contrasts + step[:count]
        is_settled = (step.abs() < _STILL_SIGMAS * covariance.diagonal().sqrt()).reshape(3, count)
        if bool(is_settled.all()):
            converged = True
            break
        moves = step[count:].reshape(2, count).T
        longest = moves.norm(dim=1, keepdim=True).clamp(min=1e-300)
        moves = moves * (reach / longest).clamp(max=1.0)
        offsets = offsets + torch.where(is_settled[1:].all(dim=0)[:, None], 0.0, moves)
    if not converged:
        _log.info("positions did not settle, number of candidates: %d", count)
    return Candidates(offsets, contrasts, covariance, detection_errors, converged)


# Amplitude and information of a planet at every pixel, with the star marginalised.

_TEMPLATES_AT_A_TIME = 320
"""Number of templates that are rendered at a time."""

_STORE_BYTES = 1e9
"""Largest number of bytes of templates that are stored; otherwise they are rendered again."""

_LAG_PIXELS = 5
"""Largest distance at which the autocorrelation of the S/N is computed, pixels."""

_LAG_PLACES = 4
"""Number of rows, and of columns, of places at which it is computed."""


class Maps:
    """Inner products with a planet at every pixel of the first frame of a fit."""

    def __init__(self, templates: Templates, progress: bool = False) -> None:
        self.templates, self.progress = templates, progress
        self.grid = templates.grid
        ny, nx = self.shape = self.grid.shape[:2]
        size = 4.0 * len(templates.frames) * (ny * nx) ** 2
        self._stores = size <= min(_STORE_BYTES, self._spare())
        self._stored: dict[int, dict[int, Tensor]] = {}
        total, light = np.zeros((3, ny * nx)), np.zeros((2, ny * nx))
        steps = np.linspace(0, 1, _LAG_PLACES + 2)[1:-1]
        rows, columns = np.meshgrid((ny * steps).astype(int), (nx * steps).astype(int))
        self._places = rows.ravel(), columns.ravel()
        cleaned = self._cleaned(templates.at_pixels(*self._places))
        between = np.zeros((len(rows.ravel()), ny * nx))
        for pixels, images in self._batches("S/N map"):
            total[:, pixels] = torch.stack(templates.linear.weigh(images)).numpy()
            light[:, pixels] = self._starlight(images)
            between[:, pixels] = _products(cleaned, images)
        self._between = between.reshape(-1, ny, nx)
        # p . Sigma^-1 r, p . Sigma^-1 p and p . C^-1 p, (ny, nx) each, see `TemplateProducts`; and
        # star over noise, averaged over pixels with the squared S/N that a planet has in each.
        self.numerator, self.information, self.photon = total.reshape(3, ny, nx)
        with np.errstate(invalid="ignore"):
            self.starlight = (light[0] / light[1]).reshape(ny, nx)

    def _starlight(self, images: Mapping[int, Tensor]) -> Image:
        """Squared S/N of planets, with and without the star over noise of each pixel, (2, k)."""
        linear = self.templates.linear
        total = np.zeros((2, len(next(iter(images.values())))))
        for k, planets in images.items():
            fitted, weight = self.templates.frames[k], linear.frames[k].weight
            star = torch.from_numpy(fitted.star - fitted.values["background"][0])
            squares = weight.square()
            columns = torch.stack([squares * weight * star, squares]).flatten(1).to(planets.dtype)
            total += (columns @ planets.flatten(1).square().T).double().numpy()
        return total

    @cached_property
    def correlation(self) -> Image:
        """Autocorrelation of the S/N of noise, by distance in pixels, mean over the field."""
        # The covariance of the numerators of planets p and p' is p . Sigma^-1 p', so that the S/N
        # of noise has the correlation p . Sigma^-1 p' / sqrt(I I') with the information I. It is
        # averaged over a few places p.
        side = 2 * _LAG_PIXELS + 1
        total, count = np.zeros((2, side, side))
        # Behind the mask the information is 0, and by rounding may be below it.
        information = np.pad(np.maximum(self.information, 0.0), _LAG_PIXELS)
        for row, column, products in zip(*self._places, self._between, strict=True):
            window = np.s_[row : row + side, column : column + side]
            size = np.sqrt(information[window] * self.information[row, column].clip(0.0))
            total += np.divide(
                np.pad(products, _LAG_PIXELS)[window], size, out=np.zeros_like(size), where=size > 0
            )
            count += size > 0
        return np.divide(total, count, out=np.zeros_like(total), where=count > 0)

    @cached_property
    def structures(self) -> Image:
        """S/N of planets that structures of the detector may be taken for in one roll, (ny, nx).

        That is the S/N of compact structures of the pattern as planets beside a known star. It is 0
        for several rolls, which tell structures from planets.
        """
        # A pattern is a fraction of the star plus the pedestal, but light that the model of the
        # star lacks is a fraction of the star alone. For a star that outshines the pedestal, the
        # pattern of fainter stars has too little of it. In F356W, 2.3 arcsec from MASK335R, six
        # rolls of three stars all have 1e-8 of the star's light in a pixel that the model lacks,
        # and the pattern of the two fainter stars predicts half of that for the third. So a
        # structure may be as large again.
        nothing = np.zeros(self.shape)
        if count_rolls(self.templates.fit) > 1:
            return nothing
        light = {
            k: torch.from_numpy(_compact_light(frame))[None]
            for k, frame in self.templates.frames.items()
        }
        if not any(bool(image.any()) for image in light.values()):
            return nothing
        weighted = self.templates.linear.noise.weighted(light)
        contrast = self._at_all_pixels(weighted)[0] / np.where(self.photon > 0, self.photon, np.inf)
        return np.asarray(np.abs(contrast) * np.sqrt(np.maximum(self.information, 0.0)))

    def _spare(self) -> float:
        """Bytes that the settings of the fit leave beside its linear model."""
        model = sum(4.0 * frame.jacobian.numel() for frame in self.templates.linear.frames)
        return self.templates.fit.settings.memory_beside(model)

    def _batches(self, name: str) -> Iterator[tuple[slice, dict[int, Tensor]]]:
        """Flat indices of pixels, and their templates by frame."""
        ny, nx = self.shape
        with ProgressBar(name, ny * nx, shown=self.progress) as progress_bar:
            for start in range(0, ny * nx, _TEMPLATES_AT_A_TIME):
                index = np.arange(start, min(start + _TEMPLATES_AT_A_TIME, ny * nx))
                images = self._stored.get(start)
                if images is None:
                    images = self.templates.at_pixels(*np.divmod(index, nx))
                    if self._stores:
                        self._stored[start] = images
                yield slice(start, start + len(index)), images
                progress_bar.update(len(index))

    def without(self, candidates: Candidates) -> Image:
        """The numerator after candidates are removed from the data, (ny, nx)."""
        if not len(candidates):
            return self.numerator
        light = candidates.light(self.templates)
        return np.asarray(self.numerator - self.change(light)[0])

    def response(self, offsets: Tensor) -> Image:
        """Change of the numerator by a planet of contrast 1 at each position, (k, ny, nx).

        `offsets` (k, 2), float64, are x, y from the star, arcsec.
        """
        return self.change(self.templates.at(offsets))

    def change(self, light: Mapping[int, Tensor]) -> Image:
        """Change of the numerator, (k, ny, nx), by images, (k, ny, nx) by frame."""
        return self._at_all_pixels(self._cleaned(light))

    def _at_all_pixels(self, weighted: Mapping[int, Tensor]) -> Image:
        """Inner products of images, by frame, with planets at all pixels, (k, ny, nx)."""
        ny, nx = self.shape
        total = np.zeros((len(weighted[0]), ny * nx))
        for pixels, images in self._batches("candidates"):
            total[:, pixels] = _products(weighted, images)
        return total.reshape(-1, ny, nx)

    def _cleaned(self, light: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """C^-1 of the parts of images that the unknowns cannot reproduce, by frame."""
        linear = self.templates.linear
        return {k: linear.frames[k].weight * image for k, image in linear.clean(light).items()}

    def snr(self, numerator: Image | None = None) -> Image:
        """Amplitude over its standard deviation; NaN where there is no information."""
        information = np.where(self.information > 0, self.information, np.nan)
        return (self.numerator if numerator is None else numerator) / np.sqrt(information)


def _compact_light(frame: FrameFit) -> Image:
    """Light that the pattern has in compact structures of a frame, (ny, nx)."""
    width = frame.model.resolution / frame.model.detector.pixelscale[0]
    multiplied = (frame.star - frame.values["background"][0] + frame.pedestal) / frame.gain
    return compact_structures(frame.gain - 1, width) * multiplied


def _products(cleaned: Mapping[int, Tensor], planets: Mapping[int, Tensor]) -> Image:
    """Inner products of images with planets, summed over the frames, (images, planets)."""
    total = torch.tensor(0.0, dtype=torch.float64)
    for k, images in planets.items():
        total = total + (cleaned[k].float().flatten(1) @ images.flatten(1).T).double()
    return np.asarray(total.numpy())


# Refinement of the star with bright sources in the model, or subtracted from the data.

_SAME_SOURCE_LAMBDA_D = 0.25
"""lambda/D between a companion of a fit and a candidate that are the same source. Positions of
sources above the threshold are known to a tenth of it."""

_CONTRAST_RATIO = 0.1
_CONTRAST_SIGMAS = 5.0
"""Largest difference of the contrasts of companion and candidate, relative and in the companion's
standard deviations, with which the fit has found the source."""


def lacks_candidates(fit: Refinement, candidates: Candidates) -> bool:
    """Return True if the companions of a fit are not the candidates.

    They are if every companion is at the place of one candidate and about as bright, and the other
    way round.
    """
    return len(fit.companions) != len(candidates) or not _confirmed(fit, candidates).all()


def in_derivatives(fit: Refinement, offsets: Tensor) -> Tensor:
    """Which sources (k, 2), x, y from the star, have light in the derivatives of the fit, (k,).

    Errors of such a source from the linear model already contain the star's errors and the
    errors of the source's image.
    """
    companions = torch.from_numpy(fit.bright_companions[:, 1:])
    return (torch.cdist(offsets, companions) < _SAME_SOURCE_LAMBDA_D * fit.model.resolution).any(
        dim=1
    )


def unconfirmed_companions(fit: Refinement, candidates: Candidates) -> NDArray[np.float64]:
    """Companions of the fit that are not among the candidates, (k, 3).

    Contrast, and x and y from the star in the first frame, arcsec.
    """
    return fit.companions[~_confirmed(fit, candidates)]


def _confirmed(fit: Refinement, candidates: Candidates) -> NDArray[np.bool_]:
    """Which companions of a fit are candidates, (companions,)."""
    contrasts = candidates.contrasts.numpy()
    away = fit.companions[:, None, 1:] - candidates.offsets.numpy()
    near = np.hypot(*np.moveaxis(away, -1, 0))
    difference = np.abs(fit.companions[:, None, 0] - contrasts)
    allowed = np.hypot(
        _CONTRAST_RATIO * contrasts, _CONTRAST_SIGMAS * fit.companion_errors[:, None, 0]
    )
    same = (near < _SAME_SOURCE_LAMBDA_D * fit.model.resolution) & (difference < allowed)
    return np.asarray(same.any(axis=1))


def are_companions(fit: Refinement, candidates: Candidates) -> NDArray[np.bool_]:
    """Which candidates are at the place of a companion of the fit, (candidates,)."""
    away = candidates.offsets.numpy()[:, None] - fit.companions[None, :, 1:]
    near = np.hypot(*np.moveaxis(away, -1, 0)) < _SAME_SOURCE_LAMBDA_D * fit.model.resolution
    return np.asarray(near.any(axis=1))


def with_companions(fit: Refinement, candidates: Candidates, progress: bool = False) -> Refinement:
    """Refine the star again, with the candidates as its companions."""
    # Without parameters of its own, a bright companion biases the fitted wavefront beyond the range
    # of the linear model.
    again = refine_again(fit, companions=candidates.planets(), progress=progress)
    return replace(again, seconds=fit.seconds + again.seconds)


def without_light(
    fit: Refinement, light: Mapping[int, Image], original: Sequence[Observation] | None = None
) -> Refinement:
    """Refine the star again after light, (ny, nx) by frame, is subtracted, without companions.

    It is subtracted from `original`, by default the frames of the fit. The errors of the data still
    contain its photon noise.
    """
    observations = original or [frame.observation for frame in fit.frames]
    frames = [
        replace(frame, observation=replace(observation, data=observation.data - light.get(k, 0.0)))
        for k, (frame, observation) in enumerate(zip(fit.frames, observations, strict=True))
    ]
    return refine_again(replace(fit, frames=tuple(frames)), companions=())


# Errors of candidates' positions because the star is hidden behind the mask.
#
# Positions are measured from the star. Where it is on the detector follows from its diffracted
# light, together with the wavefront. With unknowns u of the star, and the offset o of a source,
#
#     do = (B C^-1 B^T)^-1 B C^-1 dI/du du
#
# is the error of the offset for an error du, where I is the image of the source and B has its
# derivatives by flux, x and y, in all frames. The covariance of the offsets follows from
# the covariance of the unknowns.

_SHIFT_ARCSEC = 2e-3
"""arcsec between images whose difference is a derivative, in single precision."""


def with_position_of_star(
    templates: Templates, candidates: Candidates, place: Tensor | None = None
) -> Candidates:
    """Add the error of the star's position to the covariance of candidates' positions.

    It is computed at the candidates, which must be on the frames, or for all of them at `place`
    (2,), x, y from the star, arcsec.
    """
    count = len(candidates)
    if not count:
        return candidates
    # The star's unknowns and the noise in the candidates' pixels are taken as independent. Errors
    # of a companion whose light counts in the derivatives by the star's unknowns already
    # contain the star's errors, and do not change.
    places = candidates.offsets if place is None else place[None]
    changes = torch.stack([_rates(templates, each) for each in places], dim=2)
    changes = changes.expand(-1, -1, count)
    changes = torch.where(in_derivatives(templates.fit, candidates.offsets), 0.0, changes)
    # A companion whose place is not known says nothing about the place of the star.
    linear = templates.fit.linear
    of_star = torch.tensor([each.name != "companions" for each in linear.unknowns])
    combinations = torch.zeros(len(of_star), 2 * count, dtype=torch.float64)
    combinations[of_star] = changes.flatten(1)
    covariance = candidates.covariance.clone()
    covariance[count:, count:] += linear.covariances(combinations)
    return replace(candidates, covariance=covariance)


def _rates(templates: Templates, offset: Tensor) -> Tensor:
    """Change of a measured offset by the unknowns of the star, (unknowns, 2), in arcsec."""
    linear = templates.linear
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    gradient = torch.zeros(len(linear.vector), 3, dtype=torch.float64)
    for k in templates.frames:
        of_frame, by_row = _offset_products(templates, k, offset)
        matrix += of_frame
        gradient += linear.frames[k].onto_unknowns(by_row, len(gradient))
    return torch.linalg.solve(matrix, gradient.T)[1:].T


def _offset_products(templates: Templates, k: int, offset: Tensor) -> tuple[Tensor, Tensor]:
    """B C^-1 B^T, (3, 3), of a source in one frame, and B C^-1 dI/du by row, (rows, 3)."""
    linear, fitted = templates.linear, templates.frames[k]
    frame = linear.frames[k]
    model = coarse_copy(fitted.model)
    # Shifts hardly depend on the wavelength.
    model = model.at_wavelengths(model.bandpass.thinned(1))
    opd = downsample(torch.from_numpy(fitted.opd.copy()), model.npix)
    grid = PupilGrid.full(model.npix, model.diameter)
    names = linear.names_before_modes(k)

    def image(change: Tensor, moved: Tensor | float = 0.0) -> Tensor:
        values = fitted.optical_values
        values["star_offset"] = templates.place_of(k, offset + moved)
        for name in values.keys() & set(names):
            rows = [row for row, each in enumerate(names) if each == name]
            values[name] = values[name] + change[rows]
        modes = change[frame.first_mode :] * NANOMETRE
        wavefront = templates.fit.basis.opd(modes, grid) if len(modes) else 0.0
        return fitted.flux * model(opd + wavefront, **values).double()

    change = torch.zeros(len(frame.rows), dtype=torch.float64, requires_grad=True)
    source = image(change)
    with torch.no_grad():
        steps = _SHIFT_ARCSEC * torch.eye(2, dtype=torch.float64)
        slopes = [(image(change, s) - image(change, -s)) / (2 * _SHIFT_ARCSEC) for s in steps]
        columns = torch.stack([source.detach(), *slopes])
        weighted = columns * frame.weight.to(columns.device) ** 2
        matrix = torch.tensordot(weighted, columns, dims=[[1, 2], [1, 2]])
    # Products that do not depend on any row have derivatives as well.
    products = torch.tensordot(weighted, source, dims=2).cpu() + 0.0 * change.sum()
    by_row = [torch.autograd.grad(each, change, retain_graph=True)[0] for each in products]
    return matrix.cpu(), torch.stack(by_row, dim=1)


# Calibration errors of contrasts, from the star's flux and from the image of the source.

_OWN_ERROR_SNR = 25.0
"""S/N above which the error of a source's own image matters."""


def candidate_errors(
    templates: Templates, candidates: Candidates, factor: ErrorFactor
) -> NDArray[np.float64]:
    """Relative calibration errors of candidates, (2, k), see `calibration_errors`."""
    factors = torch.from_numpy(factor.of(candidates.offsets))
    snr = torch.from_numpy(candidates.snr(factor))
    return calibration_errors(templates, candidates.offsets, snr, factors).numpy()


def calibration_errors(
    templates: Templates, offsets: Tensor, snr: Tensor, factors: Tensor
) -> Tensor:
    """Relative errors of contrasts by the star's flux and by the source's image, (2, k), float64.

    The second row is of the sources' own fluxes, which do not depend on the star's. `offsets`
    (k, 2) are x, y from the star, arcsec; `snr` and the factors of the posterior's errors are (k,).
    Below a S/N of 25 the image is taken as known, because noise dominates.
    """
    count = len(offsets)
    # A contrast is the flux of the source over the star's. The source is measured with an
    # image that depends on the wavefront, so errors of the wavefront and of the star's flux change
    # the contrast in proportion. They do not change the significance of a source. Both come from
    # the same posterior and may partly cancel. In real frames the posterior understates the error
    # of the star's flux, see `star_flux_error`, which is added. Errors of a companion whose light
    # counts in the derivatives by the star's unknowns contain the posterior's already; only this is
    # added.
    linear, contained = templates.linear, in_derivatives(templates.fit, offsets)
    changes = torch.zeros(len(linear.vector), 2 * count, dtype=torch.float64)
    for k, fitted in templates.frames.items():
        frame = linear.frames[k]
        on_rows = torch.zeros(len(frame.rows), 2 * count, dtype=torch.float64)
        for row, name in enumerate(linear.names_before_modes(k)):
            if name == "flux":
                on_rows[row, :count] = 1 / fitted.flux
        for j in torch.nonzero((snr > _OWN_ERROR_SNR) & ~contained).flatten().tolist():
            by_modes = _by_modes(templates, k, frame, offsets[j])
            on_rows[frame.first_mode :, [j, count + j]] = by_modes[:, None]
        on_rows[:, contained.repeat(2)] = 0.0
        changes += frame.onto_unknowns(on_rows, len(linear.vector)) / len(templates.frames)
    errors = factors * linear.variances(changes).sqrt().reshape(2, count)
    untied = star_flux_error(templates.fit)
    return torch.stack([torch.hypot(errors[0], torch.full_like(errors[0], untied)), errors[1]])


def _by_modes(templates: Templates, k: int, frame: LinearFrame, offset: Tensor) -> Tensor:
    """Relative change, per nm of every mode, of the flux that a matched filter measures."""
    modes = torch.zeros(len(frame.rows) - frame.first_mode, dtype=torch.float64)
    if not len(modes):
        return modes  # The wavefront was not fitted.
    modes.requires_grad_()
    model, basis = templates.frames[k].model, templates.fit.basis
    grid = PupilGrid.full(model.npix, model.diameter)
    image = templates.image(k, offset, basis.opd(modes * NANOMETRE, grid))
    # A matched filter with the image m measures the flux (m . W m') / (m . W m) of a source whose
    # image is m'; its derivative is taken at m' = m.
    weighted = image.detach() * frame.weight.to(image.device) ** 2
    share = (weighted * image).sum() / (weighted * image.detach()).sum()
    return torch.autograd.grad(share, modes)[0]


# Caveats about the candidates of a search.


def count_rolls(fit: Refinement) -> int:
    """Number of orientations of the target's frames that differ by more than a degree."""
    angles = sorted(
        each.observation.position_angle for each in fit.frames if not each.observation.reference
    )
    steps = np.diff(angles, append=angles[0] + 360)
    return max(1, int((steps > 1).sum()))


def caveats(detection: Any) -> str:
    """Sources that only the fit of a `Detection` has, and what a single roll cannot tell."""
    fit = detection.stored_fit
    sources = np.zeros((0, 3)) if fit is None else unconfirmed_companions(fit, detection.sources)
    remarks = [
        f"A possible source of contrast {contrast:.1e} at {math.hypot(x, y):.2f} arcsec was "
        "fitted with the star; the search does not confirm it."
        # A negative companion takes up an error of the model, and is no source.
        for contrast, x, y in sources[sources[:, 0] > 0]
    ]
    if detection.rolls == 1 and detection.observation.is_nircam:
        step = np.rad2deg(detection.contrast_curve.meta["resolution_arcsec"])
        remarks.append(
            "One roll: structure that is fixed on the detector cannot be told from a planet. It "
            "made 2 candidates in 12 real rolls, which false-alarm probabilities include. A second "
            f"roll by 10 degrees would tell them apart beyond {step / 10:.1f} arcsec, where it "
            "moves a planet by more than lambda/D."
        )
    return " ".join(remarks)


# Point sources beside reference stars that were fitted together with a target.

_REFERENCE_SOURCE_SNR = 6.0
"""S/N above which a peak is a source. Fainter ones leave less than a fifth of it in the target."""

_REFERENCE_PEAK_SNR = 4.5
"""Approximate S/N, in units of its scatter, above which a peak is looked at more closely."""

_INNER_ARCSEC = 0.3
"""Smallest separation, arcsec. Nearer to the star, a source is taken up by the wavefront."""

_GRID_PIXELS = 2
"""Pixels between the positions that are looked at: about lambda/D in the long-wave channel. Between
four of them a source keeps 0.7 of its S/N."""

_PLACE_STEPS = 6
"""Largest number of steps of its position."""


class ReferenceSource(NamedTuple):
    """A point source beside a reference star, in one frame."""

    contrast: float  # To its star.
    offset: tuple[float, float]  # x, y from the star, arcsec.
    light: NDArray[np.float64]  # (ny, nx), in the unit of the frame.


def sources_of_references(fit: Refinement) -> dict[int, ReferenceSource]:
    """Find the most significant point source beside each reference star, by place in the fit."""
    # A source beside a reference star leaves a dark spot in the residual of the target, at the same
    # pixels of the detector.
    stars: dict[str, list[int]] = {}
    for k, frame in enumerate(fit.frames):
        if frame.observation.reference:
            stars.setdefault(frame.observation.target, []).append(k)
    sources = {}
    for star, places in stars.items():
        templates = Templates(fit, places)
        brightest = _brightest_source(templates)
        if brightest is None:
            continue
        contrast, x, y, snr = brightest
        _log.info("%s has a source of S/N %.1f at x, y = %.2f, %.2f arcsec", star, snr, x, y)
        offset = np.array([[x, y]])
        images = templates.at(torch.from_numpy(offset))
        origin = fit.frames[places[0]].observation
        for k in places:
            ((turned_x, turned_y),) = fit.frames[k].observation.turned(offset, origin)
            sources[k] = ReferenceSource(
                contrast, (float(turned_x), float(turned_y)), contrast * images[k][0].numpy()
            )
    return sources


def _brightest_source(templates: Templates) -> tuple[float, float, float, float] | None:
    """Contrast, x, y and S/N of the most significant source in frames of one reference star."""
    away = np.hypot(templates.grid[..., 0], templates.grid[..., 1])
    rows, columns = (each.ravel() for each in np.indices(away.shape))
    chosen = (
        (away.ravel() > _INNER_ARCSEC) & (rows % _GRID_PIXELS == 0) & (columns % _GRID_PIXELS == 0)
    )
    rows, columns = rows[chosen], columns[chosen]
    snr = _approximate_snr(templates.fit, list(templates.frames), rows, columns)
    peak = int(snr.argmax())
    if snr[peak] < _REFERENCE_PEAK_SNR:
        return None
    # The search steps over pixels, and a source may be between them.
    row, column = rows[peak : peak + 1], columns[peak : peak + 1]
    products = templates.linear.weigh(templates.at_pixels(row, column))
    contrast = (products.numerator / products.information).numpy()
    start = Candidates.at(templates.grid[row, column], contrast)
    reach = _GRID_PIXELS * pixel_width(templates.grid)
    source = refine_candidates(templates, start, reach, _PLACE_STEPS)
    measured = float(source.snr(ErrorFactor.constant(1.0))[0])
    if measured < _REFERENCE_SOURCE_SNR:
        return None
    x, y = source.offsets[0].tolist()
    return float(source.contrasts[0]), x, y, measured


def _approximate_snr(
    fit: Refinement, places: Sequence[int], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """S/N of sources at pixels of the first frame of a star, (k,), in units of its scatter."""
    # With the residual r of all unknowns, p . Sigma^-1 r is exact, and p . C^-1 p takes the place
    # of p . Sigma^-1 p, which differs from it by a factor that varies slowly over the field.
    # Dithers move the star by a fraction of a pixel, so that templates of the first frame do for
    # all.
    linear, first = fit.star_only, places[0]
    templates = Templates(fit, [first])
    cleaned = torch.zeros_like(linear.cleaned[first])
    weight = torch.zeros_like(cleaned)
    for k in places:
        roll = fit.frames[k].observation.roll_from(fit.frames[first].observation)
        if abs(roll) < SAME_ROLL_DEG:
            scale = fit.frames[k].flux / fit.frames[first].flux
            cleaned += scale * linear.frames[k].weight * linear.cleaned[k]
            weight += (scale * linear.frames[k].weight) ** 2
    snr = np.zeros(len(rows))
    for start in range(0, len(rows), _TEMPLATES_AT_A_TIME):
        part = slice(start, start + _TEMPLATES_AT_A_TIME)
        images = templates.at_pixels(rows[part], columns[part])[first].flatten(1).double()
        information = images.square() @ weight.flatten()
        snr[part] = images @ cleaned.flatten() / information.clamp(min=1e-300).sqrt()
    return snr / max(1e-300, 1.4826 * float(np.median(np.abs(snr))))
