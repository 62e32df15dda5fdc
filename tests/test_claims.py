"""Numbers of README, documentation and paper are those of the tables in ``docs/results``.

A claim is a phrase with a place for each number. The numbers are looked up in the tables,
formatted, and put into the phrase, which the document has to contain: the test fails if a number
disagrees, and if the phrase is gone.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

from pyklip_diffrender import Status
from pyklip_diffrender.reduction.pages import advice

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"

PAIRS = (("G 7-34", "F444W"), ("G 7-34", "F356W"), ("HIP 17695", "F444W"), ("HIP 17695", "F356W"))
"""Stars and filters of the limits of two rolls, as the columns of the page have them."""


@cache
def table(name):
    found = Table.read(RESULTS / f"{name}.ecsv")
    for name, column in found.columns.items():
        if isinstance(column, MaskedColumn) and column.dtype.kind in "UO":
            found[name] = column.filled("")  # Empty text is read as masked.
    return found


def rows(name, **where):
    """Rows of a table with these values; there is at least one."""
    found = table(name)
    for column, value in where.items():
        found = found[found[column] == value]
    assert len(found), f"{name}.ecsv has no row with {where}"
    return found


def stated(quantity, column="value", **where):
    """The one number of `stated_numbers.ecsv` with this name."""
    (row,) = rows("stated_numbers", quantity=quantity, **where)
    return float(row[column])


def middle(name, column, **where):
    return float(np.median(rows(name, **where)[column]))


def least(name, column, **where):
    return float(np.min(rows(name, **where)[column]))


def of_pairs(name, column):
    """Median and smallest value for each pair of rolls, one after the other."""
    return [
        f(name, column, star=star, filter=band) for star, band in PAIRS for f in (middle, least)
    ]


def ratios(star, band):
    """Median and smallest ratio of the limits of a pair of rolls, for each column of the page."""
    columns = ((LIMITS, "ratio"), (LIMITS, "ratio_small_sample"), (IMAGES, "ratio"))
    return [
        f(name, column, star=star, filter=band) for name, column in columns for f in (middle, least)
    ]


def medians(name, column, star, *bands):
    return [middle(name, column, star=star, filter=band) for band in bands]


def planets(where, count):
    """How many planets were detected, and of how many."""
    quantity = f"injected planets: detected {where} 0.45 arcsec, of {count}"
    found = rows("stated_numbers", quantity=quantity)
    return [float(np.sum(found["value"])), count * len(found)]


def all_planets():
    beyond, within = planets("beyond", 24), planets("within", 4)
    return [beyond[0] + within[0], beyond[1] + within[1]]


def disk(setting, *bands):
    quantity = "disk's light that is kept"
    return [stated(quantity, filter=band, setting=setting) for band in bands]


def of_klip(extreme):
    """Least or most of the disk's light that KLIP keeps, in any filter and with any modes."""
    found = rows("stated_numbers", quantity="disk's light that is kept")
    return extreme([row["value"] for row in found if str(row["setting"]).startswith("KLIP")])


def companion(quantity, scale=1.0):
    """Value and error of HIP 65426 b, as measured in the fit of the page."""
    where = {"star": "HIP 65426", "setting": ""}
    return [scale * stated(quantity, column, **where) for column in ("value", "error")]


def calibration(hours):
    """Scatter of the S/N, the same for a known star, and the limit over that of a known star."""
    found = rows("calibration_measured", hours=hours)
    scatter = [float(np.sqrt(np.mean(found[each] ** 2))) for each in ("null", "known_star_null")]
    return [*scatter, float(np.mean(found["limit_mean"]))]


def fluxes(at_limit, contrast=None):
    """Weighted ratio to the truth and its error, mean pull and its error, deviation, light kept."""
    found = table("fluxes_measured")
    if at_limit or contrast is not None:
        found = found[np.asarray(found["injected_at_limit"]) == at_limit]
    if contrast is not None:
        found = found[found["contrast"] == contrast]
    ratio, error = found["measured"] / found["contrast"], found["error"] / found["contrast"]
    weight = 1 / np.asarray(error) ** 2
    pull = (found["measured"] - found["contrast"]) / found["error"]
    mean = float(np.sum(np.asarray(ratio) * weight) / weight.sum())
    kept = float(np.median(found["kept_by_subtraction"]))
    spread = len(found) ** -0.5
    return [mean, weight.sum() ** -0.5, float(np.mean(pull)), spread, float(np.std(pull)), kept]


