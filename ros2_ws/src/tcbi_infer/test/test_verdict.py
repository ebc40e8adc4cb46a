"""What is required before an effect is named, and what is said otherwise."""

import dataclasses

import numpy as np
import pytest

from tcbi_infer.diagnose.claims import bounds, left_out
from tcbi_infer.diagnose.evidence import (
    CANNOT_TELL,
    EFFECT,
    NOTHING_MISSING,
    OUTSIDE_LIBRARY,
    Evidence,
    Misfit,
    ParameterEstimate,
)
from tcbi_infer.diagnose.judge import at_bound, estimate
from tcbi_infer.diagnose.verdict import CONTRADICTED, accept, ranked, rule
from tcbi_sim.parameter import Parameter

UNSIZED = (ParameterEstimate("gap", "rad", 0.01, 0.0, 0.02, 0.0),)  # may be its null value
GAINS = (40.0, 45.0, 38.0, 42.0, 41.0, 44.0)


def evidence(use: str, gains=GAINS, after: float = 1.5, before: float = 6.0, count: int = 1, **changes) -> Evidence:
    """A candidate with `count` parameters that passes every requirement, but for `changes`."""
    gains = np.array(gains, float)
    sizes = tuple(ParameterEstimate(f"{use}.{i}", "1", 0.5, 0.4, 0.6, 0.0) for i in range(count))
    found = Evidence(
        effect=use, use=use, elpd_gain=float(gains.sum()), elpd_se=1.0, statistic=9.0, error_before=before,
        error_after=after, parameters=sizes, refined=True, converged=True, gains=tuple(gains),
    )  # fmt: skip
    return dataclasses.replace(found, **changes)


def everywhere(error: float, kinds: int = 6) -> Misfit:
    """As much in each kind of motion."""
    return Misfit(error, {f"motion-{i}": error for i in range(kinds)})


def ruled(*found: Evidence, base_error: float = 6.0, kinds: int = 6, unfitted: float = 28.0):
    """The ruling on candidates after they have been tried against a threshold of 3 standard errors."""
    judged = []
    for e in found:
        accepted, reason = accept(e, 3.0, unfitted)
        judged.append(dataclasses.replace(e, accepted=accepted, reason=reason))
    return rule(ranked(judged), everywhere(base_error, kinds), kinds, everywhere(unfitted, kinds), unseen=unfitted)


def test_the_only_candidate_that_passes_is_named():
    ruling = ruled(evidence("backlash"), evidence("payload", statistic=1.0))
    assert (ruling.verdict, ruling.uses) == (EFFECT, ("backlash",))


@pytest.mark.parametrize(
    "fault",
    [
        {"statistic": 1.0},
        {"error_after": 1.95},
        {"converged": False},
        {"refined": False},
        {"parameters": UNSIZED},
    ],
)
def test_a_candidate_that_fails_one_requirement_is_not_named(fault):
    found = evidence("backlash", **{"before": 2.0, "after": 1.8} | fault)
    assert ruled(found, base_error=2.0).verdict == NOTHING_MISSING


@pytest.mark.parametrize(("in_turn", "verdict"), [(None, OUTSIDE_LIBRARY), (3.1, OUTSIDE_LIBRARY), (2.9, EFFECT)])
def test_what_explains_little_is_outside_the_library_only_if_much_is_left_of_the_motions_held_out_in_turn_too(
    in_turn, verdict
):
    found = evidence("viscous_damping", before=5.1, after=3.9, held_out=in_turn and (in_turn + 1.0, in_turn))
    ruling = ruled(found, base_error=5.1)
    assert ruling.verdict == verdict
    assert ("explains only 29 % of the excess" in ruling.statement) == (verdict == OUTSIDE_LIBRARY)
    assert ("Much is left to explain" in ruling.statement) == (verdict == EFFECT)


