"""Admission: what real folders contain, what is used of it, and why the rest is not."""

import gzip
import re
import shutil
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.time import Time
from scipy.ndimage import fourier_shift, gaussian_filter

import pyklip_diffrender as dr
from benchmarks.calints_files import CENTER, SIDE, calints, starlight
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.scene.exposure import (
    CatalogueStar,
    beginning,
    common_motion,
    image_mask,
)

FIRST, SECOND, THIRD = (f"jw0118400{k}001_03106_00001_nrcalong_calints.fits" for k in (1, 2, 3))


@pytest.fixture
def folder(tmp_path):
    """Two rolls of HD 1 and one of HD 2, a reference star."""
    calints(tmp_path / FIRST)
    calints(tmp_path / SECOND, observation=2, roll=80.0, date="2022-10-03T09:00:00")
    calints(
        tmp_path / THIRD, "HD 2", observation=3, roll=20.0, date="2022-10-03T12:00:00",
        cards={"IS_PSF": True}, light=0.3 * starlight(),
    )  # fmt: skip
    return tmp_path


def another(folder, name="x.fits", **facts):
    """One more roll of HD 1."""
    usual = {"observation": 8, "roll": 90.0, "date": "2022-10-03T13:00:00"}
    return calints(folder / name, **usual | facts)


def reasons(sequence):
    return dict(sequence.excluded)


def uses(sequence):
    return {row["file"]: str(row["use"]) for row in sequence.table}


def as_before(sequence):
    """Whether the frames are those of the two rolls and the reference star, and no others."""
    names = [each.name for each in (*sequence.science, *sequence.references)]
    return names == [FIRST, SECOND, THIRD]


def test_the_table_says_what_every_file_is(folder):
    sequence = dr.ExposureSequence.from_files(folder)
    assert as_before(sequence)
    assert sequence.excluded == ()
    table = sequence.table
    assert list(table["use"]) == ["target", "target", "reference"]
    first = table[0]
    assert first["exposure"] == "jw01184001001_03106_00001_nrcalong"
    assert (first["mask"], first["filter"], first["stop"]) == ("MASK335R", "F444W", "MASKRND")
    assert (first["level"], first["exp_type"], first["unit"]) == ("calints", "NRC_CORON", "MJy/sr")
    assert first["ra"].to_value("deg") == 100.0
    assert first["position_angle"].to_value("deg") == pytest.approx(70.05)
    assert len(table.colnames) >= 18
    assert sequence.target == "HD 1"
    assert [each.reference for each in sequence.references] == [True]
    assert sequence.science[1].roll_from(sequence.science[0]) == pytest.approx(-10)
    assert sequence.cutout(10).science[0].shape == (10, 10)
    chosen = dr.ExposureSequence.from_files(folder, target="hd 2")
    assert [each.name for each in chosen.science] == [THIRD]
    assert len(chosen.references) == 2


STARS = ("TARGPROP", "TARGNAME", "TARG_RA", "TARG_DEC")
EXCLUDED = [
    ("jw01184001001_03106_00001_nrcalong_a3001_crfints.fits", {}, "same exposure as .*calints"),
    ("jw01184001001_03106_00001_nrcalong_rateints.fits", {"BUNIT": "DN/s"}, "same exposure"),
    ("jw01184-c1001_t001_nircam_f444w-maskrnd_i2d.fits", {}, "resampled"),
    ("jw01184-c1001_t001_nircam_f444w-maskrnd_psfsub.fits", {}, "subtracted"),
    ("i2d.fits", {"S_RESAMP": "COMPLETE"}, "resampled"),
    ("stack.fits", {"FILENAME": "jw01184_psfstack.fits"}, "psfstack"),
    ("ta.fits", {"EXP_TYPE": "NRC_TACQ"}, "NRC_TACQ.*acquiring"),
    ("conf.fits", {"EXP_TYPE": "NRC_TACONFIRM"}, "NRC_TACONFIRM"),
    ("sky.fits", {"BKGDTARG": True}, "background"),
    ("open.fits", {"CORONMSK": "NONE", "APERNAME": None, "SUBARRAY": "SUB320"},
     "not behind a mask"),
    ("dn.fits", {"BUNIT": "DN/s"}, "BUNIT is DN/s, not MJy/sr"),
    ("bar.fits", {"CORONMSK": "MASKALWB", "APERNAME": None, "SUBARRAY": "SUB320ALWB",
                  "PUPIL": "MASKBAR"}, "mask is MASKLWB"),
    ("b.fits", {"DETECTOR": "NRCBLONG"}, "DETECTOR is NRCBLONG"),
    ("mas.fits", {"XOFFSET": 15.0, "YOFFSET": -10.0}, "milliarcseconds"),
    ("pup.fits", {"PUPIL": "CLEAR"}, "PUPIL is CLEAR"),
    ("two.fits", {"CORONMSK": "MASKA430R"}, "CORONMSK MASKA430R.*name different masks"),
    ("area.fits", {"PIXAR_A2": 0.00096}, "^PIXAR_A2 is 0.00096, expected about 0.004 .*NRCALONG"),
    ("steradian.fits", {"PIXAR_SR": 0.0039}, "^PIXAR_SR is 0.0039, expected about 9.17e-14 sr"),
    ("old.fits", {"DATE-BEG": "2012-01-01"}, "^the exposure.*the launch"),
    ("mid.fits", {"EXPMID": 59000.5}, "EXPMID is 59000.5, expected about"),
    ("sum.fits", {"PA_APER": 12.0}, "PA_APER is 12.0, expected 70.050"),
    ("roll.fits", {"ROLL_REF": None}, "ROLL_REF"),
    ("angle.fits", {"V3I_YANG": "UNKNOWN"}, "V3I_YANG"),
    ("who.fits", dict.fromkeys((*STARS, "IS_PSF")), "TARGPROP"),
]  # fmt: skip


