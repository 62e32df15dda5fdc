"""The result of a refinement: how it ended, and the star in each of its frames."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from enum import Enum
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
from pyklip_diffrender.errors import IncompatibleSetupError, RefinementError
from pyklip_diffrender.io.files import require_new, write_fits
from pyklip_diffrender.io.headers import fits_unit
from pyklip_diffrender.io.tables import html_summary
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.optics.grid import doubled_samples, resample
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import LEVELS, parameter
from pyklip_diffrender.refinement.fit_file import (
    image,
    linear_hdus,
    linear_of,
    model_facts,
    model_of,
    observation_hdus,
    observation_of,
    reading,
    text_hdu,
)
from pyklip_diffrender.refinement.forward import pixel_grid
from pyklip_diffrender.refinement.settings import FitSettings
from pyklip_diffrender.refinement.unknowns import brightest
from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.opd_map import OPDMap

# How a refinement ended, and the error of one whose linear algebra breaks down.


class Status(Enum):
    """How a refinement ended; the values are the messages.

    Examples
    --------
    >>> from pyklip_diffrender import Status
    >>> [status.name for status in Status if not status.usable]
    ['DIVERGED']
    >>> [status.name for status in Status if status.calibrated]
    ['CONVERGED']
    >>> print(Status.ITERATION_LIMIT)
    ITERATION_LIMIT: stopped at the limit of iterations before it converged
    """

    CONVERGED = "converged, and the model explains the data within their noise"
    MODEL_MISMATCH = (
        "converged, but the model does not explain the data: errors include a model error"
    )
    PRIOR_MISMATCH = (
        "converged, but the wavefront has changed more than its prior allows, so that the errors "
        "are too small"
    )
    ITERATION_LIMIT = "stopped at the limit of iterations before it converged"
    DIVERGED = "the fitted star has no light, or the loss is not a number"

    def __str__(self) -> str:
        return f"{self.name}: {self.value}"

    @property
    def message(self) -> str:
        """Text of the status: its value."""
        return self.value

    @property
    def usable(self) -> bool:
        """Whether the result may be subtracted."""
        return self is not Status.DIVERGED

    @property
    def calibrated(self) -> bool:
        """Whether the fit converged to a model that explains the data.

        The errors of the fit then need no factor. `detect` still multiplies the errors of sources
        in real frames by the scatter of the S/N, because neighbouring pixels share errors of the
        model that chi-squared does not show.
        """
        return self is Status.CONVERGED


WHAT_TO_CHECK = (
    "Check the star's position in the header (STARCENX/Y, else CRPIX1/2), the filter, the masks "
    "and the errors, and the unit, the orientation and the date of the OPD map."
)


@contextmanager
def breakdown_explained(name: str) -> Iterator[None]:
    """Turn a breakdown of a fit's linear algebra into a `RefinementError` that names the frames."""
    try:
        yield
    except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
        raise RefinementError(
            f"{name}: the fit broke down, as it does where the frames show something other than "
            f"the star that the model renders. {WHAT_TO_CHECK} ({error})"
        ) from error


# The star in one frame of a refinement.

