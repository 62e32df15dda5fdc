"""``algo="diffrender"`` in pyKLIP: the contract of `klip_dataset`, on datasets without headers."""

import copy
import ctypes
import inspect
import io
import sys
from unittest.mock import Mock

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from backend_scene import (
    ANGLES,
    BACKGROUND,
    CENTER,
    OPD,
    RIPPLE,
    SHAPE,
    frames,
    generic,
    planet,
    psf,
    reduced,
    render,
)
from pyklip import fm, parallelized, rdi
from pyklip.instruments.JWST import JWSTData
from pyklip.klip import high_pass_filter
from pyklip.parallelized import klip_dataset

from pyklip_diffrender.errors import (
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
from pyklip_diffrender.refinement import FitSettings

PRODUCT = "x-KLmodes-all.fits"


@pytest.fixture
def imgs(rng):
    return frames(ANGLES, rng)


@pytest.fixture
def unregistered():
    """The test registers, and need not unregister."""
    yield
    unregister()


def library(dataset, imgs):
    """A PSF library of the dataset's own frames and four of a reference star."""
    rng = np.random.default_rng(1)
    references = [900 * psf(*CENTER) + rng.normal(0, 1, SHAPE) for _ in range(4)]
    names = [*dataset.filenames, *(f"reference{i}" for i in range(4))]
    made = rdi.PSFLibrary(
        np.array([*imgs, *references]), np.array(CENTER), names, compute_correlation=True
    )
    made.prepare_library(dataset)
    return made


def exchanged():
    """All that is exchanged in pyKLIP, for a comparison by identity."""
    found = {name: vars(JWSTData)[name] for name in ("readdata", "readpsflib")}
    for module in (parallelized, fm):
        function = module.klip_dataset
        found |= {(module, name): value for name, value in vars(module).items()}
        found |= {(module, "its", name): value for name, value in vars(function).items()}
        found[module, "code"], found[module, "defaults"] = function.__code__, function.__defaults__
    return found


def same(a, b):
    return a.keys() == b.keys() and all(a[key] is b[key] for key in a)


def test_unregister_puts_back_the_same_objects():
    before = exchanged()
    assert not is_registered()
    register(opd=OPD)
    register()
    assert is_registered()
    assert not same(before, exchanged())
    assert parallelized.klip_dataset is klip_dataset
    unregister()
    assert not is_registered()
    assert same(before, exchanged())
    unregister()
    with backend(opd=OPD):
        assert is_registered()
    assert same(before, exchanged())


def test_the_signature_that_help_shows_stays():
    before = inspect.signature(klip_dataset)
    with backend(opd=OPD):
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


@pytest.mark.parametrize("algo", ["klip", "none"])
def test_other_algorithms_are_bit_identical(algo, imgs, tmp_path):
    results = []
    for i in range(3):
        if i == 1:
            register(opd=OPD, subtractor=render)
        dataset = generic(imgs, ANGLES)
        files = reduced(dataset, tmp_path / str(i), algo=algo)
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


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(
    ("mode", "collapse", "save_ints"),
    [
        ("ADI", "weighted-mean", False), ("RDI", "mean", True),
        ("ADI + RDI", "weighted-mean", True), ("ADI+SDI", "mean", False),
    ],
)  # fmt: skip
def test_every_file_keyword_and_slice_is_there_as_klip_leaves_it(
    mode, collapse, save_ints, imgs, tmp_path
):
    runs = {}
    for algo in ("klip", "diffrender"):
        dataset = generic(imgs, ANGLES)
        kw = {"psf_library": library(dataset, imgs)} if "RDI" in mode else {}
        files = reduced(
            dataset, tmp_path / algo, algo=algo, mode=mode, time_collapse=collapse, annuli=2,
            numbasis=[1, 2, 3], save_ints=save_ints, **kw,
        )  # fmt: skip
        runs[algo] = dataset, files
    (klip, klip_files), (ours, our_files) = runs["klip"], runs["diffrender"]
    assert our_files.keys() == klip_files.keys()
    for name, (klip_data, klip_header) in klip_files.items():
        data, header = our_files[name]
        assert (data.shape, data.dtype) == (klip_data.shape, klip_data.dtype)
        assert set(header) >= set(klip_header)
        for key in set(klip_header) - {"HISTORY", "COMMENT", ""}:
            assert header[key] == klip_header[key], key
        assert str(klip_header["HISTORY"]) in str(header["HISTORY"])
    assert (ours.output.shape, ours.output.dtype) == (klip.output.shape, klip.output.dtype)
    np.testing.assert_array_equal(ours.output_centers, klip.output_centers)
    assert ours.klipparams == klip.klipparams
    assert "{numbasis}" in ours.klipparams
    for mine, theirs in zip(ours.output_wcs, klip.output_wcs, strict=True):
        assert mine.to_header() == theirs.to_header()
    cube, _ = our_files[PRODUCT]
    assert len(cube) == 3
    np.testing.assert_array_equal(cube[1:], cube[:1].repeat(2, axis=0))
    assert hasattr(ours, "allints") == hasattr(klip, "allints")
    assert np.shape(getattr(ours, "allints", 0)) == np.shape(getattr(klip, "allints", 0))


@pytest.mark.usefixtures("registered")
def test_the_companion_stays_whole_and_the_star_and_the_pedestal_go(imgs, tmp_path):
    dataset = generic(imgs, ANGLES)
    image, _ = reduced(dataset, tmp_path, aligned_center=CENTER)[PRODUCT]
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
        reduced(dataset, tmp_path / algo, algo=algo, annuli=2, numbasis=[1])
        masks.append(np.isnan(dataset.output))
    np.testing.assert_array_equal(*masks)
    assert 0 < masks[0].mean() < 1


@pytest.mark.usefixtures("registered")
def test_lite_and_double_precision_and_no_derotation(imgs, tmp_path):
    outputs = []
    for kw in ({}, {"lite": True}, {"dtype": ctypes.c_double}, {"skip_derot": True}):
        dataset = generic(imgs, ANGLES)
        reduced(dataset, tmp_path / "a", **kw)
        outputs.append(dataset.output)
    np.testing.assert_array_equal(outputs[0], outputs[1])
    assert outputs[2].dtype == np.float64
    np.testing.assert_allclose(outputs[0], outputs[2], atol=1e-4)
    first = [np.unravel_index(np.nanargmax(frame), SHAPE) for frame in outputs[3][0, :, 0]]
    assert len(set(first)) == len(ANGLES)


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("highpass", [True, 12.0])
def test_high_pass_filter_acts_after_the_fit(highpass, imgs, tmp_path):
    dataset = generic(imgs, ANGLES)
    reduced(dataset, tmp_path / "b", skip_derot=True, aligned_center=CENTER, highpass=highpass)
    size = 10 if highpass is True else SHAPE[0] / highpass / (2 * np.sqrt(2 * np.log(2)))
    [made] = dataset.diffrender_results
    np.testing.assert_allclose(made.subtraction.worst.result.data, imgs)
    expected = high_pass_filter(imgs[0] - made.subtraction.star[0], size)
    got = dataset.output[0, 0, 0]
    ring = np.isfinite(got)
    np.testing.assert_allclose(got[ring], (expected - np.median(expected[ring]))[ring], atol=0.02)
    with pytest.raises(IncompatibleSetupError, match="high-pass filtered by an earlier call"):
        reduced(copy.deepcopy(dataset), tmp_path / "c")


def test_block_wins_over_dataset_over_register(imgs, tmp_path, unregistered):
    def marked(n):
        def fake(observation, opd, settings):
            found = render(observation, opd, settings)
            fit = Fit((0,), str(settings.model_options), 1.0)
            return Subtraction(found.star, (fit,), references=n)

        return fake

    def header_of(dataset, **kw):
        return reduced(dataset, tmp_path, **kw)[PRODUCT][1]

    dataset = generic(imgs, ANGLES)
    register(opd=OPD, subtractor=marked(1), model_options={"npix": 1, "shear": 1})
    assert header_of(dataset)["DRREFS"] == 1
    dataset.diffrender = DiffrenderSettings(subtractor=marked(2), model_options={"shear": 2})
    copied = copy.deepcopy(dataset)
    header = header_of(copied)
    assert (header["DRREFS"], header["DRSTAT"]) == (2, "{'npix': 1, 'shear': 2}")
    with backend(subtractor=marked(3)), backend(model_options={"route": 3}):
        header = header_of(copied, algo="klip")
    assert (header["DRREFS"], header["DRSTAT"]) == (3, "{'npix': 1, 'shear': 2, 'route': 3}")
    assert "DRREFS" not in header_of(copied, algo="klip")
    unregister()
    dataset.diffrender = "opd.fits"
    with pytest.raises(IncompatibleSetupError, match="expected DiffrenderSettings"), backend():
        header_of(dataset)


def test_block_takes_over_klip_and_nothing_else(imgs, tmp_path):
    def stamped(**kw):
        return "DRALGO" in reduced(generic(imgs, ANGLES), tmp_path, **kw)[PRODUCT][1]

    with backend(opd=OPD, subtractor=render):
        assert stamped(algo="klip")
        assert stamped(algo="KLIP")
        assert not stamped(algo="none")
    with backend(opd=OPD, subtractor=render, force=False):
        assert not stamped(algo="klip")
        assert stamped(algo="DiffRender")
    with pytest.raises(ValueError, match="Algo diffrender is not supported"):
        reduced(generic(imgs, ANGLES), tmp_path)


def test_calls_for_klip_are_taken_over_where_that_is_asked_for(imgs, tmp_path, unregistered):
    def klipped(dataset):
        return "DRALGO" not in reduced(dataset, tmp_path, algo="klip")[PRODUCT][1]

    register(opd=OPD, subtractor=render)
    dataset = generic(imgs, ANGLES)
    assert klipped(dataset)
    register(replace=True)
    assert not klipped(dataset)
    with backend(force=False):
        assert klipped(dataset)
    with pytest.raises(IncompatibleSetupError, match="NoneType is not supported by diffrender"):
        fm.klip_dataset(dataset, None)
    register(replace=False)
    assert klipped(dataset)
    with pytest.raises(AttributeError):
        fm.klip_dataset(dataset, None, numbasis=[1], mode="RDI")


@pytest.mark.parametrize("kind", ["quantity", "file"])
def test_the_kinds_of_opd_and_their_provenance(kind, imgs, tmp_path):
    path = tmp_path / "R2022073003.fits"
    fits.PrimaryHDU(RIPPLE * 1e6, fits.Header({"BUNIT": "um"})).writeto(path)
    subtract = Mock(wraps=render)
    opd = str(path) if kind == "file" else RIPPLE * 1e9 * u.nm
    with backend(opd=opd, subtractor=subtract, filter="F444W"):
        _, header = reduced(generic(imgs, ANGLES), tmp_path / "out")[PRODUCT]
    np.testing.assert_allclose(subtract.call_args.args[1], RIPPLE, rtol=1e-12)
    assert header["DROPD"] == ("array" if kind == "quantity" else path.name)
    assert len(header["DRSHA256"]) == 64
    assert (header["DRFILT"], header["DRSTAT"]) == ("F444W", "CONVERGED")
    assert header["DRCHI2"] > 0
    assert header["DRVERS"]
    history = "".join(header["HISTORY"])
    assert "KL modes are all the same" in history
    assert "frames 0, 1" in history


@pytest.mark.parametrize(
    ("settings", "change", "error", "message"),
    [
        ({}, {"mode": "FOO"}, IncompatibleSetupError, "expected 'ADI', or 'RDI'"),
        ({}, {"mode": " SDI"}, IncompatibleSetupError, "expected 'ADI', or 'RDI'"),
        ({}, {"mode": "RDI"}, ValueError, "psf_library"),
        ({}, {"numbasis": [1.5]}, TypeError, "integer"),
        ({}, {"annuli": 100}, ValueError, "Too many annuli"),
        ({"opd": None}, {}, MissingOPDError, r"register\(opd=.*backend\(opd=.*DiffrenderSett"),
        ({"subtractor": None}, {}, IncompatibleSetupError, "through which filter"),
        ({}, {"wvs": [4.0, 4.4, 4.0]}, IncompatibleSetupError, "one dataset for each filter"),
    ],
)  # fmt: skip
def test_arguments_that_make_no_sense(settings, change, error, message, imgs, tmp_path):
    wvs = change.pop("wvs", [4.44] * 3)
    dataset = generic(np.resize(imgs, (len(wvs), *SHAPE)), np.zeros(len(wvs)), wvs)
    before = dict(vars(dataset))
    settings = {"opd": OPD, "subtractor": render, **settings}
    with backend(**settings), pytest.raises(error, match=message):
        reduced(dataset, tmp_path, **change)
    assert vars(dataset) == before
    assert list(tmp_path.iterdir()) == []


MISTAKEN = [
    ({"model_options": {"npx": 64}}, "npx: not known to nircam_coronagraph, which has .*npix"),
    ({"model_options": 64}, "model_options: got a int, expected a dict"),
    ({"accuracy": "quick", "settings": FitSettings()}, "accuracy, settings: got 'quick' and set"),
    ({"pattern": "maybe"}, "'maybe', expected 'auto', 'references'"),
    ({"image": "sharp"}, "image: got 'sharp'"),
    ({"keep_detected": "yes"}, "keep_detected: got 'yes', expected one of True, False"),
    ({"size": 4}, "size: got 4, expected a whole number of pixels, 8 or more"),
    ({"star_flux": "7.2 mag"}, "star_flux: got '7.2 mag'"),
    ({"settings": {"cycles": 8}}, "settings: got a dict, expected a FitSettings"),
    ({"start": [1.0]}, "start: got a list, expected a dict"),
]


@pytest.mark.parametrize(("settings", "message"), MISTAKEN)
def test_settings_are_checked_where_they_are_given(settings, message, unregistered):
    """Not when pyKLIP is called, or after a fit."""
    with pytest.raises(IncompatibleSetupError, match=message):
        register(**settings)
    with pytest.raises(IncompatibleSetupError, match=message), backend(**settings):
        pass
    assert not is_registered()


@pytest.mark.usefixtures("registered")
def test_a_dataset_without_frames(tmp_path):
    dataset = generic(np.zeros((0, *SHAPE)), [], center=np.zeros((0, 2)))
    dataset.centers = np.zeros((0, 2))
    with pytest.raises(NoValidPixelsError, match="no frames"):
        reduced(dataset, tmp_path, mode="ADI+SDI")
    with pytest.raises(NoValidPixelsError, match="no frames"):
        observation_from_dataset(dataset)


@pytest.mark.usefixtures("registered")
def test_masked_frames(imgs, tmp_path):
    with pytest.raises(NoValidPixelsError, match=r"frame0.*nothing is left to fit"):
        reduced(generic(imgs * np.nan, ANGLES), tmp_path)
    assert list(tmp_path.iterdir()) == []
    imgs[1] = np.nan
    dataset = generic(imgs, ANGLES)
    reduced(dataset, tmp_path)
    finite = np.isfinite(dataset.output[0, :, 0]).any(axis=(1, 2))
    np.testing.assert_array_equal(finite, [True, False, True])


@pytest.mark.parametrize("where", ["fit", "shape", "nothing", "writing"])
def test_a_failure_raises_and_leaves_everything_as_it_was(where, imgs, tmp_path):
    before = exchanged()
    dataset = generic(imgs, ANGLES)

    def fake(observation, opd, settings):
        found = render(observation, opd, settings)
        if where == "fit":
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
        reduced(generic(imgs, ANGLES), tmp_path)
    kept = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    state = dict(vars(dataset))
    errors = {"fit": RefinementError, "shape": ShapeError, "nothing": RefinementError}
    with pytest.raises(errors.get(where, OSError)), backend(opd=OPD, subtractor=fake):
        reduced(dataset, tmp_path)
    assert vars(dataset) == state
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == kept
    assert same(before, exchanged())


def test_errors_while_the_console_is_silenced(imgs, tmp_path, monkeypatch):
    screen = io.StringIO()

    def fails(observation, opd, settings):
        assert not list(tmp_path.iterdir())  # Or a process that is killed would leave a folder.
        raise RefinementError("diverged", None)

    monkeypatch.setattr(sys, "stderr", io.StringIO())  # As spaceKLIP does.
    monkeypatch.setattr(sys, "__stderr__", screen)
    with backend(opd=OPD, subtractor=fails), pytest.raises(RefinementError):
        reduced(generic(imgs, ANGLES), tmp_path)
    assert screen.getvalue().startswith("diffrender: RefinementError: diverged")


def test_observation_from_a_dataset_without_headers(imgs):
    imgs[0, 3, 4] = np.nan
    observation = observation_from_dataset(generic(imgs, ANGLES))
    np.testing.assert_array_equal(observation.data[0, :3], imgs[0, :3])
    assert not observation.valid[0, 3, 4]
    assert observation.valid.sum() == imgs.size - 1
    np.testing.assert_array_equal(observation.center, np.tile(CENTER, (3, 1)))
    np.testing.assert_array_equal(observation.position_angles, ANGLES)
    assert (observation.filter, observation.date) == (None, None)
    assert observation.unit == u.dimensionless_unscaled
    assert (observation.error > 0).all()
    assert np.nanmedian(observation.data) > BACKGROUND


def test_errors_that_are_given(imgs):
    dataset = generic(imgs, ANGLES)
    for error in (0.5, np.full(SHAPE, 0.5), np.full(imgs.shape, 0.5)):
        dataset.diffrender = DiffrenderSettings(error=error, filter="F444W", unit=u.Jy)
        observation = observation_from_dataset(dataset)
        np.testing.assert_array_equal(observation.error, np.full(imgs.shape, 0.5))
        assert (observation.filter, observation.unit) == ("F444W", u.Jy)
    dataset.diffrender = DiffrenderSettings(error=np.zeros(7))
    with pytest.raises(ShapeError, match="expected a number"):
        observation_from_dataset(dataset)
