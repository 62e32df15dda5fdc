"""The work of a job: a reduction, perhaps with an injected planet."""

from __future__ import annotations

import math
from collections import abc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pyklip_diffrender.detection import measured_planet
from pyklip_diffrender.reduction import Reduction, reduce
from pyklip_diffrender.refinement import FrameFit, GaussNewton, Refinement, Systematics
from pyklip_diffrender.report import summarise, write_report
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.surveys.jobs import Injection, Job

__all__ = ["planet_image", "reduce_job"]


def reduce_job(job: Job, folder: Path, memory: float | None = None) -> dict[str, Any]:
    """Reduce a sequence, perhaps with a planet in it, and write the products."""
    options = job.options
    common: dict[str, Any] = {
        "size": options.size,
        "threshold": options.threshold,
        "memory": memory,
        "disk": options.disk,
        "settings": GaussNewton.nircam(**options.settings) if options.settings else None,
    }
    if job.injection is not None and job.base is not None:
        fit = Refinement.read(folder.parent / job.base / "fit.fits")
        sequence = _with_planet(_with_disk(fit.frames, job), job.injection)
        reduction = reduce(sequence, job.opd, systematics=fit.systematics or "off", **common)
        extra = {"recovered": _recovered(reduction, job.injection)}
    else:
        sequence = Sequence.from_files(job.files, target=job.target, filter=job.filter)
        known: Any = options.systematics
        if known not in ("auto", "references", "off"):
            known = Systematics.read(known)
        reduction, extra = (
            reduce(sequence, job.opd, systematics=known, wide=options.wide, **common),
            {},
        )
    written = reduction.detection.write(folder)
    if reduction.wide is not None:
        written += reduction.wide.write(folder)
    if reduction.disk is not None:
        written.append(reduction.disk.write(folder))
    # The linear model takes twenty times the rest of the fit.
    written.append(reduction.fit.write(folder / "fit.fits", linear=False))
    if reduction.systematics is not None:
        written.append(reduction.systematics.write(folder / "systematics.fits"))
    write_report(reduction, folder, written)
    return {**_result(summarise(reduction)), **extra}


def planet_image(
    frame: FrameFit, offset: tuple[float, float], roll: float = 0.0
) -> NDArray[np.float64]:
    """Image of a planet of contrast 1 beside the star of a fitted frame.

    Parameters
    ----------
    frame : FrameFit
    offset : tuple of float
        x, y from the star in the orientation of the first frame, arcsec.
    roll : float
        Degrees by which the sky is turned in this frame, counter-clockwise, as
        `Observation.roll_from` says.

    Returns
    -------
    ndarray, (ny, nx)
        In the unit of the observation.
    """
    values = frame.optical_values
    star = values.pop("star_offset", torch.zeros(2, dtype=torch.float64))
    away = torch.tensor(Planet.from_offset(1.0, *offset).rotated(roll).offset, dtype=torch.float64)
    with torch.no_grad():
        image = frame.model(torch.from_numpy(frame.opd), star_offset=star + away, **values)
    return frame.flux * np.asarray(image.double().cpu().numpy())


def _with_disk(frames: abc.Sequence[FrameFit], job: Job) -> list[FrameFit]:
    """The frames of a fit, with the extended light that was subtracted from them."""
    if not job.options.disk:
        return list(frames)
    files = Sequence.from_files(job.files, target=job.target, filter=job.filter)
    original = files.cutout(job.options.size).science
    return [
        replace(frame, observation=replace(frame.observation, data=each.combined().data))
        for frame, each in zip(frames, original, strict=True)
    ]


def _with_planet(frames: abc.Sequence[FrameFit], planet: Injection) -> Sequence:
    """The frames of a fit with a planet added."""
    first = frames[0].observation
    science = []
    for frame in frames:
        observation = frame.observation
        light = planet_image(
            frame, _place(planet, first.position_angle), observation.roll_from(first)
        )
        science.append(replace(observation, data=observation.data + planet.contrast * light))
    return Sequence(first.target, tuple(science))


def _place(planet: Injection, north: float) -> tuple[float, float]:
    """x, y on the first frame, arcsec; `north` is the position angle of its +y axis."""
    return Planet(planet.contrast, planet.separation, planet.angle - north).offset


def _recovered(reduction: Reduction, planet: Injection) -> dict[str, Any]:
    """What is measured of an injected planet: of its candidate, else at its place."""
    found = reduction.detection
    place = np.array(_place(planet, found.north))
    row, detected = measured_planet(found, place)
    values = {key: float(row[key]) for key in ("contrast", "contrast_error", "snr")}
    finite = {key: value if math.isfinite(value) else None for key, value in values.items()}
    return {**finite, "detected": detected}


def _result(summary: dict[str, Any]) -> dict[str, Any]:
    """What the tables and the page of a survey need of a reduction."""
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
