"""A visit as the archive delivers it, made with the package's own model.

Two rolls of a target with two planets, five small-grid dithers of a reference star, F356W and
F444W behind MASK430R, an association file for each filter, and an OPD map two days older. Run
from the root of the project::

    python examples/visit.py visit

Headers are those of calibrated files (calints) of the JWST pipeline. The images are rendered with
128 samples across the pupil, a wavefront that has drifted since the map and from frame to frame,
and a flat field with an error of 1 % in every pixel. Nothing of it is from the telescope.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch
from astropy.io import fits
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import pyklip_diffrender as dr
from benchmarks.calints_files import calints
from pyklip_diffrender.scene.aligned_frames import mask_place

ARCSEC = np.deg2rad(1 / 3600)
"""rad."""

SIDE, STAR = 128, (63.6, 64.3)
"""Pixels of a part of the subarray, and x, y of the mask's centre in it."""

PIXEL = 0.063
"""arcsec."""

FILTERS = {"F356W": "07", "F444W": "06"}
"""Filters with the number of their activity."""

TARGET, REFERENCE = "HD 1", "HD 2"
FLUX = {TARGET: 6e6, REFERENCE: 1.2e7}
"""Light of the stars without the mask, summed over pixels, MJy/sr."""

PLANETS = {
    "F356W": (dr.Planet(1.2e-4, 0.8, 120.0), dr.Planet(0.9e-4, 1.1, 300.0)),
    "F444W": (dr.Planet(2.4e-4, 0.8, 120.0), dr.Planet(1.2e-4, 1.1, 300.0)),
}

DITHERS = ((0.0, 0.0), (0.015, 0.015), (-0.015, 0.015), (-0.015, -0.015), (0.015, -0.015))
"""arcsec."""

SAMPLES = 128


def make_visit(folder: str | Path) -> Path:
    """Write the files into a folder, and the map into its folder ``maps``."""
    folder = Path(folder)
    (folder / "maps").mkdir(parents=True)
    measured = dr.wavefront.random_opd(1, npix=SAMPLES)
    card = fits.Header({"BUNIT": "m"})
    fits.PrimaryHDU(measured.data, card).writeto(folder / "maps" / "opd_2026-02-01.fits")
    wavefront = measured.data + dr.wavefront.random_opd(2, npix=SAMPLES, rms=6e-9).data
    for band in FILTERS:
        _Band(folder, band, wavefront).write()
    return folder


class _Band:
    """The files of a filter."""

    def __init__(self, folder: Path, band: str, wavefront: NDArray[np.float64]) -> None:
        self.folder, self.band, self.wavefront = folder, band, wavefront
        self.cards = {
            "FILTER": band, "CORONMSK": "MASKA430R", "SUBARRAY": "SUB320A430R",
            "APERNAME": "NRCA5_MASK430R", "PROGRAM": "09999", "ACT_ID": FILTERS[band],
            "CRPIX1": STAR[0] + 1, "CRPIX2": STAR[1] + 1, "PIXAR_A2": PIXEL**2,
        }  # fmt: skip
        header = fits.Header({"INSTRUME": "NIRCAM", "DETECTOR": "NRCALONG", **self.cards})
        corner = np.round(mask_place(header, "") - STAR).astype(int).tolist()
        self.cards |= {"SUBSTRT1": corner[0] + 1, "SUBSTRT2": corner[1] + 1}
        ones = np.ones((SIDE, SIDE))
        frame = dr.Observation.from_arrays(
            ones, ones, pixelscale=PIXEL, filter=band, header=header, center=STAR
        )
        self.model = dr.model_for(frame, npix=SAMPLES)
        rng = np.random.default_rng(list(FILTERS).index(band))
        self.flat = 1 + 0.01 * rng.normal(size=(SIDE, SIDE))

    def write(self) -> None:
        """Write two rolls, five dithers and the association."""
        members = [
            self._frame(TARGET, 1 + k, roll, exposure=1, place=(0.0, 0.0))
            for k, roll in enumerate((70.0, 80.0))
        ]
        members += [
            self._frame(REFERENCE, 3, 75.0, exposure=1 + k, place=place)
            for k, place in enumerate(DITHERS)
        ]
        product = {"name": f"jw09999-a3001_t001_nircam_{self.band.lower()}", "members": members}
        text = json.dumps({"asn_type": "coron3", "products": [product]}, indent=1)
        name = f"jw09999-a3001_20260203t000000_coron3_{FILTERS[self.band]}_asn.json"
        (self.folder / name).write_text(text + "\n", encoding="utf-8")

    def _frame(
        self, star: str, observation: int, roll: float, *, exposure: int, place: tuple[float, float]
    ) -> dict[str, str]:
        """Write a file; the member of an association that names it."""
        seed = 10 * observation + exposure
        drift = dr.wavefront.random_opd(seed, npix=SAMPLES, rms=1e-9).data
        opd = torch.from_numpy(self.wavefront + drift)

        def image(x: float, y: float) -> NDArray[np.float64]:
            with torch.no_grad():
                offset = (place[0] + x, place[1] + y)
                return np.asarray(self.model(opd, star_offset=offset).double().numpy())

        light = image(0.0, 0.0)
        for planet in PLANETS[self.band] if star == TARGET else ():
            # The position angle of the +y axis is ROLL_REF minus V3I_YANG.
            light = light + planet.contrast * image(*planet.rotated(-(roll + 0.05)).offset)
        name = f"jw09999{observation:03d}001_031{FILTERS[self.band]}_{exposure:05d}_nrcalong"
        path = calints(
            self.folder / f"{name}_calints.fits", star, observation=observation, roll=roll,
            date=f"2026-02-03T{2 * observation:02d}:{10 * exposure:02d}:{FILTERS[self.band]}",
            cards={**self.cards, "IS_PSF": star == REFERENCE, "EXPOSURE": str(exposure),
                   "XOFFSET": place[0], "YOFFSET": place[1]},
            light=FLUX[star] * light * self.flat,
        )  # fmt: skip
        fits.setval(path, "PIXAR_SR", value=PIXEL**2 * ARCSEC**2, ext=1)
        kind = "psf" if star == REFERENCE else "science"
        return {"expname": f"{name}_calints.fits", "exptype": kind}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the files are written")
    make_visit(parser.parse_args().folder)
