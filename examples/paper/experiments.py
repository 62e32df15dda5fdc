"""Write reports/experiments.md and its figures from the tables of the paper's experiments.

    python examples/paper/experiments.py

Run it from the root of the project after the studies have written their tables to docs/results.
A study that has not been run has no section.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from astropy.table import Table
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parent))
import beyond
import contrast_boundary
import contrast_drift
import klip_table
import location
import misalignment
import progress
import snr_grid
from overview import sentences, summary_table, where_others_lead
from pages import RESULTS, study_table
from pictures import image_path, read_images
from sections import (
    Lines,
    about_beyond,
    about_boundary,
    about_drift,
    about_grid,
    about_klip,
    about_location,
    about_misalignment,
    about_progress,
)

from pyklip_diffrender.drawing import save
from pyklip_diffrender.io.files import replacing


@dataclass(frozen=True)
class Study:
    """A section of the page."""

    name: str
    title: str
    module: Any
    lines: Callable[[Table], Lines]
    pictures: bool = False


STUDIES = (
    Study("klip_table", "Comparison with KLIP: six planets", klip_table, about_klip),
    Study("contrast_boundary", "Contrast against separation", contrast_boundary, about_boundary),
    Study("contrast_drift", "Contrast against drift", contrast_drift, about_drift, True),
    Study("location", "Location of the planet", location, about_location),
    Study("misalignment", "A misaligned Lyot stop", misalignment, about_misalignment),
    Study("progress", "Progress of the optimisation", progress, about_progress, True),
    Study("snr_grid", "SNR against contrast, drift and separation", snr_grid, about_grid),
    Study("beyond", "Beyond the paper", beyond, about_beyond),
)

TITLES = {study.name: study.title for study in STUDIES}

ELSEWHERE = ("snapshots", "companions", "ring")
"""The paper's experiments that are shown with the calibration."""


def description(module: Any) -> str:
    """The docstring of a script after its title and command."""
    parts = str(module.__doc__).strip().split("\n\n")
    return "\n\n".join(parts[2:])


LIMITS = """\
- Frames and fits come from the same simulator. Effects that both lack are studied in *Beyond the
  paper* and on real frames.
- The annulus SNR is not a significance. Light of the planet outside its aperture counts as noise,
  so that it saturates near 30, and faint residuals of the star may increase it. It does not account
  for lost light. A fit follows some of the noise in the annulus and may exceed the true star. The
  matched filter's S/N of a subtracted frame uses the scatter on the planet's ring, at least the
  photon noise; at 0.2 arcsec the ring has too few positions. The photon limit includes the photon
  noise of the planet, the ring does not, so that well-subtracted bright planets exceed it.
- The paper's recipe is given the star's flux, its position and the alignment; Gauss-Newton and the
  marginalised estimate fit them. Its steps are taken on 256 instead of 1024 pupil samples, which
  changed the star-model error of one frame by 0.2 %.
- KLIP's library has wavefronts along the drift of the target, closer to it than an archive's.
- Spreads are the 16 and 84 percentiles over noise realisations of the same wavefronts.
- Marginalised S/N up to 25 are slightly too low: the version that made these tables counted the
  light of a planet as noise (1 % of the S/N at 10, 3 % at 20).
"""


def computing_time(results: Path) -> list[str]:
    """Duration of all studies."""
    studies = [study_table(results, name) for name in (*TITLES, *ELSEWHERE)]
    seconds = sum(table.meta["seconds"] for table, *_ in filter(None, studies))
    return [
        f"The full set took {seconds / 3600:.1f} hours on two cores; the small set (`--quick`), "
        "which the tests run, 3.2 minutes.",
        "",
    ]


def write(results: Path, docs: Path) -> Path:
    """Write page and figures; returns the page."""
    lines = [
        "# The paper's experiments, compared with KLIP",
        "",
        "Written by `python examples/paper/experiments.py` from the tables in `docs/results`. The "
        'experiments are those of Feng et al., "Exoplanet Imaging via Differentiable Rendering" '
        "(2025). *Adam* is the paper's recipe, *Gauss-Newton* the residual of this package's fit, "
        "*marginalised* its estimate of a planet with the wavefront marginalised (as an image: "
        "the star-subtracted frame with the candidates in the model), *optimal* the true star. "
        "Medians, with the 16 and 84 percentiles.",
        "",
        "![Contrast against separation](images/paper_contrast_boundary.png)",
        "",
        *sentences(results),
        *summary_table(results),
        *where_others_lead(results),
        "Several measurements of one planet and several planets in one frame, the paper's other "
        "two experiments, are in the report on calibration.",
        "",
        *computing_time(results),
        "## Limits",
        "",
        LIMITS,
    ]
    for study in STUDIES:
        study_result = study_table(results, study.name)
        if study_result is None:
            continue
        table, path, label = study_result
        images = (read_images(image_path(path)),) if study.pictures else ()
        figure: Figure = study.module.draw(table, *images)
        save(figure, docs / "images" / f"paper_{study.name}.png", dpi=110)
        lines += [
            f"## {study.title}",
            "",
            description(study.module),
            "",
            f"![{study.title}](images/paper_{study.name}.png)",
            "",
            *study.lines(table),
            f"On {label}: `{table.meta['command']}`, {table.meta['date']}, "
            f"{table.meta['seconds'] / 60:.0f} min ({table.meta['machine']}).",
            "",
        ]
    page = docs / "experiments.md"
    with replacing(page) as temporary:
        temporary.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
    return page


def main() -> None:
    """Write page and figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--docs", type=Path, default=Path("reports"))
    arguments = parser.parse_args()
    print(f"wrote {write(arguments.results, arguments.docs)}")


if __name__ == "__main__":
    main()