def test_where_one_accepted_candidate_explains_a_third_nothing_is_outside_the_library():
    plain = evidence("coulomb_friction", before=5.2, after=4.0, alike=("stribeck_friction",))
    fewer = [g - d for g, d in zip(GAINS, (2, -3, 9, -2, 3, 4), strict=True)]
    richer = evidence("stribeck_friction", fewer, 3.3, 5.2, count=3, alike=("coulomb_friction",))
    assert ruled(plain, base_error=5.2).verdict == OUTSIDE_LIBRARY
    both = ruled(plain, richer, base_error=5.2)
    assert (both.verdict, both.uses) == (CANNOT_TELL, ("coulomb_friction", "stribeck_friction"))
    neither = ruled(plain, dataclasses.replace(richer, error_after=3.9), base_error=5.2)
    assert neither.verdict == OUTSIDE_LIBRARY
    assert "the best candidate (stribeck_friction) explains only 31 % of the excess" in neither.statement


RATES = {"angular_velocity": (2.4, 1.2), "contact": (1.0, 0.5)}


def test_an_effect_that_shows_in_the_body_rates_alone_is_named_by_their_error():
    sensor = evidence("gyro_bias", before=1.1, after=1.1, elsewhere=RATES)
    ruling = ruled(sensor, base_error=1.1)
    assert (ruling.verdict, ruling.uses) == (EFFECT, ("gyro_bias",))
    falls = "the error of angular velocity on motions that no fit has seen falls from 2.4 to 1.2 times the noise floor."
    assert falls in ruling.statement and "That of joints and attitude stays at 1.1." in ruling.statement
    fell = ruled(dataclasses.replace(sensor, error_after=0.9), base_error=1.1).statement
    assert "falls from 1.1 to 0.9" in fell and "stays" not in fell


@pytest.mark.parametrize(
    "fault",
    [
        {"elsewhere": {"angular_velocity": (2.4, 2.0)}},
        {"elsewhere": {"angular_velocity": (1.4, 0.7)}},
        {"error_after": 1.2},
        {"statistic": 1.0},
    ],
)
def test_signals_beside_joints_and_attitude_name_no_effect_where_little_falls_or_something_rises(fault):
    sensor = evidence("gyro_bias", **{"before": 1.1, "after": 1.1, "elsewhere": RATES} | fault)
    assert ruled(sensor, base_error=1.1).verdict == NOTHING_MISSING


def test_an_effect_is_not_named_where_the_model_as_it_was_predicts_better():
    ruling = ruled(evidence("backlash", after=3.8, before=11.7), base_error=11.7, unfitted=2.5)
    assert ruling.verdict == NOTHING_MISSING
    assert "the model as it was errs by 2.5 times the noise floor, refitted by 11.7" in ruling.statement
    assert ruled(evidence("backlash", after=3.8, before=11.7), base_error=11.7, unfitted=3.75).verdict == EFFECT


def test_candidates_whose_gains_are_alike_are_both_named_as_possible():
    other = tuple(g + d for g, d in zip(GAINS, (2, -3, 1, -2, 3, -2), strict=True))
    ruling = ruled(evidence("backlash"), evidence("payload", other))
    assert ruling.verdict == CANNOT_TELL and set(ruling.uses) == {"backlash", "payload"}


def test_a_candidate_that_predicts_every_motion_worse_is_no_rival():
    assert ruled(evidence("backlash"), evidence("payload", [g - 20 for g in GAINS], after=1.6)).verdict == EFFECT


@pytest.mark.parametrize(("after", "count", "verdict"), [(1.57, 1, CANNOT_TELL), (1.59, 1, EFFECT), (1.57, 2, EFFECT)])
def test_a_gain_that_hardly_lowers_the_error_tells_no_effect_from_another(after, count, verdict):
    other = evidence("command_latency", [g - 5 for g in GAINS], after=after, count=count)
    assert ruled(evidence("sensor_latency"), other).verdict == verdict


def test_two_effects_that_change_the_signals_alike_are_not_told_apart_however_steady_the_difference():
    late = evidence("sensor_latency", alike=("command_latency",))
    ruling = ruled(late, evidence("command_latency", [g - 5 for g in GAINS], alike=("sensor_latency",)))
    assert ruling.verdict == CANNOT_TELL and set(ruling.uses) == {"sensor_latency", "command_latency"}


