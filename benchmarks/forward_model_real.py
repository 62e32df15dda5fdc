"""Positions and fluxes of planets in real frames from `pyklip.fm`: this package and KLIP.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.forward_model_real --target HIP17695 --filter F444W --trials 8

Every trial adds a planet to the files of the two rolls of a target, several times as bright as the
5-sigma limit at its separation, with the wavefront of a fit of the rolls without it. The files are
read with pyKLIP's `JWSTData`, with those of all other stars as references, and
`pyklip.fm.klip_dataset` is run with an `FMPlanetPSF` whose position and flux are somewhat wrong and
whose image has the measured wavefront. It prints what `forward_model` prints.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from astropy.io import fits
from pyklip import fm
from pyklip.fmlib.fmpsf import FMPlanetPSF
from pyklip.instruments.JWST import JWSTData

import pyklip_diffrender as dr
from benchmarks.forward_model import STAMP, Errors, Image, Planet, print_statistics
from benchmarks.real_frames import real_frames_parser
from pyklip_diffrender.refinement import FrameFit

SIDE = 101
"""Pixels of the image that is added to a frame."""

STRENGTH = 2.5
"""Contrast over the limit."""

MODES = 5
"""As many as KLIP has references: the other roll and four frames of two stars."""


class Frames:
    """The files of a target's rolls, their fit without a planet, and the files of other stars.

    Parameters
    ----------
    folder, opd : Path
    target, filter : str
    """

    def __init__(self, folder: Path, opd: Path, target: str, filter: str) -> None:
        sequence = dr.ExposureSequence.from_files(folder, target=target, filter=filter)
        self.opd = opd
        self.paths = [self._path(folder, each) for each in sequence.science]
        self.references = [str(self._path(folder, each)) for each in sequence.references]
        reduction = dr.reduce(replace(sequence, references=()), opd)
        self.fits, self.limits = reduction.fit.frames, reduction.detection.contrast_curve

    @staticmethod
    def _path(folder: Path, observation: dr.Observation) -> Path:
        return next(folder.rglob(Path(observation.name).name))

    def limit(self, separation: float) -> float:
        """5-sigma contrast at a separation, arcsec."""
        return float(
            np.interp(separation, self.limits["separation"].value, self.limits["contrast"])
        )

    def scale(self) -> float:
        """Arcsec per pixel."""
        return float(np.mean(self.fits[0].model.detector.pixelscale))

    def with_planet(self, planet: Planet, folder: Path) -> list[str]:
        """Write files of the rolls with a planet."""
        written = []
        for path, fit in zip(self.paths, self.fits, strict=True):
            with fits.open(path) as hdus:
                header = hdus["SCI"].header
                star = np.array([header["CRPIX1"] - 1, header["CRPIX2"] - 1])
                middle = np.round(star)
                image = fit.render(
                    SIDE,
                    (SIDE // 2 + star[0] - middle[0], SIDE // 2 + star[1] - middle[1]),
                    background=False,
                    source=position(fit, offset(planet.separation, planet.angle, turn(header))),
                )
                row, column = (int(each) - SIDE // 2 for each in middle[::-1])
                data = hdus["SCI"].data
                data[..., row : row + SIDE, column : column + SIDE] += planet.contrast * image
                written.append(str(folder / path.name.removesuffix(".gz")))
                hdus.writeto(written[-1])
        return written

    def user_psf(self, planet: Planet) -> Image:
        """The planet's image at the guessed place with the star's flux, as a user would make it."""
        fit, roll = self.fits[0], turn(fits.getheader(self.paths[0], "SCI"))
        place = offset(*planet.guess[:2], roll) * np.array(fit.model.detector.pixelscale)
        model = dr.model_for(fit.observation, STAMP)
        opd = dr.read_opd(self.opd).data
        with torch.no_grad():
            image = model(opd, star_offset=place.tolist(), detector_shift=(-place).tolist())
        return fit.flux * image.double().numpy()


def turn(header: fits.Header) -> float:
    """Degrees by which `JWSTData` turns frames counter-clockwise."""
    return float(header["ROLL_REF"] - header["V3I_YANG"] * header["VPARITY"])


def offset(separation: float, angle: float, roll: float) -> Image:
    """x, y in a frame from the star of the header, pixels."""
    direction = np.radians(90 + angle - roll)
    return separation * np.array([np.cos(direction), np.sin(direction)])


def position(fit: FrameFit, away: Image) -> tuple[float, float]:
    """Position on the model's axes, arcsec, of a place in pixels from the star of the header."""
    grid = fit.grid + fit.optical_values["star_offset"].numpy()
    x, y = fit.observation.center[0] + away
    columns, rows = np.arange(grid.shape[1]), np.arange(grid.shape[0])
    across = float(np.interp(x, columns, grid[0, :, 0]))
    up = float(np.interp(y, rows, grid[:, 0, 1]))
    return across, up + fit.model.detector.shear * (across - float(grid[0, 0, 0]))


