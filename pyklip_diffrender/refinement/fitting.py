"""`refine`: fit the star in observed frames; fits that continue an earlier one; the star's flux."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from astropy import units as u

from pyklip_diffrender.errors import (
    IncompatibleSetupError,
    MissingOPDError,
    NoValidPixelsError,
)
from pyklip_diffrender.instrument.spectrum import require_star
from pyklip_diffrender.io.headers import known_number
from pyklip_diffrender.io.units import unit_of
from pyklip_diffrender.linear.model import Unknown
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement.annealing import Annealing
from pyklip_diffrender.refinement.fit_result import (
    FrameFit,
    Refinement,
    Status,
    breakdown_explained,
)
from pyklip_diffrender.refinement.forward import Problem, starting_values
from pyklip_diffrender.refinement.settings import (
    OWN_PARAMETERS,
    FitSettings,
    age_of_map,
    settings_for,
)
from pyklip_diffrender.scene.admission import require_agreement
from pyklip_diffrender.scene.detector_pattern import DetectorPattern, require_pattern_of
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.simulation import require_imaged
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.opd import as_opd_map
from pyklip_diffrender.wavefront.priors import WavefrontPrior

# Fits that continue earlier ones, with more modes or other settings.

_log = logging.getLogger(__name__)

_MORE_MODES_CHI2 = 1.15
"""Reduced chi-squared above which a fit is repeated with more modes."""

_DEFAULT_CYCLES = 24.0
"""Highest spatial frequency of the modes if the settings name none, as without a wavefront."""

_FINER_TOLERANCE = 3e-3
"""`FitSettings.tolerance` for continuing a fit with a larger tolerance, such as a first look, that
does not explain its data. From a map three months old, the fit ends where it nearly explains the
data of HIP 17695, and limits are 1.1 times higher."""

_FOREIGN_LIGHT_CHI2 = 5.0
"""Reduced chi-squared above which more modes would not help, because the frame shows more than the
star."""


def continue_from(fit: Refinement, **changes: Any) -> tuple[FitSettings, dict[Unknown, float]]:
    """Return the settings, and the starting values, with which to continue a fit.

    The prior has the final scales of the fit, and the companions are its final ones; `changes`
    are other fields of `FitSettings`. Raises `IncompatibleSetupError` if the fit was read from a
    file without its linear model.
    """
    settings = fit.settings
    reached = {
        "prior": _with_scales(settings.prior, fit.scales, "{}"),
        "drift": settings.drift and _with_scales(settings.drift, fit.scales, "{} drift"),
        "dither_drift": settings.dither_drift
        and _with_scales(settings.dither_drift, fit.scales, "{} dither"),
        "companions": fit.planets,
    }
    warm = dict(zip(fit.linear.unknowns, fit.linear.vector.tolist(), strict=True))
    return replace(settings, **{**reached, **changes}), warm


def _with_scales(prior: WavefrontPrior, scales: Mapping[str, float], label: str) -> WavefrontPrior:
    """Replace scales of a prior by the fitted `scales`; other groups keep their scale."""
    return replace(
        prior, scales={n: scales.get(label.format(n), scale) for n, scale in prior.scales.items()}
    )


def fit_in_stages(
    problems: Sequence[Problem],
    settings: FitSettings,
    warm: Mapping[Unknown, float] | None = None,
    *,
    progress: bool,
    same_frames: Refinement | None = None,
) -> Refinement:
    """Refine with the basis of the settings, or the first default basis that explains the data.

    `problems` has one entry per frame, and `warm` the starting values. Derivatives of a fit of the
    `same_frames` are used again. The `cycles` of the result's settings begin with the last basis.
    """
    pupil = problems[0].model.entrance
    fit: Refinement | None = None
    # The number of modes that drift is fixed.
    grows = settings.wavefront and settings.drift is None and settings.basis is None
    for k in range(max(1, len(settings.cycles)) if grows else 1):
        adapted, last = replace(settings, cycles=settings.cycles[k:]), fit
        if last is not None:
            _log.info("residuals have structure: modes up to %g cycles", settings.cycles[k])
            adapted, warm = continue_from(last, cycles=settings.cycles[k:])
        most = settings.cycles[k] if settings.cycles else _DEFAULT_CYCLES
        basis = settings.basis or default_basis(most, pupil)
        fit = _continued(
            last, Annealing(problems, adapted, basis, warm, progress, same_frames).run()
        )
        if not fit.status.usable or not _MORE_MODES_CHI2 < fit.reduced_chi2 < _FOREIGN_LIGHT_CHI2:
            break
    assert fit is not None
    is_rough = settings.tolerance > _FINER_TOLERANCE and fit.status is Status.MODEL_MISMATCH
    if is_rough and fit.reduced_chi2 < _FOREIGN_LIGHT_CHI2:
        adapted, warm = continue_from(fit, tolerance=_FINER_TOLERANCE)
        fit = _continued(fit, Annealing(problems, adapted, basis, warm, progress, fit).run())
    return fit


def _continued(earlier: Refinement | None, fit: Refinement) -> Refinement:
    """A fit with the time and the history of the earlier fit that it continues."""
    if earlier is None:
        return fit
    seconds, history = earlier.seconds + fit.seconds, earlier.history + fit.history
    return replace(fit, seconds=seconds, history=history)


def refine_again(fit: Refinement, *, progress: bool = False, **changes: Any) -> Refinement:
    """Continue a refinement with other settings: `changes` are fields of `FitSettings`.

    Raises `IncompatibleSetupError` if the fit was read from a file without its linear model.
    """
    settings, warm = continue_from(fit, **changes)
    problems = [
        Problem(frame.model, frame.observation, fit.initial, frame.start, fit.pattern)
        for frame in fit.frames
    ]
    with breakdown_explained(problems[0].observation.name):
        again = fit_in_stages(problems, settings, warm, progress=progress, same_frames=fit)
    return replace(again, catalogue_error=fit.catalogue_error, catalogue_flux=fit.catalogue_flux)


def align_frame(
    fit: Refinement,
    observation: Observation,
    settings: FitSettings,
    *,
    pattern: DetectorPattern | None,
    companions: int = 0,
) -> Refinement:
    """Fit place, flux and background of a frame with the wavefront of another fit.

    Lyot stop, blur and internal aberrations keep their values in `fit`. Parameters in
    `OWN_PARAMETERS` are free, and so are at most `companions` point sources beside the star.
    Pixels that are bad in all frames of `fit` with the same detector pixels are left out. Raises
    `IncompatibleSetupError` for a frame that cannot share a fit with the frames of `fit`, and
    `ShapeError` for a frame of another shape.
    """
    first = fit.frames[0]
    require_agreement([*(frame.observation for frame in fit.frames), observation])
    for frame in fit.frames:
        other = frame.observation
        if None is not other.first_pixel == observation.first_pixel:
            known = other.valid.any(axis=0)
            observation = replace(observation, valid=observation.valid & known)
    if companions:
        # The companions of a fit belong to the target, and are not in frames of a reference star.
        observation = replace(observation, reference=False)
    own = tuple(name for name in settings.free if name in OWN_PARAMETERS)
    alone = replace(
        settings,
        free=own,
        wavefront=False,
        drift=None,
        dither_drift=None,
        companions=(),
        max_companions=companions,
        deviations={n: d for n, d in settings.deviations.items() if n in own},
    )
    # What is not the frame's own keeps the values of the fit: they are the starting values of
    # parameters that are not free.
    shared = {
        name: value
        for name, value in first.values.items()
        if name in fit.model.parameters and name not in own
    }
    start = starting_values(fit.model, observation, {})
    initial = replace(fit.initial, data=fit.wavefront)
    problem = Problem(fit.model, observation, initial, {**shared, **start}, pattern)
    with breakdown_explained(observation.name):
        return fit_in_stages([problem], alone, progress=False)


def join_frames(
    fit: Refinement,
    others: Sequence[Refinement],
    settings: FitSettings,
    *,
    pattern: DetectorPattern | None,
    companions: Sequence[Planet] | None = None,
    progress: bool = False,
) -> Refinement:
    """Continue a fit with more frames in its likelihood, such as frames of reference stars.

    `others` are the new frames, aligned with the fit by `align_frame`; `settings` are the fit's
    with a prior on the drift between frames, and `companions` by default the fit's. Raises
    `IncompatibleSetupError` if the fit was read from a file without its linear model.
    """
    # The new frames have nearly the wavefront of the fit. A few steps of all unknowns then take
    # the place of a fit from the map on.
    settings, reached = continue_from(
        replace(fit, settings=settings),
        companions=fit.planets if companions is None else tuple(companions),
    )
    count = len(fit.frames)
    warm = {
        # A single frame has no unknowns of its own.
        each._replace(frame=0) if count == 1 and each.name in OWN_PARAMETERS else each: value
        for each, value in reached.items()
    }
    for k, other in enumerate(others, count):
        for name in OWN_PARAMETERS:
            values = other.frames[0].values.get(name, ())
            warm |= {Unknown(name, i, k): float(value) for i, value in enumerate(values)}
    problems = [
        Problem(frame.model, frame.observation, fit.initial, frame.start, pattern)
        for frame in fit.frames
    ]
    for (frame,) in (other.frames for other in others):
        start = starting_values(fit.model, frame.observation, {})
        problems.append(Problem(fit.model, frame.observation, fit.initial, start, pattern))
    with breakdown_explained(problems[0].observation.name):
        joined = fit_in_stages(problems, settings, warm, progress=progress)
    return replace(joined, catalogue_error=fit.catalogue_error, catalogue_flux=fit.catalogue_flux)


# `refine`: fit the star in observed frames, starting from an OPD map.

Start = Mapping[str, Any]


def refine(
    model: OpticalSystem,
    observation: Observation | Sequence[Observation],
    opd: Any,
    *,
    settings: FitSettings | None = None,
    start: Start | None = None,
    pattern: DetectorPattern | None = None,
    progress: bool = False,
) -> Refinement:
    """Refine an outdated wavefront until the rendered star matches the data.

    Parameters
    ----------
    model : OpticalSystem
        Model of the frames, whose detector must have the shape of the observations.
    observation : Observation or sequence of Observation
        The frames of one observation see the same star through the same wavefront and are
        averaged. Several observations (rolls, dithers, a reference star) are fitted together:
        each has its own star position, flux and background, their wavefront is shared, or differs
        by as much as `FitSettings.drift` allows, and companions rotate with the position angle.
    opd : path, OPDMap, Quantity, array or "flat"
        The wavefront to start from, entrance-pupil orientation; bare arrays in metres. The map is
        resampled to the model's pupil. "flat" stands for a flat wavefront.
    settings : FitSettings, optional
        Default `FitSettings.nircam()` for frames whose header says NIRCam, else `FitSettings()`.
    start : dict, optional
        Starting values by parameter name, for all observations. "detector_shift" is by default the
        place of the star in the observation.
    pattern : DetectorPattern, optional
        Known detector pattern of other stars, see `learn_pattern`.
    progress : bool
        Show progress bars.

    Returns
    -------
    Refinement
        The best iterate; check its `status`.

    Raises
    ------
    MissingOPDError
        If `opd` is None.
    IncompatibleSetupError
        For settings that do not fit the model and the observations, and for a pattern of another
        filter, mask or detector, of other pixels, or of the star itself.
    ShapeError, UnitError, NonFiniteError, NoValidPixelsError, CorruptFileError
        As their names say.
    RefinementError
        If the frames show something so different from the model that the equations cannot be
        solved.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> frames = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frames, opd, settings=dr.FitSettings(cycles=6))
    >>> fit.status.name
    'CONVERGED'
    """
    if opd is None:
        raise MissingOPDError(
            "refine needs a wavefront to start from: a path to an OPD map, an array in metres, "
            "'flat' if there is none, or random_opd(seed) to try things out"
        )
    if not isinstance(model, OpticalSystem):
        raise IncompatibleSetupError(
            f"model: got a {type(model).__name__}, expected an OpticalSystem. The order of the "
            "arguments is refine(model, observation, opd)"
        )
    observations = _listed(observation)
    require_agreement(observations)
    adapted = settings_for(observations[0]) if settings is None else settings
    if not isinstance(adapted, FitSettings):
        raise IncompatibleSetupError(
            f"settings: got a {type(adapted).__name__}, expected FitSettings"
        )
    if adapted.free == FitSettings().free:
        # A system without a Lyot stop has no parameters of one.
        available = (*model.parameters, "flux", "background")
        adapted = replace(adapted, free=tuple(name for name in adapted.free if name in available))
    require_imaged(model, adapted.companions, "companions")
    if pattern is not None:
        for each in observations:
            require_pattern_of(pattern, each)
    wavefront = as_opd_map(opd)
    problems = [
        Problem(model, each, wavefront, starting_values(model, each, start or {}), pattern)
        for each in observations
    ]
    with breakdown_explained(observations[0].name):
        return fit_in_stages(problems, adapted, progress=progress)


def _listed(observation: Any) -> list[Observation]:
    """One observation or several as a list; raises for anything else, and for none."""
    if isinstance(observation, Observation):
        return [observation]
    # A text has members, too.
    is_path = isinstance(observation, str | os.PathLike)
    listed = list(observation) if isinstance(observation, Iterable) and not is_path else []
    wrong = next((each for each in listed if not isinstance(each, Observation)), None)
    if is_path or wrong is not None or not isinstance(observation, Iterable):
        got = observation if wrong is None else wrong
        what = repr(os.fspath(got)) if isinstance(got, str | os.PathLike) else type(got).__name__
        raise IncompatibleSetupError(
            f"observation: got {what}, expected an Observation or several, such as the "
            "attribute science of ExposureSequence.from_files(files).cutout(size)"
        )
    if not listed:
        raise NoValidPixelsError("observation: got an empty sequence, expected at least one")
    return listed


# The flux of the star: from a fit to Jansky, and from a catalogue into a fit.

_FLUX_ERROR = 0.1
"""Relative error of the star's flux in real frames with a map of the day, if no catalogue says it.
Only diffracted light is seen, and the prior on the wavefront decides how much of it a star has:
fits with a star 10 % brighter or fainter explain real frames nearly as well
(docs/validation/real_frames.md)."""

_FLUX_ERROR_OLD_MAP = 0.3
"""Relative error if the map is too old for the preset's prior: in frames of stpsf whose wavefront
had changed by 38 nm rms, stars came out 1.0 to 1.5 times as bright as they are, and 1.0 to 2.0
times in first looks (docs/validation/references.md). Until then the error grows in proportion to
the age of the map: with one of 50 days, fits of the rolls of G 7-34 alone have a star up to 1.24
times as bright as fits with the rolls of HIP 17695."""

_FLUX_ERROR_FLAT_START = 0.4
"""Relative error for fits that start from a flat wavefront: two rolls of G 7-34 came out 2 % too
faint in F444W, and 44 % too bright in F356W."""

_HELD_FLUX_ERROR = 0.003
"""Relative deviation of a star's flux from the catalogue's. The posterior of a fit understates
the error of the flux, so that a prior as wide as the catalogue's error would hardly move it."""

