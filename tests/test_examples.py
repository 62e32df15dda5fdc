"""Every study of examples/paper in its small version, as its reader would start it.

What comes out is compared with what went in: planets of known contrast and place, a star whose
wavefront is known. Tolerances are four of the errors that the study itself states, unless a
comment says otherwise; the small versions take 25 to 50 seconds of processor time each.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from astropy.table import Table
from matplotlib.figure import Figure
from numpy.typing import NDArray

import pyklip_diffrender as dr

FOLDER = Path(__file__).parents[1] / "examples" / "paper"

SIGMAS = 4.0

NO_SCRIPTS = {
    "experiments", "inference_figure", "judging", "methods", "overview", "pages", "pictures",
    "published", "recipe", "scene", "sections", "summary",
}  # fmt: skip

WARNINGS = ("-W", "error")


def middle(table: Table, method: str, column: str) -> float:
    """Median of one method's rows."""
    return float(np.median(table[column][table["method"] == method]))


def assert_right(measured: object, truth: object, error: object) -> None:
    """Numbers agree with the truth within four of their errors, and the errors are no excuse."""
    measured, truth, error = (np.asarray(v, dtype=float) for v in (measured, truth, error))
    assert (np.abs(measured - truth) <= SIGMAS * error).all()
    assert (error < 0.5 * np.abs(truth)).all()


def assert_star_is_best(table: Table, best: str = "Gauss-Newton") -> None:
    """The refined star is nearer to the truth than any other, and nearer than the noise."""
    error = middle(table, best, "star_error")
    assert 0.05 < error < 1
    assert middle(table, "optimal", "star_error") == 0
    for other in {str(m) for m in table["method"]} - {best, "optimal", "marginalised"}:
        assert error < 0.3 * middle(table, other, "star_error"), other


def assert_planet_is_whole(table: Table) -> None:
    """The marginalised planet has its flux; no more S/N than photons allow, and half at least."""
    snr = np.asarray(table["marginalised_snr"])
    assert_right(table["marginalised_throughput"], np.ones(len(table)), 1 / snr)
    if "photon_snr" in table.colnames:
        share = snr / table["photon_snr"]
        assert ((share > 0.5) & (share < 1 + SIGMAS / snr)).all()


def assert_quiet(table: Table) -> None:
    """S/N where there is no planet scatters by 1.

    A frame of the small version has some fifty independent positions, whose scatter is uncertain
    by a tenth.
    """
    assert np.abs(np.asarray(table["null"]) - 1).max() < SIGMAS * 0.1


# -- one check a study ---------------------------------------------------------------------------


def calibration(table: Table) -> None:
    assert set(table["status"]) == {"CONVERGED"}
    assert_quiet(table)
    # Parameters take degrees of freedom; 2304 pixels leave an uncertainty of 3 %.
    assert np.abs(table["chi2"] - (1 - table["effective"] / 2304)).max() < SIGMAS * 0.03
    # A wavefront that has to be found costs something; it cannot bring anything.
    limits = [table[n] for n in table.colnames if n.startswith("limit_") and n[6:7].isdigit()]
    assert np.nanmin(limits) > 1
    assert (table["limit_mean"] < 2).all()
    assert (table["star_error"] < 0.7).all()


def companions(table: Table) -> None:
    assert table["found"].all()
    assert not table["false_candidates"].any()
    assert_right(table["measured"], table["contrast"], table["error"])
    # lambda / D is 142 mas; at S/N 15 a place is known to a tenth of that.
    assert (table["away_mas"] < 20).all()


def contrast_boundary(table: Table) -> None:
    limits = {str(row["method"]): float(row["contrast"]) for row in table}
    assert limits["photon limit"] < limits["marginalised"] < 2 * limits["photon limit"]
    assert limits["photon limit"] < limits["optimal"] < limits["Gauss-Newton"]
    assert 3 * limits["Gauss-Newton"] < limits["KLIP"]
    assert 3 * limits["Gauss-Newton"] < limits["Adam"] < limits["initial"]
    kept = {str(row["method"]): float(row["throughput"]) for row in table}
    assert kept["initial"] == pytest.approx(1, rel=1e-9)
    assert kept["optimal"] == pytest.approx(1, rel=1e-9)
    assert 0.3 < kept["Gauss-Newton"] < 1
    # The planet is injected near the limit, where its S/N is 5.
    error = limits["marginalised"] / 5 / float(table["injected"][0])
    assert_right(kept["marginalised"], 1, error)


