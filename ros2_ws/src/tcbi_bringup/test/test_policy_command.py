"""`./tcbi policy`: what its numbers are in."""

import pytest

from tcbi_bringup import cli


@pytest.mark.parametrize("words", [("policy",), ("policy", "balance")])
def test_a_return_has_its_unit_and_says_what_it_counts(words, tmp_path, capsys):
    assert cli.main([*words, "--store", str(tmp_path)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "points" in text.partition("return: points")[0]
    assert "docs/policies.md" in text


def test_the_model_of_a_measurement_is_named_where_none_was_asked_for(tmp_path, capsys):
    words = ["policy", "gait:stand", "--measure", "--task", "balance", "--rollouts", "2", "--store", str(tmp_path)]
    assert cli.main(words) == 0
    captured = capsys.readouterr()
    assert captured.err == "model hexapod-v0, the newest; --model names another\n"
    assert cli.main([*words, "--model", "hexapod-v0"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "option", [("--rollouts", "32"), ("--seed", "0"), ("--task", "balance"), ("--model", "hexapod-v2")]
)
def test_an_option_of_a_measurement_is_refused_where_nothing_is_measured(option, tmp_path, capsys):
    assert cli.main(["policy", "balance", *option, "--store", str(tmp_path)]) == 2
    assert f"{option[0]}: got it without --measure" in capsys.readouterr().err