_SETTLED_FLUX_DIFFERENCE = 0.005
"""Largest relative difference between the star's flux and the catalogue's after a fit: a tenth of
the error of a good catalogue."""

_MOST_HELD_FITS = 3
"""Largest number of fits with the flux held; each starts from the one before."""

_HELD_FLUX_FACTOR = 100.0
"""Factor by which the next of these fits holds the flux more tightly."""

_DISAGREEING_FLUX_RATIO = 3.0
"""Ratio of a star's stated and fitted flux, beyond the error of the fit, from which one of the two
is wrong. The fitted flux was at most 1.31 times too bright in forty simulated visits, and
from a flat wavefront 1.44 times in real frames. The square is allowed where a fit from a flat
wavefront did not explain them (3.7 times), and where only the alignment is fitted (6 % with the
wavefront of a map, 4.2 times with a flat one). Units differ by at least a thousand."""

_UNITS_PROBABLY_MEANT = (
    u.mJy, u.uJy, u.nJy, u.ABmag, u.W / u.m**2 / u.um, u.erg / u.s / u.cm**2 / u.AA,
    u.erg / u.s / u.cm**2 / u.Hz,
)  # fmt: skip
"""Units in which a number that is not in Jy may have been stated."""

_FRAME_UNIT = u.MJy / u.sr


