"""Two searches of the same frames are joined: at every separation, the one of the deeper limit."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.detection import deeper, stated_limits
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import separation_of
from pyklip_diffrender.reduction import visit
from pyklip_diffrender.refinement import Status

PLANETS = (dr.Planet(4e-5, 0.45, 30.0), dr.Planet(2e-5, 0.8, 200.0))
EDGE = 0.65


@cache
def searches():
    """The same frame, fitted with fewer and with more modes."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=128, fov_pixels=36)
    opd = dr.wavefront.random_opd(1, npix=128)
    frame = dr.simulate(model, dr.Scene(planets=PLANETS), opd, seed=3)
    fits = (dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=n)) for n in (6.0, 8.0))
    return tuple(dr.detect(fit) for fit in fits)


def with_factor(detection, factor):
    """A search whose errors are multiplied by a factor of the separation."""
    factors = factor(separation_of(detection.grid))
    curve = detection.contrast_curve.copy()
    at = factor(curve["separation"].value)
    for name in ("contrast", "lowest", "highest", "small_sample"):
        curve[name] = at * curve[name]
    return replace(
        detection,
        error=factors * detection.error,
        snr=detection.snr / factors,
        residual_snr=detection.residual_snr / factors,
        error_factor=ErrorFactor(factors, np.full(factors.shape, 1e6), detection.grid),
        contrast_curve=curve,
    )


def pair():
    """Searches of which the first is the deeper within `EDGE`, and the second beyond."""
    first, second = searches()
    return (
        with_factor(first, lambda r: np.where(r > EDGE, 2.0, 1.0)),
        with_factor(second, lambda r: np.where(r > EDGE, 1.0, 2.0)),
    )


def fluxes(detection):
    """Flux of every candidate by separation, and its S/N."""
    flux, table = detection.fit.frames[0].star_light, detection.candidates
    order = np.argsort(table["separation"])
    return flux * np.asarray(table["contrast"])[order], np.asarray(table["snr"])[order]


def test_limits_are_the_deeper_ones():
    first, second = pair()
    joined = deeper(first, second)
    at, limits = stated_limits(joined)
    smaller = np.minimum(stated_limits(first)[1], stated_limits(second)[1])
    np.testing.assert_allclose(limits, smaller, rtol=1e-12)
    np.testing.assert_array_equal(limits < stated_limits(first)[1], at > EDGE)
    magnitudes = joined.contrast_curve["delta_mag"].value
    np.testing.assert_allclose(10 ** (-0.4 * magnitudes), joined.contrast_curve["contrast"])
    # In units of flux, the map has the errors of the one or the other.
    star = [each.fit.frames[0].star_light for each in (first, second)]
    away = separation_of(joined.grid)
    for part, search, unit in ((away < 0.5, first, star[0]), (away > 0.7, second, star[1])):
        expected = unit * search.error[part]
        np.testing.assert_allclose(star[0] * joined.error[part], expected, rtol=1e-12)


def test_candidates_are_of_the_deeper_search_and_none_is_there_twice():
    first, second = pair()
    joined = deeper(first, second)
    (near, _), (near_snr, _) = fluxes(first)
    (_, far), (_, far_snr) = fluxes(second)
    values, snr = fluxes(joined)
    np.testing.assert_allclose(values, [near, far], rtol=1e-12)
    np.testing.assert_allclose(snr, [near_snr, far_snr], rtol=1e-9)
    assert len(joined.false_alarm) == 2
    # The place of a planet, and with it its search, is that of the first search.
    only = deeper(first, replace(second, sources=second.sources.without(0).without(0)))
    assert len(only.candidates) == 1


def test_measurements_are_those_of_the_deeper_search():
    first, second = pair()
    joined = deeper(first, second)
    places = [[0.3, 0.3], [-0.7, 0.4]]
    star = [each.fit.frames[0].star_light for each in (first, second)]
    measured = joined.measure(places)
    for k, (search, unit) in enumerate(((first, star[0]), (second, star[1]))):
        row = search.measure(places)[k]
        for name in ("contrast", "contrast_error"):
            assert star[0] * measured[name][k] == pytest.approx(unit * row[name], rel=1e-9)
        assert measured["snr"][k] == pytest.approx(row["snr"], rel=1e-9)


def test_a_search_that_is_nowhere_deeper_changes_nothing():
    first, second = searches()
    worse = with_factor(second, lambda r: np.full_like(r, 3.0))
    assert deeper(first, worse) is first


