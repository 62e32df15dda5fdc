"""An offline STPSF data directory made from the embedded geometry, without any symmetry.

With it the real stpsf runs anywhere. Shapes are those of the telescope; aberrations are made up,
of the right size, and such that any flip, transposition or mixed-up sign changes the image. The
Lyot stop lacks one opening, the pupil has an extra obstruction.
"""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
import torch
from astropy.io import fits
from astropy.table import Table

from pyklip_diffrender.instrument.masks import jwst_pupil, jwst_segments, lyot_openings
from pyklip_diffrender.instrument.spectrum import filter_throughput
from pyklip_diffrender.optics.grid import JWST_DIAMETER, PupilGrid, polygon_coverage

FILTERS = ("F200W", "F335M", "F444W")
SENSORS = [str(number) for number in range(481, 491)]
# Interpixel capacitance of the long-wave detector of module A, and a post-pixel coupling.
IPC = np.array([[3.9e-4, 6e-3, 3.8e-4], [5.9e-3, 0.97456, 6e-3], [3.8e-4, 6.1e-3, 3.9e-4]])
PPC = np.array([[0, 0, 0], [0, 0.99877, 0.00123], [0, 0, 0]])


def lopsided(npix, seed, rms):
    """A smooth map of the given rms over the square, m: low-order waves of random phase."""
    rng = np.random.default_rng(seed)
    axis = (np.arange(npix) - (npix - 1) / 2) / npix
    waves = [(*rng.normal(scale=2.5, size=2), rng.uniform(), rng.normal()) for _ in range(24)]
    fx, fy, shift, size = np.array(waves).T[:, :, None]
    in_x, in_y = (np.exp(2j * np.pi * each) for each in (fx * axis, fy * axis + shift))
    total = ((size * in_y).T @ in_x).real
    return rms * (total - total.mean()) / total.std()


