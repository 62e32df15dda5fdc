"""The star in one frame of a refinement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.nddata import CCDData
from astropy.table import QTable
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.io.keywords import fits_unit
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import LEVELS, parameter
from pyklip_diffrender.refinement.fit_file import image, observation_hdus, observation_of
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import ccd_data, world_coordinates

__all__ = ["FrameFit", "parameter_table", "pixel_grid"]

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
        Known flat-field pattern, which multiplies the star; 1 without systematics.
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

    def to_ccddata(self) -> CCDData:
        """The frame without its star as astropy's `CCDData`; integrations are averaged.

        It has the world coordinates, the mask and the errors of the frame; see `residual`.
        """
        frame = self.observation.combined()
        data = frame.data[0] - self.star
        return ccd_data(
            data, frame.error[0], frame.unit, self.wcs, frame.valid[0], frame=frame.name
        )

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
            Render a source of the star's flux here instead, arcsec from the model's axis.

        Returns
        -------
        ndarray, (ny, nx)
            In the unit of the observation, without the flat-field pattern.
        """
        model, values = self.on_pixels(fov_pixels, center)
        if source is not None:
            values["star_offset"] = torch.tensor(source, dtype=torch.float64)
        with torch.no_grad():
            image = model(torch.from_numpy(self.opd), **values).double().cpu().numpy()
        level = float(self.values["background"][0]) if background else 0.0
        return np.asarray(self.flux * image + level)

    def on_pixels(
        self,
        fov_pixels: int | tuple[int, int] | None = None,
        center: tuple[float, float] | None = None,
    ) -> tuple[OpticalSystem, dict[str, Tensor]]:
        """Return the model on another array of pixels, and its parameters; see `render`."""
        model = self.model
        if fov_pixels is not None and fov_pixels != self.model.detector.shape:
            model = model.with_fidelity(fov_pixels=fov_pixels, fov_arcsec=None)
        values = self.optical_values
        if center is not None:
            ny, nx = model.detector.shape
            old = self.observation.center[0] - (np.array(self.observation.shape[::-1]) - 1) / 2
            moved = np.array(center) - (np.array([nx, ny]) - 1) / 2 - old
            shift = torch.from_numpy(moved * np.array(model.detector.pixelscale))
            values["detector_shift"] = shift + values.get("detector_shift", torch.zeros(2))
        return model, values

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


def pixel_grid(model: OpticalSystem, values: Mapping[str, Tensor]) -> NDArray[np.float64]:
    """x, y of all pixels from the star, (ny, nx, 2), arcsec."""
    detector = model.detector
    x, y = (
        (axis.reshape(-1, detector.oversample).mean(dim=1) / ARCSEC).cpu().numpy()
        for axis in detector.axes(values)
    )
    star = values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu().numpy()
    across, up = np.meshgrid(x, y)
    return np.stack([across - star[0], up + detector.shear * across - star[1]], axis=-1)


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
