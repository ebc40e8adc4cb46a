"""The middleware's profile is a file; without a place for it a node goes on."""

import os
import tempfile
from pathlib import Path

import pytest

from tcbi_sim import prompt_acks
from tcbi_sim.prompt_acks import PROFILE, VARIABLE, ask_for_prompt_acks


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    for name in (VARIABLE, "FASTDDS_DEFAULT_PROFILES_FILE"):
        monkeypatch.setenv(name, "")  # so that what is set meanwhile is undone
        monkeypatch.delenv(name)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_the_profile_is_written_once_and_made_anew_where_it_was_damaged(folder):
    ask_for_prompt_acks()
    path = Path(os.environ.pop(VARIABLE))
    assert path.read_text() == PROFILE
    path.write_bytes(b"\xff")
    ask_for_prompt_acks()
    assert [p.read_text() for p in folder.iterdir()] == [PROFILE]


def test_a_users_own_profile_stays(folder, monkeypatch):
    monkeypatch.setenv(VARIABLE, "mine.xml")
    ask_for_prompt_acks()
    assert os.environ[VARIABLE] == "mine.xml" and not list(folder.iterdir())


@pytest.mark.parametrize("fault", ["gone", "taken"])
def test_without_a_place_for_it_one_line_is_said_and_the_node_goes_on(folder, monkeypatch, caplog, fault):
    if fault == "gone":
        monkeypatch.setattr(tempfile, "tempdir", str(folder / "gone"))
    else:
        (folder / f"tcbi-{os.getuid()}-prompt-acks.xml").mkdir()
    ask_for_prompt_acks()
    (line,) = [r.getMessage() for r in caplog.records if r.name == prompt_acks.__name__]
    assert "cannot be written" in line and str(folder) in line and "TMPDIR" in line and "\n" not in line
    assert VARIABLE not in os.environ and not list(folder.glob("*.[0-9]*"))