def test_what_is_no_frame_of_this_setup_is_excluded(folder):
    for k, (name, cards, _) in enumerate(EXCLUDED):
        calints(folder / name, observation=1 if "nrcalong" in name else 9 + k, cards=cards)
    sequence = dr.ExposureSequence.from_files(folder)
    assert as_before(sequence)
    said = reasons(sequence)
    assert said.keys() == {name for name, _, _ in EXCLUDED}
    assert [said[name] for name, _, words in EXCLUDED if not re.search(words, said[name])] == []
    assert all(uses(sequence)[name] == "excluded" for name in said)


@pytest.mark.parametrize("name", ["PRIMARY", "RESULT_PHASE"])
def test_an_opd_map_is_no_frame(tmp_path, name):
    """In the wrong place on the command line, and in the folder of the frames."""
    image = fits.ImageHDU(np.zeros((16, 16)), fits.Header({"BUNIT": "um"}), name=name)
    if name == "PRIMARY":
        image.writeto(tmp_path / "opd.fits")
    else:
        fits.HDUList([fits.PrimaryHDU(), image]).writeto(tmp_path / "opd.fits")
    words = "it is an OPD map, no frame of a star; OPD maps are given as opd"
    with pytest.raises(NoValidPixelsError, match=words):
        dr.ExposureSequence.from_files(tmp_path)
    calints(tmp_path / "a.fits")
    assert reasons(dr.ExposureSequence.from_files(tmp_path))["opd.fits"].startswith(
        "it is an OPD map"
    )


def test_one_exposure_is_used_once(folder):
    first = folder / FIRST
    (folder / f"{FIRST}.gz").write_bytes(gzip.compress(first.read_bytes()))
    (folder / "link.fits").symlink_to(first)
    with fits.open(first) as hdus:
        for name in ("SCI", "ERR", "DQ"):
            hdus[name].data = hdus[name].data[0]
        hdus.writeto(folder / FIRST.replace("calints", "cal"))
    files = [*sorted(folder.iterdir()), first]
    sequence = dr.ExposureSequence.from_files(files)
    assert as_before(sequence)
    assert len(sequence.excluded) == 4
    assert {reason.split(" as ")[0] for _, reason in sequence.excluded} <= {
        "the same file", "the same exposure",
    }  # fmt: skip


def test_of_an_exposure_the_best_file_whose_pixels_are_a_stars_is_used(folder):
    good = folder / FIRST.replace("calints", "cal")
    with fits.open(folder / FIRST) as hdus:
        for name in ("SCI", "ERR", "DQ"):
            hdus[name].data = hdus[name].data[0]
        hdus.writeto(good)
    with fits.open(folder / FIRST, mode="update") as hdus:
        hdus["SCI"].data *= -1
    sequence = dr.ExposureSequence.from_files(folder)
    assert uses(sequence)[good.name] == "target"
    assert "negative" in reasons(sequence)[FIRST]


def test_what_one_filter_leaves_out_another_one_uses(folder):
    another(folder, "other.fits", cards={"FILTER": "F356W"})
    long, short = dr.ExposureSequence.by_filter_and_epoch(folder, target="HD 1")
    assert as_before(long)
    assert [each.name for each in short.science] == ["other.fits"]
    assert reasons(long) == {"other.fits": "taken through F356W, not F444W"}
    assert set(reasons(short)) == {FIRST, SECOND, THIRD}


OTHER = {"CORONMSK": "MASKA430R", "SUBARRAY": "SUB320A430R", "APERNAME": "NRCA5_MASK430R"}


def test_the_setup_of_most_of_the_targets_frames_is_reduced(folder):
    for k in (4, 5, 6):
        date = f"2022-10-03T0{9 - k}:30:00"
        another(folder, f"r{k}.fits", observation=k, roll=60.0 + k, cards=OTHER, date=date)
    sequence = dr.ExposureSequence.from_files(folder)
    # In the order of time.
    assert [each.name for each in sequence.science] == ["r6.fits", "r5.fits", "r4.fits"]
    assert all("mask is MASK335R, not MASK430R" in reason for _, reason in sequence.excluded)
    assert len(sequence.excluded) == 3


def test_stars_are_told_apart_by_coordinates_and_signs():
    plus = CatalogueStar(("BD+20-1790",), (110.0, 20.2))
    minus = CatalogueStar(("BD-20-1790",), (110.0, -20.2))
    assert not plus.is_same(minus)
    assert not CatalogueStar(plus.names).is_same(CatalogueStar(minus.names))
    assert plus.is_same(CatalogueStar(("HD 5",), (110.0, 20.2 + 3 / 3600)))
    assert not plus.is_same(CatalogueStar(("HD 5",), (110.0, 20.2 + 20 / 3600)))
    # One star, whose coordinates are those of another epoch.
    assert plus.is_same(CatalogueStar(("BD +20 1790",), (110.0, 20.2 + 20 / 3600)))
    assert not plus.is_same(CatalogueStar(plus.names, (111.0, 20.2)))
    assert plus.separation(CatalogueStar((), (110.0 + 1e-3 / np.cos(np.deg2rad(20.2)), 20.2))) == (
        pytest.approx(3.6, rel=1e-6)
    )


