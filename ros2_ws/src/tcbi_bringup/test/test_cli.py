"""The command line: the table, errors in one line, exit statuses."""

import errno
import importlib
import json
import os
import pkgutil
import signal
import subprocess
import sys
import tempfile
import types

import pytest

from tcbi_bringup import cli, commands
from tcbi_bringup.arguments import namespace
from tcbi_contract.errors import TcbiError
from tcbi_infer.compare.comparison import MOST_PARTICLES
from tcbi_infer.tcbi.driver import LEAST_PARTICLES
from tcbi_sim.errors import UnknownNameError


@pytest.fixture
def command(monkeypatch):
    """A command `compare` whose `run` is the given function."""

    def install(run):
        module = types.SimpleNamespace(
            SUMMARY="a summary", add_arguments=lambda parser: parser.add_argument("--size", type=int), run=run
        )
        monkeypatch.setattr(cli, "available", lambda: cli.COMMANDS)
        monkeypatch.setattr(importlib, "import_module", lambda name: module)

    return install


def test_the_overview_lists_every_command_that_is_there_under_its_heading(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for command in cli.available():
        assert f"  {command.name} " in text and cli.GROUPS[command.group] in text


def test_names_are_unique_and_groups_known():
    assert len({c.name for c in cli.COMMANDS}) == len(cli.COMMANDS)
    assert {c.group for c in cli.COMMANDS} <= set(cli.GROUPS)


def test_every_command_module_is_in_the_table():
    modules = {m.name for m in pkgutil.iter_modules(commands.__path__)} - {"console"}
    assert modules <= {c.module.rpartition(".")[2] for c in cli.COMMANDS}


@pytest.mark.parametrize("command", cli.available(), ids=lambda c: c.name)
def test_every_command_explains_itself_with_examples(command, capsys):
    assert cli.main([command.name, "--help"]) == 0
    assert "./tcbi" in capsys.readouterr().out


def test_help_of_a_command_is_the_help_of_that_command(capsys):
    assert cli.main(["help", "compare"]) == 0
    assert "usage: ./tcbi compare" in capsys.readouterr().out


def test_a_wrong_command_is_wrong_usage_and_gets_a_hint(capsys):
    assert cli.main(["rnu"]) == 2
    assert "did you mean 'run'?" in capsys.readouterr().err


def test_no_command_at_all_shows_the_overview_as_wrong_usage(capsys):
    assert cli.main([]) == 2
    assert "usage:" in capsys.readouterr().out


def test_wrong_options_are_wrong_usage(command, capsys):
    command(lambda args: 0)
    assert cli.main(["compare", "--size", "big"]) == 2
    assert "--size: invalid int value" in capsys.readouterr().err


def test_an_error_of_the_user_is_one_line_and_status_1(command, capsys):
    def fail(args):
        raise TcbiError("bag x: empty; record it again")

    command(fail)
    assert cli.main(["compare"]) == 1
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "tcbi: bag x: empty; record it again\n")


def test_an_error_over_several_lines_is_still_one_line(command, capsys):
    def fail(args):
        raise TcbiError("first\n  second")

    command(fail)
    assert cli.main(["compare"]) == 1
    assert capsys.readouterr().err == "tcbi: first second\n"


def test_an_interrupt_is_status_130_without_a_traceback(command, capsys):
    def interrupt(args):
        raise KeyboardInterrupt

    command(interrupt)
    assert cli.main(["compare"]) == 130
    assert capsys.readouterr().err == "tcbi: interrupted\n"


