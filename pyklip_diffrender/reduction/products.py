"""The files that a reduction writes, and what the page of its report shows."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
from collections import abc
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy.table import QTable

from pyklip_diffrender import drawing
from pyklip_diffrender._version import __version__
from pyklip_diffrender.detection import Detection, Disk
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.files import read_text, replacing, require_new, write_table
from pyklip_diffrender.pattern import PatternChoice
from pyklip_diffrender.reduction.pages import (
    FIGURE_FORMATS,
    count,
    depth_against_klip,
    number,
    plus_minus,
    render,
    scientific,
    write_figures,
)
from pyklip_diffrender.reduction.pictures import Klip, Overview, ReportPictures, SkyImages
from pyklip_diffrender.reduction.pipeline import Checkpoint, ReductionResult
from pyklip_diffrender.reduction.reference_star import ReferenceStar
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.reduction.visit import Contribution, Visit
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.refinement.fit_file import decoded, encoded
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.scene.systematics import Systematics
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = [
    "PRODUCTS",
    "UNFINISHED",
    "ProductFolder",
    "existing_products",
    "page",
    "write_products",
    "write_report",
]


# The report: what its page shows of a summary, and its pictures.

_PHOTOMETRY = (
    "Flux densities and magnitudes (AB) are those of the source without coronagraph: the "
    "transmission of mask and Lyot stop is accounted for. Their errors do not include that of the "
    "pipeline's photometric calibration behind the coronagraph, about 30 % (0.3 mag)."
)
"""Whatever stands beside a flux density."""


def page(
    summary: Mapping[str, Any], shown: ReportPictures, files: Mapping[str, str] | None = None
) -> str:
    """The report as a page of HTML; `files` are names and contents of the files written with it."""
    status, first = summary["status"], summary["candidates"][:1]
    message = status["message"]
    wide = summary["wide_field"]
    return render(
        "report.html",
        summary=summary,
        shown=shown,
        files=files or {},
        setup=_setup(summary),
        tone="good" if status["name"] == "CONVERGED" else "warn" if status["usable"] else "bad",
        message=message[:1].upper() + message[1:] + ("" if message.endswith(".") else "."),
        key_facts=_key_facts(summary),
        sky_columns=[each for each in _SKY if first and each.key in first[0]],
        photometry=_PHOTOMETRY,
        outside=0 if wide is None else len(wide["candidates"]) - len(summary["candidates"]),
        deeper=depth_against_klip(summary["contrast_curve"], summary["klip_curve"]),
        age=_age(summary["wavefront_map"]["days_before_first_frame"]),
        provenance=_provenance(summary),
        settings=list(_flat(summary["settings"])),
    )


@dataclass(frozen=True)
class _Column:
    """A column of the table of candidates that not all frames allow."""

    title: str
    form: Callable[..., str]
    key: str
    error: str | None = None

    def write(self, row: Mapping[str, Any]) -> str:
        return self.form(*(row[each] for each in (self.key, self.error) if each))


_SKY = (
    _Column("Mid-exposure (UTC)", str, "epoch"),
    _Column("ΔRA cos Dec (arcsec)", plus_minus, "delta_ra_arcsec", "delta_ra_error_arcsec"),
    _Column("ΔDec (arcsec)", plus_minus, "delta_dec_arcsec", "delta_dec_error_arcsec"),
    _Column("Correlation of the two", "{:.2f}".format, "radec_corr"),
    _Column("Flux density (Jy)", scientific, "flux_density_Jy", "flux_density_error_Jy"),
    _Column("AB magnitude", plus_minus, "ab_mag", "ab_mag_error"),
)


def _setup(summary: Mapping[str, Any]) -> str:
    """Instrument, filter, mask, dates and frames in a line."""
    dates = [str(summary[key] or "")[:10] for key in ("first_date", "last_date")]
    targets = [each for each in summary["frames"] if each["use"] == "target"]
    uses = [each["use"] for each in summary["frames"] if each["use"] != "target"]
    words = {"wavefront": "in the likelihood", "pattern": "for the pattern"}
    purposes = [f"{uses.count(use)} {what}" for use, what in words.items() if use in uses]
    purposes += [f"{uses.count(use)} {use}" for use in ("KLIP only", "not used") if use in uses]
    parts = [
        summary["instrument"],
        summary["filter"],
        summary["image_mask"],
        summary["program"] and f"program {summary['program']}",
        " to ".join(dict.fromkeys(filter(None, dates))),
        count(len(targets), "frame") + " of the target",
        f"{count(len(uses), 'frame')} of reference stars: {', '.join(purposes)}" if uses else None,
        summary["exposure_s"] and f"{summary['exposure_s']:.0f} s on the target",
    ]
    return " · ".join(str(part) for part in parts if part)


def _key_facts(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    fit, map_, star = summary["fit"], summary["wavefront_map"], summary["star"]
    error = fit["model_error"]
    flux = []
    if star is not None:
        value = plus_minus(star["flux_density_Jy"], star["flux_density_error_Jy"])
        source = "as stated" if star["source"] == "star_flux" else "from its diffracted light"
        flux = [("Flux density of the star", f"{value} Jy, {source}")]
    return [
        ("Reduced chi-squared without model error", number(fit["reduced_chi2"])),
        (
            "Error of the star model",
            "none needed" if error == 0 else number(error and 100 * error, ".2g", "% of the star"),
        ),
        ("Errors multiplied by", number(fit["error_factor"])),
        ("Wavefront map", f"{map_['name']}, {_age(map_['days_before_first_frame'])}"),
        ("Flat-field pattern", _pattern(summary["systematics"])),
        *flux,
    ]


def _pattern(used: Mapping[str, Any] | None) -> str:
    """Where the flat-field pattern comes from, and how strong it is in the frames."""
    if used is None:
        return "none known"
    own, other = (", ".join(used[key]) for key in ("own_stars", "other_stars"))
    parts = [
        f"measured on the reference frames of {own}" if own else "",
        f"from earlier frames of {other}" if other else "",
    ]
    text = " and ".join(filter(None, parts)) or used["name"]
    if used["size"] is not None:
        text += f"; strength in these frames {plus_minus(used['size'], used['size_error'])}"
    return text


def _age(days: float | None) -> str:
    if days is None:
        return "date not known"
    return f"sensed {abs(days):.1f} days {'before' if days >= 0 else 'after'} the first frame"


def _provenance(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    rings = "; ".join(
        f"{number(each['chi2'], '.2f')} ({each['inner_arcsec']:.1f} to "
        f"{each['outer_arcsec']:.1f} arcsec)"
        for each in summary["fit"]["rings"]
    )
    return [
        ("Time of the fits", number(summary["seconds"], ".1f", "s")),
        ("Chi-squared per pixel", number(summary["fit"]["chi2_per_pixel"])),
        ("Chi-squared per pixel, by separation", rings),
        ("Software", ", ".join(" ".join(each) for each in summary["versions"].items())),
        ("SHA-256 of the wavefront map", str(summary["wavefront_map"]["sha256"])),
    ]


def _flat(settings: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, str]]:
    """Names and values of settings; those of settings in settings have both names."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{within}{name}.")
        else:
            yield f"{within}{name}", _setting(value)


