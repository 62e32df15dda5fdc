"""The files that a reduction writes, and what the page of its report shows."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pyklip_diffrender import drawing
from pyklip_diffrender.errors import CorruptFileError
from pyklip_diffrender.io.files import OutputFolder, read_text, write_page, write_table
from pyklip_diffrender.io.progress import counted
from pyklip_diffrender.reduction.pages import (
    depth_against_klip,
    number,
    plus_minus,
    remark_on_map,
    render,
    scientific,
)
from pyklip_diffrender.reduction.pictures import Klip, Overview, ReportPictures, SkyImages
from pyklip_diffrender.reduction.pipeline import ReductionResult
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.scene.sequence import by_reason

# The report: what its page shows of a summary, and its pictures.

_PHOTOMETRY = (
    "Flux densities and magnitudes (AB; Vega by CALSPEC's alpha_lyr_stis_011) are for the "
    "source without coronagraph: the "
    "transmission of mask and Lyot stop is accounted for. Their errors do not include the "
    "pipeline's photometric calibration behind the coronagraph, about 30 % (0.3 mag)."
)
"""Note beside every flux density."""


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
        sky_columns=[each for each in _SKY_COLUMNS if first and each.key in first[0]],
        photometry=_PHOTOMETRY,
        outside=0 if wide is None else len(wide["candidates"]) - len(summary["candidates"]),
        deeper=depth_against_klip(summary["contrast_curve"], summary["klip_curve"]),
        age=_age(summary["opd"]["days_before_first_frame"]),
        map_remark=remark_on_map(summary["opd"]["days_before_first_frame"]),
        left_out=by_reason((each["name"], each["reason"]) for each in summary["left_out"]),
        provenance=_provenance(summary),
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


_SKY_COLUMNS = (
    _Column("Mid-exposure (UTC)", str, "epoch"),
    _Column("ΔRA cos Dec (arcsec)", plus_minus, "delta_ra_arcsec", "delta_ra_error_arcsec"),
    _Column("ΔDec (arcsec)", plus_minus, "delta_dec_arcsec", "delta_dec_error_arcsec"),
    _Column("Correlation of the two", "{:.2f}".format, "radec_corr"),
    _Column("Flux density (Jy)", scientific, "flux_density_Jy", "flux_density_error_Jy"),
    _Column("AB magnitude", plus_minus, "ab_mag", "ab_mag_error"),
    _Column("Vega magnitude", plus_minus, "vega_mag", "vega_mag_error"),
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
        f"{counted(len(targets), 'frame')} of the target",
        uses and f"{counted(len(uses), 'frame')} of reference stars: {', '.join(purposes)}",
        summary["exposure_s"] and f"{summary['exposure_s']:.0f} s on the target",
    ]
    return " · ".join(str(part) for part in parts if part)


def _key_facts(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    fit, map_, star = summary["fit"], summary["opd"], summary["star"]
    error = fit["model_error"]
    flux = []
    if star is not None:
        value = plus_minus(star["flux_density_Jy"], star["flux_density_error_Jy"])
        source = "as stated" if star["source"] == "star_flux" else "from its diffracted light"
        flux = [("Flux density of the star", f"{value} Jy, {source}")]
    return [
        ("Reduced chi-squared without model error", _chi2(fit["reduced_chi2"])),
        (
            "Error of the star model",
            "none needed" if error == 0 else number(error and 100 * error, ".2g", "% of the star"),
        ),
        ("Errors multiplied by", number(fit["error_factor"])),
        ("OPD map", f"{map_['name']}, {_age(map_['days_before_first_frame'])}"),
        ("Detector pattern", _pattern(summary["pattern"])),
        *flux,
    ]


def _chi2(value: float | None) -> str:
    """Reduced chi-squared, and what it means where it is below 1."""
    # Of 1,600 pixels, the smallest number that is fitted as a rule, it has a deviation of 0.035.
    if value is None or value >= 0.9:
        return number(value)
    return (
        f"{number(value)}; below 1 because the errors of the frames are larger than their noise, "
        "as in resampled frames. They are not made smaller"
    )


def _pattern(used: Mapping[str, Any] | None) -> str:
    """Where the detector pattern comes from, and how strong it is in the frames."""
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
    return "; ".join(filter(None, (text, used["caveat"])))


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
        ("SHA-256 of the OPD map", str(summary["opd"]["sha256"])),
    ]


# The files that a reduction writes.

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
    "detection_other.fits": "the search of the other fit, with or without reference stars",
    "fit_other.fits": "the other fit, whose limits are deeper at some separations",
    "pattern.fits": "the detector pattern, for other reductions",
}
"""Every file that a reduction may write, with its content."""


def read_summary(folder: Path) -> dict[str, Any]:
    """Read ``summary.json`` of a folder; CorruptFileError if it is missing or damaged."""
    path = folder / "summary.json"
    try:
        return json.loads(read_text(path))
    except (OSError, ValueError) as error:
        raise CorruptFileError(
            f"{path}: not the summary of a reduction ({error}). Expected a folder that "
            "Reduction.write wrote"
        ) from error


def write_products(
    reduction: ReductionResult, folder: Path, *, fit: bool = True, derivatives: bool = False
) -> list[Path]:
    """Write the products of a reduction to a folder without any, and return their paths.

    The folder is made if it does not exist. `derivatives` says whether ``fit.fits`` has the
    derivatives of the images.
    """
    written = reduction.detection.write(folder, overwrite=True)
    if fit:
        path = folder / "fit.fits"
        written.append(reduction.fit.write(path, linear=derivatives, overwrite=True))
        if reduction.detection.other is not None:
            other, path = reduction.detection.other.fit, folder / "fit_other.fits"
            written.append(other.write(path, linear=derivatives, overwrite=True))
    if reduction.wide is not None:
        written += reduction.wide.write(folder, overwrite=True)
    if reduction.disk is not None:
        written.append(reduction.disk.write(folder, overwrite=True))
    if reduction.pattern is not None:
        written.append(reduction.pattern.write(folder / "pattern.fits", overwrite=True))
    tables = {"injections": reduction.injections, "completeness": reduction.completeness}
    for name, table in tables.items():
        if table is not None:
            written.append(folder / f"{name}.ecsv")
            write_table(table, written[-1], reduction.detection.provenance)
    overview = Overview(SkyImages(reduction), Klip.of(reduction))
    written.append(overview.images.write(folder / "images.fits"))
    written.append(folder / "detection.png")
    drawing.save(overview.figure(), written[-1])
    return written + write_report(reduction, overview, folder, written)


class ProductFolder(OutputFolder):
    """A folder into which a reduction writes its products as its stages end.

    `derivatives` is as for `Reduction.write`. Raises ExistingFileError if there are products in the
    folder, and `overwrite` is False.
    """

    def __init__(
        self, folder: str | os.PathLike[str], *, derivatives: bool = False, overwrite: bool = False
    ) -> None:
        super().__init__(folder, PRODUCTS, overwrite=overwrite)
        self._derivatives = derivatives

    def keep(self, reduction: ReductionResult) -> list[Path]:
        """Write the products of a reduction, as far as it has come, and return their paths."""
        return self.replace(
            lambda folder: write_products(reduction, folder, derivatives=self._derivatives)
        )


def write_report(
    reduction: ReductionResult, overview: Overview, folder: Path, files: Iterable[Path] = ()
) -> list[Path]:
    """Write ``report.html``, one page that needs no other file, and ``summary.json``.

    Files of these names are replaced. The page lists `files`, other products.
    """
    summary = summarise(reduction, overview.klip and overview.klip.curve)
    pictures = ReportPictures.of(reduction, overview, summary)
    html, data = (folder / name for name in ("report.html", "summary.json"))
    about = {path.name: PRODUCTS.get(path.name, "") for path in (*files, html, data)}
    write_page(html, page(summary, pictures, about), data, summary)
    return [html, data]
