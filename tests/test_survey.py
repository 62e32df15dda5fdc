"""Surveys: what is asked for is checked, what is finished is kept, what fails is said."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import replace
from datetime import date
from functools import partial
from html.parser import HTMLParser
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table
from survey_stubs import HOSTILE, configuration, inputs, result, stub
from synthetic_searches import searched, write_searched

import pyklip_diffrender as dr
from benchmarks.calints_files import CENTER, SIDE, calints
from pyklip_diffrender.cli import main
from pyklip_diffrender.detection import Candidates, with_planets
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.errors import (
    CorruptFileError,
    IncompatibleSetupError,
    RefinementError,
)
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.refinement import FrameFit, GaussNewton
from pyklip_diffrender.surveys import (
    execution,
    survey_page,
)
from pyklip_diffrender.surveys import (
    execution as work,
)
from pyklip_diffrender.surveys import (
    jobs as folders,
)
from pyklip_diffrender.surveys.config import read_config
from pyklip_diffrender.surveys.driver import run_survey, survey
from pyklip_diffrender.surveys.execution import Work
from pyklip_diffrender.surveys.jobs import Injection, Job, jobs_of
from pyklip_diffrender.surveys.survey_page import COLUMNS, table_of

ROOT = Path(__file__).resolve().parents[1]

CURVE = ("sigmas", "separation_arcsec", "contrast")

PLANETS = {"contrasts": [1e-5, 3e-6], "separations": [0.5, 1.0], "angles": [0, 90.0]}


@pytest.fixture
def _drawn() -> None:
    """For tests that need the picture of the page, which takes a second."""


@pytest.fixture(autouse=True)
def _not_drawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "_drawn" not in request.fixturenames:
        monkeypatch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"no picture")


def planned(config: dict[str, Any]) -> list[Job]:
    return jobs_of(read_config(config))


def hidden(output: Path) -> list[str]:
    """What is left of jobs that never ended."""
    return [path.name for path in (output / "jobs").iterdir() if path.name.startswith(".")]


# -- configuration ---------------------------------------------------------------------------------


def test_a_file_says_the_same_as_a_mapping(tmp_path: Path) -> None:
    config = inputs(tmp_path)
    path = configuration(tmp_path / "survey.toml", config)
    assert read_config(path) == read_config(config)
    assert [job.key for job in planned(config)] == [job.key for job in jobs_of(read_config(path))]


def test_paths_are_relative_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs(tmp_path / "data", 1)
    path = tmp_path / "data" / "survey.toml"
    path.write_text('[[sequence]]\nfiles = "star0_calints.fits"\nopd = "opd.fits"\n')
    monkeypatch.chdir("/")
    (sequence,) = read_config(path).sequences
    assert sequence.opd == tmp_path / "data" / "opd.fits"
    assert sequence.name == "star0_calints"


def test_options_of_a_sequence_come_before_those_of_all(tmp_path: Path) -> None:
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


def test_whole_frames_disks_and_completeness_are_asked_for_by_sequence(tmp_path: Path) -> None:
    config = inputs(tmp_path, 1)
    plain = config["sequence"][0]
    config["sequence"] += [{**plain, "name": n, n: True} for n in ("wide", "disk", "completeness")]
    keys = {job.key for job in planned(config)}
    assert len(keys) == 4
    assert planned({**config, "sequence": [plain]})[0].key in keys
    star = planned({**config, "sequence": [{**plain, "star_flux": 0.4}]})[0]
    assert (star.options.star_flux, star.options.star_flux_error) == (0.4, 0.05)
    assert star.key not in keys
    config["options"] = {"disk": True}
    assert [job.options.disk for job in planned({**config, "sequence": [plain]})] == [True]


@pytest.mark.parametrize(
    ("where", "key", "value", "words"),
    [
        ((), "wokers", 2, ["the key 'wokers'", "workers", "Check its name"]),
        ((), "workers", -1, ["workers", "-1", "0 or more"]),
        ((), "workers", True, ["workers", "True"]),
        ((), "memory_limit", "much", ["memory_limit", "'much'", "4 GB"]),
        ((), "sequence", [], ["sequence", "[[sequence]]"]),
        ((), "options", 3, ["options", "a table"]),
        ((), "options", {"threshold": "5"}, ["options: threshold", "'5'", "positive"]),
        ((), "options", {"settings": {"basis": 1}}, ["options: settings", "'basis'", "cycles"]),
        ((), "options", {"settings": {"cycles": "x"}}, ["options: settings", "cycles", "'x'"]),
        ((), "options", {"settings": {"free": [date(2022, 8, 1)]}}, ["settings", "a date"]),
        ((), "options", {"settings": {"robust": float("nan")}}, ["options: settings", "nan"]),
        ((), "options", {"settings": {"tolerance": []}}, ["options: settings", "wrong type"]),
        ((), "options", {"disk": 1}, ["options: disk", "true or false"]),
        ((1,), "wide", "yes", ["sequence 2: wide", "true or false"]),
        ((1,), "star_flux", -0.4, ["sequence 2: star_flux", "-0.4", "Jy"]),
        ((), "options", {"star_flux_error": 0}, ["options: star_flux_error", "0.05"]),
        ((), "options", {"disk": True, "wide": True}, ["options", "one of them"]),
        ((), "combined", {"spectra": ["no.ecsv"]}, ["combined: spectra", "no.ecsv", "'flat'"]),
        ((), "combined", {"spectra": []}, ["combined: spectra", "[]"]),
        ((), "combined", {"parallax": 0.1}, ["combined: got the key 'parallax'", "spectra"]),
        ((), "injections", {"contrasts": [1e-5]}, ["injections", "both"]),
        ((), "injections", {"angles": 3}, ["injections: angles", "a list"]),
        ((0,), "files", "nowhere.fits", ["sequence 1: files", "nowhere.fits", "exist"]),
        ((0,), "opd", 3, ["sequence 1: opd", "3", "map"]),
        ((1,), "name", "star0_calints", ["sequence 2: name", "no other sequence"]),
        ((1,), "name", "two\nlines", ["sequence 2: name", "printable"]),
        ((1,), "size", 4, ["sequence 2: size", "8 or more"]),
        ((1,), "threshold", float("nan"), ["sequence 2: threshold", "nan"]),
        ((1,), "threshold", 10**400, ["sequence 2: threshold", "positive"]),
        ((1,), "systematics", "no.fits", ["sequence 2: systematics", "'no.fits'", "references"]),
        ((1,), "injections", {**PLANETS, "separations": [2.0]}, ["sequence 2", "less than 1.3"]),
        ((1,), "code", "import os", ["sequence 2: got the key 'code'", "one of files"]),
    ],
)  # fmt: skip
def test_a_mistake_is_named_before_anything_is_done(
    tmp_path: Path, where: tuple[int, ...], key: str, value: Any, words: list[str]
) -> None:
    config = inputs(tmp_path / "data", 2)
    place = config["sequence"][where[0]] if where else config
    place[key] = value
    with pytest.raises(IncompatibleSetupError) as raised:
        run_survey(config, tmp_path / "out", stub)
    lines = str(raised.value).splitlines()
    assert len(lines) == 2
    for word in words:
        assert word in lines[1]
    assert not (tmp_path / "out").exists()


def test_all_mistakes_are_named_at_once(tmp_path: Path) -> None:
    config = {"workers": "two", "sequence": [{"files": []}, 3, {"opd": "x", "size": 1}]}
    with pytest.raises(IncompatibleSetupError) as raised:
        read_config(config)
    text = str(raised.value)
    for word in (
        "workers",
        "sequence 1: files",
        "sequence 1: opd",
        "sequence 2",
        "sequence 3: size",
    ):
        assert word in text


@pytest.mark.parametrize("content", [b"a = [", b"\xff", b"[" * 5000, b"a = 1\na = 2"])
def test_a_file_that_is_not_toml(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "survey.toml"
    with pytest.raises(CorruptFileError, match=r"survey\.toml: cannot be read"):
        read_config(path)
    path.write_bytes(content)
    with pytest.raises(CorruptFileError, match=r"survey\.toml: not a TOML file"):
        read_config(path)


def test_the_same_job_twice_is_a_mistake(tmp_path: Path) -> None:
    config = inputs(tmp_path, 1)
    config["sequence"].append({**config["sequence"][0], "name": "again"})
    with pytest.raises(IncompatibleSetupError, match="again: got the same inputs and options"):
        planned(config)


def calints_file(path: Path, star: str, day: str | None, *, reference: bool = False) -> None:
    primary = fits.PrimaryHDU()
    primary.header.update({"FILTER": "F444W", "TARGPROP": star, "IS_PSF": reference})
    if day is not None:
        primary.header["DATE-BEG"] = f"{day}T00:00:00"
    data = np.random.default_rng(1).normal(10, 2, (2, 8, 10)).astype(np.float32)
    planes = {"SCI": data, "ERR": np.ones_like(data), "DQ": np.zeros(data.shape, dtype=np.uint32)}
    hdus = [primary, *(fits.ImageHDU(array, name=name) for name, array in planes.items())]
    hdus[1].header.update(
        {"BUNIT": "MJy/sr", "PIXAR_A2": 0.00396, "CRPIX1": 6.0, "CRPIX2": 5.0,
         "ROLL_REF": 100.0, "V3I_YANG": -0.5, "VPARITY": -1}
    )  # fmt: skip
    fits.HDUList(hdus).writeto(path, overwrite=True)


def test_of_a_folder_of_maps_the_nearest_to_the_target_is_used(tmp_path: Path) -> None:
    config = inputs(tmp_path, 1)
    maps = tmp_path / "maps"
    maps.mkdir()
    for day in ("01", "11", "29"):
        hdu = fits.PrimaryHDU(1e-8 * np.random.default_rng(1).normal(size=(16, 16)))
        hdu.header["BUNIT"] = "m"
        hdu.header["DATE-OBS"] = f"2022-08-{day}T00:00:00"
        hdu.writeto(maps / f"map{day}.fits")
    (maps / "broken.fits").write_bytes(b"nothing")
    config["sequence"][0]["opd"] = str(maps)
    frames = tmp_path / "frames"
    frames.mkdir()
    config["sequence"][0]["files"] = str(frames)
    calints_file(frames / "target.fits", "HD-1", None)
    with pytest.raises(IncompatibleSetupError, match="no date"):
        planned(config)
    # The reference star was observed when another map was the nearest.
    calints_file(frames / "target.fits", "HD-1", "2022-08-15")
    calints_file(frames / "reference.fits", "HD-2", "2022-08-01", reference=True)
    (job,) = planned(config)
    assert job.opd == str(maps / "map11.fits")
    assert sorted(job.inputs) == sorted([*map(str, frames.iterdir()), job.opd])


def test_epochs_of_a_sequence_are_jobs_of_their_own(tmp_path: Path) -> None:
    config = inputs(tmp_path, 1)
    frames = tmp_path / "frames"
    for k, day in enumerate(("2022-10-03", "2022-10-04", "2023-12-01")):
        date = f"{day}T06:00:00"
        calints(frames / f"{k}.fits", observation=k, date=date, roll=70.0 + k)
    config["sequence"][0] |= {
        "files": str(frames), "name": "HD 1",
        "injections": {"contrasts": [1e-4], "separations": [0.5]},
    }  # fmt: skip
    jobs = planned(config)
    assert [each.name for each in jobs] == ["HD 1 2022-10-03"] * 2 + ["HD 1 2023-12-01"] * 2
    assert len({each.key for each in jobs}) == 4
    chosen = [
        [each.name for each in dr.Sequence.from_files(job.files, epoch=job.epoch).science]
        for job in jobs[::2]
    ]
    assert chosen == [["0.fits", "1.fits"], ["2.fits"]]
    assert jobs[3].epoch == jobs[2].epoch
    # One epoch is named as before.
    (frames / "2.fits").unlink()
    assert [each.name for each in planned(config)] == ["HD 1", "HD 1"]


def test_a_sequence_may_have_no_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "flat").mkdir()
    monkeypatch.chdir(tmp_path)
    config = inputs(tmp_path, 1)
    (mapped,) = planned(config)
    config["sequence"][0]["opd"] = "flat"
    (job,) = planned(config)
    assert job.opd == "flat"
    assert list(job.inputs) == [config["sequence"][0]["files"]]
    assert job.key != mapped.key


# -- names of jobs ---------------------------------------------------------------------------------


def test_folders_say_what_their_jobs_are_and_follow_a_new_name(tmp_path: Path) -> None:
    config, output = inputs(tmp_path / "a", 1), tmp_path / "out"
    config["sequence"][0] |= {"name": "β Pic, F444W"}
    config["injections"] = {"contrasts": [1e-5], "separations": [0.5]}
    jobs = planned(config)
    assert [job.folder for job in jobs] == [
        f"Pic-F444W_{jobs[0].key[:12]}",
        f"Pic-F444W-planet-of-1e-05-at-0.5-arcsec-0-deg_{jobs[1].key[:12]}",
    ]
    assert jobs[1].base_folder == jobs[0].folder
    ran = []

    def work(job: Job, folder: Path) -> dict[str, Any]:
        ran.append(job.folder)
        return stub(job, folder)

    run_survey(config, output, work)
    config["sequence"][0] |= {"name": "another"}
    table = run_survey(config, output, work)
    assert len(ran) == 2
    names = sorted(path.name for path in (output / "jobs").iterdir())
    assert names == sorted(table["folder"]) == sorted(job.folder for job in planned(config))
    page = (output / "survey.html").read_text()
    assert "<title>Survey of another</title>" in page
    assert f'"jobs/{names[0]}/report.html"' in page


def test_tables_have_units_and_descriptions(tmp_path: Path) -> None:
    run_survey(inputs(tmp_path / "a", 1), tmp_path / "out", stub)
    table = Table.read(tmp_path / "out/results.ecsv")
    for name in ("separation_arcsec", "injected_separation_arcsec"):
        assert table[name].unit == u.arcsec
    assert table["position_angle_deg"].unit == table["injected_angle_deg"].unit == u.deg
    assert (table["seconds"].unit, table["peak_memory_bytes"].unit) == (u.s, u.byte)
    # Limits are contrasts.
    assert all(table[name].unit is None for name in table.colnames if name.startswith("limit"))
    assert "0.5 arcsec" in table["limit_0.5_arcsec"].description


def test_the_name_of_a_job_follows_from_content_and_options_alone(tmp_path: Path) -> None:
    config = inputs(tmp_path / "a", 1)
    (job,) = planned(config)
    moved = inputs(tmp_path / "b", 1)
    moved["sequence"][0] |= {"name": "other"}
    assert [each.key for each in planned(moved)] == [job.key]
    for change in ({"size": 41}, {"threshold": 6}, {"target": "x"}, {"settings": {"cycles": 9}}):
        other = {**config, "sequence": [{**config["sequence"][0], **change}]}
        assert [each.key for each in planned(other)] != [job.key]
    Path(config["sequence"][0]["opd"]).write_bytes(b"another map")
    assert [each.key for each in planned(config)] != [job.key]


def test_a_new_version_is_a_new_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = inputs(tmp_path, 1)
    (old,) = planned(config)
    monkeypatch.setattr("pyklip_diffrender.surveys.jobs.__version__", "99.0")
    (new,) = planned(config)
    assert new.key != old.key


# -- running ---------------------------------------------------------------------------------------


def test_finished_jobs_are_not_run_again(tmp_path: Path) -> None:
    config, output, ran = inputs(tmp_path / "data"), tmp_path / "out", []

    def work(job: Job, folder: Path) -> dict[str, Any]:
        ran.append(job.name)
        return stub(job, folder)

    table = run_survey(config, output, work)
    assert list(table["status"]) == ["finished"] * 3
    assert len(ran) == 3
    run_survey(config, output, work)
    assert len(ran) == 3
    # One input has changed, one product is damaged: these two are missing.
    Path(config["sequence"][1]["files"]).write_bytes(b"new frames")
    (output / "jobs" / table["folder"][2] / "report.html").write_text("cut")
    run_survey(config, output, work)
    assert ran[3:] == ["star1_calints", "star2_calints"]
    # The job of the old content stays.
    assert len(list((output / "jobs").iterdir())) == 4
    assert hidden(output) == []


def test_a_failure_is_a_row_and_is_tried_again(tmp_path: Path) -> None:
    config, output = inputs(tmp_path / "data"), tmp_path / "out"
    config["injections"] = {"contrasts": [1e-5], "separations": [0.5]}

    def work(job: Job, folder: Path) -> dict[str, Any]:
        (folder / "half").write_text("a product")
        if job.name.startswith("star1"):
            raise ZeroDivisionError("at the second star")
        return stub(job, folder)

    table = run_survey(config, output, work)
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


def test_an_injection_starts_from_the_finished_reduction(tmp_path: Path) -> None:
    config = inputs(tmp_path / "data", 1)
    config["injections"] = {"contrasts": [1e-5], "separations": [0.5]}

    def work(job: Job, folder: Path) -> dict[str, Any]:
        if job.injection:
            assert (folder.parent / str(job.base_folder) / "report.html").exists()
        return stub(job, folder)

    table = run_survey(config, tmp_path / "out", work)
    assert list(table["status"]) == ["finished"] * 2
    assert table["injected_contrast"].tolist() == [None, 1e-5]
    assert table["recovered_contrast"].tolist() == [None, 1.1e-5]
    assert table["recovered"].tolist() == [None, True]


def test_what_another_survey_published_meanwhile_stays(tmp_path: Path) -> None:
    (job,) = planned(inputs(tmp_path / "data", 1))
    jobs = folders.prepare(tmp_path / "out")
    # In a folder of the same name, because its inputs are the same.
    rival = replace(job, opd="rival")

    def work(inner: Job, folder: Path) -> dict[str, Any]:
        if inner.opd != "rival":
            assert execution.run_job(rival, jobs, work)["status"] == "finished"
        return stub(inner, folder)

    assert execution.run_job(job, jobs, work)["status"] == "finished"
    record = folders.read_record(jobs / job.folder)
    assert record is not None
    assert record["job"]["opd"] == "rival"
    assert hidden(tmp_path / "out") == []


def test_only_what_dead_processes_left_is_removed(tmp_path: Path) -> None:
    jobs = folders.prepare(tmp_path)
    with subprocess.Popen([sys.executable, "-c", ""]) as dead:
        pass
    mine = folders.staging(jobs, "a" * 64)
    left = jobs / mine.name.replace(f"-{os.getpid()}-", f"-{dead.pid}-")
    elsewhere = left.with_name(f"{left.name}x")
    for each in (left, elsewhere):
        each.mkdir()
        (each / "half").write_text("half")
    # Another machine may run this job, whatever its clock or ours says.
    os.utime(elsewhere, (0, 0))
    folders.clean(jobs)
    assert sorted(jobs.iterdir()) == sorted([mine, elsewhere])


def test_containers_with_one_host_name_leave_each_other_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first process of another container has a number that means nothing here."""
    jobs = folders.prepare(tmp_path)
    here = os.stat
    folders._place.cache_clear()
    monkeypatch.setattr(
        os, "stat",
        lambda path, **options: SimpleNamespace(st_ino=1)
        if path == "/proc/self/ns/pid" else here(path, **options),
    )  # fmt: skip
    theirs = folders.staging(jobs, "a" * 64)
    monkeypatch.undo()
    folders._place.cache_clear()
    with subprocess.Popen([sys.executable, "-c", ""]) as dead:
        pass
    foreign = theirs.rename(str(theirs).replace(f"-{os.getpid()}-", f"-{dead.pid}-"))
    folders.clean(jobs)
    assert list(jobs.iterdir()) == [foreign]


