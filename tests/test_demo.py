"""Options of benchmarks and examples, the paper's recipe, figures of merit, the demo end to end."""

import importlib
import math
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import pyklip_diffrender as dr
from pyklip_diffrender.demo import DITHERS, draw_demo, run_demo, simulate_references, write_demo
from pyklip_diffrender.detection import metrics
from pyklip_diffrender.drawing import save
from pyklip_diffrender.io import open_fits
from pyklip_diffrender.scene.objects import ALPHA_PICTORIS_W2
from pyklip_diffrender.scene.simulation import star_photons

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted(
    path.relative_to(ROOT).as_posix()
    for folder in ("benchmarks", "examples")
    for path in (ROOT / folder).rglob("*.py")
    if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")
)


def run(script, monkeypatch):
    if script.startswith("benchmarks/"):
        name = script.removesuffix(".py").removesuffix("/__main__").replace("/", ".")
        # Another test may have imported it.
        monkeypatch.delitem(sys.modules, name, raising=False)
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(str(ROOT / script), run_name="__main__")


@pytest.mark.parametrize("script", [each for each in SCRIPTS if "summary" not in each])
def test_help(script, monkeypatch, capsys):
    if "slurm" in script:
        pytest.importorskip("dask_jobqueue")
    if script.startswith("examples/"):
        monkeypatch.syspath_prepend((ROOT / script).parent)
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit) as ended:
        run(script, monkeypatch)
    assert not ended.value.code
    assert capsys.readouterr().out.startswith("usage:")


FLUX, BACKGROUND = 1e10, 500.0


def test_the_recipe_lowers_the_mean_absolute_error_of_the_valid_pixels(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples" / "paper")
    recipe = importlib.import_module("recipe").adam_recipe
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=20)
    opd, after = (dr.wavefront.random_opd(seed, npix=64).data for seed in (1, 2))
    counts = np.random.default_rng(3).poisson(FLUX * model(after).numpy() + BACKGROUND)
    valid = np.random.default_rng(4).random(counts.shape) > 0.05
    scale = model.detector.pixelscale
    frame = dr.Observation.from_arrays(counts, np.sqrt(counts + 1), pixelscale=scale)
    frame = replace(frame, data=np.where(valid, frame.data, 1e30), valid=valid[None])
    fit = recipe(model, frame, opd, flux=FLUX, background=BACKGROUND, steps=30)
    first, final = (FLUX * model(each).numpy() + BACKGROUND for each in (opd, fit.wavefront))
    ends = [np.abs(each - frame.data[0])[valid].mean() for each in (first, final)]
    assert ends == pytest.approx([fit.losses[0], min(fit.losses)], rel=1e-10)
    assert fit.losses == tuple(sorted(fit.losses, reverse=True))
    assert fit.losses[-1] < 0.995 * fit.losses[0]
    assert len(fit.losses) == 30
    # Every step moves a pixel by a little more than the learning rate at most.
    assert 1e-10 < np.abs(fit.wavefront - opd).max() < 3.3e-10
    np.testing.assert_allclose(fit.star, final, rtol=1e-10)


CENTER, PLANET, SHAPE = (10.0, 12.0), (15.0, 12.0), (25, 21)
Y, X = np.indices(SHAPE)


def spot():
    """A round spot of known values, lopsided in y."""
    return np.exp(-0.3 * ((X - PLANET[0]) ** 2 + (Y - PLANET[1] - 0.3) ** 2))


def test_annulus_snr_of_a_chessboard():
    """Signal 7 on 9 pixels, +-1 elsewhere: mean m and deviation sqrt(1 - m^2) by counting."""
    image = np.where((X + Y) % 2 == 0, 1.0, -1.0)
    image[11:14, 14:17] = 7.0
    radius = np.hypot(X - CENTER[0], Y - CENTER[1])
    ring = (radius >= 3.5) & (radius <= 6.5) & (np.hypot(X - PLANET[0], Y - PLANET[1]) > 1.5)
    mean = image[ring].mean()
    expected = (7 - mean) / math.sqrt(1 - mean**2) * math.sqrt(9)
    assert 20 < expected < 22
    # It has no units: a scaled image has the same signal to noise, a shifted level too.
    for same in (image, 1.01 * image + 3):
        assert metrics.annulus_snr(same, PLANET, CENTER) == pytest.approx(expected, rel=1e-12)


def test_throughput_weighs_pixels_by_their_noise():
    """Two pixels: sum(p d / s^2) / sum(p^2 / s^2) = (1*3/1 + 2*1/4) / (1/1 + 4/4) = 1.75."""
    planet, image, noise = np.zeros(SHAPE), np.zeros(SHAPE), np.ones(SHAPE)
    planet[12, 15:17], image[12, 15:17] = (1.0, 2.0), (3.0, 1.0)
    noise[12, 16] = 2.0
    image[12, 19] = 1e9  # Outside the radius nothing counts; what is not finite does not either.
    for share in (1.0, 0.0, -0.2):
        found = metrics.throughput(share * image, planet, noise, PLANET)
        assert found == pytest.approx(1.75 * share, rel=1e-14)
    image[12, 15] = np.nan
    assert metrics.throughput(image, planet, noise, PLANET) == pytest.approx(0.5, rel=1e-14)


