"""``algo="diffrender"`` in pyKLIP: the contract of `klip_dataset`, on datasets without headers."""

from __future__ import annotations

import copy
import ctypes
import inspect
import io
import sys

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import fits
from backend_scene import (
    BACKGROUND,
    CENTER,
    OPD,
    RIPPLE,
    SHAPE,
    frames,
    generic,
    planet,
    psf,
    render,
)
from pyklip import fm, parallelized, rdi
from pyklip.klip import high_pass_filter

# As a script does it, long before the plugin is imported.
from pyklip.parallelized import klip_dataset

from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
    NoValidPixelsError,
    RefinementError,
    ShapeError,
)
from pyklip_diffrender.pyklip_backend import (
    DiffrenderSettings,
    Fit,
    Subtraction,
    backend,
    is_registered,
    observation_from_dataset,
    register,
    unregister,
)

ANGLES = (0.0, 20.0, 45.0)

# pyKLIP 2.10 takes the mean of sections that are all NaN.
pytestmark = pytest.mark.filterwarnings("ignore:Mean of empty slice:RuntimeWarning")


@pytest.fixture
def registered():
    register(opd=OPD, subtractor=render)
    yield
    unregister()


@pytest.fixture
def imgs(rng):
    return frames(ANGLES, rng)


def reduce(dataset, folder, prefix="x", **kw):
    """Run klip_dataset and give name -> (data, header) of all files it left."""
    folder.mkdir(exist_ok=True)
    options = {
        "mode": "ADI", "annuli": 2, "subsections": 1, "numbasis": [1, 2], "movement": 0,
        "numthreads": 1, "verbose": False, "algo": "diffrender", **kw,
    }  # fmt: skip
    klip_dataset(dataset, outputdir=str(folder), fileprefix=prefix, **options)
    return {
        path.name: (fits.getdata(path), fits.getheader(path)) for path in sorted(folder.iterdir())
    }


def library(dataset, imgs, highpass=False):
    """A PSF library of the dataset's own frames and four of a reference star."""
    rng = np.random.default_rng(1)
    references = [900 * psf(*CENTER) + rng.normal(0, 1, SHAPE) for _ in range(4)]
    names = [*dataset.filenames, *(f"reference{i}" for i in range(4))]
    made = rdi.PSFLibrary(
        np.array([*imgs, *references]),
        np.array(CENTER),
        names,
        compute_correlation=True,
        highpass=highpass,
    )
    made.prepare_library(dataset)
    return made


def spied(monkeypatch):
    """All that is exchanged in pyKLIP, for a comparison by identity."""
    found = {}
    for function in (parallelized.klip_dataset, fm.klip_dataset):
        name = f"{function.__module__}.{function.__qualname__}"
        found[name] = function
        found[name + " code"] = function.__code__
        found[name + " defaults"] = function.__defaults__
        found[name + " dict"] = dict(vars(function))
    from pyklip.instruments.JWST import JWSTData

    found["readers"] = {name: vars(JWSTData)[name] for name in ("readdata", "readpsflib")}
    found["names"] = dict(vars(parallelized))
    found["fm names"] = dict(vars(fm))
    return found


def same(a, b):
    return a.keys() == b.keys() and all(
        a[k] == b[k] if isinstance(a[k], dict) else a[k] is b[k] for k in a
    )


# Registration


def test_unregister_puts_back_the_same_objects(monkeypatch):
    before = spied(monkeypatch)
    assert not is_registered()
    register(opd=OPD)
    register()
    assert is_registered()
    assert not same(before, spied(monkeypatch))
    assert parallelized.klip_dataset is klip_dataset
    unregister()
    assert not is_registered()
    assert same(before, spied(monkeypatch))
    unregister()
    with backend(opd=OPD):
        assert is_registered()
    assert same(before, spied(monkeypatch))


def test_the_signature_that_help_shows_stays(registered):
    unregister()
    before = inspect.signature(klip_dataset)
    register(opd=OPD)
    assert inspect.signature(klip_dataset) == before
    with pytest.raises(TypeError, match="unexpected keyword argument 'oppd'"):
        klip_dataset(None, oppd=3)
    with pytest.raises(TypeError, match="missing 1 required positional argument"):
        klip_dataset()


