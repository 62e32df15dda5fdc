"""The jobs of a survey, named by a hash of everything that decides their result."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from pyklip_diffrender._version import __version__
from pyklip_diffrender.errors import CorruptFileError, DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.io.files import sha256
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.opd_map import FLAT
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.surveys.config import Config, Options, SequenceConfig
from pyklip_diffrender.wavefront.map_choice import wavefront_for

__all__ = ["Injection", "Job", "jobs_of"]

_SWITCHES = ("wide", "disk", "completeness")
"""Options that are named in the key of a job where they are on."""

_DIGITS = 12
"""Digits of the key at the end of the name of a folder."""

_SUFFIXES = (".fits", ".fits.gz")


@dataclass(frozen=True)
class Injection:
    """A planet to add to the frames.

    Attributes
    ----------
    contrast : float
    separation : float
        arcsec.
    angle : float
        Position angle, degrees east of north.
    """

    contrast: float
    separation: float
    angle: float


@dataclass(frozen=True)
class Job:
    """One reduction.

    Attributes
    ----------
    key : str
        Hash of the package's version, the content of the input files, and the options.
    name : str
        Name of the sequence, by default target and filter, with the date of the epoch if it has
        several.
    files : tuple of str
        Frames.
    opd : str
        Wavefront map.
    inputs : dict of str to str
        SHA-256 of every file that is read.
    target, filter : str or None
    epoch : str or None
        Date in the epoch, of a sequence that has several.
    options : Options
    injection : Injection or None
    base : str or None
        Key of the job whose fit an injection starts from.
    version : str
        Of the package.
    """

    key: str
    name: str
    files: tuple[str, ...]
    opd: str
    inputs: Mapping[str, str]
    target: str | None = None
    filter: str | None = None
    epoch: str | None = None
    options: Options = field(default_factory=Options)
    injection: Injection | None = None
    base: str | None = None
    version: str = __version__

    @property
    def folder(self) -> str:
        """Name of the folder with its products: what the job is, and the beginning of the key."""
        return _folder(str(self), self.key)

    @property
    def base_folder(self) -> str | None:
        """The same of the job whose fit an injection starts from."""
        return None if self.base is None else _folder(self.name, self.base)

    def __str__(self) -> str:
        planet = self.injection
        if planet is None:
            return self.name
        return (
            f"{self.name}, planet of {planet.contrast:.3g} at {planet.separation:g} arcsec, "
            f"{planet.angle:g} deg"
        )


def jobs_of(config: Config) -> list[Job]:
    """Return the jobs of a survey; every injection comes after the job that it starts from.

    Raises
    ------
    IncompatibleSetupError
        With everything that is wrong with the inputs, one line for each mistake.
    """
    jobs: dict[str, Job] = {}
    problems = []
    # Sequences may share files.
    digest = cache(sha256)
    for sequence in config.sequences:
        try:
            planned = _jobs(sequence, digest)
        except (DiffrenderError, OSError) as error:
            problems.append(f"{sequence.name}: {error}")
            continue
        if not sequence.is_named and {job.name for job in planned} & {
            j.name for j in jobs.values()
        }:
            # Another sequence of the same target and filter.
            planned = [replace(job, name=f"{job.name}, {sequence.name}") for job in planned]
        for job in planned:
            if job.key in jobs:
                problems.append(f"{job}: got the same inputs and options as {jobs[job.key]}")
            jobs[job.key] = job
    if problems:
        raise IncompatibleSetupError("\n  ".join(["survey: nothing was started:", *problems]))
    return list(jobs.values())


def _jobs(sequence: SequenceConfig, digest: Callable[[Path], str]) -> list[Job]:
    files = _files(sequence.files)
    planets = sequence.injections
    jobs = []
    for opd, epoch, name in _epochs(sequence, files):
        plain = _job(replace(sequence, name=name), files, opd, epoch, digest)
        injected = [
            _with_planet(plain, Injection(contrast, separation, angle))
            for contrast in planets.contrasts
            for separation in planets.separations
            for angle in planets.angles
        ]
        jobs += [plain, *injected]
    return jobs


def _epochs(sequence: SequenceConfig, files: list[Path]) -> list[tuple[Path, str | None, str]]:
    """Wavefront map, date and name of every epoch; without a date if there is just one."""
    of_folder = str(sequence.opd) != FLAT and sequence.opd.is_dir()
    try:
        epochs = Sequence.by_epoch(files, target=sequence.target, filter=sequence.filter)
    except DiffrenderError:
        if of_folder:
            raise
        return [(sequence.opd, None, sequence.name)]  # The job will fail, and its row says why.
    opd = sequence.opd
    return [
        (
            # As `reduce` chooses it: the one nearest to the target's frames.
            opd / wavefront_for(opd, each.date).name if of_folder else opd,
            each.date.isot if len(epochs) > 1 and each.date is not None else None,
            sequence.name if sequence.is_named else f"{each.target} {each.filter or ''}".rstrip(),
        )
        for each in epochs
    ]


def _job(
    sequence: SequenceConfig,
    files: list[Path],
    opd: Path,
    epoch: str | None,
    digest: Callable[[Path], str],
) -> Job:
    pattern, star = sequence.options.systematics, sequence.options.star_flux
    known = [] if pattern in ("auto", "references", "off") else _files((Path(pattern),))
    maps = [] if str(opd) == FLAT else [opd]
    inputs = {str(path): digest(path) for path in (*files, *maps, *known)}
    facts = {
        "version": __version__,
        "frames": sorted(inputs[str(path)] for path in files),
        "opd": inputs.get(str(opd), FLAT),
        "target": sequence.target,
        "filter": sequence.filter,
        "size": sequence.options.size,
        "threshold": sequence.options.threshold,
        "systematics": (
            inputs.get(pattern) or sorted(inputs[str(path)] for path in known) or pattern
        ),
        "settings": dict(sequence.options.settings),
        # Only where they are used, so that jobs of configurations without them keep their names.
        **{name: True for name in _SWITCHES if getattr(sequence.options, name)},
        **({} if star is None else {"star_flux": [star, sequence.options.star_flux_error]}),
        **({} if epoch is None else {"epoch": epoch}),
    }
    return Job(
        _hash(facts),
        sequence.name if epoch is None else f"{sequence.name} {epoch[:10]}",
        tuple(map(str, files)),
        str(opd),
        inputs,
        sequence.target,
        sequence.filter,
        epoch,
        sequence.options,
    )


def _with_planet(base: Job, planet: Injection) -> Job:
    key = _hash({"base": base.key, "planet": [planet.contrast, planet.separation, planet.angle]})
    return replace(base, key=key, injection=planet, base=base.key)


def _folder(label: str, key: str) -> str:
    readable = re.sub(r"[^A-Za-z0-9.+-]+", "-", fits_text(label)).strip("-.")[:80]
    return f"{readable}_{key[:_DIGITS]}"


def _hash(facts: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _files(paths: tuple[Path, ...]) -> list[Path]:
    """Files of a folder, or the files themselves."""
    if len(paths) > 1 or not paths[0].is_dir():
        return list(paths)
    inside = sorted(each for each in paths[0].iterdir() if each.name.endswith(_SUFFIXES))
    if not inside:
        raise CorruptFileError(f"{paths[0]}: the folder has no FITS files")
    return inside
