"""The result of a detection: maps, candidates and contrast curve."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from astropy.io.fits import Header
from astropy.table import QTable
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.detection.candidates import (
    Candidates,
    candidate_errors,
    caveats,
    count_rolls,
)
from pyklip_diffrender.detection.detection_file import (
    digest,
    other_file,
    provenance_of,
    read_detection,
    searched_fit,
    write_astrometry,
    write_detection,
)
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import (
    Image,
    Sky,
    is_within,
    places_of,
)
from pyklip_diffrender.detection.measurement import (
    candidate_table,
    contrasts_at,
    in_words,
    measured_shape,
    measured_table,
    subtracted_frames,
)
from pyklip_diffrender.detection.published_limits import published_limits
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.io.tables import add_columns, html_summary
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.observation import Observation

# The figure of a search: its S/N map and its contrast curve.


class _Search(Protocol):
    """The part of a `Detection` or a `WideField` that is drawn."""

    @property
    def snr(self) -> Image: ...
    @property
    def grid(self) -> Image: ...
    @property
    def candidates(self) -> QTable: ...
    @property
    def contrast_curve(self) -> QTable: ...
    @property
    def threshold(self) -> float: ...
    @property
    def error_factor(self) -> ErrorFactor: ...
    @property
    def observation(self) -> Observation: ...


def draw_search(ax: Any, search: _Search, labels: Sequence[str]) -> NDArray[Any]:
    """Draw the S/N map with the candidates, which have labels, and the contrast curve.

    Returns the two axes: `ax`, or the axes of a new figure for None.
    """
    axes, table = drawing.axes_for(ax, 2), search.candidates
    drawing.snr_map(
        axes[0], search.snr, search.grid,
        np.stack([table["x"].value, table["y"].value], axis=1),
        search.observation.north,
        title=f"{len(table)} candidate{'' if len(table) == 1 else 's'} above "
        f"S/N {search.threshold:g}",
        labels=labels,
    )  # fmt: skip
    draw_curve(axes[1], search)
    return np.array(axes)


def draw_curve(
    ax: Any, search: _Search, klip: QTable | None = None, *, legend_below: bool = False
) -> None:
    """Draw the contrast curve with the candidates, and KLIP's on the same frames if it is given."""
    drawing.contrast_curve(
        ax, search.contrast_curve, search.candidates, small_sample=search.error_factor.is_measured,
        klip=klip, legend_below=legend_below,
    )  # fmt: skip


