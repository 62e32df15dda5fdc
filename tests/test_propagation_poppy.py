"""The compact-occulter propagation against poppy's plain FFTs, made finer until they settle."""

import numpy as np
import pytest

from benchmarks import poppy_reference as reference
from pyklip_diffrender.instrument.masks import jwst_pupil, lyot_openings
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE, nircam_coronagraph
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage

NPIX = 128
WAVELENGTH = 4.5e-6
STAR = (0.46, 0.39)
"""x, y in arcsec: off both axes and off the diagonals."""


def ours(occulter_sampling=None, route="auto"):
    return nircam_coronagraph(
        monochromatic=WAVELENGTH,
        npix=NPIX,
        occulter_sampling=occulter_sampling,
        si_wfe=reference.tabulated(reference.lopsided_zernikes(), WAVELENGTH),
        flip_si_wfe=True,  # The coefficients are given for the entrance pupil.
        route=route,
    )


def system(oversample):
    return reference.coronagraph(
        jwst_pupil(NPIX).numpy(), reference.lopsided_opd(NPIX),
        polygon_coverage(lyot_openings("MASKRND"), PupilGrid.full(NPIX)).numpy(),
        reference.zernike_opd(reference.lopsided_zernikes(), NPIX), oversample=oversample,
        fov_pixels=80, pixelscale=NIRCAM_LW_PIXELSCALE,
    )  # fmt: skip


def theirs(oversample):
    return reference.image(system(oversample), WAVELENGTH, *STAR)


def error(image, truth):
    return float(np.abs(image - truth).max() / truth.max())


@pytest.mark.hard
def test_the_default_sampling_has_converged():
    finest, before = theirs(16), theirs(8)
    assert error(before, finest) < 1e-8, "poppy itself has not converged"
    for route in ("lattice", "planes"):
        model = ours(route=route)
        image = model(reference.lopsided_opd(NPIX), star_offset=STAR).numpy()
        assert error(image, finest) <= 1e-7


@pytest.mark.hard
def test_the_complex_field_is_the_same():
    """Fields, not only intensities: a fit differentiates them."""
    _, (final,) = system(4).calc_psf(wavelength=WAVELENGTH, return_final=True)
    (field,) = ours(4.0, route="planes").fields(reference.lopsided_opd(NPIX))
    # poppy leaves out the constant phase of half a sample; it is the same for the whole image.
    ratio = np.vdot(field.numpy(), final.wavefront)
    turned = field.numpy() * (ratio / abs(ratio))
    assert np.abs(turned - final.wavefront).max() <= 1e-11 * np.abs(final.wavefront).max()
