"""What the `plot` methods draw: the numbers, where they are, and what is said about them."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import pyklip_diffrender as dr
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import FourierModes
from pyklip_diffrender.wavefront.opd import random_opd

NPIX, FLUX, NOISE = 64, 3e10, 100.0
AXIS = (0.05, -0.1)
"""Where the optical axis is in the frames, arcsec from the middle."""
OFFSET = (0.02, 0.03)
"""Of the star from the axis."""
PLANET = Planet(3e-4, 0.6, 100.0)
ANGLES = (70.0, 40.0)
HOLE = (3, 20)


@pytest.fixture(autouse=True)
def _closed():
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def model():
    return dr.nircam_coronagraph(
        "F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=(30, 34),
        defaults={"detector_shift": AXIS},
    )  # fmt: skip


def in_frame(angle):
    """The planet in a frame whose +y axis is at a position angle."""
    return replace(PLANET, position_angle=PLANET.position_angle - angle)


@pytest.fixture(scope="module")
def frames(model):
    """Two rolls; the sky turns in the frame by as much as the position angle falls."""
    opd, made = random_opd(3, npix=NPIX).data, []
    scale = np.array(model.detector.pixelscale)
    for k, angle in enumerate(ANGLES):
        planet = model(opd, tuple(np.add(OFFSET, in_frame(angle).offset)))
        light = FLUX * (model(opd, OFFSET) + PLANET.contrast * planet).numpy()
        data = light + NOISE * np.random.default_rng(k).normal(size=light.shape)
        valid = np.ones(data.shape, dtype=bool)
        valid[HOLE] = False
        made.append(
            Observation.from_arrays(
                data, np.full(data.shape, NOISE), valid=valid, pixelscale=tuple(scale),
                center=(16.5, 14.5) + np.array(AXIS) / scale, name="HD 1", filter="F444W",
                position_angles=np.array([angle]),
            )
        )  # fmt: skip
    return made


@pytest.fixture(scope="module")
def fit(model, frames):
    companion = in_frame(ANGLES[0])
    settings = FitSettings(basis=FourierModes(2), response_npix=NPIX, companions=(companion,))
    return dr.refine(model, frames, random_opd(3, npix=NPIX).data, settings=settings)


def shown(ax):
    """The image that an axes shows; NaN where it is masked."""
    (image,) = ax.images
    return np.ma.filled(image.get_array().astype(float), np.nan)


def place_of(ax, row, column):
    """Coordinates of a pixel's centre on the axes."""
    (image,) = ax.images
    assert image.origin == "lower"
    left, right, bottom, top = image.get_extent()
    ny, nx = image.get_array().shape
    center = (
        left + (column + 0.5) * (right - left) / nx,
        bottom + (row + 0.5) * (top - bottom) / ny,
    )
    return (image.get_transform() - ax.transData).transform(center)


def points(ax, label):
    """Coordinates of the points of one label, (k, 2)."""
    (line,) = (line for line in ax.lines if line.get_label() == label)
    return np.stack(line.get_data(), axis=1)


def label_of(ax):
    """What the colour bar says."""
    (bar,) = ax.child_axes
    return bar.get_ylabel()


def on_sky(separation, angle):
    """Offsets to the east and north of a place at a position angle."""
    return separation * np.array([np.sin(np.deg2rad(angle)), np.cos(np.deg2rad(angle))])


def assert_north_is_up(ax):
    """Axes of offsets to the east, which grows to the left, and to the north."""
    assert [ax.get_xlabel(), ax.get_ylabel()] == ["ΔRA cos Dec (arcsec)", "ΔDec (arcsec)"]
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    assert left > right
    assert high > low


