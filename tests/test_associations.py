"""Frames by association files of the archive, and by patterns of names."""

import gzip
import json

import pytest
from survey_stubs import inputs

import pyklip_diffrender as dr
from benchmarks.calints_files import calints, starlight
from pyklip_diffrender.errors import CorruptFileError, NoValidPixelsError
from pyklip_diffrender.surveys.config import read_config
from pyklip_diffrender.surveys.jobs import jobs_of

ROLL1, ROLL2, OTHER = (f"jw0118400{k}001_03106_00001_nrcalong_calints.fits" for k in (1, 2, 3))
ACQUISITION = "jw01184001001_02101_00001_nrcalong_cal.fits"


@pytest.fixture
def folder(tmp_path):
    """Two rolls of HD 1 and one of HD 2, which no header marks as a reference star."""
    folder = tmp_path / "frames"
    calints(folder / ROLL1)
    calints(folder / ROLL2, observation=2, roll=80.0, date="2022-10-03T09:00:00")
    calints(folder / OTHER, "HD 2", observation=3, roll=20.0, date="2022-10-03T12:00:00",
            light=0.3 * starlight())  # fmt: skip
    return folder


def association(path, *members, kind="coron3"):
    """Write an association of one product as jwst's generator does; members are (name, type)."""
    listed = [
        {"expname": name, "exptype": type_, "exposerr": "null",
         "asn_candidate": "[('o001', 'observation'), ('c1001', 'coronagraphic')]"}
        for name, type_ in members
    ]  # fmt: skip
    content = {
        "asn_type": kind, "asn_rule": "Asn_Lv3Coron", "version_id": "20221004t101010",
        "code_version": "1.8.2", "program": "01184", "constraints": "DMSAttrConstraint({})",
        "asn_id": "c1001", "target": "t001", "asn_pool": "jw01184_20221004t101010_pool.csv",
        "products": [{"name": "jw01184-c1001_t001_nircam_f444w-maskrnd", "members": listed}],
    }  # fmt: skip
    path.write_text(json.dumps(content, indent=4), encoding="utf-8")
    return path


def coronagraphic(path):
    return association(
        path, (ROLL1, "science"), (ROLL2, "science"), (OTHER, "psf"),
        (ACQUISITION, "target_acquisition"),
    )  # fmt: skip


def uses(sequence):
    return {row["file"]: str(row["use"]) for row in sequence.table}


SORTED = {ROLL1: "target", ROLL2: "target", OTHER: "reference"}


def test_science_is_the_target_and_psf_are_references(folder):
    sequence = dr.ExposureSequence.from_files(coronagraphic(folder / "a_asn.json"))
    assert uses(sequence) == {**SORTED, ACQUISITION: "excluded"}
    assert dict(sequence.excluded)[ACQUISITION] == (
        "a_asn.json has it as target_acquisition, neither science nor psf"
    )
    assert (sequence.target, sequence.references[0].reference) == ("HD 1", True)


def test_an_association_counts_more_than_headers(folder):
    for name, star, observation in ((ROLL1, "HD 1", 1), (OTHER, "HD 2", 3)):
        (folder / name).unlink()
        calints(folder / name, star, observation=observation, cards={"IS_PSF": star == "HD 1"},
                date=f"2022-10-03T0{observation}:00:00")  # fmt: skip
    assert uses(dr.ExposureSequence.from_files([coronagraphic(folder / "a_asn.json")])) == {
        **SORTED, ACQUISITION: "excluded",
    }  # fmt: skip
    # Of an association with one type of members it is not known whether they are a target's.
    association(folder / "b_asn.json", (ROLL1, "science"), (OTHER, "science"), kind="image2")
    assert dr.ExposureSequence.from_files(folder / "b_asn.json").target == "HD 2"


def test_of_associations_that_disagree_headers_decide(folder):
    coronagraphic(folder / "a_asn.json")
    association(folder / "b_asn.json", (OTHER, "science"), (ROLL1, "psf"), (ROLL2, "psf"))
    both = [folder / "a_asn.json", folder / "b_asn.json"]
    assert dr.ExposureSequence.from_files(both, target="HD 2").target == "HD 2"
    again = dr.ExposureSequence.from_files([folder / "a_asn.json", folder / "a_asn.json"])
    assert uses(again) == {**SORTED, ACQUISITION: "excluded"}