def test_a_pyklip_that_changed_is_refused_and_left_alone(monkeypatch):
    def klip_dataset(dataset, algo="klip"): ...

    monkeypatch.setattr(parallelized, "klip_dataset", klip_dataset)
    code = klip_dataset.__code__
    with pytest.raises(IncompatibleSetupError, match="does not use klip_parallelized"):
        register(opd=OPD)
    with pytest.raises(IncompatibleSetupError, match="not supported"), backend(opd=OPD):
        pass
    assert not is_registered()
    assert klip_dataset.__code__ is code


@pytest.mark.parametrize("algo", ["klip", "empca", "none"])
def test_other_algorithms_are_bit_identical(algo, imgs, tmp_path):
    results = []
    for i in range(3):
        if i == 1:
            register(opd=OPD, subtractor=render)
        dataset = generic(imgs, ANGLES)
        files = reduce(dataset, tmp_path / str(i), algo=algo)
        results.append((files, dataset.output, dataset.klipparams))
        unregister()
    (files, output, klipparams), *others = results
    assert np.isfinite(output).any()
    for other_files, other_output, other_klipparams in others:
        assert output.tobytes() == other_output.tobytes()
        assert klipparams == other_klipparams
        assert files.keys() == other_files.keys()
        for name, (data, header) in files.items():
            assert data.tobytes() == other_files[name][0].tobytes()
            assert repr(header) == repr(other_files[name][1])


