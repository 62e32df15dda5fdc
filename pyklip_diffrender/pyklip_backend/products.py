"""Products that appear complete or not at all, with a header that says how they were made."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from astropy.io import fits

from pyklip_diffrender import __version__
from pyklip_diffrender.pyklip_backend.frames import Frames
from pyklip_diffrender.pyklip_backend.subtract import Subtraction
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["Made", "provenance", "require_folder", "staging", "stamp"]


@dataclass(frozen=True, eq=False)
class Made:
    """What was done to the frames of one wavelength.

    Attributes
    ----------
    frames : Frames
        What was fitted.
    opd : OPDMap
        Where the fit started.
    subtraction : Subtraction
        The star that was found.
    filled : int
        Flagged pixels that were replaced after the subtraction.
    """

    frames: Frames
    opd: OPDMap
    subtraction: Subtraction
    filled: int

    def __deepcopy__(self, memo: dict[int, Any]) -> Made:
        """Itself: it never changes, and a contrast curve copies its dataset 120 times."""
        return self


def require_folder(folder: str | os.PathLike[str]) -> Path:
    """Resolve the output folder before an hour of fitting, not after.

    Raises
    ------
    FileNotFoundError
        If there is none: pyKLIP does not make it either.
    PermissionError
        If nothing can be written there.
    """
    path = Path(folder or ".").resolve()
    if not path.is_dir():
        raise FileNotFoundError(f"outputdir: {path} is not a folder; make it first")
    if not os.access(path, os.W_OK | os.X_OK):
        raise PermissionError(f"outputdir: {path} cannot be written to")
    return path


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """Give an empty folder whose files move to `folder` when the block ends well.

    It lies inside `folder`, so that each move is one step on the same file system. If the block
    raises, the staged files are gone and `folder` is as it was.
    """
    stage = Path(tempfile.mkdtemp(prefix=".diffrender-", dir=folder))
    try:
        yield stage
        for path in sorted(p for p in stage.rglob("*") if p.is_file()):
            target = folder / path.relative_to(stage)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    finally:
        shutil.rmtree(stage)


def provenance(made: Sequence[Made]) -> fits.Header:
    """Cards for a product made from these wavelengths, in order: keywords, then HISTORY.

    A keyword holds the one value that all fits share, or for chi2 and the status that of the
    worst fit; HISTORY holds all of them.
    """
    worst = max((m.subtraction.worst for m in made), key=lambda fit: fit.chi2)
    first = made[0]
    header = fits.Header()
    values: list[tuple[str, Any, str]] = [
        ("DRALGO", "diffrender", "star subtraction algorithm"),
        ("DRVERS", __version__, "pyklip_diffrender version"),
        ("DROPD", first.opd.name, "wavefront map at the start"),
        # 64 digits leave no room for a comment on the card.
        ("DRSHA256", first.opd.sha256, ""),
        ("DRFILT", _shared([m.frames.filter or "" for m in made]), "filter of the model"),
        ("DRMETH", _shared([m.subtraction.method for m in made]), "refinement method"),
        ("DRSTAT", worst.status, "how the refinement ended"),
        ("DRSEED", first.subtraction.seed, "random seed"),
        ("DRCHI2", _number(worst.chi2), "chi2 per fitted pixel"),
        ("DRNFIT", sum(len(m.subtraction.fits) for m in made), "number of refinements"),
        ("DRKEPT", _companions(made), "most companions that a fit knew of"),
        ("DRPIXELS", _shared([m.frames.pixels for m in made]), "pixels that were fitted"),
        ("DRFILLED", sum(m.filled for m in made), "flagged pixels replaced by neighbours"),
        ("DRNOISE", _shared([m.frames.noise for m in made]), "where the errors came from"),
    ]
    for key, value, comment in values:
        header[key] = (value, comment) if comment else value
    header.add_history(
        f"Star rendered and subtracted by pyklip_diffrender {__version__}; the "
        "KL modes are all the same image"
    )
    header.add_history("DRSHA256 is the SHA-256 of the wavefront map's file, or of its array")
    for m in made:
        header.add_history(
            f"diffrender: {m.frames.name}, {m.frames.filter or 'given model'}, opd {m.opd.name}, "
            f"{m.subtraction.method}, seed {m.subtraction.seed}, {m.frames.pixels} pixels, errors "
            f"{m.frames.noise}"
        )
        for fit in m.subtraction.fits:
            header.add_history(
                f"diffrender: frames {', '.join(map(str, fit.frames))}: {fit.status}, "
                f"chi2/N {fit.chi2:.4g}"
            )
            plan = getattr(fit.result, "plan", None)
            if plan is not None:
                facts = ", ".join(f"{k[5:]} {v}" for k, v in plan.summary().items())
                header.add_history(f"diffrender: planned: {facts}")
    return header


def stamp(folder: Path, cards: fits.Header) -> None:
    """Add cards to the primary header of every FITS file in a folder; pixels stay as they are."""
    for path in (p for p in folder.rglob("*") if ".fits" in p.suffixes):
        with fits.open(path, mode="update", memmap=False) as hdus:
            hdus[0].header.extend(cards, strip=False, update=True)


def _shared(values: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(values))


def _companions(made: Sequence[Made]) -> int:
    """Of fits that say so; other subtractors may know nothing of companions."""
    return max(len(getattr(f.result, "companions", ())) for m in made for f in m.subtraction.fits)


def _number(value: float) -> float | str:
    """FITS has no NaN in headers."""
    return value if abs(value) < float("inf") else str(value)
