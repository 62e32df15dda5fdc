"""Jacobian of the image with respect to wavefront modes.

For a small change d of the OPD the field is linear, E = E0 + J d, and the image changes by
2 Re(conj(E0) J) d. The field E0 comes from the model itself. J needs one propagation per mode and
comes from a coarser copy of the model: an error of a percent in a derivative costs an iteration,
but causes no bias.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.linear.last_pupil import LastPupil
from pyklip_diffrender.linear.mode_fields import ModeFields
from pyklip_diffrender.optics.batches import batch_of
from pyklip_diffrender.optics.grid import STAR_RADIUS, samples_for_field
from pyklip_diffrender.optics.planes import CompactOcculter
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.wavefront.bases import Basis

__all__ = [
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
    masks = [plane.radius for plane in model.planes if isinstance(plane, CompactOcculter)]
    reach = _bar_reach(model) or max(masks, default=0.0)
    period = max(_field(model), reach + STAR_RADIUS)
    while npix < samples_for_field(period, min(model.bandpass.wavelengths), model.diameter):
        npix *= 2
    if "npix" not in model.adjustable or model.npix <= npix or model.npix % npix:
        return model.npix
    return npix


def coarse_copy(model: OpticalSystem, npix: int = 128) -> OpticalSystem:
    """Return a cheaper copy of a model for derivatives.

    It has fewer pupil samples, coarse cells, single precision, and of a bar only the part within
    `STAR_RADIUS` of the field. If the pupil grid of the model is fixed, or is already as coarse,
    the model itself is returned. For a wide field or mask the number of samples is doubled until
    the image does not repeat inside it.
    """
    if "npix" not in model.adjustable or model.npix <= npix:
        return model
    coarser = {
        "npix": coarse_npix(model, npix),
        "occulter_sampling": min(_CELLS, model.recipe.get("occulter_sampling") or _CELLS),
        "bar_reach": _bar_reach(model),
        "dtype": torch.float32,
    }
    return model.with_fidelity(**{k: v for k, v in coarser.items() if k in model.adjustable})


def _field(model: OpticalSystem) -> float:
    """Side of the detector, arcsec."""
    detector = model.detector
    return max(n * s for n, s in zip(detector.shape[::-1], detector.pixelscale, strict=True))


def _bar_reach(model: OpticalSystem) -> float | None:
    """Distance from the star up to which a bar matters for derivatives, arcsec; None: no bar."""
    bars = [p for p in model.planes if isinstance(p, CompactOcculter) and p.reach[0] > p.reach[1]]
    if not bars or "bar_reach" not in model.adjustable:
        return None
    return min(bars[0].reach[0], _field(model) / 2 + STAR_RADIUS)


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
        npix: int = 128,
        wavelengths: int = 4,
        stored: bool = True,
        progress: bool = False,
    ) -> None:
        self.model, self.basis = model, basis
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
        self._opd, self._values = downsample(opd, coarse.npix), values
        self._mode_fields: ModeFields | None = None
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
            for modes, changes in self._batches():
                for kept, change in zip(fields, changes, strict=True):
                    kept.index_copy_(0, modes.to(kept.device), change)
                bar.update(len(modes))
        self._fields, self._mode_fields = fields, None
        _log.debug("response of %d modes at %d pupil samples", count, self.coarse.npix)

    def follow(self, last_pupil: LastPupil, values: dict[str, Tensor]) -> None:
        """Follow a change of parameters that `LastPupil.multiply` can follow."""
        if self._fields is not None:
            last_pupil.multiply(self._fields, self._values, values)
        self._values, self._mode_fields = values, None

    def forget(self) -> None:
        """Free the memory of the derivatives."""
        self._fields = None

    def _batches(self, count: int | None = None) -> Iterator[tuple[Tensor, list[Tensor]]]:
        """Places of modes, and the derivatives of the field by them for each wavelength.

        At least the leading `count` modes, if it is given.
        """
        if self._fields is None:
            if self._mode_fields is None:
                self._mode_fields = ModeFields(self.coarse, self.basis, self._opd, self._values)
            yield from self._mode_fields.batches(self._batch)
            return
        every = torch.arange(len(self.basis) if count is None else count)
        for modes in every.split(_ROWS):
            part = slice(int(modes[0]), int(modes[-1]) + 1)
            yield modes, [kept[part] for kept in self._fields]

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
        for places, changes in self._batches(count):
            total = _weighted_sum(changes, conjugates)
            for rows, parts in ((images[:modes], total.real), (images[modes:], total.imag)):
                wanted = places < len(rows)
                if wanted.all():
                    rows[places] = detector.image(parts.contiguous(), values)
                elif wanted.any():
                    rows[places[wanted]] = detector.image(parts[wanted], values)
        return images

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