def test_a_frame_is_drawn_from_its_star(frames):
    observation = frames[0]
    _, given = pyplot.subplots()
    ax = observation.plot(given)
    assert ax is given
    assert len(pyplot.get_fignums()) == 1
    image = shown(ax)
    assert np.argwhere(np.isnan(image)).tolist() == [list(HOLE)]
    np.testing.assert_array_equal(image[observation.valid[0]], observation.data[observation.valid])
    # The star is where the observation says, in pixels of the image.
    np.testing.assert_allclose(points(ax, "star"), [[0, 0]])
    assert_north_is_up(ax)
    x, y = (np.array([16, 14]) - observation.center[0]) * observation.pixelscale
    angle = ANGLES[0] + np.rad2deg(np.arctan2(-x, y))
    np.testing.assert_allclose(place_of(ax, 14, 16), on_sky(np.hypot(x, y), angle), atol=1e-12)
    corners = [place_of(ax, row, column) for row in (0, 29) for column in (0, 33)]
    assert (np.abs(corners) < np.abs([ax.get_xlim()[0], ax.get_ylim()[1]]) + 0.2).all()
    # Without a position angle, x and y are what is known.
    plain = replace(observation, position_angles=None).plot()
    np.testing.assert_allclose(place_of(plain, 14, 16), (x, y), atol=1e-12)
    assert plain.get_xlabel() == "x from the star (arcsec)"
    assert ax.get_title(loc="left") == "HD 1, F444W"
    assert label_of(ax) == "photon"


@pytest.mark.parametrize("angle", [0.0, 70.0, 200.0])
def test_what_is_drawn_is_where_its_axes_say(frames, angle):
    """A bright pixel, in the figure as it is rendered, has the offsets that its axes say."""
    frame = replace(frames[0], position_angles=np.array([angle]))
    data, valid = np.ones_like(frame.data), np.ones_like(frame.valid)
    data[0, 22, 9] = 1e6
    figure = Figure(figsize=(6, 6), dpi=100)
    ax = figure.subplots()
    replace(frame, data=data, valid=valid).plot(ax)
    for each in (*ax.lines, *ax.child_axes):
        each.set_visible(False)
    ax.set_title("", loc="left")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    rgb = np.asarray(canvas.buffer_rgba())[::-1, :, :3].astype(float)
    box = ax.get_window_extent()
    inside = np.zeros(rgb.shape[:2], dtype=bool)
    inside[int(box.y0) + 3 : int(box.y1) - 2, int(box.x0) + 3 : int(box.x1) - 2] = True
    # The lightest colour of the scale is nearly white, the other pixels are nearly black.
    rows, columns = np.nonzero(inside & (rgb[..., 0] > 230))
    seen = ax.transData.inverted().transform((columns.mean() + 0.5, rows.mean() + 0.5))
    x, y = (np.array([9, 22]) - frame.center[0]) * frame.pixelscale
    expected = on_sky(np.hypot(x, y), angle + np.rad2deg(np.arctan2(-x, y)))
    # A pixel of the screen is 0.006 arcsec, one of the frame ten times as much.
    np.testing.assert_allclose(seen, expected, atol=0.01)


def test_a_system_shows_its_pupils_and_the_star(model):
    opd = random_opd(3, npix=NPIX).data
    pupil, wavefront, last, image = axes = model.plot(opd=opd)
    lit = model.entrance.lit.numpy()
    assert ((shown(pupil) > 0) == lit).all()
    assert shown(pupil).max() == 1
    np.testing.assert_allclose(shown(wavefront)[lit], 1e9 * opd[lit])
    assert np.isnan(shown(wavefront)[~lit]).all()
    np.testing.assert_array_equal(shown(image), model(opd).numpy())
    # The same light that goes through all planes to the detector, where the stop lets it pass.
    fields = model.debug(opd)
    behind = (fields["NIRCam internal WFE"].abs() / fields["JWST pupil"].abs().max()) ** 2
    assert shown(last).sum() == pytest.approx(float(behind.sum()), rel=1e-12)
    stopped = ~(fields["MASKRND"].abs() > 0)
    assert (shown(last) == 0).sum() == lit.size - int((~stopped).sum())
    for ax in (pupil, wavefront, last):
        np.testing.assert_allclose(ax.images[0].get_extent(), 3.3 * np.array([-1, 1, -1, 1]), 0.02)
    # The optical axis lies beside the middle of the detector.
    middle = (place_of(image, 0, 0) + place_of(image, 29, 33)) / 2
    np.testing.assert_allclose(middle, -np.array(AXIS), atol=1e-12)
    assert [label_of(ax) for ax in axes] == [
        "amplitude", "wavefront error (nm)", "light, 1 in the first pupil",
        "fraction of the star's light",
    ]  # fmt: skip
    assert image.images[0].norm.vmin == pytest.approx(1e-6 * float(model(opd).max()))


