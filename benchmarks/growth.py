"""How the time of a fit grows, beside a count of its operations.

    python -m benchmarks.growth --output docs/results/growth.ecsv

Made stars in F444W behind MASK335R, whose wavefront has drifted for 4 h since the map. From one
frame of 80 x 80 pixels, modes to 12 cycles and 4 wavelengths, one size changes at a time. All fits
take the same number of steps, so that the time of a step is compared. In the same process are
measured the processor time of one thread, and the rates of products of real and of complex
matrices, by which the counted operations become seconds:

- The normal equations of u unknowns of a frame with p pixels, of which one triangle is computed:
  u^2 p.
- The transform of a field from k x k samples of the pupil to n x n samples of the detector at one
  wavelength, by a product of matrices: 8 (k^2 n + k n^2), for each image of the star, and for the
  derivatives by each mode.

Both are counted as often as the fit needs them. Not counted are the occulter and the derivatives of
the image by the other parameters.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from astropy.table import Table

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from benchmarks.speed.timing import exponent
from pyklip_diffrender.io.files import write_table
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement import equations
from pyklip_diffrender.wavefront.opd import random_drift

START: dict[str, float] = {"pixels": 80, "cycles": 12, "wavelengths": 4, "frames": 1}
SIZES: dict[str, tuple[float, ...]] = {
    "pixels": (40, 80, 120, 160, 240),
    "cycles": (6, 9, 12, 18, 24),
    "wavelengths": (1, 2, 4, 8),
    "frames": (1, 2, 4, 7, 11),
}
STEPS = 6
DRIFT_HOURS = 4.0
PUPIL_SAMPLES = 512
RESPONSE_SAMPLES = 128
MATRIX_SIZE = 1024


class Count(logging.Handler):
    """Counts operations of real numbers in a fit: normal equations, and transforms of fields."""

    def __init__(self, model: dr.OpticalSystem, wavelengths: int) -> None:
        super().__init__(logging.DEBUG)
        self.normal = self.transforms = 0.0
        self._samples = model.detector.shape[0] * model.detector.oversample
        self._wavelengths = wavelengths

    def add_transforms(self, pupil_samples: int, fields: float) -> None:
        """Count transforms of fields from a pupil to the detector."""
        k, n = pupil_samples, self._samples
        self.transforms += fields * 8.0 * (k**2 * n + k * n**2)

    def emit(self, record: logging.LogRecord) -> None:
        """Count the transforms of a response, whose message has the number of its modes."""
        if str(record.msg).startswith("response of") and isinstance(record.args, tuple):
            modes = float(str(record.args[0]))
            self.add_transforms(RESPONSE_SAMPLES, modes * self._wavelengths)

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count what is computed within."""
        accumulate, field = equations._accumulate, OpticalSystem.field
        logger = logging.getLogger("pyklip_diffrender")

        def accumulated(jacobian: torch.Tensor, *rest: Any) -> Any:
            unknowns, pixels = jacobian.shape
            self.normal += float(unknowns) ** 2 * pixels
            return accumulate(jacobian, *rest)

        def propagated(model: OpticalSystem, *rest: Any) -> Any:
            self.add_transforms(model.npix, 1)
            return field(model, *rest)

        level = logger.level
        logger.addHandler(self)
        logger.setLevel(logging.DEBUG)
        try:
            with (
                patch.object(equations, "_accumulate", accumulated),
                patch.object(OpticalSystem, "field", propagated),
            ):
                yield
        finally:
            logger.removeHandler(self)
            logger.setLevel(level)


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """Processor time of a piece of work, and its result."""
    began = time.process_time()
    result = work()
    return time.process_time() - began, result


def rate(dtype: torch.dtype) -> float:
    """Real operations in a second of a product of matrices, the best of three."""
    one = torch.ones(MATRIX_SIZE, MATRIX_SIZE, dtype=dtype)
    least = min(seconds(lambda: one @ one)[0] for _ in range(3))
    return (8 if dtype.is_complex else 2) * MATRIX_SIZE**3 / least


def measured(pixels: float, cycles: float, wavelengths: float, frames: float) -> dict[str, float]:
    """Processor time and counted operations of one fit."""
    model = dr.nircam_coronagraph(
        "F444W", npix=PUPIL_SAMPLES, fov_pixels=int(pixels), nlambda=int(wavelengths)
    )
    start = dr.wavefront.random_opd(1, npix=PUPIL_SAMPLES)
    drift = random_drift(2, DRIFT_HOURS, npix=PUPIL_SAMPLES)
    now = replace(start, data=start.data + drift.data)
    observed = [dr.simulate(model, dr.Scene(), now, seed=k) for k in range(int(frames))]
    settings = dr.FitSettings(
        cycles=cycles, max_iterations=STEPS, tolerance=1e-12, adapt_prior=False,
        response_npix=RESPONSE_SAMPLES,
    )  # fmt: skip
    count = Count(model, min(int(wavelengths), settings.response_wavelengths))
    with count.counting():
        fit_seconds, fit = seconds(lambda: dr.refine(model, observed, start, settings=settings))
    return {
        "unknowns": len(fit.linear.unknowns), "fit": fit_seconds,
        "normal": count.normal, "transforms": count.transforms,
    }  # fmt: skip


def table_of(sizes: dict[str, tuple[float, ...]]) -> Table:
    """One row for each size."""
    rates = {"normal": rate(torch.float64), "transforms": rate(torch.complex64)}
    rows = []
    for name, values in sizes.items():
        for value in values:
            row = measured(**{**START, name: value})
            ideal = sum(row[part] / rates[part] for part in rates)
            rows.append({"size": name, "value": value, **row, "counted": ideal})
            print(rows[-1], flush=True)
    table = Table(rows)
    table["over_counted"] = table["fit"] / table["counted"]
    for name in ("fit", "counted"):
        table[name].unit = "s"
    for name in ("fit", "counted", "over_counted"):
        table[name].format = ".3g"
    table["fit"].description = "processor time of one thread"
    table["counted"].description = "counted operations over the rate of a product of matrices"
    return table


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, help="file for the table (ECSV)")
    parser.add_argument("--quick", action="store_true", help="the two smallest sizes of each kind")
    options = parser.parse_args()
    torch.set_num_threads(1)
    sizes = {k: v[:2] for k, v in SIZES.items()} if options.quick else SIZES
    table = table_of(sizes)
    table.meta = provenance("benchmarks.growth --output FILE")
    for name in sizes:
        rows = table[table["size"] == name]
        for part in ("fit", "counted"):
            power = exponent(np.asarray(rows["value"]), np.asarray(rows[part]))
            table.meta[f"exponent of {part} in {name}"] = round(float(power), 2)
    table.pprint_all()
    print(*(f"{k}: {v}" for k, v in table.meta.items()), sep="\n")
    if options.output is not None:
        write_table(table, options.output)


if __name__ == "__main__":
    main()
