"""Output of the commands."""

import json
import subprocess
import sys
import time
from dataclasses import dataclass

import numpy as np
import pytest

from tcbi_bringup.commands import console


@dataclass(frozen=True)
class Signal:
    name: str
    error: float


def test_json_has_numbers_for_numpy_and_null_for_what_is_no_number(capsys):
    console.emit(
        {
            "a": np.float32(0.5),
            "b": np.array([1, 2]),
            "c": float("nan"),
            "d": np.array([np.inf, 1.0]),
            "e": np.bool_(True),
        }
    )
    assert json.loads(capsys.readouterr().out) == {"a": 0.5, "b": [1, 2], "c": None, "d": [None, 1.0], "e": True}


def test_json_takes_dataclasses_and_keeps_the_order_of_keys(capsys):
    console.emit({"z": [Signal("q", 0.1)], "a": (1, "x", None)})
    assert json.loads(capsys.readouterr().out) == {"z": [{"name": "q", "error": 0.1}], "a": [1, "x", None]}
    console.emit({"z": 1, "a": 2})
    assert list(json.loads(capsys.readouterr().out)) == ["z", "a"]


def test_a_file_s_name_that_is_no_text_is_escaped(capsys):
    console.emit({"bag": "walk\udcff"})
    assert json.loads(capsys.readouterr().out) == {"bag": "walk\udcff"}
    done = run_python("with console.json_only():\n    console.emit({'bag': 'walk\\udcff'})")
    assert json.loads(done.stdout) == {"bag": "walk\udcff"}


def run_python(code: str) -> subprocess.CompletedProcess:
    preamble = "import os, subprocess\nfrom tcbi_bringup.commands import console\n"
    return subprocess.run([sys.executable, "-c", preamble + code], capture_output=True, text=True, check=False)


def test_with_json_only_the_answer_reaches_standard_output_whoever_else_writes_there():
    done = run_python(
        "with console.json_only():\n"
        "    os.write(1, b'by a library\\n')\n"
        "    print('by a module')\n"
        "    subprocess.run(['echo', 'by a child'], check=True)\n"
        "    console.emit({'a': 1})\n"
        "print('afterwards')"
    )
    assert done.stdout == '{\n  "a": 1\n}\nafterwards\n'
    assert all(words in done.stderr for words in ("by a library", "by a module", "by a child"))


def test_standard_output_comes_back_when_a_command_with_json_fails():
    done = run_python(
        "try:\n    with console.json_only(): raise RuntimeError\nexcept RuntimeError: print('here again')"
    )
    assert done.stdout == "here again\n"


def test_a_table_shows_four_digits_and_a_dash_for_nothing(capsys):
    console.table("errors", ["signal", "error"], [["q", 0.123456], ["p", float("nan")]])
    out = capsys.readouterr().out
    assert "0.1235" in out and "–" in out and "errors" in out


def test_progress_and_notes_keep_away_from_standard_output(capsys, monkeypatch):
    monkeypatch.setattr("tcbi_bringup.progress.LINE_PERIOD_S", 0.0)
    with console.progress("recording", total=4, unit="rollouts") as advance:
        advance()
        advance(done=3, note="generation 2")
    console.note("done")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert (
        "recording: 3 of 4 rollouts, 0 s" in captured.err and "generation 2" in captured.err and "done" in captured.err
    )


def test_long_work_without_news_is_seen_to_go_on(capsys, monkeypatch):
    monkeypatch.setattr("tcbi_bringup.progress.QUIET_PERIOD_S", 0.05)
    with console.progress("training") as advance:
        advance(note="piece 1")
        time.sleep(0.5)
    assert capsys.readouterr().err.count("piece 1") >= 3


def test_progress_ends_when_the_work_fails(capsys):
    with pytest.raises(RuntimeError), console.progress("simulating") as advance:
        advance()
        raise RuntimeError("broken")


@pytest.mark.parametrize("variable", ["", "elsewhere"])
def test_the_default_store_is_that_of_the_model_store(variable, monkeypatch):
    from tcbi_sim.store import default_root

    monkeypatch.setenv("TCBI_STORE", variable)
    assert console.store_folder(None) == default_root().absolute()
