"""The command line: what it writes, where errors go, and that it starts quickly."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from astropy.io import fits

from pyklip_diffrender import __version__
from pyklip_diffrender.cli import main
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.wavefront.opd import random_opd, resample

ROOT = Path(__file__).resolve().parents[1]

WAVELENGTH = ["--monochromatic", "4.5e-6"]


def opd_file(path: Path, unit: str | None = "nm") -> Path:
    hdu = fits.PrimaryHDU(random_opd(3, npix=128).data * 1e9)
    if unit:
        hdu.header["BUNIT"] = unit
    hdu.writeto(path)
    return path


def test_help_names_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    for command in ("demo", "reduce", "detect", "psf"):
        assert command in shown


def test_no_command_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == 2
    assert "COMMAND" in capsys.readouterr().err


def test_help_does_not_wait_for_torch() -> None:
    program = (
        "import sys, pyklip_diffrender.cli as cli\n"
        "try:\n    cli.main(['--help'])\n"
        "except SystemExit:\n    pass\n"
        "heavy = {'torch', 'numpy', 'pyklip', 'matplotlib', 'poppy'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr


def test_psf_writes_the_image_of_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "star.fits"
    opd = opd_file(tmp_path / "opd.fits")
    arguments = ["psf", str(path), *WAVELENGTH, "--size", "20", "--opd", str(opd)]
    assert main([*arguments, "--offset", "0.02", "-0.3"]) == 0
    assert str(path) in capsys.readouterr().out
    with open_fits(path) as hdus:
        image, header = hdus[0].data, hdus[0].header
    assert header["FILTER"] == "F444W"
    assert header["PIXELSCL"] == pytest.approx(0.062424185)
    model = nircam_coronagraph("F444W", monochromatic=4.5e-6, fov_pixels=20)
    map_ = resample(random_opd(3, npix=128).data, 1024)
    with torch.no_grad():
        expected = model(map_, (0.02, -0.3)).numpy()
    np.testing.assert_allclose(image, expected, rtol=1e-9)
    # The star is below the middle, as asked for.
    assert np.unravel_index(image.argmax(), image.shape)[0] < 9
    assert not np.allclose(image, expected[::-1], rtol=0.1)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--filter", "F200W"], ["F200W", "MASK335R", "F444W"]),
        (["--monochromatic", "4.5"], ["4.5", "metres"]),
        (["--size", "0"], ["at least 1"]),
        (["--opd", "nowhere.fits"], ["nowhere.fits", "no such file"]),
    ],
    ids=["filter", "wavelength", "field", "file"],
)
def test_errors_go_to_stderr_and_nothing_is_written(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    extra: list[str],
    words: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["psf", "star.fits", *extra]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("pyklip-diffrender: ")
    assert "Traceback" not in shown.err
    for word in words:
        assert word in shown.err
    assert list(tmp_path.iterdir()) == []


def test_a_map_without_a_unit_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opd = opd_file(tmp_path / "opd.fits", unit=None)
    product = tmp_path / "star.fits"
    assert main(["psf", str(product), *WAVELENGTH, "--opd", str(opd)]) == 1
    assert "opd.fits: the header has no BUNIT" in capsys.readouterr().err
    assert not product.exists()


@pytest.mark.parametrize("percent", [0, 50])
def test_detect_in_a_broken_file_leaves_no_product(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], percent: int
) -> None:
    frames, products = tmp_path / "calints.fits", tmp_path / "products"
    if percent:
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 90, 90)), name="SCI")]).writeto(
            frames
        )
        whole = frames.read_bytes()
        frames.write_bytes(whole[: len(whole) * percent // 100])
    opd = opd_file(tmp_path / "opd.fits")
    assert main(["detect", str(frames), "--opd", str(opd), "-o", str(products)]) == 1
    assert "calints.fits" in capsys.readouterr().err
    assert not products.exists()


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"pyklip-diffrender {__version__}\n"


# -- outputs that are there already --------------------------------------------------------------


def test_an_image_is_replaced_only_when_told_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "star.fits"
    path.write_text("mine")
    arguments = ["psf", str(path), *WAVELENGTH, "--size", "8"]
    assert main(arguments) == 1
    shown = capsys.readouterr().err
    assert str(path) in shown
    assert "--overwrite" in shown
    assert path.read_text() == "mine"
    assert main([*arguments, "--overwrite"]) == 0
    with open_fits(path) as hdus:
        assert hdus[0].data.shape == (8, 8)


@pytest.mark.parametrize(
    ("command", "product"),
    [("demo", "demo.fits"), ("reduce", "detection.fits"), ("detect", "detection.fits")],
)
def test_products_are_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, product: str
) -> None:
    """The frames do not exist: had they been opened first, the message would be theirs."""
    arguments = [command, "-o", str(tmp_path)]
    if command != "demo":
        arguments += ["nowhere.fits", "--opd", "nowhere_else.fits"]
    path = tmp_path / product
    path.write_text("mine")
    assert main(arguments) == 1
    shown = capsys.readouterr().err
    assert str(path) in shown
    assert "--overwrite" in shown
    if command != "demo":
        assert main([*arguments, "--overwrite"]) == 1
        assert "nowhere.fits" in capsys.readouterr().err
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("extra", [[], ["--overwrite"]], ids=["plain", "overwrite"])
def test_an_output_that_is_a_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str]
) -> None:
    path = tmp_path / "products"
    path.write_text("mine")
    assert main(["reduce", "nowhere.fits", "--opd", "nowhere.fits", "-o", str(path), *extra]) == 1
    assert f"{path} is a file, expected a folder" in capsys.readouterr().err
    assert path.read_text() == "mine"


# -- sequences -----------------------------------------------------------------------------------


def calints_file(path: Path, star: str, reference: bool) -> Path:
    rng = np.random.default_rng(1)
    data = rng.normal(10, 2, (2, 8, 10)).astype(np.float32)
    primary = fits.PrimaryHDU()
    primary.header.update(
        {
            "FILTER": "F444W",
            "TARGPROP": star,
            "IS_PSF": reference,
            "DATE-BEG": "2022-07-30T02:03:04",
        }
    )
    hdus = fits.HDUList([primary])
    planes = {"SCI": data, "ERR": np.ones_like(data), "DQ": np.zeros(data.shape, dtype=np.uint32)}
    for name, array in planes.items():
        hdus.append(fits.ImageHDU(array, name=name))
    hdus["SCI"].header.update(
        {
            "BUNIT": "MJy/sr", "PIXAR_A2": 0.00396, "CRPIX1": 6.0, "CRPIX2": 5.0,
            "ROLL_REF": 100.0, "V3I_YANG": -0.5, "VPARITY": -1,
        }
    )  # fmt: skip
    hdus.writeto(path)
    return path


def test_a_dry_run_lists_the_frames_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, products = tmp_path / "frames", tmp_path / "products"
    frames.mkdir()
    calints_file(frames / "one_calints.fits", "HIP-1", reference=False)
    calints_file(frames / "two_calints.fits", "HIP-2", reference=True)
    (frames / "three_calints.fits").write_bytes(b"")
    arguments = ["reduce", str(frames), "--opd", "nowhere.fits", "-o", str(products), "--dry-run"]
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    target, reference = (
        next(line for line in lines if name in line) for name in ("one_calints", "two_calints")
    )
    assert target.split()[:2] == ["target", "HIP-1"]
    assert reference.split()[:2] == ["reference", "HIP-2"]
    assert any(line.startswith("left out: three_calints.fits: ") for line in lines)
    assert not products.exists()
    # Which is which follows from the option, too.
    assert main([*arguments, "--target", "HIP-2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert next(x for x in lines if "two_calints" in x).split()[:2] == ["target", "HIP-2"]
    assert main([*arguments, "--target", "HIP-3"]) == 1
    assert "HIP-3" in capsys.readouterr().err