# What is left behind, against KLIP


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("save_ints", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize(
    "collapse", [pytest.param("mean", marks=pytest.mark.slow), "weighted-mean"]
)
@pytest.mark.parametrize(
    ("mode", "wvs"),
    [
        ("ADI", None),
        ("RDI", None),
        ("ADI + RDI", None),
        ("ADI+SDI", (4.44, 4.44, 4.44)),
        ("ADI+SDI", (4.0, 4.4, 4.4)),
        ("ADI", (4.0, 4.4, 4.8)),
    ],
)
def test_every_file_keyword_and_slice_is_there_as_klip_leaves_it(
    mode, wvs, collapse, save_ints, imgs, tmp_path
):
    if wvs is not None and len(set(wvs)) > 1:
        # As many frames at each wavelength.
        imgs, angles = np.repeat(imgs, 2, axis=0), np.repeat(ANGLES, 2)
        wvs = np.tile([4.0, 4.4], 3)
    else:
        angles = ANGLES
    runs = {}
    for algo in ("klip", "diffrender"):
        dataset = generic(imgs, angles, wvs)
        kw = {"psf_library": library(dataset, imgs)} if "RDI" in mode else {}
        files = reduce(
            dataset, tmp_path / algo, algo=algo, mode=mode, time_collapse=collapse,
            numbasis=[1, 2, 3], save_ints=save_ints, **kw,
        )  # fmt: skip
        runs[algo] = dataset, files
    (klip, klip_files), (ours, our_files) = runs["klip"], runs["diffrender"]
    assert our_files.keys() == klip_files.keys()
    for name, (klip_data, klip_header) in klip_files.items():
        data, header = our_files[name]
        assert data.shape == klip_data.shape
        assert data.dtype == klip_data.dtype
        assert set(header) >= set(klip_header)
        for key in set(klip_header) - {"HISTORY", "COMMENT", ""}:
            assert header[key] == klip_header[key], key
        assert str(klip_header["HISTORY"]) in str(header["HISTORY"])
    assert ours.output.shape == klip.output.shape
    assert ours.output.dtype == klip.output.dtype
    np.testing.assert_array_equal(ours.output_centers, klip.output_centers)
    assert ours.klipparams == klip.klipparams
    assert "{numbasis}" in ours.klipparams
    for mine, theirs in zip(ours.output_wcs, klip.output_wcs, strict=True):
        assert mine.to_header() == theirs.to_header()
    cube, _ = our_files["x-KLmodes-all.fits"]
    assert len(cube) == 3
    np.testing.assert_array_equal(cube[0], cube[1])
    np.testing.assert_array_equal(cube[0], cube[2])
    assert hasattr(ours, "allints") == hasattr(klip, "allints")
    if hasattr(klip, "allints"):
        assert ours.allints.shape == klip.allints.shape


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("highpass", [False, 8.0])
def test_both_algorithms_in_one_call(highpass, imgs, tmp_path):
    alone = {algo: (generic(imgs, ANGLES), tmp_path / algo) for algo in ("klip", "diffrender")}
    expected = {
        algo: reduce(*each, algo=algo, highpass=highpass)["x-KLmodes-all.fits"][0]
        for algo, each in alone.items()
    }
    dataset = generic(imgs, ANGLES)
    with backend():
        files = reduce(dataset, tmp_path / "both", algo="diffrender + KLIP", highpass=highpass)
    for name, algo in (("x", "diffrender"), ("x-klip", "klip")):
        data, header = files[f"{name}-KLmodes-all.fits"]
        np.testing.assert_array_equal(data, expected[algo])
        assert ("DRALGO" in header) == (algo == "diffrender")
    np.testing.assert_array_equal(dataset.output, alone["diffrender"][0].output)
    np.testing.assert_array_equal(dataset.input, alone["diffrender"][0].input)
    assert len(dataset.diffrender_results) == 1
    (record,) = dataset.diffrender_results
    for each in (record, record.frames, record.frames.pointings[0], record.subtraction):
        # No arrays, which are pages long.
        assert repr(each).startswith("<")
        assert "\n" not in repr(each)
        assert len(repr(each)) < 400
    assert "CONVERGED, chi2/pixel" in repr(dataset.diffrender_results)


@pytest.mark.usefixtures("registered")
def test_the_companion_stays_whole_and_the_star_and_the_pedestal_go(imgs, tmp_path):
    dataset = generic(imgs, ANGLES)
    files = reduce(dataset, tmp_path, aligned_center=CENTER)
    image, _ = files["x-KLmodes-all.fits"]
    truth = 2 * planet(CENTER[0], CENTER[1] + 12)
    stamp = np.s_[33:41, 17:26]
    np.testing.assert_allclose(image[0][stamp], truth[stamp], atol=0.15)
    assert image[0][stamp].sum() == pytest.approx(truth[stamp].sum(), rel=0.05)
    away = image[0][:30]
    assert abs(np.nanmean(away)) < 0.02
    assert np.nanstd(away) < 0.06
    assert np.nanmax(np.abs(dataset.input)) > 1000


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("outer", [None, 15.0])
def test_nan_where_pyklip_has_nan(outer, imgs, tmp_path):
    imgs[0, 20, 30] = imgs[1, 5:8, 5] = np.nan
    masks = []
    for algo in ("none", "diffrender"):
        dataset = generic(imgs, ANGLES)
        dataset.OWA = outer
        reduce(dataset, tmp_path / algo, algo=algo, numbasis=[1])
        masks.append(np.isnan(dataset.output))
    np.testing.assert_array_equal(*masks)
    assert masks[0].any()
    assert not masks[0].all()


@pytest.mark.usefixtures("registered")
def test_frames_padded_with_nan(imgs, tmp_path):
    plain = generic(imgs, ANGLES)
    reduce(plain, tmp_path / "a", aligned_center=CENTER)
    pad = 16
    padded = generic(
        np.pad(imgs, ((0, 0), (pad, pad), (pad, pad)), constant_values=np.nan),
        ANGLES,
        center=np.array(CENTER) + pad,
    )
    padded.OWA = plain.OWA = 40.0
    files = reduce(padded, tmp_path / "b", aligned_center=np.array(CENTER) + pad)
    image, _ = files["x-KLmodes-all.fits"]
    assert image.shape[1:] == (SHAPE[0] + 2 * pad, SHAPE[1] + 2 * pad)
    inner = padded.output[..., pad:-pad, pad:-pad]
    both = np.isfinite(inner) & np.isfinite(plain.output)
    assert both.mean() > 0.5
    np.testing.assert_allclose(inner[both], plain.output[both], atol=0.03)


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("mode", ["RDI", "ADI", "ADI+RDI"])
def test_a_single_frame_without_header(mode, imgs, tmp_path):
    dataset = generic(imgs[:1], [0.0])
    kw = {"psf_library": library(dataset, imgs[:1])} if "RDI" in mode else {}
    files = reduce(dataset, tmp_path, mode=mode, numbasis=1, **kw)
    image, header = files["x-KLmodes-all.fits"]
    assert image.shape == (1, *SHAPE)
    assert np.nanmax(image) == pytest.approx(1.85, rel=0.1)
    assert header["DRSTAT"] == "CONVERGED"


@pytest.mark.usefixtures("registered")
def test_lite_and_double_precision_and_no_derotation(imgs, tmp_path):
    outputs = []
    for kw in ({}, {"lite": True}, {"dtype": ctypes.c_double}, {"skip_derot": True}):
        dataset = generic(imgs, ANGLES)
        reduce(dataset, tmp_path / "a", **kw)
        outputs.append(dataset.output)
    np.testing.assert_array_equal(outputs[0], outputs[1])
    assert outputs[2].dtype == np.float64
    np.testing.assert_allclose(outputs[0], outputs[2], atol=1e-4)
    first = [np.unravel_index(np.nanargmax(frame), SHAPE) for frame in outputs[3][0, :, 0]]
    assert len(set(first)) == len(ANGLES)


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("highpass", [True, 12.0])
def test_high_pass_filter_acts_after_the_fit(highpass, imgs, tmp_path):
    plain, filtered = generic(imgs, ANGLES), generic(imgs, ANGLES)
    reduce(plain, tmp_path / "a", skip_derot=True, aligned_center=CENTER)
    reduce(filtered, tmp_path / "b", skip_derot=True, aligned_center=CENTER, highpass=highpass)
    size = 10 if highpass is True else SHAPE[0] / highpass / (2 * np.sqrt(2 * np.log(2)))
    [seen] = [made.subtraction.worst.result for made in filtered.diffrender_results]
    np.testing.assert_allclose(seen.data, imgs)
    expected = high_pass_filter(imgs[0] - filtered.diffrender_results[0].subtraction.star[0], size)
    got = filtered.output[0, 0, 0]
    ring = np.isfinite(got)
    np.testing.assert_allclose(got[ring], (expected - np.median(expected[ring]))[ring], atol=0.02)
    with pytest.raises(IncompatibleSetupError, match="high-pass filtered by an earlier call"):
        reduce(copy.deepcopy(filtered), tmp_path / "c")


# Where settings come from


def test_a_missing_opd_is_an_error_that_says_what_to_do(imgs, tmp_path):
    dataset = generic(imgs, ANGLES)
    before = dict(vars(dataset))
    register(subtractor=render)
    try:
        with pytest.raises(MissingOPDError, match=r"register\(opd=.*backend\(opd=.*DiffrenderSett"):
            reduce(dataset, tmp_path)
    finally:
        unregister()
    assert vars(dataset) == before
    assert list(tmp_path.iterdir()) == []


def test_block_wins_over_dataset_over_register(imgs, tmp_path):
    def marked(n):
        def fake(observation, opd, settings):
            found = render(observation, opd, settings)
            fit = Fit((0,), str(settings.model_options), 1.0)
            return Subtraction(found.star, (fit,), references=n)

        return fake

    dataset = generic(imgs, ANGLES)
    register(opd=OPD, subtractor=marked(1), model_options={"a": 1, "b": 1})
    try:
        assert reduce(dataset, tmp_path)["x-KLmodes-all.fits"][1]["DRREFS"] == 1
        dataset.diffrender = DiffrenderSettings(subtractor=marked(2), model_options={"b": 2})
        copied = copy.deepcopy(dataset)
        header = reduce(copied, tmp_path)["x-KLmodes-all.fits"][1]
        assert (header["DRREFS"], header["DRSTAT"]) == (2, "{'a': 1, 'b': 2}")
        with backend(subtractor=marked(3)), backend(model_options={"c": 3}):
            header = reduce(copied, tmp_path, algo="klip")["x-KLmodes-all.fits"][1]
        assert (header["DRREFS"], header["DRSTAT"]) == (3, "{'a': 1, 'b': 2, 'c': 3}")
        with pytest.warns(DiffrenderWarning, match="runs KLIP"):
            header = reduce(copied, tmp_path, algo="klip")["x-KLmodes-all.fits"][1]
        assert "DRREFS" not in header
    finally:
        unregister()
    dataset.diffrender = "opd.fits"
    with pytest.raises(IncompatibleSetupError, match="expected DiffrenderSettings"), backend():
        reduce(dataset, tmp_path)


def test_block_takes_over_klip_and_nothing_else(imgs, tmp_path):
    def stamped(**kw):
        return "DRALGO" in reduce(generic(imgs, ANGLES), tmp_path, **kw)["x-KLmodes-all.fits"][1]

    with backend("diffrender", opd=OPD, subtractor=render):
        assert stamped(algo="klip")
        assert stamped(algo="KLIP")
        assert not stamped(algo="none")
    with backend(opd=OPD, subtractor=render, force=False):
        assert not stamped(algo="klip")
        assert stamped(algo="DiffRender")
    with pytest.raises(IncompatibleSetupError, match="only backend is 'diffrender'"), backend("x"):
        pass
    with pytest.raises(ValueError, match="Algo diffrender is not supported"):
        reduce(generic(imgs, ANGLES), tmp_path)


def test_klip_on_a_dataset_that_was_reduced_here_says_so_once(imgs, tmp_path):
    def klipped(dataset):
        header = reduce(dataset, tmp_path, algo="klip")["x-KLmodes-all.fits"][1]
        return "DRALGO" not in header

    register(opd=OPD, subtractor=render)
    try:
        dataset = generic(imgs, ANGLES)
        assert klipped(dataset)
        reduce(dataset, tmp_path)
        with pytest.warns(DiffrenderWarning, match=r"runs KLIP.*replace=True") as caught:
            assert klipped(copy.deepcopy(dataset))
        # The line of the script that made the call.
        of_the_package = [each for each in caught if each.category is DiffrenderWarning]
        assert [each.filename for each in of_the_package] == [__file__]
        assert klipped(dataset)
        reduce(dataset, tmp_path)
        with backend(force=False):
            assert klipped(dataset)
        register(replace=False)
        assert klipped(dataset)
        register(replace=True)
        assert not klipped(dataset)
        with backend(force=False):
            assert klipped(dataset)
    finally:
        unregister()
    register(opd=OPD, subtractor=render)
    try:
        reduce(dataset, tmp_path)
        with pytest.warns(DiffrenderWarning), pytest.raises(AttributeError):
            fm.klip_dataset(dataset, None, numbasis=[1], mode="RDI")
        register(replace=True)
        with pytest.raises(IncompatibleSetupError, match="NoneType is not supported by diffrender"):
            fm.klip_dataset(dataset, None)
    finally:
        unregister()


@pytest.mark.parametrize("kind", ["array", "quantity", "file", "path"])
def test_the_kinds_of_opd_and_their_provenance(kind, imgs, tmp_path):
    path = tmp_path / "R2022073003.fits"
    fits.PrimaryHDU(RIPPLE * 1e6, fits.Header({"BUNIT": "um"})).writeto(path)
    opd = {"array": RIPPLE, "quantity": RIPPLE * 1e9 * u.nm, "file": str(path), "path": path}[kind]
    seen = []

    def fake(observation, opd, settings):
        seen.append(np.asarray(opd))
        return render(observation, opd, settings)

    with backend(opd=opd, subtractor=fake, filter="F444W"):
        _, header = reduce(generic(imgs, ANGLES), tmp_path / "out")["x-KLmodes-all.fits"]
    np.testing.assert_allclose(seen[0], RIPPLE, rtol=1e-12)
    assert header["DROPD"] == ("array" if kind in ("array", "quantity") else path.name)
    assert len(header["DRSHA256"]) == 64
    assert header["DRFILT"] == "F444W"
    assert header["DRSTAT"] == "CONVERGED"
    assert header["DRCHI2"] > 0
    assert header["DRVERS"]
    history = "".join(header["HISTORY"])
    assert "KL modes are all the same" in history
    assert "frames 0, 1" in history


# Bad input and failures


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"mode": "FOO"}, IncompatibleSetupError, "expected ADI, RDI, SDI"),
        ({"mode": " SDI"}, IncompatibleSetupError, "compares wavelengths"),
        ({"mode": "RDI"}, ValueError, "psf_library"),
        ({"numbasis": [1.5]}, TypeError, "integer"),
        ({"annuli": 100}, ValueError, "Too many annuli"),
    ],
)
def test_arguments_that_make_no_sense(change, error, message, imgs, tmp_path):
    dataset = generic(imgs, ANGLES)
    before = dict(vars(dataset))
    with pytest.raises(error, match=message):
        reduce(dataset, tmp_path, **change)
    assert vars(dataset) == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("mode", ["ADI", "ADI+SDI"])