def test_a_law_with_more_parameters_that_looks_the_same_and_gains_nothing_is_no_rival():
    plain = evidence("coulomb_friction", alike=("stribeck_friction",))
    richer = evidence("stribeck_friction", count=3, alike=("coulomb_friction",))
    assert ruled(plain, richer).uses == ("coulomb_friction",)


def test_a_richer_law_that_predicts_every_motion_better_is_named_alone():
    plain = evidence("coulomb_friction", alike=("stribeck_friction",))
    richer = evidence("stribeck_friction", [g + 20 for g in GAINS], 1.4, count=3, alike=("coulomb_friction",))
    assert ruled(plain, richer).uses == ("stribeck_friction",)
    assert ruled(plain, dataclasses.replace(richer, error_after=1.45)).uses == ("stribeck_friction", "coulomb_friction")


def test_a_richer_law_that_gains_hardly_more_leaves_the_name_to_the_plain_one_that_it_includes():
    plain = evidence("load_friction", alike=("stribeck_friction",))
    more = [g + d for g, d in zip(GAINS, (2, -1, 3, -2, 3, -1), strict=True)]
    richer = evidence("stribeck_friction", more, 1.48, count=3, alike=("load_friction",))
    assert sum(more) > sum(GAINS)
    assert ruled(plain, richer).uses == ("load_friction",)
    assert ruled(dataclasses.replace(plain, alike=()), dataclasses.replace(richer, alike=())).verdict == CANNOT_TELL
    assert ruled(plain, dataclasses.replace(richer, error_after=1.4)).verdict == CANNOT_TELL


@pytest.mark.parametrize(
    ("kinds", "bad", "verdict"),
    [
        (2, 1, NOTHING_MISSING), (2, 2, OUTSIDE_LIBRARY), (5, 2, NOTHING_MISSING), (5, 3, OUTSIDE_LIBRARY),
        (8, 4, NOTHING_MISSING), (8, 5, OUTSIDE_LIBRARY),
    ],
)  # fmt: skip
@pytest.mark.parametrize("error", [9.0, np.inf])
def test_an_error_in_some_kinds_of_motion_is_told_of_these(kinds, bad, verdict, error):
    errors = {f"motion-{i}": error if i < bad else 2.0 for i in range(kinds)}
    ruling = rule([], Misfit(4.0, errors), kinds, everywhere(28.0, kinds))
    assert ruling.verdict == verdict
    if verdict != OUTSIDE_LIBRARY:
        assert ruling.statement.startswith("No effect is named") and f"in {bad} of {kinds} kinds" in ruling.statement


def test_how_many_kinds_err_is_asked_of_the_model_that_predicts_better():
    slip = Misfit(3.2, {"a": 2.0, "b": 2.0, "c": 2.0, "d": 2.0, "e": 6.0})
    ruling = rule([], everywhere(12.0, 5), 5, slip)
    assert ruling.verdict == NOTHING_MISSING and "most in e, by 6.0" in ruling.statement


@pytest.mark.parametrize(
    ("tilts", "verdict"), [((2.0, 8.0, 2.0, 7.0, 9.0), OUTSIDE_LIBRARY), ((9, 3, 2, 3, 9), NOTHING_MISSING)]
)
def test_a_wrong_attitude_is_not_drowned_in_well_predicted_joints(tilts: tuple[float, ...], verdict: str) -> None:
    kinds = {f"motion-{i}": 2.5 for i in range(5)}
    base = Misfit(2.5, kinds, dict(zip(kinds, map(float, tilts), strict=True)))
    ruling = rule([], base, 5, everywhere(28.0, 5))
    assert ruling.verdict == verdict
    assert ("roll and pitch by 7.0 in the median kind" in ruling.statement) == (verdict == OUTSIDE_LIBRARY)


def test_a_large_error_that_no_candidate_explains_lies_outside_the_library():
    assert ruled(evidence("backlash", after=18.0, before=20.0), base_error=20.0).verdict == OUTSIDE_LIBRARY
    assert (
        ruled(evidence("backlash", statistic=1.0, after=19.0, before=20.0), base_error=20.0).verdict == OUTSIDE_LIBRARY
    )