def _pixel_area(observation: Observation) -> float | None:
    """Solid angle of a pixel, sr, in the photometric calibration; None without calibration."""
    area = known_number(observation.header, "PIXAR_SR")
    if not (observation.is_nircam and observation.unit.is_equivalent(_FRAME_UNIT)):
        return None
    return area if area is not None and area > 0 else None


def require_calibrated(observation: Observation) -> None:
    """Raise `IncompatibleSetupError` for a frame without photometric calibration."""
    if _pixel_area(observation) is None:
        raise IncompatibleSetupError(
            f"star_flux: {observation.name} is not calibrated: expected a frame of NIRCam in units "
            "of surface brightness, with PIXAR_SR in its header"
        )


def jansky_per_unit(frame: FrameFit) -> float | None:
    """Flux density, Jy, of a star of flux 1 in the unit of a fit; None without calibration.

    Only frames of NIRCam in units of surface brightness, with PIXAR_SR in their header, have a
    calibration.
    """
    area = _pixel_area(frame.observation)
    # The fitted flux is the light that the entrance pupil collects, in the unit of the pixels. What
    # the pipeline calibrates is the light of a source far from the occulter, all of its image
    # through the Lyot stop. This light is the fitted flux times the transmission of the stop, times
    # the solid angle of a pixel for which the pipeline calculated surface brightness (PIXAR_SR).
    if area is None:
        return None
    return float(frame.transmission * area * frame.observation.unit.to(_FRAME_UNIT) * 1e6)