def test_a_message_in_another_encoding_stops_nothing(tmp_path: Path) -> None:
    config, output = inputs(tmp_path / "data", 2), tmp_path / "out"

    def work(job: Job, folder: Path) -> dict[str, Any]:
        if job.name.startswith("star1"):
            # As Python quotes a Latin-1 name of a file.
            raise ValueError("no such file: " + os.fsdecode(b"caf\xe9.fits"))
        return stub(job, folder)

    for _ in range(2):
        table = run_survey(config, output, work)
        assert sorted(table["status"]) == ["failed", "finished"]
    (message,) = table["message"][table["status"] == "failed"]
    assert message == r"ValueError: no such file: caf\udce9.fits"
    assert message in Table.read(output / "results.ecsv")["message"]
    assert list(run_survey(config, output, stub)["status"]) == ["finished"] * 2


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"products": {}}', '{"products": 3}'])
def test_a_damaged_record_is_a_missing_job(tmp_path: Path, damage: str) -> None:
    config, output = inputs(tmp_path / "data", 1), tmp_path / "out"
    (name,) = run_survey(config, output, stub)["folder"]
    record = output / "jobs" / name / "job.json"
    whole = json.loads(record.read_text())
    record.write_text(damage)
    assert list(run_survey(config, output, stub)["status"]) == ["finished"]
    assert json.loads(record.read_text())["products"] == whole["products"]