@pytest.mark.parametrize(
    ("before", "after", "held_out", "verdict"),
    [
        (3.2, 2.9, None, CANNOT_TELL), (3.2, 2.4, None, EFFECT), (2.9, 2.7, None, EFFECT),
        (3.2, 2.9, (4.0, 1.5), EFFECT), (3.2, 2.9, (4.0, 3.4), CANNOT_TELL), (3.8, 3.2, None, OUTSIDE_LIBRARY),
    ],
)  # fmt: skip
def test_an_accepted_candidate_that_explains_little_of_a_large_error_is_left_open(before, after, held_out, verdict):
    ruling = ruled(evidence("coulomb_friction", before=before, after=after, held_out=held_out), base_error=before)
    assert ruling.verdict == verdict
    assert ruling.uses == (() if verdict == OUTSIDE_LIBRARY else ("coulomb_friction",))
    assert ("of which coulomb_friction explains only 14 %" in ruling.statement) == (verdict == CANNOT_TELL)


def test_two_that_explain_little_are_told_to_do_so_and_one_that_shows_elsewhere_is_named() -> None:
    two = [evidence(use, before=3.2, after=2.9) for use in ("coulomb_friction", "viscous_damping")]
    assert "None of them explains a third of it." in ruled(*two, base_error=3.2).statement
    elsewhere = {"body rates": (6.0, 1.0)}
    bias = evidence("gyro_bias", before=3.2, after=3.2, held_out=(3.1, 2.95), elsewhere=elsewhere)
    assert (ruled(bias, base_error=3.1).verdict, ruled(bias, base_error=3.1).uses) == (EFFECT, ("gyro_bias",))


def test_a_large_error_that_an_uncertain_candidate_would_explain_is_left_open():
    found = evidence("backlash", statistic=1.0, after=2.0, before=20.0)
    assert (ruled(found, base_error=20.0).verdict, ruled(found, base_error=20.0).uses) == (CANNOT_TELL, ("backlash",))
    slipped = Misfit(3.3, dict(zip("abcdef", (2.0, 2.7, 7.0, 1.3, 2.0, 2.0), strict=True)))
    alone = dataclasses.replace(found, error_before=3.3, reason="too uneven")
    assert rule([alone], slipped, 6, everywhere(28.0)).verdict == NOTHING_MISSING  # one motion does not decide
    tilted = Misfit(2.6, everywhere(2.6).by_kind, everywhere(5.0).by_kind)
    assert rule([], tilted, 6, everywhere(28.0)).verdict == OUTSIDE_LIBRARY
    assert rule([dataclasses.replace(alone, error_before=2.6, error_after=1.2)], tilted, 6, everywhere(28.0)).uses


def test_what_a_candidate_explains_is_told_of_the_motions_on_which_it_was_judged():
    found = dataclasses.replace(evidence("backlash", statistic=2.0, after=2.0, before=20.0), reason="too uneven")
    calm = rule([found], everywhere(20.0), 6, everywhere(28.0), unseen=2.2)
    assert calm.verdict == OUTSIDE_LIBRARY
    hard = rule([found], everywhere(20.0), 6, everywhere(15.0), unseen=40.0)
    assert hard.verdict == CANNOT_TELL and "explains 95 % of the excess" in hard.statement


def test_errors_of_open_motions_are_said_to_be_held_out_in_turn():
    for ruling in (ruled(base_error=1.2), ruled(base_error=20.0), ruled(base_error=20.0, unfitted=5.0)):
        assert "on the motions held out in turn" in ruling.statement.lower()
    stuck = rule([], everywhere(6.0), 6, everywhere(28.0), base_converged=False)
    assert "errs by 6.0 times the noise floor on the motions held out in turn" in stuck.statement


