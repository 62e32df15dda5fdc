"""The report as a self-contained HTML page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from string import Template
from typing import Any

from pyklip_diffrender.reduction import html
from pyklip_diffrender.reduction.html import Picture
from pyklip_diffrender.reduction.words import (
    number,
    plus_minus,
    probability,
    scientific,
)

__all__ = ["page"]

_HEADER = Template("""\
<header>
<h1>$target</h1>
<p class="setup">$setup</p>
$pictures
<p class="result">$sentence</p>
<div class="status $tone">
<strong>$status</strong>
<p>$advice</p>
</div>
$facts
$links
</header>
""")


def page(
    summary: Mapping[str, Any],
    overview: Sequence[Picture],
    curve: Sequence[Picture],
    stars: Sequence[Sequence[Picture]],
    wavefront: Sequence[Picture],
    wide: Sequence[Picture] = (),
    disk: Sequence[Picture] = (),
    files: Mapping[str, str] | None = None,
    planets: Sequence[str] = (),
) -> str:
    """The report.

    Parameters
    ----------
    summary : dict
        See `summarise`.
    overview, curve, wavefront, wide, disk : sequence of Picture
        Pictures of the whole frames, `wide`, and of extended light, `disk`, may be missing.
    stars : sequence of sequence of Picture
        One for each frame of the target that is shown.
    files : mapping of str to str, optional
        Names of the files that were written with it, and their content.
    planets : sequence of str
        Sections, see `injections_section` and `completeness_section`.

    Returns
    -------
    str
        Every value in it is escaped: headers of files may hold anything.
    """
    status = summary["status"]
    message = status["message"]
    tone = "good" if status["name"] == "CONVERGED" else "warn" if status["usable"] else "bad"
    sections = [
        html.section("Candidates", _candidates(summary)),
        html.section("Limits", html.beside(html.pictures(curve), _limits(summary))),
        *(
            [html.section("Whole frames", html.pictures(wide, "pair"), _wide(summary))]
            if wide
            else []
        ),
        *(
            [html.section("Extended light", html.pictures(disk, "pair"), _disk(summary))]
            if disk
            else []
        ),
        *planets,
        html.section("Star subtraction", *_star(summary, stars)),
        html.section("Wavefront", _wavefront(summary), html.pictures(wavefront)),
        html.section("Frames", _frames(summary), _left_out(summary)),
        html.section("Provenance", _provenance(summary, files or {})),
    ]
    text = {
        "target": summary["target"],
        "setup": _setup(summary),
        # Numbers are not broken over lines.
        "sentence": re.sub(" ([±×]) ", "\u00a0\\1\u00a0", summary["sentence"]),
        "tone": tone,
        "status": message[:1].upper() + message[1:] + ("" if message.endswith(".") else "."),
        "advice": status["advice"],
    }
    header = _HEADER.substitute(
        {name: escape(str(value)) for name, value in text.items()},
        pictures=html.pictures(overview),
        facts=html.facts(_key_facts(summary)),
        links=_links(files or {}),
    )
    title = f"{summary['target']}, {summary['filter'] or 'no filter'}: report"
    return html.document(title, header, sections)


def _setup(summary: Mapping[str, Any]) -> str:
    """Instrument, filter, mask and dates in a line."""
    dates = [str(summary[key] or "")[:10] for key in ("first_date", "last_date")]
    targets = [each for each in summary["frames"] if each["use"] == "target"]
    references = len(summary["frames"]) - len(targets)
    parts = [
        summary["instrument"],
        summary["filter"],
        summary["image_mask"],
        summary["program"] and f"program {summary['program']}",
        " to ".join(dict.fromkeys(filter(None, dates))),
        html.count(len(targets), "frame") + " of the target",
        html.count(references, "reference frame") if references else None,
        summary["exposure_s"] and f"{summary['exposure_s']:.0f} s on the target",
    ]
    return " · ".join(str(part) for part in parts if part)


def _links(files: Mapping[str, str]) -> str:
    """The files beside the page in a line."""
    if not files:
        return ""
    return f'<p class="note">Files: {", ".join(html.link(name, name) for name in files)}.</p>'


def _key_facts(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    fit, map_, used = summary["fit"], summary["wavefront_map"], summary["systematics"]
    error = fit["model_error"]
    pattern = "none known"
    if used is not None:
        stars = ", ".join(used["stars"])
        pattern = used["name"] if stars in ("", used["name"]) else f"{used['name']} ({stars})"
        if used["size"] is not None:
            strength = plus_minus(used["size"], used["size_error"])
            pattern += f"; strength in these frames {strength}"
    star = summary["star"]
    flux = []
    if star is not None:
        value = plus_minus(star["flux_density_Jy"], star["flux_density_error_Jy"])
        source = "as assumed" if star["source"] == "star_flux" else "from its diffracted light"
        flux = [("Flux density of the star", f"{value} Jy, {source}")]
    return [
        ("Reduced chi-squared without model error", number(fit["reduced_chi2"])),
        (
            "Error of the star model",
            "none needed" if error == 0 else number(error and 100 * error, ".2g", "% of the star"),
        ),
        ("Errors multiplied by", number(fit["error_factor"])),
        ("Wavefront map", f"{map_['name']}, {_age(map_['days_before_first_frame'])}"),
        ("Flat-field pattern", pattern),
        *flux,
    ]


def _by_ring(rings: Sequence[Mapping[str, Any]]) -> str:
    return "; ".join(
        f"{number(each['chi2'], '.2f')} ({each['inner_arcsec']:.1f} to "
        f"{each['outer_arcsec']:.1f} arcsec)"
        for each in rings
    )


def _age(days: float | None) -> str:
    if days is None:
        return "date not known"
    return f"sensed {abs(days):.1f} days {'before' if days >= 0 else 'after'} the first frame"


def _candidates(summary: Mapping[str, Any]) -> str:
    if not summary["candidates"]:
        return html.note(f"No candidate has an S/N above {summary['threshold_snr']:g}.")
    rows = [
        [
            str(k),
            plus_minus(each["separation_arcsec"], each["separation_error_arcsec"]),
            plus_minus(each["position_angle_deg"], each["position_angle_error_deg"]),
            scientific(each["contrast"], each["contrast_error"]),
            plus_minus(each["delta_mag"], each["delta_mag_error"]),
            f"{each['snr']:.1f}",
            probability(each["false_alarm_probability"]),
        ]
        for k, each in enumerate(summary["candidates"], 1)
    ]
    angle = "east of north" if summary["oriented"] else "from +y of the first frame"
    header = [
        "", "Separation (arcsec)", f"Position angle (deg, {angle})", "Contrast",
        "Magnitude difference (mag)", "S/N", "False-alarm probability",
    ]  # fmt: skip
    note = (
        "Contrast is relative to the star without coronagraph; errors are standard deviations, "
        "those of contrasts with that of the star's flux. The false-alarm probability is that of "
        "noise alone making such a peak anywhere in the field; it is not stated where the model "
        "does not explain the data, nor for candidates that look like extended light. One epoch "
        "does not show whether a candidate is bound or in the background."
    )
    return html.table(header, rows) + html.note(note) + _on_sky(summary["candidates"])


def _disk(summary: Mapping[str, Any]) -> str:
    """The extended light that was fitted."""
    disk = summary["disk"]
    axis = (
        ""
        if disk["position_angle_deg"] is None
        else f" Its long axis has a position angle of {disk['position_angle_deg']:.1f} deg."
    )
    return html.note(
        f"Altogether {scientific(disk['contrast'])} of the star's light, in {disk['sources']} "
        f"sources that lower chi-squared by {disk['chi2_decrease']:.0f}.{axis} The search and the "
        "limits above are for frames without this light. The limits hold where a planet would not "
        f"be taken for a part of it, in {100 * (1 - disk['hidden']):.0f} % of the field: outside "
        "the dashed line. Of twelve planets of twice the limits that were injected next to AU "
        "Mic's disk, ten were found, with 0.8 to 1.2 times their light; the other two had half of "
        "it and less."
    )


def _wide(summary: Mapping[str, Any]) -> str:
    """Candidates in the whole frames."""
    candidates = summary["wide_field"]["candidates"]
    rows = [
        [
            str(k),
            plus_minus(each["separation_arcsec"], each["separation_error_arcsec"]),
            plus_minus(each["position_angle_deg"], each["position_angle_error_deg"]),
            scientific(each["contrast"], each["contrast_error"]),
            f"{each['snr']:.1f}",
            "" if each["fit_chi2"] is None else f"{each['fit_chi2']:.1f}",
            _shape(each),
        ]
        for k, each in enumerate(candidates, 1)
    ]
    if not rows:
        return html.note(f"No candidate has an S/N above {summary['threshold_snr']:g}.")
    angle = "east of north" if summary["oriented"] else "from +y of the first frame"
    header = ["", "Separation (arcsec)", f"Position angle (deg, {angle})", "Contrast", "S/N",
              "Chi-squared of a point source", "Shape (arcsec)"]  # fmt: skip
    note = (
        "The last columns are the reduced chi-squared of a fit of a point source and the shape, "
        "for candidates outside the pixels in which the star was fitted. An extended source, or "
        "several that are blended, are one row with all of their light, and with the full widths "
        "at half maximum and the position angle of a Gaussian."
    )
    return "<h3>Candidates</h3>" + html.table(header, rows) + html.note(note)


def _shape(candidate: Mapping[str, Any]) -> str:
    """Shape of a source in words."""
    if candidate["shape"] != "extended":
        return str(candidate["shape"])
    widths = " × ".join(f"{candidate[f'fwhm_{axis}_arcsec']:.2f}" for axis in ("major", "minor"))
    return f"extended, {widths} at {candidate['axis_angle_deg']:.0f} deg"


PHOTOMETRY = (
    "Flux densities and magnitudes (AB) are those of the source without coronagraph: the "
    "transmission of mask and Lyot stop is accounted for. Their errors do not include that of the "
    "pipeline's photometric calibration behind the coronagraph, about 30 % (0.3 mag)."
)
"""Whatever stands beside a flux density."""

_SKY = (
    ("Mid-exposure (UTC)", "epoch", None, str),
    ("ΔRA cos Dec (arcsec)", "delta_ra_arcsec", "delta_ra_error_arcsec", plus_minus),
    ("ΔDec (arcsec)", "delta_dec_arcsec", "delta_dec_error_arcsec", plus_minus),
    ("Correlation of the two", "radec_corr", None, "{:.2f}".format),
    ("Flux density (Jy)", "flux_density_Jy", "flux_density_error_Jy", scientific),
    ("AB magnitude", "ab_mag", "ab_mag_error", plus_minus),
)
"""Titles of columns, keys of their values and errors, and how they are written."""


def _on_sky(candidates: Sequence[Mapping[str, Any]]) -> str:
    """Astrometry and photometry, as far as the headers of the frames allow them."""
    columns = [each for each in _SKY if each[1] in candidates[0]]
    if not columns:
        return ""
    rows = [
        [str(k), *(form(*(each[key] for key in keys if key)) for _, *keys, form in columns)]
        for k, each in enumerate(candidates, 1)
    ]
    note = (
        "Errors of positions do not include those of the pixel scale and of the roll angle. "
        + PHOTOMETRY
    )
    titles = ["", *(title for title, *_ in columns)]
    return "<h3>Astrometry and photometry</h3>" + html.table(titles, rows) + html.note(note)


def _limits(summary: Mapping[str, Any]) -> str:
    if not summary["limits"]:
        return ""
    sigmas = summary["contrast_curve"]["sigmas"]
    calibrated = "ab_mag" in summary["limits"][0]
    rows = [
        [
            f"{each['separation_arcsec']:.3g}",
            scientific(each["contrast"]),
            f"{scientific(each['lowest'])} to {scientific(each['highest'])}",
            f"{each['delta_mag']:.2f}",
            *([f"{each['ab_mag']:.2f}", scientific(each["flux_density_Jy"])] if calibrated else []),
        ]
        for each in summary["limits"]
    ]
    header = [
        "Separation (arcsec)", f"Contrast at {sigmas:g} sigma", "All angles",
        "Magnitude difference (mag)",
        *(["AB magnitude", "Flux density (Jy)"] if calibrated else []),
    ]  # fmt: skip
    return html.table(header, rows) + (html.note(PHOTOMETRY) if calibrated else "")


def _star(summary: Mapping[str, Any], stars: Sequence[Sequence[Picture]]) -> Iterable[str]:
    targets = [each for each in summary["frames"] if each["use"] == "target"]
    for frame, pictures in zip(targets, stars, strict=False):
        if len(targets) > 1:
            yield f"<h3>{escape(_label(frame))}</h3>"
        yield html.pictures(pictures)
    if len(stars) < len(targets):
        yield html.note(
            f"The first {len(stars)} of {len(targets)} frames are shown; detection.fits has all."
        )


def _label(frame: Mapping[str, Any]) -> str:
    angle = frame["position_angle_deg"]
    roll = "" if angle is None else f", +y at position angle {angle:.1f} deg"
    return f"{frame['file']}{roll}"


def _wavefront(summary: Mapping[str, Any]) -> str:
    map_ = summary["wavefront_map"]
    sensed = "" if map_["date"] is None else f" of {map_['date'][:16].replace('T', ' ')} UTC"
    return (
        f"<p>Started from {escape(map_['name'])}{escape(sensed)}, "
        f"{_age(map_['days_before_first_frame'])}. The fit changed the wavefront by "
        f"{number(map_['change_rms_nm'], '.1f', 'nm')} rms.</p>"
    )


def _frames(summary: Mapping[str, Any]) -> str:
    rows = [
        [
            each["use"],
            each["star"],
            (each["date"] or "not known")[:16].replace("T", " "),
            number(each["position_angle_deg"], ".2f"),
            str(each["integrations"]),
            number(each["exposure_s"], ".0f"),
            f"{100 * each['pixels_used']:.1f}",
            each["file"],
        ]
        for each in summary["frames"]
    ]
    header = ["Use", "Star", "Date (UTC)", "Position angle of +y (deg)", "Integrations",
              "Exposure (s)", "Pixels used (%)", "File"]  # fmt: skip
    table = html.table(header, rows)
    bad = [
        f"{each['file']}: " + ", ".join(f"({x:+.2f}, {y:+.2f})" for x, y in each["bad_pixels"])
        for each in summary["frames"]
        if each.get("bad_pixels")
    ]
    if not bad:
        return table
    return table + html.note(
        "Pixels left out because they deviate from the model and no point source explains it "
        f"(x, y from the star, arcsec): {'; '.join(bad)}."
    )


def _left_out(summary: Mapping[str, Any]) -> str:
    rows = [[each["name"], each["reason"]] for each in summary["left_out"]]
    if not rows:
        return html.note("No frame was left out.")
    return "<h3>Left out</h3>" + html.table(["Name", "Reason"], rows, wrap=1)


def _provenance(summary: Mapping[str, Any], files: Mapping[str, str]) -> str:
    seconds, map_ = summary["seconds"], summary["wavefront_map"]
    versions = ", ".join(" ".join(each) for each in summary["versions"].items())
    facts = [
        ("Time of the fits", number(seconds, ".1f", "s")),
        ("Chi-squared per pixel", number(summary["fit"]["chi2_per_pixel"])),
    ]
    settings = "; ".join(f"{name}: {value}" for name, value in summary["settings"].items())
    long = [
        ("Chi-squared per pixel, by separation", _by_ring(summary["fit"]["rings"])),
        ("Software", versions),
        ("SHA-256 of the wavefront map", map_["sha256"]),
        ("Settings of the fit", settings),
    ]
    parts = [html.facts(facts), html.facts(long, "facts long")]
    if files:
        rows = [[html.link(name, name), content] for name, content in files.items()]
        parts += ["<h3>Files written with this page</h3>", html.table(["File", "Content"], rows, 1)]
    return "\n".join(parts)