@cache
def pupil(npix):
    """Entrance pupil, 0 or 1, with an extra block in the lower left."""
    array = (jwst_pupil(npix) > 0.5).numpy().astype(float)
    array[npix // 4 : npix // 4 + npix // 10, npix // 5 : npix // 5 + npix // 12] = 0
    return array


@cache
def segments(npix):
    """Number of the segment, 1 to 18, at every sample."""
    labels = np.zeros((npix, npix))
    for number, outline in enumerate(jwst_segments().values(), start=1):
        labels[polygon_coverage([outline], PupilGrid.full(npix)).numpy() > 0.5] = number
    return labels


@cache
def lyot_stop(npix):
    """MASKRND without its first opening, entrance-pupil orientation."""
    return polygon_coverage(lyot_openings("MASKRND")[1:], PupilGrid.full(npix)).numpy()


def _write(path, primary, *hdus):
    path.parent.mkdir(parents=True, exist_ok=True)
    fits.HDUList([primary, *hdus]).writeto(path)


def _image(path, data, npix, **keywords):
    header = fits.Header({**keywords, "PUPLSCAL": JWST_DIAMETER / npix, "PUPLDIAM": JWST_DIAMETER})
    _write(path, fits.PrimaryHDU(data, header))


def _zernike_table(path, seed):
    rng = np.random.default_rng(seed)
    rows = []
    corners = {"A": (0.2, 2.7), "B": (-2.7, -0.2)}
    for module, (left, right) in corners.items():
        for channel in ("LW", "SW"):
            base = rng.normal(scale=15e-9, size=36) / np.sqrt(1 + np.arange(36) / 4)
            points = product(np.linspace(left, right, 3), (-9.5, -8.1, -6.1))
            for number, (v2, v3) in enumerate(points):
                values = base + rng.normal(scale=2e-9, size=36)
                rows.append((f"NIRCam{channel}{module}", f"P{number}", v2, v3, *values))
    names = ["instrument", "field_point_name", "V2", "V3", *(f"Zernike_{k}" for k in range(1, 37))]
    Table(rows=rows, names=names).write(path)


def _field_dependence(path, seed):
    rng = np.random.default_rng(seed)
    keywords = {
        "INSTR": "NIRCam", "WFBASIS": "Noll Zernikes", "FIEBASIS": "Legendre Polynomials",
        "NCOEFWF": 78, "NCOEFFIE": 15, "FIEORDER": 4, "FANGUNIT": "arcmin", "OPDUNIT": "nm",
        "MINXFIE": -3.0, "MAXXFIE": 3.0, "MINYFIE": -3.0, "MAXYFIE": 3.0,
        "V2SIGN": -1.0, "V2ORIGIN": 0.0, "V3SIGN": 1.0, "V3ORIGIN": -7.8,
    }  # fmt: skip
    tables = rng.normal(scale=2, size=(2, 15, 78)) / np.sqrt(1 + np.arange(78))
    names = [f"Z{k}" for k in range(1, 79)]
    hdus = [fits.BinTableHDU(Table(values, names=names)) for values in tables]
    _write(path, fits.PrimaryHDU(header=fits.Header(keywords)), *hdus)


def _kernels(path, kernel):
    cubes = [fits.ImageHDU(kernel[None], name=sensor) for sensor in SENSORS]
    _write(path, fits.PrimaryHDU(), *cubes)


def _filter(path, name):
    if name == "F200W":  # stpsf wants it to exist; nothing here looks through it.
        wavelength, throughput = np.linspace(1.7e-6, 2.3e-6, 50), np.ones(50)
        throughput[[0, -1]] = 0
    else:
        wavelength, throughput = filter_throughput(name)
    columns = {"WAVELENGTH": wavelength * 1e10, "THROUGHPUT": throughput}
    table = fits.BinTableHDU(Table(columns))
    table.header["WAVEUNIT"] = "Angstrom"
    _write(path, fits.PrimaryHDU(), table)


def wss_file(path, seed=5, date="2022-08-11T02:00:00"):
    """A wavefront-sensing product as MAST has it: 256 x 256, microns, 0 where there is none."""
    opd = lopsided(256, seed, 0.07) * pupil(256)
    cards = {"APERNAME": "NRCA3_FP1", "DATE-OBS": date[:10], "TIME-OBS": date[11:]}
    images = {"RESULT_PHASE": opd.astype(np.float32), "EXPECTED_PHASE": np.zeros((4, 4), "f4")}
    hdus = [fits.ImageHDU(data, name=name) for name, data in images.items()]
    _write(path, fits.PrimaryHDU(header=fits.Header(cards)), *hdus)


def make_stpsf_data(folder, npix=256):
    """Write the directory, for STPSF_PATH, with `npix` samples across the pupil."""
    nircam = folder / "NIRCam"
    nircam.mkdir(parents=True)
    (folder / "version.txt").write_text("2.1.0\n", encoding="utf-8")
    rows = "".join(f"{name}\t9\n" for name in FILTERS)
    (nircam / "filters.tsv").write_text(f"filter\tnlambda\n{rows}", encoding="utf-8")
    name = f"RevW_npix{npix}.fits.gz"
    _image(folder / f"jwst_pupil_{name}", pupil(npix).astype(np.uint8), npix)
    labels = segments(npix).astype(np.uint8)
    _image(folder / f"JWpupil_segments_{name}", labels, npix, VERSION="RevW")
    opd = (lopsided(npix, 1, 66e-9) * pupil(npix)).astype(np.float32)
    _image(folder / "JWST_OTE_OPD_cycle1_example_2022-07-30.fits", opd, npix, BUNIT="m")
    _image(nircam / "optics" / "NIRCam_Lyot_Somb.fits.gz", lyot_stop(npix), npix)
    wedge = lyot_stop(npix) * (np.abs(np.arange(npix) - npix / 2)[:, None] > npix / 12)
    _image(nircam / "optics" / "NIRCam_Lyot_Sinc.fits.gz", wedge, npix)
    for number, file in enumerate(("si_zernikes_coron_wfe.fits", "si_zernikes_isim_cv3.fits")):
        _zernike_table(folder / file, 10 + number)
    _field_dependence(nircam / "OPD" / "field_dep_table_nircam.fits", 20)
    phase = lopsided(1024, 30, 40e-9).astype(np.float32)
    for point in ("fp1", "fp6"):
        _image(nircam / "OPD" / f"wss_target_phase_{point}.fits", phase, 1024, BUNIT="m")
    _kernels(nircam / "IPC" / "KERNEL_IPC_CUBE.fits", IPC)
    _kernels(nircam / "IPC" / "KERNEL_PPC_CUBE.fits", PPC)
    for filter_name in FILTERS:
        _filter(nircam / "filters" / f"{filter_name}_throughput.fits", filter_name)
    return folder


def stop_of(mask):
    """The Lyot stop that belongs to a mask, as stpsf calls it."""
    return mask if mask.endswith("WB") else "MASKRND"


def nircam(folder, image_mask="MASK335R", pupil_mask="MASKRND", band="F444W", npix=256,
           pupil="RevW", aperture=None, **options):  # fmt: skip
    """A configured stpsf.NIRCam."""
    import stpsf

    instrument = stpsf.NIRCam()
    instrument.filter = band
    instrument.image_mask, instrument.pupil_mask = image_mask, pupil_mask
    if aperture is not None:
        # stpsf takes the detector from the mask; the other channel sees the mask as well.
        instrument.set_position_from_aperture_name(aperture)
    instrument.pupil = str(folder / f"jwst_pupil_{pupil}_npix{npix}.fits.gz")
    instrument.options.update(options)
    return instrument


def zernike_tensor(seed):
    """36 small Noll coefficients, m."""
    return torch.from_numpy(np.random.default_rng(seed).normal(scale=5e-9, size=36))