def measured(frames: Frames, planet: Planet, mode: str, algorithm: str | None) -> dict[str, Errors]:
    """What `Planet.compared` returns, by method."""
    psf = frames.user_psf(planet)
    with (
        tempfile.TemporaryDirectory() as name,
        contextlib.redirect_stdout(io.StringIO()),
        dr.pyklip_backend.backend(opd=frames.opd) if algorithm else contextlib.nullcontext(),
    ):
        folder = Path(name)
        paths = frames.with_planet(planet, folder)
        dataset = JWSTData(paths, psflib_filepaths=frames.references, highpass=False)
        separation, angle, contrast = planet.guess
        forward = FMPlanetPSF(
            dataset.input.shape, np.array([MODES]), separation, angle, contrast, psf[np.newaxis],
            np.unique(dataset.wvs), spectrallib=[np.ones(1)], spectrallib_units="contrast",
        )  # fmt: skip
        fm.klip_dataset(
            dataset, forward, mode=mode, outputdir=name, fileprefix="x", annuli=1, subsections=1,
            numbasis=[MODES], movement=1, numthreads=1, mute_progression=True,
            psf_library=dataset.psflib, **({"algo": algorithm} if algorithm else {}),
        )  # fmt: skip
        with fits.open(folder / "x-klipped-KLmodes-all.fits") as hdus:
            header, product = hdus[0].header, hdus[0].data[0].astype(float)
        model = fits.getdata(folder / "x-fmpsf-KLmodes-all.fits")[0].astype(float)
    center = np.array([header["PSFCENTX"], header["PSFCENTY"]])
    values = {"FMAstrometry": planet.measured_in(model, product, center, "diag")}
    own = planet.in_header(header)
    return values if own is None else {**values, "own": own}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the trials and print a table."""
    parser = real_frames_parser(__doc__, target="HIP17695")
    parser.add_argument("--trials", type=int, default=8)
    options = parser.parse_args(arguments)
    frames = Frames(options.frames, options.opd, options.target, options.filter)
    results: dict[str, list[Errors]] = {}
    for seed in range(options.trials):
        rng = np.random.default_rng(seed)
        arcsec, angle = rng.uniform(0.6, 2.0), rng.uniform(0.0, 360.0)
        planet = Planet(rng, arcsec / frames.scale(), angle, STRENGTH * frames.limit(arcsec))
        print(f"{seed}: {planet.contrast:.2e} at {arcsec:.2f} arcsec, {angle:.0f} deg")
        for name, mode, algorithm in (
            ("diffrender", "ADI", "diffrender"),
            ("KLIP, ADI+RDI", "ADI+RDI", None),
        ):
            np.random.seed(seed)  # emcee has no other way.  # noqa: NPY002
            for kind, errors in measured(frames, planet, mode, algorithm).items():
                results.setdefault(f"{name}, {kind}", []).append(errors)
                parts = (
                    f"{what} {away:+.3f} +- {error:.3f}"
                    for what, away, error in zip(("contrast", "x", "y"), *errors, strict=True)
                )
                print(f"  {name}, {kind}: {', '.join(parts)}", flush=True)
    print_statistics(results)


if __name__ == "__main__":
    main()
