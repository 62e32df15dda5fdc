"""What poppy and stpsf document acts as there, or is refused with the reason."""

import inspect

import numpy as np
import poppy
import pytest
from astropy import units as u
from astropy.io import fits
from matplotlib import pyplot

from benchmarks import stpsf_data
from pyklip_diffrender.bridges import from_poppy, from_webbpsf
from pyklip_diffrender.bridges.poppy import PoppySystem
from pyklip_diffrender.bridges.webbpsf import WebbSystem
from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.optics import InstrumentSystem, OpticalSystem

# Of poppy's drawing, and of stpsf's writing.
pytestmark = [
    pytest.mark.filterwarnings("ignore:The set_bad function:PendingDeprecationWarning"),
    pytest.mark.filterwarnings("ignore:Card is too long"),
]

WAVES = [4e-6, 5e-6]
SOURCE = {"wavelengths": np.array(WAVES), "weights": np.array([1.0, 3.0])}

POPPY = {
    "wavelength": {"wavelength": 4.2e-6 * u.m},
    "weight": {"wavelength": WAVES * u.m, "weight": [1.0, 3.0]},
    "save_intermediates_what": {"save_intermediates_what": "phase"},
    "display": {"display": True},
    "return_intermediates": {"return_intermediates": True},
    "return_final": {"return_final": True},
    "source": {"source": SOURCE},
    "normalize": {"normalize": "last"},
}
"""Arguments of a call in which a keyword of poppy's `OpticalSystem.calc_psf` acts."""

POPPY_REFUSED = {
    "save_intermediates": (True, r"return_intermediates=True and call \.writeto\(\)"),
    "display_intermediates": (True, r"return_intermediates=True and call \.display\(\)"),
    "progressbar": (True, "leave it out"),
    "inwave": (poppy.Wavefront(wavelength=4.5e-6, npix=8), "give a wavefront as opd"),
}
"""Values of other keywords, and what the refusal says."""

FAST = {"monochromatic": 4.5e-6, "fov_pixels": 30, "fft_oversample": 2, "detector_oversample": 1}
STPSF = {
    "outfile": {"outfile": "psf.fits"},
    "source": {"source": {**SOURCE, "wavelengths": np.array([4.2e-6, 4.6e-6])},
               "monochromatic": None},
    "nlambda": {"nlambda": 2, "monochromatic": None},
    "monochromatic": {"monochromatic": 4.2e-6},
    "fov_arcsec": {"fov_arcsec": 1.5, "fov_pixels": None},
    "fov_pixels": {"fov_pixels": (20, 24)},
    "oversample": {"oversample": 2, "fft_oversample": None, "detector_oversample": None},
    "detector_oversample": {"detector_oversample": 2},
    "fft_oversample": {"fft_oversample": 3},
    "overwrite": {"outfile": "psf.fits", "overwrite": True},
    "display": {"display": True},
    "return_intermediates": {"return_intermediates": True},
    "normalize": {"normalize": "last"},
    "add_distortion": {"add_distortion": False},
    "crop_psf": {"crop_psf": False},
}  # fmt: skip
"""Arguments of a call in which a keyword of stpsf's `Instrument.calc_psf` acts."""

STPSF_REFUSED = {"save_intermediates": POPPY_REFUSED["save_intermediates"]}
FIELDS = (True, r"debug\(opd\) returns the field at every plane")
PLAIN_REFUSED = POPPY_REFUSED | dict.fromkeys(
    ("save_intermediates", "return_intermediates", "return_final", "display_intermediates"), FIELDS
)
OWN_REFUSED = {
    "save_intermediates": FIELDS,
    "return_intermediates": FIELDS,
    "add_distortion": (True, "modelled by from_webbpsf only"),
}


@pytest.fixture(autouse=True)
def _closed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    yield
    pyplot.close("all")


def keywords(method):
    """Names of the arguments of a method, with their default values, in order."""
    parameters = inspect.signature(method).parameters.values()
    kinds = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return {each.name: each.default for each in parameters if each.kind not in kinds}


@pytest.fixture
def poppy_system():
    system = poppy.OpticalSystem(oversample=2, npix=64, pupil_diameter=6.5 * u.m)
    system.add_pupil(poppy.optics.ParityTestAperture(radius=3.2 * u.m))
    system.add_image(poppy.CircularOcculter(radius=0.3))
    system.add_pupil(poppy.CircularAperture(radius=2.6))
    system.add_detector(pixelscale=0.05, fov_pixels=20, oversample=2)
    return system


