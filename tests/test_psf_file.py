"""PSF files of the embedded system: what a user of poppy's instruments expects."""

import numpy as np
import pytest
import torch
from astropy.io import fits

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument import jwst_pupil, nircam_coronagraph

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


def test_arguments_of_an_instrument_change_the_call(tmp_path):
    path = tmp_path / "psf.fits"
    psf = model().calc_psf(
        outfile=path, nlambda=3, fov_pixels=16, oversample=2, opd=OPD, normalize="last"
    )
    assert psf[0].data.shape == (32, 32)
    assert psf[0].header["NWAVES"] == 3
    assert psf[0].data.sum() == pytest.approx(1, rel=1e-12)
    with fits.open(path) as written:
        assert np.array_equal(written[1].data, psf[1].data)
        assert written[0].header["FILENAME"] == "psf.fits"
    with pytest.raises(FileExistsError, match=r"psf\.fits exists"):
        model().calc_psf(outfile=path, overwrite=False)
    assert model().calc_psf(fov_arcsec=1.0, detector_oversample=1)[0].data.shape == (16, 16)
    same = model(occulter_sampling=3).calc_psf(opd=OPD)[0].data
    assert np.array_equal(model().calc_psf(opd=OPD, fft_oversample=3)[0].data, same)


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


def test_intermediate_fields_come_by_name():
    psf, fields = model().calc_psf(opd=OPD), model().debug(OPD)
    assert next(iter(fields)) == "JWST pupil"
    final = fields["detector"].abs() ** 2
    assert torch.allclose(final, torch.from_numpy(psf[0].data.astype(float)), rtol=1e-12)
