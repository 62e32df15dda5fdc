"""Output files that appear complete or not at all, with provenance in their headers."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.time import Time

from pyklip_diffrender._version import __version__
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.keywords import set_keyword
from pyklip_diffrender.pyklip_backend.dataset_frames import Frames
from pyklip_diffrender.pyklip_backend.product_images import ProductImages
from pyklip_diffrender.pyklip_backend.subtract import Subtraction
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["ReductionRecord", "folder_and_prefix", "provenance", "staging", "stamp"]


@dataclass(frozen=True, eq=False)
class ReductionRecord:
    """How the frames of one wavelength were reduced.

    Attributes
    ----------
    frames : Frames
        The fitted frames.
    opd : OPDMap
        The wavefront map at the start.
    subtraction : Subtraction
        The fitted star.
    filled : int
        Flagged pixels that were replaced after the subtraction.
    image : str
        Image that the products carry, see `DiffrenderSettings`.
    """

    frames: Frames
    opd: OPDMap
    subtraction: Subtraction
    filled: int
    image: str = "subtracted"

    def __repr__(self) -> str:
        filter_ = self.frames.observation.filter or "given model"
        return (
            f"<ReductionRecord: {filter_}, {self.subtraction!r}, image {self.image!r}, map "
            f"{self.opd.name}>"
        )

    @cached_property
    def images(self) -> ProductImages:
        """Other images of the frames."""
        return ProductImages(self.subtraction)

    def __deepcopy__(self, memo: dict[int, Any]) -> ReductionRecord:
        """Itself: it never changes, and a contrast curve copies its dataset 120 times."""
        return self


def folder_and_prefix(folder: str | os.PathLike[str], prefix: str) -> tuple[Path, str]:
    """Split where products go into a folder, which is checked before an hour of fitting, and names.

    Parameters
    ----------
    folder : path
        The argument `outputdir`.
    prefix : str
        The argument `fileprefix`, which may begin with folders.

    Raises
    ------
    FileNotFoundError
        If there is no such folder; pyKLIP does not make it either.
    PermissionError
        If nothing can be written there.
    """
    inside, name = os.path.split(str(prefix))
    path = (Path(folder or ".") / inside).resolve()
    argument = "fileprefix" if inside else "outputdir"
    if not path.is_dir():
        raise FileNotFoundError(f"{argument}: {path} is not a folder; make it first")
    if not os.access(path, os.W_OK | os.X_OK):
        raise PermissionError(f"{argument}: {path} cannot be written to")
    return path, name


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """Path of a temporary folder whose files are moved to `folder` if the block succeeds.

    It is inside `folder`, so that each move is one step on the same file system. If the block
    raises, the files are deleted and `folder` is unchanged. The block makes the folder when it has
    something to write: a process that is killed during a long fit then leaves nothing behind.
    """
    stage = folder / f".diffrender-{secrets.token_hex(6)}"
    try:
        yield stage
        for path in sorted(p for p in stage.rglob("*") if p.is_file()):
            target = folder / path.relative_to(stage)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    finally:
        if stage.exists():
            shutil.rmtree(stage)


def provenance(records: Sequence[ReductionRecord]) -> fits.Header:
    """Cards for a product made from these wavelengths: keywords, then HISTORY.

    A keyword holds the value that all fits share; chi2 and status are those of the worst fit.
    HISTORY has them all.
    """
    fits_of_all = [fit for record in records for fit in record.subtraction.fits]
    worst = max(fits_of_all, key=lambda fit: fit.chi2)
    first = records[0]
    companions = max(record.subtraction.kept for record in records)
    header = fits.Header()
    values: dict[str, Any] = {
        "DRALGO": "diffrender",
        "DRVERS": __version__,
        "DROPD": first.opd.name,
        "DRSHA256": first.opd.sha256,
        "DRFILT": _shared(r.frames.observation.filter or "" for r in records),
        "DRSTAT": worst.status,
        "DRCHI2": worst.chi2,
        "DRNFIT": len(fits_of_all),
        "DRKEPT": companions,
        "DRSYST": _shared(r.subtraction.systematics for r in records),
        "DRREFS": sum(r.subtraction.references for r in records),
        "DRPIXELS": _shared(r.frames.pixels for r in records),
        "DRFILLED": sum(r.filled for r in records),
        "DRIMAGE": _shared(r.image for r in records),
        "DRNOISE": _shared(r.frames.noise for r in records),
    }
    dates = [pointing.observation.date for pointing in first.frames.pointings]
    known = [date for date in dates if date is not None]
    days = first.opd.days_after(Time(known).mean()) if known else None
    if first.opd.date is not None:
        values["DROPDDAT"] = first.opd.date.isot
    if days is not None:
        values["DROPDHRS"] = 24 * days
    for key, value in values.items():
        set_keyword(header, key, value)
    header.add_history(
        f"Star rendered and subtracted by pyklip_diffrender {__version__}; the "
        "KL modes are all the same image"
    )
    header.add_history("DRSHA256 is the SHA-256 of the wavefront map's file, or of its array")
    for record in records:
        frames, subtraction = record.frames, record.subtraction
        line = (
            f"diffrender: {frames.observation.name}, {frames.observation.filter or 'given model'}, "
            f"opd {record.opd.name}, "
            f"{frames.pixels} pixels, errors {frames.noise}"
        )
        header.add_history(fits_text(line))
        for fit in subtraction.fits:
            header.add_history(
                f"diffrender: frames {', '.join(map(str, fit.frames))}: {fit.status}, "
                f"chi2/N {fit.chi2:.4g}"
            )
        for line in _fitted(subtraction):
            header.add_history(f"diffrender: {line}")
    return header


def _fitted(subtraction: Subtraction) -> Iterator[str]:
    """The settings of the fits, their companions, and the star of every pointing, in words."""
    for result in dict.fromkeys(part.result for part in subtraction.pointings):
        free, settings = ", ".join(result.settings.free), result.settings
        yield f"fit: free {free}, cycles {settings.cycles}, tolerance {settings.tolerance}"
        for contrast, x, y in result.companions:
            yield f"companion: contrast {contrast:.3g} at x {x:.4f}, y {y:.4f} arcsec from the star"
    for part in subtraction.pointings:
        x, y = -part.from_star(np.zeros(2))
        yield (
            f"frames {', '.join(map(str, part.pointing.frames))}: star at x {x:+.4f}, y {y:+.4f} "
            f"arcsec from its place in the file, flux {part.frame.flux:.6g}, background "
            f"{float(part.frame.values['background'][0]):.4g}"
        )


def stamp(folder: Path, cards: fits.Header) -> None:
    """Add cards to the primary header of every FITS file in a folder; pixels stay as they are."""
    for path in (p for p in folder.rglob("*") if ".fits" in p.suffixes):
        with fits.open(path, mode="update", memmap=False) as hdus:
            hdus[0].header.extend(cards, strip=False, update=True)


def _shared(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))