Image = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FrameFit:
    """The star in one frame of a refinement.

    Attributes
    ----------
    model : OpticalSystem
    observation : Observation
        The observation; its frames are averaged for the fit. Bad pixels that the fit has left out
        are not valid.
    start : dict
        Starting values of parameters, by name.
    opd : ndarray, (npix, npix)
        Best estimate of the wavefront, m, entrance-pupil orientation. Complex if the pupil's
        amplitude was free: the imaginary part is then an absorption.
    star : ndarray, (ny, nx)
        The star and the background, in the unit of the observation.
    companion_image : ndarray, (ny, nx)
        Light of the companions that were part of the fit; not part of `star`.
    values, errors : dict of str to ndarray
        Every parameter but the wavefront and its standard deviation (NaN where it was not
        fitted), in the units of the parameter table.
    gain : ndarray, (ny, nx)
        Known detector pattern, which multiplies the star; 1 without a pattern.
    coefficients : ndarray, (modes,)
        Coefficients of the wavefront modes, nm.
    """

    model: OpticalSystem
    observation: Observation
    start: dict[str, Any]
    opd: NDArray[Any]
    star: Image
    companion_image: Image
    values: dict[str, Image]
    errors: dict[str, Image]
    gain: Image
    coefficients: NDArray[np.float64]

    def __repr__(self) -> str:
        return f"<FrameFit: {self.observation.name}, flux {self.flux:.4g}>"

    @property
    def flux(self) -> float:
        """Light of the star that the pupil collects, in the unit of the observation."""
        return float(self.values["flux"][0])

    @property
    def transmission(self) -> float:
        """Part of the light of a source far from the occulter that pupil planes let through."""
        # A tensor, because the wavefront is complex where the pupil's amplitude was fitted.
        opd = torch.from_numpy(np.ascontiguousarray(self.opd))
        return float(self.model.transmission(opd, **self.optical_values))

    @property
    def star_light(self) -> float:
        """Light of the star behind the Lyot stop, in the unit of the observation.

        Two fits of the same frames may differ in the star's flux and in the transmission. The data
        determine the light of a source, so that this is what relates contrasts of the two.
        """
        return self.flux * self.transmission

    @property
    def pedestal(self) -> float:
        """Light per pixel that the pattern multiplies besides the star; 0 without a pattern."""
        return float(self.values["pedestal"][0]) if "pedestal" in self.values else 0.0

    @property
    def residual(self) -> Image:
        """Data minus star, (frames, ny, nx); NaN where the data are masked.

        The fit attributes some of the light of other sources to the star, so that it is missing
        here; `pyklip_diffrender.Detection.subtracted` retains it.
        """
        data = self.observation.data - self.star
        return np.where(self.observation.valid, data, np.nan)

    @property
    def optical_values(self) -> dict[str, Tensor]:
        """Values of the model's own parameters, as the model takes them."""
        return {
            name: torch.from_numpy(value)
            for name, value in self.values.items()
            if name in self.model.parameters
        }

    @property
    def grid(self) -> Image:
        """x, y of all pixels from the star, (ny, nx, 2), arcsec."""
        return pixel_grid(self.model, self.optical_values)

    @property
    def wcs(self) -> fits.Header:
        """World coordinates of the pixels, see `world_coordinates`."""
        return world_coordinates(self.grid, self.observation)

    def render(
        self,
        fov_pixels: int | tuple[int, int] | None = None,
        center: tuple[float, float] | None = None,
        *,
        background: bool = True,
        source: tuple[float, float] | None = None,
    ) -> Image:
        """Render the star on another array of pixels of the same scale.

        Parameters
        ----------
        fov_pixels : int or (ny, nx), optional
            Default the shape of the observation.
        center : (x, y), optional
            Pixel of the new array on which the observation's `center` falls. Default the middle
            of the array.
        background : bool
            Add the fitted background.
        source : (x, y), optional
            Place of a source of the star's flux to render instead, arcsec from the model's axis.

        Returns
        -------
        ndarray, (ny, nx)
            Image in the unit of the observation, without the detector pattern.
        """
        model, values = self.on_pixels(fov_pixels, center)
        if source is not None:
            values["star_offset"] = torch.tensor(source, dtype=torch.float64)
        with torch.no_grad():
            image = model(self.opd_for(model), **values).double().cpu().numpy()
        level = float(self.values["background"][0]) if background else 0.0
        return np.asarray(self.flux * image + level)

    def on_pixels(
        self,
        fov_pixels: int | tuple[int, int] | None = None,
        center: tuple[float, float] | None = None,
    ) -> tuple[OpticalSystem, dict[str, Tensor]]:
        """Return the model on another array of pixels, and its parameters; see `render`.

        The model has more pupil samples where its image would repeat in a larger array, see
        `opd_for`.
        """
        model = self.model
        if fov_pixels is not None and fov_pixels != self.model.detector.shape:
            changes: dict[str, Any] = {"fov_pixels": fov_pixels, "fov_arcsec": None}
            npix = self._samples_for(fov_pixels)
            if npix > model.npix and "npix" in model.adjustable:
                changes["npix"] = npix
            model = model.with_fidelity(**changes)
        values = self.optical_values
        if center is not None:
            ny, nx = model.detector.shape
            # The place of the star is counted from the middle of the array.
            old = self.observation.center[0] - (np.array(self.observation.shape[::-1]) - 1) / 2
            moved = np.array(center) - (np.array([nx, ny]) - 1) / 2 - old
            shift = torch.from_numpy(moved * np.array(model.detector.pixelscale))
            values["detector_shift"] = shift + values.get("detector_shift", torch.zeros(2))
        return model, values

    def _samples_for(self, fov_pixels: int | tuple[int, int]) -> int:
        """Pupil samples for an image of the star on (ny, nx) pixels."""
        model = self.model
        ny, nx = (fov_pixels, fov_pixels) if isinstance(fov_pixels, int) else fov_pixels
        x, y = model.detector.pixelscale
        shortest = min(model.bandpass.wavelengths)
        return doubled_samples(model.npix, max(nx * x, ny * y), shortest, model.diameter)

    def opd_for(self, model: OpticalSystem) -> Tensor:
        """The refined wavefront on the pupil samples of a model of `on_pixels`, m."""
        parts = (self.opd.real, self.opd.imag) if np.iscomplexobj(self.opd) else (self.opd,)
        maps = [torch.from_numpy(resample(each, model.npix)) for each in parts]
        return torch.complex(*maps) if len(maps) > 1 else maps[0]

    def to_hdus(self, k: int) -> tuple[dict[str, Any], list[Any]]:
        """Return metadata and FITS extensions of the frame, with EXTVER k + 1."""
        observation, hdus = observation_hdus(self.observation, k)
        unit, wcs = fits_unit(self.observation.unit), self.wcs
        arrays = {
            "STAR": (self.star, unit),
            "COMPANIONS": (self.companion_image, unit),
            "GAIN": (self.gain, ""),
            "OPD": (self.opd.real, "m"),
            "ABSORPTION": (self.opd.imag if np.iscomplexobj(self.opd) else None, "m"),
            "COEFFICIENTS": (self.coefficients, "nm"),
        }
        for name, (array, array_unit) in arrays.items():
            if array is not None:
                hdus.append(fits.ImageHDU(array, name=name, ver=k + 1))
                hdus[-1].header["BUNIT"] = array_unit
        for hdu in hdus:
            if hdu.name not in ("OPD", "ABSORPTION", "COEFFICIENTS"):
                hdu.header.update(wcs)
        facts = {
            "observation": observation,
            "start": self.start,
            "values": self.values,
            "errors": self.errors,
        }
        return facts, hdus

    @classmethod
    def from_hdus(
        cls, hdus: fits.HDUList, facts: dict[str, Any], model: OpticalSystem, k: int
    ) -> FrameFit:
        """Make a frame from the metadata and extensions of `to_hdus`."""
        opd: NDArray[Any] = image(hdus, "OPD", k)
        if ("ABSORPTION", k + 1) in hdus:
            opd = opd + 1j * image(hdus, "ABSORPTION", k)
        values, errors = (
            {name: np.atleast_1d(value).astype(float) for name, value in facts[key].items()}
            for key in ("values", "errors")
        )
        return cls(
            model=model,
            observation=observation_of(hdus, facts["observation"], k),
            start=facts["start"],
            opd=opd,
            star=image(hdus, "STAR", k),
            companion_image=image(hdus, "COMPANIONS", k),
            values=values,
            errors=errors,
            gain=image(hdus, "GAIN", k),
            coefficients=image(hdus, "COEFFICIENTS", k),
        )


