"""Tables of the pages that are made from the code and from the results of benchmarks."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from pyklip_diffrender.io.headers import KEYWORDS
from pyklip_diffrender.options import OPTIONS

__all__ = ["hard_cases", "keywords", "options", "scene_needs", "situations", "write_tables"]

RESULTS = Path(__file__).parent / "results"

GOOD = 0.03
"""Largest change of the limits for a model that is good enough."""


def options() -> list[list[str]]:
    """Rows for the options of `reduce`: name, default, option of the command line, meaning."""
    return [
        [
            f"`{each.name}`: {each.stated_type}",
            f"`{each.default!r}`",
            "" if each.not_on_command_line else f"`{each.flag}`",
            each.meaning,
        ]
        for each in OPTIONS.values()
    ]


@dataclass(frozen=True)
class Situation:
    """What somebody has, what `reduce` makes of it by itself, and what else can be done.

    Attributes
    ----------
    name : str
    alone : str
        What the package does without options.
    values : dict
        Options to set, by name, with a value each.
    beside : str
        What else to do, in Markdown.
    expect : str
    """

    name: str
    alone: str
    values: dict[str, Any]
    beside: str
    expect: str

    @property
    def passed(self) -> str:
        """Options in Python and on the command line, and what else to do."""
        texts = [
            f"`{name}={_as_text(value)}` (`{_in_a_command(name, value)}`)"
            for name, value in self.values.items()
        ]
        return " ".join([*texts, self.beside] if self.beside else texts) or "nothing"


def _as_text(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _in_a_command(name: str, value: Any) -> str:
    option = OPTIONS[name]
    if option.is_switch:
        return option.flag
    return f"{option.flag} {_as_text(value) if ' ' in str(value) else value}"


_DATA = "../validation/real_frames.md"
_PATTERN = "detector_pattern.md#a-library-of-your-own"

SITUATIONS = (
    Situation(
        "one roll", "Fits the roll with the pattern of the library.", {}, "",
        "Structure that is fixed on the detector can pass for a planet, which false-alarm "
        "probabilities include. Confirm a candidate with another roll.",
    ),
    Situation(
        "two rolls", "Fits one wavefront to both, with the pattern of the library. Without one, "
        "the rolls share a pattern of unknown values.", {}, "",
        f"Limits [beside KLIP's]({_DATA}), and KLIP's curve in the report.",
    ),
    Situation(
        "a reference star, one frame", "It joins the wavefront where that makes limits deeper.",
        {}, "", "Little of it with the library. Ask for dithers when you propose.",
    ),
    Situation(
        "a reference star, dithered", "All frames in one likelihood, where limits are deeper.",
        {}, "",
        "[Deeper limits](../validation/references.md) in about twice the time of the rolls alone.",
    ),
    Situation(
        "reference stars of other epochs or programmes", "They teach the pattern where the library "
        "has none, and are in KLIP's curve.", {"pattern": "references"},
        "to learn from them beside the library. Give their files with the target's.",
        "A fit of each star at each epoch, as long as the target's.",
    ),
    Situation(
        "a disk", "The star takes most of its light. Candidates in a row along it are said to look "
        "like extended light.", {"disk": True}, "",
        "The disk without the star, and limits where a planet would not be taken for a part of it. "
        f"Bright disks end as `MODEL_MISMATCH` ([AU Mic]({_DATA}#a-disk-au-mic)).",
    ),
    Situation(
        "a binary or bright neighbour", "Fitted with the star.", {},
        "`from_files(star=(x, y))` (`--star X Y`) if a frame is refused because the neighbour is "
        "taken for the star",
        "[Limits higher by its photon noise](../validation/neighbours.md), and a little more.",
    ),
    Situation(
        "a crowded field", "Fits bright sources with the star, also those beyond the fitted "
        "square.", {"wide": True}, "",
        "A search to the edge of the frames. Many bright sources within 3.5 arcsec end as "
        "`MODEL_MISMATCH`.",
    ),
    Situation(
        "no OPD map", "Asks for one.", {"star_flux": "0.45 Jy"},
        'with the map `"flat"` (`--opd flat`); or fetch the map of the day (`--opd mast`)',
        f"Nearly the same limits in twice the time, but [the star's flux is uncertain]({_DATA}"
        "#the-opd-map) unless you state it.",
    ),
    Situation(
        "a filter, mask or pipeline version without a pattern", "Reference stars teach it; without "
        "them, rolls share a pattern of unknown values.", {"pattern": "patterns"},
        f"after [learning it]({_PATTERN}) from other stars (`pyklip-diffrender learn`)",
        "Higher limits near the star than with a pattern. A single roll usually ends as "
        "`MODEL_MISMATCH`.",
    ),
    Situation(
        "a mask that is not supported", "Refuses the files, with the reason.", {},
        "a model [from poppy or stpsf](../bridges.md) and `refine`, `detect`",
        "The same fit and search, without patterns and `reduce`.",
    ),
    Situation(
        "several filters or epochs", "The command line reduces each, and searches all together. "
        "Python asks which filter.", {}, "`dr.combine` of the reductions in Python",
        "[One table of candidates](combined.md), with companions told from background sources.",
    ),
    Situation(
        "a known flux of the star", "Takes the star's flux from diffracted light, to 10 %.",
        {"star_flux": "0.45 Jy"}, "",
        "[Errors of contrasts](star_flux.md) with the error of this flux instead.",
    ),
    Situation(
        "little time", "A full reduction.", {"accuracy": "quick"}, "",
        "[A first look](../validation/speed_error.md#a-first-look) out to 1.7 arcsec in a third "
        "to half of the time.",
    ),
    Situation(
        "little memory", "Takes what it needs.", {"memory": "2.5 GB"}, "",
        "The same result, [more slowly](resources.md#what-costs-memory). Frames of reference stars "
        "for which there is none are left out.",
    ),
)  # fmt: skip
"""Situations, from what most observers have to what few do."""


def situations() -> list[list[str]]:
    """Rows for what to do when: situation, by itself, to pass, to expect."""
    return [[each.name, each.alone, each.passed, each.expect] for each in SITUATIONS]


def keywords() -> list[list[str]]:
    """Rows for the package's FITS keywords: name, files, comment, meaning."""
    return [
        [f"`{each.name}`", each.files, each.comment, each.meaning] for each in KEYWORDS.values()
    ]