def to_jansky(star_flux: float | str | u.Quantity) -> float:
    """Flux density of a star in Jy, from a number of Jy, a Quantity, an AB magnitude or text.

    Raises `IncompatibleSetupError` for anything that is not the flux density of a star.
    """
    try:
        if isinstance(star_flux, str):
            parts = re.fullmatch(r"\s*([-+.\d]+(?:[eE][-+]?\d+)?)\s*(.*)", star_flux)
            if parts is None:
                raise ValueError("no number")
            unit = unit_of(parts[2]) if parts[2] else u.Jy
            if unit is None:
                raise ValueError("no unit")
            value = float(parts[1]) << unit
        else:
            value = star_flux if hasattr(star_flux, "unit") else u.Quantity(star_flux, u.Jy)
        jansky = float(value.to_value(u.Jy))
    except (TypeError, ValueError) as error:  # Units that cannot be converted are TypeErrors.
        raise IncompatibleSetupError(
            f"star_flux: got {star_flux!r}, expected a flux density per frequency, such as "
            "'0.45 Jy' or '403 mJy', or an AB magnitude, such as '9.8 mag(AB)'. A Vega magnitude "
            "is not converted; a spectrum is, see star_flux_density (--star-sed)"
        ) from error
    require_star(jansky, "star_flux")
    return jansky


