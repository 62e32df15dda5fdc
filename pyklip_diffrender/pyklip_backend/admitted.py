"""Files of a dataset and of its library of reference stars, judged as `Sequence` judges files."""

from __future__ import annotations

import warnings
from collections import abc
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import DiffrenderWarning
from pyklip_diffrender.io.headers import header_text
from pyklip_diffrender.pyklip_backend.source import REFERENCES, SourceFrames
from pyklip_diffrender.scene.catalogue_star import star_of
from pyklip_diffrender.scene.exposure import is_reference
from pyklip_diffrender.scene.frame_files import FrameFile
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import Sequence

__all__ = ["Admitted", "admit", "library_files"]


class Admitted(NamedTuple):
    """Frames of a dataset that are used, and what else its files say.

    Attributes
    ----------
    target : ndarray of bool, (n,)
        Frames of the target.
    references : tuple of Observation
        Of reference stars, from the dataset and the library.
    """

    target: NDArray[np.bool_]
    references: tuple[Observation, ...]


def library_files(dataset: Any, psf_library: Any) -> tuple[Path, ...]:
    """Files of the frames in a PSF library, as far as they are known.

    Only a library that `JWSTData` read while the backend was registered has files.
    """
    paths = [Path(path) for path in getattr(dataset, REFERENCES, ())]
    chosen = np.asarray(psf_library.master_filenames)
    if psf_library.isgoodpsf is not None:
        chosen = chosen[psf_library.isgoodpsf]
    # pyKLIP appends the number of the integration to the name of the file.
    names = {str(name).rpartition("_INT")[0] for name in chosen}
    return tuple(path for path in paths if path.name in names)


def admit(source: SourceFrames, frames: NDArray[np.intp], library: abc.Sequence[Path]) -> Admitted:
    """Judge the files of frames of one filter, and those of the library.

    The target is the star of the first frame that is not marked as a reference (IS_PSF).

    Parameters
    ----------
    source : SourceFrames
    frames : ndarray of int
        Indices in `source`.
    library : sequence of Path
        Files of reference stars.

    Raises
    ------
    IncompatibleSetupError, NoValidPixelsError
        See `pyklip_diffrender.Sequence.from_files`.

    Warns
    -----
    DiffrenderWarning
        For every file that is not used, or not entirely, with the reason.
    """
    paths = [source.paths[k] for k in frames]
    sequence = source.sequence
    known = sequence is not None
    if sequence is None:
        sequence = _sequence(source, frames, paths, library)
    others = {str(each.get("FILTER")) for each in source.headers} - {str(sequence.filter)}
    for row in sequence.rows:
        if known and row.use == "excluded":
            continue  # Whoever has judged the files has said so.
        if row.remark and row.exposure.filter not in others:
            what = "is not used: " if row.use == "excluded" else ""
            warnings.warn(
                f"{row.exposure.name}: {what}{row.remark}", DiffrenderWarning, stacklevel=2
            )
    uses = {row.path: row.use for row in sequence.rows if row.use != "excluded"}
    names = [(path, source.filenames[k]) for path, k in zip(paths, frames, strict=True)]
    again = [each in names[:k] for k, each in enumerate(names)]
    if any(again):
        warnings.warn(
            f"{sum(again)} frames are in the dataset twice, and are used once",
            DiffrenderWarning,
            stacklevel=2,
        )
    marked = sum(uses.get(path) == "reference" for path in paths)
    if marked:
        warnings.warn(
            f"{marked} of {len(paths)} frames of the dataset show a reference star and stay NaN in "
            "the products. Give them to JWSTData as psflib_filepaths",
            DiffrenderWarning,
            stacklevel=2,
        )
    used = [uses.get(path) == "target" and not a for path, a in zip(paths, again, strict=True)]
    return Admitted(np.array(used), sequence.references)


def _sequence(
    source: SourceFrames,
    frames: NDArray[np.intp],
    paths: abc.Sequence[Path],
    library: abc.Sequence[Path],
) -> Sequence:
    """Sort the files of frames, and those of the library, none of which is opened twice."""
    headers = [source.headers[k] for k in frames]
    first = next((k for k, h in enumerate(headers) if not is_reference(h)), 0)
    name = source.filenames[frames[first]]
    return Sequence.of_opened(
        # Copies, into which the reasons are written.
        [replace(source.files[path]) for path in dict.fromkeys(paths)],
        [FrameFile.opened(path, frames=True) for path in library],
        target=next(iter(star_of(headers[first], name).names), None),
        filter=header_text(headers[first], "FILTER", name),
    )
