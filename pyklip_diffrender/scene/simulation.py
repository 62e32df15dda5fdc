"""The model of an observed frame, and simulated observations."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.instrument.masks import (
    FIELD,
    MASKS,
    DetectorPlace,
    detector_place,
    stop_is_measured,
)
from pyklip_diffrender.instrument.nircam import FLIGHT_ALIGNMENT, nircam_coronagraph
from pyklip_diffrender.instrument.spectrum import filter_throughput
from pyklip_diffrender.io.headers import header_text
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.grid import doubled_samples
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.scene.exposure import bar_place, detector_of, image_mask, module_of
from pyklip_diffrender.scene.objects import Planet, Scene
from pyklip_diffrender.scene.observation import Observation, Window
from pyklip_diffrender.wavefront.opd import random_opd

# The model for a real frame.

_PUPIL_SAMPLES = 256
"""Samples across the pupil. The error of so coarse a grid, 2 % of the image, is static, and the
fit absorbs it: with 256 and 512 samples the residual of real frames was the same."""

_CELLS_PER_LAMBDA_D = 1.2
"""Cells of the occulter per lambda/D. The round masks have no structure finer than several
lambda/D, so that this changes images by 3e-7 of their peak or less, and one cell per pixel is
enough in all filters of both channels; two cells per pixel take four times as long."""


def model_for(observation: Observation, size: int | None = None, **overrides: Any) -> OpticalSystem:
    """Make the model of the coronagraph for an observation.

    Frames whose header says NIRCam get the detector's scale and shear from the SIAF, and the Lyot
    stop in its place in flight, or in its nominal place if that was not measured (short wave and
    bars). A fit starts from this model.

    Parameters
    ----------
    observation : Observation
        The model has the observation's filter, and as many pupil samples as its width asks for.
    size : int, optional
        Side of the detector in pixels, for an observation that will be cut out; default the shape
        of the observation.
    **overrides
        Arguments of `nircam_coronagraph`, such as ``nlambda=5``.

    Returns
    -------
    OpticalSystem

    Raises
    ------
    ShapeError
        If the frames are smaller than `size`.
    IncompatibleSetupError
        If the filter is not known, or the instrument or the coronagraph is not one that is
        modelled.

    Examples
    --------
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> ones = np.ones((24, 24))
    >>> frame = dr.Observation.from_arrays(ones, ones, pixelscale=0.063, filter="F444W")
    >>> model = dr.model_for(frame, monochromatic=4.5e-6, npix=128)
    >>> tuple(model().shape)
    (24, 24)
    """
    if size is not None and size > min(observation.shape):
        ny, nx = observation.shape
        raise ShapeError(
            f"{observation.name}: {size} x {size} pixels do not fit into {nx} x {ny}. Choose a "
            "smaller size"
        )
    if observation.filter is None:
        raise IncompatibleSetupError(
            f"{observation.name}: the filter of these frames is not known. Give the observation a "
            "filter, such as 'F444W', or make the model with nircam_coronagraph"
        )
    instrument = header_text(observation.header, "INSTRUME", observation.name)
    if instrument is not None and instrument.upper() != "NIRCAM":
        raise IncompatibleSetupError(
            f"{observation.name}: these frames are of {instrument}, and only NIRCam's coronagraph "
            "is built in. Make the model of another one with from_poppy, and fit with refine"
        )
    arguments: dict[str, Any] = {
        "fov_pixels": observation.shape if size is None else size,
        "pixelscale": observation.pixelscale,
    }
    if observation.is_nircam:
        place = _place_of(observation, overrides.get("image_mask"))
        # The star may be rendered in the whole field of the mask as well.
        shape = observation.shape
        if size is not None:
            ny, nx = field_of(observation).shape
            shape = max(ny, size), max(nx, size)
        arguments |= {
            "image_mask": place.mask,
            "bar_place": place.place,
            "pixelscale": place.siaf_pixelscale,
            "shear": place.siaf_shear,
            "nlambda": 7,
            "npix": pupil_samples(observation, shape, _PUPIL_SAMPLES, place),
            "occulter_sampling": _CELLS_PER_LAMBDA_D,
            "defaults": FLIGHT_ALIGNMENT
            if stop_is_measured(place.mask, place.short_wave)
            else None,
        }
    arguments |= overrides
    return nircam_coronagraph(observation.filter, **arguments)


def _place_of(observation: Observation, mask: str | None = None) -> DetectorPlace:
    """Place of the star in a frame of NIRCam, behind the mask in its header or another mask.

    IncompatibleSetupError if the header does not say, or what it says is not modelled.
    """
    in_header = image_mask(observation.header, observation.name)
    name = mask or in_header
    if name is None:
        raise IncompatibleSetupError(
            f"{observation.name}: the header does not say behind which mask the star is. Add "
            "CORONMSK, such as MASKA335R, or give image_mask"
        )
    if name not in MASKS:
        raise IncompatibleSetupError(
            f"{observation.name}: these frames have image mask {in_header}, expected one of "
            f"{', '.join(MASKS)}"
        )
    along = bar_place(observation.header, observation.name)
    place = detector_place(name, str(observation.filter), along)
    detector = detector_of(observation.header, observation.name)
    module = module_of(observation.header, observation.name)
    if module == "B" or detector not in (None, place.header_detector):
        what = "module B" if detector is None else f"the detector {detector}"
        raise IncompatibleSetupError(
            f"{observation.name}: these frames are of {what}, expected "
            f"{place.header_detector}, on which {name} is imaged in {observation.filter}"
        )
    return place


def field_of(observation: Observation) -> Window:
    """The pixels about the star in which its mask lets sources be seen; all of a subarray."""
    if not observation.is_nircam:
        return Window(0, 0, observation.shape)
    (ny, nx), (x, y) = observation.shape, observation.pixelscale
    height, width = min(ny, int(FIELD / y)), min(nx, int(FIELD / x))
    box = Window.about(observation.mean_center, (height, width))
    # Moved into the frame.
    return Window(min(max(box.y, 0), ny - height), min(max(box.x, 0), nx - width), (height, width))


def within_field(observation: Observation) -> Observation:
    """The pixels of `field_of`."""
    field = field_of(observation)
    return observation if field.shape == observation.shape else observation.within(field)


def pupil_samples(
    observation: Observation, shape: tuple[int, int], npix: int, place: DetectorPlace | None = None
) -> int:
    """Pupil samples, `npix` or twice, four times ... as many, for images (ny, nx) behind a mask.

    `place` is the star's, by default from the observation's header.
    """
    period, (x, y) = 0.0, observation.pixelscale
    if place is None and observation.is_nircam:
        place = _place_of(observation)
    if place is not None:
        period, (x, y) = place.period(), place.siaf_pixelscale
    shortest = float(filter_throughput(str(observation.filter))[0][0])
    return doubled_samples(npix, max(shape[1] * x, shape[0] * y, period), shortest)


def images_of_stars(
    observation: Observation, away: float, reach: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Images, (n, n), of a star behind the mask and of one `away` from it (arcsec, in y).

    The images are monochromatic, with an arbitrary wavefront, and show `reach` (arcsec) about both.
    """
    size = 2 * int(np.ceil((away + reach) / np.mean(observation.pixelscale))) + 1
    npix = pupil_samples(observation, (size, size), 128)
    model = model_for(observation, size, nlambda=1, npix=npix)
    # Without a wavefront error the star would be too faint.
    wavefront = random_opd(1, npix=npix)
    return _image(model, wavefront, (0.0, 0.0)), _image(model, wavefront, (0.0, away))


