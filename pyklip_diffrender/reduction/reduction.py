"""`reduce`, and its result."""

from __future__ import annotations

import os
import textwrap
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.detection import Detection
from pyklip_diffrender.detection.published_limits import published_limits
from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.options import ReduceKeywords, ReduceOptions
from pyklip_diffrender.reduction.pipeline import ReductionResult, prepare
from pyklip_diffrender.reduction.products import ProductFolder, read_summary
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.reduction.visit import Visit
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.sequence import ExposureSequence


@dataclass(frozen=True, eq=False, repr=False)
class Reduction(ReductionResult):
    """Result of `reduce`.

    Attributes
    ----------
    sequence : ExposureSequence
        The frames, cut to the fitted pixels.
    fit : Refinement
        The fit that was searched: all frames of the target together, with the bright candidates in
        the model, and without the light of a disk, if that was fitted.
    detection : Detection
    references : tuple of Refinement
        One for each reference star that was fitted.
    pattern : DetectorPattern or None
        The detector pattern that was used.
    failed : tuple of (str, str)
        Reference stars that could not be fitted, and why.
    pattern_origin : str
        Origin of the detector pattern, with the names of its stars.
    visit : Visit
        What every frame of a reference star has contributed to the fit of the target.
    wide : WideField or None
        The search of the whole frames, if it was asked for.
    disk : Disk or None
        Extended light about the star, if it was asked for.
    injections : QTable or None
        Measurements of injected planets, see `recover_planets`, if they were asked for.
    completeness : QTable or None
        Fraction of planets that the search finds, see `completeness`, if it was asked for.
    accuracy : str
        "full", or "quick" for a first look, see `ReduceOptions`.

    Examples
    --------
    With frames and OPD maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", target="HIP 65426")  # doctest: +SKIP
    >>> print(result.candidates["separation", "contrast", "snr"])  # doctest: +SKIP
    >>> result.write("products")  # doctest: +SKIP
    """

    def __str__(self) -> str:
        return f"{textwrap.fill(self.sentence, 80)}\n{super().__str__()}"

    @cached_property
    def sentence(self) -> str:
        """The result in a few sentences, with which the report begins."""
        return str(summarise(self)["sentence"])

    @property
    def candidates(self) -> QTable:
        """Table of the candidates, of the whole frames where they were searched.

        See `Detection.candidates` and `WideField`.
        """
        return self.search.candidates

    @property
    def contrast_curve(self) -> QTable:
        """Limits by separation, to the edge of the whole frames where they were searched."""
        return self.search.contrast_curve

    def limits(self, isochrone: Any = None, *, parallax: Any = None) -> QTable:
        """Limits as they are published, see `Detection.limits`; of `contrast_curve`."""
        return published_limits(self.contrast_curve, self.detection, isochrone, parallax)

    def plot(self, ax: Any = None) -> NDArray[Any]:
        """Draw the S/N map with the candidates, and the contrast curve.

        North is up, and east left, where the orientation of the first frame is known.

        Parameters
        ----------
        ax : two Axes, optional
            Axes to draw in; a new figure by default.

        Returns
        -------
        ndarray of Axes, (2,)
        """
        return self.search.plot(ax)

    @classmethod
    def read(cls, folder: str | os.PathLike[str]) -> Reduction:
        """Read the products that `write` wrote.

        Frames are as they were fitted. Not read, because no product has them, are the fits of
        reference stars, frames of reference stars that were not fitted with the target's, and the
        table of all files. The search of whole frames and a disk are None, with a warning; their
        files are for other programs. The derivatives of the images, which `measure` and another
        `write` need, are there if they were written.

        Parameters
        ----------
        folder : path

        Returns
        -------
        Reduction

        Raises
        ------
        CorruptFileError
            If detection.fits, fit.fits or summary.json is missing or damaged. A folder without
            fit.fits may have a detection that ``Detection.read`` reads.
        IncompatibleSetupError
            If the fit is not the one that was searched.

        Warns
        -----
        DiffrenderWarning
            If the folder has products of whole frames or a disk, which are not read.

        Examples
        --------
        With a folder of products, which the package does not contain:

        >>> import pyklip_diffrender as dr
        >>> print(dr.Reduction.read("products").candidates)  # doctest: +SKIP
        """
        folder = Path(folder)
        fit = Refinement.read(folder / "fit.fits")
        detection = Detection.read(folder, fit=None if fit.stored_linear is None else fit)
        frames = [each.observation for each in fit.frames]
        about = read_summary(folder)
        left = [(each["name"], each["reason"]) for each in about["left_out"]]
        star = "reference star "
        unread = [name for name in ("wide_field.fits", "disk.fits") if (folder / name).exists()]
        if unread:
            warnings.warn(
                f"{folder}: {' and '.join(unread)} "
                f"{'is' if len(unread) == 1 else 'are'} not read: the reduction has only the "
                "pixels in which the star was fitted",
                DiffrenderWarning,
                stacklevel=2,
            )
        tables = {
            name: QTable.read(folder / f"{name}.ecsv")
            for name in ("injections", "completeness")
            if (folder / f"{name}.ecsv").exists()
        }
        result = cls(
            ExposureSequence(
                about["target"],
                tuple(each for each in frames if not each.reference),
                tuple(each for each in frames if each.reference),
                tuple(each for each in left if not each[0].startswith(star)),
            ),
            fit,
            detection,
            pattern=fit.pattern,
            failed=tuple((n.removeprefix(star), why) for n, why in left if n.startswith(star)),
            pattern_origin=about["pattern_origin"],
            visit=Visit.from_facts(about["visit"]),
            accuracy=about["accuracy"],
            **tables,
        )
        # The fit does not say how sources of a disk were arranged.
        vars(result).update(sentence=about["sentence"], extended=about["extended"])
        return result

    def write(
        self, folder: str | os.PathLike[str], *, overwrite: bool = False, derivatives: bool = False
    ) -> list[Path]:
        """Write maps, tables, the fit, the detector pattern, a figure and a report.

        Parameters
        ----------
        folder : path
            Made if it does not exist.
        overwrite : bool
            Replace the products of an earlier reduction, and remove what this one does not have.
        derivatives : bool
            Keep the derivatives of the images in ``fit.fits``, which then takes ten times the
            space: they are needed to search the fit again (`detect`), and to measure at other
            places (``Detection.read(...).measure``).

        Returns
        -------
        list of Path
            The files that were written.

        Raises
        ------
        ExistingFileError
            If there are products in the folder, and `overwrite` is False; it is also an `OSError`.
        IncompatibleSetupError
            For a reduction that was read without derivatives.
        """
        if self.detection.stored_fit is None:
            raise IncompatibleSetupError(
                f"{self.sequence.target}: the reduction was read from a folder without the "
                "derivatives of the images, which its figures need. Copy that folder, or write the "
                "reduction with derivatives=True first"
            )
        products = ProductFolder(folder, derivatives=derivatives, overwrite=overwrite)
        return products.keep(self)


