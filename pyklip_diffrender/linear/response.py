"""How the image answers to small changes: its Jacobian with respect to wavefront and alignment.

For a small OPD change the field is linear, E = E0 + J d, and so the image changes by
2 Re(conj(E0) J) d. The field E0 comes from the model as it is; J, which needs one propagation a
mode, from a coarser copy of the model: an error of a percent in a derivative costs an iteration,
not a bias.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from tqdm import tqdm

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.linear.forward_mode import jacfwd
from pyklip_diffrender.optics.grid import PupilGrid, samples_for_field
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.wavefront.bases import Basis

__all__ = [
    "NANOMETRE",
    "Responses",
    "WavefrontResponse",
    "coarse_copy",
    "coarse_npix",
    "downsample",
    "parameter_jacobian",
]

_log = logging.getLogger(__name__)

NANOMETRE = 1e-9
"""Wavefront coefficients are in nm inside a fit, so that all its numbers are of order 1."""

IMAGE_PARAMETERS = ("blur",)
"""Parameters that act on the image; all others act on the field."""

_CELLS = 1.9
"""Of the occulter per lambda/D: then one cell a pixel serves all wavelengths of F444W, down to
3.9 um. A second one would take four times as long."""

_BATCH_BYTES = 2.5e7

_PIECE = 16
"""Modes whose images are made at a time."""


def coarse_npix(model: OpticalSystem, npix: int = 128) -> int:
    """Pupil samples that `coarse_copy` has; those of the model where it serves itself."""
    detector = model.detector
    field = max(n * s for n, s in zip(detector.shape[::-1], detector.pixelscale, strict=True))
    while npix < samples_for_field(field, min(model.bandpass.wavelengths), model.diameter):
        npix *= 2
    if "npix" not in model.adjustable or model.npix <= npix or model.npix % npix:
        return model.npix
    return npix


def coarse_copy(model: OpticalSystem, npix: int = 128) -> OpticalSystem:
    """A cheaper copy of a model for derivatives: coarse cells, single precision.

    A model whose pupil grid is fixed, or one that is already as coarse, serves itself. A wide
    field takes more samples, by powers of two, so that the image does not repeat inside it.
    """
    npix = coarse_npix(model, npix)
    if npix == model.npix:
        return model
    coarser = {"npix": npix, "occulter_sampling": _CELLS, "dtype": torch.float32}
    return model.with_fidelity(**{k: v for k, v in coarser.items() if k in model.adjustable})


def downsample(opd: Tensor, npix: int) -> Tensor:
    """Mean of the OPD over the pixels of a coarser grid, (..., npix, npix).

    `npix` must divide the grid of the OPD.
    """
    factor = opd.shape[-1] // npix
    if factor == 1:
        return opd
    # Rows first, each as a whole, then columns by a product: a third of the time of a pooling
    # over squares.
    rows = opd.unflatten(-2, (npix, factor)).sum(dim=-2)
    mean = torch.full((factor, 1), 1 / factor**2, dtype=opd.dtype, device=opd.device)
    return (rows.unflatten(-1, (npix, factor)) @ mean).squeeze(-1)


class WavefrontResponse:
    """Derivative of the complex field on the detector with respect to wavefront modes.

    The field behind a coronagraph is a small difference of large ones: it changes by much when
    the wavefront changes by little, but its derivative does not. So the derivative of the field
    is kept, and that of the image is made from it for whatever field the star now has.

    Parameters
    ----------
    model : OpticalSystem
    basis : Basis
    opd : Tensor, (n, n)
        About which to linearise, m.
    values : dict of Tensor
        Values of the model's other parameters.
    names : tuple of str
        Other parameters whose derivatives are kept as well.
    npix : int
        Pupil samples of the coarse copy that does the propagations.
    wavelengths : int
        Largest number of wavelengths at which derivatives are computed.
    memory_limit : float
        Bytes that may be kept.
    progress : bool
        Show a progress bar.

    Raises
    ------
    IncompatibleSetupError
        If the response would be larger than `memory_limit`.
    """

    def __init__(
        self,
        model: OpticalSystem,
        basis: Basis,
        opd: Tensor,
        values: dict[str, Tensor],
        *,
        names: tuple[str, ...] = (),
        npix: int = 128,
        wavelengths: int = 4,
        memory_limit: float = 4e9,
        progress: bool = False,
    ) -> None:
        self.model, self.names = model, names
        self._kept_wavelengths, bandpass = model.bandpass.thinned(wavelengths)
        coarse = coarse_copy(model, npix).at_wavelengths(bandpass)
        self.coarse = coarse
        ny, nx = (n * model.detector.oversample for n in model.detector.shape)
        size = 8.0 * len(basis) * ny * nx * len(bandpass.wavelengths)
        if size > memory_limit:
            raise IncompatibleSetupError(
                f"the response of {len(basis)} modes on {ny} x {nx} samples at "
                f"{len(bandpass.wavelengths)} wavelengths takes {size / 1e9:.1f} GB, more than "
                f"the limit of {memory_limit / 1e9:.1f} GB. Fit a smaller field, fewer wavelengths "
                "or fewer modes, or raise the limit"
            )
        self.size = size
        """Bytes that are kept."""
        self.fields = [
            torch.empty(len(basis), ny, nx, dtype=torch.complex64, device=model.device)
            for _ in bandpass.wavelengths
        ]
        full = PupilGrid.full(coarse.npix, coarse.diameter)
        window = coarse.entrance.grid
        complex_bytes = 16 if coarse.dtype == torch.float64 else 8
        batch = max(1, int(_BATCH_BYTES / (complex_bytes * math.prod(window.shape)) / 2))
        with torch.no_grad():
            small = downsample(opd, coarse.npix)
            pupils = [coarse.pupil_field(small, w, values) for w in bandpass.wavelengths]
            for start in tqdm(
                range(0, len(basis), batch), desc="response", unit="batch", disable=not progress
            ):
                stop = min(start + batch, len(basis))
                sampled = basis.modes(full, start, stop)
                modes = coarse.entrance.on_window(sampled).to(model.device, coarse.dtype)
                for kept, wavefront in zip(self.fields, pupils, strict=True):
                    # d(exp(i k OPD)) = i k exp(i k OPD) d(OPD), for 1 nm.
                    wavenumber = 2 * math.pi / wavefront.wavelength * NANOMETRE
                    moved = replace(wavefront, field=modes * (1j * wavenumber * wavefront.field))
                    kept[start:stop] = coarse.propagate(moved, values)
        self._slopes = field_derivatives(coarse, downsample(opd, coarse.npix), values, names)
        _log.debug("response of %d modes at %d pupil samples", len(basis), coarse.npix)

    def image(
        self,
        fields: Sequence[Tensor],
        values: dict[str, Tensor],
        amplitude_modes: int = 0,
        modes: int | None = None,
    ) -> Tensor:
        """Derivative of the image, for a star with the given fields.

        A mode of the amplitude, an OPD of -1j nm, changes the field by -1j times what the same
        mode of the OPD does, so the same response serves.

        Parameters
        ----------
        fields : sequence of Tensor
            What `OpticalSystem.fields` returns: the star's field at each wavelength.
        values : dict of Tensor
            Values of the model's other parameters (the blur matters here).
        amplitude_modes : int
            How many modes, the first, are amplitude modes as well.
        modes : int, optional
            How many modes, the first, are wanted; default all.

        Returns
        -------
        Tensor, (modes + amplitude_modes, ny, nx), float32
            Light per pixel (fraction of what the pupil collects) per nm.
        """
        modes = len(self.fields[0]) if modes is None else modes
        shape = (modes + amplitude_modes, *self.fields[0].shape[1:])
        total = torch.zeros(shape, device=self.model.device)
        conjugates = [
            (2 * weight) * field.to(torch.complex64).conj()
            for field, weight in zip(self._kept(fields), self.coarse.bandpass.weights, strict=True)
        ]
        # In pieces that stay in the processor's cache: the whole product is never held.
        for start in range(0, max(modes, amplitude_modes), _PIECE):
            piece = slice(start, start + _PIECE)
            real, imaginary = total[:modes][piece], total[modes:][piece]
            for conjugate, change in zip(conjugates, self.fields, strict=True):
                product = change[piece] * conjugate
                real += product[: len(real)].real
                imaginary += product[: len(imaginary)].imag
        return self.coarse.detector.image(total, values)

    def parameters(self, fields: Sequence[Tensor], values: dict[str, Tensor]) -> Tensor:
        """Derivative of the image with respect to the other parameters, (components, ny, nx)."""
        return image_derivatives(self.coarse, self._kept(fields), values, self.names, self._slopes)

    def _kept(self, fields: Sequence[Tensor]) -> list[Tensor]:
        """The star's fields at the wavelengths of the response."""
        return [fields[k] for k in self._kept_wavelengths]