def parameter_table(frames: Sequence[FrameFit]) -> QTable:
    """Table of all parameters but the wavefront; see `Refinement.parameters`."""
    rows = []
    for k, frame in enumerate(frames):
        for name, value in frame.values.items():
            entry = parameter(name)
            unit = frame.observation.unit.to_string() if entry in LEVELS else entry.unit
            labels = entry.labels()[: len(value)]
            parts = zip(value, frame.errors[name], labels, strict=True)
            for j, (number, error, label) in enumerate(parts):
                component = name if len(value) == 1 else f"{name}[{j}]"
                rows.append((k, component, number, error, unit, label))
    table = QTable(
        rows=rows,
        names=("frame", "name", "value", "error", "unit", "description"),
        dtype=(int, str, float, float, str, str),
    )
    for name in ("value", "error"):
        table[name].info.format = ".5g"
    return table


# The result of a refinement.

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
        The star in each observation, in the same order.
    initial : OPDMap
        Starting wavefront.
    settings : FitSettings
    basis : Basis
        Wavefront modes that were fitted.
    status : Status
    chi2_per_pixel : float
        Chi-squared per pixel, with the errors of the observations and of `pattern`.
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
    pattern : DetectorPattern or None
        Assumed detector pattern.
    stored_linear : LinearModel or None
        The linear model; None if the fit was read from a file without it.
    history : list of dict
        Course of the fit, one entry for each iteration.
    seconds : float
    catalogue_error : float or None
        Relative error of the star's flux in a catalogue, see `star_flux_error`; None without one.
    catalogue_flux : float or None
        Flux density of the star in that catalogue, Jy, to which the fit agrees within 0.5 %.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> frame = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=6))
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
    settings: FitSettings
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
    pattern: DetectorPattern | None = None
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
                "OPD map": self.initial.name,
                "Detector pattern": None if self.pattern is None else self.pattern.name,
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
        """The refined wavefront of the first frame, (npix, npix), m, real.

        Its samples are the samples of the model's pupil. ``frames[0].opd`` is this wavefront
        together with the absorption.
        """
        return np.array(np.real(self.frames[0].opd))

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
            If the fit was read from a file without its linear model.
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

        Flux, background and pedestal are in the unit of the frame.
        """
        return parameter_table(self.frames)

    def write(
        self, path: str | os.PathLike[str], *, linear: bool = True, overwrite: bool = False
    ) -> Path:
        """Write the refinement to a FITS file that `read` reads.

        Extensions are the table PARAMETERS (frame, name, value, error, unit, description), the
        starting map INITIAL_OPD (m), PATTERN and PATTERN_ERROR of the detector pattern that was
        used, and for each frame, numbered by EXTVER from 1:

        - DATA, ERROR, VALID: the observation, its integrations averaged;
        - STAR, COMPANIONS: the fitted star and background, and the light of fitted companions;
        - GAIN: factor of the star, 1 without a pattern;
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
        if self.pattern is not None:
            hdus.extend(self.pattern.to_hdus())
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
                pattern=DetectorPattern.from_hdus(hdus) if "PATTERN" in hdus else None,
                **plain,
            )

    def plot(self, ax: Any = None, *, frame: int = 0) -> NDArray[Any]:
        """Draw the data, the star model and the residual over the noise of a frame.

        Axes are in arcsec from the star. Circles are around companions that were part of the fit,
        and arrows point to north and east where the position angle of the frame is known.

        Parameters
        ----------
        ax : three Axes, optional
            Default: the axes of a new figure.
        frame : int
            Index of the frame in `frames`; the integrations of an observation are averaged.

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
        for each, shown, title in ((axes[0], data, "data"), (axes[1], part.star, "star model")):
            drawing.star_image(
                each, shown, part.grid, norm, bar=unit, title=title, north=observation.north
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
            "pattern": "none" if self.pattern is None else self.pattern.name,
        }
