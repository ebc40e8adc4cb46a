"""What rollouts could have shown: checked by planting effects of that size, and by counting false alarms."""

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.diagnose import diagnose
from tcbi_infer.diagnose.detectable import HEAD, SIZES, _Ray, _Use, robust_gain, rows
from tcbi_infer.diagnose.evidence import DetectableSize, Diagnosis
from tcbi_infer.diagnose.false_alarms import false_alarms
from tcbi_infer.diagnose.null import Null, sign_patterns, threshold_of
from tcbi_infer.diagnose.screen import Targets
from tcbi_infer.diagnose.settings import QUICK
from tcbi_sim.effects import library
from tcbi_sim.model import base_model
from tcbi_sim.parameter import Parameter

GAP = "backlash"
STIFFER = """
from tcbi_sim.effect import Effect
from tcbi_sim.parameter import Parameter

def apply(fields, rig, site, values):
    fields.scale_gain(fields.actuators(), values["factor"])

EFFECT = Effect(
    name="stiffer",
    physics="The servo is stiffer than the model's own stiffness says, which is that parameter under another name.",
    source="made for this test",
    parameters=(Parameter("factor", "1", 0.5, 2.0, 1.2, null=1.0, scale="log", description="of the stiffness"),),
    apply=apply,
)
"""
RECORDED = ("sine", "fast", "steps", "chirp", "saw")


def diagnosed(gap: float, uses: tuple[str, ...], seed: int) -> Diagnosis:
    """A quick diagnosis of a bench with play of `gap` rad; 0 is none."""
    model = base_model("servo_bench")
    truth, values = (model.with_effect(GAP), np.r_[BASE, gap]) if gap else (model, BASE)
    rollouts = [m for m in record(truth, values, seed) if m.policy_id in RECORDED]
    return diagnose(model, rollouts, uses=uses, settings=QUICK)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Iterator[Diagnosis]:
    """A bench without play, diagnosed with an effect of the user's own that is a base parameter in disguise."""
    folder = tmp_path_factory.mktemp("effects")
    (folder / "stiffer.py").write_text(STIFFER)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TCBI_EFFECTS", str(folder))
        library.cache_clear()
        yield diagnosed(0.0, (GAP, "stiffer"), seed=0)
    library.cache_clear()


@pytest.fixture(scope="module")
def stated(sound) -> DetectableSize:
    """The smallest gap that a bench without play says it would have shown."""
    return next(s for s in sound.detectable if s.use == GAP)


def test_twice_the_stated_size_is_named(stated):
    found = diagnosed(2.0 * stated.value, (GAP,), seed=5)
    assert found.verdict == "effect" and found.ranking[0].statistic > found.threshold


def test_a_third_of_the_stated_size_is_not_named(stated):
    found = diagnosed(0.3 * stated.value, (GAP,), seed=5)
    assert found.verdict == "nothing_missing" and not found.ranking[0].accepted


def test_the_size_is_in_the_parameters_own_unit_and_says_what_decides_it(stated):
    assert (stated.unit, stated.null, stated.reason) == ("rad", 0.0, "")
    assert stated.limit and 0 < stated.value < 0.01


def test_an_effect_that_is_a_base_parameter_under_another_name_is_not_testable(sound):
    disguised = [s for s in sound.detectable if s.use == "stiffer"]
    assert len(disguised) == 2  # upwards and downwards
    assert all(s.value is None and "own parameters" in s.reason for s in disguised)


def test_every_candidate_has_a_size_or_a_reason_in_the_json(sound):
    listed = sound.to_json()["detectable"]
    assert {s["use"] for s in listed} == {GAP, "stiffer"}
    assert all((s["value"] is None) == bool(s["reason"]) for s in listed)


def test_the_table_shows_the_hardest_site_and_counts_those_that_show_nothing():
    size = DetectableSize("weak_leg:lf", "weak_leg:lf.scale", "1", 1.0, 0.9, 0.05, "the search")
    others = [
        dataclasses.replace(size, use="weak_leg:rm", parameter="weak_leg:rm.scale", value=0.8, share=0.1),
        dataclasses.replace(size, use="weak_leg:rr", parameter="weak_leg:rr.scale", value=None, reason="too small"),
    ]
    ((effect, parameter, shown, decided),) = rows([size, *others])
    assert (effect, parameter, len(HEAD)) == ("weak_leg (3 places)", "scale", 4)
    assert shown == "0.8 (none: 1)" and "1 of 3" in decided


def test_the_robust_gain_of_a_small_effect_is_that_of_squares_and_of_a_large_one_less():
    samples = np.array([1000.0, 2000.0])
    assert robust_gain(np.array([5.0, 8.0]), samples) == pytest.approx([5.0, 8.0], rel=0.02)
    assert np.all(robust_gain(np.array([5e4, 8e4]), samples) < [5e3, 1e4])