def test_a_dataset_without_frames(mode, tmp_path):
    dataset = generic(np.zeros((0, *SHAPE)), [], center=np.zeros((0, 2)))
    dataset.centers = np.zeros((0, 2))
    with pytest.raises(NoValidPixelsError, match="no frames"):
        reduce(dataset, tmp_path, mode=mode)
    with pytest.raises(NoValidPixelsError, match="no frames"):
        observation_from_dataset(dataset)


@pytest.mark.usefixtures("registered")
def test_masked_frames(imgs, tmp_path):
    with pytest.raises(NoValidPixelsError, match=r"frame0.*nothing is left to fit"):
        reduce(generic(imgs * np.nan, ANGLES), tmp_path)
    assert list(tmp_path.iterdir()) == []
    imgs[1] = np.nan
    dataset = generic(imgs, ANGLES)
    reduce(dataset, tmp_path)
    finite = np.isfinite(dataset.output[0, :, 0]).any(axis=(1, 2))
    np.testing.assert_array_equal(finite, [True, False, True])


@pytest.mark.parametrize("where", ["fit", "shape", "nothing", "writing"])
def test_a_failure_raises_and_leaves_everything_as_it_was(where, imgs, tmp_path, monkeypatch):
    before = spied(monkeypatch)
    dataset = generic(imgs, ANGLES, wvs=[4.0, 4.4, 4.8])
    calls = []

    def fake(observation, opd, settings):
        calls.append(observation)
        found = render(observation, opd, settings)
        if len(calls) == 3 and where == "fit":
            raise RefinementError("diverged", found)
        star = {"shape": found.star[:, 1:], "nothing": found.star * np.nan}.get(where, found.star)
        return Subtraction(star, found.fits)

    if where == "writing":
        save = dataset.savedata

        def savedata(path, *args, **kw):
            save(path, *args, **kw)
            if "KLmodes" in path:
                raise OSError("no space left on device")

        dataset.savedata = savedata
    with backend(opd=OPD, subtractor=render):
        kept = {k: v[0].tobytes() for k, v in reduce(generic(imgs, ANGLES), tmp_path).items()}
    state = dict(vars(dataset))
    errors = {"fit": RefinementError, "shape": ShapeError, "nothing": RefinementError}
    with pytest.raises(errors.get(where, OSError)), backend(opd=OPD, subtractor=fake):
        reduce(dataset, tmp_path)
    assert vars(dataset) == state
    left = {p.name: fits.getdata(p).tobytes() for p in tmp_path.iterdir()}
    assert left == kept
    assert same(before, spied(monkeypatch))


