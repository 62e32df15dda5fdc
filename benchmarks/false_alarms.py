"""How often noise passes for a planet, and how often a planet passes for noise.

Run from the root of the project, with fits that `Refinement.write` wrote::

    python -m benchmarks.false_alarms simulated fit.fits --output results
    python -m benchmarks.false_alarms maxima fit.fits --output results
    python -m benchmarks.false_alarms real fit.fits ... --output results

`simulated` makes Gaussian maps of S/N with the autocorrelation of the fit's templates and three
laws of scatter, and decides with the package's own code: maps with a false candidate, and the part
of planets that become candidates. `maxima` compares the probability of a false alarm with maps of
uniform noise that are sampled four times finer than the pixels. `real` counts the maxima of the
maps of real fits with the sign of the data reversed, and with the rolls turned the wrong way,
beside the expectation. Finished blocks are kept in the output folder and not computed again.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from pyklip_diffrender.detection.candidates import Candidates, Maps
from pyklip_diffrender.detection.error_factor import Significance
from pyklip_diffrender.detection.field import separation_of
from pyklip_diffrender.detection.search import significance_of
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.refinement.residual import local_maxima

Image = NDArray[np.float64]

BLOCK = 250
"""Number of maps that are kept together."""

LEVELS = (3.0, 3.5, 4.0, 4.5, 5.0)
LOWEST = 4.0
"""Lowest threshold of the decisions on simulated maps."""

MARGIN = 16
"""Pixels by which simulated fields are larger, because they are periodic."""

FINER = 4
"""Samples per pixel of maxima between pixels."""

INNER = 0.2
"""Smallest separation of candidates, arcsec."""

SEPARATIONS = (0.3, 0.4, 0.5, 0.8, 1.2, 2.0)
STRENGTHS = (6.5, 8.0)
NOTHING = np.zeros((0, 2))


class Noise:
    """Gaussian fields of standard deviation 1 with a given autocorrelation.

    Parameters
    ----------
    correlation : ndarray, (2 k + 1, 2 k + 1)
    shape : (ny, nx)
    finer : int
        Samples per pixel.
    """

    def __init__(self, correlation: Image, shape: tuple[int, int], finer: int = 1) -> None:
        periodic = np.zeros((shape[0] + MARGIN, shape[1] + MARGIN))
        reach = correlation.shape[0] // 2
        periodic[: 2 * reach + 1, : 2 * reach + 1] = correlation
        power = np.fft.fft2(np.roll(periodic, (-reach, -reach), axis=(0, 1))).real
        self._amplitude = np.sqrt(np.maximum(power, 0) / np.maximum(power, 0).mean())
        self.shape, self.finer = shape, finer

    def maps(self, seed: int, count: int) -> Iterator[Image]:
        """Fields of `shape` in pixels."""
        rng = np.random.default_rng(seed)
        ny, nx = self._amplitude.shape
        for _ in range((count + 1) // 2):
            white = rng.normal(size=(2, ny, nx))
            spectrum = self._amplitude * np.fft.fft2(white[0] + 1j * white[1])
            if self.finer > 1:  # Between pixels the field has no higher frequencies.
                centred = np.fft.fftshift(spectrum)
                more = [(self.finer - 1) * n // 2 for n in (ny, nx)]
                padded = np.pad(centred, [(each, each) for each in more])
                spectrum = self.finer**2 * np.fft.ifftshift(padded)
            both = np.fft.ifft2(spectrum)
            window = tuple(slice(0, self.finer * n) for n in self.shape)
            yield both.real[window]
            yield both.imag[window]


def laws(significance: Significance) -> dict[str, Image]:
    """Standard deviations of the S/N: as on a bright star, by separation, and 1."""
    distance = separation_of(significance.grid)
    light = np.nan_to_num(significance.starlight)
    return {
        # The scatter of the S/N of single rolls of a star by star over noise.
        "starlight": np.interp(light, [5, 22, 55, 100, 300], [1, 1.4, 2.3, 3.4, 6]),
        "separation": 1 + 1.5 * np.exp(-((distance / 0.8) ** 2)),
        "uniform": np.ones(distance.shape),
    }


def blocks(
    folder: Path, name: str, count: int, compute: Callable[[int], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Rows of `compute(seed)` for as many blocks as there are, from files where they exist."""
    parts = []
    for block in range(count):
        path = folder / f"{name}_{block:04d}.npy"
        if not path.exists():
            # The file is complete or does not exist.
            values = compute(zlib.crc32(f"{name} {block}".encode()))
            with replacing(path) as temporary, open(temporary, "wb") as file:
                np.save(file, values)
        parts.append(np.load(path))
    return np.concatenate(parts)


