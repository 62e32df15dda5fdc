"""Surveys: what is asked for is checked, what is finished is kept, what fails is said."""

import json
import shutil
import sys
import time
from dataclasses import replace
from datetime import date
from functools import partial
from math import inf
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from survey_stubs import HOSTILE, Tags, configuration, inputs, result, stub

import pyklip_diffrender as dr
from benchmarks import faults
from benchmarks.calints_files import SIDE, calints
from benchmarks.synthetic_searches import searched, write_searched
from pyklip_diffrender.cli import main
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.surveys import driver
from pyklip_diffrender.surveys import jobs as folders
from pyklip_diffrender.surveys.config import read_config
from pyklip_diffrender.surveys.driver import run_survey
from pyklip_diffrender.surveys.jobs import jobs_of

PLANETS = {"contrasts": [1e-5, 3e-6], "separations": [0.5, 1.0], "angles": [0, 90.0]}
PLANET = {"contrasts": [1e-5], "separations": [0.5]}
NO_STAR = np.zeros((SIDE, SIDE))


@pytest.fixture(autouse=True)
def _not_drawn(monkeypatch):
    """Without the picture of the page, which takes a second."""
    monkeypatch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"no picture")


def planned(config):
    return jobs_of(read_config(config))


def hidden(output):
    """What is left of jobs that never ended."""
    return [path.name for path in (output / "jobs").iterdir() if path.name.startswith(".")]


def failing(star, error):
    """The stub's work, which fails for one star."""

    def work(job, folder):
        (folder / "half").write_text("a product")
        if job.name.startswith(star):
            raise error
        return stub(job, folder)

    return work