def test_a_fit_shows_data_star_and_what_is_left(fit):
    part = fit.frames[1]
    _, given = pyplot.subplots(1, 3)
    data, star, residual = axes = fit.plot(given, frame=1)
    assert axes.tolist() == given.tolist()
    assert len(pyplot.get_fignums()) == 1
    with pytest.raises(IncompatibleSetupError, match=r"got 2 axes, expected 3"):
        fit.plot(given[:2])
    valid = part.observation.valid[0]
    # A mean of one integration is rounded.
    np.testing.assert_allclose(shown(data)[valid], part.observation.data[0][valid], rtol=1e-14)
    np.testing.assert_array_equal(shown(star), part.star)
    np.testing.assert_allclose(shown(residual)[valid], part.residual[0][valid] / NOISE)
    assert np.isnan(shown(residual)[HOLE])
    # One scale for both, or they could not be compared.
    assert data.images[0].norm is star.images[0].norm
    assert residual.images[0].get_clim() == (-5, 5)
    assert [label_of(ax) for ax in axes] == ["photon", "photon", "standard deviations"]
    # The circle is where the companion's light is, in this frame and from this star.
    row, column = np.unravel_index(np.argmax(part.companion_image), part.star.shape)
    (place,) = points(residual, "companions")
    assert np.abs(place - place_of(residual, row, column)).max() < 0.07
    np.testing.assert_allclose(place, on_sky(0.6, 100.0), atol=0.01)
    middle = (place_of(data, 0, 0) + place_of(data, 29, 33)) / 2
    x, y = -np.add(AXIS, OFFSET)
    angle = ANGLES[1] + np.rad2deg(np.arctan2(-x, y))
    np.testing.assert_allclose(middle, on_sky(np.hypot(x, y), angle), atol=0.01)
    for ax in axes:
        assert_north_is_up(ax)


def test_a_detection_shows_candidates_and_the_curve(fit):
    found = dr.detect(fit)
    left, right = found.plot()
    np.testing.assert_array_equal(shown(left), found.snr)
    assert_north_is_up(left)
    (row,) = found.candidates
    circled = points(left, "companions")
    np.testing.assert_allclose(circled, [[row["delta_ra"].value, row["delta_dec"].value]])
    np.testing.assert_allclose(circled, [on_sky(0.6, 100.0)], atol=0.01)
    peak = np.unravel_index(np.nanargmax(found.snr), found.snr.shape)
    assert np.abs(circled[0] - place_of(left, *peak)).max() < 0.07
    assert f"S/N {row['snr']:.1f}" in [each.get_text() for each in left.texts]
    assert left.get_title(loc="left") == "1 candidate above S/N 5"
    assert label_of(left) == "S/N of a point source"
    curve = found.contrast_curve
    for label, name in (("median", "contrast"), ("star known exactly", "known_star")):
        drawn = points(right, label)
        np.testing.assert_array_equal(drawn[:, 0], curve["separation"].value)
        np.testing.assert_array_equal(drawn[:, 1], curve[name])
    assert right.get_yscale() == "log"
    assert right.get_ylabel() == "contrast at 5 sigma"
