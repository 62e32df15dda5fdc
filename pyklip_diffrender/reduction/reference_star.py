"""Reference stars fitted once: wavefront and detector from the fit of a star, for other stars.

A reference star that was fitted once serves all its targets. Its wavefront is a better place to
start from than a map of another day: the telescope has changed by a few nanometres in hours, so
that the prior of the target's wavefront about it is narrow. And the residual of its frames over its
light is the pattern of the flat field on the pixels that the target has, too. What the file does
not have is how the errors of wavefront and pattern go together; only a fit of all frames does.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from astropy.io import fits

from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.files import open_fits, require_new, write_fits
from pyklip_diffrender.io.headers import fits_text, set_keyword
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.pattern import (
    PatternLibrary,
    combine_patterns,
    measure_patterns,
)
from pyklip_diffrender.reduction.visit import slew_drift
from pyklip_diffrender.refinement import GaussNewton, Refinement, settings_for
from pyklip_diffrender.scene.exposure import CatalogueStar, detector_of, image_mask
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.systematics import Systematics, contradiction, shows_star
from pyklip_diffrender.wavefront.opd import OPDMap, read_opd

__all__ = ["ReferenceStar", "reference_star_in"]

_CARD = "REFSTAR"
"""Card of the primary header by which a file is known."""

_DAILY = 1.75
"""nm rms by which the wavefront departs further in a day: 9 nm in the 3.6 days between two sensings
(Feng et al. 2025, section 4), of which 2.7 nm are those of `slew_drift`."""

_NEW = 14.0
"""Days after which a wavefront is taken for a map like any other: mirrors may have been moved."""


@dataclass(frozen=True, eq=False)
class ReferenceStar:
    """Wavefront and flat-field pattern from the fit of a star, for the fits of other stars.

    Give it, or the file that `write` makes, in place of the wavefront map: `reduce` then starts
    from the wavefront of this star, with a prior for what changes in the hours between two stars,
    and has its flat-field pattern if its frames show the target's pixels. For stars of one visit;
    with the frames themselves, `reduce` fits all stars together, which takes longer and goes
    deeper.

    Attributes
    ----------
    wavefront : OPDMap
        The fitted wavefront, m, with the date of the frames.
    patterns : PatternLibrary
        The flat-field pattern in each of its frames.
    star : str
        Name of the star.
    filter, image_mask, detector : str or None
        Set-up of the frames.
    frames : tuple of str
        Names of their files.
    status : str
        How the fit ended: the name of a `Status`.
    chi2 : float
        Chi-squared per pixel of the fit.
    start : str
        Wavefront map from which the fit started.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=128, fov_pixels=24)
    >>> opd = dr.random_opd(1, npix=128)
    >>> frame = dr.simulate(model, dr.Scene(), opd, seed=1)
    >>> fit = dr.refine(model, [frame], opd, settings=dr.GaussNewton(cycles=4))
    >>> dr.ReferenceStar.of(fit).frames
    ('simulation(seed=1)',)
    """

    wavefront: OPDMap
    patterns: PatternLibrary = field(default_factory=PatternLibrary)
    star: str = ""
    filter: str | None = None
    image_mask: str | None = None
    detector: str | None = None
    frames: tuple[str, ...] = ()
    status: str = ""
    chi2: float = float("nan")
    start: str = ""

    def __repr__(self) -> str:
        count = f"{len(self.frames)} frame{'' if len(self.frames) == 1 else 's'}"
        return f"<ReferenceStar {self.star!r}: {self.filter}, {count}>"

    def _repr_html_(self) -> str:
        date = self.wavefront.date
        facts = {
            "Status": self.status,
            "Observed (UTC)": None if date is None else date.isot[:19],
            "Frames": len(self.frames),
            "Filter": self.filter,
            "Mask": self.image_mask,
        }
        return html_summary(f"Reference star {self.star}", facts)

    @classmethod
    def of(cls, fit: Refinement) -> Self:
        """Make it of the fit of a star: of its own frames, without those of other stars.

        Raises
        ------
        IncompatibleSetupError
            If the fit failed.
        """
        if not fit.status.usable:
            raise IncompatibleSetupError(
                f"the fit ended as {fit.status}, expected one that may be used for other stars"
            )
        own = [each for each in fit.frames if not each.observation.reference] or list(fit.frames)
        first = own[0].observation
        names = tuple(each.observation.name for each in own)
        measured = [each for each in measure_patterns(fit) if each.frame in names]
        return cls(
            wavefront=OPDMap(
                fit.wavefront,
                first.date,
                first.target,
                hashlib.sha256(fit.wavefront.tobytes()).hexdigest(),
            ),
            # The light of the star, by which a pedestal is changed, would double the file.
            patterns=PatternLibrary(tuple(replace(each, light=None) for each in measured)),
            star=first.target,
            filter=first.filter,
            image_mask=image_mask(first.header, first.name),
            detector=detector_of(first.header, first.name),
            frames=names,
            status=fit.status.name,
            chi2=float(fit.chi2_per_pixel),
            start=fit.initial.name,
        )

    def settings_for(
        self, observation: Observation, usual: GaussNewton | None = None
    ) -> GaussNewton:
        """Return the settings of a fit that starts from this wavefront.

        They are the usual ones, default those of `refine`, but for the prior, which is that of
        the drift from one star to the next. It grows by 1.75 nm rms a day, up to the usual one
        about a map, and is widened where the frames ask for it.
        """
        usual = settings_for(observation) if usual is None else usual
        date, sensed = observation.date, self.wavefront.date
        days = 0.0 if date is None or sensed is None else abs(float((date - sensed).jd))
        prior = slew_drift(_DAILY * days)
        if days > _NEW or prior.scales["segment"] >= usual.prior.scales["segment"]:
            return usual
        return replace(usual, prior=replace(usual.prior, scales=prior.scales, knee=prior.knee))

    def pattern_for(self, observation: Observation) -> Systematics | None:
        """Return the flat-field pattern on the pixels of an observation of another star.

        None if fewer than two frames show half of them.
        """
        patterns = self.patterns.matching(observation)
        return combine_patterns(patterns) if len(patterns) > 1 else None

    @property
    def stars(self) -> tuple[CatalogueStar, ...]:
        """The star, by every name and by the coordinates that are known."""
        known = tuple(dict.fromkeys(star for each in self.patterns.patterns for star in each.stars))
        return known or (CatalogueStar((self.star,)),)

    @property
    def flat(self) -> str | None:
        """Flat field with which its frames were calibrated; None if there are several."""
        flats = {each.flat for each in self.patterns.patterns}
        return flats.pop() if len(flats) == 1 else None

    def has(self, observation: Observation) -> bool:
        """Whether an observation is of one of the exposures that were fitted, by name or date."""
        dates = {each.date for each in self.patterns.patterns if each.date}
        date = observation.date
        return observation.name in self.frames or (date is not None and date.isot in dates)

    def require_setup_of(self, observation: Observation) -> None:
        """Raise for frames that this star says nothing of.

        Raises
        ------
        IncompatibleSetupError
            For another filter, mask or detector, and for frames of this very star.
        """
        name, differing = observation.name, contradiction(self, observation)
        if differing is not None:
            what, here, there = differing
            raise IncompatibleSetupError(
                f"{name}: got the {what} {there}, expected {here}, that of the reference star "
                f"{self.star}"
            )
        if self.has(observation):
            raise IncompatibleSetupError(
                f"{name} is one of the frames that the reference star {self.star} was fitted to, "
                "expected frames of another star. Give a wavefront map"
            )
        if shows_star(self, observation):
            raise IncompatibleSetupError(
                f"{name} shows {self.star}, the star that the wavefront was fitted to, expected "
                "frames of another star: light of its planets may be part of that wavefront. Give "
                "a wavefront map"
            )

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write to a FITS file, atomically.

        The extension OPD has the wavefront, so that the file can be read as a wavefront map
        (`read_opd`), and the others are those of a `PatternLibrary`.

        Parameters
        ----------
        path : path
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        ExistingFileError
            If the file exists, and `overwrite` is False; it is also an `OSError`.
        """
        require_new([path], overwrite)
        hdus = self.patterns.to_hdus()
        header = hdus[0].header
        header[_CARD] = (fits_text(self.star), "star that was fitted")
        header["FILTER"], header["CORONMSK"] = self.filter or "", self.image_mask or ""
        header["DETECTOR"] = self.detector or ""
        set_keyword(header, "DRSTAT", self.status)
        set_keyword(header, "DRCHI2", self.chi2)
        set_keyword(header, "DROPD", self.start)
        for k, name in enumerate(self.frames, 1):
            header[f"FRAME{k}"] = fits_text(name)
        image = fits.ImageHDU(self.wavefront.data, name="OPD")
        image.header["BUNIT"] = "m"
        if self.wavefront.date is not None:
            image.header["DATE-OBS"] = self.wavefront.date.utc.isot
        hdus.insert(1, image)
        write_fits(hdus, path)
        return Path(path)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read what `write` wrote.

        Raises
        ------
        CorruptFileError
            If the file is truncated or holds something else.
        """
        path = Path(path)
        with open_fits(path) as hdus:
            header = hdus[0].header.copy()
        if _CARD not in header:
            raise CorruptFileError(
                f"{path.name}: no reference star in it ({_CARD}), expected a file that "
                "ReferenceStar.write made, such as reference.fits of a reduction"
            )
        return cls(
            wavefront=read_opd(path),
            patterns=PatternLibrary.read(path),
            star=header[_CARD],
            filter=header["FILTER"] or None,
            image_mask=header["CORONMSK"] or None,
            detector=header["DETECTOR"] or None,
            frames=tuple(header["FRAME*"].values()),
            status=header["DRSTAT"],
            chi2=float(header["DRCHI2"]),
            start=header["DROPD"],
        )


def reference_star_in(opd: object) -> ReferenceStar | None:
    """Return the reference star that stands in place of a map, or of whose file it was read."""
    if isinstance(opd, ReferenceStar):
        return opd
    path = opd.path if isinstance(opd, OPDMap) else opd
    if not isinstance(path, str | os.PathLike) or not Path(path).is_file():
        return None
    try:
        with open_fits(path, images=False) as hdus:
            is_one = _CARD in hdus[0].header
    except CorruptFileError:
        return None  # What is wrong is said where it is read as a map.
    return ReferenceStar.read(path) if is_one else None