def judged(fit: Refinement, inner: float = INNER) -> tuple[Maps, Significance, Candidates]:
    """Maps of a fit, what decides on their peaks, and its companions."""
    maps = Maps(Templates(fit))
    known = Candidates.of_fit(fit)
    return maps, significance_of(maps, known.offsets, inner), known


def simulated(fit: Refinement, folder: Path, maps: int, planets: int) -> None:
    """False candidates and completeness of maps whose scatter follows three laws."""
    _, significance, _ = judged(fit)
    distance = separation_of(significance.grid)
    everywhere = np.ones(distance.shape, dtype=bool)
    noise = Noise(significance.correlation, distance.shape)

    def decisions(scale: Image, seed: int) -> NDArray[np.float64]:
        rows = []
        for unit in noise.maps(seed, BLOCK):
            peaks = significance.significant_peaks(scale * unit, NOTHING, LOWEST, everywhere)
            highest = max((sigmas for _, sigmas in peaks), default=0.0)
            rows.append((unit[distance >= significance.inner].max(), highest))
        return np.array(rows)

    def detected(scale: Image, seed: int) -> NDArray[np.float64]:
        """Whether a planet at a separation, of an S/N in units of the true scatter, is found."""
        rng = np.random.default_rng(seed + 1)
        rows = []
        for unit in noise.maps(seed, BLOCK):
            separation, strength = rng.choice(SEPARATIONS), rng.choice(STRENGTHS)
            pixel = _place(significance, separation, rng.uniform(0, 2 * np.pi))
            image = strength * scale[pixel] * _around(significance.correlation, pixel, unit.shape)
            peaks = significance.significant_peaks(scale * unit + image, NOTHING, 5.0, everywhere)
            is_found = any(np.hypot(*np.subtract(peak, pixel)) < 2 for peak, _ in peaks)
            rows.append((separation, strength, is_found))
        return np.array(rows)

    for name, scale in laws(significance).items():

        def decide(seed: int, scale: Image = scale) -> NDArray[np.float64]:
            return decisions(scale, seed)

        def detect(seed: int, scale: Image = scale) -> NDArray[np.float64]:
            return detected(scale, seed)

        unit, highest = blocks(folder, f"false_{name}", maps // BLOCK, decide).T
        row = "; ".join(
            f"{level:g}: {np.mean(highest > level):.2%} (nominal {np.mean(unit > level):.2%})"
            for level in LEVELS
            if level >= LOWEST
        )
        print(f"scatter by {name}, {len(unit)} maps with a false candidate above {row}", flush=True)
        rows = blocks(folder, f"planets_{name}", planets // BLOCK, detect)
        for strength in STRENGTHS:
            shares = [
                rows[(rows[:, 0] == each) & (rows[:, 1] == strength), 2].mean()
                for each in SEPARATIONS
            ]
            text = ", ".join(f"{s:g}: {p:.2f}" for s, p in zip(SEPARATIONS, shares, strict=True))
            print(f"  completeness at a true S/N of {strength:g} by separation: {text}", flush=True)


def _place(significance: Significance, separation: float, angle: float) -> tuple[int, int]:
    place = separation * np.array([np.cos(angle), np.sin(angle)])
    away = separation_of(significance.grid - place)
    row, column = np.unravel_index(np.argmin(away), away.shape)
    return int(row), int(column)


def _around(correlation: Image, pixel: tuple[int, int], shape: tuple[int, ...]) -> Image:
    """S/N of a planet of S/N 1 at a pixel."""
    reach = correlation.shape[0] // 2
    image = np.zeros((shape[0] + 2 * reach, shape[1] + 2 * reach))
    row, column = pixel
    image[row : row + 2 * reach + 1, column : column + 2 * reach + 1] = correlation
    return image[reach:-reach, reach:-reach]


def maxima(fit: Refinement, folder: Path, maps: int) -> None:
    """The probability of a false alarm, and its frequency between the pixels."""
    _, significance, _ = judged(fit)
    distance = separation_of(significance.grid)
    noise = Noise(significance.correlation, distance.shape, FINER)
    fine = np.kron(distance, np.ones((FINER, FINER))) >= significance.inner

    def highest(seed: int) -> NDArray[np.float64]:
        return np.array([unit[fine].max() for unit in noise.maps(seed, BLOCK)])

    heights = blocks(folder, "maxima", maps // BLOCK, highest)
    table = Table(names=("S/N", "share", "error", "probability", "ratio"))
    for level in LEVELS[1:]:
        share, predicted = np.mean(heights > level), significance.false_alarm(level)
        error = np.sqrt(share * (1 - share) / len(heights))
        table.add_row((level, share, error, predicted, predicted / max(share, 1e-9)))
    for name in table.colnames[1:]:
        table[name].format = ".3g"
    print(f"{len(heights)} maps")
    table.pprint_all()


def real(paths: Sequence[Path]) -> None:
    """Maxima of the maps of real fits in which no planet can be."""
    table = Table(
        names=("fit", "map", *(f">{each:g}" for each in LEVELS)), dtype=["U40"] * 2 + ["U12"] * 5
    )
    for path in paths:
        fit = Refinement.read(path)
        maps, significance, known = judged(fit)
        snr = maps.snr(maps.without(known))
        table.add_row((path.stem, "negative", *_counts(significance, -snr, known)))
        table.add_row((path.stem, "positive", *_counts(significance, snr, known)))
        templates = Templates(fit)
        if len(templates.rolls) > 1 and not len(known):
            for k, roll in templates.rolls.items():
                templates.rolls[k] = -roll
            turned = Maps(templates)
            wrong = significance_of(turned, known.offsets, significance.inner)
            counts = _counts(wrong, turned.snr(), known)
            table.add_row((path.stem, "rolls reversed", *counts))
        table[-1:].pprint_all()
    print("maxima and, in brackets, their expectation in Gaussian noise")
    table.pprint_all()


def _counts(significance: Significance, snr: Image, known: Candidates) -> list[str]:
    """Numbers of maxima above the levels, in sigmas of Gaussian noise, and their expectation."""
    factor = significance.factor(snr, known.offsets)
    scaled = snr / factor.factors
    allowed = separation_of(significance.grid) >= significance.inner
    peaks = local_maxima(scaled, allowed, 2.5, size=3)
    alone = significance._scatter.judged(snr, known.offsets, peaks)
    sigmas = [
        significance.sigmas(float(snr[peak]) / max(scatter, significance.least), freedom)
        for peak, (scatter, freedom) in zip(peaks, alone, strict=True)
    ]
    return [
        f"{np.sum(np.array(sigmas) > level)} ({-np.log1p(-significance.false_alarm(level)):.2g})"
        for level in LEVELS
    ]


def main() -> None:
    """Run one of the comparisons."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=["simulated", "maxima", "real"])
    parser.add_argument("fits", type=Path, nargs="+")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--maps", type=int, help="default 10000, and 20000 of the maxima")
    parser.add_argument("--planets", type=int, default=3000)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    if options.what == "real":
        real(options.fits)
        return
    fit = Refinement.read(options.fits[0])
    if options.what == "simulated":
        simulated(fit, options.output, options.maps or 10_000, options.planets)
    else:
        maxima(fit, options.output, options.maps or 20_000)


if __name__ == "__main__":
    main()