def test_a_small_error_that_an_uncertain_candidate_would_mostly_explain_is_left_open():
    found = evidence("payload", statistic=2.5, after=1.5, before=2.6)
    assert (ruled(found, base_error=2.6).verdict, ruled(found, base_error=2.6).uses) == (CANNOT_TELL, ("payload",))
    by_chance = dataclasses.replace(found, statistic=1.4)
    assert ruled(by_chance, base_error=2.6).verdict == NOTHING_MISSING
    assert ruled(by_chance, base_error=2.6, kinds=4).verdict == CANNOT_TELL  # no rate of false alarms is claimed
    unsized = dataclasses.replace(found, parameters=UNSIZED)
    assert ruled(unsized, base_error=2.6).verdict == CANNOT_TELL
    assert ruled(dataclasses.replace(unsized, error_after=2.2), base_error=2.6).verdict == NOTHING_MISSING
    assert ruled(dataclasses.replace(unsized, error_after=1.1), base_error=1.4).verdict == NOTHING_MISSING


def test_a_candidate_that_passes_all_but_the_search_is_left_open_however_little_it_explains():
    found = evidence("payload", statistic=2.5, after=2.2, before=2.6)
    ruling = ruled(found, base_error=2.6)
    assert (ruling.verdict, ruling.uses) == (CANNOT_TELL, ("payload",))
    assert "payload explains 25 % of the excess, but is not certain" in ruling.statement
    calm = ruled(dataclasses.replace(found, error_before=1.2, error_after=1.1), base_error=1.2)
    assert calm.verdict == CANNOT_TELL and "payload is not certain" in calm.statement
    for fault in ({"statistic": 1.0}, {"parameters": UNSIZED}, {"converged": False}, {"error_after": 2.55}):
        assert ruled(dataclasses.replace(found, **fault), base_error=2.6).verdict == NOTHING_MISSING


def test_one_kind_of_motion_tells_nothing():
    assert ruled(evidence("backlash", gains=(40.0,)), kinds=1).verdict == CANNOT_TELL
    assert "no candidate was tried" not in ruled(evidence("backlash", gains=(40.0,)), kinds=1).statement
    assert "no candidate was tried" in ruled(kinds=1).statement


def test_a_candidate_that_predicts_better_but_less_evenly_is_named_beside_the_one_accepted():
    uneven = evidence("backlash", [2 * g for g in GAINS], statistic=1.9, after=1.4)
    ruling = ruled(evidence("link_flexibility", after=2.0), uneven)
    assert ruling.verdict == CANNOT_TELL and set(ruling.uses) == {"link_flexibility", "backlash"}


def test_sealed_motions_that_contradict_the_others_leave_the_verdict_open():
    found = evidence("joint_offset:lm_coxa", after=4.8, before=2.5, held_out=(2.5, 1.8))
    ruling = ruled(found, base_error=2.5)
    assert (ruling.verdict, ruling.uses) == (CANNOT_TELL, ("joint_offset:lm_coxa",)) and "sealed" in ruling.statement
    neither = dataclasses.replace(found, held_out=(2.5, 2.45))
    assert ruled(neither, base_error=2.5).verdict == NOTHING_MISSING


def test_a_base_fit_that_did_not_converge_names_no_effect():
    (best,) = ranked([dataclasses.replace(evidence("backlash"), accepted=True)])
    ruling = rule([best], everywhere(6.0), 6, everywhere(28.0), base_converged=False)
    assert (ruling.verdict, ruling.uses) == (CANNOT_TELL, ("backlash",))
    assert "did not converge, and backlash may only make up for that" in ruling.statement
    assert rule([], everywhere(6.0), 6, everywhere(28.0), base_converged=False).verdict == CANNOT_TELL
    assert rule([], everywhere(1.2), 6, everywhere(28.0), base_converged=False).verdict == NOTHING_MISSING


@pytest.mark.parametrize(
    ("null", "unit", "told"), [(None, 0.0, True), (None, 0.5, False), (0.0, 0.0, False), (0.0, 1.0, True)]
)
def test_a_value_at_the_end_of_its_range_is_marked_unless_that_is_where_the_effect_vanishes(null, unit, told):
    parameter = Parameter("torque", "N m", 0.0, 2.0, nominal=0.5, null=null)
    assert at_bound(parameter, unit) is told


