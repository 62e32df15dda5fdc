"""Numbers of README, documentation and paper are those of the tables in ``docs/results``.

A claim is a phrase with a place for each number, which the document has to contain with those
of the tables: the test fails if a number disagrees, and if the phrase is gone.
"""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

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


def speeds(row, ours, others, error, scale=1.0, others_scale=1.0):
    """Duration and error of ours and of another's, and how many times as fast ours is."""
    found = {
        str(each["column"]): each for each in rows("performance", row=row, precision="float64")
    }
    one, other = found[ours], found[others]
    times = [scale * one["seconds"], others_scale * other["seconds"]]
    return [times[0], one[error], times[1], other[error], one["ratio"]]


BOTH = ("F444W", "F356W")
LIKE, SAME = "like_with_like", {"library": "no library", "references": "references"}
LIMITS, IMAGES, DISKS = "real_pairs_limits", "real_pairs_images", "disk_limits"
README, PAPER, PAGE = "README.md", "paper/paper.md", "docs/validation/real_frames.md"
HOWTO, RESOURCES = "docs/howto/real_frames.md", "docs/howto/resources.md"
NEIGHBOURS, SPACEKLIP = "docs/validation/neighbours.md", "docs/howto/spaceklip.md"
CALIBRATION, DEMO = "docs/validation/calibration.md", "docs/validation/demo.md"
SPEED, REFERENCES = "docs/validation/speed_error.md", "docs/validation/references.md"