def _setting(value: Any) -> str:
    """A value as one would write it in a table."""
    if value is None:
        return "default"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, str) or not isinstance(value, abc.Sequence):
        return str(value)
    return ", ".join(_setting(each) for each in value) or "none"


# The files that a reduction writes.

_log = logging.getLogger(__name__)


UNFINISHED = "unfinished.json"
"""File that is in the folder of products until all stages of a reduction are done."""

_LATER = ("injections", "completeness", "device", "memory")
"""Options that may differ when a reduction is resumed: the fit and the search are the same."""

PRODUCTS = {
    "report.html": "this page",
    "summary.json": "the content of this page, for programs",
    "detection.png": "the sky without the star, the S/N map and the contrast curve",
    "detection.fits": "maps, star-subtracted frames and candidates, for Detection.read",
    "images.fits": "the sky without the star, its contrast and S/N, with north up",
    "candidates.ecsv": "the candidates with all columns",
    "contrast.ecsv": "the contrast curve",
    "astrometry.csv": "epoch and positions of the candidates, for orbitize!",
    "wide_field.fits": "maps of the whole frames",
    "wide_field_candidates.ecsv": "candidates in the whole frames",
    "wide_field_contrast.ecsv": "contrast curve to the edge of the frames",
    "disk.fits": "the extended light: frames without the star, and its sources",
    "injections.ecsv": "injected planets and their measurements",
    "completeness.ecsv": "fraction of planets that the search finds, by contrast and separation",
    "fit.fits": "the fit, for Refinement.read",
    "systematics.fits": "the flat-field pattern, for other reductions",
    "reference.fits": "wavefront and pattern, for fits of other stars of the visit",
    UNFINISHED: "stages that are done, for a reduction that is resumed",
}
"""Every file that a reduction may write, with its content."""


_FIGURES = "figures"
"""Folder of the figures, in that of the products."""

