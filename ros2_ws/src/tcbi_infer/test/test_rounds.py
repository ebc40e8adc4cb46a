"""One effect after another: what is tried next, when the search ends and why."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.diagnose import rounds as module
from tcbi_infer.diagnose.rounds import rounds, steps
from tcbi_sim.model import base_model

CANDIDATES = ["a", "b", "c", "d"]


@dataclasses.dataclass(frozen=True)
class Said:
    """What a diagnosis said, as far as the search looks at it."""

    verdict: str
    uses: tuple[str, ...]
    ranking: tuple[Any, ...]
    errors: dict[str, float]
    model: str = "m-v0"
    unsteady: str = ""
    converged: bool = True

    @property
    def base(self) -> Any:
        return SimpleNamespace(converged=self.converged)

    def to_json(self) -> dict[str, Any]:
        return {}


def evidence(use: str, error: float, accepted: bool = True, alike: tuple[str, ...] = (), little: bool = False) -> Any:
    return SimpleNamespace(
        use=use, error_after=error, accepted=accepted, alike=alike, refined=True, explains_little=little
    )


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
            return Said(verdict, (use,), (evidence(use, 8.0 - len(asked)),), {"base": 9.0 - len(asked)})

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
    assert found[-1].ending.startswith("no effect is named")
    fell = [error for _, error in steps(found)]
    assert fell == sorted(fell, reverse=True) and fell[-1] < 1.3
    assert all(set(r.diagnosis.sealed) == set(found[0].diagnosis.sealed) for r in found)


@pytest.fixture
def facts(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let diagnoses follow from facts: by the effects of a model and the only candidate, if there is one."""

    def plan(says: dict[tuple[tuple[str, ...], str], Said]) -> None:
        def diagnosed(model: Any, _: Any, *, uses: list[str] | None) -> Any:
            only = uses[0] if uses and len(uses) == 1 else ""
            return dataclasses.replace(says[tuple(sorted(model.effects)), only], model=model.version)

        def adopted(model: Any, use: str, _: Any) -> Any:
            effects = (*model.effects, use)
            return Model(version="m+" + "+".join(effects), effects=effects)

        monkeypatch.setattr(module, "diagnose", diagnosed)
        monkeypatch.setattr(module, "adopt", adopted)
        monkeypatch.setattr(module, "objection", lambda *_: "")

    return plan


def named(use: str) -> Said:
    return Said("effect", (use,), (evidence(use, 1.0),), {"base": 2.0})


def nothing(verdict: str = "nothing_missing") -> Said:
    return Said(verdict, (), (evidence("d", 2.0, accepted=False),), {"base": 2.0})


UNSURE = Said("cannot_tell", ("a", "b"), (evidence("a", 3.0), evidence("b", 3.1)), {"base": 5.0})
PARTLY = Said("outside_library", (), (evidence("a", 7.0), evidence("b", 8.0, accepted=False)), {"base": 9.0})
DOUBTED = Said(
    "cannot_tell", ("a",), (evidence("a", 7.0, accepted=False), evidence("b", 8.0, accepted=False)), {"base": 9.0}
)


@pytest.mark.parametrize(
    ("b_beside_a", "a_beside_b", "added"),
    [(True, True, ("a", "b")), (False, True, ("a",)), (True, False, ("b",)), (False, False, ())],
)
def test_of_two_that_are_not_told_apart_what_each_is_beside_the_other_decides(facts, b_beside_a, a_beside_b, added):
    facts({
        ((), ""): UNSURE,
        (("a",), "b"): named("b") if b_beside_a else nothing(),
        (("b",), "a"): named("a") if a_beside_b else nothing(),
        (("a",), ""): nothing(),
        (("b",), ""): nothing(),
        (("a", "b"), ""): nothing(),
    })  # fmt: skip
    found = list(rounds(Model(version="m-v0", effects=()), [], uses=CANDIDATES))
    assert tuple(r.use for r in found if r.use) == added
    assert bool(found[0].resolved) == bool(added) and found[-1].ending.startswith("no effect is named")
    assert ("a and b were tried beside each other" in found[-1].ending) == (not added)
    assert [r.diagnosis.model for r in found] == [r.model.version for r in found]
    if len(added) == 2:
        assert "b is named beside a, and a beside b" in found[0].resolved


def test_two_that_change_the_signals_alike_are_not_tried_beside_each_other(facts):
    alike = (evidence("a", 3.0, alike=("b",)), evidence("b", 3.1, alike=("a",)))
    facts({((), ""): dataclasses.replace(UNSURE, ranking=alike)})
    (only,) = rounds(Model(version="m-v0", effects=()), [], uses=CANDIDATES)
    assert only.added is None


LITTLE = Said(
    "cannot_tell", ("a",), (evidence("a", 2.9, little=True), evidence("b", 8.0, accepted=False)), {"base": 3.2}
)


@pytest.mark.parametrize("begun", [PARTLY, DOUBTED, LITTLE])
@pytest.mark.parametrize(
    ("beside_a", "left", "a_beside_b", "added"),
    [
        (named("b"), nothing(), named("a"), ("a", "b")),
        (nothing(), nothing(), named("a"), ()),
        (named("b"), nothing("outside_library"), named("a"), ()),
        (named("b"), nothing(), nothing(), ()),
    ],
)
def test_two_that_only_together_explain_what_is_missing_are_added_and_no_less(
    facts, begun, beside_a, left, a_beside_b, added
):
    facts({((), ""): begun, (("a",), ""): beside_a, (("a", "b"), ""): left, (("b",), "a"): a_beside_b})
    found = list(rounds(Model(version="m-v0", effects=()), [], uses=CANDIDATES))
    assert tuple(r.use for r in found if r.use) == added
    assert not added or found[0].resolved.startswith("Neither explains it alone")


def test_beside_what_is_not_certain_nothing_is_tried_where_little_is_left(facts):
    less = dataclasses.replace(DOUBTED, ranking=(evidence("a", 2.0, accepted=False),))
    facts({((), ""): less})
    (only,) = rounds(Model(version="m-v0", effects=()), [], uses=CANDIDATES)
    assert only.added is None and only.ending == "no effect is named"


@pytest.mark.parametrize(
    "begun",
    [
        dataclasses.replace(PARTLY, unsteady="It does not repeat itself."),
        dataclasses.replace(LITTLE, converged=False),
    ],
)
def test_of_an_unsteady_robot_or_on_a_base_fit_in_doubt_no_second_effect_is_looked_for(facts, begun):
    facts({((), ""): begun})
    (only,) = rounds(Model(version="m-v0", effects=()), [], uses=CANDIDATES)
    assert only.added is None and only.ending == "no effect is named"