@cache
def claims():
    """Document, phrase with a format for each number, and the numbers, of every claim."""
    hip = [*companion("separation of the companion"),
           *companion("contrast of the companion", 1e4)]  # fmt: skip
    published = [*companion("published separation"), *companion("published contrast", 1e4)]
    beyond, within = planets("beyond", 24), planets("within", 4)
    found, injected = np.add(beyond, within)
    truth = [stated("injected planets: contrast over truth, mean", each, star="all")
             for each in ("value", "error")]  # fmt: skip
    joint = [100 * each for each in disk("disk=True, fitted light", *BOTH)]
    klip = [100 * of_klip(min), 100 * of_klip(max)]
    cleaned = [stated("ratio of limits of product images, median", filter=band, setting="cleaned")
               for band in BOTH]  # fmt: skip
    demo = [1e6 * stated("demo: contrast"), 1e6 * stated("demo: contrast", "error")]
    snr = stated("S/N of the companion")
    dwarfs = ("G-7-34", "HIP17695")
    like_with_like = [middle(LIKE, "ratio", star=star, filter=band, **SAME)
                      for star in dwarfs for band in BOTH]  # fmt: skip
    least_of_dwarfs = min(least(LIKE, "ratio", star=star, **SAME) for star in dwarfs)
    scatter = np.prod([table("visits_null")[name] for name in ("scatter", "factor")], axis=0)
    pulls = table("visit_planets")
    stars = table("star_flux")[table("star_flux")["rolls"] == "pair"]
    beside_photometry = [
        each["fitted"] / np.nanmean([each["wise"], each["type_and_ks"]]) for each in stars
    ]
    visits = table("reference_sequences").group_by("visit").groups.aggregate(np.median)
    return (
        (README, "| the same | {:.1f} to {:.1f} | once, within 0.7 arcsec, up to {:.1f} times |",
         [f(like_with_like) for f in (min, max)] + [1 / least_of_dwarfs]),
        (README, "| all | all | {:.2f} | at some separations, up to {:.1f} times |",
         [np.median(visits["klip_over_ours_raw"]),
          1 / least("reference_sequences", "klip_over_ours_raw")]),
        (README, "ours keeps {:.0f} %, KLIP at most {:.0f} %", [min(joint), klip[1]]),
        (README, "by up to {:.1f}.",
         [max(max(table(name)["error_factor"]) for name in (LIMITS, LIKE))]),
        (README, "up to {:.1f} times as bright as photometry says", [max(beside_photometry)]),
        (README, "up to {:.1f} times too\n  bright",
         [stated("star's flux from a flat wavefront over that from a map, largest")]),
        # -- intake and resources
        (NEIGHBOURS, "segments), {:.0f} are used entirely, from {:.0f} some files are excluded "
         "with a reason, and {:.0f} are refused",
         [table("intake")[name][-1] for name in ("as untouched", "excluded", "refused")]),
        (HOWTO, "takes about twice as long",
         [stated("duration without a map over that with a map")]),
        (RESOURCES, "3255 integrations, takes {:.2f} times its size",
         [stated("memory of reading over the size of the file", setting="4 GB")]),
        (RESOURCES, "reading takes {:.1f} times the file (`--dataset",
         [stated("memory of reading over the size of the file", setting="pyKLIP dataset, 0.2 GB")]),
        # -- steps before a reduction
        *((SPACEKLIP, f"{what} | {{:{form}f}}",
           [float(rows("stage2_steps", step=step)["limits"][0])])
          for step, what, form in (
              ("background", "no harm: it is fitted", ".2"),
              ("1/f, star masked", "only if stripes are seen", ".2"),
              ("1/f, star not masked", "the star not masked | no", ".2"),
              ("flagged pixels", "before a shift; otherwise not needed", ".2"),
              ("pixels found by clipping", "it takes the star's sharp structure", ".1"),
              ("NaN to zero", "`replace_nans` | before a shift", ".2"),
              ("cropping", "only a square about the star is fitted", ".2"),
              ("recentring, recorded", "as `IMSHIFTS` records the shift", ".2"),
              ("recentring, not recorded", "is lost", ".2"))),
        # -- paper
        (PAPER, "factors of {:.1f} (F356W) and {:.1f} (F444W) for HIP 17695, and of {:.1f} and "
         "{:.1f} for G 7-34",
         [*medians(LIMITS, "ratio_small_sample", "HIP 17695", *BOTH[::-1]),
          *medians(LIMITS, "ratio_small_sample", "G 7-34", *BOTH[::-1])]),
        (PAPER, "Of {1:.0f} planets injected at 1.6 times the limits {0:.0f} were",
         [found, injected]),
        (PAPER, "with fluxes of {:.2f} +- {:.2f} of the truth", truth),
        (PAPER, "KLIP keeps {:.0f} to {:.0f} % of the light and the joint fit {:.0f} % in F444W "
         "({:.0f} % in F356W)", [*klip, *joint]),
        (PAPER, "{:.3f} +- {:.3f} arcsec and a contrast of {:.2f}e-4 +- {:.2f}e-4", hip),
        (PAPER, "published {:.3f} +- {:.3f} arcsec and {:.2f}e-4 +- {:.2f}e-4", published),
        # -- real frames
        *((PAGE, f"| {star}, {band} | {{:.2f}} ({{:.2f}}) | {{:.2f}} ({{:.2f}}) | {{:.2f}} "
           "({:.2f}) |", ratios(star, band)) for star, band in PAIRS),
        (PAGE, "the S/N scatters by {:.2f} to {:.2f} after the errors",
         [stated(f"S/N deviation beyond 0.3 arcsec, {each}", setting="two rolls")
          for each in ("smallest", "largest")]),
        (PAGE, "after the errors are scaled, by {:.2f} to {:.2f}.",
         [f(table(LIMITS)["error_factor"]) for f in (min, max)]),
        (PAGE, "for one of them {:.1f} times",
         [stated("star's flux from a flat wavefront over that from a map, largest")]),
        (PAGE, "Of {1:.0f} planets, {0:.0f} are detected:", [found, injected]),
        (PAGE, "{:.0f} of {:.0f} beyond 0.45 arcsec, and {:.0f} of {:.0f} within",
         [*beyond, *within]),
        (PAGE, "contrasts are {:.2f} +- {:.2f} of the truth", truth),
        (PAGE, "the median ratios are {:.2f} and {:.2f} in the two filters.", cleaned),
        (PAGE, "at 2 arcsec the ratios are {:.2f} and {:.2f}.",
         [stated("ratio of limits of product images, at 2.0 arcsec", filter=band,
                 setting="cleaned") for band in BOTH]),
        (PAGE, "in F356W it comes out {:.2f} times as large,",
         [stated("factor by which contrasts are too low without a map")]),
        (PAGE, "keeps {:.2f} and {:.2f} of it.", disk("disk=True, fitted light", *BOTH)),
        (PAGE, "KLIP keeps {:.2f} and {:.2f} with one mode, and {:.2f} and {:.2f} with five.",
         [*disk("KLIP, 1 modes", *BOTH), *disk("KLIP, 5 modes", *BOTH)]),
        (PAGE, "are {:.2f} and {:.2f} times deeper than KLIP's",
         medians(DISKS, "ratio_small_sample", "AU Mic", *BOTH)),
        (PAGE, "the {:.0f} % and {:.0f} % of the field",
         [stated("field with limits", filter=band) for band in BOTH]),
        (PAGE, "chi-squared per pixel of {:.1f} and {:.1f}.",
         [stated("chi-squared per pixel", star="AU Mic", filter=band, setting="disk=True")
          for band in BOTH]),
        (PAGE, "is the only candidate, at S/N {:.0f}:", [snr]),
        (PAGE, "| this package | {:.4f} +- {:.4f} | {:.2f}e-4 +- {:.2f}e-4 |", hip),
        (PAGE, "L20) | {:.3f} +- {:.3f} | {:.2f}e-4 +- {:.2f}e-4 |", published),
        # -- other pages
        *((NEIGHBOURS, f"| {name} | {{:.2f}} | {{:.2f}} | {{:.2f}} | {{:.2f}} |",
           list(rows("neighbours", contrast=0.1)[column]))
          for name, column in (("limits over those without it, median", "limits"),
                               ("of which photon noise", "photon_limits"),
                               ("reduced chi-squared (0.77 without it)", "chi2"))),
        *((NEIGHBOURS, phrase,
           [f(rows("neighbours", contrast=contrast)[column]) for f in (min, max)])
          for phrase, contrast, column in (
              ("contrast of a binary of 0.1 is {:.2f} to {:.2f} times", 0.1, "measured"),
              ("Limits are {:.2f} to {:.2f} times those without the field", 0.0, "limits"))),
        (REFERENCES, "mean (least, greatest) | {:.3f} ({:.2f}, {:.2f}) |",
         [f(scatter) for f in (np.mean, min, max)]),
        *((REFERENCES, f"| {name} | {{:.2f}} | {{:+.2f}} |",
           [np.mean(pull**2) ** 0.5, np.mean(pull)])
          for name, pull in (("separation", pulls["separation_pull"]),
                             ("position angle", pulls["angle_pull"]))),
        *((CALIBRATION, f"| {hours} | {{:.3f}} | {{:.3f}} | {{:.3f}} |", calibration(hours))
          for hours in (0, 3, 40, 86, 200)),
        *((CALIBRATION, f"| {name} | {{:{form}f}} +- {{:{form}f}} | {{:+.2f}} +- {{:.2f}} "
           "| {:.2f} | {:.2f} |", fluxes(*which))
          for name, form, which in (
              ("5-sigma limit", ".3", (True,)), ("1e-6", ".3", (False, 1e-6)),
              ("1e-4", ".4", (False, 1e-4)), ("all 25 frames", ".4", (False,)))),
        (CALIBRATION, "to {:.2f} mas, {:.4f} %, {:.4f} degrees and {:.2f} %",
         [np.max(table("mismatch_measured")[f"{name}_error_{unit}"])
          for name, unit in (("offset", "mas"), ("lyot", "percent"), ("rotation", "deg"),
                             ("flux", "percent"))]),
        *(("docs/validation/experiments.md", f"| {name} | {{:.1f}} | {{:.2f}} | {{:.2f}} |",
           experiments(name))
          for name in ("KLIP", "KLIP, library", "Adam", "Gauss-Newton", "marginalised")),
        *((DEMO, f"| {row} | {{:.1f}} | {{:.2f}} | {{:{form}f}} |",
           [stated(f"demo: {each}", setting=setting)
            for each in ("annulus SNR", "throughput", "star error")])
          for row, form, setting in (("KLIP", ".1", "KLIP"),
                                     ("refined: fitted to the frame", ".2", "refined"))),
        (DEMO, "at {:.3f} arcsec and {:.1f} degrees",
         [stated("demo: separation"), stated("demo: position angle")]),
        (DEMO, "a contrast of {:.2f}e-6 +- {:.2f}e-6 (true: 1e-6) at S/N {:.1f}",
         [*demo, stated("demo: S/N")]),
        *((SPEED, f"{row} | {{:.2f}} | {{:.2f}} | {{:.2f}} |",
           [f(table("first_look")[column]) for f in (np.median, min, max)])
          for row, column in (("processor time", "time"), ("star's flux", "flux"),
                              ("limits as contrasts, median over separations", "limits"),
                              ("in units of flux, median over separations", "limits_in_flux"))),
        (SPEED, "| one image | {:.1f} ms | {:.1e} of the peak | {:.2f} s: stpsf `calc_psf`, "
         "oversample 4 | {:.1e} | {:.0f} |",
         speeds("forward", "this package, 1024", "stpsf calc_psf, fft_oversample 4", "error", 1e3)),
        (SPEED, "| image and gradient | {:.1f} ms | {:.1e} | {:.0f} ms: the paper's renderer | "
         "{:.1e} | {:.0f} |",
         speeds("forward + backward", "this package, 1024", "the paper's recipe", "error", 1e3,
                1e3)),
        (SPEED, "| fit of a frame | {:.2f} s | star {:.2f} sigma | {:.0f} s (one step timed): the "
         "paper's recipe, 1000 Adam steps | star {:.1f} sigma | {:.0f} |",
         speeds("refinement", "this package, as it comes", "the paper's recipe, 1000 Adam steps",
                "sigma")),
        (SPEED, "| S/N map, 6400 positions | {0:.2f} s | {1:.0e} of S/N | {2:.0f} s (two positions "
         "timed): one call of the fine model for each position | | {4:.0f} |",
         speeds("S/N map", "this package, 6400 positions", "one call of the fine model a position",
                "error")),
    )  # fmt: skip


