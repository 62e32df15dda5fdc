"""Settings of the refinement methods, presets for real frames, and the priors that both imply."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.masks import is_short_wave, is_wide_band, stop_is_measured
from pyklip_diffrender.io.units import ARCSEC, half_circle, require_positive, to_bytes, to_unit
from pyklip_diffrender.optics.grid import JWST_DIAMETER
from pyklip_diffrender.parameters import OPTICAL_PARAMETERS
from pyklip_diffrender.scene.exposure import image_mask
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.simulation import pupil_samples
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import EvidenceUpdate, WavefrontPrior, scale_ratios

_FITTED_REACH_PIXELS = 40
"""Pixels from the star to the edge of the square that `reduce` fits."""

_MOST_CYCLES = 32
"""Highest spatial frequency of the preset: 3,200 modes. Each of them takes a float for every pixel,
and the time of a step grows with their square."""

_SHORT_WAVE_DRIFT = WavefrontPrior(
    scales={"segment": 1.5, "texture": 1.0}, knee=1.0, slope=1.0, fit_scales=False
)
"""Change of the wavefront between frames, 4 nm rms. Without this prior, fits of simulated rolls
whose wavefronts differ by 2 nm take the change for a shift of the star. Behind MASK210R they make
the star up to 1.5 times too bright, and limits 1.5 times higher. In the long-wave channel it makes
limits of two rolls of G 7-34 6 to 11 % higher from 0.4 to 1 arcsec, and is not used."""

_CURRENT_MAP_DAYS = 60.0
"""Days between map and frames up to which the scales of the preset hold: in the real frames with
which they were measured, 50."""


def age_of_map(days: float | None) -> float:
    """Time between map and frames as a fraction of `_CURRENT_MAP_DAYS`; 0 if it is not known."""
    return abs(days or 0.0) / _CURRENT_MAP_DAYS


_DRIFTS = (" drift", " dither")
"""Endings of the names of groups of modes in `drift` and `dither_drift`."""

_DRIFT_RANGE = 4.0
"""Largest factor between the scale of a drift that maximises the evidence and the one stated."""

_SWITCHES = (
    "wavefront", "adapt_prior", "marginal_flux", "companions_if_stalled", "accurate_steps",
)  # fmt: skip
"""Fields of `FitSettings` that are True or False."""

OWN_PARAMETERS = ("star_offset", "detector_shift", "flux", "background", "pedestal")
"""Parameters with a value for every frame when several frames are fitted together; the frames
share the others."""

_REFERENCE_RING_PIXELS = (5.0, 16.0)
_REFERENCE_SQUARED_SNR = 1800.0
"""Median of the squared S/N of pixels at these distances from the star, pixels, in one roll of
G 7-34 in F444W, for which `benchmarks.scene_fidelity` measured what a coarser model costs."""

_VERY_FAINT_RATIO = 100.0

_COARSE_NPIX = 128
"""Samples across the pupil for a first look, half as many as in `model_for`."""

_QUICK_CYCLE_SHARES = ((100.0, 0.4), (4.0, 0.55), (0.0, 0.77))
"""Share of the spatial frequencies that a first look fits, by how many times the star is fainter
than G 7-34, compared with its noise."""

_QUICK_SETTINGS: dict[str, Any] = {
    "response_npix": 64,
    "response_wavelengths": 3,
    "tolerance": 0.02,
    "relinearise": 0.3,
}
"""Other settings of a first look; `benchmarks.first_look` compares its time and limits with full
fits. With a tolerance of 1e-3, it takes 1.2 to 1.4 times as long, and median limits change
by up to 4 %; with 0.03, the fit of two rolls of HIP 17695 in F356W ends before it explains the
frames. Without accurate steps, limits are 1.3 times as large. With three wavelengths in the model,
the fit does not explain the frames."""

_PROCESS_BYTES = 1.3e9
"""Memory that the package and PyTorch take, with what a fit needs for a while, bytes."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of the default method: damped Gauss-Newton on wavefront modes with a prior.

    Attributes
    ----------
    free : tuple of str
        Free parameters besides the wavefront, from the parameter table. The pedestal of a known
        pattern is always free, see `pyklip_diffrender.DetectorPattern`.
    wavefront : bool
        Fit the wavefront; False fits the alignment only.
    cycles : tuple of float
        Highest spatial frequencies of the default basis, in cycles across the pupil. The first
        one is fitted, and the next ones in turn while the data are not explained. Give one where
        the residual need not be missing modes.
    basis : Basis, optional
        Wavefront modes, in place of the default basis: Fourier modes and, for JWST, the motions of
        its segments.
    deviations : mapping of str to float or Quantity
        Prior standard deviations of free parameters about their starting values, where they
        differ from the parameter table. The deviation of "flux" is relative, and takes a starting
        value: ``deviations={"flux": 0.05}`` with ``start={"flux": ...}`` ties the contrast scale to
        the star's known brightness, as the light that the pupil collects in the unit of the frames.
    prior : WavefrontPrior
        Prior on the wavefront's change from the starting map.
    adapt_prior : bool
        Where a prior with fixed scales makes the fitted wavefront improbable (status
        `PRIOR_MISMATCH`), raise its scales and the scales of `drift` towards the highest evidence
        and continue the fit, up to three times. Where the fitted wavefront is less than 0.8 times
        as large as its prior says, and a map of the wavefront is known, lower the scales likewise:
        with a prior that is too wide, the star's flux comes out too high.
    marginal_flux : bool
        Fit the flux of the star that is most probable after the wavefront is marginalised, and not
        the most probable pair of both, which is too bright where the data determine many modes.
    drift : WavefrontPrior, optional
        Prior on the difference between the wavefronts of several frames. By default all frames
        share one wavefront.
    dither_drift : WavefrontPrior, optional
        Prior on the difference between the wavefronts of the frames of one exposure sequence, such
        as the small-grid dithers of a star. The sequence shares a difference of the size of `drift`
        from frames before or after a slew. By default the wavefronts of any two frames differ by
        `drift`.
    drift_cycles : float
        Highest spatial frequency of such differences.
    companions : tuple of Planet
        Companions with free contrast and position from the start; positions relative to the star,
        in the orientation of the first frame.
    max_companions : int
        Largest number of companions that the fit may add if they are significant in the
        residual of the alignment fit. If it is not 0, a source that outshines what the mask leaves
        of the star is looked for before that fit, and up to twenty more are added to it that are
        too bright to be errors of the wavefront.
    companion_threshold : float
        Smallest S/N of such companions, in units of the scatter of the matched filter.
    companions_if_stalled : bool
        Where the fit of the wavefront stalls far above the noise, search the residual for bright
        companions, one at a time and up to twenty more than `max_companions`, and before that fit
        even if `max_companions` is 0. False for frames whose residual has peaks that are errors of
        the model: the search then waits until a fit stalls with more than 0.12 of the star's light.
    response_npix : int
        Pupil samples of the coarse copy of the model that computes derivatives.
    response_wavelengths : int
        Largest number of wavelengths of the coarse copy.
    max_iterations : int
    tolerance : float
        The fit has converged when a step lowers the penalised chi-squared per pixel by less.
    min_model_error : float
        Smallest error of the star model that is assumed on the way to the solution, as a fraction
        of the star's light in a pixel, and added in quadrature to the noise. The errors of the
        result do not include it where the noise explains the residual.
    relinearise : float
        Relative error of derivatives (radians of phase, rms over the pupil) beyond which the
        response to the wavefront is recomputed, see ``linear.response``.
    accurate_steps : bool
        Follow a step that fails, gains less than expected or is the last by steps with derivatives
        of the model itself, see ``pyklip_diffrender.refinement.solver``. Fits of bright
        stars need them; `relinearise` may then be twice as large.
    robust : float
        Residuals of this many standard deviations get half weight (Cauchy's loss); inf for plain
        least squares.
    memory : float, str or Quantity, optional
        Memory that the process should take, bytes or such as "2 GB", including 1.3 GB for the
        process itself. Derivatives that do not fit are computed in parts whenever they are needed,
        which takes longer and gives the same result. The Jacobians of the frames are always
        stored, so that a low limit may be exceeded. By default derivatives take up to 2 GB.

    Raises
    ------
    IncompatibleSetupError
        For a value outside its range.

    Examples
    --------
    >>> from pyklip_diffrender import FitSettings
    >>> FitSettings(cycles=16).cycles
    (16.0,)
    """

    free: tuple[str, ...] = ("star_offset", "lyot_shift", "lyot_rotation", "flux", "background")
    wavefront: bool = True
    cycles: tuple[float, ...] = (24.0, 32.0)
    basis: Basis | None = None
    deviations: Mapping[str, float] = field(default_factory=dict)
    prior: WavefrontPrior = field(default_factory=WavefrontPrior)
    adapt_prior: bool = False
    marginal_flux: bool = False
    drift: WavefrontPrior | None = None
    dither_drift: WavefrontPrior | None = None
    drift_cycles: float = 8.0
    companions: tuple[Planet, ...] = ()
    max_companions: int = 0
    companion_threshold: float = 4.0
    companions_if_stalled: bool = True
    response_npix: int = 128
    response_wavelengths: int = 4
    max_iterations: int = 40
    tolerance: float = 1e-3
    min_model_error: float = 0.0
    relinearise: float = 0.05
    accurate_steps: bool = False
    robust: float = math.inf
    memory: float | None = None

    def __post_init__(self) -> None:
        if self.memory is not None:
            object.__setattr__(self, "memory", to_bytes(self.memory, "memory"))
        try:
            cycles = np.atleast_1d(np.asarray(self.cycles, dtype=float))
        except (TypeError, ValueError) as reason:
            raise IncompatibleSetupError(
                f"cycles: got {self.cycles!r}, expected a number or several, such as (24, 32)"
            ) from reason
        object.__setattr__(self, "cycles", tuple(cycles.tolist()))
        free: Any = self.free
        if isinstance(free, str):
            raise IncompatibleSetupError(
                f"free: got the text {free!r}, expected a tuple of names such as ({free!r},)"
            )
        object.__setattr__(self, "free", tuple(free))
        object.__setattr__(self, "companions", tuple(self.companions))
        if not all(isinstance(each, Planet) for each in self.companions):
            raise IncompatibleSetupError(
                f"companions: got {self.companions}, expected Planets, such as "
                "(Planet.from_offset(contrast, x, y),)"
            )
        if not self.cycles and self.basis is None and self.wavefront:
            raise IncompatibleSetupError("cycles: got none, expected at least one, such as 24")
        if not all(each > 0 for each in self.cycles):
            raise IncompatibleSetupError(f"cycles: got {self.cycles}, expected positive numbers")
        for name in _SWITCHES:
            if not isinstance(getattr(self, name), bool):
                raise IncompatibleSetupError(
                    f"{name}: got {getattr(self, name)!r}, expected True or False"
                )
        positive = (
            "max_iterations", "tolerance", "robust", "relinearise", "response_npix",
            "response_wavelengths", "companion_threshold", "drift_cycles",
        )  # fmt: skip
        require_positive(**{name: getattr(self, name) for name in positive})
        for name in ("min_model_error", "max_companions"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise IncompatibleSetupError(
                    f"{name}: got {getattr(self, name)}, expected 0 or more"
                )
        units = {each.name: each.unit for each in OPTICAL_PARAMETERS}
        deviations = {
            name: float(to_unit(value, units.get(name, ""), f"deviations: {name}"))
            for name, value in self.deviations.items()
        }
        object.__setattr__(self, "deviations", deviations)
        for name, deviation in self.deviations.items():
            if name not in self.free or not deviation > 0:
                raise IncompatibleSetupError(
                    f"deviations: got {deviation} for {name!r}, expected a positive number for one "
                    f"of the free parameters {self.free}"
                )
        if not self.free and not self.wavefront:
            raise IncompatibleSetupError(
                "free is empty and wavefront is False: nothing to fit. Name parameters in free, "
                "such as ('flux', 'background'), or set wavefront=True"
            )

    def memory_beside(self, arrays: float) -> float:
        """Bytes of `memory` that remain beside the process and arrays of so many bytes."""
        if self.memory is None:
            return math.inf
        # Some of what is freed does not return to the system at once.
        return max(0.0, 0.9 * self.memory - _PROCESS_BYTES - arrays)

    def with_wider_priors(self, ratios: Mapping[str, float]) -> FitSettings:
        """Return settings whose priors have scales multiplied by ratios above 1.

        Parameters
        ----------
        ratios : mapping of str to float
            As ``Refinement.prior_ratios``: by group of modes, followed by " drift" or " dither"
            for groups of `drift` and `dither_drift`, and "amplitude".
        """
        of_drift, of_dither = (_labelled(ratios, label) for label in _DRIFTS)
        return replace(
            self,
            prior=self.prior.widened(ratios),
            drift=self.drift and self.drift.widened(of_drift),
            dither_drift=self.dither_drift and self.dither_drift.widened(of_dither),
        )

    def with_narrower_prior(self, size: float, amplitude: float) -> FitSettings:
        """Return settings with a narrower prior on the wavefront that all frames share.

        Parameters
        ----------
        size : float
            Factor by which the scales of all groups are multiplied.
        amplitude : float
            Factor by which the scale of the amplitude modes is multiplied, if it is below 1.
        """
        prior = self.prior
        scales = {name: size * scale for name, scale in prior.scales.items()}
        amplitude_scale = min(1.0, amplitude) * prior.amplitude_scale
        return replace(self, prior=replace(prior, scales=scales, amplitude_scale=amplitude_scale))

    def with_drift_scales(self, ratios: Mapping[str, float], within: FitSettings) -> FitSettings:
        """Return settings whose drifts have scales multiplied by ratios, within bounds.

        Parameters
        ----------
        ratios : mapping of str to float
            As for `with_wider_priors`; ratios of groups of `prior` do not count.
        within : FitSettings
            Settings whose drifts are the middle of the bounds, `_DRIFT_RANGE` times to either side.
            Dithers may differ by as much as exposures with a slew between them.
        """
        changed = {}
        slews: dict[str, float] = {}
        if within.drift is not None:
            reach = _DRIFT_RANGE if within.drift.fit_scales else 1.0
            slews = {name: reach * scale for name, scale in within.drift.scales.items()}
        for field_name, label in (("drift", _DRIFTS[0]), ("dither_drift", _DRIFTS[1])):
            prior, middle = getattr(self, field_name), getattr(within, field_name)
            if prior is not None and middle.fit_scales:
                own = _labelled(ratios, label)
                scales = {
                    name: float(np.clip(own.get(name, 1.0) * scale,
                                        middle.scales[name] / _DRIFT_RANGE,
                                        max(middle.scales[name] * _DRIFT_RANGE,
                                            slews.get(name, 0.0))))
                    for name, scale in prior.scales.items()
                }  # fmt: skip
                changed[field_name] = replace(prior, scales=scales)
        return replace(self, **changed)

    @classmethod
    def nircam(
        cls,
        filter: str | None = None,
        *,
        reach: int = _FITTED_REACH_PIXELS,
        image_mask: str | None = None,
        **changes: Any,
    ) -> FitSettings:
        """Return the settings for real NIRCam frames, for which the model is not exact.

        The prior's scales are fixed unless they are much too small, the pupil's amplitude is free
        as well, the alignment has a prior about its values in flight, the fit allows for a model
        error of at least a percent of the star, outliers are down-weighted, and one companion that
        is significant after the alignment fit gets its own parameters.

        A wider prior (20 and 18 nm, alignment free) fits real frames a little more closely, but
        by way of a star far off the mask and of a wavefront that outshines the measured one: the
        star's flux then comes out too low, and contrasts too high.

        In the short-wave channel, the wavefront may change between frames.

        Parameters
        ----------
        filter : str, optional
            Filter, such as "F356W"; default as in F444W.
        reach : int
            Pixels by which the finest modes move light, but at most with 32 cycles: by default to
            the edge of the square that `reduce` fits, with 18 cycles in F444W and F210M, 22 in
            F356W and 32 in F250M.
        image_mask : str, optional
            Image mask; default a round mask. Behind bars, and in the short-wave channel, the
            alignment of the Lyot stop was not measured in flight, and its prior is three times as
            wide.
        **changes
            Fields with other values.

        Raises
        ------
        IncompatibleSetupError
            For a filter that does not go with the coronagraph, or a value that a field cannot have.

        Examples
        --------
        >>> from pyklip_diffrender import FitSettings
        >>> FitSettings.nircam("F356W", max_iterations=60).cycles
        (22.0,)
        """
        name = "F444W" if filter is None else filter
        short = is_short_wave(name)
        loose = 1.0 if stop_is_measured(image_mask, short) else 3.0
        preset = cls(
            free=(
                "star_offset",
                "lyot_shift",
                "lyot_rotation",
                "detector_shift",
                "blur",
                "si_zernikes",
                "flux",
                "background",
            ),
            prior=WavefrontPrior(
                scales={"segment": 10.0, "texture": 6.0},
                knee=1.0,
                slope=1.0,
                fit_scales=False,
                amplitude_cycles=12.0,
                amplitude_scale=2.0,
                amplitude_slope=0.5,
            ),
            adapt_prior=True,
            # Without a marginal flux, six planets in pairs of rolls of stpsf came out at 0.96 of
            # their contrast in the mean, with it at 1.02.
            marginal_flux=True,
            # Finer modes cost time and leave chi-squared within 3 %.
            cycles=(_cycles_to_edge(name, reach),),
            # With three, derivatives in F210M are off by 1 to 3 % at 80 pixels, and by 2 to 20 % at
            # 160, as they are with four in F444W at 80.
            response_wavelengths=4 if is_wide_band(name) else 3,
            drift=_SHORT_WAVE_DRIFT if short else None,
            drift_cycles=12.0,
            deviations={
                "star_offset": 0.003,
                "lyot_shift": loose * 0.004,
                "lyot_rotation": loose * 0.2,
            },
            max_companions=1,
            companion_threshold=3.0,
            # Peaks may be due to the model error.
            companions_if_stalled=False,
            robust=3.0,
            min_model_error=0.01,
            max_iterations=40,
            relinearise=0.1,
            accurate_steps=True,
            # For 6,400 pixels, less than one unit of chi-squared. With 5e-4, fits of a star behind
            # MASK210R stop 50 to 100 units above the minimum, at a flux that is 20 % too low.
            tolerance=1e-4,
        )
        # Parameters that are not free need no prior.
        free = changes.get("free", preset.free)
        deviations = {name: value for name, value in preset.deviations.items() if name in free}
        return replace(preset, **{"deviations": deviations, **changes})


def _labelled(ratios: Mapping[str, float], label: str) -> dict[str, float]:
    """Ratios of the groups with a label, by the name of the group without it."""
    return {n.removesuffix(label): ratio for n, ratio in ratios.items() if n.endswith(label)}


def settings_for(observation: Observation) -> FitSettings:
    """Return the default settings for an observation: the NIRCam preset for real NIRCam frames."""
    if not observation.is_nircam:
        return FitSettings()
    return nircam_settings(
        observation, reach=max(_FITTED_REACH_PIXELS, min(observation.shape) // 2)
    )


def faintness(observation: Observation) -> float:
    """Factor by which a star is fainter, compared with its noise, than G 7-34 in one roll."""
    frame = observation.combined()
    y, x = np.indices(frame.shape)
    column, row = frame.center[0]
    away = np.hypot(x - column, y - row)
    ring = frame.valid[0] & (away > _REFERENCE_RING_PIXELS[0]) & (away < _REFERENCE_RING_PIXELS[1])
    if not ring.any():
        return 1.0
    # The chi-squared of an error of the model that is a fraction of the light is proportional to
    # (S/N)^2.
    squares = (frame.data[0][ring] / frame.error[0][ring]) ** 2
    return _REFERENCE_SQUARED_SNR / max(float(np.median(squares)), 1e-6)


def coarse_arguments(observation: Observation, shape: tuple[int, int]) -> dict[str, Any]:
    """Arguments of `model_for`, by the noise, for a first look at (ny, nx) pixels."""
    nlambda = 3 if faintness(observation) >= _VERY_FAINT_RATIO else 7
    if observation.filter is None:
        return {}
    return {"nlambda": nlambda, "npix": pupil_samples(observation, shape, _COARSE_NPIX)}


def quick_settings(observation: Observation) -> FitSettings:
    """Settings for a first look: `settings_for` with fewer modes and coarser derivatives."""
    settings, faint = settings_for(observation), faintness(observation)
    share = next(share for least, share in _QUICK_CYCLE_SHARES if faint >= least)
    cycles = float(max(4, round(share * settings.cycles[0])))
    prior = settings.prior
    if prior.amplitude_cycles:
        prior = replace(prior, amplitude_cycles=min(prior.amplitude_cycles, cycles))
    return replace(settings, cycles=(cycles,), prior=prior, **_QUICK_SETTINGS)


def nircam_settings(observation: Observation, **changes: Any) -> FitSettings:
    """Return the preset `FitSettings.nircam` for an observation's filter and mask."""
    mask = image_mask(observation.header, observation.name)
    return FitSettings.nircam(observation.filter, image_mask=mask, **changes)


def _cycles_to_edge(filter: str, reach: int) -> float:
    """Spatial frequency that moves light by `reach` pixels of NIRCam, if it is not too high."""
    pixel = 0.031 if is_short_wave(filter) else 0.063
    wavelength = int(filter[1:4]) * 1e-8
    return float(min(_MOST_CYCLES, int(reach * pixel * ARCSEC * JWST_DIAMETER / wavelength)))


# Priors of the modes of a fit: amplitude, wavefront, and its drift between frames.

_WRONG_PRIOR_SCALE_RATIO = 1.5
"""Ratio of the fitted to the fixed scale of modes above which the prior is wrong."""


_SAME_SEQUENCE_DAYS = 2.0 / 24
"""Days between the beginnings of frames of one exposure sequence: nine dithers of a faint star."""

SAME_ROLL_DEG = 1.0
"""Degrees by which the roll may differ within an exposure sequence, whose sources are at the same
pixels."""


def exposure_sequences(observations: Sequence[Observation]) -> list[int]:
    """Number the exposure sequence of every observation, from 0 in the order of first appearance.

    Frames of one star at one roll, each begun at most two hours after another one, are of one
    sequence, such as small-grid dithers. Frames whose date or angle is not known belong to every
    sequence of their star.
    """
    numbers: list[int] = []
    for k, each in enumerate(observations):
        own = [numbers[j] for j in range(k) if _follows(each, observations[j])]
        numbers.append(own[0] if own else 1 + max(numbers, default=-1))
    return numbers


def _follows(one: Observation, other: Observation) -> bool:
    """Whether there is no slew between two observations, as far as is known."""
    if one.target != other.target or one.reference != other.reference:
        return False
    dates = [each.date.mjd for each in (one, other) if each.date is not None]
    if max(dates, default=0.0) - min(dates, default=0.0) > _SAME_SEQUENCE_DAYS:
        return False
    angle, other_angle = one.position_angles, other.position_angles
    if angle is None or other_angle is None:
        return True
    return abs(half_circle(float(angle[0] - other_angle[0]))) <= SAME_ROLL_DEG


def count_modes_below(basis: Basis, cycles: float) -> int:
    """Count the leading modes of a basis whose spatial frequency is at most `cycles`."""
    beyond = torch.nonzero(basis.frequencies > cycles).flatten()
    return int(beyond[0]) if len(beyond) else len(basis)


@dataclass(frozen=True)
class ModePriors:
    """Gaussian priors about zero on the modes: amplitude, wavefront and blocks of drift."""

    amplitude: Tensor  # (amplitude modes,), standard deviations, nm of an imaginary OPD.
    drift: int  # Number of leading modes of the wavefront that may differ between frames.
    # For every frame, the blocks of drift that its wavefront has: first the block of its exposure
    # sequence or, where frames of a sequence share none, its own.
    blocks: tuple[tuple[int, ...], ...]
    # (modes + blocks * drift,), standard deviations relative to the scale of the group.
    shape: Tensor
    group: Tensor  # (modes + blocks * drift,), int64, index of the group in `names`.
    names: tuple[str, ...]
    scales: Tensor  # (groups,), nm; a step of a fit returns others unless they are fixed.
    # Number of modes that the data determine, if the flux is to be marginal, see `Solver`; else 0.
    determined: float = 0.0

    @classmethod
    def of(
        cls, settings: FitSettings, basis: Basis, observations: Sequence[Observation]
    ) -> ModePriors:
        """Return the priors of a fit to frames of these observations."""
        prior, drift, dither = settings.prior, settings.drift, settings.dither_drift
        shape, group, names = [prior.shape(basis)], [basis.group_index], list(basis.groups)
        scales = [prior.scales[name] for name in basis.groups]
        drifting, blocks = 0, []
        if drift is not None and len(observations) > 1:
            drifting = count_modes_below(basis, settings.drift_cycles)
            sequences = list(range(len(observations)))
            if dither is not None:
                sequences = exposure_sequences(observations)
            blocks = [[number] for number in sequences]
            # A frame's wavefront is the shared one, plus the block of its exposure sequence
            # (`drift`), plus a block of its own (`dither`) where the sequence has other frames.
            # Blocks are numbered in this order, and each repeats the leading modes of the shared
            # wavefront.
            kinds = [(drift, "drift", 1 + max(sequences))]
            if dither is not None:
                many = [k for k, each in enumerate(sequences) if sequences.count(each) > 1]
                for number, k in enumerate(many, 1 + max(sequences)):
                    blocks[k].append(number)
                kinds += [(dither, "dither", len(many))] if many else []
            for kind, label, count in kinds:
                shape.append(kind.shape(basis)[:drifting].repeat(count))
                group.append((basis.group_index[:drifting] + len(names)).repeat(count))
                names += [f"{name} {label}" for name in basis.groups]
                scales += [kind.scales[name] for name in basis.groups]
        return cls(
            prior.amplitude_deviation(basis),
            drifting,
            tuple(map(tuple, blocks)),
            torch.cat(shape),
            torch.cat(group),
            tuple(names),
            torch.tensor(scales, dtype=torch.float64),
        )

    @property
    def deviation(self) -> Tensor:
        """Standard deviations of amplitude, wavefront and drift, in this order."""
        return torch.cat([self.amplitude, self.scales[self.group] * self.shape])

    def ratios_if_fixed(self, update: EvidenceUpdate, settings: FitSettings) -> dict[str, float]:
        """Size of the fitted modes relative to their priors, by group; empty if they are fitted."""
        is_fixed = settings.wavefront and not settings.prior.fit_scales
        return self.ratios(update) if is_fixed else {}

    def are_improbable(self, ratios: Mapping[str, float]) -> bool:
        """Whether the wavefront is too large for its prior."""
        of_wavefront = [ratios[name] for name in self.names if ratios]
        return max(of_wavefront, default=0.0) >= _WRONG_PRIOR_SCALE_RATIO

    def counted(self, update: EvidenceUpdate) -> ModePriors:
        """These priors, with the number of modes that the data determine."""
        assert update.variance is not None
        deviation = self.deviation
        shares = 1 - update.variance[-len(deviation) :] / deviation**2
        return replace(self, determined=float(shares.sum()))

    def size(self, update: EvidenceUpdate) -> float:
        """Size of the wavefront that all frames share, relative to its prior."""
        assert update.variance is not None
        blocks = {number for each in self.blocks for number in each}
        first, last = len(self.amplitude), len(self.group) - len(blocks) * self.drift
        count = len(self.amplitude) + len(self.group)
        shared = slice(len(update.step) - count + first, len(update.step) - count + first + last)
        step, variance = update.step[shared], update.variance[shared]
        deviation = self.deviation[first : first + last]
        return float(scale_ratios(step, variance, deviation, torch.zeros_like(self.group[:last])))

    def ratios(self, update: EvidenceUpdate) -> dict[str, float]:
        """Size of the fitted modes relative to their priors, by group, from all unknowns."""
        assert update.variance is not None
        amplitude = torch.zeros(len(self.amplitude), dtype=torch.int64)
        group = torch.cat([amplitude, self.group + 1])
        last = slice(-len(group), None)
        ratios = scale_ratios(update.step[last], update.variance[last], self.deviation, group)
        return dict(zip(["amplitude", *self.names], ratios.tolist(), strict=True))
