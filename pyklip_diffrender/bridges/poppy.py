"""`from_poppy`: a differentiable system from a user's poppy `OpticalSystem`, and the way back."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Self

import numpy as np
import poppy
import torch
from astropy import units as u
from astropy.io import fits
from poppy.poppy_core import PlaneType
from torch import Tensor

from pyklip_diffrender.bridges.convert import Converted, Converter
from pyklip_diffrender.bridges.intermediates import intermediate_wavefronts
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import to_metres
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.orientation import Orientation
from pyklip_diffrender.optics.psf_file import poppy_psf
from pyklip_diffrender.optics.sampled_planes import PupilOptic
from pyklip_diffrender.optics.system import OpticalSystem

__all__ = ["PoppySystem", "from_poppy", "opd_to_hdus", "opd_to_poppy"]

_POPPY_OPTIONS = ("display_intermediates", "progressbar")


class PoppySystem(OpticalSystem):
    """What `from_poppy` makes: an `OpticalSystem` that keeps poppy's names and interface.

    Attributes
    ----------
    propagation : dict of str to str
        For every image plane, "compact" or "fft".
    frames : list of Orientation
        For every plane of poppy's, from its frame to the frame of this system's pupils.
    """

    propagation: dict[str, str]
    frames: list[Orientation]

    @classmethod
    def of(
        cls,
        converted: Converted,
        recipe: dict[str, Any],
        remake: Callable[..., OpticalSystem],
        detector: Detector | None = None,
    ) -> Self:
        """Put converted planes together."""
        system = cls(
            converted.entrance,
            converted.planes,
            detector or converted.detector,
            converted.bandpass,
            recipe=recipe,
            remake=remake,
        )
        system.propagation, system.frames = converted.propagation, converted.frames
        return system

    def plane(self, name: str) -> Any:
        """The plane of this name."""
        planes: list[Any] = [self.entrance, *self.planes, self.detector]
        for plane in planes:
            if plane.name == name:
                return plane
        names = [plane.name for plane in planes]
        raise KeyError(f"{name!r} is not a plane of this system; those are {names}")

    @property
    def trainable(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The leaf tensors (OPD change in m, transmission factor) of every trainable plane."""
        return {
            plane.name: (plane.opd, plane.transmission)
            for plane in self.planes
            if isinstance(plane, PupilOptic)
            and plane.opd is not None
            and plane.transmission is not None
        }

    def calc_psf(  # type: ignore[override]  # As an OpticalSystem of poppy, not an Instrument.
        self,
        wavelength: Any = None,
        weight: Any = None,
        save_intermediates: bool = False,
        save_intermediates_what: str = "all",
        display: bool = False,
        return_intermediates: bool = False,
        return_final: bool = False,
        source: dict[str, Any] | None = None,
        normalize: str = "first",
        opd: Any = None,
        **options: Any,
    ) -> Any:
        """PSF as an HDUList, with the arguments and the keywords of poppy's `calc_psf`.

        Parameters
        ----------
        wavelength : Quantity, float (m) or sequence of them, optional
            Default: the wavelengths that the system was made for.
        weight : sequence of float, optional
            One per wavelength.
        source : dict, optional
            With "wavelengths" and "weights", in place of the two above.
        normalize : str
            "first", "last", "exit_pupil" or "none", as in poppy.
        return_intermediates, return_final : bool
            Also return a list of `poppy.Wavefront`: of every pupil plane and the detector, or of
            the detector. Summed over wavelengths as poppy does.
        opd, **options
            As in a call of the system; options of poppy's without a meaning here are dropped.
        save_intermediates, save_intermediates_what, display
            Taken for poppy's sake. Nothing is drawn; saving asks for `return_intermediates`.

        Returns
        -------
        HDUList, or (HDUList, list of Wavefront)
        """
        if save_intermediates:
            raise IncompatibleSetupError(
                "save_intermediates: this system writes no files on its own; take "
                "return_intermediates=True and call .writeto() on the wavefronts"
            )
        if source is not None:
            wavelength, weight = source["wavelengths"], source["weights"]
        system: Any = self
        if wavelength is not None:
            system = self.with_fidelity(wavelength=wavelength, weights=weight)
        parameters = {k: v for k, v in options.items() if k not in _POPPY_OPTIONS}
        hdus = poppy_psf(system, normalize, opd, **parameters)
        if not (return_intermediates or return_final):
            return hdus
        return hdus, intermediate_wavefronts(
            system, system.frames, normalize, only_last=not return_intermediates
        )