def test_frames_that_change_on_the_way_are_noticed(tmp_path: Path) -> None:
    config = inputs(tmp_path / "data", 2)

    def work(job: Job, folder: Path) -> dict[str, Any]:
        Path(config["sequence"][1]["files"]).write_bytes(b"other")
        return stub(job, folder)

    table = run_survey(config, tmp_path / "out", work)
    assert list(table["status"]) == ["finished", "failed"]
    assert "star1_calints.fits: the content on" in table["message"][1]


@pytest.mark.parametrize("what", ["file", "version", "output"])
def test_a_worker_that_sees_something_else_says_so(tmp_path: Path, what: str) -> None:
    (job,) = planned(inputs(tmp_path / "data", 1))
    jobs = folders.prepare(tmp_path / "out")
    words = {"file": "does not see this file", "version": "99.0", "output": "see this folder"}
    if what == "file":
        shutil.rmtree(tmp_path / "data")
    elif what == "version":
        job = replace(job, version="99.0")
    else:
        shutil.rmtree(jobs)
    record = execution.run_job(job, jobs, stub)
    assert record["status"] == "failed"
    assert words[what] in record["message"]
    # A worker must not make the folder on a disk of its own.
    assert jobs.exists() == (what != "output")


# -- results ---------------------------------------------------------------------------------------