def experiments(method):
    """Medians of annulus SNR, of the S/N over that of a known star, and of the throughput."""
    found = rows("klip_table_measured")
    known = {
        (row["separation"], row["contrast"], row["seed"]): row["matched_snr"]
        for row in found if row["method"] == "optimal"
    }  # fmt: skip
    found = found[found["method"] == method]
    ratio = [
        row["matched_snr"] / known[row["separation"], row["contrast"], row["seed"]]
        for row in found
    ]  # fmt: skip
    medians = [float(np.median(found[name])) for name in ("annulus_snr", "throughput")]
    return [medians[0], float(np.median(ratio)), medians[1]]


def speed(row, column, what):
    (found,) = (
        each for each in rows("performance", row=row, precision="float64")
        if str(each["column"]) == column
    )  # fmt: skip
    return float(found[what])


class Claim(NamedTuple):
    """A phrase of a document, with a format for each number, and where the numbers come from."""

    document: str
    phrase: str
    numbers: Callable[[], Sequence[float]]


BOTH = ("F444W", "F356W")
LIMITS, IMAGES, DISKS = "real_pairs_limits", "real_pairs_images", "disk_limits"
PAGE = "docs/validation/real_frames.md"

CLAIMS = (
    # -- README
    Claim("README.md", "has S/N {:.1f} and a contrast of {:.2f}e-6 +- {:.2f}e-6.",
          lambda: [stated("demo: S/N"), 1e6 * stated("demo: contrast"),
                   1e6 * stated("demo: contrast", "error")]),
    Claim("README.md", "Its annulus SNR is {:.1f}, with KLIP and nine reference frames {:.1f}.",
          lambda: [stated("demo: annulus SNR", setting=each) for each in ("refined", "KLIP")]),
    Claim("README.md", "{:.1f} and {:.1f} times for HIP 17695, {:.1f} and {:.1f} times for G 7-34",
          lambda: [*medians(LIMITS, "ratio", "HIP 17695", *BOTH),
                   *medians(LIMITS, "ratio", "G 7-34", *BOTH)]),
    Claim("README.md", "KLIP is up to {:.1f} times deeper within 0.7 arcsec",
          lambda: [1 / least(LIMITS, "ratio", star="G 7-34", filter="F444W")]),
    Claim("README.md", "Fluxes of {:.0f} injected planets are {:.2f} +- {:.2f} of the truth",
          lambda: [all_planets()[1],
                   *(stated("injected planets: contrast over truth, mean", each, star="all")
                     for each in ("value", "error"))]),
    Claim("README.md", "{:.0f} of {:.0f} are detected beyond 0.45 arcsec, and {:.0f} of {:.0f}",
          lambda: [*planets("beyond", 24), *planets("within", 4)]),
    Claim("README.md", "one likelihood have median limits {:.2f} and {:.2f} times deeper than KLIP",
          lambda: [middle("reference_sequences", "klip_over_ours_raw", visit=k) for k in (0, 1)]),
    Claim("README.md", "At single separations KLIP is up to {:.2f} times deeper.",
          lambda: [1 / min(least("reference_sequences", "klip_over_ours_raw", visit=k)
                           for k in (0, 1))]),
    Claim("README.md", "median limits are {:.1f} to {:.1f} times deeper than KLIP's (ADI+RDI)",
          lambda: [f(of_pairs(IMAGES, "ratio")[::2]) for f in (min, max)]),
    Claim("README.md", "separation from 0.4 to 2.3 arcsec at least {:.1f} times.",
          lambda: [min(of_pairs(IMAGES, "ratio"))]),
    Claim("README.md", "Beside AU Mic's disk they are {:.1f} and {:.1f} times",
          lambda: [stated("ratio of limits of product images, median", filter=band,
                          setting="cleaned") for band in BOTH]),
    Claim("README.md", "KLIP's are up to {:.1f} and {:.1f} times deeper.",
          lambda: [1 / stated("ratio of limits of product images, smallest", filter=band,
                              setting="cleaned") for band in BOTH]),
    Claim("README.md", "KLIP keeps {:.0f} to {:.0f} % of the light, and `disk=True` {:.0f} %",
          lambda: [100 * of_klip(min), 100 * of_klip(max),
                   *(100 * each for each in disk("disk=True, fitted light", "F444W"))]),
    Claim("README.md", "(F444W) and {:.0f} % (F356W)",
          lambda: [100 * each for each in disk("disk=True, fitted light", "F356W")]),
    Claim("README.md", "at S/N {:.0f} and {:.3f} +- {:.3f} arcsec (published: {:.3f} +- {:.3f})",
          lambda: [stated("S/N of the companion"), *companion("separation of the companion"),
                   *companion("published separation")]),
    Claim("README.md", "a contrast of {:.2f}e-4 +- {:.2f}e-4 (published: {:.2f}e-4 +- {:.2f}e-4)",
          lambda: [*companion("contrast of the companion", 1e4),
                   *companion("published contrast", 1e4)]),
    # -- intake
    Claim("docs/howto/real_frames.md", "segments), {:.0f} are used entirely, from {:.0f} "
          "some files are excluded with a reason, and {:.0f} are refused",
          lambda: [float(table("intake")[name][-1])
                   for name in ("as untouched", "excluded", "refused")]),
    # -- resources
    Claim("docs/howto/resources.md", "3255 integrations, takes {:.2f} times its size",
          lambda: [stated("memory of reading over the size of the file", setting="4 GB")]),
    Claim("docs/howto/resources.md", "reading takes {:.1f} times the file (`--dataset",
          lambda: [stated("memory of reading over the size of the file",
                          setting="pyKLIP dataset, 0.2 GB")]),
    # -- paper
    Claim("paper/paper.md", "factors of {:.1f} (F356W) and {:.1f} (F444W) for HIP 17695, "
          "and of {:.1f} and {:.1f} for G 7-34",
          lambda: [*medians(LIMITS, "ratio_small_sample", "HIP 17695", "F356W", "F444W"),
                   *medians(LIMITS, "ratio_small_sample", "G 7-34", "F356W", "F444W")]),
    Claim("paper/paper.md", "Of {1:.0f} planets injected at 1.6 times the limits {0:.0f} were",
          all_planets),
    Claim("paper/paper.md", "with fluxes of {:.2f} +- {:.2f} of the truth",
          lambda: [stated("injected planets: contrast over truth, mean", each, star="all")
                   for each in ("value", "error")]),
    Claim("paper/paper.md", "KLIP keeps {:.0f} to {:.0f} % of the light and the joint fit {:.0f} % "
          "in F444W ({:.0f} % in F356W)",
          lambda: [100 * of_klip(min), 100 * of_klip(max),
                   *(100 * each for each in disk("disk=True, fitted light", *BOTH))]),
    Claim("paper/paper.md", "{:.3f} +- {:.3f} arcsec and a contrast of {:.2f}e-4 +- {:.2f}e-4",
          lambda: [*companion("separation of the companion"),
                   *companion("contrast of the companion", 1e4)]),
    Claim("paper/paper.md", "published {:.3f} +- {:.3f} arcsec and {:.2f}e-4 +- {:.2f}e-4",
          lambda: [*companion("published separation"), *companion("published contrast", 1e4)]),
    # -- real frames
    *(
        Claim(PAGE, f"| {star}, {band} | {{:.2f}} ({{:.2f}}) | {{:.2f}} ({{:.2f}}) "
              "| {:.2f} ({:.2f}) |", partial(ratios, star, band))
        for star, band in PAIRS
    ),
    Claim(PAGE, "the S/N scatters by {:.2f} to {:.2f}.",
          lambda: [stated(f"S/N deviation beyond 0.3 arcsec, {each}", setting="two rolls")
                   for each in ("smallest", "largest")]),
    Claim(PAGE, "F444W are {:.1f} to {:.1f} times higher.",
          lambda: [stated(f"limits without a pattern over those with it, {each}")
                   for each in ("smallest", "largest")]),
    Claim(PAGE, "Of {1:.0f} planets, {0:.0f} are detected:", all_planets),
    Claim(PAGE, "{:.0f} of {:.0f} beyond 0.45 arcsec, and {:.0f} of {:.0f} within",
          lambda: [*planets("beyond", 24), *planets("within", 4)]),
    Claim(PAGE, "contrasts are {:.2f} +- {:.2f} of the truth",
          lambda: [stated("injected planets: contrast over truth, mean", each, star="all")
                   for each in ("value", "error")]),
    Claim(PAGE, "the median ratios are {:.2f} and {:.2f} in the two filters.",
          lambda: [stated("ratio of limits of product images, median", filter=band,
                          setting="cleaned") for band in BOTH]),
    Claim(PAGE, "at 2 arcsec the ratios are {:.2f} and {:.2f}.",
          lambda: [stated("ratio of limits of product images, at 2.0 arcsec", filter=band,
                          setting="cleaned") for band in BOTH]),
    Claim(PAGE, "in F356W it comes out {:.2f} times as large",
          lambda: [stated("factor by which contrasts are too low without a map")]),
    Claim(PAGE, "keeps {:.2f} and {:.2f} of it.",
          lambda: disk("disk=True, fitted light", *BOTH)),
    Claim(PAGE, "KLIP keeps {:.2f} and {:.2f} with one mode, and {:.2f} and {:.2f} with five.",
          lambda: [*disk("KLIP, 1 modes", *BOTH), *disk("KLIP, 5 modes", *BOTH)]),
    Claim(PAGE, "are {:.2f} and {:.2f} times deeper than KLIP's",
          lambda: medians(DISKS, "ratio_small_sample", "AU Mic", *BOTH)),
    Claim(PAGE, "the {:.0f} % and {:.0f} % of the field",
          lambda: [stated("field with limits", filter=band) for band in BOTH]),
    Claim(PAGE, "chi-squared per pixel of {:.1f} and {:.1f}.",
          lambda: [stated("chi-squared per pixel", star="AU Mic", filter=band, setting="disk=True")
                   for band in BOTH]),
    Claim(PAGE, "is the only candidate, at S/N {:.0f}:", lambda: [stated("S/N of the companion")]),
    Claim(PAGE, "| this package | {:.4f} +- {:.4f} | {:.2f}e-4 +- {:.2f}e-4 |",
          lambda: [*companion("separation of the companion"),
                   *companion("contrast of the companion", 1e4)]),
    Claim(PAGE, "L20) | {:.3f} +- {:.3f} | {:.2f}e-4 +- {:.2f}e-4 |",
          lambda: [*companion("published separation"),
                   *companion("published contrast", 1e4)]),
    # -- other pages
    Claim("docs/howto/real_frames.md", "takes about twice as long",
          lambda: [stated("duration without a map over that with a map")]),
    *(
        Claim("docs/validation/calibration.md", f"| {hours} | {{:.3f}} | {{:.3f}} | {{:.3f}} |",
              partial(calibration, hours))
        for hours in (0, 3, 40, 86, 200)
    ),
    Claim("docs/validation/calibration.md",
          "| 5-sigma limit | {:.3f} +- {:.3f} | {:+.2f} +- {:.2f} "
          "| {:.2f} | {:.2f} |", lambda: fluxes(True)),
    Claim("docs/validation/calibration.md", "| 1e-6 | {:.3f} +- {:.3f} | {:+.2f} +- {:.2f} "
          "| {:.2f} | {:.2f} |", lambda: fluxes(False, 1e-6)),
    Claim("docs/validation/calibration.md", "| 1e-4 | {:.4f} +- {:.4f} | {:+.2f} +- {:.2f} "
          "| {:.2f} | {:.2f} |", lambda: fluxes(False, 1e-4)),
    Claim("docs/validation/calibration.md", "| all 25 frames | {:.4f} +- {:.4f} | {:+.2f} +- "
          "{:.2f} | {:.2f} | {:.2f} |", lambda: fluxes(False)),
    Claim("docs/validation/calibration.md", "to {:.2f} mas, {:.4f} %, {:.4f} degrees and {:.2f} %",
          lambda: [float(np.max(table("mismatch_measured")[f"{name}_error_{unit}"]))
                   for name, unit in (("offset", "mas"), ("lyot", "percent"),
                                      ("rotation", "deg"), ("flux", "percent"))]),
    *(
        Claim("docs/validation/experiments.md", f"| {name} | {{:.1f}} | {{:.2f}} | {{:.2f}} |",
              partial(experiments, name))
        for name in ("KLIP", "KLIP, library", "Adam", "Gauss-Newton", "marginalised")
    ),
    Claim("docs/validation/demo.md", "| KLIP | {:.1f} | {:.2f} | {:.1f} |",
          lambda: [stated(f"demo: {each}", setting="KLIP")
                   for each in ("annulus SNR", "throughput", "star error")]),
    Claim("docs/validation/demo.md", "| refined: fitted to the frame | {:.1f} | {:.2f} | {:.2f} |",
          lambda: [stated(f"demo: {each}", setting="refined")
                   for each in ("annulus SNR", "throughput", "star error")]),
    Claim("docs/validation/demo.md", "at {:.3f} arcsec and {:.1f} degrees",
          lambda: [stated("demo: separation"), stated("demo: position angle")]),
    Claim("docs/validation/demo.md", "a contrast of {:.2f}e-6 +- {:.2f}e-6 (true: 1e-6) at "
          "S/N {:.1f}",
          lambda: [1e6 * stated("demo: contrast"), 1e6 * stated("demo: contrast", "error"),
                   stated("demo: S/N")]),
    Claim("docs/validation/speed_error.md", "| one image | {:.1f} ms | {:.1e} of the peak | "
          "{:.2f} s: stpsf `calc_psf`, oversample 4 | {:.1e} | {:.0f} |",
          lambda: [1e3 * speed("forward", "this package, 1024", "seconds"),
                   speed("forward", "this package, 1024", "error"),
                   speed("forward", "stpsf calc_psf, fft_oversample 4", "seconds"),
                   speed("forward", "stpsf calc_psf, fft_oversample 4", "error"),
                   speed("forward", "this package, 1024", "ratio")]),
    Claim("docs/validation/speed_error.md", "| image and gradient | {:.1f} ms | {:.1e} | "
          "{:.0f} ms: the paper's renderer | {:.1e} | {:.0f} |",
          lambda: [1e3 * speed("forward + backward", "this package, 1024", "seconds"),
                   speed("forward + backward", "this package, 1024", "error"),
                   1e3 * speed("forward + backward", "the paper's recipe", "seconds"),
                   speed("forward + backward", "the paper's recipe", "error"),
                   speed("forward + backward", "this package, 1024", "ratio")]),
    Claim("docs/validation/speed_error.md", "| fit of a frame | {:.2f} s | star {:.2f} sigma | "
          "{:.0f} s (one step timed): the paper's recipe, 1000 Adam steps | star {:.1f} sigma | "
          "{:.0f} |",
          lambda: [speed("refinement", "this package, as it comes", "seconds"),
                   speed("refinement", "this package, as it comes", "sigma"),
                   speed("refinement", "the paper's recipe, 1000 Adam steps", "seconds"),
                   speed("refinement", "the paper's recipe, 1000 Adam steps", "sigma"),
                   speed("refinement", "this package, as it comes", "ratio")]),
    Claim("docs/validation/speed_error.md", "| S/N map, 6400 positions | {:.2f} s | "
          "{:.0e} of S/N | {:.0f} s (two positions timed): "
          "one call of the fine model for each position | | {:.0f} |",
          lambda: [speed("S/N map", "this package, 6400 positions", "seconds"),
                   speed("S/N map", "this package, 6400 positions", "error"),
                   speed("S/N map", "one call of the fine model a position", "seconds"),
                   speed("S/N map", "this package, 6400 positions", "ratio")]),
)  # fmt: skip


