"""The demo, end to end: its physics, its table, its files and its figure."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from pyklip_diffrender.demo import DITHERS, draw_demo, run_demo, simulate_references, write_demo
from pyklip_diffrender.drawing import save
from pyklip_diffrender.instrument import nircam_coronagraph
from pyklip_diffrender.io import open_fits
from pyklip_diffrender.refinement import Status
from pyklip_diffrender.scene import ALPHA_PICTORIS_W2, Scene, Star, star_photons
from pyklip_diffrender.wavefront import random_opd


def test_references_are_nine_dithered_frames_of_the_reference_star():
    model = nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=20)
    opd = random_opd(2, npix=128).data
    frames = simulate_references(model, opd, seed=7)
    assert frames.shape == (9, 20, 20)
    assert len(set(DITHERS)) == 9
    star = Star(w2_magnitude=ALPHA_PICTORIS_W2, exposure=400.0)
    for frame, (x, y) in zip(frames, DITHERS, strict=True):
        # Nominal positions in mas, missed by 10 mas in x.
        offset = ((x + 10) * 1e-3, y * 1e-3)
        expected = star_photons(model, Scene(star=star, star_offset=offset), opd)
        away = (frame - expected) / np.sqrt(expected + 42.0**2)
        assert np.sqrt(np.mean(away**2)) == pytest.approx(1.0, abs=0.12)


@pytest.mark.slow
def test_the_demo_finds_the_planet_that_klip_loses(tmp_path):
    result = run_demo(size=48)
    table = result.table
    assert table.colnames == [
        "star model", "annulus SNR", "planet throughput", "star error", "seconds",
    ]  # fmt: skip
    rows = {row["star model"]: row for row in table}
    assert list(rows) == ["initial", "KLIP", "refined", "detected", "optimal"]
    assert result.fit.status is Status.CONVERGED

    # The star is known to better than the noise, KLIP and the old wavefront leave it above.
    assert rows["refined"]["star error"] < 1
    assert rows["optimal"]["star error"] == 0
    assert rows["KLIP"]["star error"] > 3 * rows["refined"]["star error"]
    assert rows["initial"]["star error"] > 20
    # The planet's light survives the refinement. What KLIP keeps drowns in the star it leaves.
    assert rows["refined"]["planet throughput"] > 0.5
    # A matched filter on the true star's residual scatters by the noise over the planet's light.
    assert rows["optimal"]["planet throughput"] == pytest.approx(1.0, abs=0.4)
    assert rows["refined"]["annulus SNR"] > max(4, rows["KLIP"]["annulus SNR"] + 1)
    # Once it is found, it loses nothing any more.
    kept = {name: rows[name]["planet throughput"] for name in ("refined", "detected", "optimal")}
    assert abs(kept["detected"] - kept["optimal"]) < 0.1
    assert rows["detected"]["annulus SNR"] > 0.8 * rows["optimal"]["annulus SNR"]
    # The fit has given this planet parameters of its own already.
    assert rows["detected"]["annulus SNR"] == pytest.approx(rows["refined"]["annulus SNR"], rel=0.1)
    assert rows["detected"]["star error"] < 1.1 * rows["refined"]["star error"]
    assert abs(rows["initial"]["annulus SNR"]) < 4
    assert rows["refined"]["seconds"] == pytest.approx(result.fit.seconds)

    # With the wavefront marginalised the planet is whole, and where it is.
    (found,) = result.detection.candidates
    assert found["snr"] > rows["refined"]["annulus SNR"]
    assert abs(found["contrast"] - 1e-6) < 3 * found["contrast_error"]
    assert found["separation"].to_value("arcsec") == pytest.approx(0.6, abs=0.02)
    assert found["position_angle"].to_value("deg") == pytest.approx(54.0, abs=2.0)

    images, written_table, candidates = write_demo(result, tmp_path / "new")
    figure = tmp_path / "new" / "demo.png"
    save(draw_demo(result), figure)
    assert sorted(p.name for p in figure.parent.iterdir()) == [
        "candidates.ecsv", "demo.ecsv", "demo.fits", "demo.png",
    ]  # fmt: skip
    assert figure.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert figure.stat().st_size > 50_000
    with open_fits(images) as hdus:
        assert [hdu.name for hdu in hdus[1:]] == [
            "FRAME", "INITIAL", "KLIP", "REFINED", "DETECTED", "OPTIMAL", "OPD_MEASURED",
            "OPD_TRUE", "OPD_REFINED", "SNR",
        ]  # fmt: skip
        np.testing.assert_array_equal(hdus["REFINED"].data, result.fit.frames[0].residual[0])
        np.testing.assert_array_equal(hdus["FRAME"].data, result.observation.data[0])
        np.testing.assert_allclose(hdus["OPD_TRUE"].data, result.true_opd, rtol=1e-6, atol=1e-16)
        assert hdus["OPD_REFINED"].header["BUNIT"] == "m"
        assert {hdus[k].header["BUNIT"] for k in range(1, 7)} == {"photon"}
        assert hdus[0].header["status"] == "CONVERGED"
    read = Table.read(written_table, format="ascii.ecsv")
    assert list(read["star model"]) == list(table["star model"])
    np.testing.assert_allclose(read["annulus SNR"], table["annulus SNR"], rtol=1e-6)
    assert read.meta["hours"] == 40.0
    assert len(Table.read(candidates, format="ascii.ecsv")) == 1