def test_every_keyword_has_a_case():
    """In the order of the original, so that arguments may be given by position as well."""
    stpsf = pytest.importorskip("stpsf")
    # Without a wavelength, poppy takes 1 micron, and a system its own. The embedded instrument has
    # no distortion, and a converted one adds it by default, as stpsf does.
    for original, systems, cases, other in (
        (poppy.OpticalSystem, (OpticalSystem, PoppySystem), POPPY | POPPY_REFUSED, "wavelength"),
        (
            stpsf.NIRCam, (InstrumentSystem, WebbSystem), STPSF | STPSF_REFUSED, "add_distortion",
        ),
    ):  # fmt: skip
        theirs = keywords(original.calc_psf)
        assert cases.keys() == theirs.keys() - {"self"}
        for system in systems:
            ours = keywords(system.calc_psf)
            assert list(ours)[: len(theirs)] == list(theirs)
            assert {n for n, default in theirs.items() if ours[n] != default} == {other}


def same(ours, theirs, tolerance):
    """Whether two results agree: extensions and, if there are any, wavefronts and figures."""
    waves = [[], []]
    if isinstance(theirs, tuple):
        (ours, waves[0]), (theirs, waves[1]) = ours, theirs
    assert len(ours) == len(theirs)
    for mine, other in zip(ours, theirs, strict=True):
        assert np.abs(mine.data - other.data).max() <= tolerance * other.data.max()
    assert len(waves[0]) == len(waves[1])
    for mine, wave in zip(waves[0][-1:], waves[1][-1:], strict=True):
        assert np.abs(mine.intensity - wave.intensity).max() <= tolerance * wave.intensity.max()


def drawn():
    """The last image in the current figure."""
    return np.asarray([image for ax in pyplot.gcf().axes for image in ax.images][-1].get_array())


@pytest.mark.parametrize("keyword", POPPY)
def test_keywords_of_poppy_act_as_there(poppy_system, keyword):
    call = {"wavelength": 4.5e-6, **POPPY[keyword]}
    theirs = poppy_system.calc_psf(**call)
    shown = drawn() if keyword == "display" else None
    ours = from_poppy(poppy_system, 4.5e-6).calc_psf(**POPPY[keyword])
    # Rounding; the same samples.
    same(ours, theirs, 1e-12)
    if shown is not None:
        assert len(pyplot.get_fignums()) == 2
        assert np.allclose(drawn(), shown, atol=1e-12 * shown.max(), rtol=0)


STPSF_CASES = [
    name if name in ("display", "normalize") else pytest.param(name, marks=pytest.mark.slow)
    for name in STPSF
]


@pytest.mark.parametrize("keyword", STPSF_CASES)
def test_keywords_of_stpsf_act_as_there(stpsf_path, tmp_path, keyword):
    instrument, call = stpsf_data.nircam(stpsf_path), {**FAST, **STPSF[keyword]}
    model = from_webbpsf(instrument, **FAST)
    # stpsf draws all planes before the PSF, which is its last image.
    theirs = instrument.calc_psf(**call)
    shown = drawn() if keyword == "display" else None
    if keyword == "overwrite":
        for each in (instrument, model):
            with pytest.raises(OSError, match="exists"):
                each.calc_psf(**{**call, "overwrite": False})
    ours = model.calc_psf(**STPSF[keyword])
    # Rounding; the same samples.
    same(ours, theirs, 1e-10)
    if "outfile" in call:
        with fits.open(tmp_path / "psf.fits") as written:
            same(written, theirs, 1e-10)
            assert "DRVERS" in written[0].header
    if shown is not None:
        assert len(pyplot.get_fignums()) == 2
        # stpsf draws before it adds the jitter, 7 mas, which moves light between neighbours.
        assert np.allclose(drawn(), ours[0].data, rtol=1e-12)
        assert np.allclose(drawn(), shown, atol=0.02 * shown.max(), rtol=0)


EMBEDDED = {"monochromatic": 4.5e-6, "npix": 64, "fov_pixels": 20, "oversample": 2}
OWN = {
    "outfile": {"outfile": "psf.fits"},
    "source": {"source": 4000.0, "nlambda": 3},
    "nlambda": {"nlambda": 3},
    "monochromatic": {"monochromatic": 4.2e-6},
    "fov_arcsec": {"fov_arcsec": 1.0},
    "fov_pixels": {"fov_pixels": (16, 12)},
    "oversample": {"oversample": 3},
    "detector_oversample": {"detector_oversample": 3},
    "fft_oversample": {"fft_oversample": 3},
    "overwrite": {"outfile": "psf.fits", "overwrite": True},
    "display": {"display": True},
    "normalize": {"normalize": "last"},
    "crop_psf": {"crop_psf": False},
}
"""Arguments of a call in which a keyword of stpsf's acts on the embedded instrument."""