def test_threads_and_errors_while_the_console_is_silenced(imgs, tmp_path, monkeypatch):
    seen, screen = [], io.StringIO()

    def fails(observation, opd, settings):
        seen.append(torch.get_num_threads())
        assert not list(tmp_path.iterdir())  # Or a process that is killed would leave a folder.
        raise RefinementError("diverged", None)

    before = torch.get_num_threads()
    monkeypatch.setattr(sys, "stderr", io.StringIO())  # As spaceKLIP does.
    monkeypatch.setattr(sys, "__stderr__", screen)
    with backend(opd=OPD, subtractor=fails, threads=before + 1), pytest.raises(RefinementError):
        reduce(generic(imgs, ANGLES), tmp_path)
    assert seen == [before + 1]
    assert torch.get_num_threads() == before
    assert screen.getvalue().startswith("diffrender: RefinementError: diverged")
    with backend(opd=OPD, threads=0), pytest.raises(IncompatibleSetupError, match="threads"):
        reduce(generic(imgs, ANGLES), tmp_path)


@pytest.mark.usefixtures("registered")
def test_one_model_for_several_wavelengths_is_refused(imgs, tmp_path):
    seen = []

    def fake(observation, opd, settings):
        seen.append(settings.model)
        return render(observation, opd, settings)

    def dataset():
        return generic(imgs[:2], ANGLES[:2], wvs=[4.0, 4.4])

    with pytest.raises(IncompatibleSetupError, match="mapping"), backend(model="a"):
        reduce(dataset(), tmp_path)
    only_one = pytest.raises(IncompatibleSetupError, match=r"none for wavelength 4\.4")
    with only_one, backend(model={4.0: "a"}, subtractor=fake):
        reduce(dataset(), tmp_path)
    with backend(model={4.0: "a", 4.4: "b"}, subtractor=fake):
        reduce(dataset(), tmp_path)
    assert seen[-2:] == ["a", "b"]


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("wvs", [(4.0, 4.0, 4.4, 4.4), (4.0, 4.4, 4.0)])
def test_wavelengths_that_pyklip_would_mix_up_are_refused(wvs, imgs, tmp_path):
    cube = np.tile(imgs[0], (len(wvs), 1, 1))
    with pytest.raises(IncompatibleSetupError, match="one dataset for each filter"):
        reduce(generic(cube, np.zeros(len(wvs)), wvs), tmp_path, mode="ADI+SDI")


