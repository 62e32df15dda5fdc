"""Jacobian of the image with respect to wavefront modes.

For a small change d of the OPD the field is linear, E = E0 + J d, and the image changes by
2 Re(conj(E0) J) d. The field E0 comes from the model itself. J needs one propagation per mode and
comes from a coarser copy of the model: an error of a percent in a derivative costs an iteration,
but causes no bias.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.linear.mode_fields import ModeFields
from pyklip_diffrender.linear.parameter_derivatives import field_derivatives, image_derivatives
from pyklip_diffrender.optics.batches import batch_of
from pyklip_diffrender.optics.grid import samples_for_field
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.wavefront.bases import Basis

__all__ = [
    "Responses",
    "WavefrontResponse",
    "coarse_copy",
    "coarse_npix",
    "downsample",
]

_log = logging.getLogger(__name__)

_CELLS = 1.9
"""Largest number of cells of the occulter per lambda/D. With this number one cell per pixel is
enough at all wavelengths of F444W, down to 3.9 um; two cells per pixel take four times as long."""

_ROWS = 128
"""Number of modes whose images are computed at a time."""

_PIECE = 16
"""Number of modes whose fields are multiplied at a time."""


def coarse_npix(model: OpticalSystem, npix: int = 128) -> int:
    """Return the number of pupil samples of `coarse_copy`."""
    detector = model.detector
    field = max(n * s for n, s in zip(detector.shape[::-1], detector.pixelscale, strict=True))
    while npix < samples_for_field(field, min(model.bandpass.wavelengths), model.diameter):
        npix *= 2
    if "npix" not in model.adjustable or model.npix <= npix or model.npix % npix:
        return model.npix
    return npix


def coarse_copy(model: OpticalSystem, npix: int = 128) -> OpticalSystem:
    """Return a cheaper copy of a model for derivatives, with coarse cells and single precision.

    If the pupil grid of the model is fixed, or is already as coarse, the model itself is returned.
    For a wide field the number of samples is doubled until the image does not repeat inside it.
    """
    npix = coarse_npix(model, npix)
    if npix == model.npix:
        return model
    cells = min(_CELLS, model.recipe.get("occulter_sampling") or _CELLS)
    coarser = {"npix": npix, "occulter_sampling": cells, "dtype": torch.float32}
    return model.with_fidelity(**{k: v for k, v in coarser.items() if k in model.adjustable})


def downsample(opd: Tensor, npix: int) -> Tensor:
    """Mean of the OPD over the pixels of a coarser grid, (..., npix, npix).

    `npix` must divide the grid of the OPD.
    """
    factor = opd.shape[-1] // npix
    if factor == 1:
        return opd
    # Summing rows and then multiplying for the columns takes a third of the time of average
    # pooling.
    rows = opd.unflatten(-2, (npix, factor)).sum(dim=-2)
    mean = torch.full((factor, 1), 1 / factor**2, dtype=opd.dtype, device=opd.device)
    return (rows.unflatten(-1, (npix, factor)) @ mean).squeeze(-1)


class WavefrontResponse:
    """Derivative of the complex field on the detector with respect to wavefront modes.

    The field behind a coronagraph is a small difference of large fields. A small change of the
    wavefront changes the field by a large factor, but hardly changes its derivative. Therefore
    the derivative of the field is stored, and that of the image is computed from it and from the
    current field of the star.

    Parameters
    ----------
    model : OpticalSystem
    basis : Basis
    opd : Tensor, (n, n)
        Wavefront about which to linearise, m.
    values : dict of Tensor
        Values of the model's other parameters.
    names : tuple of str
        Other parameters whose derivatives are stored as well.
    npix : int
        Pupil samples of the coarse copy that does the propagations.
    wavelengths : int
        Largest number of wavelengths at which derivatives are computed.
    stored : bool
        Compute and store the derivatives now; otherwise they are computed in every call of `image`
        until `store` is called.
    progress : bool
        Show a progress bar.
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
        stored: bool = True,
        progress: bool = False,
    ) -> None:
        self.model, self.basis, self.names = model, basis, names
        self._kept_wavelengths, bandpass = model.bandpass.thinned(wavelengths)
        self.coarse = coarse = coarse_copy(model, npix).at_wavelengths(bandpass)
        self._progress = progress
        self._fields: list[Tensor] | None = None
        pixels = math.prod(model.detector.shape) * model.detector.oversample**2
        self.size = 8 * len(basis) * pixels * len(bandpass.wavelengths)
        """Number of bytes that are stored."""
        # Behind the occulter, arrays are padded to twice the size of the image.
        samples = max(math.prod(coarse.entrance.grid.shape), 4 * pixels)
        self._batch = batch_of(samples, coarse.dtype.to_complex(), coarse.device)
        small = downsample(opd, coarse.npix)
        self._mode_fields = ModeFields(coarse, basis, small, values)
        self._slopes = field_derivatives(coarse, small, values, names)
        if stored:
            self.store()

    @property
    def stored(self) -> bool:
        """Whether the derivatives are stored."""
        return self._fields is not None

    def store(self) -> None:
        """Compute the derivatives and store them."""
        ny, nx = (n * self.model.detector.oversample for n in self.model.detector.shape)
        count = len(self.basis)
        fields = [
            torch.empty(count, ny, nx, dtype=torch.complex64, device=self.model.device)
            for _ in self.coarse.bandpass.wavelengths
        ]
        with ProgressBar("response", count, shown=self._progress) as bar:
            for start in range(0, count, self._batch):
                part = slice(start, min(start + self._batch, count))
                for kept, change in zip(fields, self._changes(part), strict=True):
                    kept[part] = change
                bar.update(part.stop - start)
        self._fields = fields
        _log.debug("response of %d modes at %d pupil samples", count, self.coarse.npix)

    def forget(self) -> None:
        """Free the memory of the derivatives."""
        self._fields = None

    def _changes(self, part: slice) -> list[Tensor]:
        """Derivatives of the field with respect to some modes, for each wavelength."""
        if self._fields is not None:
            return [kept[part] for kept in self._fields]
        return self._mode_fields.changes(part)

    def image(
        self,
        fields: Sequence[Tensor],
        values: dict[str, Tensor],
        amplitude_modes: int = 0,
        modes: int | None = None,
    ) -> Tensor:
        """Derivative of the image for given fields of the star.

        An amplitude mode is an OPD of -1j nm. It changes the field by -1j times the change that
        the same OPD mode causes, so its derivative follows from the same response.

        Parameters
        ----------
        fields : sequence of Tensor
            The star's field at each wavelength, as `OpticalSystem.fields` returns it.
        values : dict of Tensor
            Values of the model's other parameters (the blur matters here).
        amplitude_modes : int
            Number of leading modes that are amplitude modes as well.
        modes : int, optional
            Number of leading modes; default all.

        Returns
        -------
        Tensor, (modes + amplitude_modes, ny, nx), float32
            Light per pixel (fraction of what the pupil collects) per nm.
        """
        modes = len(self.basis) if modes is None else modes
        detector, count = self.coarse.detector, max(modes, amplitude_modes)
        images = torch.empty(modes + amplitude_modes, *detector.shape, device=self.model.device)
        conjugates = [
            (2 * weight) * field.to(torch.complex64).conj()
            for field, weight in zip(self._kept(fields), self.coarse.bandpass.weights, strict=True)
        ]
        step = _ROWS if self.stored else self._batch
        for start in range(0, count, step):
            part = slice(start, min(start + step, count))
            total = _weighted_sum(self._changes(part), conjugates)
            for rows, parts in ((images[:modes], total.real), (images[modes:], total.imag)):
                wanted = rows[part]
                wanted.copy_(detector.image(parts[: len(wanted)].contiguous(), values))
        return images

    def parameters(self, fields: Sequence[Tensor], values: dict[str, Tensor]) -> Tensor:
        """Derivative of the image with respect to the other parameters, (components, ny, nx)."""
        return image_derivatives(self.coarse, self._kept(fields), values, self.names, self._slopes)

    def _kept(self, fields: Sequence[Tensor]) -> list[Tensor]:
        """The star's fields at the wavelengths of the response."""
        return [fields[k] for k in self._kept_wavelengths]


