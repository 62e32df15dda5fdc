"""Summary of a reduction, as plain values for JSON."""

from __future__ import annotations

import math
import platform
from collections.abc import Sequence
from dataclasses import asdict, fields, is_dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender._version import __version__
from pyklip_diffrender.detection import Detection, Disk, WideField
from pyklip_diffrender.io.headers import known_number, known_text
from pyklip_diffrender.io.tables import labelled, plain_rows
from pyklip_diffrender.io.units import east_and_north
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.pattern import pattern_size
from pyklip_diffrender.reduction.pages import sentence
from pyklip_diffrender.reduction.pipeline import ReductionResult
from pyklip_diffrender.reduction.remarks import advice
from pyklip_diffrender.refinement import FrameFit, Refinement
from pyklip_diffrender.scene.detector_pattern import caveat
from pyklip_diffrender.scene.observation import Observation

LIMITS_ARCSEC = (0.5, 1.0, 1.5, 2.0)
"""Separations at which limits are stated, arcsec."""

_STATED_LIBRARIES = ("torch", "numpy", "scipy", "astropy", "photutils", "matplotlib")


def summarise(reduction: ReductionResult, klip: QTable | None = None) -> dict[str, Any]:
    """Return what a reduction shows as nested dicts and lists of plain values.

    `klip` is KLIP's contrast curve of the same frames. Keys end in the unit of their values; None
    stands for what is not known.
    """
    sequence, detection = reduction.sequence, reduction.detection
    fit = reduction.fit
    contributions = [asdict(each) for each in reduction.visit.contributions]
    for each in contributions:
        if klip is not None and each["use"] == "not used":
            each["use"] = "KLIP only"
    uses = {each["name"]: each["use"] for each in contributions}
    first = sequence.science[0]
    dates = [each.date for each in sequence.science if each.date is not None]
    summary = {
        "target": sequence.target,
        "instrument": known_text(first.header, "INSTRUME"),
        "filter": sequence.filter,
        "image_mask": known_text(first.header, "CORONMSK"),
        "program": known_text(first.header, "PROGRAM"),
        "exposure_s": _exposure(sequence.science),
        "first_date": min(dates).isot if dates else None,
        "last_date": max(dates).isot if dates else None,
        "epoch_mjd": detection.sky.mjd,
        "star": _star(detection),
        "accuracy": reduction.accuracy,
        "threshold_snr": detection.threshold,
        "oriented": first.position_angles is not None,
        "status": _status(reduction),
        "fit": {
            "reduced_chi2": fit.reduced_chi2,
            "chi2_per_pixel": fit.chi2_per_pixel,
            "model_error": fit.model_error,
            "error_factor": detection.scatter,
            "rings": plain_rows(detection.rings),
        },
        "opd": _opd(fit, first),
        "pattern": _pattern(reduction),
        "pattern_origin": reduction.pattern_origin,
        "extended": reduction.extended,
        "candidates": _candidates(reduction),
        "wide_field": None if reduction.wide is None else _wide_field(reduction.wide),
        "disk": None if reduction.disk is None else _disk(reduction.disk),
        "limits": _limits(detection),
        "contrast_curve": _curve(detection.contrast_curve),
        "klip_curve": None if klip is None else _curve(klip),
        "injections": None if reduction.injections is None else _injected(reduction.injections),
        "completeness": _completeness(reduction),
        "frames": [
            *(
                _frame(each, "target") | {"bad_pixels": _bad_pixels(each, fitted)}
                # Frames of reference stars follow the target's.
                for each, fitted in zip(sequence.science, fit.frames, strict=False)
            ),
            *(_frame(each, uses.get(each.name, "not used")) for each in sequence.references),
        ],
        "visit": {
            "gain": reduction.visit.gain,
            "where": reduction.visit.where,
            "contributions": contributions,
        },
        "admission": plain_rows(sequence.table),
        "left_out": [
            *({"name": name, "reason": reason} for name, reason in sequence.excluded),
            *({"name": f"reference star {n}", "reason": why} for n, why in reduction.failed),
        ],
        "settings": _settings(fit.settings),
        "seconds": sum(each.seconds for each in (fit, *reduction.references)),
        "versions": {
            "pyklip_diffrender": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in _STATED_LIBRARIES},
        },
    }
    summary = {"sentence": sentence(summary), **summary}
    return _plain(summary)