_FIGURE = re.compile(
    r"(without_star|klip|most_probable|snr|contrast_curve|candidate_\d+_(frame_\d+|corner)"
    r"|whole_frames_(snr|contrast_curve)|extended_light(_model)?|injected_planets|completeness"
    r"|frame_\d+_(data|model|residual)|wavefront_(before|after|change))"
    rf"\.({'|'.join(FIGURE_FORMATS)})"
)
"""Names of the files of figures."""


def existing_products(folder: Path) -> list[Path]:
    """Files in a folder that are called like products of a reduction."""
    figures = folder / _FIGURES
    drawn = figures.iterdir() if figures.is_dir() else ()
    return [
        *(folder / name for name in PRODUCTS if (folder / name).exists()),
        *sorted(path for path in drawn if _FIGURE.fullmatch(path.name)),
    ]


def write_products(
    reduction: ReductionResult,
    folder: Path,
    *,
    fit: bool = True,
    derivatives: bool = False,
    figures: Literal["pdf", "png", "svg"] | None = None,
) -> list[Path]:
    """Write the products of a reduction, and return their paths; see `Reduction.write`.

    The folder is made if it does not exist. Afterwards it has no products of an earlier reduction.
    `derivatives` says whether ``fit.fits`` has those of the images. Raises IncompatibleSetupError
    for a format that is not one of `FIGURE_FORMATS`.
    """
    if figures is not None and figures not in FIGURE_FORMATS:
        raise IncompatibleSetupError(
            f"figures: got {figures!r}, expected one of {', '.join(FIGURE_FORMATS)}, or None for a "
            "report without files of its figures"
        )
    written = reduction.detection.write(folder, overwrite=True)
    if fit:
        path = folder / "fit.fits"
        written.append(reduction.fit.write(path, linear=derivatives, overwrite=True))
    if reduction.wide is not None:
        written += reduction.wide.write(folder, overwrite=True)
    if reduction.disk is not None:
        written.append(reduction.disk.write(folder, overwrite=True))
    if reduction.systematics is not None:
        written.append(reduction.systematics.write(folder / "systematics.fits", overwrite=True))
    if reduction.fit.status.usable:
        reference = ReferenceStar.of(reduction.fit)
        written.append(reference.write(folder / "reference.fits", overwrite=True))
    tables = {"injections": reduction.injections, "completeness": reduction.completeness}
    for name, table in tables.items():
        if table is not None:
            written.append(folder / f"{name}.ecsv")
            write_table(table, written[-1])
    overview = Overview(SkyImages(reduction), Klip.of(reduction))
    written.append(overview.images.write(folder / "images.fits"))
    written.append(folder / "detection.png")
    drawing.save(overview.figure(), written[-1])
    summary, pictures = _shown(reduction, overview)
    if figures is not None:
        written += write_figures(pictures, folder / _FIGURES, figures)
    written += _write_page(summary, pictures, folder, written)
    for path in set(existing_products(folder)) - set(written):
        path.unlink()
    return written


