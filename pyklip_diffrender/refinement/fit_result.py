"""The result of a refinement."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender import drawing
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import require_new, write_fits
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement.fit_file import (
    linear_hdus,
    linear_of,
    model_facts,
    model_of,
    reading,
    text_hdu,
)
from pyklip_diffrender.refinement.frame_fit import FrameFit, parameter_table
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.status import Status
from pyklip_diffrender.refinement.unknowns import brightest
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.product_headers import primary_hdu
from pyklip_diffrender.scene.systematics import Systematics
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["Refinement"]

Image = NDArray[np.float64]

_ARRAYS = ("companions", "companion_errors")
_PLAIN = (
    "settings", "basis", "chi2_per_pixel", "model_error", *_ARRAYS, "scales", "prior_ratios",
    "effective_parameters", "log_evidence", "history", "seconds", "catalogue_error",
    "catalogue_flux",
)  # fmt: skip
"""Attributes of a refinement that are written as text."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined wavefront and the stars that it renders, for frames that were fitted together.

    Attributes
    ----------
    frames : tuple of FrameFit
        One for each observation, in the same order.
    initial : OPDMap
        Starting wavefront.
    settings : GaussNewton
    basis : Basis
        Wavefront modes that were fitted.
    status : Status
    chi2_per_pixel : float
        With the errors of the observations (and those of `systematics`).
    model_error : float
        Assumed error of the star model, as a fraction of the star's light in a pixel, added in
        quadrature to the noise; 0 if chi-squared per pixel is near 1.
    companions, companion_errors : ndarray, (companions, 3)
        Companions that were part of the fit: contrast, and x and y from the star in the first
        frame, arcsec.
    scales : dict of str to float
        Final scales of the prior, nm.
    prior_ratios : dict of str to float
        Size of the fitted modes and of the amplitude relative to a prior with fixed scales, by
        group: about 1 where the prior holds; 1 where too few modes are determined. Empty if the
        scales were fitted.
    effective_parameters : float
        Number of unknowns that the data determine, see `EvidenceUpdate`; NaN if unknown.
    log_evidence : float
        Logarithm of the evidence of the linearised model, up to a constant of the data. Differences
        compare priors.
    systematics : Systematics or None
        Assumed flat-field pattern.
    stored_linear : LinearModel or None
        The linear model; None if the fit was read from a file without it.
    history : list of dict
        One entry for each iteration.
    seconds : float
    catalogue_error : float or None
        Relative error of the star's flux if a catalogue has stated it, see `star_flux_error`.
    catalogue_flux : float or None
        That flux density, Jy, which the star has within 0.5 %.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.random_opd(1, npix=128)
    >>> frame = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frame, opd, settings=dr.GaussNewton(cycles=6))
    >>> fit.status.usable
    True
    >>> fit.frames[0].star.shape
    (32, 32)

    This writes to the current folder:

    >>> path = fit.write("fit.fits")  # doctest: +SKIP
    >>> fit = dr.Refinement.read(path)  # doctest: +SKIP
    """

    frames: tuple[FrameFit, ...]
    initial: OPDMap
    settings: GaussNewton
    status: Status
    chi2_per_pixel: float
    basis: Basis
    stored_linear: LinearModel | None
    model_error: float = math.nan
    companions: Image = field(default_factory=lambda: np.zeros((0, 3)))
    companion_errors: Image = field(default_factory=lambda: np.zeros((0, 3)))
    scales: dict[str, float] = field(default_factory=dict)
    prior_ratios: dict[str, float] = field(default_factory=dict)
    effective_parameters: float = math.nan
    log_evidence: float = math.nan
    systematics: Systematics | None = None
    history: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = math.nan
    catalogue_error: float | None = None
    catalogue_flux: float | None = None

    def __repr__(self) -> str:
        count = len(self.frames)
        return (
            f"<Refinement: {self.status.name}, {count} frame{'s' if count > 1 else ''}, "
            f"chi2/pixel {self.chi2_per_pixel:.3g}, {self.seconds:.1f} s>"
        )

    def __getstate__(self) -> dict[str, Any]:
        # Without what is cached, which can be computed again and is larger than the rest.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def _repr_html_(self) -> str:
        return html_summary(
            "Refinement",
            {
                "Status": str(self.status),
                "Frames": ", ".join(frame.observation.name for frame in self.frames),
                "Chi-squared per pixel": f"{self.chi2_per_pixel:.3g}",
                "Model error": f"{100 * self.model_error:.2g} % of the star",
                "Wavefront map": self.initial.name,
                "Systematics": None if self.systematics is None else self.systematics.name,
                "Companions in the fit": len(self.companions) or None,
                "Time": f"{self.seconds:.1f} s",
            },
        )

    @property
    def model(self) -> OpticalSystem:
        """The optical system."""
        return self.frames[0].model

    @property
    def wavefront(self) -> Image:
        """The refined wavefront of the first frame, (npix, npix), m, real; see `absorption`.

        It is on the samples of the model's pupil. Both together are ``frames[0].opd``.
        """
        return np.array(np.real(self.frames[0].opd))

    @property
    def absorption(self) -> Image:
        """Imaginary part of the first frame's wavefront, (npix, npix), m: it dims the pupil.

        0 where the amplitude was not fitted.
        """
        return np.array(np.imag(self.frames[0].opd))

    @property
    def planets(self) -> tuple[Planet, ...]:
        """The companions as planets; negative contrasts become 0."""
        return tuple(Planet.from_offset(max(c, 0.0), x, y) for c, x, y in self.companions.tolist())

    @property
    def bright_companions(self) -> Image:
        """Companions whose light counts in the derivatives by the star, (k, 3) as `companions`."""
        return brightest(torch.from_numpy(self.companions)).numpy()

    @property
    def linear(self) -> LinearModel:
        """Jacobian and covariance of all unknowns, which `detect` uses.

        Raises
        ------
        IncompatibleSetupError
            If the fit was read from a file without them.
        """
        if self.stored_linear is None:
            raise IncompatibleSetupError(
                "this fit was read from a file without its linear model, which write(linear=False) "
                "leaves out. Fit the frames again, or write the fit with linear=True"
            )
        return self.stored_linear

    @property
    def reduced_chi2(self) -> float:
        """Chi-squared per degree of freedom.

        Raises
        ------
        IncompatibleSetupError
            As `linear`.
        """
        pixels = sum(int((frame.weight > 0).sum()) for frame in self.linear.frames)
        return self.chi2_per_pixel / max(1 - self.effective_parameters / pixels, 1e-3)

    @cached_property
    def star_only(self) -> LinearModel:
        """The linear model without companions, with their light added to the data.

        Raises
        ------
        IncompatibleSetupError
            As `linear`.
        """
        if not len(self.companions):
            return self.linear
        light: dict[int, NDArray[np.float64] | Tensor | float] = {
            k: frame.companion_image for k, frame in enumerate(self.frames)
        }
        return self.linear.without("companions", light)

    @property
    def parameters(self) -> QTable:
        """All parameters but the wavefront: frame, name, value, error, unit and description.

        The unit of flux, background and pedestal is that of the frame.
        """
        return parameter_table(self.frames)

    def write(
        self, path: str | os.PathLike[str], *, linear: bool = True, overwrite: bool = False
    ) -> Path:
        """Write the refinement to a FITS file that `read` reads.

        Extensions are the table PARAMETERS (frame, name, value, error, unit, description), the
        starting map INITIAL_OPD (m), PATTERN and PATTERN_ERROR of the systematics that were used,
        and for each frame, numbered by EXTVER from 1:

        - DATA, ERROR, VALID: the observation, its integrations averaged;
        - STAR, COMPANIONS: the fitted star and background, and the light of fitted companions;
        - GAIN: factor of the star, 1 without systematics;
        - OPD, ABSORPTION: refined wavefront and, if the pupil's amplitude was free, absorption, m;
        - COEFFICIENTS: of the wavefront modes, nm.

        UNKNOWNS, CURVATURE and ``LINEAR_*`` are the linear model, and FACTS has settings, status
        and history as JSON text, one byte a pixel. Images of the sky have world coordinates. The
        file is written atomically.

        Parameters
        ----------
        path : path
        linear : bool
            Include the linear model, which `detect` needs and which takes most of the space.
        overwrite : bool
            Replace an existing file.

        Returns
        -------
        Path

        Raises
        ------
        ExistingFileError
            If the file exists, and `overwrite` is False; it is also an `OSError`.
        IncompatibleSetupError
            For settings with a user-defined basis.
        """
        require_new([path], overwrite)
        names = [frame.observation.name for frame in self.frames]
        about = {**self.summary(), "observations": names}
        primary = primary_hdu(self.frames[0].observation, about)
        hdus = fits.HDUList([primary, fits.BinTableHDU(self.parameters, name="PARAMETERS")])
        parts = [frame.to_hdus(k) for k, frame in enumerate(self.frames)]
        for _, extensions in parts:
            hdus.extend(extensions)
        hdus.append(fits.ImageHDU(self.initial.data, name="INITIAL_OPD"))
        hdus["INITIAL_OPD"].header["BUNIT"] = "m"
        if self.systematics is not None:
            hdus.extend(self.systematics.to_hdus())
        if linear and self.stored_linear is not None:
            hdus.extend(linear_hdus(self.stored_linear))
        date = self.initial.date
        facts = {
            "model": model_facts(self.model),
            "frames": [about for about, _ in parts],
            "initial": [self.initial.name, self.initial.sha256, date and date.isot],
            "status": self.status.name,
            **{name: getattr(self, name) for name in _PLAIN},
        }
        hdus.append(text_hdu("FACTS", facts))
        write_fits(hdus, path)
        return Path(path)

    @classmethod
    def read(
        cls, path: str | os.PathLike[str], *, model: OpticalSystem | None = None
    ) -> Refinement:
        """Read a refinement that `write` wrote.

        Parameters
        ----------
        path : path
        model : OpticalSystem, optional
            The model of the fit; needed if it was not made by `nircam_coronagraph`.

        Raises
        ------
        CorruptFileError
            If the file is missing, truncated, or was not written by `write`.
        IncompatibleSetupError
            If the model is needed but missing.
        """
        name = Path(path).name
        with reading(path, "Refinement") as (hdus, facts):
            system = model_of(facts["model"], name) if model is None else model
            frames = tuple(
                FrameFit.from_hdus(hdus, about, system, k)
                for k, about in enumerate(facts["frames"])
            )
            label, sha256, date = facts["initial"]
            plain: dict[str, Any] = {key: facts[key] for key in _PLAIN}
            plain |= {key: np.reshape(facts[key], (-1, 3)).astype(float) for key in _ARRAYS}
            return cls(
                frames=frames,
                initial=OPDMap(
                    native_float64(hdus["INITIAL_OPD"].data),
                    None if date is None else Time(date),
                    label,
                    sha256,
                ),
                status=Status[facts["status"]],
                stored_linear=linear_of(hdus, len(frames), name) if "UNKNOWNS" in hdus else None,
                systematics=Systematics.from_hdus(hdus) if "PATTERN" in hdus else None,
                **plain,
            )

    def plot(self, ax: Any = None, *, frame: int = 0) -> NDArray[Any]:
        """Draw the data, the star model and the residual over the noise of a frame.

        Axes are in arcsec from the star. Circles are around companions that were part of the fit,
        and arrows point to north and east where the position angle of the frame is known.

        Parameters
        ----------
        ax : three Axes, optional
            Default those of a new figure.
        frame : int
            Which of `frames`; the integrations of an observation are averaged.

        Returns
        -------
        ndarray of Axes, (3,)
        """
        axes = drawing.axes_for(ax, 3)
        part = self.frames[frame]
        observation = part.observation.combined()
        valid, noise = observation.valid[0], observation.error[0]
        data = np.where(valid, observation.data[0], np.nan)
        north = observation.north
        norm, unit = drawing.light_norm(data, noise[valid]), drawing.unit_label(observation.unit)
        for each, image, title in ((axes[0], data, "data"), (axes[1], part.star, "star model")):
            drawing.star_image(
                each, image, part.grid, norm, bar=unit, title=title, north=observation.north
            )
        places = observation.turned(self.companions[:, 1:], self.frames[0].observation)
        drawing.signed_image(
            axes[2],
            (data - part.star) / noise,
            part.grid,
            5.0,
            bar="standard deviations",
            title="residual / noise",
            places=() if observation.reference else places,
            north=north,
        )
        return np.array(axes)

    def summary(self) -> Mapping[str, Any]:
        """Return metadata for a header or a log, without arrays."""
        return {
            "status": self.status.name,
            "frames": len(self.frames),
            "chi2_per_pixel": self.chi2_per_pixel,
            "model_error": self.model_error,
            "seconds": self.seconds,
            "opd": self.initial.name,
            "opd_sha256": self.initial.sha256,
            "systematics": "none" if self.systematics is None else self.systematics.name,
        }