def plain(text):
    """Text without line breaks."""
    return " ".join(text.split())


def as_stated(phrase, numbers):
    # Exponents as people write them: 5e-7 for 5e-07.
    return plain(re.sub(r"e-0(\d)", r"e-\1", phrase.format(*numbers)))


@cache
def text_of(document):
    return plain((ROOT / document).read_text(encoding="utf-8"))


def test_a_claim_is_what_the_table_says():
    said = [(document, as_stated(phrase, numbers)) for document, phrase, numbers in claims()]
    assert [each for each in said if each[1] not in text_of(each[0])] == []


SETTINGS = (
    r"\[[^]]*\]\([^)]*\)|`[^`]*`",  # Links and code.
    r"F\d{3}[WMN]|MASK\w+|G 7-34|HIP \d+|[Pp]rogramme \d+|5-sigma|2MASS",
    r"\(?\d{4}[a-z]?[,)]|ApJL? \d+, \w+|0\.4 to 2\.3 arcsec|0\.7 arcsec|0\.45 arcsec",
    r"from (0\.4|2) arcsec|1\.6 times the limits|50 days old",
)
"""What is no result: names, links, and the settings of a measurement."""


@pytest.mark.parametrize(
    ("document", "begin", "end"),
    [("README.md", "## Results", "## More"), ("paper/paper.md", "# Validation", "# Acknowledg")],
)
def test_results_of_readme_and_paper_are_all_claims(document, begin, end):
    """A number that is in no claim could disagree with the tables."""
    text = text_of(document).partition(begin)[2].partition(end)[0]
    for where, phrase, numbers in claims():
        if where == document:
            text = text.replace(as_stated(phrase, numbers), "")
    for pattern in SETTINGS:
        text = re.sub(pattern, "", text)
    left = re.findall(r"[^ ]*\d[^ ]*", text)
    assert set(left) <= ALLOWED[document], f"{document}: {left} are in no claim"