def test_the_json_says_whether_an_interval_leaves_the_null_value_out():
    assert ParameterEstimate("gap", "rad", 0.5, 0.4, 0.6, 0.0).to_json()["excludes_null"] is True
    assert ParameterEstimate("gap", "rad", 0.5, -0.1, 0.6, 0.0).to_json()["excludes_null"] is False
    assert ParameterEstimate("mass", "kg", 0.5, 0.4, 0.6, None).to_json()["excludes_null"] is None


@pytest.mark.parametrize(
    ("tried", "verdict", "told"),
    [
        (None, OUTSIDE_LIBRARY, "no effect of the library explains it"),
        (4, OUTSIDE_LIBRARY, "none of the 4 effects tried explains it"),
        (1, OUTSIDE_LIBRARY, "the one effect tried does not explain it"),
        (0, CANNOT_TELL, "no effect was tried"),
    ],
)
def test_of_effects_that_were_not_tried_nothing_is_said(tried, verdict, told):
    ruling = rule([], everywhere(20.0), 6, everywhere(28.0), tried=tried)
    assert (ruling.verdict, ruling.uses) == (verdict, ()) and told in ruling.statement


def test_a_small_share_explained_is_told_of_the_effects_that_were_tried():
    found = dataclasses.replace(evidence("backlash", after=18.0, before=20.0), accepted=True)
    whole, part = (rule([found], everywhere(20.0), 6, everywhere(28.0), tried=n).statement for n in (None, 2))
    assert "that the library does not hold" in whole and "that no effect tried explains" in part


def test_what_was_left_out_is_told_by_effect():
    left = ["payload", "joint_offset:a", "joint_offset:b", "weak_leg:lf"]
    assert left_out(left, ["weak_leg:rf", "backlash"]) == ["Not tried: payload, joint_offset, weak_leg at 1 place."]
    assert left_out([], ["backlash"]) == []


def test_an_interval_that_ends_with_the_range_is_said_to_be_cut_off_but_not_where_the_effect_vanishes():
    torque = Parameter("torque", "N m", 0.0, 0.15, 0.05, null=0.0)
    cut = estimate(torque, 0.8, 0.6, 1.0)
    assert cut.cut_off and not cut.at_bound and (cut.low90, cut.high90) == pytest.approx((0.09, 0.15))
    assert not estimate(torque, 0.2, 0.0, 0.4).cut_off
    stopped = estimate(torque, 1.0, 0.9, 1.0)
    assert stopped.at_bound and not stopped.cut_off


@pytest.mark.parametrize(
    ("null", "unit", "words"),
    [(0.0, 1.0, "the effect may be larger"), (None, 0.0, "its value may be smaller"), (None, 1.0, "may be larger")],
)
def test_of_a_value_that_stopped_at_an_end_it_is_said_which_way_it_may_go_on(null, unit, words):
    depth = Parameter("depth", "rad", 0.0, 0.15, 0.05, null=null)
    interval = (max(unit - 0.1, 0.0), min(unit + 0.1, 1.0))
    base, named = evidence(""), evidence("backlash", parameters=(estimate(depth, unit, *interval),))
    (line,) = bounds(base, [named])
    assert line.endswith(f"{words}.") and "its interval is one-sided" in line


def test_a_base_parameter_at_its_end_is_told_as_of_the_model_without_the_effects_that_a_verdict_names():
    gain = Parameter("gain", "N m/rad", 2.0, 12.0, 5.0)
    base = evidence("", parameters=(estimate(gain, 1.0, 0.9, 1.0),))
    (beside,) = bounds(base, [evidence("backlash")])
    (alone,) = bounds(base, [])
    assert beside == f"Without an effect, {alone}" and alone.startswith("gain stopped at an end")


def test_what_the_unfitted_model_does_better_passes_not_every_test_but_one():
    sealed = evidence("backlash", after=3.1, before=3.0, held_out=(3.0, 1.5))
    assert accept(sealed, 3.0, 9.0) == (False, CONTRADICTED)
    accepted, why = accept(sealed, 3.0, 1.0)
    assert not accepted and "the model as it was" in why