FAST = (3.0, 3.4)
"""arcsec per year, by which a star goes 103 arcsec from 2000 to the end of 2022."""
DATED = {"MU_RA": FAST[0], "MU_DEC": FAST[1], "MU_EPOCH": "2000-01-01 00:00:00.0000000"}
UNDATED = {"MU_RA": 0.0, "MU_DEC": 0.0, "MU_EPOCH": "2000-01-01 00:00:00.0000000"}


def place_in(date, dec=20.0):
    """Cards of the coordinates of the fast star at a date, by astropy."""
    star = SkyCoord(
        100 * u.deg, dec * u.deg, pm_ra_cosdec=FAST[0] * u.arcsec / u.yr, distance=10 * u.pc,
        pm_dec=FAST[1] * u.arcsec / u.yr, obstime=Time("2000-01-01"),
    )  # fmt: skip
    there = star.apply_space_motion(Time(date))
    return {"TARG_RA": float(there.ra.deg), "TARG_DEC": float(there.dec.deg)}


@pytest.mark.parametrize(
    ("names", "cards", "dec"),
    [
        (("HD 1", "HD 1"), DATED, 20.0),
        (("HD 1", "GJ 1"), DATED, 20.0),
        (("HD 1", "GJ 1"), DATED | {"MU_EPOCH": 2000.0}, 20.0),
        # Near the pole a proper motion is no change of coordinates at a constant rate.
        (("HD 1", "GJ 1"), DATED, 89.8),
        # Of names that agree, the motion that any star may have is enough.
        (("HD 1", "hd-1"), UNDATED, 20.0),
        (("HD 1", "HD 1"), {}, 20.0),
    ],
    ids=["one name", "two names", "a year", "pole", "zeros", "no cards"],
)
def test_a_star_with_coordinates_of_two_epochs_is_one(tmp_path, names, cards, dec):
    """No card says whether TARG_RA is of the catalogue's epoch or of the exposure."""
    for k, (name, date) in enumerate(zip(names, ("2000-01-01", "2022-10-03"), strict=True)):
        place = place_in(date, dec)
        another(tmp_path, f"{k}.fits", star=name, observation=k + 1, cards=cards | place,
                roll=70.0 + 10 * k, date=f"2022-10-03T0{k}:00:00")  # fmt: skip
    sequence = dr.ExposureSequence.from_files(tmp_path)
    assert uses(sequence) == {"0.fits": "target", "1.fits": "target"}


@pytest.mark.parametrize(
    ("names", "cards", "arcsec"),
    [
        (("HD 1", "GJ 1"), UNDATED, 10.0),
        (("HD 1", "GJ 1"), DATED, 10.0),
        # A motion of which no star is capable explains nothing.
        (("HD 1", "GJ 1"), UNDATED | {"MU_RA": 3000.0, "MU_DEC": 3400.0}, 103.0),
        (("TARGET", "TARGET"), DATED, 3600.0),
        (("TARGET", "TARGET"), UNDATED, 3600.0),
    ],
)
def test_what_the_motion_does_not_explain_are_two_stars(tmp_path, names, cards, arcsec):
    for k, name in enumerate(names):
        place = {"TARG_RA": 100.0, "TARG_DEC": 20.0 + k * arcsec / 3600}
        another(tmp_path, f"{k}.fits", star=name, observation=k + 1, cards=cards | place)
    with pytest.raises(IncompatibleSetupError, match=r"target: the files have"):
        dr.ExposureSequence.from_files(tmp_path)


def test_proper_motions_of_headers_are_compared():
    def motion(*pairs):
        cards = [fits.Header({"MU_RA": east, "MU_DEC": north}) for east, north in pairs]
        return common_motion((header, f"{k}.fits") for k, header in enumerate(cards))

    # Zeros are what a proposal has that says nothing.
    assert motion((0.0, 0.0)) is None
    assert motion((0.0, 0.0), (0.28, -0.36)) == (0.28, -0.36)
    assert motion((0.0, -0.36)) == (0.0, -0.36)
    assert motion((0.28, -0.36), (0.284, -0.36)) == pytest.approx((0.282, -0.36))
    with pytest.raises(
        IncompatibleSetupError, match=r"0\.28, -0\.36 in 1\.fits and 0\.4, -0\.4 in 2"
    ):
        motion((0.0, 0.0), (0.28, -0.36), (0.4, -0.4))
    with pytest.raises(CorruptFileError, match=r"281 and -360, expected .*milliarcseconds"):
        motion((281.0, -360.0))
    assert motion((-0.80, 10.36)) == (-0.80, 10.36)  # Barnard's star.