ALLOWED = {"README.md": set(), "paper/paper.md": {"10", "@carter2023"}}
"""Words with digits that are left: settings, and errors that the text explains elsewhere."""


def test_the_readme_takes_a_minute():
    """Somebody decides there whether to go on: at most 450 words and twelve numbers."""
    text = (ROOT / README).read_text(encoding="utf-8")
    assert len(text.split()) <= 450
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    for pattern in (*SETTINGS[:2], "BSD 3-clause"):
        prose = re.sub(pattern, "", prose)
    assert 6 < len(re.findall(r"(?<![\w.])\d[\d.]*", prose)) <= 12


@pytest.mark.parametrize("path", sorted((ROOT / "docs/howto").glob("*.md")), ids=lambda p: p.stem)
def test_guides_are_short(path):
    """What was measured, and how, belongs to the pages of validation."""
    assert len(path.read_text(encoding="utf-8").split()) <= 1200


def test_how_often_real_frames_are_not_explained():
    """The page on statuses says how often one comes, of the reductions on the page."""
    name, explained = "chi-squared per pixel", 1.2  # the limit of CONVERGED
    pairs = [stated(f"{name}, {each}", setting="two rolls") for each in ("smallest", "largest")]
    assert max(pairs) < explained
    others = [stated(name, star="AU Mic", filter=each, setting="disk=True") for each in BOTH]
    others.append(stated(name, star="HIP 65426", setting=""))
    missed = sum(each > explained for each in others)
    phrase = f"{missed} of the {len(PAIRS) + len(others)} reductions"
    assert phrase in (ROOT / "docs/howto/status.md").read_text(encoding="utf-8")


def test_the_page_of_real_frames_has_few_numbers():
    text = (ROOT / PAGE).read_text(encoding="utf-8")
    for pattern in SETTINGS[:2]:
        text = re.sub(pattern, "", text)
    assert 60 < len(re.findall(r"(?<![\w.])\d[\d.]*(?:e-?\d+)?", text)) <= 120


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.ecsv")), ids=lambda path: path.name)
def test_tables_say_when_and_how_they_were_made(path):
    found = Table.read(path)
    text = " ".join(map(str, found.meta.values()))
    for name in ("command", "date", "note"):
        if name in found.colnames:
            text += " ".join(map(str, found[name]))
    assert re.search(r"python|pyklip-diffrender", text), "no command"
    assert re.search(r"20\d\d-\d\d-\d\d", text), "no date"