def _status(reduction: ReductionResult) -> dict[str, Any]:
    """How the fit of the star ended, and what to do about it."""
    status, detection = reduction.fit.status, reduction.detection
    return {
        "name": status.name,
        "message": status.message,
        "advice": advice(
            status,
            patterned=reduction.pattern is not None,
            remark=f"{detection.remark} {reduction.remark}".strip(),
        ),
        "usable": status.usable,
        "calibrated": status.calibrated,
    }


def wavefronts(fit: Refinement) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The wavefront before and after the fit, nm, without piston; NaN outside the pupil.

    The wavefront after the fit is the first frame's.
    """
    lit = fit.model.entrance.lit.cpu().numpy()
    before = resample(fit.initial.data, len(fit.wavefront))
    maps = [1e9 * opd for opd in (before, fit.wavefront)]
    before, after = (np.where(lit, each - each[lit].mean(), np.nan) for each in maps)
    return before, after


def _opd(fit: Refinement, frame: Observation) -> dict[str, Any]:
    date, days = fit.initial.date, None
    if date is not None and frame.date is not None:
        days = frame.date.mjd - date.mjd
    before, after = wavefronts(fit)
    return {
        "name": fit.initial.name,
        "date": None if date is None else date.isot,
        "days_before_first_frame": days,
        "sha256": fit.initial.sha256,
        "rms_nm": np.nanstd(before),
        "refined_rms_nm": np.nanstd(after),
        "change_rms_nm": np.nanstd(after - before),
    }


def _pattern(reduction: ReductionResult) -> dict[str, Any] | None:
    used = reduction.pattern
    if used is None:
        return None
    provenance = {key: used.provenance.get(key, []) for key in ("stars", "frames")}
    fitted = {each.observation.target for fit in reduction.references for each in fit.frames}
    size, error = pattern_size(reduction.fit) or (None, None)
    return {
        "name": used.name,
        **provenance,
        # Reference frames of this sequence need not be where the pattern comes from.
        "own_stars": [star for star in provenance["stars"] if star in fitted],
        "other_stars": [star for star in provenance["stars"] if star not in fitted],
        "size": size,
        "size_error": error,
        "caveat": caveat(used, reduction.sequence.science[0]),
    }


def _star(detection: Detection) -> dict[str, Any] | None:
    """Flux density of the star; None for frames without photometric calibration."""
    if detection.sky.star is None:
        return None
    value, error = detection.sky.star
    known = detection.fit.catalogue_flux is not None
    return {
        "flux_density_Jy": value,
        "flux_density_error_Jy": error,
        "source": "star_flux" if known else "diffracted light",
    }


def _candidates(reduction: ReductionResult) -> list[dict[str, Any]]:
    """Candidates; the ones that look like extended light have no false-alarm probability."""
    rows = plain_rows(reduction.detection.candidates)
    if reduction.extended:
        rows = [each | {"false_alarm_probability": None} for each in rows]
    return rows


def _wide_field(wide: WideField) -> dict[str, Any]:
    """Candidates and limits in the whole frames."""
    return {
        "candidates": plain_rows(wide.candidates),
        "contrast_curve": _curve(wide.contrast_curve),
    }


def _disk(disk: Disk) -> dict[str, Any]:
    """Extended light in numbers."""
    return {
        "contrast": disk.contrast,
        "sources": len(disk.contrasts),
        "chi2_decrease": disk.gain,
        "hidden": float(disk.hides_points.mean()),
        "position_angle_deg": disk.orientation,
    }


def _injected(planets: QTable) -> dict[str, Any]:
    """Injected planets, and how well they were recovered.

    Pulls are differences from the injected contrasts over their errors.
    """
    ratio = np.asarray(planets["contrast"] / planets["injected"])
    pull = np.asarray((planets["contrast"] - planets["injected"]) / planets["contrast_error"])
    several = len(pull) > 1
    return {
        "count": len(planets),
        "detected": np.sum(planets["detected"]),
        "mean_ratio": ratio.mean(),
        "mean_ratio_error": ratio.std(ddof=1) / math.sqrt(len(ratio)) if several else None,
        "pull_deviation": pull.std(ddof=1) if several else None,
        "within_one_error": np.mean(np.abs(pull) < 1),
        "strength": planets.meta["strength"],
        "planets": plain_rows(planets),
    }


def _completeness(reduction: ReductionResult) -> dict[str, Any] | None:
    """Contrasts at which 50 and 95 % of planets are found, None where there are none."""
    fractions, curve = reduction.completeness, reduction.detection.contrast_curve
    if fractions is None:
        return None
    places, limits = curve["separation"].value, np.log(curve["contrast"])
    return {
        **fractions.meta,
        "planets": fractions["planets"].max(),
        "limit": np.exp(np.interp(fractions.meta["separation_arcsec"], places, limits)),
    }


def _curve(curve: QTable) -> dict[str, Any]:
    columns = {labelled(curve, name): np.asarray(curve[name]) for name in curve.colnames}
    return {"sigmas": curve.meta["sigmas"], **columns}


def _limits(detection: Detection) -> list[dict[str, Any]]:
    """The contrast curve at a few separations, or at its end if it reaches none of them."""
    curve = detection.contrast_curve
    if not len(curve):
        return []
    separation = curve["separation"].to_value("arcsec")
    inside = [s for s in LIMITS_ARCSEC if separation[0] - 1e-6 <= s <= separation[-1] + 1e-6]
    rows = []
    # Limits fall by orders of magnitude with the separation: their logarithms are interpolated.
    for separation_arcsec in inside or [separation[-1]]:
        values = {
            name: float(np.exp(np.interp(separation_arcsec, separation, np.log(curve[name]))))
            for name in ("contrast", "lowest", "highest", "known_star", "small_sample")
        }
        star = detection.sky.star_jansky
        known = {} if star is None else _photometry(star * values["contrast"], detection.sky.vega)
        rows.append(
            {
                "separation_arcsec": float(separation_arcsec),
                "delta_mag": -2.5 * math.log10(values["contrast"]),
                **values,
                **known,
            }
        )
    return rows


def _photometry(jansky: float, vega: float | None) -> dict[str, float]:
    """Flux density with AB and Vega magnitude; `vega` is the flux density of magnitude 0, Jy."""
    known = {"flux_density_Jy": jansky, "ab_mag": (jansky * u.Jy).to_value(u.ABmag)}
    return known if vega is None else known | {"vega_mag": -2.5 * math.log10(jansky / vega)}


def _frame(observation: Observation, use: str) -> dict[str, Any]:
    oriented = observation.position_angles is not None
    return {
        "use": use,
        "star": observation.target,
        "date": None if observation.date is None else observation.date.isot,
        "position_angle_deg": observation.position_angle if oriented else None,
        "integrations": observation.count,
        "exposure_s": known_number(observation.header, "EFFEXPTM"),
        "pixels_used": observation.valid.mean(),
        "file": observation.name,
    }


def _exposure(frames: Sequence[Observation]) -> float | None:
    """Exposure time of all frames, s; None where one does not say it."""
    times = [known_number(each.header, "EFFEXPTM") for each in frames]
    known = [each for each in times if each is not None]
    return sum(known) if len(known) == len(times) else None


def _bad_pixels(observation: Observation, fitted: FrameFit) -> list[list[float]]:
    """Good pixels of the file that the fit has left out, in arcsec from the star.

    Offsets to the east and to the north, or x and y where the orientation is not known.
    """
    left_out = observation.valid.any(axis=0) & ~fitted.observation.valid.any(axis=0)
    places = fitted.grid[left_out]
    if observation.north is not None:
        places = places @ east_and_north(observation.north).T
    return [[round(float(v), 3) for v in place] for place in places]


def _settings(settings: Any) -> dict[str, Any]:
    values = {each.name: getattr(settings, each.name) for each in fields(settings)}
    # JSON has no infinity, and None means something else here.
    return {name: "inf" if value == math.inf else value for name, value in values.items()}


def _plain(value: Any) -> Any:
    """Nested values as JSON has them; what is not a finite number becomes None."""
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(_settings(value))
    return str(value)