def contrast_drift(table: Table) -> None:
    assert_star_is_best(table)
    assert_planet_is_whole(table)
    snr = {str(row["method"]): float(row["annulus_snr"]) for row in table}
    # The planet of this case is bright: whoever knows the star sees it at the same S/N.
    assert snr["marginalised"] == pytest.approx(snr["optimal"], rel=0.1)
    assert snr["marginalised"] > 2 * max(snr["KLIP"], snr["Adam"], snr["initial"], 5)


def beyond(table: Table) -> None:
    assert set(table["status"]) == {"CONVERGED"}
    assert_star_is_best(table)
    assert_planet_is_whole(table)
    assert_quiet(table)


def failures(table: Table) -> None:
    """A prior that is too tight is said to be; in both cases errors are inflated to be right."""
    assert [str(status) for status in table["status"]] == ["PRIOR_MISMATCH", "MODEL_MISMATCH"]
    assert (table["chi2"] > table["expected_chi2"]).all()
    assert (table["scatter"] > 1).all()
    assert_quiet(table)
    assert (table["limit"] > 1).all()


def fluxes(table: Table) -> None:
    assert_right(table["measured"], table["contrast"], table["error"])
    assert (table["error"] > table["photon_error"]).all()
    # At the closed-form limit the S/N is 5, of the frame without the planet.
    (limit,) = table[table["injected_at_limit"]]
    assert limit["contrast"] / limit["error"] == pytest.approx(5, rel=0.1)
    # The residual of a fit that knows of no planet has lost part of it.
    # A single draw: the noise over the planet's light scatters by a few percent.
    assert ((table["kept_by_subtraction"] > 0.2) & (table["kept_by_subtraction"] < 1.05)).all()


def matched(table: Table) -> None:
    assert middle(table, "marginalised", "matched_snr") > 5 * abs(
        middle(table, "KLIP", "matched_snr")
    )
    photons = np.median(table["photon_snr"])
    assert 0.5 < middle(table, "marginalised", "matched_snr") / photons < 1.2
    for method in ("initial", "optimal"):
        assert middle(table, method, "throughput") == pytest.approx(1, abs=0.05)
    assert_right(
        middle(table, "marginalised", "throughput"), 1,
        1 / middle(table, "marginalised", "matched_snr"),
    )  # fmt: skip


def klip_table(table: Table) -> None:
    assert_star_is_best(table)
    matched(table)


def location(table: Table) -> None:
    (row,) = table
    assert row["found"]
    assert row["false_candidates"] == 0
    for axis in "xy":
        assert abs(row[f"{axis}_found"] - row[axis]) < SIGMAS * row[f"{axis}_error"]
        # Photons allow about lambda / (2 pi D) / (S/N).
        assert 0.142 / (2 * np.pi) / row["photon_snr"] < row[f"{axis}_error"] < 0.005
    assert_right(row["flux_ratio"], 1, 1 / row["snr"])
    assert row["snr_Gauss-Newton"] > 2 * max(row["snr_KLIP"], row["snr_Adam"], row["snr_initial"])


def misalignment(table: Table) -> None:
    assert_star_is_best(table, "Gauss-Newton, fitted")
    assert_planet_is_whole(table)
    # The planet on a known star has the PSNR that its photons give; a fitted stop reaches that.
    known = middle(table, "optimal", "psnr")
    assert middle(table, "Gauss-Newton, fitted", "psnr") > known - 3
    held = [m for m in dict.fromkeys(str(m) for m in table["method"]) if m.endswith("held")]
    assert len(held) == 2
    for method in held:
        assert middle(table, method, "psnr") < known - 10


def mismatch(table: Table) -> None:
    (row,) = table
    assert row["status"] == "CONVERGED"
    # What was not known of the instrument is found; the start was off by many times as much.
    assert row["offset_error_mas"] < 1
    assert row["lyot_error_percent"] < 0.02
    assert row["rotation_error_deg"] < 0.01
    assert row["flux_error_percent"] < 1
    assert_quiet(table)
    assert row["snr"] > 5
    assert 0.8 < row["information_kept"] <= 1 + 1e-9
    assert row["snr"] == pytest.approx(row["snr_matched"], rel=0.2)