def plain(text):
    """Text without line breaks."""
    return " ".join(text.split())


def powers(text):
    """Exponents as people write them: 5e-7 for 5e-07."""
    return re.sub(r"e-0(\d)", r"e-\1", text)


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda each: f"{each.document}: {each.phrase[:40]}")
def test_a_claim_is_what_the_table_says(claim):
    text = plain((ROOT / claim.document).read_text(encoding="utf-8"))
    phrase = plain(powers(claim.phrase.format(*claim.numbers())))
    assert phrase in text, f"{claim.document} does not say: {phrase}"


SETTINGS = (
    r"\[[^]]*\]\([^)]*\)|`[^`]*`",  # Links and code.
    r"F\d{3}[WMN]|MASK\w+|G 7-34|HIP \d+|[Pp]rogramme \d+|5-sigma|2MASS",
    r"\(?\d{4}[a-z]?[,)]|ApJL? \d+, \w+|0\.4 to 2\.3 arcsec|0\.7 arcsec|0\.45 arcsec",
    r"contrast 1e-6, 0\.6 arcsec|1\.6 times the limits|2 arcsec and beyond|50 days old",
)
"""What is no result: names, links, and the settings of a measurement."""


@pytest.mark.parametrize(
    ("document", "begin", "end"),
    [("README.md", "## Why", "## Install"), ("paper/paper.md", "# Validation", "# Acknowledg")],
)
def test_results_of_readme_and_paper_are_all_claims(document, begin, end):
    """A number that is in no claim could disagree with the tables."""
    text = plain(
        (ROOT / document).read_text(encoding="utf-8").partition(begin)[2].partition(end)[0]
    )
    for claim in CLAIMS:
        if claim.document == document:
            text = text.replace(plain(powers(claim.phrase.format(*claim.numbers()))), "")
    for pattern in SETTINGS:
        text = re.sub(pattern, "", text)
    left = re.findall(r"[^ ]*\d[^ ]*", text)
    assert set(left) <= ALLOWED[document], f"{document}: {left} are in no claim"