def test_star_model_error_is_an_rms_over_the_ring_in_units_of_the_noise():
    truth, noise = np.full(SHAPE, 100.0), np.full(SHAPE, 5.0)
    distance = np.hypot(X - CENTER[0], Y - CENTER[1])
    for away in (15.0, 0.0, -100.0):
        model = np.where((distance >= 3) & (distance <= 6), 100 + away, 1e9)
        error = metrics.star_model_error(model, truth, noise, CENTER, 3, 6)
        assert error == pytest.approx(abs(away) / 5, rel=1e-14)


def test_psnr_of_a_known_error(monkeypatch):
    """Peak p, constant error e: 20 log10(p / e)."""
    monkeypatch.syspath_prepend(ROOT / "examples" / "paper")
    psnr = importlib.import_module("judging").psnr
    planet, peak = spot(), float(spot().max())
    assert psnr(planet + 0.01 * peak, planet, PLANET) == pytest.approx(40.0, abs=1e-9)
    assert psnr(planet, planet, PLANET) == math.inf
    # 1 % too bright is an error of 1 % of the window's rms.
    window = planet[7:18, 10:21]
    expected = 20 * math.log10(peak / (0.01 * math.sqrt((window**2).mean())))
    assert psnr(1.01 * planet, planet, PLANET) == pytest.approx(expected, abs=1e-9)


def test_references_are_nine_dithered_frames_of_the_reference_star():
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=20)
    opd = dr.wavefront.random_opd(2, npix=128).data
    frames = simulate_references(model, opd, seed=7)
    assert frames.shape == (9, 20, 20)
    assert len(set(DITHERS)) == 9
    star = dr.Star(w2_magnitude=ALPHA_PICTORIS_W2, exposure=400.0)
    for frame, (x, y) in zip(frames, DITHERS, strict=True):
        # Nominal positions in mas, missed by 10 mas in x.
        offset = ((x + 10) * 1e-3, y * 1e-3)
        expected = star_photons(model, dr.Scene(star=star, star_offset=offset), opd)
        away = (frame - expected) / np.sqrt(expected + 42.0**2)
        assert np.sqrt(np.mean(away**2)) == pytest.approx(1.0, abs=0.12)


@pytest.mark.slow
def test_the_demo_finds_the_planet_that_klip_loses(tmp_path):
    result = run_demo(size=36)
    names = ["initial", "KLIP", "refined", "detected", "optimal"]
    assert list(result.table["star model"]) == names
    assert result.fit.status is dr.Status.CONVERGED
    snr, kept, error = (
        dict(zip(names, result.table[column], strict=True))
        for column in ("annulus SNR", "planet throughput", "star error")
    )
    # The star is known to better than the noise, KLIP and the old wavefront leave it above.
    assert error["refined"] < 1
    assert error["optimal"] == 0
    assert error["KLIP"] > 3 * error["refined"]
    assert error["initial"] > 20
    # The planet's light survives the refinement. What KLIP keeps drowns in the star it leaves.
    assert kept["refined"] > 0.5
    # A matched filter on the true star's residual scatters by the noise over the planet's light.
    assert kept["optimal"] == pytest.approx(1.0, abs=0.4)
    assert snr["refined"] > max(4, snr["KLIP"] + 1)
    # Once it is found, it loses nothing any more.
    assert abs(kept["detected"] - kept["optimal"]) < 0.1
    assert snr["detected"] > 0.8 * snr["optimal"]
    assert error["detected"] < 1.1 * error["refined"]

    # With the wavefront marginalised the planet is whole, and where it is.
    (found,) = result.detection.candidates
    assert found["snr"] > snr["refined"]
    assert abs(found["contrast"] - 1e-6) < 3 * found["contrast_error"]
    assert found["separation"].to_value("arcsec") == pytest.approx(0.6, abs=0.02)
    assert found["position_angle"].to_value("deg") == pytest.approx(54.0, abs=2.0)

    images, written_table, candidates = write_demo(result, tmp_path)
    save(draw_demo(result), tmp_path / "demo.png")
    assert (tmp_path / "demo.png").stat().st_size > 50_000
    with open_fits(images) as hdus:
        np.testing.assert_array_equal(hdus["REFINED"].data, result.fit.frames[0].residual[0])
        np.testing.assert_allclose(hdus["OPD_TRUE"].data, result.true_opd, rtol=1e-6, atol=1e-16)
        assert hdus["OPD_REFINED"].header["BUNIT"] == "m"
        assert {hdus[k].header["BUNIT"] for k in range(1, 7)} == {"photon"}
        assert hdus[0].header["status"] == "CONVERGED"
    read = Table.read(written_table, format="ascii.ecsv")
    np.testing.assert_allclose(read["annulus SNR"], result.table["annulus SNR"], rtol=1e-6)
    assert read.meta["hours"] == 40.0
    assert len(Table.read(candidates, format="ascii.ecsv")) == 1
