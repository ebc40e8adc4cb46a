"""The hidden-effect benchmark counts what a diagnosis says as what it is; its robots are those asked for."""

import json
from pathlib import Path
from typing import Any

import pytest

BENCH = Path(__file__).resolve().parents[1] / "bench"
LEG = {"leg": "lm", "remaining_torque_share": 0.5}
PAIR = {"backlash": {"gap_rad": 0.05}, "payload": {"mass_kg": 0.2}}


@pytest.fixture(autouse=True)
def beside_the_scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs a script of the folder, too: its modules are found from there."""
    monkeypatch.syspath_prepend(str(BENCH))


def result(hidden: str, verdict: str, *uses: str, effect: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    truth = {"friction": 0.7, "mass": 0.8, "gain": 2.5, "effect": effect or {}}
    return {
        **{"hidden": hidden, "strength": "strong", "seed": 1, "verdict": verdict, "uses": list(uses), "truth": truth},
        **{"first": uses[0] if uses else "", "ranking": [], "base": [], "rounds": []},
        **{"found": list(uses[:1]) if verdict == "effect" else []},
        **{"errors": {"unfitted": 9.0, "fitted": 3.0, "added": 1.1}},
        **{"wall_s": 50.0, "cpu_s": 40.0, "peak_mib": 200.0, "at_once": 2, "plan": "quick", "format": 2, **more},
    }


@pytest.mark.parametrize(
    ("told", "word"),
    [
        (result("none", "nothing_missing"), "right"),
        (result("none", "effect", "payload"), "false alarm"),
        (result("none", "outside_library"), "false alarm"),
        (result("weak_leg", "effect", "weak_leg:lm", effect=LEG), "right"),
        (result("weak_leg", "effect", "weak_leg:lf", effect=LEG), "wrong"),
        (result("weak_leg", "cannot_tell", "payload", "weak_leg:lm", effect=LEG), "unsure"),
        (result("weak_leg", "cannot_tell", "payload", "backlash", effect=LEG), "wrong"),
        (result("weak_leg", "nothing_missing", effect=LEG), "missed"),
        (result("cogging", "outside_library"), "flagged"),
        (result("cogging", "effect", "coulomb_friction"), "wrong"),
        (result("cogging", "cannot_tell", "backlash", "payload"), "unsure"),
        (result("cogging", "nothing_missing"), "missed"),
    ],
)
def test_one_word_says_how_a_diagnosis_came_out(told: dict[str, Any], word: str) -> None:
    from hidden_effects.outcomes import outcome

    assert outcome(told) == word


@pytest.mark.parametrize(
    ("found", "word"),
    [
        (["payload", "backlash"], "both"),
        (["payload", "backlash", "imu_tilt"], "both and another"),
        (["payload", "imu_tilt"], "one of two"),
        (["imu_tilt"], "wrong"),
        ([], "missed"),
    ],
)
def test_of_two_effects_both_must_be_found_and_no_third(found: list[str], word: str) -> None:
    from hidden_effects.outcomes import outcome

    verdict = "effect" if found else "nothing_missing"
    assert outcome(result("backlash+payload", verdict, *found[:1], effect=PAIR, found=found)) == word


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        ({"format": 1}, "line 2: a result of format 1, allowed is 2"),
        ({"format": None}, "a result of format None"),
        ({}, "a result of format 1"),
        ("{cut off", "line 2: no result of this benchmark"),
        ("[]", "line 2: no result of this benchmark"),
    ],
)
def test_kept_results_of_another_format_are_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], kept: Any, words: str
) -> None:
    from hidden_effects.main import main

    new = result("none", "nothing_missing")
    old = {k: v for k, v in new.items() if k != "format"}
    keep = tmp_path / "kept.jsonl"
    keep.write_text(json.dumps(new) + "\n" + (kept if isinstance(kept, str) else json.dumps({**old, **kept})) + "\n")
    monkeypatch.setattr("sys.argv", ["hidden", "--hidden", "none", "--seeds", "1:2", "--keep", str(keep)])
    assert main() == 1
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1


def test_kept_results_of_this_format_give_the_figures_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from hidden_effects.main import main

    keep = tmp_path / "kept.jsonl"
    keep.write_text(json.dumps(result("none", "nothing_missing")) + "\n")
    monkeypatch.setattr("sys.argv", ["hidden", "--hidden", "none", "--seeds", "1:2", "--keep", str(keep)])
    assert main() == 0
    assert json.loads(capsys.readouterr().out)["name"] == "hidden"


def test_first_and_alike_are_counted_apart_from_the_verdict() -> None:
    from hidden_effects.outcomes import ranked_first, twin_ranked_first

    twin = {"use": "sensor_latency", "confused_with": ["command_latency"]}
    told = result("command_latency", "cannot_tell", "sensor_latency", "command_latency", ranking=[twin])
    assert not ranked_first(told) and twin_ranked_first(told)
    assert ranked_first(result("payload", "nothing_missing", first="payload"))


def test_an_interval_is_held_against_the_true_size_wherever_the_effect_was_fitted() -> None:
    from hidden_effects.truth import size_hits

    def fitted(low: float, high: float) -> list[dict[str, Any]]:
        return [{"use": "backlash", "parameters": [{"name": "backlash.gap", "low90": low, "high90": high}]}]

    for later in (fitted(0.04, 0.06), fitted(0.06, 0.08)):
        told = result("backlash+payload", "effect", "payload", effect=PAIR, found=["payload", "backlash"])
        told |= {"ranking": [{"use": "payload", "parameters": []}], "rounds": [{"ranking": later}]}
        assert list(size_hits(told)) == [("backlash", later[0]["parameters"][0]["low90"] < 0.05, True)]
    again = result("backlash+payload", "effect", "payload", effect=PAIR, found=["payload", "backlash"])
    again |= {"ranking": fitted(0.08, 0.09), "rounds": [{"ranking": fitted(0.04, 0.06)}]}
    assert list(size_hits(again)) == [("backlash", True, True)], "the fit that named it counts"
    missed = result("backlash", "nothing_missing", effect=PAIR["backlash"], ranking=fitted(0.06, 0.08))
    assert list(size_hits(missed)) == [("backlash", False, False)], "an effect that was not named counts, too"
    assert not list(size_hits(result("backlash", "nothing_missing", effect=PAIR["backlash"])))


def test_figures_stand_beside_their_targets() -> None:
    from hidden_effects.figures import figures

    found = [result("none", "nothing_missing") for _ in range(20)]
    fitted = [{"use": "payload", "parameters": [{"name": "payload.mass", "low90": 0.1, "high90": 0.3}]}]
    found += [result("payload", "effect", "payload", effect={"mass_kg": 0.2}, ranking=fitted) for _ in range(9)]
    found += [result("payload", "effect", "backlash", effect={"mass_kg": 0.2}), result("cogging", "outside_library")]
    told = {f["name"]: f for f in figures(found)}
    alarms = told["false alarms with nothing hidden"]
    assert (alarms["value"], alarms["target"], alarms["met"]) == (0.0, 0.05, True)
    assert told["the same, at most, with 95 % confidence"]["value"] == pytest.approx(1 - 0.05 ** (1 / 20), abs=1e-3)
    first = told["strong effects ranked first"]
    assert (first["value"], first["unit"], first["met"]) == (0.9, "of 10", False)
    missed = result("payload", "effect", "backlash", effect={"mass_kg": 0.5}, ranking=fitted)
    sizes = {f["name"]: f for f in figures([*found, missed]) if f["name"].startswith("90 % intervals of effects'")}
    (every, named), unsized = sizes.values(), "90 % intervals of effects' sizes that hold the truth"
    assert list(sizes) == [f"{unsized}, wherever fitted", f"{unsized}, effects that were named"]
    assert (every["value"], every["unit"], every["target"]) == (0.9, "of 10", "0.85 to 0.95")
    assert (named["value"], named["unit"], named["target"]) == (1.0, "of 9", None)
    assert told["intervals of payload that hold the truth"]["value"] == 1.0
    assert told["outside the library: flagged"]["met"] and told["payload (strong): wrong"]["value"] == 1


def test_what_an_effect_brings_stands_beside_what_fitting_alone_brings() -> None:
    from hidden_effects.figures import figures

    wrong = {"unfitted": 9.0, "fitted": 5.0, "added": 5.0}
    own = {"unfitted": 4.0, "fitted": 2.0, "added": 0.9}
    found = [result("payload", "effect", "payload", errors_own_floor=own), result("none", "nothing_missing")]
    found += [result("cogging", "nothing_missing", errors=wrong) for _ in range(3)]
    name = "median error over the floor on unseen motions, "
    told = {f["name"].removeprefix(name): f for f in figures(found) if f["name"].startswith(name)}
    right, every = "named right: ", "every robot with an effect: "
    versions = (
        "model as it was, not fitted",
        "without an effect, parameters fitted",
        "with what was named, parameters fitted",
    )
    assert [told[right + v]["value"] for v in versions] == [9.0, 3.0, 1.1]
    assert [told[every + v]["value"] for v in versions] == [9.0, 5.0, 5.0]
    assert [told[right + v]["target"] for v in versions] == [None, None, 1.2] and told[right + versions[0]][
        "unit"
    ] == "of 1"
    assert "median wall time of a diagnosis, up to 2 at once" in {f["name"] for f in figures(found)}
    (floor,) = (f for f in figures(found) if "own floor" in f["name"] and "named right" in f["name"])
    assert (floor["value"], floor["unit"]) == (0.9, "of 1"), "older results have none"


def test_the_confusion_matrix_says_who_was_taken_for_whom() -> None:
    from hidden_effects.outcomes import as_text, confusion

    leg = result("weak_leg", "effect", "weak_leg:lm", effect=LEG)
    table = confusion([leg, leg, result("weak_leg", "effect", "payload"), result("none", "nothing_missing")])
    assert table == {"weak_leg (strong)": {"weak_leg": 2, "payload": 1}, "none": {"nothing missing": 1}}
    assert as_text(table).splitlines()[0] == "weak_leg (strong)  weak_leg 2, payload 1"


def test_every_named_truth_has_the_library_s_parameter() -> None:
    from hidden_effects.truth import SIZES

    from tcbi_bringup.emulated_robot.hidden_effects import choose
    from tcbi_bringup.emulated_robot.hidden_names import LIBRARY
    from tcbi_sim.effects import built_in

    assert set(SIZES) == set(LIBRARY)
    for name, pairs in SIZES.items():
        truth = choose(name, "strong", 1)[2].truth
        known = {p.name: p for p in built_in()[name].parameters}
        for parameter, key in pairs:
            assert known[parameter].low <= float(truth[key]) <= known[parameter].high, (name, parameter)  # type: ignore[arg-type]


def test_the_robots_are_those_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    from hidden_effects.main import PAIRED, jobs_of, parser

    def jobs(*words: str) -> list[Any]:
        return jobs_of(parser().parse_args(words))

    assert len(jobs("--quick")) == 7 and {job[0] for job in jobs("--quick")} == {"quick"}
    every = jobs("--plan", "bench", "--hidden", "all", "--strength", "strong,weak", "--seeds", "1:3")
    assert len(every) == 2 * (25 * 2 + 1) and every[0] == ("bench", "none", "strong", 1)
    judging = jobs("--judge", "--plan", "bench")
    assert len(judging) == 5 * (6 * 2 + 1) + 95 and len(set(judging)) == len(judging)
    assert {seed for *_, seed in judging} == set(range(2000, 2100))
    assert len(jobs("--hidden", "none", "--pairs", "--seeds", "1:2")) == 1 + len(PAIRED) * (len(PAIRED) - 1) // 2
    assert ("quick", "backlash+payload", "weak", 5) in jobs(
        "--hidden=backlash+payload", "--strength=weak", "--seeds=5:6"
    )
    for words, told in (
        (("--hidden", "gremlins"), "'gremlins'"),
        (("--strength", "huge"), "there are strong, weak"),
        (("--seeds", "3:2"), "wanted first:end"),
    ):
        with pytest.raises(SystemExit):
            jobs(*words)
        assert told in capsys.readouterr().err