@pytest.mark.parametrize(
    ("names", "keys", "arcsec"),
    [
        (("HD 1A", "HD 1B"), ("TARG_RA", "TARG_DEC"), 1.5),
        (("HD 1A", "HD 1B"), ("RA_REF", "DEC_REF"), 4.9),
        (("BD+20-1790", "BD-20-1790"), None, None),
    ],
    ids=["binary", "wide binary", "another sign"],
)
def test_stars_near_each_other_or_of_nearly_one_name_are_two(tmp_path, names, keys, arcsec):
    for k, name in enumerate(names):
        cards = dict.fromkeys(("TARG_RA", "TARG_DEC")) if keys else {}
        if keys:
            cards |= {keys[0]: 100.0, keys[1]: 20.0 + k * arcsec / 3600}
        another(tmp_path, f"{k}.fits", star=name, observation=k, cards=cards)
    listed = ", ".join(rf"{re.escape(name)} \(1\)" for name in names)
    with pytest.raises(IncompatibleSetupError, match=listed):
        dr.ExposureSequence.from_files(tmp_path)
    sequence = dr.ExposureSequence.from_files(tmp_path, target=names[0])
    assert uses(sequence) == {"0.fits": "target", "1.fits": "reference"}


@pytest.mark.parametrize(
    ("name", "kept"),
    [(None, ("TARGNAME",)), ("", ("TARG_RA", "TARG_DEC")), ("UNKNOWN", ("IS_PSF",))],
)
def test_a_star_without_a_name_is_known_by_other_cards(folder, name, kept):
    cards = dict.fromkeys(STARS) | {"TARGPROP": name, "TARGNAME": name, "IS_PSF": None}
    values = {"TARGNAME": "HD 2", "TARG_RA": 101.5, "TARG_DEC": 19.0, "IS_PSF": True}
    (folder / THIRD).unlink()
    another(folder, THIRD, star="HD 2", cards=cards | {key: values[key] for key in kept})
    sequence = dr.ExposureSequence.from_files(folder, target="HD 1")
    assert uses(sequence)[THIRD] == "reference"
    assert as_before(sequence)


@pytest.mark.parametrize("nameless", [False, True])
def test_a_reference_star_does_not_become_the_target(folder, nameless):
    """Of a file that cannot be read, or states nothing, it is not known that it is no target."""
    truncated(folder / FIRST)
    if nameless:
        (folder / SECOND).unlink()
        calints(folder / SECOND, observation=2, cards=dict.fromkeys(STARS))
    else:
        truncated(folder / SECOND)
    with pytest.raises(NoValidPixelsError, match=f"only frames that are marked.*HD 2.*{FIRST}"):
        dr.ExposureSequence.from_files(folder)
    assert dr.ExposureSequence.from_files(folder, target="HD 2").target == "HD 2"


def test_a_single_star_needs_no_name(tmp_path):
    cards = dict.fromkeys((*STARS, "IS_PSF"))
    another(tmp_path, cards=cards)
    assert dr.ExposureSequence.from_files(tmp_path).target == "x.fits"
    another(tmp_path, "y.fits", observation=9, date="2022-10-03T14:00:00", cards=cards)
    with pytest.raises(NoValidPixelsError, match=r"x\.fits, y\.fits: .*does not say which star"):
        dr.ExposureSequence.from_files(tmp_path)


@pytest.mark.parametrize(
    ("cards", "isot"),
    [
        ({"DATE-BEG": "2022-10-03T05:53:34.311"}, "2022-10-03T05:53:34.311"),
        ({"DATE-OBS": "2022-10-03", "TIME-OBS": "05:53:34.311"}, "2022-10-03T05:53:34.311"),
        ({"DATE-BEG": "UNKNOWN", "EXPSTART": 59855.25}, "2022-10-03T06:00:00.000"),
        ({"DATE-OBS": "2022-10-03"}, "2022-10-03T00:00:00.000"),
        ({"DATE-OBS": ""}, None),
    ],
)
def test_the_beginning_is_what_the_cards_say(cards, isot):
    date = beginning(fits.Header(cards), "a.fits")
    assert (date and date.isot) == isot


@pytest.mark.parametrize(
    ("cards", "mask"),
    [
        ({"CORONMSK": "MASKA335R"}, "MASK335R"),
        ({"CORONMSK": "UNKNOWN", "APERNAME": "NRCA5_FULL_MASK335R"}, "MASK335R"),
        ({"SUBARRAY": "SUB320A430R"}, "MASK430R"),
        ({"SUBARRAY": "SUB640A210R", "CORONMSK": ""}, "MASK210R"),
        ({"APERNAME": "NRCA5_MASKLWB_F444W"}, "MASKLWB"),
        ({"SUBARRAY": "FULL"}, None),
        ({"APERNAME": "NRCA5_TAMASK335R"}, None),
        ({"CORONMSK": "4QPM_1065"}, "4QPM_1065"),
    ],
)
def test_the_mask_is_known_by_any_of_three_cards(cards, mask):
    assert image_mask(fits.Header(cards), "a.fits") == mask