def made_with(call):
    """Image of the embedded instrument, made with the settings of a call."""
    names = {"detector_oversample": "oversample", "fft_oversample": "occulter_sampling"}
    call = {names.get(name, name): value for name, value in call.items()}
    settings = {n: v for n, v in call.items() if n in keywords(nircam_coronagraph)}
    if "oversample" in call:
        settings.setdefault("occulter_sampling", call["oversample"])
    replaced = {"nlambda": "monochromatic", "fov_arcsec": "fov_pixels"}
    dropped = {replaced[name] for name in settings if name in replaced}
    start = {name: value for name, value in EMBEDDED.items() if name not in dropped}
    image = nircam_coronagraph("F444W", **{**start, **settings})().numpy()
    return image / image.sum() if "normalize" in call else image


@pytest.mark.parametrize("keyword", OWN)
def test_keywords_of_stpsf_act_on_the_embedded_instrument(tmp_path, keyword):
    call = OWN[keyword]
    model = nircam_coronagraph("F444W", **EMBEDDED)
    psf = model.calc_psf(**call)
    if keyword == "detector_oversample":
        call = {**call, "fft_oversample": None}
    # Binning in another order, and a stop that hides nothing.
    assert np.allclose(psf["DET_SAMP"].data, made_with(call), rtol=1e-12)
    if "outfile" in call:
        with fits.open(tmp_path / "psf.fits") as written:
            same(written, psf, 0)
            assert written[0].header["FILENAME"] == "psf.fits"
        with pytest.raises(FileExistsError, match="overwrite"):
            model.calc_psf(**{**call, "overwrite": False})
    if keyword == "display":
        assert np.array_equal(drawn(), psf[0].data)


def test_sources_of_stpsf():
    """A dictionary has the wavelengths themselves; a spectrum of synphot has to be sampled."""
    # The tilt of the wedge is zero at this wavelength, whatever is in the band.
    model = nircam_coronagraph("F444W", chromatic_reference=4.5e-6, **EMBEDDED)
    source = {"wavelengths": [4.2e-6, 4.6e-6], "weights": [1.0, 3.0]}
    psf = model.calc_psf(source=source)["DET_SAMP"]
    parts = [model.calc_psf(monochromatic=wave)[1].data for wave in source["wavelengths"]]
    assert np.allclose(psf.data, 0.25 * parts[0] + 0.75 * parts[1], rtol=1e-12)
    synphot = pytest.importorskip("synphot")
    from synphot.models import BlackBody1D

    spectrum = synphot.SourceSpectrum(BlackBody1D, temperature=4000)
    with pytest.raises(IncompatibleSetupError, match=r"source=\(spectrum\.waveset"):
        model.calc_psf(source=spectrum, nlambda=3)
    waves = np.linspace(3e-6, 6e-6, 1000) * u.m
    sampled = model.calc_psf(source=(waves, spectrum(waves)), nlambda=3)[1].data
    # A blackbody by samples 3 nm apart.
    assert np.allclose(sampled, model.calc_psf(source=4000.0, nlambda=3)[1].data, rtol=1e-4)


def embedded(_):
    return nircam_coronagraph("F444W", **EMBEDDED)


def plain(_):
    """A system made of planes, without a recipe."""
    model = nircam_coronagraph("F444W", chromatic_reference=4.5e-6, **EMBEDDED)
    return OpticalSystem(model.entrance, model.between, model.detector, model.bandpass)


def converted(system):
    return from_poppy(system, 4.5e-6)


@pytest.mark.parametrize("keyword", [name for name in POPPY if name not in PLAIN_REFUSED])
def test_keywords_of_poppy_act_on_a_system_made_of_planes(keyword):
    call = {"wavelength": 4.5e-6, **POPPY[keyword]}
    source = call.get("source", SOURCE | {"wavelengths": WAVES})
    if keyword not in ("source", "weight"):
        wave = u.Quantity(call["wavelength"], u.m).value
        source = {"wavelengths": [wave], "weights": [1.0]}
    model = nircam_coronagraph("F444W", chromatic_reference=4.5e-6, **EMBEDDED)
    normalize = call.get("normalize", "first")
    same(plain(None).calc_psf(**call), model.calc_psf(source=source, normalize=normalize)[:1], 0)
    assert len(pyplot.get_fignums()) == (keyword == "display")


def test_weights_alone_are_those_of_the_systems_wavelengths(poppy_system):
    model = from_poppy(poppy_system, WAVES)
    theirs = poppy_system.calc_psf(WAVES * u.m, weight=[1.0, 3.0])
    same(model.calc_psf(weight=[1.0, 3.0]), theirs, 1e-12)
    same(from_poppy(poppy_system, WAVES * u.m, [1.0, 3.0]).calc_psf(), theirs, 1e-12)
    with pytest.raises(ShapeError, match="2 wavelengths and 3 weights"):
        model.calc_psf(weight=[1.0, 3.0, 1.0])


