"""How many cells the occulter needs: this package against poppy's plain FFT at full size.

Run from the root of the project, with the package installed:

    python -m benchmarks.convergence

It writes reports/accuracy.md; docs/validation/optics.md has the results. poppy's FFT takes about
4 GB of memory at an oversampling of 8, four times as much at 16.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from benchmarks import poppy_reference as reference
from benchmarks.compared import Array, largest
from benchmarks.provenance import provenance
from pyklip_diffrender.instrument.jwst import jwst_pupil, maskrnd_openings
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE, nircam_coronagraph
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.optics.system import OpticalSystem

WAVELENGTH = 4.5e-6
SEPARATIONS = (0.0, 0.01, 0.05, 0.3, 0.6, 1.5, 2.3)
ANGLE = 0.7
LIMIT = 16


def gradient(model: OpticalSystem, opd: Array, weight: torch.Tensor) -> torch.Tensor:
    """Of a weighted sum of the pixels, with respect to the OPD."""
    variable = torch.from_numpy(opd).to(model.dtype).requires_grad_()
    (model(variable) * weight.to(model.dtype)).sum().backward()
    assert variable.grad is not None
    return variable.grad.to(torch.float64)


def main() -> None:
    """Measure, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--npix", type=int, default=1024)
    parser.add_argument("--poppy-oversample", type=int, nargs="*", default=[2, 4, 8])
    parser.add_argument("--sampling", type=int, nargs="*", default=[2, 4, 8])
    parser.add_argument("--output", type=Path, default=Path("reports") / "accuracy.md")
    arguments = parser.parse_args()
    npix = arguments.npix
    zernikes, opd = reference.lopsided_zernikes(), reference.lopsided_opd(npix)
    pupil = jwst_pupil(npix).numpy()
    lyot = polygon_coverage(maskrnd_openings(), PupilGrid.full(npix)).numpy()
    internal = reference.zernike_opd(zernikes, npix)

    def ours(
        sampling: int, dtype: torch.dtype = torch.float64, route: str = "planes"
    ) -> OpticalSystem:
        return nircam_coronagraph(
            monochromatic=WAVELENGTH,
            npix=npix,
            occulter_sampling=sampling,
            si_wfe=reference.tabulated(zernikes, WAVELENGTH),
            flip_si_wfe=True,
            dtype=dtype,
            route=route,
        )

    stars = {r: (r * np.cos(ANGLE), r * np.sin(ANGLE)) for r in SEPARATIONS}
    finest = ours(LIMIT)
    truth = {r: finest(opd, star_offset=stars[r]).numpy() for r in SEPARATIONS}
    images: dict[tuple[str, int], dict[float, Array]] = {}
    for sampling in arguments.sampling:
        model = ours(sampling)
        images["ours", sampling] = {r: model(opd, star_offset=stars[r]).numpy() for r in stars}
    for oversample in arguments.poppy_oversample:
        system = reference.coronagraph(
            pupil,
            opd,
            lyot,
            internal,
            oversample=oversample,
            fov_pixels=80,
            pixelscale=NIRCAM_LW_PIXELSCALE,
        )
        images["poppy", oversample] = {
            r: reference.image(system, WAVELENGTH, *stars[r]) for r in stars
        }

    head = "| star at | peak | " + " | ".join(f"{who} {k}" for who, k in images) + " |"
    rms = 1e9 * float(np.linalg.norm(zernikes[1:]))
    lines = [head, "|---" * (2 + len(images)) + "|"]
    for r in SEPARATIONS:
        cells = (f"{largest(images[key][r], truth[r]):.1e}" for key in images)
        lines.append(f'| {r:g}" | {truth[r].max():.2e} | ' + " | ".join(cells) + " |")

    common = [k for k in arguments.sampling if k in arguments.poppy_oversample]
    same = [
        "| star at | " + " | ".join(str(k) for k in common) + " |",
        "|---" * (1 + len(common)) + "|",
    ]
    for r in SEPARATIONS:
        cells = (f"{largest(images['ours', k][r], images['poppy', k][r]):.1e}" for k in common)
        same.append(f'| {r:g}" | ' + " | ".join(cells) + " |")

    weight = torch.from_numpy(np.random.default_rng(335).standard_normal((80, 80)))
    errors = {}
    for route in ("planes", "lattice"):
        double, single = (ours(4, dtype, route) for dtype in (torch.float64, torch.float32))
        slopes = [gradient(model, opd, weight) for model in (double, single)]
        errors[route] = (
            largest(single(opd).numpy().astype(float), double(opd).numpy()),
            float((slopes[1] - slopes[0]).norm() / slopes[0].norm()),
        )

    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(
        "\n".join(
            [
                "# Accuracy of the propagation",
                "",
                *provenance("-m benchmarks.convergence"),
                "",
                "## Cells in the occulter's disc",
                "",
                f"{npix} x {npix} samples in the pupil, MASK335R and MASKRND, {WAVELENGTH * 1e6:g} "
                "um, 80 x 80 pixels, a wavefront and internal aberrations without any symmetry "
                f"(60 and {rms:.0f} nm rms). `poppy` is an `OpticalSystem` put together "
                "independently (`poppy_reference`) with that FFT oversampling, `ours` is "
                "`nircam_coronagraph` with that `occulter_sampling`. In the table: the largest "
                "difference from the converged image as a fraction of the image's peak; the "
                "peak as a fraction of the light that the pupil collects.",
                "",
                *lines,
                "",
                f"Converged is `ours` with {LIMIT} cells per lambda/D.",
                "",
                "## The same cells",
                "",
                "poppy's FFT samples the occulter at the same points. With as many cells the two "
                "therefore differ by rounding only, so that `ours` stands for poppy at samplings "
                "where its FFT does not fit into memory. Largest difference as a fraction of the "
                "peak:",
                "",
                *same,
                "",
                "## Single precision",
                "",
                "float32 against float64, star on the axis, plane by plane: image "
                f"{errors['planes'][0]:.1e} of the peak, gradient of a random sum of pixels with "
                f"respect to the OPD {errors['planes'][1]:.1e} (relative L2). The star is "
                f"suppressed by a factor of {ours_suppression(double, opd):.0f} there, which costs "
                "as many digits.",
                "",
                "By convolution on the detector's lattice, the default: image "
                f"{errors['lattice'][0]:.1e}, gradient {errors['lattice'][1]:.1e}. What the "
                "occulter takes away is subtracted on the detector there, and rounding errors of "
                "two terms that are some twenty times the difference remain; in the pupil they "
                "average out on the way to the detector.",
                "",
            ]
        ),
        encoding="utf-8",
    )


def ours_suppression(model: OpticalSystem, opd: Array) -> float:
    """Peak without the occulter over the peak with it."""
    clear = nircam_coronagraph(**{**model.recipe, "image_mask": None, "route": "auto"})
    return float(clear(opd).max() / model(opd).max())


if __name__ == "__main__":
    main()