def test_epochs_are_separate_sequences(folder):
    another(folder, "later.fits", date="2023-12-01T13:00:00")
    with pytest.raises(IncompatibleSetupError, match=r"2022-10-03 \(jw.*2023-12-01 \(later"):
        dr.ExposureSequence.from_files(folder)
    first, second = dr.ExposureSequence.by_epoch(folder)
    assert as_before(first)
    # A reference star teaches the pattern at any epoch; the target's own planets must not.
    assert uses(second) == {
        "later.fits": "target", FIRST: "excluded", SECOND: "excluded", THIRD: "reference",
    }  # fmt: skip
    assert "another epoch than the frames of 2023-12-01" in reasons(second)[FIRST]
    for each, epochs in ((first, (1, 0)), (second, (0, 1))):
        assert (len(each.same_epoch), len(each.other_epochs)) == epochs
    remarks = dict(zip(second.table["file"], second.table["remark"], strict=True))
    assert remarks[THIRD].endswith("for the detector pattern and KLIP only")
    chosen = dr.ExposureSequence.from_files(folder, epoch="2023-12-02")
    assert [each.name for each in chosen.science] == ["later.fits"]
    with pytest.raises(IncompatibleSetupError, match="epoch: got 2023-02-01, expected one of"):
        dr.ExposureSequence.from_files(folder, epoch="2023-02-01")


def simulated(**details):
    ones = np.ones((2, 24, 24))
    return dr.Observation.from_arrays(ones, ones, pixelscale=0.06, filter="F444W", **details)


def test_frames_that_cannot_share_a_fit_are_refused():
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=24)
    days = ("2022-10-01", "2022-10-03", "2022-11-03")
    dates = [simulated(date=Time(day), name=day) for day in days]
    angled = simulated(position_angles=np.array([10.0, 10.0]))
    turned = simulated(position_angles=np.array([10.0, 40.0]))
    moved = simulated(center=np.array([[11.5, 11.5], [14.5, 11.5]]))
    for frames, words in (
        (dates, r"5 days apart.*2022-10-01.*2022-11-03"),
        ([angled, simulated()], "orientation on the sky is not known"),
        (turned, "2 places or orientations"),
        (moved, r"pointings\(\)"),
    ):
        with pytest.raises(IncompatibleSetupError, match=words):
            dr.refine(model, frames, "flat")
    assert [len(each) for each in turned.pointings()] == [1, 1]
    assert [each.position_angle for each in turned.pointings()] == [10.0, 40.0]
    assert [each.center[0, 0] for each in moved.pointings()] == [11.5, 14.5]
    assert angled.pointings() == (angled,)


def times(**factors):
    def change(arrays):
        for name, factor in factors.items():
            arrays[name] *= factor

    return change


def flipped(**shifts):
    """About the star, which is not in the middle."""
    axes = [{"x": -1, "y": -2}[name] for name in shifts]

    def change(arrays):
        for name, array in arrays.items():
            arrays[name] = np.roll(np.flip(array, axes), tuple(shifts.values()), axes)

    return change


def subtracted(arrays):
    y, x = np.indices((SIDE, SIDE))
    arrays["SCI"] -= starlight() * (1 - 0.3 * np.sin(x) * np.sin(y))


@pytest.mark.parametrize(
    ("light", "change", "words"),
    [
        (starlight((24.0, 3.0)), None, "centred 1.5 arcsec .*not behind the mask"),
        (None, times(SCI=2.5, ERR=2.5), "2.5 times as bright .*BUNIT"),
        (None, times(SCI=1e-3, ERR=1e-3), "scatter by .* MJy/sr, expected .*BUNIT"),
        (None, times(ERR=0.05), "scatter 20 times as much as ERR says"),
        (None, subtracted, "the star was subtracted"),
        (0.0 * starlight(), None, "no light of a star"),
        (None, flipped(x=-3), "pixels are mirrored left to right"),
        (None, flipped(y=3, x=-3), "pixels are turned by 180 degrees"),
    ],
    ids=["off the mask", "unit", "factor", "errors", "subtracted", "empty", "mirror", "turned"],
)
def test_frames_whose_pixels_contradict_the_others_are_excluded(folder, light, change, words):
    another(folder, light=light, change=change)
    sequence = dr.ExposureSequence.from_files(folder)
    assert re.search(words, reasons(sequence)["x.fits"])
    assert as_before(sequence)


def test_of_two_frames_that_differ_in_brightness_none_is_right(folder):
    (folder / SECOND).unlink()
    another(folder, SECOND, change=times(SCI=2.5, ERR=2.5))
    with pytest.raises(IncompatibleSetupError, match=f"{FIRST}, {SECOND} contradict each other"):
        dr.ExposureSequence.from_files(folder)


def aligned_with_an_outlier(path, recorded):
    """Shift a file by Fourier transform, as alignments do, with 1e6 for a NaN in ERR."""
    shift = np.array([0.37, -0.21])
    with fits.open(path) as hdus:
        hdus = fits.HDUList([each.copy() for each in hdus])
    hdus["ERR"].data[0, 60, 120] = 1e6
    for name in ("SCI", "ERR"):
        turned = fourier_shift(np.fft.fft2(hdus[name].data[0].astype(float)), shift[::-1])
        hdus[name].data = np.fft.ifft2(turned).real[None].astype(np.float32)
    if recorded:
        hdus.append(fits.ImageHDU(shift[None], name="IMSHIFTS"))
    hdus.writeto(path, overwrite=True)


