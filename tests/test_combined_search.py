"""One search over filters and epochs: exact, calibrated, and honest about what it leaves out."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.coordinates import GCRS, SkyCoord
from astropy.table import QTable
from astropy.time import Time
from scipy import stats

import pyklip_diffrender as dr
from benchmarks.reliability import reliability, system
from benchmarks.synthetic_searches import CURVATURE, PIXEL, found, noise, searched
from pyklip_diffrender.detection import Motion, checked_motion
from pyklip_diffrender.detection.combined_result import scales_of, star_of_filter, unmoved
from pyklip_diffrender.detection.error_factor import ErrorFactor, structures_in_single_roll
from pyklip_diffrender.detection.sky_map import Family, SkyStack
from pyklip_diffrender.errors import IncompatibleSetupError, UnitError
from pyklip_diffrender.instrument import planet_spectra
from pyklip_diffrender.linear.model import LinearModel, Unknown
from pyklip_diffrender.reduction.several import search_together

MOTION = (0.3, -0.2)
YEAR = 365.25


def fitted(filter, wavelength, seed):
    """A small frame of a star, searched, with maps in double precision at its pixels."""
    model = dr.nircam_coronagraph(filter, monochromatic=wavelength, npix=64, fov_pixels=16)
    opd = dr.wavefront.random_opd(1, npix=64)
    frame = dr.simulate(model, dr.Scene(), opd, seed=seed)
    frame = replace(frame, position_angles=np.array([40.0]))
    return dr.detect(dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=3)))


@pytest.fixture(scope="module")
def pair():
    return [fitted("F444W", 4.4e-6, 1), fitted("F356W", 3.6e-6, 2)]


def stacked(models):
    """One model of the data of several, whose unknowns are independent."""
    unknowns, frames, count = [], [], 0
    for model in models:
        for each in model.unknowns:
            unknowns.append(Unknown(f"{count} {each.name}"[:20], each.component, each.frame))
        for each in model.frames:
            frames.append(replace(each, rows=each.rows + count, drift=each.drift + count))
        count += len(model.unknowns)
    columns = (
        torch.cat([getattr(each, name) for each in models])
        for name in ("vector", "mean", "deviation")
    )
    return LinearModel(
        tuple(unknowns), tuple(frames), *columns,
        torch.block_diag(*(each.curvature for each in models)),
    )  # fmt: skip


def test_it_is_the_joint_likelihood_of_all_frames(pair):
    """Amplitudes of spectra equal those of one linear model of both data sets."""
    grid = pair[0].grid
    offsets = torch.from_numpy(grid.reshape(-1, 2))
    exact = []
    for each in pair:
        products = each.templates.linear.weigh(each.templates.at(offsets))
        information = products.information.numpy().reshape(grid.shape[:2])
        contrast = products.numerator.numpy().reshape(grid.shape[:2]) / information
        snr = contrast * np.sqrt(information)
        exact.append(
            replace(
                each, contrast=contrast, error=information**-0.5, snr=snr, residual_snr=snr,
                error_factor=ErrorFactor.constant(1.0), grid=grid,
            )
        )  # fmt: skip
    both = dr.combine(exact, star="A2V, K=6.77", spectra=["blackbody", "flat", "free"])
    assert both.unit == "Jy"
    pixels = [(3, 4), (12, 2), (7, 13)]
    places = np.array([both.maps[0].on_sky(grid[pixel]) for pixel in pixels])
    scales = scales_of(both.maps, both.unit)
    filters = both.spectra.filters
    stack = SkyStack.of(both.maps, filters, scales, places, unmoved(both.maps))
    snr = np.einsum("kfn,fn->kn", stack.weights(both.spectra.flux), stack.snr)
    amplitude_error = stack.amplitude_errors(both.spectra.flux)
    joint = stacked([each.templates.linear for each in pair])
    at = torch.from_numpy(np.array([grid[pixel] for pixel in pixels]))
    images = [each.templates.at(at)[0] for each in pair]
    stars = [
        dr.instrument.star_flux_density("A2V, K=6.77", name).value for name in ("F444W", "F356W")
    ]
    for k, flux in enumerate(both.spectra.flux):
        templates = {f: flux[f] / stars[f] * image for f, image in enumerate(images)}
        matrix, vector = joint.normal_equations(templates)
        information = matrix.diagonal().numpy()
        np.testing.assert_allclose(amplitude_error[k], information**-0.5, rtol=1e-8)
        # The vector is the amplitude times the information, and the S/N that over its root.
        assert np.all(np.abs(snr[k] - vector.numpy() / np.sqrt(information)) < 1e-8)
    # Free fluxes are those of both templates fitted together, which do not share pixels.
    zero, step = torch.zeros_like(images[0]), len(pixels)
    apart = {0: torch.cat([images[0], zero]), 1: torch.cat([zero, images[1]])}
    matrix, vector = joint.normal_equations(apart)
    both_fluxes = torch.linalg.solve(matrix[::step, ::step], vector[::step]).numpy()
    of_star = np.array([star_of_filter(both.maps, name, scales) for name in filters])
    measured, errors = stack.flux[:, 0] / of_star, stack.error[:, 0] / of_star
    assert np.all(np.abs(measured - both_fluxes) < 1e-8 * np.array(errors))


def test_a_combination_of_products_is_that_of_the_detections(pair, tmp_path):
    for each in pair:
        each.write(tmp_path / str(each.observation.filter))
    folders = [tmp_path / "F444W", tmp_path / "F356W"]
    live, read = dr.combine(pair), dr.combine(folders)
    np.testing.assert_allclose(read.snr, live.snr, atol=1e-9)
    assert read.to_dict() == live.to_dict()
    # The star is not known in photons: its own spectrum, and the result says so.
    assert read.spectra.names == ("as the star",)
    assert "--star-sed" in read.remarks[0]
    paths = read.write(tmp_path / "both")
    names = ["combined.fits", "combined_candidates.ecsv", "combined_limits.ecsv"]
    assert [each.name for each in paths] == names
    limits = QTable.read(paths[2])
    assert limits.meta["sigmas"] == pytest.approx(read.limits.meta["sigmas"])
    assert 0 < limits["contrast"].min() < limits["contrast"].max() < 1e-2
    json.dumps(read.to_dict(), allow_nan=False)
    with pytest.raises(FileExistsError):
        read.write(tmp_path / "both")
    by_command = search_together(folders, spectra=("free",))
    assert list(by_command.thresholds) == ["all filters, spectra", "all filters, free"]
    # The reductions are finished, so that a search that is not possible is no error.
    assert "expected two or more" in search_together(folders[:1])


def test_a_planet_too_faint_for_each_filter_is_a_candidate_of_both():
    place = (0.6, 0.35)
    one = searched("F444W", 1, [(*place, 4.2)], north=20.0)
    two = searched("F356W", 2, [(*place, 4.0)], north=-35.0)
    both = dr.combine([one, two])
    assert one.snr.max() < 5
    assert two.snr.max() < 5
    assert len(both.candidates) == 1
    row = both.candidates[0]
    moved = np.hypot(row["delta_ra"].value - place[0], row["delta_dec"].value - place[1])
    error = math.hypot(row["delta_ra_error"].value, row["delta_dec_error"].value)
    assert moved < 3 * error < 0.1
    # Combined noise has the standard deviation 1, so that 4.1 sqrt(2) is met within three.
    assert row["snr"] == pytest.approx(4.1 * math.sqrt(2), abs=3)
    assert row["false_alarm_probability"] < 0.01
    for name in ("F444W", "F356W"):
        pull = (row[f"contrast_{name}"] - 4.1e-6) / row[f"contrast_error_{name}"]
        assert abs(pull) < 3
        assert row[f"flux_density_{name}"].value == pytest.approx(row[f"contrast_{name}"])
    assert both.thresholds["all filters, spectra"] > 5


def test_the_colour_says_which_spectrum():
    """A planet of 250 K has a tenth of its flux in F356W."""
    cold = searched("F444W", 1, [(0.6, 0.3, 30.0)], known=True)
    none = searched("F356W", 2, [(0.6, 0.3, 2.9)])
    both = dr.combine([cold, none], spectra="blackbody")
    temperature = int(both.candidates["spectrum"][0].split()[3])
    assert 150 <= temperature <= 300
    assert both.candidates["spectrum_chi2"][0] < 9
    warm = dr.combine([cold, searched("F356W", 2, [(0.6, 0.3, 30.0)], known=True)])
    (spectrum,) = warm.candidates["spectrum"]
    assert spectrum in ("black body of 1200 K", "black body of 1500 K", "flat")


def test_a_source_of_one_filter_alone_is_found_with_free_fluxes_and_keeps_its_flux():
    """A methane planet, bright at 4.4 micron only, among spectra that have light in both."""
    one = searched("F444W", 1, [(0.6, 0.3, 12.0)], known=True)
    two = searched("F356W", 3, [(0.6, 0.3, -6.0)])
    both = dr.combine([one, two], spectra=["flat", "free"])
    assert both.candidates["spectrum"][0] == "free"
    assert both.candidates["snr_F444W"][0] == pytest.approx(12, abs=0.05)


def test_errors_that_are_hardly_known_need_a_higher_peak():
    known, unsure = (
        dr.combine([searched(name, seed, [(0.6, 0.35, 5.0)], freedom=freedom)
                    for name, seed in (("F444W", 1), ("F356W", 2))])
        for freedom in (np.inf, 8.0)
    )  # fmt: skip
    assert len(known.candidates) == 1
    assert len(unsure.candidates) == 0
    np.testing.assert_allclose(known.snr, unsure.snr)


def test_structures_of_the_detector_pass_for_sources_where_all_frames_have_one_roll():
    def candidate(north):
        maps = [
            searched(name, k, [(0.6, 0.35, 5.5)], north=angle, header={"INSTRUME": "NIRCAM"})
            for k, (name, angle) in enumerate((("F444W", 0.0), ("F356W", north)), 1)
        ]
        return dr.combine(maps).candidates[0]

    alike, turned = candidate(0.5), candidate(10.0)
    structures = float(structures_in_single_roll(alike["snr"]))
    assert structures > 1e-3
    assert alike["false_alarm_probability"] == pytest.approx(structures, rel=0.1)
    assert turned["false_alarm_probability"] < 0.01 * structures


def test_a_bad_fit_is_left_out_and_its_candidates_with_it():
    bad = searched("F444W", 1, [(0.6, 0.3, 40.0)], status="MODEL_MISMATCH", known=True)
    good = [searched("F356W", 2), searched("F300M", 3)]
    both = dr.combine([bad, *good])
    assert len(both.candidates) == 0
    assert [each.filter for each in both.maps] == ["F356W", "F300M"]
    ((name, reason),) = both.left_out
    assert name.startswith("F444W")
    assert "MODEL_MISMATCH" in reason
    with pytest.raises(IncompatibleSetupError, match=r"expected two or more .*MODEL_MISMATCH"):
        dr.combine([bad, good[0]])


def test_a_fit_with_scaled_errors_takes_part_and_is_named():
    """Its noise is measured, so that the search is the same as that of a fit that converged."""
    sources, wide = [(0.6, 0.3, 7.0)], {"freedom": 60.0, "factor": 1.5}
    other = searched("F356W", 2, sources)
    both = dr.combine([searched("F444W", 1, sources, status="PRIOR_MISMATCH", **wide), other])
    usual = dr.combine([searched("F444W", 1, sources, **wide), other])
    np.testing.assert_array_equal(both.snr, usual.snr)
    assert len(both.candidates) == len(usual.candidates) == 1
    assert not both.left_out
    (remark,) = set(both.remarks) - set(usual.remarks)
    assert "F444W 2023-02-25 (PRIOR_MISMATCH, errors multiplied by 1.50)" in remark


def test_frames_count_once():
    """Two reductions of one frame, as with other options, are not two observations."""
    one = searched("F444W", 1, [(0.6, 0.3, 4.0)])
    again, other = searched("F444W", 1, [(0.6, 0.3, 4.0)], error=2e-6), searched("F356W", 2)
    both = dr.combine([one, again, other])
    assert [each.filter for each in both.maps] == ["F444W", "F356W"]
    ((name, reason),) = both.left_out
    assert (name, reason) == ("F444W 2023-02-25 (2)", "its frames are also in F444W 2023-02-25")
    np.testing.assert_array_equal(both.snr, dr.combine([one, other]).snr)
    with pytest.raises(IncompatibleSetupError, match=r"of which 1 can be used.*are also in"):
        dr.combine([one, again])


def test_what_cannot_be_combined_is_refused_with_the_reason(tmp_path):
    one = searched("F444W", 1, header={"TARGPROP": "HD 1", "TARG_RA": 10.0, "TARG_DEC": 5.0})
    other = searched("F356W", 2, header={"TARGPROP": "HD 2", "TARG_RA": 90.0, "TARG_DEC": 5.0})
    short = tmp_path / "short.txt"
    short.write_text("# micron Y T\n3.0 1 1\n3.5 2 nan\n4.2 3 2\n", encoding="utf-8")
    good = [searched("F444W"), searched("F356W")]
    for reductions, spectra, words in (
        ([one, other], None, "HD 1 and HD 2"),
        ([good[0], searched("F356W", north=None)], None, "no position angle"),
        ([good[0], searched("F444W", 2, mjd=60400.0)], None, "proper_motion="),
        ([3, 4], None, "expected a Reduction"),
        (good, [], "spectra: got none"),
        (good, str(short), "Y: .* F444W needs"),
    ):
        with pytest.raises(IncompatibleSetupError, match=words):
            dr.combine(reductions, **({} if spectra is None else {"spectra": spectra}))


def test_spectra_come_from_a_table_of_model_atmospheres(tmp_path):
    wave = np.linspace(2.5, 5.6, 200)
    table = QTable({
        "wavelength": wave * u.micron,
        "blue": wave**-4 * u.Unit("W / (m2 um)"),  # Per frequency wave^-2.
        "cut": np.where(wave < 4, wave, np.nan) * u.Unit("W / (m2 um)"),
    })  # fmt: skip
    path = tmp_path / "atmospheres.ecsv"
    table.write(path)
    spectra = planet_spectra(path, ["F356W", "F444W"])
    assert spectra.names == ("blue",)
    assert spectra.left_out[0][0] == "cut"
    # The mean of wave^-2 over a filter is near that at its mean wavelength.
    assert spectra.flux[0] == pytest.approx([1, (3.56 / 4.40) ** 2], rel=0.02)
    cold = planet_spectra("blackbody", ["F356W", "F444W"]).flux[0]
    x = {w: 14387.77 / (w * 150) for w in (3.56, 4.40)}
    ratio = (4.40 / 3.56) ** 3 * np.expm1(x[4.40]) / np.expm1(x[3.56])
    # Steep over a filter, so that its mean is that of a longer wavelength.
    assert ratio < cold[0] < 3 * ratio


@pytest.mark.parametrize("count", [1, 4])
def test_free_fluxes_at_one_place_follow_chi_bar_squared(count):
    stack = SkyStack(
        np.zeros((count, 1)), np.zeros((count, 1)), np.ones((count, 1)), np.zeros((count, 2, 2))
    )
    for level in (1.0, 2.5, 5.0):
        rare = sum(
            math.comb(count, k) / 2**count * stats.chi.sf(level, k) for k in range(1, count + 1)
        )
        assert Family(None, stack, 1.0).expected(level) == pytest.approx(rare, rel=1e-9)


def test_noise_has_as_many_peaks_as_expected():
    """Fine maps of noise: the share with a peak above a level, for black bodies and free fluxes."""
    count, side, names = 500, 40, ("F444W", "F356W")
    errors = np.array([[1.0], [0.6]])
    spectra = planet_spectra(["blackbody", "flat"], names).flux
    stack = SkyStack(
        np.zeros((len(names), side**2)), np.zeros((len(names), side**2)),
        errors * np.ones((1, side**2)), CURVATURE * np.tile(np.eye(2), (len(names), 1, 1)),
    )  # fmt: skip
    highest = {"listed": [], "free": []}
    families = {"listed": Family(spectra, stack, PIXEL**2), "free": Family(None, stack, PIXEL**2)}
    for k in range(count):
        maps = np.stack([noise(5 * k + f, side).ravel() for f in range(len(names))])
        for name, family in families.items():
            highest[name].append(family.statistic(replace(stack, sigmas=maps)).max())
    for name, family in families.items():
        for level in (4.0, 4.5):
            share = np.mean(np.array(highest[name]) > level)
            expected = -math.expm1(-family.expected(level))
            # Pixels miss the tops of peaks, and the bound is one of expectations: it may be high.
            spread = math.sqrt(expected / count)
            assert share - 3 * spread < expected < 1.5 * share + 4 * spread, (name, level, share)


def test_parallax_and_proper_motion_are_those_of_astropy():
    star = SkyCoord(80.0 * u.deg, -30.0 * u.deg, distance=10 * u.pc)
    motion = Motion(MOTION, 0.1, (80.0, -30.0))
    before, after = 59900.0, 59990.0
    seen = []
    for mjd in (before, after):
        frame = GCRS(obstime=Time(mjd, format="mjd"))
        far = SkyCoord(80.0 * u.deg, -30.0 * u.deg, distance=1e9 * u.pc).transform_to(frame)
        east, north = far.spherical_offsets_to(star.transform_to(frame))
        # At the telescope, 1 % farther from the Sun than the Earth.
        seen.append(1.01 * np.array([east.to_value("arcsec"), north.to_value("arcsec")]))
    expected = -(seen[1] - seen[0]) - np.array(MOTION) * 90 / YEAR
    np.testing.assert_allclose(motion.background(before, after), expected, atol=5e-4)


def epochs(first, second, seed=0):
    """A source at two epochs, 400 days from each other."""
    return [
        searched("F444W", 2 * seed + 1, [first], mjd=59900.0),
        searched("F444W", 2 * seed + 2, [second], mjd=60300.0, north=25.0),
    ]


def test_epochs_tell_companions_from_the_background():
    moved = -np.array(MOTION) * 400 / YEAR
    start = np.array([0.5, 0.45])
    bound = dr.combine(epochs((*start, 9.0), (*start, 9.0)), proper_motion=MOTION)
    assert list(bound.candidates["verdict"]) == ["moves with the star"]
    assert bound.candidates["ln_evidence_ratio"][0] > 5
    sky = dr.combine(epochs((*start, 9.0), (*(start + moved), 9.0)), proper_motion=MOTION)
    assert list(sky.candidates["verdict"]) == ["stays on the sky: a source in the background"]
    assert sky.candidates["search"][0] == "all epochs, on the sky"
    assert sky.candidates["ln_evidence_ratio"][0] < -5
    elsewhere = epochs((*start, 9.0), (-0.6, -0.5, 9.0))
    neither = dr.combine(elsewhere, proper_motion=MOTION)
    verdicts = set(neither.candidates["verdict"])
    assert verdicts == {"neither moves with the star nor stays on the sky"}
    assert any("parallax" in each for each in neither.remarks)
    still = dr.combine(epochs((*start, 9.0), (*start, 9.0)), proper_motion=(0.004, 0.0))
    assert list(still.candidates["verdict"]) == ["not decided"]
    assert still.candidates["probability_neither"][0] < 0.01


def test_a_faint_companion_is_found_in_the_sum_of_epochs():
    start = (0.5, 0.45, 4.4)
    both = dr.combine(epochs(start, start, seed=3), proper_motion=MOTION)
    assert len(both.candidates) == 1
    assert both.candidates["search"][0] == "all epochs, with the star"
    # Free fluxes of a single filter are no family of their own.
    assert all(name.endswith("spectra") for name in both.thresholds)


SKY = -np.array(MOTION) * 400 / YEAR
"""How far a source in the background moves beside the star in 400 days."""

ONE, TWO, THREE = np.array([0.5, 0.45]), np.array([-0.6, 0.3]), np.array([-0.2, -0.8])


def at_epochs(*sources, listed=True):
    """Searches of 400 days apart; sources are lists of (east, north, S/N) by epoch."""
    return [
        found(
            "F444W", 7 + k, present, mjd=59900.0 + 400 * k, north=25.0 * k,
            threshold=5.0 if listed else np.inf,
        )
        for k, present in enumerate(sources)
    ]  # fmt: skip


def verdicts(reductions, **options):
    """Verdicts by the place of the candidate at the epoch to which it belongs."""
    table = dr.combine(reductions, proper_motion=MOTION, **options).candidates
    places = (table[name].value.round(1).tolist() for name in ("delta_ra", "delta_dec"))
    return dict(zip(zip(*places, strict=True), table["verdict"], strict=True))


BOUND = "moves with the star"
BACKGROUND = "stays on the sky: a source in the background"
NEITHER = "neither moves with the star nor stays on the sky"


TWO_PLACE = tuple(TWO.tolist())


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        # The light of the brighter one of two companions is no place of the fainter one.
        ([(*ONE, 12.0), (*TWO, 15.0)], [(*ONE, 12.0), (*TWO, 15.0)],
         {(0.5, 0.5): BOUND, TWO_PLACE: BOUND}),
        # A companion beside a background star.
        ([(*ONE, 12.0), (*TWO, 20.0)], [(*ONE, 12.0), (*(TWO + SKY), 20.0)],
         {(0.5, 0.5): BOUND, TWO_PLACE: BACKGROUND}),
        # One is seen at the first epoch only, one at the second, and a companion at both.
        ([(*ONE, 12.0), (*TWO, 14.0)], [(*ONE, 12.0), (*THREE, 13.0)],
         {(0.5, 0.5): BOUND, TWO_PLACE: NEITHER, (-0.2, -0.8): NEITHER}),
    ],
    ids=["two companions", "background", "come and go"],
)  # fmt: skip
@pytest.mark.parametrize("listed", [True, False])
def test_one_source_is_not_explained_by_another(first, second, expected, listed):
    found = verdicts(at_epochs(first, second, listed=listed))
    # A source in the background has a place at either epoch.
    at_second = tuple((TWO + SKY).round(1).tolist())
    assert {TWO_PLACE if place == at_second else place: v for place, v in found.items()} == expected


def test_a_faint_companion_next_to_one_a_hundred_times_brighter():
    """At 1.5 lambda/D, where a single search separates them."""
    beside = ONE + np.array([0.21, 0.0])
    both = dr.combine(
        at_epochs(*(2 * [[(*ONE, 8.0), (*beside, 800.0)]])), proper_motion=MOTION
    ).candidates
    assert list(both["verdict"]) == [BOUND, BOUND]
    # In the mean of both epochs the error of a contrast is that of one over the root of two.
    assert both["contrast_F444W"][1] == pytest.approx(8e-6, abs=4 * 1e-6 / math.sqrt(2))
    assert both["contrast_F444W"][0] == pytest.approx(8e-4, abs=4 * 1e-6 / math.sqrt(2))


def test_a_source_that_leaves_the_field_is_not_decided_against():
    """In the background, it would be outside at the second epoch, where nothing is known."""
    edge = np.array([-1.7, 0.2])
    gone = dr.combine(at_epochs([(*edge, 15.0), (*ONE, 9.0)], [(*ONE, 9.0)]), proper_motion=MOTION)
    row = gone.candidates[
        np.argmax(gone.candidates["snr_F444W"] * (gone.candidates["delta_ra"] < 0))
    ]
    assert row["probability_bound"] < 1e-6
    assert row["probability_background"] == pytest.approx(row["probability_neither"], rel=0.1)


def test_five_sources_at_four_epochs_keep_their_identities():
    """Two companions, two background stars, and one that is seen once, crossing each other."""
    stars = [np.array([0.6, -0.3]), np.array([-0.4, -0.9])]
    moved = [[(*ONE, 9.0), (*TWO, 30.0)] + [(*(s + k * SKY / 2), 15.0) for s in stars]
             for k in range(4)]  # fmt: skip
    moved[2].append((*THREE, 11.0))
    reductions = [
        found("F444W", 70 + k, present, mjd=59900.0 + 200 * k, north=25.0 * k)
        for k, present in enumerate(moved)
    ]
    both = dr.combine(reductions, proper_motion=MOTION)
    assert sorted(both.candidates["verdict"]) == sorted(2 * [BOUND] + 2 * [BACKGROUND] + [NEITHER])
    assert sorted(np.unique(both.sightings["candidate"], return_counts=True)[1]) == [1, 4, 4, 4, 4]


def test_a_place_is_where_the_signal_is_highest():
    """Degrees of freedom that rise from 15 to 180 in an arcsec: significance peaks elsewhere."""
    x = np.linspace(-1.89, 1.89, 61)
    freedom = 15 + 165 * np.clip(np.hypot(*np.meshgrid(x, x)), 0, 1)
    places = [(0.3, 0.5), (-0.5, 0.6), (0.1, -0.9)]
    sources = [(*place, snr) for place, snr in zip(places, (30.0, 45.0, 95.0), strict=True)]
    for listed in (5.0, np.inf):
        both = dr.combine([
            found(name, k, sources, freedom=freedom, threshold=listed)
            for k, name in enumerate(("F444W", "F356W"))
        ]).candidates  # fmt: skip
        assert len(both) == 3
        for place, snr in zip(places, (30.0, 45.0, 95.0), strict=True):
            away = np.hypot(both["delta_ra"].value - place[0], both["delta_dec"].value - place[1])
            row = both[np.argmin(away)]
            # Noise moves a peak of S/N z in one filter by 1 / (z sqrt(L)) in each direction.
            assert away.min() < 4 / (snr * math.sqrt(CURVATURE))
            assert row["contrast_F444W"] == pytest.approx(snr * 1e-6, abs=4e-6)


def test_a_motion_that_no_star_has_is_refused():
    mas = u.mas
    assert checked_motion(None, 45 * mas, 1.0) == (None, pytest.approx(0.045), 1.0)
    proper, parallax, _ = checked_motion(("377 mas/yr", "-90 mas/yr"), "70 mas")
    assert proper == pytest.approx((0.377, -0.09))
    assert parallax == pytest.approx(0.07)
    # An empty proposal has zeros.
    assert checked_motion((0.0, 0.0), 0)[0] is None
    for motion, words in (
        (((377.0, -90.0), None), "377 mas/yr"),
        ((None, 70.0), "70 mas"),
        ((None, "a lot"), "'a lot'"),
        (((0.1, 0.2, 0.3), None), r"shape \(3,\)"),
    ):
        with pytest.raises(IncompatibleSetupError, match=words):
            checked_motion(*motion)
    with pytest.raises(UnitError, match="arcsec"):
        checked_motion(None, 3 * u.pc)
    with pytest.raises(IncompatibleSetupError, match="proper_motion: got 377"):
        dr.combine([searched("F444W"), searched("F356W")], proper_motion=(377.0, 0.0))


def test_coordinates_of_other_epochs_are_of_one_star():
    """A star that moves by 4.5 arcsec a year, with coordinates of 2000 and of 2023."""
    year = 4.5 / 3600

    def dated(mjd, declination, motion):
        cards = {
            "TARGPROP": "fast", "TARG_RA": 80.0, "TARG_DEC": declination, "MU_RA": 0.0,
            "MU_DEC": motion, "MU_EPOCH": "2000.0", "DATE-BEG": Time(mjd, format="mjd").isot,
        }  # fmt: skip
        return found("F444W", int(mjd), [(*ONE, 12.0)], mjd=mjd, header=cards)

    both = dr.combine([dated(59900.0, -30.0, 4.5), dated(60300.0, -30.0 + 24.0 * year, 4.504)])
    # The mean of headers that hardly differ.
    assert both.motion.proper == pytest.approx((0.0, 4.502))
    assert list(both.candidates["verdict"]) == [BOUND]


def test_a_candidate_below_the_threshold_of_the_combination_is_named():
    """The threshold of two filters is 5.3, that of each is 5."""
    one = found("F444W", 3, [(*ONE, 5.2)], threshold=4.0)
    both = dr.combine([one, searched("F356W", 2)])
    assert len(one.candidates) == 1
    assert (len(both.candidates), len(both.remarks)) in ((0, 1), (1, 0))
    low = found("F444W", 3, [(*ONE, 4.4)], threshold=4.0)
    both = dr.combine([low, searched("F356W", 2)])
    assert len(both.candidates) == 0
    assert "below the threshold of the combined search" in both.remarks[0]


@pytest.mark.slow
@pytest.mark.parametrize(("epochs", "filters", "count"), [(2, 1, 40), (3, 2, 8)])
def test_probabilities_are_frequencies(epochs, filters, count):
    """Systems of one to five sources of S/N 5 to 25, with slow stars, so that many are unclear."""
    result = reliability([system(seed, epochs, filters) for seed in range(count)])
    assert result.unexplained == 0
    for low, high in ((0.0, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 1.01)):
        chosen = (result.stated >= low) & (result.stated < high)
        expected, variance = result.stated[chosen].sum(), (
            result.stated * (1 - result.stated))[chosen].sum()  # fmt: skip
        # Hypotheses about one source are not independent: a factor of two in the variance.
        assert abs(result.true[chosen].sum() - expected) < 1 + 3 * math.sqrt(2 * variance)
    # Known to 1 / sqrt(2 n), a tenth or so.
    assert np.std(result.place_pulls) == pytest.approx(1, abs=0.2)
    assert np.std(result.flux_pulls) == pytest.approx(1, abs=0.25)


@pytest.mark.slow
def test_a_crowded_field_has_no_wrong_verdict():
    """Twenty-five sources, orbits of 0.3 arcsec: more associations than can be compared."""
    rng = np.random.default_rng(0)
    places, heights = rng.uniform(-2, 2, (25, 2)), np.exp(rng.uniform(*np.log([6, 60]), 25))
    bound = rng.random(25) < 0.3
    proper = np.array([0.05, -0.08])
    reductions = [
        found(
            "F444W", k, mjd=59900 + 3 * YEAR * k, side=81, north=30.0 * k,
            sources=[(*(place - 3 * k * proper * (not own)), height)
                     for place, own, height in zip(places, bound, heights, strict=True)],
        )
        for k in range(2)
    ]  # fmt: skip
    table = dr.combine(reductions, proper_motion=proper, parallax=0.1).candidates
    assert len(table) == 25
    for row in table:
        start = np.array([row["delta_ra"].value, row["delta_dec"].value])
        start = start + (row["epoch_mjd"] - 59900) / YEAR * proper * np.array([[0.0], [1.0]])
        away = np.hypot(*(places[None] - start[:, None]).transpose(2, 0, 1))
        source = int(np.argmin(away[[0, 1], :].min(axis=0)))
        allowed = {BOUND if bound[source] else BACKGROUND, "not decided"}
        assert row["verdict"] in allowed


@pytest.mark.slow
def test_orbits_allow_a_bound_source_to_move():
    """At 0.7 arcsec and 10 pc a circular orbit moves by 0.24 arcsec a year."""
    start = np.array([0.5, 0.45])
    moved = start + np.array([0.12, -0.13])
    found = epochs((*start, 12.0), (*moved, 12.0))
    fixed = dr.combine(found, proper_motion=(1.0, 1.0))
    assert "moves with the star" not in fixed.candidates["verdict"]
    orbit = dr.combine(found, proper_motion=(1.0, 1.0), parallax=0.1)
    assert set(orbit.candidates["verdict"]) == {"moves with the star"}
    assert len(orbit.candidates) == 1


@pytest.mark.slow
def test_false_candidates_are_as_rare_as_those_of_a_single_search():
    """Thresholds lowered to 3.6, so that many searches of noise have a candidate."""
    count, level = 80, 3.6
    false = single = 0
    for seed in range(count):
        maps = [searched("F444W", 3 * seed, north=10.0), searched("F356W", 3 * seed + 1)]
        both = dr.combine(maps, threshold=level)
        false += len(both.candidates) > 0
        single += maps[0].snr.max() > level
    # Peaks between the pixels are searched, which a single map's pixels miss; and the bound on the
    # trials is generous.
    assert abs(false - single) < 4 * math.sqrt(single) + 0.3 * single
    assert false > 0.5 * single