class ProductFolder:
    """A folder into which a reduction writes its products as its stages end.

    Until it has finished, the folder also has the file unfinished.json, and ``fit.fits`` the
    derivatives, from which the reduction can go on; `derivatives` and `figures` are for the end.
    Raises ExistingFileError if there are products that neither `overwrite` nor `resume` allows.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        derivatives: bool = False,
        figures: Literal["pdf", "png", "svg"] | None = None,
        overwrite: bool = False,
        resume: bool = False,
    ) -> None:
        self.folder, self._derivatives, self._figures = Path(folder), derivatives, figures
        self._resumes = resume and (self.folder / UNFINISHED).exists()
        if not self._resumes:
            require_new(existing_products(self.folder), overwrite)
        self._facts: dict[str, Any] = {}

    def begin(self, sequence: Sequence, opd: OPDMap, options: Any) -> Checkpoint | None:
        """Return what an interrupted reduction of the same frames has done; else None.

        Raises IncompatibleSetupError if that was of other frames or with other options, and
        CorruptFileError if one of its files is damaged.
        """
        fingerprint = _fingerprint(sequence, opd, options)
        self._facts = {"version": __version__, "fingerprint": fingerprint, "done": []}
        if not self._resumes:
            return None
        path = self.folder / UNFINISHED
        try:
            facts = json.loads(read_text(path))
            same = (facts["version"], facts["fingerprint"]) == (__version__, fingerprint)
            done, choice = frozenset(facts["done"]), facts["choice"]
            failed = tuple((str(name), str(why)) for name, why in choice["failed"])
            settings, origin = decoded(choice["settings"]), choice["origin"]
            pattern, visit = str(choice["pattern"]), _visit_of(facts["visit"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CorruptFileError(
                f"{path} is damaged ({error!r}). Start the reduction anew, with overwrite=True "
                "(--overwrite)"
            ) from error
        if not same:
            raise IncompatibleSetupError(
                f"resume: {self.folder} has an interrupted reduction of other frames, with other "
                "options or by another version of the package. Repeat its options, or start anew "
                "with overwrite=True (--overwrite)"
            )
        self._facts["done"] = sorted(done)
        fit = Refinement.read(self.folder / "fit.fits")
        known = self.folder / "systematics.fits"
        tables = {
            name: QTable.read(self.folder / f"{name}.ecsv")
            for name in ("injections", "completeness")
            if name in done and (self.folder / f"{name}.ecsv").exists()
        }
        _log.info("resumed after: %s", ", ".join(sorted(done)))
        return Checkpoint(
            done,
            fit,
            Detection.read(self.folder, fit=fit),
            visit,
            settings,
            Systematics.read(known) if known.exists() else None,
            origin,
            pattern,
            failed,
            Disk.read(self.folder, fit) if "disk" in done else None,
            tables.get("injections"),
            tables.get("completeness"),
        )

    def keep(self, stage_name: str, reduction: ReductionResult, choice: PatternChoice) -> None:
        """Write the products so far, after a stage."""
        self._facts["done"] = sorted({*self._facts["done"], stage_name})
        self._facts["choice"] = {
            "settings": encoded(choice.settings),
            "origin": choice.origin,
            "pattern": reduction.pattern,
            "failed": choice.failed,
        }
        self._facts["visit"] = encoded(asdict(reduction.visit))
        table = getattr(reduction, stage_name, None)
        path = self.folder / UNFINISHED
        if isinstance(table, QTable):
            # The rest is as it was, and the report follows at the end.
            write_table(table, self.folder / f"{stage_name}.ecsv")
        else:
            # Until all files are of the same stage, there is nothing to resume.
            path.unlink(missing_ok=True)
            write_products(reduction, self.folder, derivatives=True)
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(self._facts, indent=2) + "\n", encoding="utf-8")

    def finish(self, reduction: ReductionResult) -> list[Path]:
        """Write all products; the reduction has finished."""
        return write_products(
            reduction, self.folder, derivatives=self._derivatives, figures=self._figures
        )


def _visit_of(facts: Any) -> Visit:
    """The visit that was written to the file of what is done."""
    known = decoded(facts)
    return Visit(tuple(Contribution(**each) for each in known["contributions"]), known["gain"])


def _fingerprint(sequence: Sequence, opd: OPDMap, options: Any) -> str:
    """Hash of frames, wavefront map and options that decide the fit and the search."""
    total = hashlib.sha256()
    for frame in (*sequence.science, *sequence.references):
        for array in (frame.data, frame.error, frame.valid):
            total.update(np.ascontiguousarray(array).tobytes())
    total.update(np.ascontiguousarray(opd.data).tobytes())
    named = {each.name: getattr(options, each.name) for each in fields(options)}
    named["settings"] = encoded(named["settings"])
    chosen = {name: value for name, value in named.items() if name not in _LATER}
    total.update(json.dumps(chosen, sort_keys=True, default=repr).encode())
    return total.hexdigest()


def write_report(
    reduction: ReductionResult, folder: Path, files: Iterable[Path] = ()
) -> list[Path]:
    """Write ``report.html``, one page that needs no other file, and ``summary.json``.

    Files of these names are replaced. The page lists `files`, other products.
    """
    overview = Overview(SkyImages(reduction), Klip.of(reduction))
    return _write_page(*_shown(reduction, overview), folder, files)


def _shown(reduction: ReductionResult, overview: Overview) -> tuple[dict[str, Any], ReportPictures]:
    """Numbers and pictures of the report."""
    summary = summarise(reduction, overview.klip and overview.klip.curve)
    return summary, ReportPictures.of(reduction, overview, summary)


def _write_page(
    summary: dict[str, Any], pictures: ReportPictures, folder: Path, files: Iterable[Path]
) -> list[Path]:
    html, data = (folder / name for name in ("report.html", "summary.json"))
    listed = [*files, html, data]
    drawn = [path for path in listed if path.parent.name == _FIGURES]
    about = {path.name: PRODUCTS.get(path.name, "") for path in listed if path not in drawn}
    if drawn:
        about[f"{_FIGURES}/"] = f"the {len(drawn)} figures of this page, each in a file"
    text = page(summary, pictures, about)
    written = {html: text, data: json.dumps(summary, indent=2, allow_nan=False) + "\n"}
    for path, content in written.items():
        with replacing(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return list(written)
