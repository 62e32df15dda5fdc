"""Folders with random mutations: admitted rightly, excluded with a reason, or refused."""

from __future__ import annotations

import pytest

from benchmarks.fuzz_intake import make_frames, run


@pytest.mark.slow
@pytest.mark.parametrize(("real", "folders"), [(False, 15), (True, 5)], ids=["simulated", "real"])
def test_no_folder_is_silently_wrong(tmp_path, real, folders, request):
    source = request.getfixturevalue("shared_data") / "gto1184" if real else None
    frames = make_frames(tmp_path / "untouched", source)
    records = run(frames, range(1000, 1000 + folders))
    assert [
        each for each in records if each["outcome"] in ("wrong", "wrongly refused", "crash")
    ] == []
    assert all(each["message"] for each in records if each["outcome"] in ("excluded", "refused"))


def test_the_untouched_folder_is_used_entirely(tmp_path):
    """The check itself sees a frame that is used wrongly."""
    frames = make_frames(tmp_path / "untouched")
    (record,) = run(frames, [0])
    assert record["outcome"] != "wrong"
    assert record["mutations"]
