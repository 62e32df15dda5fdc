"""Positions and fluxes of injected planets from `pyklip.fm` and `fitpsf`: this package and KLIP.

Run from the root of the project::

    python -m benchmarks.forward_model --trials 12

Every trial simulates two rolls of a star with a planet, and frames of a reference star, all with
drifted wavefronts; runs `pyklip.fm.klip_dataset` with an `FMPlanetPSF` whose position and flux are
somewhat wrong; and fits the product with `FMAstrometry`, with one or two of its kernels. "own" are
the values and errors that diffrender writes into the headers of its products. Trials without them
are left out of "own"; the number of trials is printed.

For the contrast (as a fraction of the truth) and the position (pixels) it prints the weighted mean
of the differences from the truth, the mean and scatter of these differences in units of their
errors, and how many are within one and two errors. "difference" fits the difference of the products
with and without the planet, in which the noise cancels: only the error of the forward model is
left.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from numpy.typing import NDArray
from pyklip import fm, rdi
from pyklip.fitpsf import FMAstrometry
from pyklip.fmlib.fmpsf import FMPlanetPSF
from pyklip.instruments.Instrument import GenericData

import pyklip_diffrender as dr
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.opd import random_drift

Image = NDArray[np.float64]
Errors = NDArray[np.float64]

SIDE, STAMP, BOX = 64, 31, 13
PIXEL = 0.062424185
ROLLS = (0.0, 14.0)
FLUX, SKY = 1e10, 100.0
DRIFT, REFERENCE_DRIFT = 40.0, 20.0
DITHERS = ((0.0, 0.0), (0.015, 0.015), (-0.015, 0.015), (-0.015, -0.015), (0.015, -0.015))
NUMERICS: dict[str, Any] = {"npix": 128, "occulter_sampling": 2.0, "monochromatic": 4.44e-6}
CENTER = np.full(2, (SIDE - 1) / 2)
FWHM = 2.4
KERNELS: dict[str, list[float]] = {"diag": [], "matern32": [3.0]}
"""Kernels of `FMAstrometry` with their first correlation lengths, as spaceKLIP has them."""


class Planet:
    """A planet with a guess of its place and flux, and what fits of it return.

    Attributes
    ----------
    contrast, separation, angle : float
        The truth: separation in pixels, position angle in degrees.
    guess : (float, float, float)
        Separation, position angle and contrast, up to 0.4 pixel, 1 degree and 40 % off.
    """

    def __init__(
        self, rng: np.random.Generator, separation: float, angle: float, contrast: float
    ) -> None:
        self.separation, self.angle, self.contrast = separation, angle, contrast
        self.guess = (
            separation + rng.uniform(-0.4, 0.4),
            angle + rng.uniform(-1.0, 1.0),
            contrast * rng.uniform(0.7, 1.4),
        )

    def measured_in(self, model: Image, product: Image, center: Image, kernel: str) -> Errors:
        """What `FMAstrometry` returns, minus the truth, and its errors."""
        fit = FMAstrometry(*self.guess[:2], fitboxsize=BOX)
        fit.generate_fm_stamp(model, center, padding=5)
        fit.generate_data_stamp(product, center, dr=4, exclusion_radius=3 * FWHM)
        length = KERNELS[kernel]
        fit.set_kernel(kernel, length, ["l"] * len(length))
        fit.set_bounds(1.5, 1.5, 1.0, [1.0] * len(length))
        fit.fit_astrometry(nwalkers=24, nburn=150, nsteps=150, save_chain=False, numthreads=1)
        values = (fit.raw_flux, fit.raw_RA_offset, fit.raw_Dec_offset)
        return self.compared([each.bestfit for each in values], [each.error for each in values])

    def in_header(self, header: fits.Header) -> Errors | None:
        """The same from the header of a product, if it is there."""
        if "DRFMFLUX" not in header:
            return None
        errors = [header[key] for key in ("DRFMFERR", "DRFMRAER", "DRFMDEER")]
        values = [header[key] for key in ("DRFMFLUX", "DRFMRA", "DRFMDE")]
        return self.compared(values, errors)

    def compared(self, values: Sequence[float], errors: Sequence[float]) -> Errors:
        """Contrast over the truth, and x and y in pixels, minus the truth; and their errors."""
        direction, scales = np.radians(self.angle), np.array([self.guess[2] / self.contrast, 1, 1])
        place = self.separation * np.array([np.sin(direction), np.cos(direction)])
        return np.array([scales * values - (1.0, *place), scales * errors])


def print_statistics(results: Mapping[str, Sequence[Errors]]) -> None:
    """Bias, scatter and coverage of every estimate, by name."""
    for name, each in results.items():
        away, errors = np.moveaxis(np.array(each), 1, 0)
        pulls, weights = away / errors, errors**-2.0
        bias = (weights * away).sum(axis=0) / weights.sum(axis=0)
        expected = weights.sum(axis=0) ** -0.5
        print(f"{name}: {len(each)} trials")
        for k, what in enumerate(("contrast", "x", "y")):
            print(
                f"  {what}: bias {bias[k]:+.3f} +- {expected[k]:.3f}, mean pull "
                f"{pulls[:, k].mean():+.2f} +- {len(pulls) ** -0.5:.2f}, scatter of pulls "
                f"{pulls[:, k].std(ddof=1):.2f}, within 1 sigma {np.mean(abs(pulls[:, k]) < 1):.0%}"
                f", within 2 {np.mean(abs(pulls[:, k]) < 2):.0%}, median error "
                f"{np.median(errors[:, k]):.3f}, unweighted mean {away[:, k].mean():+.3f}, scatter "
                f"{away[:, k].std(ddof=1):.3f}"
            )


class Trial(Planet):
    """Frames of a star with a planet, and of a reference star.

    Parameters
    ----------
    seed : int
    contrast : float
    """

    def __init__(self, seed: int, contrast: float) -> None:
        rng = np.random.default_rng(seed)
        super().__init__(rng, rng.uniform(9.0, 15.0), rng.uniform(0.0, 360.0), contrast)
        self.measured = dr.wavefront.random_opd(seed, npix=128)
        drifts = [random_drift(100 * seed + k, h, npix=128).data
                  for k, h in enumerate((DRIFT, REFERENCE_DRIFT))]  # fmt: skip
        camera = dr.nircam_coronagraph("F444W", fov_pixels=SIDE, **NUMERICS)
        wave = self.measured.data + drifts[0]
        with torch.no_grad():
            stars = [camera(wave) for _ in ROLLS]
            others = [camera(wave + drifts[1], star_offset=dither) for dither in DITHERS]
            planets = [
                contrast * camera(wave, star_offset=self.place(roll, self.separation, self.angle))
                for roll in ROLLS
            ]
        # The planet comes with photons of its own, so that frames without it have the same noise.
        self.empty, self.others, planet = (
            rng.poisson(FLUX * np.array([each.numpy() for each in images]) + level).astype(float)
            for images, level in ((stars, SKY), (others, SKY), (planets, 0.0))
        )
        self.frames = self.empty + planet
        # As a user would make it, with the measured wavefront, at the guessed place.
        stamp = dr.nircam_coronagraph("F444W", fov_pixels=STAMP, **NUMERICS)
        source = self.place(0.0, *self.guess[:2])
        with torch.no_grad():
            image = stamp(
                self.measured.data, star_offset=source, detector_shift=[-each for each in source]
            )
        self.psf = FLUX * image.double().numpy()

    @staticmethod
    def place(roll: float, separation: float, angle: float) -> list[float]:
        """x, y in a frame, arcsec, of a planet whose separation is in pixels."""
        direction = np.radians(90 + angle - roll)
        return [PIXEL * separation * float(f(direction)) for f in (np.cos, np.sin)]

    def fitted(
        self, mode: str, kernels: Sequence[str] = ("diag",), **settings: Any
    ) -> dict[str, Errors]:
        """What `Planet.compared` returns, (2, 3), by method."""
        model, product, header = self.images(self.frames, mode, **settings)
        values = {name: self.measured_in(model, product, CENTER, name) for name in kernels}
        own = self.in_header(header)
        return values if own is None else {**values, "own": own}

    def difference(self, **settings: Any) -> dict[str, Errors]:
        """The same in the difference of the products with and without the planet."""
        model, product, _ = self.images(self.frames, "ADI", **settings)
        product = product - self.images(self.empty, "ADI", **settings)[1]
        return {"diag": self.measured_in(model, product, CENTER, "diag")}

    def images(self, frames: Image, mode: str, **settings: Any) -> tuple[Image, Image, fits.Header]:
        """Forward model, product and its header."""
        dataset = GenericData(
            frames.copy(),
            np.tile(CENTER, (len(ROLLS), 1)),
            parangs=np.array(ROLLS),
            wvs=np.full(len(ROLLS), 4.44),
            IWA=3,
            filenames=np.array([f"roll{k}" for k in range(len(ROLLS))]),
        )
        dataset.OWA = SIDE / 2 - 1
        names = np.array([*dataset.filenames, *(f"other{k}" for k in range(len(DITHERS)))])
        library = rdi.PSFLibrary(
            np.concatenate([frames, self.others]), CENTER, names, compute_correlation=True
        )
        library.prepare_library(dataset)
        separation, angle, contrast = self.guess
        planet = FMPlanetPSF(
            dataset.input.shape, np.array([5]), separation, angle, contrast,
            self.psf[np.newaxis], np.unique(dataset.wvs), spectrallib=[np.ones(1)],
            spectrallib_units="contrast",
        )  # fmt: skip
        if settings:
            dataset.diffrender = dr.pyklip_backend.DiffrenderSettings(
                opd=self.measured,
                model=dr.nircam_coronagraph("F444W", fov_pixels=SIDE, **NUMERICS),
                error=np.sqrt(self.frames),
                settings=dr.FitSettings(basis=default_basis(12.0), response_npix=128),
                **settings,
            )
        with (
            tempfile.TemporaryDirectory() as folder,
            contextlib.redirect_stdout(io.StringIO()),
            dr.pyklip_backend.backend() if settings else contextlib.nullcontext(),
        ):
            fm.klip_dataset(
                dataset, planet, mode=mode, outputdir=folder, fileprefix="x", annuli=1,
                subsections=1, numbasis=[5], movement=1, numthreads=1, mute_progression=True,
                psf_library=library, aligned_center=CENTER,
            )  # fmt: skip
            path = Path(folder) / "x-klipped-KLmodes-all.fits"
            model, product = (
                fits.getdata(path.with_name(path.name.replace("klipped", name)))[0].astype(float)
                for name in ("fmpsf", "klipped")
            )
            return model, product, fits.getheader(path)


def main() -> None:
    """Run the trials and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=12)
    parser.add_argument("--contrast", type=float, default=4e-6)
    options = parser.parse_args()
    reductions: dict[str, Callable[[Trial], dict[str, Errors]]] = {
        "diffrender": lambda trial: trial.fitted("ADI", tuple(KERNELS), keep_detected=False),
        "diffrender, detected kept": lambda trial: trial.fitted("ADI", keep_detected=True),
        "diffrender, difference": lambda trial: trial.difference(keep_detected=False),
        "KLIP, RDI": lambda trial: trial.fitted("RDI"),
    }
    results: dict[str, list[Errors]] = {}
    for seed in range(options.trials):
        trial = Trial(seed, options.contrast)
        for reduction, method in reductions.items():
            np.random.seed(seed)  # emcee has no other way.  # noqa: NPY002
            for kind, ((contrast, x, y), errors) in method(trial).items():
                name = f"{reduction}, {kind}"
                results.setdefault(name, []).append(np.array([(contrast, x, y), errors]))
                print(
                    f"{seed} {name}: contrast {contrast:+.3f} +- {errors[0]:.3f}, "
                    f"x {x:+.3f} +- {errors[1]:.3f}, "
                    f"y {y:+.3f} +- {errors[2]:.3f}", flush=True,
                )  # fmt: skip
    print_statistics(results)


if __name__ == "__main__":
    main()