def test_the_tables_say_the_same(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    config = inputs(tmp_path / "data", 2)
    config["sequence"][0]["injections"] = {"contrasts": [1e-5], "separations": [0.5]}
    table = run_survey(config, tmp_path / "out", stub)
    ecsv = Table.read(tmp_path / "out" / "results.ecsv")
    rows = parquet.read_table(tmp_path / "out" / "results.parquet").to_pylist()
    assert len(rows) == len(ecsv) == len(table) == 3
    for mine, row, theirs in zip(table, rows, ecsv, strict=True):
        for name in table.colnames:
            value = None if np.ma.is_masked(mine[name]) else mine[name]
            assert row[name] == value
            assert np.ma.is_masked(theirs[name]) if value is None else theirs[name] == value
    assert rows[0]["snr"] == 30.0
    assert rows[0]["candidates"] == 1
    assert rows[0]["limit_1.0_arcsec"] == 1e-5
    assert rows[0]["limit_2.0_arcsec"] is None
    assert rows[0]["peak_memory_bytes"] > 1e6


def test_the_tables_are_there_while_the_survey_runs(tmp_path: Path) -> None:
    config, output, seen = inputs(tmp_path / "data"), tmp_path / "out", []

    def work(job: Job, folder: Path) -> dict[str, Any]:
        path = output / "results.ecsv"
        seen.append(list(Table.read(path)["status"]) if path.exists() else [])
        return stub(job, folder)

    run_survey(config, output, work)
    assert seen[0] == []
    assert seen[1] == ["finished", "waiting", "waiting"]


class Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


@pytest.mark.usefixtures("_drawn")
def test_neither_header_nor_file_name_can_write_into_the_page(tmp_path: Path) -> None:
    config = inputs(tmp_path / "data", 2)
    config["injections"] = {"contrasts": [1e-5], "separations": [0.5]}
    for k, name in enumerate((HOSTILE, "$\\frac{_a$")):
        config["sequence"][k]["name"] = name

    def work(job: Job, folder: Path) -> dict[str, Any]:
        if job.name == HOSTILE and job.injection:
            raise ValueError(HOSTILE)
        return {**stub(job, folder), **result(HOSTILE), "filter": HOSTILE, "fit_status": HOSTILE}

    output = tmp_path / HOSTILE.replace("/", "")
    run_survey(config, output, work)
    text = (output / "survey.html").read_text(encoding="utf-8")
    tags = Tags(text).tags
    assert text.count("&lt;script&gt;") > 8
    assert not [tag for tag, attributes in tags if tag == "script" or "onerror" in attributes]
    (picture,) = (attributes for tag, attributes in tags if tag == "img")
    assert (picture["src"] or "").startswith("data:image/png;base64,iVBOR")
    links = [attributes["href"] or "" for tag, attributes in tags if tag == "a"]
    assert links
    for link in links:
        assert (output / link).exists()


@pytest.mark.usefixtures("_drawn")
def test_a_survey_of_many_stars_has_one_picture(tmp_path: Path) -> None:
    (job,) = planned(inputs(tmp_path / "data", 1))
    record = {"status": "finished", "result": result(), "seconds": 1.0}
    rows = [(replace(job, name=f"star {k}"), record) for k in range(12)]
    text = survey_page.page([*rows, (job, None)])
    assert "12 of 13 jobs finished, 1 not finished yet" in text
    assert "12 sequences reduced, 12 companion candidates in 12 of them." in text


# -- filters and epochs of a star together ---------------------------------------------------------

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


def searching(job: Job, folder: Path) -> dict[str, Any]:
    """A job whose search is one of `SEARCHED`; nothing is fitted."""
    write_searched(SEARCHED[job.name](), folder)
    return result()


def test_filters_of_a_star_are_searched_together_at_the_end(
    tmp_path: Path, do: Callable[[Work], None], capsys: pytest.CaptureFixture[str]
) -> None:
    do(searching)
    config = inputs(tmp_path / "data", 4)
    output = tmp_path / "out"
    path = configuration(tmp_path / "survey.toml", config)
    assert main(["survey", str(path), "-o", str(output), "-q"]) == 0
    said = capsys.readouterr().out
    assert said.count("all filters and epochs") == 1
    # 4.1 sqrt(2) and the noise of these seeds; each filter alone needs 5.
    assert "HD 1, all filters and epochs: S/N 5.4 at 0.698 arcsec" in said
    (folder,) = (output / "combined").iterdir()
    assert folder.name.startswith("HD-1_")
    assert {each.name for each in folder.iterdir()} == {
        "combined.fits", "combined_candidates.ecsv", "combined_limits.ecsv", "comparison.html",
        "comparison.json",
    }  # fmt: skip
    (row,) = QTable.read(folder / "combined_candidates.ecsv")
    away = np.hypot(row["delta_ra"].value - PLACE[0], row["delta_dec"].value - PLACE[1])
    assert away < 0.06
    text = (output / "survey.html").read_text(encoding="utf-8")
    section = text.partition("Filters and epochs together")[2].partition("</section>")[0]
    assert "MODEL_MISMATCH" in section
    assert "HD 2" not in section
    (link,) = (a["href"] for tag, a in Tags(section).tags if tag == "a")
    assert (output / str(link)).samefile(folder / "comparison.html")
    inside = Tags((folder / "comparison.html").read_text(encoding="utf-8")).tags
    reports = [a["href"] for tag, a in inside if tag == "a" and "report.html" in str(a["href"])]
    assert len(reports) == 3
    assert all((folder / str(each)).exists() for each in reports)


def test_a_combined_search_is_kept_until_its_jobs_or_spectra_change(
    tmp_path: Path, do: Callable[[Work], None], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    do(searching)
    config = inputs(tmp_path / "data", 3)
    output, first = tmp_path / "out", {**config, "sequence": config["sequence"][:2]}
    (before,) = survey(first, output).meta["combined"]
    assert before["filters"] == ["F444W", "F356W"]
    page = output / before["folder"] / "comparison.html"
    page.write_text("kept")
    assert survey(first, output).meta["combined"] == [before]
    assert page.read_text() == "kept"
    assert caplog.text.count("combined search of") == 1
    (flat,) = survey({**first, "combined": {"spectra": ["flat"]}}, output).meta["combined"]
    assert [each["name"] for each in flat["spectra"]] == ["flat"]
    assert not flat["free"]
    (more,) = survey(config, output).meta["combined"]
    assert len({each["folder"] for each in (before, flat, more)}) == 3
    assert hidden(output) == []
    assert not [each for each in (output / "combined").iterdir() if each.name.startswith(".")]


def test_jobs_of_the_same_frames_count_once_and_what_cannot_be_searched_is_said(
    tmp_path: Path, do: Callable[[Work], None], capsys: pytest.CaptureFixture[str]
) -> None:
    """Two jobs of one frame with other options are one observation; epochs need a motion."""
    wide = partial(searched, "F444W", 1, [(*PLACE, 4.2)], north=20.0, header=STAR)
    later = partial(searched, "F444W", 5, mjd=60400.0, header=STAR)

    def work(job: Job, folder: Path) -> dict[str, Any]:
        given = {**SEARCHED, "wide": wide, "later": later}
        write_searched(given[job.name](), folder)
        return result()

    do(work)
    config = inputs(tmp_path / "data", 1)
    config["sequence"].append({**config["sequence"][0], "name": "wide", "wide": True})
    (twice,) = survey(config, tmp_path / "twice").meta["combined"]
    assert "its frames are those of F444W 2023-02-25" in twice["reason"]
    path = configuration(tmp_path / "survey.toml", inputs(tmp_path / "data", 2))
    text = path.read_text().replace("star1_calints.fits'", "star1_calints.fits'\nname = 'later'")
    path.write_text(text)
    assert main(["survey", str(path), "-o", str(tmp_path / "epochs"), "-q"]) == 0
    assert "HD 1: no combined search: combine: got reductions of several epochs" in (
        capsys.readouterr().out
    )
    page = (tmp_path / "epochs" / "survey.html").read_text(encoding="utf-8")
    assert "no combined search: combine: got reductions of several epochs" in page


# -- where it runs ---------------------------------------------------------------------------------


def test_the_table_shows_its_contrasts_on_80_columns() -> None:
    values = {"name": "HIP-65426_F444W", "status": "finished", "contrast": 3.6276222428e-4,
              "snr": 70.0387387, "message": "none", "key": "0123456789abcdef"}  # fmt: skip
    shown = table_of([dict.fromkeys(COLUMNS) | values]).pformat(max_width=80)
    assert max(map(len, shown)) <= 80
    assert {"3.63e-04", "70.0"} <= set(shown[-1].split())


@pytest.mark.parametrize("missing", ["dask", "pyarrow"])
def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    config = inputs(tmp_path / "data", 1)
    for name in [each for each in sys.modules if each.split(".")[0] == missing]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, f"{missing}.distributed", None)
    monkeypatch.setattr(
        "pyklip_diffrender.surveys.survey_page.find_spec",
        lambda name: None if name == missing else 1,
    )
    if missing == "dask":
        with pytest.raises(IncompatibleSetupError, match=r"pip install .dask\[.*workers = 0"):
            run_survey({**config, "workers": 1}, tmp_path / "out", stub)
    assert list(run_survey(config, tmp_path / "out", stub)["status"]) == ["finished"]
    assert (tmp_path / "out" / "results.ecsv").exists()
    assert (tmp_path / "out" / "results.parquet").exists() == (missing != "pyarrow")


def test_an_output_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(IncompatibleSetupError, match=r"output: got .*out, expected a folder"):
        run_survey(inputs(tmp_path / "data", 1), tmp_path / "out", stub)
    assert (tmp_path / "out").read_text() == "mine"


def test_a_table_that_cannot_be_written_stops_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config, output = inputs(tmp_path / "data"), tmp_path / "out"
    (output / "results.ecsv").mkdir(parents=True)
    with pytest.raises(IncompatibleSetupError, match="Is a directory"):
        run_survey(config, output, stub)
    assert "Is a directory" in caplog.text
    (output / "results.ecsv").rmdir()
    assert list(run_survey(config, output, pytest.fail)["status"]) == ["finished"] * 3


def test_a_job_that_another_disk_has_is_a_failure(tmp_path: Path) -> None:
    (job,) = planned(inputs(tmp_path / "data", 1))
    jobs = folders.prepare(tmp_path / "out")

    class Future:
        def result(self) -> dict[str, Any]:
            return {"status": "finished", "host": "node7"}

    record = execution._record_of(Future(), job, jobs, patience=0)
    assert record["status"] == "failed"
    assert "node7 wrote its products to another disk" in record["message"]


def test_a_result_that_dies_with_its_worker_is_read_from_the_disk(tmp_path: Path) -> None:
    (job,) = planned(inputs(tmp_path / "data", 1))
    jobs = folders.prepare(tmp_path / "out")

    class Future:
        def result(self) -> dict[str, Any]:
            raise CancelledError

    with pytest.raises(RefinementError, match="scheduler was lost"):
        execution._record_of(Future(), job, jobs)
    record = execution.run_job(job, jobs, stub)
    assert execution._record_of(Future(), job, jobs) == record


@pytest.fixture
def do(monkeypatch: pytest.MonkeyPatch) -> Callable[[Work], None]:
    """Give the command other work than reductions."""
    return partial(monkeypatch.setattr, "pyklip_diffrender.surveys.execution.reduce_job")


@pytest.mark.parametrize("broken", [False, True])
def test_the_command_says_what_came_of_it(
    tmp_path: Path,
    do: Callable[[Work], None],
    capsys: pytest.CaptureFixture[str],
    broken: bool,
) -> None:
    def work(job: Job, folder: Path) -> dict[str, Any]:
        if broken and job.name.startswith("star1"):
            raise ValueError("no such star")
        return stub(job, folder)

    do(work)
    path = configuration(tmp_path / "survey.toml", inputs(tmp_path / "data", 2))
    with path.open("a") as file:
        file.write("\ninjections = { contrasts = [1e-5], separations = [0.5] }")
    output = tmp_path / "out"
    assert main(["survey", str(path), "-o", str(output), "--quiet"]) == int(broken)
    said = capsys.readouterr().out
    assert f"{3 - 2 * broken} of 3 jobs finished, {2 * broken} failed" in said
    # The injected planet, which the stub finds beside star 1, is no candidate.
    assert said.count("S/N") == 2 - broken
    assert "star0_calints: S/N 30.0 at 0.820 arcsec" in said
    assert ("star1_calints failed: ValueError: no such star" in said) == broken
    assert f"wrote {output / 'survey.html'}" in said


def test_an_interrupted_command_says_that_it_can_go_on(
    tmp_path: Path, do: Callable[[Work], None], capsys: pytest.CaptureFixture[str]
) -> None:
    def work(job: Job, folder: Path) -> dict[str, Any]:
        if job.name.startswith("star1"):
            raise KeyboardInterrupt
        return stub(job, folder)

    do(work)
    path = configuration(tmp_path / "survey.toml", inputs(tmp_path / "data"))
    output = tmp_path / "out"
    assert main(["survey", str(path), "-o", str(output), "-q"]) == 130
    assert "finished jobs are kept" in capsys.readouterr().err
    table = Table.read(output / "results.ecsv")
    assert list(table["status"]) == ["finished", "waiting", "waiting"]


def test_jobs_aim_at_less_than_the_memory_of_their_worker(
    tmp_path: Path, do: Callable[[Work], None]
) -> None:
    limits = []

    def work(job: Job, folder: Path, memory: float | None = None) -> dict[str, Any]:
        limits.append(memory)
        return stub(job, folder)

    do(work)
    config = inputs(tmp_path / "data", 1)
    survey({**config, "memory_limit": "4 GB"}, tmp_path / "limited")
    survey(config, tmp_path / "free")
    assert limits == [3.2e9, None]


def test_a_configuration_with_mistakes_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "survey.toml"
    path.write_text("workers = -1")
    assert main(["survey", str(path), "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert "survey.toml: nothing was started:\n  workers: got -1" in said
    assert not (tmp_path / "out").exists()


def test_public_name() -> None:
    assert dr.survey is survey


# -- the real work ---------------------------------------------------------------------------------

ROLLS = (20.0, 60.0)


def test_a_planet_is_injected_where_and_as_bright_as_it_is_asked_for() -> None:
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    scene, opd = dr.Scene(dr.Star(exposure=200.0)), dr.random_opd(1, npix=128)
    star = dr.simulate(model, scene, opd, seed=5)
    nothing = np.zeros((32, 32))
    values = {"flux": np.array([scene.star.photons]), "background": np.zeros(1)}
    frames = [
        FrameFit(
            model, replace(star, position_angles=np.array([roll])), {}, opd.data, nothing,
            nothing, values, {}, nothing, np.zeros(0),
        )
        for roll in ROLLS
    ]  # fmt: skip
    planet = Injection(1e-4, 0.6, 100.0)
    science = with_planets(frames, [work._planet(planet, ROLLS[0])])
    assert len(science) == 2
    for roll, frame in zip(ROLLS, science, strict=True):
        light = (frame.data - star.data)[0]
        # Position angles of planets in a scene are counted from +y of the frame.
        truth = dr.Planet(planet.contrast, planet.separation, planet.angle - roll)
        expected = dr.simulate(model, replace(scene, planets=(truth,)), opd, seed=5).data[0]
        x, y = np.round(np.array(truth.offset) / 0.0624 + 15.5).astype(int)
        core = (slice(y - 2, y + 3), slice(x - 2, x + 3))
        assert light[core].max() == light.max()
        # The photon noise of the star under the planet is 3 % of the planet.
        assert light[core].sum() == pytest.approx((expected - star.data[0])[core].sum(), rel=0.1)


def test_a_disk_and_the_whole_frames_are_part_of_the_job(tmp_path: Path) -> None:
    config = inputs(tmp_path, 1)
    # Other fields than those asked for are those of the preset in the filter of the frames.
    settings = GaussNewton.nircam("F356W", max_iterations=7)
    ones = np.ones((4, 4))
    frame = dr.Observation.from_arrays(ones, ones, pixelscale=0.063, filter="F356W")
    for name in ("wide", "disk"):
        options = {name: True, "star_flux": 0.4, "settings": {"max_iterations": 7}}
        (job,) = planned({**config, "options": options})
        expected = ReduceOptions(size=40, star_flux=0.4, settings=settings, **{name: True})
        assert work._options(job, frame) == expected
        assert work._options(job, frame, wide=False).wide is False


def test_the_result_of_a_job_is_that_of_the_largest_field() -> None:
    wide_field = {"candidates": [{"snr": 7.0}], "contrast_curve": {k: [] for k in CURVE}}
    summary = {
        **result(), "status": {"name": "CONVERGED"}, "fit": {"reduced_chi2": 1, "error_factor": 1},
        "contrast_curve": {k: [1.0] for k in CURVE}, "frames": [], "wide_field": wide_field,
    }  # fmt: skip
    record = work._result(summary)
    assert [each["false_alarm_probability"] for each in record["candidates"]] == [None]
    assert record["curve"] == wide_field["contrast_curve"]
    record = work._result({**summary, "wide_field": None})
    assert record["curve"] == summary["contrast_curve"]
    assert [each["snr"] for each in record["candidates"]] == [30.0]


def test_a_planet_is_injected_into_the_frames_with_their_disk() -> None:
    ones = np.ones((30, 30))
    cut = dr.Observation.from_arrays(3 * ones, ones, pixelscale=0.063).cutout(8)
    frame = FrameFit(
        cast(Any, None), replace(cut, data=cut.data - 2), {}, ones, ones, ones, {}, {}, ones,
        np.zeros(0),
    )  # fmt: skip
    (with_disk,) = work._with_disk([frame], [cut])
    assert (with_disk.observation.data == 3).all()


def test_what_is_recovered_is_the_candidate_at_the_place() -> None:
    planet = Injection(1e-4, 0.6, 100.0)
    x, y = dr.Planet(1e-4, 0.6, 100.0 - 20.0).offset

    def searched(*rows: tuple[float, float, float]) -> Any:
        """Candidates of x, y and contrast, with an error of 1e-5."""
        table = np.reshape(rows, (-1, 3))
        errors = torch.full((len(table),), 1e-5, dtype=torch.float64)
        sources = replace(
            Candidates.at(table[:, :2], table[:, 2]),
            covariance=torch.diag(errors.repeat(3) ** 2),
            detection_errors=errors,
        )

        def measure(offsets: list[Any]) -> QTable:
            np.testing.assert_allclose(offsets, [[x, y]])
            return QTable({"contrast": [4.5e-5], "contrast_error": [2e-5], "snr": [4.5]})

        star = SimpleNamespace(frames=[SimpleNamespace(flux=3.0)])
        detection = SimpleNamespace(
            north=20.0, sources=sources, error_factor=ErrorFactor.constant(1.0), measure=measure,
            fits=[star],
        )  # fmt: skip
        return SimpleNamespace(detection=detection)

    other = (0.5, 0.5, 7e-5)
    recovered = work._recovered(searched(other, (x + 0.03, y, 9e-5)), planet, 2.0)
    expected = {"contrast": 1.35e-4, "contrast_error": 1.5e-5, "snr": 9.0, "detected": True}
    assert recovered == pytest.approx(expected)
    for rows in ((other,), ()):
        recovered = work._recovered(searched(*rows), planet, 3.0)
        assert (recovered["snr"], recovered["detected"]) == (4.5, False)


@pytest.mark.slow
def test_files_with_and_without_a_planet(tmp_path: Path) -> None:
    """From calibrated files to the tables; test_slurm.py has a job with a real frame."""
    first = dr.Sequence.from_files([calints(tmp_path / "blank_calints.fits")]).science[0]
    model = dr.model_for(first, 41)
    before = dr.random_opd(1, npix=model.npix).data
    fits.writeto(tmp_path / "opd.fits", before, fits.Header({"BUNIT": "m"}))
    image = model(before + dr.random_opd(2, npix=model.npix, rms=2e-9).data).detach().numpy()
    # The brightest pixel has 90 sigma.
    (x, y), light = np.array(CENTER, dtype=int), np.zeros((SIDE, SIDE))
    light[y - 20 : y + 21, x - 20 : x + 21] = 100 * image / image.max()
    config = {
        "workers": 0,
        "options": {
            "size": 24, "systematics": "off",
            "settings": {
                "cycles": [4.0], "max_iterations": 20, "response_npix": 64,
                "response_wavelengths": 1, "accurate_steps": False,
            },
        },
        "injections": {"contrasts": [2e-4], "separations": [0.6], "angles": [330.0]},
        "sequence": [
            {
                "files": str(calints(tmp_path / "star_calints.fits", light=light)),
                "opd": str(tmp_path / "opd.fits"),
            }
        ],
    }  # fmt: skip
    table = survey(config, tmp_path / "products")
    assert list(table["status"]) == ["finished"] * 2
    assert list(table["fit_status"]) == ["CONVERGED"] * 2
    assert list(table["target"]) == ["HD 1"] * 2
    planet = table[1]
    assert planet["recovered"]
    assert planet["recovered_snr"] > 10
    away = abs(planet["recovered_contrast"] - planet["injected_contrast"])
    assert away < 3 * planet["recovered_error"]
    # The sequence has no name in the configuration.
    assert list(table["name"]) == ["HD 1 F444W"] * 2
    for name, has_fit in zip(table["folder"], (True, False), strict=True):
        assert name.startswith("HD-1-F444W")
        products = {path.name for path in (tmp_path / "products" / "jobs" / name).iterdir()}
        assert {"detection.fits", "candidates.ecsv", "report.html"} <= products
        assert ("fit.fits" in products) == has_fit
