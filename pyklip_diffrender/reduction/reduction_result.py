"""The result of a reduction, and whether its candidates are parts of extended light."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray
from scipy import stats

from pyklip_diffrender.detection import Detection, Disk, WideField
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.reduction.visit import Visit
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.scene.systematics import Systematics

__all__ = ["ReductionResult", "looks_extended", "on_extended_light"]


# Whether candidates are parts of extended light, such as a disk, rather than planets.

_UNLIKELY = 0.01
"""Probability below which unrelated sources are not taken to be arranged by chance."""

_NEAR = 1.5
"""Separation of neighbours, lambda/D: one extended source is found as several this close."""


def looks_extended(candidates: QTable, resolution: float, edge: float) -> str:
    """Say how candidates are arranged like extended light; empty if they may be so by chance.

    `candidates` has x and y from the star, and frame_angle; `resolution` is lambda/D and `edge` the
    largest separation that was searched, arcsec.
    """
    # Sources that have nothing to do with each other have independent position angles, and are
    # spread evenly over the field. The number of candidates alone says nothing.
    count = len(candidates)
    if count < 2:
        return ""
    if count > 2:
        axes = np.sort(candidates["frame_angle"].value % 180)
        gaps = np.diff(axes, append=axes[0] + 180)
        # All axes are in the arc that is left by the largest gap. The probability that n random
        # axes are in an arc a of their circle, a < 1/2, is n a^(n - 1).
        arc = 1 - gaps.max() / 180
        if arc < 0.5 and count * arc ** (count - 1) < _UNLIKELY:
            return "The candidates are in line with the star, like an edge-on disk"
    places = np.stack([candidates["x"].value, candidates["y"].value], axis=1)
    distances = np.hypot(*(places[:, None] - places).T)[np.triu_indices(count, 1)]
    # Each of the n (n - 1) / 2 pairs is within reach of each other with the probability
    # (reach / edge)^2, the ratio of two areas, so that their number is nearly Poisson's.
    reach = _NEAR * resolution
    expected = len(distances) * (reach / edge) ** 2
    if stats.poisson.sf((distances < reach).sum() - 1, expected) < _UNLIKELY:
        return "Candidates are next to each other, like parts of an extended source"
    return ""


def on_extended_light(candidates: QTable, offsets: NDArray[np.float64], resolution: float) -> str:
    """Say which candidates lie on extended light that was fitted; empty if none does.

    `candidates` has x, y and separation. `offsets` (k, 2) are x, y of the sources of the extended
    light from the star; `resolution` is lambda/D, arcsec.
    """
    if not len(candidates) or not len(offsets):
        return ""
    places = np.stack([candidates["x"].value, candidates["y"].value], axis=1)
    away = np.hypot(*np.moveaxis(places[:, None] - offsets, -1, 0)).min(axis=1)
    near = np.sort(candidates["separation"].value[away < resolution])
    if not len(near):
        return ""
    separations = ", ".join(f"{each:.2f}" for each in near)
    return (
        f"On the extended light, candidates at {separations} arcsec may be parts of it that its "
        "fit has left."
    )


# The result of a reduction.

_LARGE = 4.0
"""Chi-squared per pixel above which more is missing than what real frames leave where the pattern
of the flat field is known: at most 1.6 for stars without a disk, 5 to 32 for AU Mic."""

_HOPELESS = 100.0
"""Chi-squared per pixel that no disk explains: the star is misplaced, or the set-up is wrong."""


@dataclass(frozen=True, eq=False)
class ReductionResult:
    """What a reduction has found, without the means to write it: see `Reduction`."""

    sequence: Sequence
    fit: Refinement
    detection: Detection
    references: tuple[Refinement, ...] = ()
    systematics: Systematics | None = None
    failed: tuple[tuple[str, str], ...] = ()
    pattern: str = "none"
    visit: Visit = field(default_factory=Visit)
    wide: WideField | None = None
    disk: Disk | None = None
    injections: QTable | None = None
    completeness: QTable | None = None
    accuracy: str = "full"

    @property
    def reference_frames(self) -> int:
        """Number of frames of reference stars that the flat-field pattern was learned from."""
        if self.systematics is None:
            return 0
        return sum(frame.observation.count for fit in self.references for frame in fit.frames)

    @property
    def remark(self) -> str:
        """Advice about a poor fit, or about extended light; else empty."""
        if self.fit.chi2_per_pixel > _HOPELESS:
            return (
                "The residual is so far above the noise that something basic is wrong: check that "
                "the star is behind the mask where the header says, that filter and mask are those "
                "of the header, that no frame is damaged, and the unit of the wavefront map."
            )
        if self.disk is not None:
            resolution = self.detection.contrast_curve.meta["resolution_arcsec"]
            return on_extended_light(self.detection.candidates, self.disk.offsets, resolution)
        reason = self.extended
        if not reason and self.systematics is not None and self.fit.chi2_per_pixel > _LARGE:
            reason = "The residual is far above the noise, as it is where the star has a disk"
        if not reason:
            return ""
        return f"{reason}: repeat the reduction with disk=True (--disk on the command line)."

    @cached_property
    def extended(self) -> str:
        """How the candidates are arranged like extended light, such as a disk; else empty."""
        curve = self.detection.contrast_curve
        if self.disk is not None or not len(curve):
            return ""
        resolution = curve.meta["resolution_arcsec"]
        edge = float(curve["separation"][-1].to_value("arcsec"))
        return looks_extended(self.detection.candidates, resolution, edge)

    @property
    def _status(self) -> str:
        """How the fit ended, and whether it was a first look."""
        quick = " (quick: a first look with a coarser model)" if self.accuracy == "quick" else ""
        return f"{self.fit.status}{quick}"

    def __repr__(self) -> str:
        return f"<Reduction of {self.sequence.target}: {self.fit!r}, {self.detection!r}>"

    def __str__(self) -> str:
        known = "none" if self.systematics is None else f"from {self.systematics.name}"
        search = self.detection if self.wide is None else self.wide
        return (
            f"{self.sequence!r}\n{self._status}\n"
            f"flat-field pattern: {known}\n{self._references}{search}\n{self.remark}"
        ).rstrip()

    @property
    def _references(self) -> str:
        """What the frames of reference stars are for, in a line; empty without any."""
        every = self.visit.contributions
        used = sum(each.use == "joint" for each in every)
        if not every:
            return ""
        deeper = f"; limits {self.visit.gain:.2f} times deeper" if used else ""
        return f"reference frames in the likelihood: {used} of {len(every)}{deeper}\n"

    def _repr_html_(self) -> str:
        facts = {
            "Status": self._status,
            "Frames": f"{len(self.sequence.science)} of the target, "
            f"{len(self.sequence.references)} of reference stars",
            "Filter": self.sequence.filter,
            "Flat-field pattern": "none" if self.systematics is None else self.systematics.name,
        }
        if self.remark:
            facts["Remark"] = self.remark
        head = html_summary(f"Reduction of {self.sequence.target}", facts)
        return f"{head}\n{self.detection._repr_html_()}"