def progress(table: Table) -> None:
    for method in ("Adam", "Gauss-Newton"):
        mine = table[table["method"] == method]
        mine.sort("step")
        assert (np.diff(mine["star_error"]) < 0).all()
        assert (np.diff(mine["opd_left"]) <= 0).all()
        assert (mine["opd_left"] < 1.2).all()
    newton, adam = (table[table["method"] == m] for m in ("Gauss-Newton", "Adam"))
    # Five steps of the one, two hundred of the other.
    assert newton["star_error"].min() < 0.5 * adam["star_error"].min()
    assert newton["opd_left"].min() < adam["opd_left"].min()


def ring(table: Table) -> None:
    assert_right(table["measured"], table["light"], table["error"])
    # Subtraction alone loses it.
    assert (np.abs(table["kept_by_subtraction"]) < 0.95).all()
    assert (table["ring_over_star"] > 0).all()


def snapshots(table: Table) -> None:
    assert list(table["snapshots"]) == [1, 2]
    assert_right(table["measured"], np.full(2, 5e-7), table["error"])
    assert_right(table["linked"][1], 5e-7, table["linked_error"][1])
    first, second = table["error"]
    assert second < first
    # Frames of one wavefront: two are worth sqrt(2), or more when fitted together.
    assert first / second == pytest.approx(2**0.5, rel=0.15)


def snr_grid(table: Table) -> None:
    matched(table)


def speed(table: Table) -> None:
    """No duration is asserted; that of one step of the recipe is a part of the whole."""
    assert (np.asarray(table["refine"], dtype=float) > 0).all()


CHECKS: dict[str, Callable[[Table], None]] = {
    check.__name__: check
    for check in (
        beyond, calibration, companions, contrast_boundary, contrast_drift, failures, fluxes,
        klip_table, location, misalignment, mismatch, progress, ring, snapshots, snr_grid, speed,
    )
}  # fmt: skip

DRAWN = {
    "beyond": ("marginalised_throughput",),
    "contrast_boundary": ("contrast", "matched", "throughput"),
    "contrast_drift": (),
    "klip_table": ("annulus_snr", "matched_snr", "throughput"),
    "location": ("x", "y", "x_found", "y_found", "snr_KLIP", "snr_Gauss-Newton"),
    "misalignment": ("psnr",),
    "progress": ("star_error", "annulus_snr", "opd_left"),
    "snr_grid": ("annulus_snr", "matched_snr", "throughput"),
}
"""Of studies with a section on the page of experiments: the columns that their figure draws."""


def test_every_study_is_tested() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} - NO_SCRIPTS == set(CHECKS)


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))


