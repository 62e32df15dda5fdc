"""The report: what its page shows of a summary, and its pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pyklip_diffrender.reduction.pages import count, render
from pyklip_diffrender.reduction.pictures import ReportPictures
from pyklip_diffrender.reduction.words import (
    depth_against_klip,
    number,
    plus_minus,
    scientific,
)

__all__ = ["page"]

_PHOTOMETRY = (
    "Flux densities and magnitudes (AB) are those of the source without coronagraph: the "
    "transmission of mask and Lyot stop is accounted for. Their errors do not include that of the "
    "pipeline's photometric calibration behind the coronagraph, about 30 % (0.3 mag)."
)
"""Whatever stands beside a flux density."""


def page(
    summary: Mapping[str, Any], shown: ReportPictures, files: Mapping[str, str] | None = None
) -> str:
    """The report as a page of HTML.

    Parameters
    ----------
    summary : dict
        See `summarise`.
    shown : ReportPictures
    files : mapping of str to str, optional
        Names of the files that were written with it, and their content.
    """
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
    references = len(summary["frames"]) - len(targets)
    joint = sum(each["use"] == "joint" for each in summary["visit"]["contributions"])
    used = summary["systematics"]
    purpose = "KLIP alone" if used is None or not used["own_stars"] else "the pattern and KLIP"
    if joint:
        purpose = f"KLIP, {joint} of them in the likelihood"
    parts = [
        summary["instrument"],
        summary["filter"],
        summary["image_mask"],
        summary["program"] and f"program {summary['program']}",
        " to ".join(dict.fromkeys(filter(None, dates))),
        count(len(targets), "frame") + " of the target",
        f"{count(references, 'frame')} of reference stars, for {purpose}" if references else None,
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
    if isinstance(value, str) or not isinstance(value, Sequence):
        return str(value)
    return ", ".join(_setting(each) for each in value) or "none"