@dataclass(frozen=True)
class Detection:
    """Point sources in refined frames: maps, candidates, and the contrast curve.

    Everything is for point sources with the wavefront, alignment, flux and background of the star
    marginalised. Images have the first frame's pixels; positions are x, y from the star.

    Attributes
    ----------
    stored_fit : Refinement or None
        The fit that was searched, after the last refinement; None if the detection was read from a
        file without it. See `fit`.
    contrast : ndarray, (ny, nx)
        Flux of a point source at every pixel over the star's, before the coronagraph.
    error : ndarray, (ny, nx)
        Standard deviation of `contrast`, with the factor `error_factor`.
    photon_error : ndarray, (ny, nx)
        Standard deviation of `contrast` for a known star.
    snr : ndarray, (ny, nx)
        contrast / error.
    residual_snr : ndarray, (ny, nx)
        S/N after the candidates are removed from the data.
    error_factor : ErrorFactor
        Factor by which errors were multiplied, at every pixel; ``error_factor.at(0.5)`` is its
        median at 0.5 arcsec.
    sources : Candidates
        The candidates with the covariance of all their values, as tensors; in the order in which
        they were found.
    false_alarm : ndarray, (candidates,)
        Probability that noise alone makes a peak as significant as the candidate anywhere in the
        field; NaN where the fit does not explain its data.
    rings : QTable
        Chi-squared per pixel, without the candidates, and error factor between separations.
    threshold : float
        Smallest S/N of a candidate in Gaussian noise. Where errors were scaled to the scatter of
        the S/N, ``error_factor.threshold(threshold, offsets)`` is the value at a position.
    contrast_curve : QTable
        See `contrast_curve`.
    has_limits : ndarray of bool, (ny, nx)
        Pixels whose limits are in the curve.
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    path : Path or None
        File that the detection was read from.
    other : Detection or None
        Search with another fit of the same frames, such as the target without reference
        stars, where that search is deeper at some separations.
    of_other : ndarray of bool, (ny, nx), or None
        Pixels whose maps, candidates and limits come from `other`, relative to the star of
        `fit`.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> scene = dr.Scene(planets=(dr.Planet(1e-4, 0.5, 54.0),))
    >>> frame = dr.simulate(model, scene, opd, seed=1)
    >>> fit = dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=4))
    >>> detection = dr.detect(fit)
    >>> len(detection.candidates)
    1
    >>> print(f"{detection.candidates['separation'][0]:.2f}")
    0.50 arcsec
    """

    stored_fit: Refinement | None
    contrast: Image
    error: Image
    photon_error: Image
    snr: Image
    residual_snr: Image
    error_factor: ErrorFactor
    sources: Candidates
    false_alarm: Image
    rings: QTable
    threshold: float
    contrast_curve: QTable
    has_limits: NDArray[np.bool_]
    grid: Image
    path: Path | None = None
    other: Detection | None = None
    of_other: NDArray[np.bool_] | None = None

    def __repr__(self) -> str:
        return (
            f"<Detection: {self._count} above {self.threshold:g} sigma, "
            f"errors scaled by {self.scatter:.3g}>"
        )

    def __str__(self) -> str:
        """The candidates in words, at most 80 columns wide."""
        words = in_words(self.candidates, self.threshold)
        return f"{words}\n{textwrap.fill(self.remark, 80)}".rstrip()

    @property
    def remark(self) -> str:
        """Caveats about sources that only the fit has, and about real frames of a single roll."""
        return caveats(self)

    @cached_property
    def rolls(self) -> int:
        """Number of orientations of the target's frames that differ by more than a degree."""
        return count_rolls(self.fit)

    @property
    def _count(self) -> str:
        count = len(self.sources)
        return f"{count} candidate{'' if count == 1 else 's'}"

    def _repr_html_(self) -> str:
        star = self.sky.star_jansky
        return html_summary(
            f"Detection: {self._count} above {self.threshold:g} sigma",
            {
                "Star": self.observation.target,
                "Epoch (UTC)": self.sky.date,
                "Flux density of the star": None if star is None else f"{star:.3g} Jy",
                "Errors multiplied by": f"{self.scatter:.3g}",
            },
            self.candidates,
            ("separation", "separation_error", "position_angle", "position_angle_error",
             "contrast", "contrast_error", "delta_mag", "snr"),
        )  # fmt: skip

    @cached_property
    def fit(self) -> Refinement:
        """The fit that was searched, after the last refinement.

        If the detection was read without it, ``fit.fits`` is read from the same folder.

        Raises
        ------
        IncompatibleSetupError
            If there is none, or none with its linear model.
        """
        if self.stored_fit is not None:
            return self.stored_fit
        assert self.path is not None  # Of a detection that was read.
        return searched_fit(self.path, self._digest)

    @cached_property
    def templates(self) -> Templates:
        """Images of planets in the frames of the fit."""
        return Templates(self.fit)

    @cached_property
    def observation(self) -> Observation:
        """The first frame; its integrations are averaged if the detection was read from a file."""
        return self.fit.frames[0].observation

    @property
    def north(self) -> float:
        """Position angle of the first frame's +y axis, degrees east of north; 0 if not known."""
        return self.observation.position_angle

    @property
    def scatter(self) -> float:
        """The typical factor by which errors were multiplied: the median over the field."""
        return self.error_factor.typical

    @cached_property
    def sky(self) -> Sky:
        """Orientation, epoch, and flux density of the star, as far as they are known."""
        return Sky.of(self.fit, self.scatter)

    @cached_property
    def candidates(self) -> QTable:
        """Table of the candidates, highest S/N first; every column has a description.

        Columns are separation; position angle east of north (counter-clockwise from +y of the
        first frame if its orientation is not known); contrast; magnitude difference; S/N; the
        probability of a false alarm; angle and x, y from the star on the first frame. With a known
        orientation there are the offsets in right ascension and declination and their correlation,
        with a date the epoch, and for calibrated frames the flux density and the AB magnitude.

        Errors are standard deviations, with all parameters of the star marginalised. Errors of
        positions include the error of the star's position behind the mask, and do not include
        errors of the pixel scale and of the roll angle. The contrast's error includes errors of
        the star's flux (10 % for real frames with a map of the day, and up to 30 % with an older
        one, unless ``reduce(star_flux=...)`` says it), of the source's own image and of its
        position; the flux density's error does not depend on the star's flux. The S/N is the
        contrast over its error for a known position and image, because the others do not change
        the significance of a source.
        """
        table = candidate_table(self.sources, self.error_factor, self._calibration_errors, self.sky)
        order = np.argsort(-self.sources.snr(self.error_factor))
        about = "of a peak anywhere; NaN if not known"
        add_columns(
            table, [("false_alarm_probability", self.false_alarm[order], None, ".1e", about)]
        )
        table.meta = dict(self.provenance)
        return table

    def limits(self, isochrone: Any = None, *, parallax: Any = None) -> QTable:
        """Limits as they are published: separation, contrast, magnitudes and, with a model, masses.

        Parameters
        ----------
        isochrone : QTable, Table or path, optional
            An evolutionary model at the age of the star: a column mass (Jupiter masses, or with a
            unit), and one that is named like the filter, such as F444W or JWST_NIRCam.F444W, with
            absolute Vega magnitudes, AB magnitudes (unit mag(AB)), or flux densities at 10 pc.
        parallax : float, Quantity or str, optional
            Parallax of the star, arcsec or such as "9.3 mas"; needed with `isochrone`.

        Returns
        -------
        QTable
            separation; contrast, the median of all angles in `contrast_curve`; dmag, its
            magnitude; mag, the apparent Vega magnitude, where the flux density of the star is
            known; and mass, from which every planet of the model is brighter than the limit, NaN
            outside of it. Vega has the spectrum alpha_lyr_stis_011 of CALSPEC. Names have no
            underscores, which LaTeX takes for subscripts.

        Raises
        ------
        IncompatibleSetupError
            For a model without these columns or with several ages, without a parallax, or frames
            that are not calibrated.
        CorruptFileError, FileNotFoundError, UnitError
            As their names say.

        Examples
        --------
        A table for the CDS and one for LaTeX, by the writers of astropy:

        >>> import pyklip_diffrender as dr
        >>> table = dr.Detection.read("products").limits()  # doctest: +SKIP
        >>> table.write("limits.txt", format="ascii.mrt")  # doctest: +SKIP
        >>> table.write("limits.tex", format="ascii.aastex")  # doctest: +SKIP
        """
        return published_limits(self.contrast_curve, self, isochrone, parallax)

    @cached_property
    def _calibration_errors(self) -> Image:
        """Relative calibration errors of the candidates' contrasts and fluxes, (2, k)."""
        return candidate_errors(self.templates, self.sources, self.error_factor)

    def measure(
        self,
        offsets: ArrayLike | None = None,
        *,
        separation: ArrayLike | None = None,
        position_angle: ArrayLike | None = None,
        sigmas: float = 5.0,
    ) -> QTable:
        """Contrast of a point source at given positions, one at a time.

        Positions are either `offsets`, or `separation` with `position_angle`, as in `candidates`;
        all of them may be quantities.

        Parameters
        ----------
        offsets : (k, 2), optional
            x, y from the star, arcsec, image orientation of the first frame. Figures show offsets
            to the east and to the north instead: take separation and position angle of a place that
            is read off one.
        separation : float or (k,), optional
            From the star, arcsec.
        position_angle : float or (k,), optional
            Degrees east of north, or counter-clockwise from +y of the first frame, if its
            orientation is not known.
        sigmas : float
            S/N of a detection, below which an upper limit is stated; 3 and 5 are usual.

        Returns
        -------
        QTable
            x, y, contrast, its error and S/N as in `candidates`; upper_limit, the contrast (at
            least 0) plus `sigmas` errors, NaN where the S/N is `sigmas` or more; separation and
            position angle, and the other columns of `candidates` that apply. Positions are as
            given, without errors, and the candidates are not removed from the data.

        Raises
        ------
        IncompatibleSetupError
            For a position outside the field, for positions that are given in both ways or in part,
            or if the detection was read from a file without its fit; see `read`.
        NonFiniteError, ShapeError, UnitError

        Examples
        --------
        >>> import pyklip_diffrender as dr
        >>> found = dr.Detection.read("products")  # doctest: +SKIP
        >>> found.measure(separation=0.6, position_angle=211)  # doctest: +SKIP
        """
        places = places_of(offsets, separation, position_angle, self.north)
        raw, calibration = self._contrasts_at(places)
        return measured_table(raw, calibration, self.sky, sigmas)

    def _contrasts_at(self, offsets: ArrayLike) -> tuple[QTable, Image]:
        """Contrasts at positions, see `contrasts_at`, of the search that is deeper at each."""
        raw, calibration = contrasts_at(self.templates, offsets, self.error_factor)
        if self.other is None or self.of_other is None:
            return raw, calibration
        places = np.stack([raw["x"].value, raw["y"].value], axis=1)
        theirs, errors = self.other._contrasts_at(places)
        # Relative to the star of this search, as the map is.
        one, two = (each.fit.frames[0].star_light for each in (self, self.other))
        chosen = is_within(self.of_other, self.grid, places)
        for name, unit in (("contrast", two / one), ("contrast_error", two / one), ("snr", 1.0)):
            raw[name] = np.where(chosen, unit * theirs[name], raw[name])
        return raw, np.where(chosen, errors, calibration)

    def measure_shape(self, image: ArrayLike, *, relinearise: float = 25.0) -> tuple[float, float]:
        """Measure an extended source of known shape in the first frame, such as a ring.

        Parameters
        ----------
        image : (ny, nx)
            Image of the source at amplitude 1 behind the coronagraph, in the data's unit.
        relinearise : float
            S/N (before `scatter`) above which the source is subtracted and the star refined
            again, until the amplitude has settled, so that it does not bias the wavefront. Only
            for a single frame.

        Returns
        -------
        amplitude, error : float
        """
        return measured_shape(self.templates, image, self.scatter, relinearise)

    @cached_property
    def subtracted(self) -> tuple[Image, ...]:
        """Star-subtracted frames of the fit, with the candidates as part of the model.

        A fit without a companion in its model attributes some of its light to the star, so that
        `pyklip_diffrender.refinement.FrameFit.residual` has lost that light. Here the candidates
        lose no light, only sources below the threshold do. Images (ny, nx) are in the order of the
        fit's frames, in the data's unit, and NaN where the data are masked; integrations of a frame
        are averaged.
        """
        return subtracted_frames(self.templates, self.sources)

    @cached_property
    def _wcs(self) -> tuple[Header, ...]:
        """World coordinates of the frames, in the order of `subtracted`."""
        return tuple(each.wcs for each in self.fit.frames)

    @cached_property
    def _digest(self) -> str:
        return digest(self.fit)

    @cached_property
    def provenance(self) -> dict[str, object]:
        """Facts about the fit and the search, by name."""
        return provenance_of(self)

    def plot(self, ax: Any = None) -> NDArray[Any]:
        """Draw the S/N map with the candidates, and the contrast curve.

        The map has north up and east left, in arcsec from the star, where the position angle of the
        first frame is known; else it has x and y of the first frame.

        Parameters
        ----------
        ax : two Axes, optional
            Axes to draw in; a new figure by default.

        Returns
        -------
        ndarray of Axes, (2,)
        """
        return draw_search(ax, self, [f"S/N {each:.1f}" for each in self.candidates["snr"]])

    def write(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write maps (FITS), candidates and contrast curve (ECSV); returns the paths.

        `read` needs only the first file, detection.fits. For frames with a date and a position
        angle there is also astrometry.csv, see `write_astrometry`. Extensions of detection.fits:

        - SNR, RESIDUAL_SNR: S/N of a point source at every pixel, and with the candidates removed;
        - CONTRAST, CONTRAST_ERROR, PHOTON_ERROR: contrast, its standard deviation, and the one for
          a known star;
        - ERROR_FACTOR, FREEDOM: factor of the errors, and degrees of freedom of Student's t, which
          noise follows in units of these errors;
        - HAS_LIMITS: 1 for the pixels whose limits are in the contrast curve, else 0;
        - OF_OTHER: 1 for the pixels of `other`, which has a file of its own,
          detection_other.fits;
        - OFFSET_X, OFFSET_Y: position of every pixel from the star, arcsec;
        - SUBTRACTED, numbered by EXTVER: each frame without its star, candidates preserved;
        - DATA, ERROR, VALID: the first frame, its integrations averaged;
        - FACTS: candidates, contrast curve, metadata and a hash of the fit, as JSON text, one byte
          a pixel.

        Parameters
        ----------
        folder : path
            Made if it does not exist.
        overwrite : bool
            Replace the files of an earlier detection.

        Raises
        ------
        ExistingFileError
            If one of the files exists, and `overwrite` is False; it is also an `OSError`.
        """
        return write_detection(self, Path(folder), overwrite=overwrite)

    def write_astrometry(
        self,
        path: str | os.PathLike[str],
        *,
        format: str = "orbitize",
        overwrite: bool = False,
    ) -> Path:
        """Write epoch and positions of the candidates for a program that fits orbits.

        Candidates are numbered as in `candidates`, where their order may differ between epochs.
        Errors have no share of the pixel scale and of the roll angle; add those that you assume.

        Parameters
        ----------
        path : path
        format : "orbitize", "backtracks", "octofitter" or "orvara"
            The CSV file of orbitize! (MJD, mas, degrees), backtracks or Octofitter (MJD, mas), or
            the text file with relative astrometry of orvara (JD, arcsec, degrees).
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        ExistingFileError
            If the file exists, and `overwrite` is False; it is also an `OSError`.
        IncompatibleSetupError
            If the frames have no date or no position angle.
        """
        return write_astrometry(self.candidates, path, format, overwrite=overwrite)

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        fit: Refinement | None = None,
    ) -> Detection:
        """Read a detection that `write` wrote.

        Maps, tables and figures do not need the fit. `measure` and `measure_shape` do: they read
        ``fit.fits`` from the same folder, where `Reduction.write` puts it, unless it is passed.

        Parameters
        ----------
        path : path
            The folder, or detection.fits in it.
        fit : Refinement, optional
            The fit that was searched: the attribute `fit` of the detection that was written.

        Raises
        ------
        CorruptFileError
            If the file is missing, truncated, or was not written by `write`.
        IncompatibleSetupError
            For a fit other than the one that was searched.
        """
        searched, computed = read_detection(Path(path), fit)
        if "of_other" in searched:
            searched["other"] = cls.read(other_file(Path(path)))
        detection = cls(**searched)
        vars(detection).update(computed)
        return detection
