"""The work of a job: a reduction, perhaps with an injected planet."""

from __future__ import annotations

import math
from collections import abc
from dataclasses import replace
from pathlib import Path
from typing import Any

from pyklip_diffrender.detection import measured_planet, with_planets
from pyklip_diffrender.reduction import (
    ReduceOptions,
    Reduction,
    prepare,
    summarise,
    write_products,
)
from pyklip_diffrender.refinement import FrameFit, Refinement, nircam_settings
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.surveys.jobs import Injection, Job

__all__ = ["reduce_job"]


def reduce_job(job: Job, folder: Path, memory: float | None = None) -> dict[str, Any]:
    """Reduce a sequence, perhaps with a planet in it, and write the products."""
    changes: dict[str, Any] = {"memory": memory}
    if job.injection is not None and job.base_folder is not None:
        fit = Refinement.read(folder.parent / job.base_folder / "fit.fits")
        first = fit.frames[0].observation
        planet = _planet(job.injection, first.position_angle)
        frames: abc.Sequence[FrameFit] = [
            each for each in fit.frames if not each.observation.reference
        ]
        references = tuple(each.observation for each in fit.frames if each.observation.reference)
        if job.options.disk:
            frames = _with_disk(frames, _sequence(job).cutout(job.options.size).science)
        science = with_planets(frames, [planet])
        sequence = Sequence(first.target, science, references)
        changes |= {"systematics": fit.systematics or "off", "wide": False}
    else:
        sequence = _sequence(job)
    options = _options(job, sequence.science[0], **changes)
    reduction = prepare(sequence, job.opd, options).run()
    write_products(reduction, folder, fit=job.injection is None)
    result = _result(summarise(reduction))
    if job.injection is not None and job.base is not None:
        result["recovered"] = _recovered(reduction, job.injection, frames[0].flux)
    return result


def _sequence(job: Job) -> Sequence:
    return Sequence.from_files(job.files, target=job.target, filter=job.filter, epoch=job.epoch)


def _options(job: Job, frames: Observation, **changes: Any) -> ReduceOptions:
    """Options of a job's reduction; settings that it does not name are those of the preset."""
    keywords = {**job.options.keywords, **changes}
    if job.options.settings:
        keywords["settings"] = nircam_settings(frames, **job.options.settings)
    return ReduceOptions(**keywords)


def _with_disk(
    frames: abc.Sequence[FrameFit], original: abc.Sequence[Observation]
) -> list[FrameFit]:
    """The frames of a fit, with the extended light that was subtracted from them."""
    return [
        replace(frame, observation=replace(frame.observation, data=each.combined().data))
        for frame, each in zip(frames, original, strict=True)
    ]


def _planet(injection: Injection, north: float) -> Planet:
    """Beside the star in the first frame, whose +y axis has the position angle `north`."""
    return Planet(injection.contrast, injection.separation, injection.angle - north)


def _recovered(reduction: Reduction, planet: Injection, flux: float) -> dict[str, Any]:
    """Measure an injected planet: its candidate, or else the position of the injection.

    Its contrast is relative to a star of that flux.
    """
    detection = reduction.detection
    place = _planet(planet, detection.north).offset
    measured = measured_planet(detection, place, flux)._asdict()
    return {key: value if math.isfinite(value) else None for key, value in measured.items()}


def _result(summary: dict[str, Any]) -> dict[str, Any]:
    """Facts of a reduction for the tables and the page of a survey."""
    keys = ("target", "filter", "sentence", "limits", "threshold_snr", "left_out")
    search = summary["wide_field"] or summary
    curve = search["contrast_curve"]
    return {
        **{key: summary[key] for key in keys},
        "candidates": [{"false_alarm_probability": None, **each} for each in search["candidates"]],
        "fit_status": summary["status"]["name"],
        "reduced_chi2": summary["fit"]["reduced_chi2"],
        "error_factor": summary["fit"]["error_factor"],
        "frames": sum(each["use"] == "target" for each in summary["frames"]),
        "curve": {key: curve[key] for key in ("sigmas", "separation_arcsec", "contrast")},
    }