ALLOWED = {"README.md": {"(F444W"}, "paper/paper.md": {"10", "@carter2023"}}
"""Words with digits that are left: settings, and errors that the text explains elsewhere."""


def test_how_often_real_frames_are_not_explained():
    """The advice about a status says how often it comes, of the reductions on the page."""
    name, explained = "chi-squared per pixel", 1.2  # the limit of CONVERGED
    pairs = [stated(f"{name}, {each}", setting="two rolls") for each in ("smallest", "largest")]
    assert max(pairs) < explained
    others = [stated(name, star="AU Mic", filter=each, setting="disk=True") for each in BOTH]
    others.append(stated(name, star="HIP 65426", setting=""))
    missed = sum(each > explained for each in others)
    phrase = f"{missed} of the {len(PAIRS) + len(others)} reductions"
    assert phrase in advice(Status.MODEL_MISMATCH, patterned=True)
    assert phrase in (ROOT / "docs/howto/status.md").read_text(encoding="utf-8")


def test_the_page_of_real_frames_has_few_numbers():
    text = (ROOT / PAGE).read_text(encoding="utf-8")
    for pattern in SETTINGS[:2]:
        text = re.sub(pattern, "", text)
    numbers = re.findall(r"(?<![\w.])\d[\d.]*(?:e-?\d+)?", text)
    assert 60 < len(numbers) <= 120


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.ecsv")), ids=lambda path: path.name)
def test_tables_say_when_and_how_they_were_made(path):
    found = Table.read(path)
    text = " ".join(map(str, found.meta.values()))
    for name in ("command", "date", "note"):
        if name in found.colnames:
            text += " ".join(map(str, found[name]))
    assert re.search(r"python|pyklip-diffrender", text), "no command"
    assert re.search(r"20\d\d-\d\d-\d\d", text), "no date"