def _weighted_sum(changes: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    """Sum over wavelengths of changes (modes, ny, nx) times weights (ny, nx)."""
    total = torch.zeros_like(changes[0])
    # Pieces that fit in the processor's cache are faster than the whole product.
    for start in range(0, len(total), _PIECE):
        piece = slice(start, start + _PIECE)
        for change, weight in zip(changes, weights, strict=True):
            total[piece] += change[piece] * weight
    return total


_OPENINGS = 20.0
"""Relative change of the field for a shift of the Lyot stop by one pupil diameter. The openings of
the stop are about a twentieth of a diameter wide."""


class Responses:
    """Cache of wavefront responses, which are used again where the field is nearly the same.

    Parameters
    ----------
    model : OpticalSystem
    basis : Basis
    npix : int
        Pupil samples of the coarse copy that does the propagations.
    wavelengths : int
        Largest number of wavelengths at which derivatives are computed.
    relinearise : float
        Relative change of the field (radians for a phase), rms over the pupil, above which the
        response is computed again. With a response computed at a distance of 0.2 (15 mas in the
        star's position), the stated error of the star's position is half the correct one, and
        the position is off by four times that error.
    keep : int
        Number of responses to store: one for each frame, because star positions differ.
    memory : float
        Number of bytes of responses to store. Those that do not fit are computed again whenever
        they are needed, the oldest first, about the same wavefront.
    progress : bool
        Show progress bars.

    Attributes
    ----------
    farthest : float
        Largest change of the field at which a response was used; set it to 0 to begin anew.
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
        memory: float = math.inf,
        progress: bool = False,
    ) -> None:
        self.keep = keep
        self.model, self.basis, self.npix, self.wavelengths = model, basis, npix, wavelengths
        self.relinearise, self.memory, self.progress = relinearise, memory, progress
        self._kept: list[tuple[Tensor, dict[str, Tensor], WavefrontResponse]] = []
        self._slopes: tuple[Tensor, dict[str, Tensor], dict[str, list[Tensor]]] | None = None
        self._kept_wavelengths, bandpass = model.bandpass.thinned(wavelengths)
        self._coarse = coarse_copy(model, npix).at_wavelengths(bandpass)
        self.farthest = 0.0

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
            The star's field at each wavelength.
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
        """Return the stored response for nearly the same field, or compute it."""
        inside = opd[self.model.entrance.lit]
        for opd_then, values_then, response in reversed(self._kept):
            change = self._change(inside - opd_then, values, values_then)
            if change <= self.relinearise:
                self.farthest = max(self.farthest, change)
                return response
            del response  # Or its memory could not be freed.
        # Memory is freed first, because the new response is as large as the old one.
        del self._kept[: max(0, len(self._kept) + 1 - self.keep)]
        response = WavefrontResponse(
            self.model,
            self.basis,
            opd,
            values,
            names=names,
            npix=self.npix,
            wavelengths=self.wavelengths,
            stored=False,
            progress=self.progress,
        )
        if response.size <= self.memory:
            self._make_room(response.size)
            response.store()
        self._kept.append((inside, dict(values), response))
        return response

    def _make_room(self, size: int) -> None:
        """Free the oldest responses until as many bytes can be stored."""
        stored = [response for _, _, response in self._kept if response.stored]
        while stored and sum(each.size for each in stored) + size > self.memory:
            stored.pop(0).forget()

    def _change(self, moved: Tensor, values: dict[str, Tensor], others: dict[str, Tensor]) -> float:
        """Relative change of the field, rms over the pupil."""

        def difference(name: str) -> Tensor:
            zero = torch.zeros((), dtype=torch.float64)
            return values.get(name, zero).cpu() - others.get(name, zero).cpu()

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