_OPENINGS = 20.0
"""Relative change of the field for a shift of the Lyot stop by one pupil diameter: its openings
are about a twentieth of it wide."""


class Responses:
    """The field's responses to a basis that were computed, to be used again nearby.

    Parameters
    ----------
    model : OpticalSystem
    basis : Basis
    npix : int
        Pupil samples of the coarse copy that does the propagations.
    wavelengths : int
        Largest number of wavelengths at which derivatives are computed.
    relinearise : float
        Relative change of the field (radians, for a phase), rms over the pupil, beyond which the
        response is computed anew. A response from 0.2 away (a star 15 mas off) halves the error
        that a fit states for the star's position and moves it by four of those errors.
    keep : int
        Number of responses that are kept: one for each frame, as their stars differ in position.
    memory_limit : float
        Bytes that one response may take.
    progress : bool
        Show progress bars.
    """

    def __init__(
        self,
        model: OpticalSystem,
        basis: Basis,
        *,
        npix: int = 128,
        wavelengths: int = 4,
        relinearise: float = 0.05,
        keep: int = 1,
        memory_limit: float = 4e9,
        progress: bool = False,
    ) -> None:
        self.keep = keep
        self.model, self.basis, self.npix, self.wavelengths = model, basis, npix, wavelengths
        self.relinearise, self.memory_limit, self.progress = relinearise, memory_limit, progress
        self._kept: list[tuple[Tensor, dict[str, Tensor], WavefrontResponse]] = []
        self._slopes: tuple[Tensor, dict[str, Tensor], dict[str, list[Tensor]]] | None = None
        self._kept_wavelengths, bandpass = model.bandpass.thinned(wavelengths)
        self._coarse = coarse_copy(model, npix).at_wavelengths(bandpass)

    def parameters(
        self,
        opd: Tensor,
        values: dict[str, Tensor],
        names: tuple[str, ...],
        fields: Sequence[Tensor],
    ) -> Tensor:
        """Derivative of the image with respect to named parameters, (components, ny, nx).

        Parameters
        ----------
        opd : Tensor, (npix, npix)
            On the model's grid, m.
        values : dict of Tensor
        names : tuple of str
        fields : sequence of Tensor
            The star's field at each wavelength. Derivatives of the field are used again where it
            differs little.
        """
        inside = opd[self.model.entrance.lit]
        kept = self._slopes
        if kept is None or self._change(inside - kept[0], values, kept[1]) > self.relinearise:
            coarse = downsample(opd, self._coarse.npix)
            slopes = field_derivatives(self._coarse, coarse, values, names)
            kept = self._slopes = (inside, dict(values), slopes)
        own = [fields[k] for k in self._kept_wavelengths]
        return image_derivatives(self._coarse, own, values, names, kept[2])

    def near(
        self, opd: Tensor, values: dict[str, Tensor], names: tuple[str, ...] = ()
    ) -> WavefrontResponse:
        """The response where the field differs little from that of `opd` and `values`."""
        inside = opd[self.model.entrance.lit]
        for there, then, response in reversed(self._kept):
            if self._change(inside - there, values, then) <= self.relinearise:
                return response
        # Room first, for the new one takes as much memory as the old.
        del self._kept[: max(0, len(self._kept) + 1 - self.keep)]
        response = WavefrontResponse(
            self.model,
            self.basis,
            opd,
            values,
            names=names,
            npix=self.npix,
            wavelengths=self.wavelengths,
            memory_limit=self.memory_limit,
            progress=self.progress,
        )
        self._kept.append((inside, dict(values), response))
        return response

    def _change(self, moved: Tensor, values: dict[str, Tensor], others: dict[str, Tensor]) -> float:
        """Relative change of the field, rms over the pupil."""

        def difference(name: str) -> Tensor:
            here, there = values.get(name), others.get(name)
            missing = torch.zeros((), dtype=torch.float64)
            return (missing if here is None else here.cpu()) - (
                missing if there is None else there.cpu()
            )

        wavenumber = 2 * math.pi / min(self.model.bandpass.wavelengths)
        # The rms of a tilt over a disc is a quarter of its diameter times the angle.
        lever = wavenumber * ARCSEC * self.model.diameter / 4
        x, y = (difference("star_offset") * ARCSEC).expand(2).tolist()
        pupil = self.model.entrance
        tilt = (y * pupil.full.y[:, None] - x * pupil.full.x[None, :])[pupil.lit.cpu()]
        total = (wavenumber * (moved + tilt.to(moved.device)).abs()).square().mean()
        for name, sensitivity in (
            ("detector_shift", lever),
            ("si_zernikes", wavenumber),
            ("lyot_shift", _OPENINGS),
            ("lyot_rotation", _OPENINGS * math.radians(1) / 4),
        ):
            total = total + (sensitivity * difference(name)).square().sum().to(total.device)
        return float(total.sqrt())