def require_agreement_of_flux(fit: Refinement, stated: float) -> None:
    """Raise IncompatibleSetupError for a flux density, Jy, that cannot be the star's of a fit.

    The fit may be of the alignment alone, which tells a mistaken unit.
    """
    frame, error = fit.frames[0], star_flux_error(fit)
    seen, limit = _scale(frame) * frame.flux, _DISAGREEING_FLUX_RATIO * (1 + error)
    if not (fit.status.calibrated or (fit.settings.wavefront and fit.initial.data.any())):
        limit *= _DISAGREEING_FLUX_RATIO
    if 1 / limit < stated / seen < limit:
        return
    wavelength = float(np.mean(fit.model.bandpass.wavelengths)) * u.m
    meant = ""
    for unit in _UNITS_PROBABLY_MEANT:
        jansky = (stated * unit).to_value(u.Jy, u.spectral_density(wavelength))
        if 1 / limit < jansky / seen < limit:
            meant = (
                f" {stated:.3g} {unit} would be {jansky:.3g} Jy: state the unit, or convert it. "
                "A spectrum has its unit in the header of its file or the names of its columns."
            )
            break
    raise IncompatibleSetupError(
        f"star_flux: got {stated:.3g} Jy, expected about {seen:.3g} Jy (to {100 * error:.0f} %), "
        f"by the light that is diffracted around the mask in {frame.observation.name}.{meant} "
        "If the flux is not given, that light determines it"
    )


