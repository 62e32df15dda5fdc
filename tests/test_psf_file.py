"""PSF files of the embedded system: what a user of poppy's instruments expects."""

import numpy as np
import pytest

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.masks import jwst_pupil
from pyklip_diffrender.instrument.nircam import nircam_coronagraph

OPD = 5e-8 * np.random.default_rng(1).standard_normal((64, 64))


def model(**changes):
    settings = {"monochromatic": 4.5e-6, "npix": 64, "fov_pixels": 20, "oversample": 3}
    return nircam_coronagraph(**{**settings, **changes})


def test_extensions_and_keywords():
    psf = model().calc_psf(opd=OPD, star_offset=(0.1, 0.2))
    assert [hdu.name for hdu in psf] == ["OVERSAMP", "DET_SAMP"]
    assert psf[0].data.shape == (60, 60)
    assert np.allclose(psf[1].data, model()(OPD, star_offset=(0.1, 0.2)).numpy(), rtol=1e-12)
    header = psf[1].header
    wanted = {
        "FILTER": "F444W", "CORONMSK": "MASK335R", "PUPIL": "MASKRND", "INSTRUME": "NIRCam",
        "PIXELSCL": 0.062424185, "OVERSAMP": 1, "CALCSAMP": 3, "DET_SAMP": 3, "NWAVES": 1,
        "WAVELEN": 4.5e-6, "WAVE0": 4.5e-6, "WGHT0": 1.0, "NORMALIZ": "first", "DRPROP": "compact",
        "DRPREC": "float64",
    }  # fmt: skip
    assert {name: header[name] for name in wanted} == pytest.approx(wanted)
    assert psf[0].header["PIXELSCL"] == pytest.approx(0.062424185 / 3)


def test_normalisations():
    first = model().calc_psf(opd=OPD)[0].data
    totals = {}
    for name in ("last", "exit_pupil", "none"):
        scaled = model().calc_psf(opd=OPD, normalize=name)[0].data
        ratio = scaled / first
        assert np.ptp(ratio) < 1e-9 * ratio.max()
        totals[name] = ratio.mean()
    assert totals["last"] > totals["exit_pupil"] > 1
    assert totals["none"] == pytest.approx(float((jwst_pupil(64) ** 2).sum()))
    with pytest.raises(IncompatibleSetupError, match="expected one of first, last"):
        model().calc_psf(normalize="middle")