@pytest.mark.parametrize("recorded", [False, True])
def test_a_frame_with_errors_that_ring_is_left_out_and_the_others_go_on(folder, recorded):
    aligned_with_an_outlier(folder / SECOND, recorded)
    sequence = dr.ExposureSequence.from_files(folder)
    assert [each.name for each in sequence.science] == [FIRST]
    ((name, reason),) = sequence.excluded
    assert name == SECOND
    assert re.search(
        r"no pixel is valid|of the pixels within 2 arcsec of the star are valid", reason
    )
    assert "positive" in reason
    for other in (FIRST, THIRD):
        (folder / other).unlink()
    with pytest.raises(NoValidPixelsError, match=f"{SECOND}: .* valid"):
        dr.ExposureSequence.from_files(folder)


def test_a_frame_without_valid_pixels_about_the_star_is_left_out(folder):
    def change(arrays):
        rows, columns = np.indices(arrays["DQ"].shape[1:])
        near = np.hypot(columns - CENTER[0], rows - CENTER[1]) * 0.0624 < 1.2
        arrays["DQ"][:, near] = 1

    another(folder, change=change)
    another(folder, "y.fits", date="2022-10-03T14:00:00", observation=9, cards={"CRPIX1": 400.0})
    sequence = dr.ExposureSequence.from_files(folder)
    assert as_before(sequence)
    # 64 % of a circle of 2 arcsec are more than 1.2 arcsec from its middle.
    assert reasons(sequence)["x.fits"].startswith("64% of the pixels within 2 arcsec of the star")
    assert "is not in the frame of 180 x 180 pixels" in reasons(sequence)["y.fits"]


def test_what_too_few_pixels_leave_open_is_said(tmp_path):
    small = starlight()[78:105, 75:102]
    path = calints(tmp_path / "small.fits", light=small, cards={"CRPIX1": 14.0, "CRPIX2": 14.0})
    (frame,) = dr.ExposureSequence.from_files(path).science
    assert "1.2 arcsec from the star: whether a star is there" in frame.remarks[0]
    whole = calints(tmp_path / "whole.fits")
    assert dr.ExposureSequence.from_files(whole).science[0].remarks == ()


def test_a_pixel_that_is_missing_at_the_peak_moves_nothing(shared_data, tmp_path):
    for number in ("005", "006"):
        name = f"jw01184{number}001_03106_00001_nrcalong_calints.fits"
        with fits.open(shared_data / "gto1184" / f"{name}.gz") as hdus:
            if number == "005":
                data = hdus["SCI"].data
                data[np.unravel_index(np.nanargmax(data), data.shape)] = np.nan
            hdus.writeto(tmp_path / name)
    sequence = dr.ExposureSequence.from_files(tmp_path, target="G 7-34")
    assert not sequence.excluded
    assert len(sequence.science) == 2


def test_stars_a_few_pixels_from_their_stated_places_and_in_a_nebula_are_admitted(folder):
    y, x = np.indices((SIDE, SIDE))
    nebula = 20 * np.exp(-(((x - 150) ** 2 + (y - 30) ** 2) / 2 / 40**2))
    lights = (starlight((-3.0, 0.0)), starlight((3.0, 0.0)), starlight() + nebula)
    for k, light in enumerate(lights, 10):
        another(folder, f"x{k}.fits", observation=k, light=light)
    sequence = dr.ExposureSequence.from_files(folder)
    assert reasons(sequence) == {}
    assert [uses(sequence)[f"x{k}.fits"] for k in (10, 11, 12)] == ["target"] * 3


def test_nothing_usable_is_an_error_with_every_reason_once(folder):
    paths = sorted(folder.glob("jw*"))
    for path in paths:
        fits.setval(path, "EXP_TYPE", value="NRC_TACQ")
    names = ", ".join(path.name for path in paths)
    with pytest.raises(NoValidPixelsError) as raised:
        dr.ExposureSequence.from_files(folder)
    assert str(raised.value).startswith(f"none of 3 files can be used: {names}: ")
    assert str(raised.value).count("NRC_TACQ") == 1
    for k in range(2):
        shutil.copy(paths[0], folder / f"z{k}.fits")
    for files, words in (
        (folder, rf"5 files can .*{names} and 2 more: .*NRC_TACQ"),
        ([folder / "z0.fits"], r"the file cannot be used: z0.fits: .*NRC_TACQ"),
    ):
        with pytest.raises(NoValidPixelsError, match=words):
            dr.ExposureSequence.from_files(files)


def test_real_frames_are_admitted(shared_data):
    paths = sorted((shared_data / "gto1184").glob("*_03107_*"))
    other = next((shared_data / "gto1184").glob("*_03106_*"))
    sequence = dr.ExposureSequence.from_files([*paths, other], filter="F356W", target="AU Mic")
    assert [len(sequence.science), len(sequence.references)] == [2, 4]
    assert {reason for _, reason in sequence.excluded} == {"taken through F444W, not F356W"}
    single = dr.ExposureSequence.from_files(shared_data / "hip65426_f444w_calints.fits.gz")
    assert len(single.science) == 1


def cube(path, change, integrations=8):
    return dr.Observation.from_fits(calints(path, integrations=integrations, change=change))


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """Eight integrations with nothing to remark."""
    return cube(tmp_path_factory.mktemp("twin") / "twin.fits", None)


