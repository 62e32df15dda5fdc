"""Files from MAST, by a stub of astroquery that answers and fails as the real one does."""

import inspect
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table
from requests import ConnectionError as NoConnection

from pyklip_diffrender import archive
from pyklip_diffrender.cli import main
from pyklip_diffrender.errors import ArchiveError, DiffrenderWarning, IncompatibleSetupError

SIZE = 2880
NAMES = ("jw01184005001_03106_00001_nrcalong", "jw01184006001_03106_00001_nrcalong")


class Observations:
    """The part of astroquery's `Observations` that is used, with its way of failing."""

    def __init__(self):
        self.rows = [
            ("1", "G-7-34", "F444W;MASKRND"),
            ("2", "G-7-34", "F356W;MASKRND"),
            ("3", "AU-MIC", "F444W;MASKRND"),
        ]
        self.rights = dict.fromkeys(NAMES, "PUBLIC")
        self.short, self.renamed, self.failures = "", "", {}
        self.asked, self.fetched, self.tokens = {}, [], []

    def query_criteria(self, **criteria):
        self._online("query")
        self.asked = criteria
        return Table(rows=self.rows, names=("obsid", "target_name", "filters"))

    def get_unique_product_list(self, observations):
        self.asked["obsid"] = list(observations["obsid"])
        files = [f"{name}_{kind}.fits" for name in NAMES for kind in ("calints", "rateints")]
        files += ["jw01184005001_03106_00001_nrcalong_calints.jpg", "jw01184_f356w_calints.fits"]
        files[0] = self.renamed or files[0]
        return Table({
            "productFilename": MaskedColumn(files),
            "dataURI": [f"mast:JWST/product/{each}" for each in files],
            "size": MaskedColumn([SIZE] * len(files)),
            "filters": ["F444W;MASKRND"] * (len(files) - 1) + ["F356W;MASKRND"],
            "dataRights": [self.rights.get(each[:34], "PUBLIC") for each in files],
        })  # fmt: skip

    def login(self, token=None):
        assert token, "astroquery would ask for it on the terminal"
        self.tokens.append(token)

    def download_file(self, uri, *, local_path, cache, verbose):
        name = uri.rpartition("/")[2]
        self.fetched.append(name)
        path = Path(local_path)
        # Astroquery takes a path without a suffix for a folder.
        assert path.suffix
        assert not cache
        self._online(name)
        if self.rights.get(name[:34]) != "PUBLIC" and not self.tokens:
            return "ERROR", "HTTPError: 401 Client Error: Unauthorized", uri
        path.write_bytes(b"S" * (SIZE // 2 if name[:34] == self.short else SIZE))
        return "COMPLETE", None, None

    def _online(self, what):
        if what in self.failures:
            raise self.failures[what]


OFFLINE = NoConnection("Failed to resolve 'mast.stsci.edu'")


@pytest.fixture
def mast(monkeypatch):
    stub = Observations()
    monkeypatch.setattr(archive, "_mast", lambda: stub)
    monkeypatch.delenv("MAST_API_TOKEN", raising=False)
    return stub


def left(folder):
    return sorted(path.name for path in folder.iterdir())


FILES = [f"{name}_calints.fits" for name in NAMES]


@pytest.mark.slow
def test_the_stub_has_the_interface_of_astroquery():
    real = pytest.importorskip("astroquery.mast").Observations
    for name in ("query_criteria", "get_unique_product_list", "download_file", "login"):
        needed = inspect.signature(getattr(Observations, name)).parameters
        had = inspect.signature(getattr(real, name)).parameters
        kinds = {each.kind for each in had.values()}
        keywords = set(needed) - {"self", "criteria"}
        assert keywords <= set(had) or inspect.Parameter.VAR_KEYWORD in kinds, name


def test_a_target_is_fetched_once(mast, tmp_path):
    paths = archive.fetch_calints(1184, "G 7-34", filter="f444w", folder=tmp_path)
    assert paths == [tmp_path / name for name in FILES]
    assert left(tmp_path) == FILES
    assert mast.asked["instrument_name"] == "NIRCAM/CORON"
    assert mast.asked["proposal_id"] == ["1184", "01184"]
    assert mast.asked["obsid"] == ["1"]
    assert archive.fetch_calints("01184", "G 7-34", filter="F444W", folder=tmp_path) == paths
    assert mast.fetched == FILES


def test_a_listing_fetches_nothing(mast, tmp_path):
    (tmp_path / FILES[0]).write_bytes(b"S" * SIZE)
    (tmp_path / FILES[1]).write_bytes(b"S" * (SIZE - 1))
    listing = archive.list_calints(1184, "G-7-34", filter="F444W", folder=tmp_path)
    assert list(listing["file"]) == FILES
    assert list(listing["complete"]) == [True, False]
    np.testing.assert_allclose(listing["size"].to_value("kbyte"), SIZE / 1e3)
    assert mast.fetched == []
    # A file of another size is fetched again.
    archive.fetch_calints(1184, "G-7-34", filter="F444W", folder=tmp_path)
    assert mast.fetched == FILES[1:]
    assert (tmp_path / FILES[1]).stat().st_size == SIZE


@pytest.mark.parametrize("name", ["../../x_calints.fits", r"..\x_calints.fits", ".x_calints.fits"])
def test_a_name_that_leaves_the_folder_is_refused(mast, tmp_path, name):
    mast.renamed = name
    with pytest.raises(ArchiveError, match="expected the name of a file without a folder"):
        archive.fetch_calints(1184, "G-7-34", folder=tmp_path / "a" / "b")
    assert left(tmp_path) == []
    assert mast.fetched == []


@pytest.mark.parametrize(
    ("state", "error", "words"),
    [
        ({"short": NAMES[1]}, ArchiveError, "1 of 2 files are complete"),
        ({"failures": {FILES[1]: OFFLINE}}, ArchiveError, "1 of 2 files are complete"),
        ({"failures": {FILES[1]: KeyboardInterrupt()}}, KeyboardInterrupt, None),
    ],
    ids=["short", "offline", "interrupted"],
)
def test_a_part_of_a_file_is_not_taken_for_a_file(mast, tmp_path, state, error, words):
    vars(mast).update(state)
    with pytest.raises(error, match=words):
        archive.fetch_calints(1184, filter="F444W", folder=tmp_path)
    assert left(tmp_path) == FILES[:1]
    # The next call fetches only what is missing.
    mast.short, mast.failures, mast.fetched = "", {}, []
    archive.fetch_calints(1184, filter="F444W", folder=tmp_path)
    assert mast.fetched == FILES[1:]
    assert left(tmp_path) == FILES


def test_proprietary_files_need_a_token(mast, tmp_path, monkeypatch):
    mast.rights[NAMES[1]] = "EXCLUSIVE_ACCESS"
    with pytest.warns(DiffrenderWarning, match=rf"proprietary.*{FILES[1]}"):
        paths = archive.fetch_calints(1184, filter="F444W", folder=tmp_path)
    assert paths == [tmp_path / FILES[0]]
    mast.rights = dict.fromkeys(NAMES, "EXCLUSIVE_ACCESS")
    with pytest.raises(ArchiveError, match=r"all files are proprietary.*MAST_API_TOKEN"):
        archive.fetch_calints(1184, filter="F444W", folder=tmp_path / "other")
    monkeypatch.setenv("MAST_API_TOKEN", "secret")
    assert len(archive.fetch_calints(1184, filter="F444W", folder=tmp_path)) == 2
    assert mast.tokens == ["secret"]


def test_without_astroquery_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "astroquery", None)
    with pytest.raises(ArchiveError, match=r"python -m pip install astroquery$"):
        archive.fetch_calints(1184)


@pytest.mark.parametrize(
    ("state", "options", "error", "message"),
    [
        ({}, {"program": "GTO"}, IncompatibleSetupError, "the number of a JWST programme"),
        ({}, {"target": "Vega"}, IncompatibleSetupError, "target: got 'Vega', expected one of 'AU"),
        ({}, {"filter": "F200W"}, IncompatibleSetupError, "filter: got 'F200W'"),
        ({"rows": []}, {}, ArchiveError, "no coronagraphic frames of NIRCam of programme 1184"),
        ({"failures": {"query": OFFLINE}}, {}, ArchiveError, "cannot be reached .*download the fi"),
    ],
    ids=["programme", "target", "filter", "no coronagraphy", "offline"],
)
def test_what_cannot_be_fetched_is_said(mast, tmp_path, state, options, error, message):
    vars(mast).update(state)
    with pytest.raises(error, match=message):
        archive.fetch_calints(**{"program": 1184, "folder": tmp_path / "new"} | options)
    assert left(tmp_path) == []


REDUCE = ["reduce", "--program", "1184", "--filter", "F444W", "--opd", "opd.fits"]


def test_a_run_fetches_and_reads_the_files(mast, tmp_path, capsys):
    run = [*REDUCE, "--cache", str(tmp_path / "cache"), "-o", str(tmp_path / "out")]
    assert main([*run, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in FILES)
    assert "to fetch: 2 of 2 files, 0 MB" in shown
    assert left(tmp_path) == mast.fetched == []
    assert main(run) == 1
    assert left(tmp_path / "cache") == FILES
    # The stub's files hold nothing.
    assert "none of 2 files can be used" in capsys.readouterr().err


def test_frames_or_a_programme_but_not_both(capsys):
    assert main([*REDUCE, "frames", "-o", "out"]) == 2
    assert "either FRAMES or --program" in capsys.readouterr().err