def scene_needs(window: int = 80) -> list[list[str]]:
    """Rows for the cheapest model that is good enough, by how much fainter the star is."""
    table = Table.read(RESULTS / "scene_fidelity.ecsv")
    table = table[table["window"] == window]
    rows = [["star", "modes of the wavefront", "wavelengths", "samples across the pupil"]]
    for fainter in dict.fromkeys(table["fainter"]):
        cases = {
            str(row["model"]): float(row["change"]) for row in table[table["fainter"] == fainter]
        }
        modes = _cheapest(cases, "modes to", "all")
        name = "as it is" if fainter == 1 else f"{fainter} times fainter"
        waves = _cheapest(cases, "nlambda: ", "7").removeprefix("nlambda: ")
        samples = "128" if cases["npix: 128"] <= GOOD else "256"
        rows.append([name, modes.removeprefix("modes "), waves, samples])
    return rows


def _cheapest(cases: dict[str, float], kind: str, finest: str) -> str:
    """The last of the cases of a kind, from fine to coarse, before one is not good enough."""
    best = finest
    for name, change in cases.items():
        if name.startswith(kind):
            if change > GOOD:
                break
            best = name
    return best


def like_with_like() -> list[list[str]]:
    """KLIP's limits over this package's for pairs of real rolls, by what both were given."""
    table = Table.read(RESULTS / "like_with_like.ecsv")
    separations = sorted(set(table["separation"].value.tolist()))
    rows = [["star, filter", "library, references", *(f'{each:g}"' for each in separations)]]
    for case in table.group_by(["library", "references", "star", "filter"]).groups:
        first = case[0]
        given = f"{first['library']}, {first['references']}"
        ratios = [f"{each:.2f}" for each in case["ratio"]]
        rows.append([f"{first['star']}, {first['filter']}", given, *ratios])
    # Without the library first, with references before without.
    head, *rest = rows
    return [head, *sorted(rest, key=lambda row: ("no lib" not in row[1], "no ref" in row[1]))]


def hard_cases() -> Table:
    """Hard cases with the error of the fitted star and the status of the fit."""
    table = Table.read(RESULTS / "stability_fits.ecsv")
    return table[np.isfinite(table["error"])]


def _write(path: Path, rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(rows)


def write_tables(folder: Path) -> None:
    """Write the tables as CSV files into a folder."""
    _write(folder / "options.csv", options())
    _write(folder / "situations.csv", situations())
    _write(folder / "keywords.csv", keywords())
    _write(folder / "scene_needs.csv", scene_needs())
    _write(folder / "like_with_like.csv", like_with_like())