def test_intermediate_wavefronts_are_those_of_the_call(poppy_system):
    """The wavefronts have the OPD and the place of the source that the PSF has."""
    model = from_poppy(poppy_system, 4.5e-6)
    opd = 1e-7 * np.random.default_rng(1).standard_normal((64, 64))
    psf, (last,) = model.calc_psf(opd=opd, star_offset=(0.1, 0.2), return_final=True)
    assert np.allclose(last.intensity, psf[0].data, rtol=1e-12)


DISPLAY = {
    "what": "both", "crosshairs": True, "ax": None, "colorbar": False,
    "colorbar_orientation": "vertical", "title": "coronagraph", "opd_vmax": 1e-7 * u.m,
    "wavelength": 2e-6 * u.m, "npix": 64, "grid_size": 3,
}  # fmt: skip
"""Keywords of `display` of poppy's optics, which `OpticalSystem.display` passes on."""


@pytest.mark.parametrize("keyword", DISPLAY)
def test_display_draws_what_poppy_draws(poppy_system, keyword):
    placed = {"self", "nrows", "row"}  # By the system, in which an optic has a row.
    assert DISPLAY.keys() == keywords(poppy.poppy_core.OpticalElement.display).keys() - placed
    call = {"what": "both", keyword: DISPLAY[keyword]}
    poppy_system.display(**call)
    theirs = pyplot.gcf()
    pyplot.figure()
    converted(poppy_system).display(**call)
    ours = pyplot.gcf()
    assert ours is not theirs
    assert len(ours.axes) == len(theirs.axes) >= 6
    for mine, other in zip(ours.axes, theirs.axes, strict=True):
        assert mine.get_title() == other.get_title()
        assert len(mine.lines) == len(other.lines)
        for image, wanted in zip(mine.images, other.images, strict=True):
            assert np.array_equal(image.get_array(), wanted.get_array(), equal_nan=True)
            assert image.get_clim() == wanted.get_clim()
            assert image.get_extent() == wanted.get_extent()
    with pytest.raises(IncompatibleSetupError, match=rf"^{keyword}=.*plot\(ax, opd"):
        embedded(None).display(**call if keyword == "what" else {keyword: DISPLAY[keyword]})


@pytest.mark.slow
def test_display_of_an_instrument(stpsf_path):
    instrument = stpsf_data.nircam(stpsf_path)
    assert list(keywords(type(instrument).display)) == ["self"]
    instrument.display()
    theirs = [ax.get_title() for ax in pyplot.gcf().axes]
    pyplot.figure()
    from_webbpsf(instrument, **FAST).display()
    assert [ax.get_title() for ax in pyplot.gcf().axes] == theirs
    assert "MASK335R" in "".join(theirs)


def test_display_of_the_embedded_instrument():
    embedded(None).display()
    # The pupil, the wavefront, the light in the last pupil and the image.
    assert len(pyplot.gcf().axes) == 4


def test_planes_from_pupil_to_detector_are_described(poppy_system):
    model = converted(poppy_system)
    assert [plane.name for plane in model.planes] == [each.name for each in poppy_system.planes]
    for system in (model, embedded(None)):
        assert system.planes == (system.entrance, *system.between, system.detector)
        first, *lines = system.describe().split("\n\t")
        assert first == repr(system)
        assert len(lines) == len(system.planes)
        for line, plane in zip(lines, system.planes, strict=True):
            assert line == repr(plane)
            assert plane.name in line
        assert "object at 0x" not in system.describe()
    assert embedded(None).describe().split("\n\t")[1:] == [
        "<EntrancePupil 'JWST pupil', 64 px pupil>",
        "<CompactOcculter 'MASK335R', image plane>",
        "<LyotStop 'MASKRND', pupil plane>",
        "<InternalAberration 'NIRCam internal WFE', pupil plane>",
        "<Detector 'detector', 20 x 20 px of 0.06242 arcsec>",
    ]


CASES = [
    *((plain, name, *case) for name, case in PLAIN_REFUSED.items()),
    *((converted, name, *case) for name, case in POPPY_REFUSED.items()),
    *((embedded, name, *case) for name, case in OWN_REFUSED.items()),
]


@pytest.mark.parametrize(("make", "keyword", "value", "reason"), CASES)
def test_what_is_refused(poppy_system, make, keyword, value, reason):
    assert OWN.keys() | OWN_REFUSED.keys() == STPSF.keys() | STPSF_REFUSED.keys()
    with pytest.raises(IncompatibleSetupError, match=f"^{keyword}=.*{reason}"):
        make(poppy_system).calc_psf(**{keyword: value})


def test_stpsf_models_save_no_planes(stpsf_path):
    model = from_webbpsf(stpsf_data.nircam(stpsf_path), **FAST)
    value, reason = STPSF_REFUSED["save_intermediates"]
    with pytest.raises(IncompatibleSetupError, match=f"^save_intermediates=True.*{reason}"):
        model.calc_psf(save_intermediates=value)