def from_poppy(
    osys: poppy.OpticalSystem,
    wavelength: Any = 1e-6 * u.m,
    weights: Sequence[float] | None = None,
    *,
    propagation: str | Mapping[str, str] = "auto",
    occulter_sampling: float | None = None,
    trainable: Collection[str] = (),
    dtype: torch.dtype = torch.float64,
    device: str | torch.device = "cpu",
) -> PoppySystem:
    """Make a differentiable system of a poppy `OpticalSystem`.

    ``model()`` is the image that ``osys.calc_psf`` gives, binned to detector pixels; ``model(opd)``
    replaces the OPD of the first plane, in that plane's own frame; ``model.entrance.opd`` is the
    one it has. Source offsets of `osys` are kept, and `star_offset` adds to them.

    Parameters
    ----------
    osys : poppy.OpticalSystem
        Fraunhofer system of pupil, image and detector planes. It is not changed, and later
        changes to it do not reach the model.
    wavelength : Quantity, float (m) or sequence of them
        Where the optics are sampled.
    weights : sequence of float, optional
        One per wavelength; default equal.
    propagation : "auto", "compact", "fft", or mapping of plane name to one of these
        How to pass image planes: on the part of the image that the mask blocks, if that is
        bounded, or by FFTs padded as poppy's. "auto" takes the first where it can; what was taken
        is in ``model.propagation``.
    occulter_sampling : float, optional
        Lattice points per lambda/D in image planes; default ``osys.oversample``, with which the
        model and poppy agree to rounding either way.
    trainable : collection of str
        Names of pupil planes that get leaf tensors to train, see ``model.trainable``.
    dtype, device
        Of the computation.

    Raises
    ------
    IncompatibleSetupError
        For a plane that is not supported, by name, saying what is.
    """
    recipe = {k: v for k, v in locals().items() if k != "recipe"}
    recipe["osys"] = osys = copy.deepcopy(osys)
    return PoppySystem.of(Converter(osys, recipe).convert(), recipe, from_poppy)


def opd_to_poppy(opd: Any, osys: poppy.OpticalSystem) -> poppy.OpticalSystem:
    """A copy of a poppy system whose first plane has another OPD.

    Parameters
    ----------
    opd : Tensor, Quantity or array, (npix, npix)
        m, frame of the first plane: for instance ``fit.opd``.
    osys : poppy.OpticalSystem
        Not changed.
    """
    changed = copy.deepcopy(osys)
    first = changed.planes[0]
    wave = changed.input_wavefront(1e-6 * u.m)
    transmission = np.array(np.broadcast_to(first.get_transmission(wave), wave.shape))
    values = to_metres(opd, "opd")
    if values.shape != transmission.shape:
        raise IncompatibleSetupError(
            f"opd: got shape {values.shape}, the first plane of {osys.name} has "
            f"{transmission.shape}"
        )
    replacement = poppy.ArrayOpticalElement(
        name=first.name,
        transmission=transmission,
        opd=values,
        pixelscale=wave.pixelscale,
        planetype=PlaneType.pupil,
    )
    replacement.pupil_diam = wave.diam
    changed.planes[0] = replacement
    return changed


def opd_to_hdus(opd: Any, diameter: float) -> fits.HDUList:
    """An OPD as poppy's and stpsf's readers take it: metres, with BUNIT and PUPLSCAL."""
    values = to_metres(opd, "opd")
    header = fits.Header()
    header["BUNIT"] = "m"
    header["PUPLDIAM"] = (diameter, "[m] side of the array")
    header["PUPLSCAL"] = (diameter / values.shape[-1], "[m / pixel]")
    header["CONTENTS"] = "OTE OPD, entrance pupil orientation"
    return fits.HDUList([fits.PrimaryHDU(values, header)])
