"""`./tcbi infer`: the contract's keys, a new model version, one clear line for bad input."""

import json
from pathlib import Path

import pytest

from tcbi_bringup import cli
from tcbi_sim.store import ModelStore
from tests.servo_bags import RIG, steps_bags


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return steps_bags(tmp_path_factory.mktemp("bags"))


def infer(bags: Path, store: Path, *words: str) -> int:
    return cli.main(["infer", str(bags), "--store", str(store), "--particles", "20", "--generations", "2", *words])


def test_json_has_the_contracts_keys_and_nothing_else_is_on_standard_output(bags, tmp_path, capsys) -> None:
    assert infer(bags, tmp_path, "--json") == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert {"model", "method", "parameters", "ess", "simulations", "seconds"} <= set(found)
    assert set(found["parameters"][0]) >= {"name", "unit", "mean", "sd", "low90", "high90", "identified"}
    looked = found["simulations"] - 2 * 20 * 4  # at draws of the posterior, in every rollout
    assert found["method"] == "calibrated" and 0 < looked <= (40 + 4 * 24) * 4 and looked % 4 == 0
    assert "open loop" in captured.err
    assert found["prior"] == "flat" and found["fits"] in (True, False, None)
    claims = {"yes", "not surely", "no: little more than the prior", "cannot say"} if found["fits"] else set()
    assert {p["identifiability"] for p in found["parameters"]} <= claims | {
        "cannot say: too few generations",
        "not identified: the model fits poorly",
    }
    assert found["settings"].items() >= {"seed": 0, "divergence": "js", "particles": 20, "generations": 2}.items()
    saved = ModelStore(tmp_path).load(found["model"])
    assert saved.parent == f"{RIG}-v0"
    means = dict(zip(saved.names, saved.weights @ saved.particles, strict=True))
    assert all(means[p["name"]] == pytest.approx(p["mean"]) for p in found["parameters"])


def test_the_table_says_of_each_parameter_whether_the_data_tell(bags, tmp_path, capsys) -> None:
    assert infer(bags, tmp_path, "--method", "paper", "--statistics", "joint_tracking") == 0
    text = capsys.readouterr().out
    assert all(name in text for name in ("gain", "damping", "friction", "identified?"))
    assert "narrows with every generation" in text and text.count("not judged") == 3


def test_few_effective_particles_tell_nothing_whatever_their_spread(bags, tmp_path, capsys) -> None:
    page = tmp_path / "page.html"
    assert infer(bags, tmp_path, "--particles", "10", "--generations", "1", "--report", str(page)) == 0
    text = capsys.readouterr().out
    assert "--advise" not in text, "nothing could be advised"
    assert text.count("cannot say") == 3 and "fewer than 10 effective particles tell nothing" in text
    assert page.read_text().count("cannot say") == 3, "the report says the same"


def test_the_report_shows_generations_beside_the_known_truth(bags, tmp_path, capsys) -> None:
    page = tmp_path / "page.html"
    assert infer(bags, tmp_path, "--truth", "gain=2", "--report", str(page), "--json") == 0
    assert json.loads(capsys.readouterr().out)["report"] == str(page)
    html = page.read_text()
    assert "Over the generations" in html and "Variance of gain" in html and "inside?" in html


def test_a_truth_of_an_unknown_parameter_is_refused_with_the_names_known(bags, tmp_path, capsys) -> None:
    assert infer(bags, tmp_path, "--truth", "gian=2") != 0
    assert "did you mean 'gain'" in capsys.readouterr().err


def test_a_method_to_compare_with_says_what_its_posterior_is(bags, tmp_path, capsys) -> None:
    assert infer(bags, tmp_path, "--method", "simopt", "--set", "kl_bound=0.06") == 0
    text = capsys.readouterr().out
    assert "SimOpt is an optimiser" in text and "method simopt" in text


@pytest.mark.parametrize(
    ("words", "said", "status"),
    [
        (("--method", "magic"), "unknown method 'magic'; known: calibrated, paper", 2),
        (("--method", "paper", "--divergence", "magic"), "unknown divergence 'magic'; known: js, js_nearest", 2),
        (("--statistics", "speed"), "unknown statistic 'speed'; known: attitude", 2),
        (("--set", "speed=5"), "unknown setting of method calibrated 'speed'; known: particles, generations", 2),
        (("--set", "prior_share=9"), "prior_share: got 9.0, allowed is 0 to 1", 2),
        (("--set", "particles=nan"), "'particles=nan' is not NAME=VALUE with a number", 2),
        (("--particles", "1"), "--particles: got '1', allowed is a whole number, 10 or more", 2),
        (("--seed", "-1"), "--seed: got '-1', allowed is a whole number, 0 to 4294967295", 2),
        (("--timestep", "0"), "--timestep: got '0', allowed is a number, 1e-05 to 0.01", 2),
        (("--method", "simopt", "--divergence", "mmd"), "method simopt looks at no divergence", 2),
        (("--method", "simopt", "--statistics", "reward"), "looks at trajectories, not at statistics", 2),
        (("--model", "hexapod-v0"), "is of rig hexapod", 1),
        (("--loop", "closed"), "policy 'steps' does not exist", 1),
        (("--rollouts", "1"), "at least 2 are needed", 1),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_model(bags, tmp_path, capsys, words, said, status) -> None:
    assert infer(bags, tmp_path, *words) == status
    lines = capsys.readouterr().err.strip().splitlines()
    assert said in lines[-1]
    assert ModelStore(tmp_path).versions(RIG) == [f"{RIG}-v0"]
