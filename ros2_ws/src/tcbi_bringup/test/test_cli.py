"""The command line: the table, errors in one line, exit statuses."""

import errno
import importlib
import os
import pkgutil
import types

import pytest

from tcbi_bringup import cli, commands
from tcbi_contract.errors import TcbiError


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
    assert "invalid int value" in capsys.readouterr().err


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