def recording(ran):
    """The stub's work, which adds its jobs to a list."""
    return lambda job, folder: ran.append(job) or stub(job, folder)


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Runs the command with other work than reductions, and returns its exit status."""

    def run(work, count, more=""):
        monkeypatch.setattr("pyklip_diffrender.surveys.driver.reduce_job", work)
        path = configuration(tmp_path / "survey.toml", inputs(tmp_path / "data", count))
        path.write_text(path.read_text() + more)
        return main(["survey", str(path), "-o", str(tmp_path / "out"), "-q"])

    return run


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    inputs(tmp_path, 1)
    path = tmp_path / "survey.toml"
    path.write_text('[[sequence]]\nfiles = "star0_calints.fits"\nopd = "opd.fits"\n')
    monkeypatch.chdir("/")
    (sequence,) = read_config(path).sequences
    assert (sequence.opd, sequence.name) == (tmp_path / "opd.fits", "star0_calints")


def test_options_of_a_sequence_come_before_those_of_all(tmp_path):
    config = inputs(tmp_path, 2)
    config["options"] = {"threshold": 6, "size": 48, "settings": {"cycles": 8, "robust": inf}}
    config["injections"] = PLANETS
    config["sequence"][1] |= {"threshold": 7.5, "settings": {"cycles": 12.0}, "injections": {}}
    first, second = read_config(config).sequences
    assert (first.options.size, first.options.threshold) == (40, 6.0)
    assert (second.options.size, second.options.threshold) == (40, 7.5)
    assert second.options.settings == {"cycles": 12.0, "robust": inf}
    assert first.injections.contrasts == second.injections.contrasts == (1e-5, 3e-6)
    assert len(planned(config)) == 2 * (1 + 2 * 2 * 2)
    assert set(run_survey(config, tmp_path / "out", stub)["status"]) == {"finished"}


@pytest.mark.parametrize(
    ("where", "key", "value", "words"),
    [
        ((), "wokers", 2, ["the key 'wokers'", "workers", "Check its name"]),
        ((), "workers", -1, ["workers", "-1", "0 or more"]),
        ((), "memory_limit", "much", ["memory_limit", "'much'", "4 GB"]),
        ((), "sequence", [], ["sequence", "[[sequence]]"]),
        ((), "options", 3, ["options", "a table"]),
        ((), "options", {"threshold": "5"}, ["options: threshold", "'5'", "positive"]),
        ((), "options", {"settings": {"basis": 1}}, ["options: settings", "'basis'", "cycles"]),
        ((), "options", {"settings": {"cycles": "x"}}, ["options: settings", "cycles", "'x'"]),
        ((), "options", {"settings": {"free": [date(2022, 8, 1)]}}, ["settings", "a date"]),
        ((), "options", {"settings": {"robust": float("nan")}}, ["options: settings", "nan"]),
        ((1,), "wide", "yes", ["sequence 2: wide", "true or false"]),
        ((), "options", {"settings": {"tolerance": []}}, ["options: settings", "wrong type"]),
        ((), "options", {"disk": True, "wide": True}, ["options", "one of them"]),
        ((), "combined", {"spectra": ["no.ecsv"]}, ["combined: spectra", "no.ecsv", "'flat'"]),
        ((), "combined", {"spectra": []}, ["combined: spectra", "[]"]),
        ((), "combined", {"parallax": 0.1}, ["combined: got the key 'parallax'", "spectra"]),
        ((), "injections", {"contrasts": [1e-5]}, ["injections", "both"]),
        ((), "injections", {"contrasts": [12.5]}, ["contrasts", "no magnitudes"]),
        ((), "injections", {"angles": 3}, ["injections: angles", "a list"]),
        ((0,), "files", "nowhere.fits", ["sequence 1: files", "nowhere.fits", "exist"]),
        ((0,), "opd", 3, ["sequence 1: opd", "3", "map"]),
        ((1,), "name", "star0_calints", ["sequence 2: name", "no other sequence"]),
        ((1,), "name", "two\nlines", ["sequence 2: name", "printable"]),
        ((1,), "threshold", 10**400, ["sequence 2: threshold", "positive"]),
        ((1,), "pattern", __file__, ["sequence 2: pattern", "test_survey", "patterns"]),
        ((1,), "pattern", "no.fits", ["sequence 2: pattern", "'no.fits'", "references"]),
        ((1,), "injections", {**PLANETS, "separations": [2.0]}, ["sequence 2", "less than 1.3"]),
        ((1,), "code", "import os", ["sequence 2: got the key 'code'", "one of files"]),
    ],
)  # fmt: skip
def test_a_mistake_is_named_before_anything_is_done(tmp_path, where, key, value, words):
    config = inputs(tmp_path / "data", 2)
    place = config["sequence"][where[0]] if where else config
    place[key] = value
    with pytest.raises(IncompatibleSetupError) as raised:
        run_survey(config, tmp_path / "out", stub)
    lines = str(raised.value).splitlines()
    assert len(lines) == 2
    assert all(word in lines[1] for word in words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"a = [", b"\xff", b"[" * 5000, b"a = 1\na = 2"])
def test_a_file_that_is_not_toml(tmp_path, content):
    path = tmp_path / "survey.toml"
    with pytest.raises(CorruptFileError, match=r"survey\.toml: cannot be read"):
        read_config(path)
    path.write_bytes(content)
    with pytest.raises(CorruptFileError, match=r"survey\.toml: not a TOML file"):
        read_config(path)


def test_the_same_job_twice_is_a_mistake(tmp_path):
    config = inputs(tmp_path, 1)
    config["sequence"].append({**config["sequence"][0], "name": "again"})
    with pytest.raises(IncompatibleSetupError, match="again: got the same inputs and options"):
        planned(config)


def test_epochs_of_a_sequence_are_jobs_of_their_own(tmp_path):
    config, frames = inputs(tmp_path, 1), tmp_path / "frames"
    for k, day in enumerate(("2022-10-03", "2022-10-04", "2023-12-01")):
        calints(frames / f"{k}.fits", observation=k, date=f"{day}T06:00:00", roll=70.0 + k)
    config["sequence"][0] |= {"files": str(frames), "name": "HD 1", "injections": PLANET}
    jobs = planned(config)
    assert [each.name for each in jobs] == ["HD 1 2022-10-03"] * 2 + ["HD 1 2023-12-01"] * 2
    assert len({each.key for each in jobs}) == 4
    epochs = [dr.ExposureSequence.from_files(job.files, epoch=job.epoch) for job in jobs[::2]]
    chosen = [[each.name for each in epoch.science] for epoch in epochs]
    assert chosen == [["0.fits", "1.fits"], ["2.fits"]]
    assert jobs[3].epoch == jobs[2].epoch
    # One epoch is named as before, whatever else is in the folder.
    (frames / "2.fits").unlink()
    calints(frames / "3.fits", observation=2, date="2023-12-01T06:00:00", light=NO_STAR)
    assert [each.name for each in planned(config)] == ["HD 1", "HD 1"]


def test_of_a_folder_of_maps_the_nearest_to_the_target_is_used(tmp_path):
    config = inputs(tmp_path, 1)
    maps, frames = tmp_path / "maps", tmp_path / "frames"
    maps.mkdir()
    opd = dr.wavefront.random_opd(1, npix=16).data
    for day in ("01", "11", "29"):
        header = fits.Header({"BUNIT": "m", "DATE-OBS": f"2022-08-{day}T00:00:00"})
        fits.writeto(maps / f"map{day}.fits", opd, header)
    config["sequence"][0] |= {"opd": str(maps), "files": str(frames)}
    calints(frames / "target.fits", date="2022-08-15T00:00:00")
    # The reference star was observed when another map was the nearest.
    cards = {"IS_PSF": True}
    calints(frames / "star.fits", "HD 2", observation=2, date="2022-08-01T00:00:00", cards=cards)
    (job,) = planned(config)
    assert job.opd == str(maps / "map11.fits")
    assert sorted(job.inputs) == sorted([*map(str, frames.iterdir()), job.opd])


def test_folders_say_what_their_jobs_are_and_follow_a_new_name(tmp_path):
    config, output = inputs(tmp_path / "a", 1), tmp_path / "out"
    config["sequence"][0] |= {"name": "β Pic, F444W"}
    config["injections"] = PLANET
    jobs = planned(config)
    assert [job.folder for job in jobs] == [
        f"Pic-F444W_{jobs[0].key[:12]}",
        f"Pic-F444W-planet-of-1e-05-at-0.5-arcsec-0-deg_{jobs[1].key[:12]}",
    ]
    assert jobs[1].base_folder == jobs[0].folder
    run_survey(config, output, stub)
    config["sequence"][0] |= {"name": "another"}
    # Without any work that would fail.
    table = run_survey(config, output, lambda job, folder: 1 / 0)
    assert list(table["status"]) == ["finished"] * 2
    names = sorted(path.name for path in (output / "jobs").iterdir())
    assert names == sorted(table["folder"]) == sorted(job.folder for job in planned(config))
    page = (output / "survey.html").read_text()
    assert "<title>Survey of another</title>" in page
    assert f'"jobs/{names[0]}/report.html"' in page


def test_the_name_of_a_job_follows_from_content_and_options_alone(tmp_path, monkeypatch):
    (tmp_path / "flat").mkdir()
    monkeypatch.chdir(tmp_path)
    config, moved = inputs(tmp_path / "a", 1), inputs(tmp_path / "b", 1)
    moved["sequence"][0] |= {"name": "other"}
    (job,) = planned(config)
    assert [each.key for each in planned(moved)] == [job.key]
    changes = [
        {"size": 41}, {"threshold": 6}, {"target": "x"}, {"settings": {"cycles": 9}},
        {"wide": True}, {"disk": True}, {"completeness": True}, {"references": "off"},
        {"star_flux": 0.4}, {"opd": "flat"},
    ]  # fmt: skip
    (plain,) = config["sequence"]
    others = [planned({**config, "sequence": [{**plain, **change}]})[0] for change in changes]
    assert len({job.key, *(other.key for other in others)}) == len(changes) + 1
    star, flat = others[-2:]
    assert (star.options.star_flux, star.options.star_flux_error) == (0.4, 0.05)
    assert (flat.opd, list(flat.inputs)) == ("flat", [plain["files"]])
    # Where reference stars may join the target's fit, memory decides how many of them do.
    limits = ({"memory_limit": each} for each in ("4 GB", "4000 MB", "8 GB"))
    less, same, more = (planned({**config, **each})[0].key for each in limits)
    assert less == same
    assert len({job.key, less, more}) == 3
    alone = {**config, "sequence": [{**plain, "references": "off"}]}
    assert len({planned({**alone, **each})[0].key for each in ({}, {"memory_limit": "4 GB"})}) == 1
    of_all = planned({**config, "options": {"disk": True}})
    assert [each.options.disk for each in of_all] == [True]
    Path(plain["opd"]).write_bytes(b"another map")
    assert [each.key for each in planned(config)] != [job.key]


def test_finished_jobs_are_not_run_again(tmp_path, caplog):
    config, output, ran, seen = inputs(tmp_path / "data"), tmp_path / "out", [], []

    def work(job, folder):
        path = output / "results.ecsv"
        seen.append(list(Table.read(path)["status"]) if path.exists() else [])
        ran.append(job.name)
        return stub(job, folder)

    table = run_survey(config, output, work)
    assert list(table["status"]) == ["finished"] * 3
    # The tables are there while the survey runs.
    assert seen[:2] == [[], ["finished", "waiting", "waiting"]]
    run_survey(config, output, work)
    assert len(ran) == 3
    assert "done again" not in caplog.text
    # One input has changed, one product is damaged: these two are missing.
    Path(config["sequence"][1]["files"]).write_bytes(b"new frames")
    (output / "jobs" / table["folder"][2] / "report.html").write_text("cut")
    run_survey(config, output, work)
    assert ran[3:] == ["star1_calints", "star2_calints"]
    assert "jobs are done again" in caplog.text
    assert "star1_calints" in caplog.text
    # The job of the old content stays.
    assert len(list((output / "jobs").iterdir())) == 4
    assert hidden(output) == []


def test_products_of_another_job_are_not_those_of_this_one(tmp_path, caplog):
    config, output = inputs(tmp_path / "data", 2), tmp_path / "out"
    first, second = run_survey(config, output, stub)["folder"]
    shutil.rmtree(output / "jobs" / first)
    shutil.copytree(output / "jobs" / second, output / "jobs" / first)
    ran = []
    work = recording(ran)
    table = run_survey(config, output, work)
    assert [job.name for job in ran] == ["star0_calints"]
    assert "are done again" in caplog.text
    assert "star0_calints" in caplog.text
    assert list(table["folder"]) == [first, second]
    record = json.loads((output / "jobs" / first / "job.json").read_text())
    assert record["job"]["name"] == "star0_calints"


def test_a_failure_is_a_row_and_is_tried_again(tmp_path):
    config, output = inputs(tmp_path / "data"), tmp_path / "out"
    config["injections"] = PLANET
    table = run_survey(config, output, failing("star1", ZeroDivisionError("at the second star")))
    assert list(table["status"]) == ["finished"] * 2 + ["failed"] * 2 + ["finished"] * 2
    message, consequence = table["message"][2:4]
    assert message == "ZeroDivisionError: at the second star"
    assert "without a planet failed" in consequence
    assert "in work" in table["traceback"][2]
    # ECSV drops the blanks at the start of a line.
    read = Table.read(output / "results.ecsv")["traceback"]
    assert [read[k].split() for k in (2, 3)] == [table["traceback"][k].split() for k in (2, 3)]
    folder = output / "jobs" / table["folder"][2]
    assert [path.name for path in folder.iterdir()] == ["job.json"]
    assert json.loads((folder / "job.json").read_text())["status"] == "failed"
    assert "at the second star" in (output / "survey.html").read_text()
    assert list(run_survey(config, output, stub)["status"]) == ["finished"] * 6
    assert (folder / "report.html").exists()
    assert hidden(output) == []


def test_workers_start_with_a_planet_after_the_job_without(tmp_path):
    """And do not start it after one that failed."""
    distributed = pytest.importorskip("distributed")
    config, output = inputs(tmp_path / "data", 2), tmp_path / "out"
    config["injections"] = {**PLANET, "angles": [0, 90.0]}

    def work(job, folder):
        if job.injection is None:
            # Time for the jobs with planets to be wrong.
            time.sleep(0.1)
            if job.name.startswith("star1"):
                raise ZeroDivisionError("at the second star")
        else:
            assert folders.finished(folder.parent / job.base_folder)
        return stub(job, folder)

    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=4, processes=False, dashboard_address="127.0.0.1:0"
    ) as cluster:
        table = run_survey(config, output, work, cluster.scheduler_address)
    assert list(table["status"]) == ["finished"] * 3 + ["failed"] * 3
    assert "at the second star" in table["message"][3]
    assert all("without a planet failed" in each for each in table["message"][4:])
    assert hidden(output) == []


@pytest.mark.parametrize("damage", ["{", "[]", '{"products": {}}', '{"products": 3}'])
def test_a_damaged_record_is_a_missing_job(tmp_path, damage):
    config, output = inputs(tmp_path / "data", 1), tmp_path / "out"
    (name,) = run_survey(config, output, stub)["folder"]
    record = output / "jobs" / name / "job.json"
    whole = json.loads(record.read_text())
    record.write_text(damage)
    assert list(run_survey(config, output, stub)["status"]) == ["finished"]
    assert json.loads(record.read_text())["products"] == whole["products"]


def test_frames_that_change_on_the_way_are_noticed(tmp_path):
    config = inputs(tmp_path / "data", 2)

    def work(job, folder):
        Path(config["sequence"][1]["files"]).write_bytes(b"other")
        return stub(job, folder)

    table = run_survey(config, tmp_path / "out", work)
    assert list(table["status"]) == ["finished", "failed"]
    assert "star1_calints.fits: the content on" in table["message"][1]


@pytest.mark.parametrize("what", ["file", "version", "output"])
def test_a_worker_that_sees_something_else_says_so(tmp_path, what):
    (job,) = planned(inputs(tmp_path / "data", 1))
    jobs = folders.folder_for_jobs(tmp_path / "out")
    words = {"file": "does not see this file", "version": "99.0", "output": "see this folder"}[what]
    if what == "file":
        shutil.rmtree(tmp_path / "data")
    elif what == "version":
        job = replace(job, version="99.0")
    else:
        shutil.rmtree(jobs)
    record = driver.run_job(job, jobs, stub)
    assert record["status"] == "failed"
    assert words in record["message"]
    # A worker must not make the folder on a disk of its own.
    assert jobs.exists() == (what != "output")


def test_the_table_that_is_written_is_that_which_is_returned(tmp_path):
    config = inputs(tmp_path / "data", 2)
    config["sequence"][0]["injections"] = PLANET
    table = run_survey(config, tmp_path / "out", stub)
    ecsv = Table.read(tmp_path / "out" / "results.ecsv")
    assert len(ecsv) == len(table) == 3
    for mine, theirs in zip(table, ecsv, strict=True):
        for name in table.colnames:
            is_masked = np.ma.is_masked(mine[name])
            assert np.ma.is_masked(theirs[name]) if is_masked else theirs[name] == mine[name]
    assert table["snr"][0] == 30.0
    assert table["candidates"][0] == 1
    assert table["limit_1.0_arcsec"][0] == 1e-5
    assert np.ma.is_masked(table["limit_2.0_arcsec"][0])


def test_neither_header_nor_file_name_can_write_into_the_page(tmp_path, monkeypatch):
    monkeypatch.undo()  # With the picture.
    config = inputs(tmp_path / "data", 2)
    config["injections"] = PLANET
    for k, name in enumerate((HOSTILE, "$\\frac{_a$")):
        config["sequence"][k]["name"] = name

    def work(job, folder):
        if job.name == HOSTILE and job.injection:
            raise ValueError(HOSTILE)
        return {**stub(job, folder), **result(HOSTILE), "filter": HOSTILE, "fit_status": HOSTILE}

    output = tmp_path / HOSTILE.replace("/", "")
    run_survey(config, output, work)
    text = (output / "survey.html").read_text(encoding="utf-8")
    assert text.count("&lt;script&gt;") > 8
    assert not [each for tag, each in Tags(text).tags if tag == "script" or "onerror" in each]
    (picture,) = (each["src"] for tag, each in Tags(text).tags if tag == "img")
    assert picture.startswith("data:image/png;base64,iVBOR")
    links = [each["href"] for tag, each in Tags(text).tags if tag == "a"]
    assert links
    assert all((output / link).exists() for link in links)


STAR = {"TARGPROP": "HD 1", "TARG_RA": 10.0, "TARG_DEC": 5.0}
OTHER = {"TARGPROP": "HD 2", "TARG_RA": 90.0, "TARG_DEC": 5.0}
PLACE = (0.6, 0.35)

SEARCHED = {
    "star0_calints": partial(searched, "F444W", 1, [(*PLACE, 4.2)], north=20.0, header=STAR),
    "star1_calints": partial(searched, "F356W", 2, [(*PLACE, 4.0)], header=STAR),
    "star2_calints": partial(searched, "F300M", 3, [(-0.5, 0.4, 30.0)], known=True,
                             status="MODEL_MISMATCH", header=STAR),
    "star3_calints": partial(searched, "F444W", 4, header=OTHER),
}  # fmt: skip
"""Searches by the name of the job: a planet that is too faint for each of two filters, a fit that
does not explain its data, and another star."""


def searching(job, folder):
    """A job whose search is one of `SEARCHED`; nothing is fitted."""
    write_searched(SEARCHED[job.name](), folder)
    return result()


def test_filters_of_a_star_are_searched_together_at_the_end(tmp_path, command):
    assert command(searching, 4) == 0
    (folder,) = (tmp_path / "out" / "combined").iterdir()
    assert folder.name.startswith("HD-1_")
    assert sorted(each.name for each in folder.iterdir()) == [
        "combined.fits", "combined_candidates.ecsv", "combined_limits.ecsv", "comparison.html",
        "comparison.json",
    ]  # fmt: skip
    (row,) = QTable.read(folder / "combined_candidates.ecsv")
    # 4.1 sqrt(2) and the noise of these seeds; each filter alone needs 5.
    assert f"{row['snr']:.1f} {row['separation'].value:.3f}" == "5.4 0.698"
    assert np.hypot(row["delta_ra"].value - PLACE[0], row["delta_dec"].value - PLACE[1]) < 0.06
    text = (tmp_path / "out" / "survey.html").read_text(encoding="utf-8")
    section = text.partition("Filters and epochs together")[2].partition("</section>")[0]
    assert "MODEL_MISMATCH" in section
    assert "HD 2" not in section
    (link,) = (each["href"] for tag, each in Tags(section).tags if tag == "a")
    page = folder / "comparison.html"
    assert (tmp_path / "out" / link).samefile(page)
    links = [each.get("href", "") for _, each in Tags(page.read_text(encoding="utf-8")).tags]
    reports = [folder / each for each in links if "report.html" in each]
    assert len(reports) == 3
    assert all(each.exists() for each in reports)


def test_a_combined_search_is_kept_until_its_jobs_or_spectra_change(tmp_path, caplog):
    caplog.set_level("INFO")
    config = inputs(tmp_path / "data", 3)
    output, first = tmp_path / "out", {**config, "sequence": config["sequence"][:2]}

    def combined(config):
        (made,) = run_survey(config, output, searching).meta["combined"]
        return made

    before = combined(first)
    assert before["filters"] == ["F444W", "F356W"]
    page = output / before["folder"] / "comparison.html"
    page.write_text("kept")
    assert combined(first) == before
    assert page.read_text() == "kept"
    assert caplog.text.count("combined search of") == 1
    # A damaged one is made again.
    page.with_name("comparison.json").write_text("{")
    assert combined(first) == before
    assert page.read_text() != "kept"
    flat = combined({**first, "combined": {"spectra": ["flat"]}})
    assert [each["name"] for each in flat["spectra"]] == ["flat"]
    assert not flat["free"]
    assert len({each["folder"] for each in (before, flat, combined(config))}) == 3
    assert hidden(output) == []
    assert not [each for each in (output / "combined").iterdir() if each.name.startswith(".")]


def test_what_cannot_be_searched_together_is_said(tmp_path, command, monkeypatch):
    """Two jobs of one frame with other options are one observation; epochs need a motion."""
    later = partial(searched, "F444W", 5, mjd=60400.0, header=STAR)
    monkeypatch.setitem(SEARCHED, "wide", SEARCHED["star0_calints"])
    config = inputs(tmp_path / "data", 1)
    config["sequence"].append({**config["sequence"][0], "name": "wide", "wide": True})
    (twice,) = run_survey(config, tmp_path / "twice", searching).meta["combined"]
    assert "its frames are also in F444W 2023-02-25" in twice["reason"]
    monkeypatch.setitem(SEARCHED, "star1_calints", later)
    assert command(searching, 2) == 0
    words = "no combined search: combine: got reductions of several epochs"
    assert words in (tmp_path / "out" / "survey.html").read_text(encoding="utf-8")


def test_without_the_extra(tmp_path, monkeypatch):
    config = inputs(tmp_path / "data", 1)
    for name in [each for each in sys.modules if each.split(".")[0] == "dask"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    with pytest.raises(IncompatibleSetupError, match=r"pip install .dask\[.*workers = 0"):
        run_survey({**config, "workers": 1}, tmp_path / "out", stub)
    assert list(run_survey(config, tmp_path / "out", stub)["status"]) == ["finished"]
    assert (tmp_path / "out" / "results.ecsv").exists()


def test_the_command_says_what_came_of_it(tmp_path, command, capsys):
    work = failing("star1", ValueError("no such star"))
    planet = "\ninjections = { contrasts = [1e-5], separations = [0.5] }"
    assert command(work, 2, planet) == 1
    said = capsys.readouterr().out
    assert "1 of 3 jobs finished, 2 failed" in said
    assert "star1_calints failed: ValueError: no such star" in said
    assert f" and {tmp_path / 'out' / 'survey.html'}" in said


def test_an_interrupted_command_says_that_it_can_go_on(tmp_path, command, capsys):
    assert command(failing("star1", KeyboardInterrupt), 3) == 130
    assert "finished jobs are kept" in capsys.readouterr().err
    table = Table.read(tmp_path / "out" / "results.ecsv")
    assert list(table["status"]) == ["finished", "waiting", "waiting"]


SCENARIOS = ("workers_killed", "full_disk", "damaged_inputs")
BY_HAND = (
    "client_killed", "out_of_memory", "two_surveys", "scheduler_killed", "blind_worker",
    "read_only", "file_limit",
)  # fmt: skip
"""Where importing the libraries alone needs more than the limit, the workers of "out_of_memory"
are restarted without end. The others take long, and break the same code as those that remain."""


@pytest.mark.slow
@pytest.mark.hard
@pytest.mark.parametrize(
    "scenario", [*SCENARIOS, *(pytest.param(name, marks=pytest.mark.study) for name in BY_HAND)]
)
def test_nothing_is_half_done_and_nothing_finished_is_lost(scenario, tmp_path, monkeypatch):
    if scenario in (*SCENARIOS[:1], *BY_HAND[:5]):
        pytest.importorskip("distributed")
    # Of the surveys, which are processes.
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[1]))
    try:
        said = getattr(faults, scenario)(tmp_path, 1, 20)
    except faults.MountingRefused as error:
        # The scenario mounts a small disk, which needs rights that not all have.
        pytest.skip(f"{scenario}: {error}")
    assert said


@pytest.mark.parametrize("north", [0.0, 30.0, 265.0])
def test_injected_planets_are_at_their_position_angle_on_the_sky(north):
    injection = folders.Injection(1e-5, 0.8, 70.0)
    x, y = driver._planet(injection, north).offset
    # The +y axis has the position angle `north`, and +x is 90 degrees clockwise of it on the sky:
    # west where north is up.
    up = np.deg2rad(north)
    east, northward = y * np.sin(up) - x * np.cos(up), y * np.cos(up) + x * np.sin(up)
    assert np.rad2deg(np.arctan2(east, northward)) == pytest.approx(injection.angle)
    assert np.hypot(x, y) == pytest.approx(injection.separation)