def test_no_filter_and_no_model(imgs, tmp_path):
    with pytest.raises(IncompatibleSetupError, match="through which filter"), backend(opd=OPD):
        reduce(generic(imgs, ANGLES), tmp_path)


# Observations


def test_observation_from_a_dataset_without_headers(imgs):
    imgs[0, 3, 4] = np.nan
    dataset = generic(imgs, ANGLES)
    observation = observation_from_dataset(dataset)
    np.testing.assert_array_equal(observation.data[0, :3], imgs[0, :3])
    assert not observation.valid[0, 3, 4]
    assert observation.valid.sum() == imgs.size - 1
    np.testing.assert_array_equal(observation.center, np.tile(CENTER, (3, 1)))
    np.testing.assert_array_equal(observation.position_angles, ANGLES)
    assert observation.filter is None
    assert observation.date is None
    assert observation.unit == u.dimensionless_unscaled
    assert (observation.error > 0).all()
    assert np.nanmedian(observation.data) > BACKGROUND


def test_errors_that_are_given(imgs):
    dataset = generic(imgs, ANGLES)
    for error in (0.5, np.full(SHAPE, 0.5), np.full(imgs.shape, 0.5)):
        dataset.diffrender = DiffrenderSettings(error=error, filter="F444W", unit=u.Jy)
        observation = observation_from_dataset(dataset)
        np.testing.assert_array_equal(observation.error, np.full(imgs.shape, 0.5))
        assert observation.filter == "F444W"
        assert observation.unit == u.Jy
    dataset.diffrender = DiffrenderSettings(error=np.zeros(7))
    with pytest.raises(ShapeError, match="expected a number"):
        observation_from_dataset(dataset)