def field_derivatives(
    model: OpticalSystem, opd: Tensor, values: dict[str, Tensor], names: tuple[str, ...]
) -> dict[str, list[Tensor]]:
    """Derivatives of the complex field on the detector with respect to named parameters.

    Forward-mode derivatives of the model itself.

    Parameters
    ----------
    model : OpticalSystem
        May be a coarse copy.
    opd : Tensor, (npix, npix)
        m.
    values : dict of Tensor
        Where to differentiate; must hold every name.
    names : tuple of str
        Those that act on the image only (`IMAGE_PARAMETERS`) are left out.

    Returns
    -------
    dict of str to list of Tensor
        For every wavelength (components, ny, nx), per unit of the parameter table.
    """
    # Constants are built and kept at the first call; that must not happen inside a transform.
    with torch.no_grad():
        model(opd, **values)
    moved = {name: values[name] for name in names if name not in IMAGE_PARAMETERS}
    if not moved:
        return {}

    def fields(given: dict[str, Tensor]) -> list[Tensor]:
        # Complex outputs of jacfwd would need complex inputs.
        return [torch.view_as_real(field) for field in model.fields(opd, **{**values, **given})]

    # Together: one pass costs as much for five components as for one.
    slopes = jacfwd(fields)(moved)
    return {
        name: [torch.view_as_complex(s[name].movedim(-1, 0).contiguous()) for s in slopes]
        for name in moved
    }