def _image(model: OpticalSystem, opd: Any, offset: tuple[float, float]) -> NDArray[np.float64]:
    """Image (ny, nx) of a point source at x, y from the occulter, arcsec, without derivatives."""
    with torch.no_grad():
        return np.asarray(model(opd, offset).double().cpu().numpy())


# Simulated observations: the model's image of a scene, with shot and read noise.


def require_imaged(model: OpticalSystem, planets: Iterable[Planet], name: str) -> None:
    """Raise IncompatibleSetupError for planets so far away that they would appear elsewhere.

    The image of a pupil of samples repeats, and what is farther than the field from its next copy
    would be in the field.
    """
    (ny, nx), (x, y) = model.detector.shape, model.detector.pixelscale
    period = model.npix * min(model.bandpass.wavelengths) / model.diameter / ARCSEC
    reach = period - max(nx * x, ny * y) / 2
    for each in planets:
        if max(np.abs(each.offset)) > reach:
            raise IncompatibleSetupError(
                f"{name}: got a planet at {each.separation:.4g} arcsec, expected less than "
                f"{reach:.3g} arcsec along x and y, beyond which the image of {model.npix} pupil "
                "samples repeats. Separations are in arcsec, or have a unit, such as 500 * u.mas"
            )


def star_photons(model: OpticalSystem, scene: Scene, opd: Any) -> NDArray[np.float64]:
    """Expected photons of the star alone, (ny, nx)."""
    return scene.star.photons * _image(model, opd, scene.star_offset)


def planet_photons(
    model: OpticalSystem, scene: Scene, planet: Planet, opd: Any
) -> NDArray[np.float64]:
    """Expected photons of one planet, seen through the mask where it is, (ny, nx)."""
    x, y = np.add(scene.star_offset, planet.offset)
    return planet.contrast * scene.star.photons * _image(model, opd, (x, y))


def expected_photons(model: OpticalSystem, scene: Scene, opd: Any) -> NDArray[np.float64]:
    """Expected photons of star, planets and background, (ny, nx)."""
    total = star_photons(model, scene, opd) + scene.background
    for planet in scene.planets:
        total = total + planet_photons(model, scene, planet, opd)
    return total


def simulate(
    model: OpticalSystem, scene: Scene, opd: Any, *, seed: int, frames: int = 1
) -> Observation:
    """Simulate an observation.

    Parameters
    ----------
    model : OpticalSystem
    scene : Scene
    opd : array, Quantity or OPDMap
        The true wavefront, (npix, npix), m.
    seed : int
        Seed of the noise; the same seed gives the same frames.
    frames : int
        Independent exposures of the same scene.

    Returns
    -------
    Observation
        Frames in photons. The error is the observer's estimate, sqrt(counts + read noise^2), from
        the frame itself.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    >>> dr.simulate(model, dr.Scene(), dr.wavefront.random_opd(1, npix=128), seed=1)
    <Observation 'simulation(seed=1)': 1 frame of 24 x 24 pixels, F444W, ph, no date>
    """
    require_imaged(model, scene.planets, "scene")
    expected = expected_photons(model, scene, opd)
    generator = np.random.default_rng(seed)
    counts = generator.poisson(expected, size=(frames, *expected.shape)).astype(np.float64)
    counts += generator.normal(0.0, scene.read_noise, size=counts.shape)
    # As an observer would: the variance of the counts is estimated by the counts themselves.
    error = np.sqrt(np.maximum(counts, 0.0) + scene.read_noise**2)
    return Observation.from_arrays(
        counts,
        error,
        unit="photon",
        pixelscale=model.detector.pixelscale,
        filter=model.setup.get("filter"),
        name=f"simulation(seed={seed})",
    )