def test_a_name_that_does_not_exist_is_wrong_usage(command, capsys):
    def run(_):
        raise UnknownNameError("effect", "backlsh", ("backlash",))

    command(run)
    assert cli.main(["compare"]) == 2
    assert capsys.readouterr().err == "tcbi: unknown effect 'backlsh'; did you mean 'backlash'?; known: backlash\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("replay --rate 0 bag", "--rate: got '0', allowed is a number, 0.01 to 1000.0"),
        ("replay --rate nan bag", "--rate: got 'nan'"),
        ("replay --wait-for 101 bag", "--wait-for: got '101', allowed is a whole number, 0 to 100"),
        ("retrain --task foo", "unknown task 'foo'; known: balance, forward"),
        ("retrain --task balance --budget -1", "--budget: got '-1', allowed is a number, more than 0"),
        ("train --task balance --steps 1.5", "--steps: got '1.5', allowed is a whole number, 1 or more"),
        ("collect --n 0", "--n: got '0', allowed is a whole number, 1 or more"),
        ("policy balance --measure --rollouts 0", "--rollouts: got '0'"),
        ("add backlash --diagnosis nosuch.json", "--diagnosis: got 'nosuch.json', allowed is a file"),
        ("bench nosuch", "unknown benchmark 'nosuch'"),
        ("doctor --sensor-port x", "--sensor-port: got it without --port"),
        ("doctor --calibration x", "--calibration: got it without --port"),
        ("doctor --baud-rate 9600", "--baud-rate: got it without --port"),
        ("doctor --sensor-baud-rate 9600", "--sensor-baud-rate: got it without --port"),
        ("policy --onnx x", "--onnx and --measure: got no policy"),
        ("policy --measure", "--onnx and --measure: got no policy"),
        ("collect --realtime", "--realtime: got --robot running, allowed is sim"),
        ("collect --robot emulated --realtime", "--realtime: got --robot emulated, allowed is sim"),
        ("collect --strength weak", "--hidden and --strength: got --robot running, allowed is emulated"),
        ("compare bag --timestep 0", "--timestep: got '0', allowed is a number, 1e-05 to 0.01"),
        (f"compare bag --particles {MOST_PARTICLES + 1}", f"allowed is a whole number, 0 to {MOST_PARTICLES}"),
        (f"infer bag --particles {LEAST_PARTICLES - 1}", f"allowed is a whole number, {LEAST_PARTICLES} or more"),
        ("infer bag --threads -1", "--threads: got '-1', allowed is a whole number, 0 or more"),
        ("infer bag --rollouts x", "--rollouts: got 'x', allowed is a whole number, 1 or more"),
        (f"diagnose bag --seed {'9' * 400}", "allowed is a whole number, 0 or more"),
        ("study --threads -1", "--threads: got '-1', allowed is a whole number, 0 or more"),
        ("study --robots a", "robots: got 'a', allowed is numbers from 0 on"),
        ("demo --seed x", "--seed: got 'x', allowed is a whole number, 0 or more"),
        ("import m log --window x", "--window: got 'x', allowed is a number, 0 or more"),
        ("dashboard --port 99999", "--port: got '99999', allowed is a whole number, 1 to 65535"),
        ("view --seconds 0.001", "--seconds: got '0.001', allowed is a number, 0.1 or more"),
        ("train --task balance --seed 4294967296", "allowed is a whole number, 0 to 4294967295"),
        ("train --task balance --preset fats", "unknown preset 'fats'; did you mean 'fast'?"),
        ("train --task balance --start nosuch", "policy 'nosuch' does not exist; there are balance"),
        ("policy gait:nosuch", "gait 'nosuch' does not exist; there are stand"),
        ("study --preset nosuch", "unknown preset 'nosuch'; known: hour, full"),
        ("study --methods nosuch", "unknown method of the study 'nosuch'; known: fixed_dr"),
        ("selftest --rig nosuch", "unknown rig 'nosuch'; known: hexapod"),
        ("import nosuch log", "unknown mapping file or built-in mapping 'nosuch'; known: double_pendulum"),
        ("run nosuch", "no package 'nosuch' with executables"),
        ("run tcbi_sim nosuch", "package 'tcbi_sim' has no executable 'nosuch'"),
    ],
)
def test_a_wrong_value_is_one_line_that_names_it_and_what_is_allowed(words, said, capsys):
    assert cli.main(words.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("tcbi: ") and said in captured.err


@pytest.mark.parametrize("words", ["up", "doctor", "collect", "replay bag", "dashboard"])
@pytest.mark.parametrize("name", ["my robot", "1left", "../x", "left//arm", "links-1"])
def test_a_namespace_that_no_graph_can_have_is_refused(words, name, capsys):
    assert cli.main([*words.split(), "--namespace", name]) == cli.USAGE
    error = capsys.readouterr().err
    assert f"--namespace: got {name!r}, allowed are letters, digits and _" in error and error.count("\n") == 1


def test_a_namespace_is_taken_with_and_without_slashes_at_its_ends():
    assert [namespace(text) for text in ("", "/", "left", "/lab_2/left/")] == ["", "", "left", "lab_2/left"]


@pytest.mark.parametrize("words", [("--help",), ("effects",), ("effects", "--json")])
def test_a_reader_that_has_gone_ends_a_command_quietly(words):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-P", "-m", "tcbi_bringup.cli", *words]
    buffered = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    done = subprocess.run(
        command, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=100, check=False, env=buffered
    )
    os.close(writer)
    assert (done.stderr, done.returncode) == ("", cli.READER_GONE)


def test_the_version_is_one_line_and_with_json_names_what_it_stands_on(capsys):
    assert cli.main(["--version"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("tcbi ") and text.count("\n") == 1
    assert cli.main(["--version", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {"tcbi", "commit", "python", "rclpy", "mujoco"} <= set(found)
    assert text.split()[1] == str(found["tcbi"]) and str(found["mujoco"])[0].isdigit()


def test_the_status_of_a_command_is_passed_on(command):
    command(lambda args: 1)
    assert cli.main(["compare"]) == 1


@pytest.mark.parametrize("number", cli.MACHINE_FAULTS)
def test_a_full_disk_or_a_forbidden_folder_is_one_line_with_a_remedy_in_any_command(command, number, capsys):
    def run(_):
        raise OSError(number, os.strerror(number), "store/models")

    command(run)
    assert cli.main(["compare"]) == cli.FAULT
    error = capsys.readouterr().err
    assert error.startswith(f"tcbi: store/models: {os.strerror(number)}; ") and error.count("\n") == 1


def test_other_errors_of_the_system_are_not_hidden(command):
    def run(_):
        raise OSError(errno.EBADF, "bad file descriptor")

    command(run)
    with pytest.raises(OSError, match="bad file descriptor"):
        cli.main(["compare"])


def test_no_usable_temporary_folder_is_one_line_with_a_remedy(command, tmp_path, capsys, monkeypatch):
    nowhere = str(tmp_path / "nowhere")
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: [nowhere])
    command(lambda _: tempfile.mkdtemp())
    assert cli.main(["compare"]) == cli.FAULT
    error = capsys.readouterr().err
    assert error.startswith(f"tcbi: No usable temporary directory found in ['{nowhere}']; ") and "TMPDIR" in error
    assert error.count("\n") == 1


def test_a_file_that_is_not_there_is_not_taken_for_the_temporary_folder(command):
    command(lambda _: os.stat("/nowhere/file"))
    with pytest.raises(FileNotFoundError):
        cli.main(["compare"])


@pytest.mark.parametrize("place", ["", "/file/page.html"])
def test_a_report_that_cannot_be_written_is_refused_before_anything_is_done(place, tmp_path, capsys):
    (tmp_path / "file").touch()
    assert cli.main(["compare", "bag", "--report", f"{tmp_path}{place}"]) == cli.USAGE
    error = capsys.readouterr().err
    assert "which cannot be written" in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("words", ["compare bag --store", "up --log-dir", "demo --folder", "study --out"])
@pytest.mark.parametrize("below", ["", "/sub"])
def test_a_file_in_the_place_of_a_folder_is_refused_before_anything_is_done(words, below, tmp_path, capsys):
    file = tmp_path / "file"
    file.touch()
    assert cli.main([*words.split(), f"{file}{below}"]) == cli.USAGE
    error = capsys.readouterr().err
    assert f"got '{file}{below}', allowed is a folder, and {file} is a file" in error and error.count("\n") == 1


def test_a_missing_package_is_one_line_that_says_what_brings_it(command, capsys):
    def run(_):
        import mujocoo  # noqa: F401

    command(run)
    assert cli.main(["compare"]) == cli.FAULT
    error = capsys.readouterr().err
    assert "'mujocoo' is missing" in error and "requirements-pypi.txt" in error and error.count("\n") == 1


PATIENT = """
import importlib, sys, time, types
from tcbi_bringup import cli
def run(_):
    try:
        print("started", flush=True)
        time.sleep(100)
    finally:
        print("ended in good order", flush=True)
module = types.SimpleNamespace(SUMMARY="", add_arguments=lambda parser: None, run=run)
importlib.import_module = lambda name: module
sys.argv = ["tcbi", "doctor"]
sys.exit(cli.main())
"""


def test_sigterm_ends_a_command_in_good_order_whoever_calls_main():
    with subprocess.Popen([sys.executable, "-c", PATIENT], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "started\n"
        process.terminate()
        assert process.stdout.read() == "ended in good order\n"
    assert process.returncode == 128 + signal.SIGTERM


def test_a_store_that_is_a_file_is_refused_before_anything_else(tmp_path, monkeypatch, capsys):
    file = tmp_path / "store"
    file.touch()
    monkeypatch.setenv("TCBI_STORE", str(file))
    assert cli.main(["history"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "TCBI_STORE" in line and "allowed is a folder" in line


def test_what_stands_behind_two_dashes_is_the_benchmarks_wherever_the_options_stand(capfd):
    assert cli.main(["bench", "hidden", "--json", "--", "--seeds", "3"]) == 1
    assert "argument --seeds: got '3'" in capfd.readouterr().err
