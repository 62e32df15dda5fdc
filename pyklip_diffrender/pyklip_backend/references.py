"""Frames of reference stars that a reduction may learn the flat-field pattern from."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.pyklip_backend.pointings import may_be_one_star
from pyklip_diffrender.pyklip_backend.source import REFERENCES
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.window import Window

__all__ = [
    "References",
    "files_of_setup",
    "library_files",
    "require_same_setup",
]

logger = logging.getLogger(__name__)

_SETUP = ("FILTER", "CORONMSK", "PUPIL", "DETECTOR")
"""Header keywords in which reference frames must agree with those of the target."""


@dataclass(frozen=True, eq=False)
class References:
    """Frames of reference stars that a reduction may use.

    Attributes
    ----------
    files : tuple of Path
        Files of the psf_library; they are read only where they are needed.
    frames : tuple of Observation
        Frames of the dataset itself.
    """

    files: tuple[Path, ...] = ()
    frames: tuple[Observation, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.files or self.frames)

    def cut(self, shape: tuple[int, int], target: Observation) -> list[Observation]:
        """Read all frames and cut the pixels about the star out of them.

        A file that cannot be used is left out, and so are frames of the target itself: its planets
        would become part of the pattern.
        """
        observations = list(self.frames)
        for path in self.files:
            try:
                frames = Observation.from_fits(path)
            except DiffrenderError as error:
                logger.warning("reference frames are left out: %s", error)
                continue
            if may_be_one_star(frames.header, target.header):
                logger.warning("%s is left out: it does not show another star", path.name)
                continue
            observations.append(replace(frames, reference=True))
        return [each.within(Window.about(each.center[0], shape)) for each in observations]


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


def require_same_setup(headers: Iterable[fits.Header], files: Sequence[Path]) -> None:
    """Refuse reference files of other filters, masks or detectors than those of the target.

    Parameters
    ----------
    headers : iterable of Header
        Of the target, one for each of its set-ups.
    files : sequence of Path

    Raises
    ------
    IncompatibleSetupError
    CorruptFileError
        If a file is gone.
    """
    targets = list(headers)
    for path in files:
        differences = [_difference(header, path) for header in targets]
        if all(differences):
            raise IncompatibleSetupError(
                f"psf_library: {path.name} was taken with {differences[0]}. Give only reference "
                "frames of the same set-up"
            )


def files_of_setup(header: fits.Header, files: Sequence[Path]) -> tuple[Path, ...]:
    """The reference files of the filter, mask and detector of a header of the target."""
    return tuple(path for path in files if _difference(header, path) is None)


def _difference(header: fits.Header, path: Path) -> str | None:
    """How the set-up of a reference file differs from that of the target, in words."""
    with open_fits(path) as hdus:
        theirs = hdus[0].header
        for key in _SETUP:
            ours, other = header.get(key), theirs.get(key)
            if None not in (ours, other) and str(ours).strip() != str(other).strip():
                return f"{key} {other}, the target with {ours}"
    return None