def dim(arrays):
    arrays["SCI"][2] -= 0.4 * starlight()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda arrays: arrays["SCI"][2].fill(0.0), "have the value 0"),
        (lambda arrays: arrays["DQ"][2].fill(1), "flagged"),
        (dim, "0.60 times as bright"),
    ],
)
def test_an_integration_that_deviates_is_left_out_and_named(tmp_path, twin, change, words):
    got = cube(tmp_path / "x.fits", change)
    assert len(twin) == 8
    assert twin.remarks == ()
    assert len(got) == 7
    (remark,) = got.remarks
    assert remark.startswith("integration 3 of 8 is left out")
    assert words in remark
    both = twin.combined().valid & got.combined().valid
    away = (got.combined().data - twin.combined().data)[both] / twin.combined().error[both]
    # The mean of seven of the eight.
    assert away.std() < 0.5


def test_an_afterglow_in_one_integration_is_masked(tmp_path, twin):
    def change(arrays):
        y, x = np.indices((SIDE, SIDE))
        arrays["SCI"][4] += 5 * np.exp(-(((x - 105) ** 2 + (y - 80) ** 2) / (2 * 5.0**2)))

    got = cube(tmp_path / "x.fits", change)
    assert len(got) == 8
    assert "integration 5 of 8" in got.remarks[0]
    assert not got.valid[4, 80, 105]
    assert got.valid[np.arange(8) != 4].all()
    away = (got.combined().data - twin.combined().data)[0] / twin.combined().error[0]
    # Without the mask it would be 3 standard deviations of the mean; what is left is its edge.
    assert np.abs(away).max() < 2.5


def test_integrations_of_a_moving_star_are_kept(tmp_path):
    """Jitter of a fiftieth of a pixel, and stripes as strong as the noise."""

    def change(arrays):
        rng = np.random.default_rng(4)
        for k, (x, y) in enumerate(rng.normal(0, 0.02, (8, 2))):
            arrays["SCI"][k] += starlight((x, y)) - starlight()
        arrays["SCI"] += 0.5 * rng.normal(size=(8, SIDE, 1))

    got = cube(tmp_path / "x.fits", change)
    assert len(got) == 8
    assert got.valid.mean() > 0.9995


def test_every_integration_can_keep_its_place(tmp_path):
    def change(arrays):
        arrays["SCI"][0] = 0.0
        dim(arrays)

    path = calints(tmp_path / "x.fits", integrations=6, change=change)
    every, used = (dr.Observation.from_fits(path, every_integration=e) for e in (True, False))
    kept = every.valid.any(axis=(1, 2))
    assert kept.tolist() == [False, True, False, True, True, True]
    np.testing.assert_array_equal(every.data[kept], used.data)
    assert every.remarks == used.remarks


@cache
def star_at(place):
    """A source behind the mask, or beside it, on 161 x 161 pixels."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=256, fov_pixels=161)
    return model(dr.wavefront.random_opd(3, npix=256), place).double().detach().numpy()


def neighbour(contrast, separation, angle, size=0.0):
    """Add a source next to the star, by the image of the coronagraph's model, to real frames.

    An extended one has the `size`, in arcsec, as its standard deviation.
    """

    def change(hdus):
        place = separation * np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))])
        star, source = star_at((0.0, 0.0)), star_at(tuple(place))
        if size:
            source = gaussian_filter(source, size / 0.063)
        header, data = hdus["SCI"].header, hdus["SCI"].data
        x, y = (round(header[key]) - 1 for key in ("CRPIX1", "CRPIX2"))
        window = np.s_[:, y - 80 : y + 81, x - 80 : x + 81]
        rows, columns = np.indices(star.shape) - 80
        near = np.hypot(rows, columns) < 20
        flux = np.nansum(data[window][0][near]) / star[near].sum()
        data[window] += (contrast * flux * source).astype(data.dtype)

    return change


def real_roll(shared_data, path, change):
    """G 7-34 in F444W, an aligned file, changed."""
    name = "jw01184005001_03106_00001_nrcalong_calints.fits.gz"
    with fits.open(shared_data / "gto1184" / name) as hdus:
        change(hdus)
        hdus.writeto(path)
    return path


def field_stars(hdus):
    """300 stars anywhere, with peaks up to ten times as bright as the star behind the mask."""
    data, rng = hdus["SCI"].data, np.random.default_rng(11)
    ny, nx = data.shape[1:]
    light = np.zeros((ny, nx))
    for x, y in rng.uniform(0, 1, (300, 2)) * (nx, ny):
        light[int(y), int(x)] += 10 ** rng.uniform(-3, 1)
    light *= np.nanmax(data) * 2 * np.pi * 1.1**2
    data += gaussian_filter(light, 1.1).astype(data.dtype)


def edge_on_disk(hdus):
    """As bright as AU Mic's: beside G 7-34 it has 0.6 MJy/sr at 1 arcsec, and 0.36 at 2."""
    data, header = hdus["SCI"].data, hdus["SCI"].header
    rows, columns = np.indices(data.shape[1:])
    x, y = ((k - (header[key] - 1)) * 0.063 for k, key in ((columns, "CRPIX1"), (rows, "CRPIX2")))
    along, across = 0.6 * x + 0.8 * y, 0.8 * x - 0.6 * y
    light = 0.6 * np.maximum(np.abs(along), 0.3) ** -0.75 * np.exp(-((across / 0.12) ** 2) / 2)
    data += np.where(np.hypot(x, y) > 0.3, light, 0.0).astype(data.dtype)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "change",
    [
        neighbour(1e-3, 1.3, 100.0),
        neighbour(0.01, 0.5, 300.0),
        neighbour(0.1, 1.0, 200.0),
        pytest.param(neighbour(0.1, 0.3, 70.0), marks=SLOW),
        pytest.param(neighbour(0.1, 2.5, 250.0), marks=SLOW),
        neighbour(1e-2, 1.5, 130.0, size=0.25),
        field_stars,
        edge_on_disk,
    ],
    ids=["1e-3", "1e-2", "0.1", "close", "far", "galaxy", "300 field stars", "disk of AU Mic"],
)
def test_neighbours_and_extended_light_are_not_taken_for_the_star(shared_data, tmp_path, change):
    (frame,) = dr.ExposureSequence.from_files(
        real_roll(shared_data, tmp_path / "a.fits", change)
    ).science
    assert frame.first_pixel == (490, 1500)


