"""One effect after another: what is tried next, when the search ends and why."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.diagnose import rounds as module
from tcbi_infer.diagnose.rounds import rounds, steps
from tcbi_sim.model import base_model

CANDIDATES = ["a", "b", "c", "d"]


class Model(SimpleNamespace):
    effects: tuple[str, ...]


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let the diagnoses say what a test wants, and remember which candidates they were given."""

    def plan(verdicts: list[str], disputed: str = "") -> list[list[str] | None]:
        asked: list[list[str] | None] = []

        def diagnosed(model: Any, _: Any, *, uses: list[str] | None) -> Any:
            asked.append(uses)
            verdict, use = verdicts[len(asked) - 1], CANDIDATES[len(asked) - 1]
            errors = {"base": 9.0 - len(asked), use: 8.0 - len(asked)}
            return SimpleNamespace(verdict=verdict, uses=(use,), errors=errors, to_json=dict)

        def adopted(model: Any, use: str, _: Any) -> Any:
            return Model(version=f"m-v{len(asked)}", effects=(*model.effects, use))

        monkeypatch.setattr(module, "diagnose", diagnosed)
        monkeypatch.setattr(module, "adopt", adopted)
        monkeypatch.setattr(module, "objection", lambda _, use: f"{use} varies" if use == disputed else "")
        return asked

    return plan


@pytest.mark.parametrize(
    ("verdicts", "most", "added", "ending"),
    [
        (["effect", "effect", "nothing_missing"], 3, ("a", "b"), "no effect is named"),
        (["effect", "effect", "effect", "effect"], 3, ("a", "b", "c"), "3 effects at most"),
        (["cannot_tell"], 3, (), "no effect is named"),
        (["effect", "effect"], 1, ("a",), "1 effect at most"),
    ],
)
def test_the_next_version_is_diagnosed_until_no_effect_is_named(told, verdicts, most, added, ending):
    asked = told(verdicts)
    saved: list[str] = []

    def keep(model: Any) -> Any:
        saved.append(model.version)
        return model

    found = list(rounds(Model(version="m-v0", effects=()), [], most=most, uses=CANDIDATES, keep=keep))
    last = found[-1].added or found[-1].model
    assert last.effects == added and found[-1].ending == ending and not any(r.ending for r in found[:-1])
    assert [r.added.version for r in found if r.added] == saved and len(saved) == len(added)
    assert [len(uses) for uses in asked] == [4 - i for i in range(len(asked))]
    assert steps(found)[1:] == [(f"m-v{i + 1}, with {use}", 7.0 - i) for i, use in enumerate(added)]


def test_an_effect_on_whose_size_the_motions_disagree_ends_the_search_unless_it_is_wanted_anyway(told):
    told(["effect", "nothing_missing"], disputed="a")
    (only,) = rounds(Model(version="m-v0", effects=()), [], uses=CANDIDATES)
    assert only.added is None and only.ending == "a varies"
    told(["effect", "nothing_missing"], disputed="a")
    assert [r.added is not None for r in rounds(Model(version="m-v0", effects=()), [], anyway=True)] == [True, False]


def test_the_search_ends_where_no_candidate_is_left_to_try(told):
    asked = told(["effect", "effect"])
    found = list(rounds(Model(version="m-v0", effects=()), [], uses=["a", "b"]))
    assert len(asked) == 2 and [r.ending for r in found] == ["", "no candidate is left to try"]
    assert found[-1].added.effects == ("a", "b")


def test_two_hidden_effects_are_found_one_after_the_other():
    truth = base_model("servo_bench").with_effect("command_latency").with_effect("rotor_inertia")
    values = np.r_[BASE, 0.06, 0.002]
    found = list(
        rounds(base_model("servo_bench"), record(truth, values), uses=["command_latency", "rotor_inertia", "backlash"])
    )
    assert {r.diagnosis.uses[0] for r in found if r.added} == {"command_latency", "rotor_inertia"}
    assert found[-1].ending == "no effect is named"
    fell = [error for _, error in steps(found)]
    assert fell == sorted(fell, reverse=True) and fell[-1] < 1.3
    assert all(set(r.diagnosis.sealed) == set(found[0].diagnosis.sealed) for r in found)
