"""Files are replaced whole or not at all, also by several writers, and what a killed writer left can be removed."""

import threading
from pathlib import Path

import pytest

from tcbi_contract.files import remove_unfinished, replace_file, replacement


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    replace_file(path, "old")
    replace_file(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_writer_that_fails_leaves_the_old_content_and_no_trace(tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    replace_file(path, "old")
    with pytest.raises(ValueError, match="half way"), replacement(path) as work:
        assert work.suffix == ".npz"
        work.write_text("ne")
        raise ValueError("half way")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_two_writers_at_once_each_write_their_own_file(tmp_path: Path) -> None:
    path, texts = tmp_path / "history.json", ["a" * 100_000, "b" * 100_000]
    writers = [threading.Thread(target=lambda t=t: [replace_file(path, t) for _ in range(20)]) for t in texts]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        assert not path.exists() or path.read_text() in texts
    assert path.read_text() in texts
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_writer_left_is_removed_and_other_files_stay(tmp_path: Path) -> None:
    kept = [tmp_path / ".hidden.json", tmp_path / "state.json"]
    for path in kept:
        path.write_text("")
    writer = replacement(tmp_path / "state.json")
    writer.__enter__().write_text("ne")  # and killed here
    assert len(list(tmp_path.iterdir())) == 3
    remove_unfinished(tmp_path)
    assert sorted(tmp_path.iterdir()) == kept


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        replace_file(tmp_path / "none" / "state.json", "text")