def test_members_are_beside_the_association_and_may_be_packed(folder, tmp_path, monkeypatch):
    (folder / f"{OTHER}.gz").write_bytes(gzip.compress((folder / OTHER).read_bytes()))
    (folder / OTHER).unlink()
    (tmp_path / "lists").mkdir()
    path = association(
        tmp_path / "lists" / "a_asn.json",
        *((f"../frames/{name}", kind) for name, kind in ((ROLL1, "SCIENCE"), (OTHER, "psf"))),
    )
    monkeypatch.chdir("/")
    assert uses(dr.ExposureSequence.from_files(path)) == {
        ROLL1: "target",
        f"{OTHER}.gz": "reference",
    }


def test_missing_members_are_named(folder):
    path = coronagraphic(folder / "a_asn.json")
    for name in (ROLL2, OTHER):
        (folder / name).unlink()
    with pytest.raises(CorruptFileError, match=f"2 of its 3 members.*: {ROLL2}, {OTHER}. Put"):
        dr.ExposureSequence.from_files(path)


@pytest.mark.parametrize(
    "text", ["", "{", "[1, 2]", '{"products": 3}', '{"products": [{"members": [{}]}]}',
             '{"products": [{"members": [{"expname": 3, "exptype": "psf"}]}]}'],
)  # fmt: skip
def test_what_is_no_association_is_left_out(folder, text):
    (folder / "odd.json").write_text(text, encoding="utf-8")
    sequence = dr.ExposureSequence.from_files([folder, folder / "odd.json"], target="HD 1")
    assert uses(sequence) == {**SORTED, "odd.json": "excluded"}
    with pytest.raises(NoValidPixelsError, match="no association file"):
        dr.ExposureSequence.from_files(folder / "odd.json")


def test_associations_in_a_folder_are_not_read(folder, caplog):
    caplog.set_level("INFO")
    before = uses(dr.ExposureSequence.from_files(folder, target="HD 1"))
    association(folder / "a_asn.json", ("gone.fits", "science"), (ROLL1, "psf"))
    assert "association" not in caplog.text
    assert uses(dr.ExposureSequence.from_files(folder, target="HD 1")) == before == SORTED
    assert "its association files are not read" in caplog.text


def test_patterns_of_names(folder, tmp_path):
    def found(pattern, **choice):
        return set(uses(dr.ExposureSequence.from_files(pattern, **choice)))

    assert found(str(folder / "*00[12]001_*_calints.fits")) == {ROLL1, ROLL2}
    assert found([f"{tmp_path}/**/*_calints.fits"], target="HD 1") == set(SORTED)
    # Folders that a pattern matches may have no FITS files, as those of downloads.
    (tmp_path / "empty").mkdir()
    assert found(f"{tmp_path}/*", target="HD 1") == set(SORTED)
    assert found(folder / ROLL1, references=[f"{folder}/*003001*"]) == {ROLL1, OTHER}
    # A file of that very name is itself.
    (folder / ROLL1).rename(folder / "[12].fits")
    calints(folder / "1.fits")
    assert found(str(folder / "[12].fits")) == {"[12].fits"}
    with pytest.raises(NoValidPixelsError, match=r"no\*\.fits: no file has a name of this pattern"):
        dr.ExposureSequence.from_files(folder / "no*.fits")


def test_a_survey_takes_patterns_and_associations(tmp_path, folder):
    config = inputs(tmp_path, 1)
    coronagraphic(folder / "a_asn.json")
    path = tmp_path / "survey.toml"
    opd = config["sequence"][0]["opd"]

    def planned(files, target=""):
        text = f'[[sequence]]\nfiles = {json.dumps(files)}\nopd = "{opd}"\nsize = 40\n'
        path.write_text(text + (f'target = "{target}"\n' if target else ""), encoding="utf-8")
        (job,) = jobs_of(read_config(path))
        return job

    job = planned("frames/a_asn.json")
    assert job.files == (str(folder / "a_asn.json"),)
    assert {str(folder / name) for name in SORTED} < set(job.inputs)
    pattern = planned("frames/*_calints.fits", "HD 1")
    assert pattern.files == tuple(str(folder / name) for name in (ROLL1, ROLL2, OTHER))
    assert pattern.key == planned("frames", "HD 1").key
    # A member that changes is another job.
    (folder / OTHER).unlink()
    calints(folder / OTHER, "HD 2", observation=3, roll=25.0, date="2022-10-03T12:00:00")
    assert planned("frames/a_asn.json").key != job.key