def null(passed: int, kinds: int, count: int = 300) -> Null:
    maxima = np.r_[np.full(passed, 3.0), np.zeros(count - passed)]
    return Null(2.0, maxima, kinds, Targets(np.zeros(0), np.zeros(0)), np.ones(count))


def test_the_false_alarm_rate_has_its_own_interval():
    alarms = false_alarms(null(15, 8))
    assert alarms.rate == pytest.approx(0.05) and alarms.data_sets == 300
    assert (alarms.low90, alarms.high90) == pytest.approx((0.031, 0.076), abs=0.001)  # Clopper and Pearson's
    assert "15 of 300" in alarms.statement and "5.0 % (90 % interval 3.1 % to 7.6 %)" in alarms.statement


def test_the_false_alarm_rate_is_not_five_percent_by_construction():
    maxima = 2.0 + np.random.default_rng(0).standard_t(3, (20, 300))
    passed = [round(300 * (false_alarms(dataclasses.replace(null(0, 8), maxima=m)).rate or 0.0)) for m in maxima]
    assert len(set(passed)) > 3 and np.mean(passed) == pytest.approx(15, abs=3)


@pytest.mark.parametrize("kinds", [2, 5, 8, 9])
def test_signs_come_in_every_pattern_equally_often_where_there_are_few(kinds):
    patterns = sign_patterns(kinds, 300, np.random.default_rng(1))
    assert patterns.shape == ({2: 300, 5: 320, 8: 512, 9: 300}[kinds], kinds)
    assert set(np.unique(patterns)) == {-1.0, 1.0}
    often = np.unique(patterns, axis=0, return_counts=True)[1]
    assert kinds == 9 or (len(often) == 2**kinds and np.ptp(often) == 0)


@pytest.mark.parametrize("worst", [[1, 1, 1, 1, 1], [1, -1, 1, 1, -1]])
def test_a_threshold_of_five_kinds_does_not_hang_on_how_often_one_pattern_was_drawn(worst):
    """Of the sixteen patterns one, whichever, makes of the discrepancy something like an effect."""
    thresholds, alarms = [], []
    for seed in range(20):
        patterns = sign_patterns(5, 300, np.random.default_rng(seed))
        maxima = np.random.default_rng(100 + seed).uniform(0.0, 6.0, len(patterns))
        maxima[np.abs(patterns @ worst) == 5] = 18.0
        thresholds.append(threshold_of(maxima, 5))
        alarms.append(false_alarms(dataclasses.replace(null(0, 5), maxima=maxima)))
    assert max(thresholds) < 6.1, "that of the other patterns"
    assert min(a.rate for a in alarms) > 1 / 16, "it is counted as the alarms that it makes"
    assert all("With 5 kinds of motion the threshold aims at 9.4 %" in a.statement for a in alarms)
    assert threshold_of(maxima, 4) == 18.0, "where no rate is told, it sets the threshold"


def test_no_alarm_seen_is_no_rate_of_zero():
    alarms = false_alarms(null(0, 6))
    assert alarms.rate == 0 and alarms.low90 == 0 and alarms.high90 == pytest.approx(0.00994, abs=1e-4)


def test_no_false_alarm_rate_is_claimed_of_few_kinds_of_motion():
    alarms = false_alarms(null(15, 4))
    assert alarms.rate is None and "no false-alarm rate is claimed" in alarms.statement
    assert false_alarms(Null.of_no_search()).rate is None


@pytest.mark.parametrize(("straight", "least"), [(True, SIZES[0]), (False, 0.1)])
def test_of_an_effect_that_is_not_straight_nothing_smaller_than_simulated_is_claimed(monkeypatch, straight, least):
    own = Parameter("gap", "rad", 0.0, 1.0, 0.2, null=0.0, description="")
    use = object.__new__(_Use)
    use.key, use.own = "backlash", (own,)
    monkeypatch.setattr(_Use, "_absorbed", lambda self, ray: False)
    monkeypatch.setattr(_Use, "_straight", lambda self, ray: straight)
    monkeypatch.setattr(_Use, "_power", lambda self, ks, multiples: (np.ones(len(ks)), np.ones(len(ks))))
    for name in ("_usefulness", "_distance"):
        monkeypatch.setattr(_Use, name, lambda self, ks, multiples: np.full(len(ks), 50.0))
    size = use._size(_Ray(0, 1, "", (0, 1), (0.1, 0.35)))
    assert size.share == pytest.approx(least) and size.limit == "nothing smaller is claimed"