@pytest.mark.parametrize("unocculted", [False, True])
def test_a_star_off_the_mask_is_refused_unless_the_user_insists(shared_data, tmp_path, unocculted):
    def change(hdus):
        data = hdus["SCI"].data.copy()
        if unocculted:
            neighbour(1.0, 1.5, 160.0)(hdus)
            hdus["SCI"].data -= data
            hdus["SCI"].data += np.random.default_rng(1).normal(size=data.shape) * hdus["ERR"].data
        else:
            hdus["SCI"].data[:] = np.roll(data, (17, -17), axis=(1, 2))

    path = real_roll(shared_data, tmp_path / "a.fits", change)
    with pytest.raises(
        NoValidPixelsError, match=r"a\.fits: its light is centred 1\.5.*with the.*star"
    ):
        dr.ExposureSequence.from_files(path)
    (frame,) = dr.ExposureSequence.from_files(path, star=(150.0, 174.5)).science
    # The whole pixels of the alignment are undone.
    assert np.abs((frame.center[0] - (150.0, 174.5) + 0.5) % 1 - 0.5).max() < 0.6


def test_a_place_of_the_star_is_in_its_frames(shared_data):
    """Of files of 320 x 320 pixels."""
    path = shared_data / "gto1184" / "jw01184003001_03106_00001_nrcalong_calints.fits.gz"
    for place in ((400.0, 10.0), (-5.0, 150.0), (150.0, 320.0)):
        words = rf"star: got x, y = {place[0]:g}, {place[1]:g}, expected a place in its 320 x 320"
        with pytest.raises(NoValidPixelsError, match=words):
            dr.ExposureSequence.from_files(path, star=place)


def test_a_place_of_the_star_is_two_numbers(folder):
    with pytest.raises(IncompatibleSetupError, match="star: got 'here', expected two finite"):
        dr.ExposureSequence.from_files(folder, star="here")


def without(path, name):
    with fits.open(path, mode="update") as hdus:
        del hdus[name]


def truncated(path):
    path.write_bytes(path.read_bytes()[:20000])


EMPTY = {"change": times(SCI=0.0)}


@pytest.mark.parametrize(
    ("facts", "spoil"),
    [
        ({"cards": OTHER}, lambda path: without(path, "SCI")),
        ({"cards": OTHER}, lambda path: without(path, "ERR")),
        ({"cards": OTHER}, truncated), ({"cards": OTHER | {"DRVERS": "0.1"}}, None),
        ({"cards": OTHER | {"PSFSUB": "pyKLIP"}}, None), (EMPTY | {"cards": OTHER}, None),
        (EMPTY | {"cards": {"FILTER": "F356W"}}, None), (EMPTY | {"star": "HD 9"}, None),
    ],
)  # fmt: skip
def test_files_that_cannot_be_used_do_not_vote(folder, facts, spoil):
    names = ["k0.fits", "k1.fits", "k2.fits"]
    for k, name in enumerate(names):
        path = another(folder, name, observation=20 + k, roll=90.0 + k, **facts)
        if spoil is not None:
            spoil(path)
    sequence = dr.ExposureSequence.from_files(folder)
    assert as_before(sequence)
    assert sorted(reasons(sequence)) == names
    assert all(reasons(sequence).values())


def test_frames_that_do_not_state_their_mask_are_no_measure_for_others(folder):
    (folder / SECOND).unlink()
    path = folder / FIRST
    for key in ("CORONMSK", "APERNAME", "SUBARRAY"):
        fits.delval(path, key)
    sequence = dr.ExposureSequence.from_files(folder)
    assert uses(sequence)[FIRST] == "target"
    (reason,) = reasons(sequence).values()
    assert "mask is MASK335R, which they do not state; add the card" in reason


def test_segments_of_an_exposure_are_one_roll(folder):
    calints(folder / "seg2.fits", cards={"EXSEGNUM": 2}, date="2022-10-03T06:20:00", integrations=2)
    sequence = dr.ExposureSequence.from_files(folder)
    first, second = sequence.science
    assert (first.count, second.count) == (3, 1)
    assert first.name == f"{FIRST} and 1 more"
    assert len(first.noise_ratios) == len(first) == 2
    assert first.cutout(40).combined().count == 3
    rows = {row["file"]: (row["use"], row["integrations"]) for row in sequence.table}
    assert rows["seg2.fits"] == ("target", 2)