def test_the_joined_search_is_read_as_it_was_written(tmp_path):
    joined = deeper(*pair())
    joined.write(tmp_path)
    for name, search in (("fit.fits", joined), ("fit_other.fits", joined.other)):
        search.fit.write(tmp_path / name, linear=True)
    again = dr.Detection.read(tmp_path)
    np.testing.assert_array_equal(again.of_other, joined.of_other)
    for name in ("separation", "contrast", "snr", "position_angle"):
        np.testing.assert_allclose(again.candidates[name], joined.candidates[name], rtol=1e-12)
    places = [[0.3, 0.3], [-0.7, 0.4]]
    for name in ("contrast", "contrast_error", "snr"):
        expected = joined.measure(places)[name]
        np.testing.assert_allclose(again.measure(places)[name], expected, rtol=1e-4)
    # A search without another one leaves no file of an earlier one behind.
    searches()[0].write(tmp_path, overwrite=True)
    assert dr.Detection.read(tmp_path).other is None
    assert not (tmp_path / "detection_other.fits").exists()


def test_the_fit_that_is_deeper_at_most_separations_is_kept_and_the_others_are_named():
    alone, together = pair()
    fits = alone.fit, together.fit
    kept, detection, gain, where = visit._kept(*fits, alone, together)
    separations, limits = stated_limits(alone)
    gains = limits / stated_limits(together)[1]
    assert kept is fits[int(np.median(gains) > 1)] is detection.fit
    assert gain == pytest.approx(np.median(gains[separations > EDGE]))
    assert where == f"at 0.7 to {separations[-1]:.1f} arcsec"
    # A fit of all frames whose errors are not calibrated is no gain over one whose are.
    failed = replace(fits[1], status=Status.MODEL_MISMATCH)
    assert "MODEL_MISMATCH" in visit._kept(fits[0], failed, alone, together)
    worse = with_factor(together, lambda r: np.full_like(r, 3.0))
    assert "limits would be" in visit._kept(*fits, alone, worse)


def with_darker_stop(detection, loss):
    """The same search, where the fit says that the Lyot stop lets less light of the star through.

    An imaginary OPD a multiplies the amplitude by exp(-2 pi a / lambda). Sources of the same light
    then have larger contrasts.
    """
    fit = detection.fit
    (frame,) = fit.frames
    wavelength = fit.model.bandpass.mean_wavelength
    imaginary = -np.log(1 - loss) * wavelength / (4 * np.pi)
    darker = replace(frame, opd=frame.opd + 1j * imaginary)
    assert darker.star_light == pytest.approx((1 - loss) * frame.star_light, rel=1e-9)
    more, curve, own = 1 / (1 - loss), detection.contrast_curve.copy(), detection.sources
    for name in ("contrast", "lowest", "highest", "small_sample", "known_star"):
        curve[name] = more * curve[name]
    units = np.repeat([more, 1.0, 1.0], len(own))
    return replace(
        detection,
        stored_fit=replace(fit, frames=(darker,)),
        contrast=more * detection.contrast,
        error=more * detection.error,
        photon_error=more * detection.photon_error,
        sources=replace(
            own,
            contrasts=more * own.contrasts,
            covariance=own.covariance * torch.from_numpy(np.outer(units, units)),
            detection_errors=more * own.detection_errors,
        ),
        contrast_curve=curve,
    )


def test_contrasts_are_related_by_the_light_behind_the_stop():
    first, second = pair()
    expected, joined = deeper(first, second), deeper(first, with_darker_stop(second, 0.1))
    np.testing.assert_array_equal(joined.of_other, expected.of_other)
    for name in ("contrast", "error", "photon_error"):
        np.testing.assert_allclose(getattr(joined, name), getattr(expected, name), rtol=1e-9)
    for name in ("contrast", "small_sample", "known_star", "delta_mag"):
        curves = (each.contrast_curve[name] for each in (joined, expected))
        np.testing.assert_allclose(*curves, rtol=1e-9)
    np.testing.assert_allclose(joined.sources.contrasts, expected.sources.contrasts, rtol=1e-9)
    np.testing.assert_allclose(joined.sources.covariance, expected.sources.covariance, rtol=1e-9)


def test_factors_that_were_not_measured_are_read_as_they_were_written(tmp_path):
    """Each search has one factor, and the joined one both."""
    first, second = pair()
    not_measured = [
        replace(each, error_factor=ErrorFactor.constant(factor))
        for each, factor in ((first, 1.1), (second, 1.3))
    ]
    joined = deeper(*not_measured)
    joined.write(tmp_path)
    again = dr.Detection.read(tmp_path)
    assert not again.error_factor.is_measured
    np.testing.assert_array_equal(again.error_factor.factors, joined.error_factor.factors)
    assert set(np.unique(joined.error_factor.factors)) == {1.1, 1.3}