def run(name: str, folder: Path) -> Table:
    command = [sys.executable, *WARNINGS, str(FOLDER / f"{name}.py"), "--quick", "-o", str(folder)]
    done = subprocess.run(
        command,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return Table.read(folder / f"{name}_generator.ecsv", format="ascii.ecsv")


def drawn_values(figure: Figure) -> np.ndarray:
    """All coordinates of all lines and markers."""
    data = [line.get_xydata() for ax in figure.axes for line in ax.lines]
    return np.concatenate([np.asarray(each, dtype=float).ravel() for each in data])


@pytest.mark.study
@pytest.mark.parametrize("name", CHECKS)
@pytest.mark.usefixtures("examples")
def test_small_version(name: str, tmp_path: Path) -> None:
    table = run(name, tmp_path)
    CHECKS[name](table)
    experiments = importlib.import_module("experiments")
    assert set(DRAWN) == set(experiments.TITLES)
    if name not in DRAWN:
        return
    study = next(study for study in experiments.STUDIES if study.name == name)
    pictures = importlib.import_module("pictures")
    path = pictures.image_path(tmp_path / f"{name}_generator.ecsv")
    images = (pictures.read_images(path),) if study.pictures else ()
    figure = study.module.draw(table, *images)
    for column in DRAWN[name]:
        # One seed: its values are the medians that are drawn.
        values = np.asarray(table[column], dtype=float)
        shown = drawn_values(figure)
        assert np.isclose(values[np.isfinite(values)][:, None], shown, rtol=1e-9).any(axis=1).all()
    if study.pictures:
        drawn = [np.asarray(each.get_array()) for ax in figure.axes for each in ax.images]
        assert len(drawn) >= 3
        for image in drawn:
            assert any(np.array_equal(image, true, equal_nan=True) for true in images[0].values())
    page = experiments.write(tmp_path, tmp_path).read_text(encoding="utf-8")
    assert f"![{study.title}](images/paper_{name}.png)" in page
    assert (tmp_path / "images" / f"paper_{name}.png").is_file()
    assert f"`{table.meta['command']}`" in page
    assert not re.search(r"\bnan\b", page)


@pytest.fixture
def recipe(examples: None) -> ModuleType:
    return importlib.import_module("recipe")


@dataclass
class Small:
    """A small model, a map, and a frame under another wavefront."""

    model: dr.OpticalSystem
    opd: NDArray[np.float64]
    frame: dr.Observation


FLUX, BACKGROUND = 1e10, 500.0


@pytest.fixture(scope="module")
def small() -> Small:
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=20)
    before, after = (dr.random_opd(seed, npix=64).data for seed in (1, 2))
    counts = np.random.default_rng(3).poisson(FLUX * model(after).numpy() + BACKGROUND)
    frame = dr.Observation.from_arrays(
        counts, np.sqrt(counts + 1), pixelscale=model.detector.pixelscale
    )
    return Small(model, before, frame)


def test_the_recipe_lowers_the_mean_absolute_error(recipe: ModuleType, small: Small) -> None:
    fit = recipe.adam_recipe(
        small.model, small.frame, small.opd, flux=FLUX, background=BACKGROUND, steps=30
    )
    first = FLUX * small.model(small.opd).numpy() + BACKGROUND
    assert fit.losses[0] == pytest.approx(np.abs(first - small.frame.data[0]).mean(), rel=1e-10)
    assert fit.losses == tuple(sorted(fit.losses, reverse=True))
    assert fit.losses[-1] < 0.995 * fit.losses[0]
    assert len(fit.losses) == 30
    # Every step moves a pixel by a little more than the learning rate at most.
    assert 1e-10 < np.abs(fit.wavefront - small.opd).max() < 3.3e-10
    final = FLUX * small.model(fit.wavefront).numpy() + BACKGROUND
    np.testing.assert_allclose(fit.star, final, rtol=1e-10)
    assert np.abs(fit.residual).mean() == pytest.approx(min(fit.losses), rel=1e-10)


def test_the_first_step_of_the_recipe_is_against_the_gradient(
    recipe: ModuleType, small: Small
) -> None:
    fit = recipe.adam_recipe(small.model, small.frame, small.opd, flux=FLUX, steps=2)
    opd = torch.from_numpy(small.opd.copy()).requires_grad_()
    image = FLUX * small.model(opd)
    (gradient,) = torch.autograd.grad(
        (image - torch.from_numpy(small.frame.data[0])).abs().mean(), opd
    )
    strong = gradient.abs() > 1e-3 * gradient.abs().max()
    step = torch.from_numpy(fit.wavefront - small.opd)
    torch.testing.assert_close(step[strong], -1e-11 * gradient.sign()[strong], rtol=1e-3, atol=0)


def test_the_recipe_does_not_see_masked_pixels(recipe: ModuleType, small: Small) -> None:
    valid = np.random.default_rng(4).random(small.frame.shape) > 0.05
    fits = []
    for junk in (0.0, 1e30):
        data = np.where(valid, small.frame.data[0], junk)
        masked = replace(small.frame, data=data[None], valid=valid[None])
        fits.append(recipe.adam_recipe(small.model, masked, small.opd, flux=FLUX, steps=3))
    assert fits[0].wavefront.tobytes() == fits[1].wavefront.tobytes()
    assert fits[0].losses == fits[1].losses
    expected = np.abs(FLUX * small.model(small.opd).numpy() - small.frame.data[0])[valid].mean()
    assert fits[0].losses[0] == pytest.approx(expected, rel=1e-9)