def with_star_flux(
    fit: Refinement,
    star_flux: float,
    error: float,
    *,
    held: float = _HELD_FLUX_ERROR,
    progress: bool = False,
) -> Refinement:
    """Continue a fit of one star with its flux held at a catalogue's value, Jy in the filter.

    `error` is the relative standard deviation of the catalogue's flux, which errors of contrasts
    then include; `held` is the relative deviation from it that the first fit allows. Raises
    `IncompatibleSetupError` if the frames have no photometric calibration, and for a flux that
    differs from the fitted one by more than a factor of three and its error.
    """
    for frame in fit.frames:
        require_calibrated(frame.observation)
    require_agreement_of_flux(fit, star_flux)
    for _ in range(_MOST_HELD_FITS):
        # The wavefront makes up for the change of the diffracted light, so that contrasts refer to
        # the catalogue's star.
        frames = [
            replace(frame, start={**frame.start, "flux": star_flux / _scale(frame)})
            for frame in fit.frames
        ]
        known = replace(fit, frames=tuple(frames), catalogue_error=error, catalogue_flux=star_flux)
        deviations = {**fit.settings.deviations, "flux": held}
        fit = refine_again(known, progress=progress, deviations=deviations)
        shares = [_scale(frame) * frame.flux / star_flux for frame in fit.frames]
        if max(abs(share - 1) for share in shares) < _SETTLED_FLUX_DIFFERENCE:
            break
        # The light that passes the stop has changed with the wavefront and the pupil's amplitude,
        # or the frames pull at the flux more than it is held.
        held /= _HELD_FLUX_FACTOR
    return fit


def _scale(frame: FrameFit) -> float:
    scale = jansky_per_unit(frame)
    assert scale is not None
    return scale


def star_flux_error(fit: Refinement) -> float:
    """Relative error of the star's flux that is not in the fit's own covariance.

    The error of the catalogue, if there is one. Otherwise, for real frames, where only diffracted
    light tells how bright the star is, 10 % with an OPD map of the day, which grows to 30 % with
    one of 60 days or more, and 40 % without a map. It is 0 for other frames.
    """
    observation = fit.frames[0].observation
    if fit.catalogue_error is not None:
        return fit.catalogue_error
    if not observation.is_nircam:
        return 0.0
    if not fit.initial.data.any():
        return _FLUX_ERROR_FLAT_START
    date = observation.date
    age = age_of_map(None if date is None else fit.initial.days_after(date))
    return _FLUX_ERROR + min(age, 1.0) * (_FLUX_ERROR_OLD_MAP - _FLUX_ERROR)