def image_derivatives(
    model: OpticalSystem,
    fields: Sequence[Tensor],
    values: dict[str, Tensor],
    names: tuple[str, ...],
    slopes: dict[str, list[Tensor]],
) -> Tensor:
    """Derivatives of the image from those of the field, for a star with the given fields.

    Parameters
    ----------
    model : OpticalSystem
    fields : sequence of Tensor
        The star's field at each wavelength; of a finer model, if there is one.
    values : dict of Tensor
    names : tuple of str
    slopes : dict of str to list of Tensor
        What `field_derivatives` gave.

    Returns
    -------
    Tensor, (components of all names in order, ny, nx)
        Light per pixel per unit of the parameter table.
    """
    rows = []
    for name in names:
        if name in IMAGE_PARAMETERS:

            def image(value: Tensor, name: str = name) -> Tensor:
                return model.image_of(fields, {**values, name: value})

            rows.append(jacfwd(image)(values[name]).movedim(-1, 0))
            continue
        total = torch.zeros((), dtype=fields[0].real.dtype, device=model.device)
        for field, slope, weight in zip(fields, slopes[name], model.bandpass.weights, strict=True):
            total = total + 2 * weight * (field.conj() * slope).real
        rows.append(model.detector.image(total, values))
    return torch.cat([row.double() for row in rows])


def parameter_jacobian(
    model: OpticalSystem,
    opd: Tensor,
    values: dict[str, Tensor],
    names: tuple[str, ...],
    fields: Sequence[Tensor] | None = None,
) -> Tensor:
    """Derivative of the image with respect to the components of named parameters.

    Parameters
    ----------
    model, opd, values, names
        See `field_derivatives`.
    fields : sequence of Tensor, optional
        The finer model's fields there, at each wavelength. Then only the fields' derivatives are
        those of `model`.

    Returns
    -------
    Tensor, (components, ny, nx), float64
        Light per pixel per unit of the parameter table.
    """
    slopes = field_derivatives(model, opd, values, names)
    if fields is None:
        with torch.no_grad():
            fields = model.fields(opd, **values)
    return image_derivatives(model, fields, values, names, slopes)