def reduce(
    sequence: ExposureSequence | str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    opd: Any,
    *,
    target: str | None = None,
    filter: str | None = None,
    progress: bool = False,
    options: ReduceOptions | None = None,
    output: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    **keywords: Unpack[ReduceKeywords],
) -> Reduction:
    """Search a sequence of real frames for planets.

    All frames of the target are fitted together, with the error of the model on the detector's
    pixels (the detector pattern), and searched. The guide "Detector pattern and reference stars"
    says what frames of reference stars are used for.

    Parameters
    ----------
    sequence : ExposureSequence, or files as for `ExposureSequence.from_files`
    opd : path, OPDMap, Quantity, array or "flat"
        The wavefront to start from, as for `refine`. Of a folder of maps, the one nearest in time
        to the target's frames is taken; see `choose_opd` for other rules. "flat" is for frames
        without a map: the fit then takes longer, and the star's flux is uncertain by 40 % unless
        `star_flux` says it.
    target, filter : str, optional
        See `ExposureSequence.from_files`.
    progress : bool
        Show progress bars.
    options : ReduceOptions, optional
        Options of the reduction, in place of `keywords`.
    output : path, optional
        Folder for the products, as of `Reduction.write`. They are written as they come: products
        of the fit and the search before wide, disk, injections and completeness begin.
    overwrite : bool
        Replace the products of an earlier reduction in `output`. Products that somebody else writes
        there while this reduction runs are kept in any case: this reduction's then go to a new
        folder in `output`.
    **keywords
        Options by name, such as ``size=120``: the fields of `ReduceOptions`.

    Returns
    -------
    Reduction

    Raises
    ------
    IncompatibleSetupError
        For options that `ReduceOptions` refuses; for `star_flux` with frames that are not
        calibrated, or that differs from the fitted flux by more than a factor of three; for
        `pattern` of the star itself, of another filter, mask or detector, of other pixels, or
        of which the frames show less than half; and if `output` is a file.
    TypeError
        For a keyword that is no option, or keywords together with `options`.
    ExistingFileError
        If there are products in `output`, and `overwrite` is False; it is also an `OSError`.
    DiffrenderError
        If the target cannot be fitted. A reference star that cannot be is left out.

    Warns
    -----
    DiffrenderWarning
        If products that were written to `output` meanwhile are kept, with the folder of the new
        ones.

    Examples
    --------
    With frames and OPD maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", target="HIP 65426")  # doctest: +SKIP
    >>> print(result)  # doctest: +SKIP
    """
    if options is None:
        options = ReduceOptions.from_keywords(keywords)
    elif keywords:
        raise TypeError(
            f"reduce() got options and the keywords {', '.join(keywords)}, expected one of the two"
        )
    if not isinstance(sequence, ExposureSequence):
        sequence = ExposureSequence.from_files(sequence, target=target, filter=filter)
    if output is None:
        if overwrite:
            raise TypeError("reduce() got overwrite without output, a folder")
        return _writable(prepare(sequence, opd, options).run(progress=progress))
    products = ProductFolder(output, overwrite=overwrite)
    result = prepare(sequence, opd, options).run(progress=progress, keep=products.keep)
    products.keep(result)
    return _writable(result)


def _writable(result: ReductionResult) -> Reduction:
    return Reduction(**{each.name: getattr(result, each.name) for each in fields(result)})
