"""A model version's own distribution as the prior of the next inference."""

import dataclasses

import numpy as np
import pytest
from tcbi_cases import bench_rollouts

from tcbi_infer import posterior
from tcbi_infer.errors import InferError
from tcbi_infer.report.inference import identifiability
from tcbi_infer.seen import used_before
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.method import METHODS
from tcbi_infer.tcbi.prior import MODEL, NO_WIDTH, Prior
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.result import estimates
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import Model, base_model


def narrow(rollouts: tuple[str, ...] = ()) -> Model:
    model = base_model("servo_bench")
    rng = np.random.default_rng(0)
    unit = np.clip(rng.normal([0.5, 0.4, 0.6], [0.02, 0.05, 0.1], (400, 3)), 0.01, 0.99)
    return model.with_particles(model.from_unit(unit), rollouts=list(rollouts))


def rollouts() -> list[Measurement]:
    model = base_model("servo_bench")
    commands = Commands(np.arange(20) * 0.1, np.random.default_rng(1).uniform(-1, 1, (20, 1)), 0.1)
    out = simulate(model, model.sample(np.random.default_rng(2), 4), [Scenario("bench", 2.0)], commands=[commands])
    found = []
    for n in range(4):
        m = out.measurement(n, rollout_id=f"run-{n}")
        found.append(dataclasses.replace(m, commands=commands))
    return found


def test_the_cubes_uniform_distribution_becomes_the_models_own():
    model = narrow()
    cube = np.random.default_rng(3).random((20000, 3))
    unit = Prior.of(model).unit(cube)
    own = model.to_unit(model.particles)
    np.testing.assert_allclose(unit.mean(axis=0), own.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(unit.std(axis=0), own.std(axis=0), rtol=0.1)


def test_rollouts_that_made_the_model_do_not_count_twice():
    measurements = rollouts()
    model = narrow((measurements[2].rollout_id,))
    assert used_before(model) == {"run-2"}
    with pytest.raises(InferError, match="run-2"):
        Problem.of(model, measurements, prior=MODEL)


def inferred(model: Model, measurements: list[Measurement], prior: str = "flat") -> Model:
    """What an inference that takes no time makes of a model."""
    return infer(Problem.of(model, measurements, prior=prior), "prior").updated_model()


def test_rollouts_that_particles_kept_beside_a_new_effect_have_seen_do_not_count_twice():
    first = inferred(base_model("servo_bench"), rollouts())
    child = first.with_effect("command_latency").with_effect("rotor_inertia")
    assert used_before(child) == used_before(first) != set()
    with pytest.raises(InferError, match="run-0"):
        Problem.of(child, rollouts(), prior=MODEL)
    assert not {"kind", "inference", "rollouts", "errors"} & set(child.evidence), "it is no fit of the child"
    assert used_before(child.without_effect("rotor_inertia")) == used_before(first)


def test_rollouts_that_made_the_prior_of_a_version_do_not_count_twice():
    a = rollouts()
    b = [dataclasses.replace(m, rollout_id=f"later-{m.rollout_id}") for m in a]
    second = inferred(inferred(base_model("servo_bench"), a), b, MODEL)
    assert second.evidence["inference"]["rollouts"] == [m.rollout_id for m in b]
    with pytest.raises(InferError, match="run-0"):
        Problem.of(second, a, prior=MODEL)
    anew = inferred(inferred(base_model("servo_bench"), a), b)
    assert used_before(anew) == {m.rollout_id for m in b}, "a flat prior has seen nothing"


def made_by(method: str, model: Model | None = None, **told) -> Model:
    model = model or narrow()
    return dataclasses.replace(model, evidence={"inference": {"method": method, "rollouts": ["old"], **told}})


def test_a_prior_whose_width_means_little_is_told_by_the_method_that_made_it():
    def said(model: Model) -> str:
        return " ".join(Problem.of(model, rollouts(), prior=MODEL).warnings)

    assert "the method simopt left" in said(made_by("simopt"))
    assert "the method simopt left" in said(made_by("simopt").with_effect("command_latency"))
    assert "did not fit the rollouts" in said(made_by("calibrated", fits=False))
    assert "the prior" not in said(made_by("calibrated", fits=True))
    few = narrow()
    few = few.with_particles(few.particles[:5])
    assert "5 effective particles" in said(made_by("calibrated", few))


def test_a_method_says_what_the_data_leave_open_or_has_no_width_to_go_on_from():
    assert {name for name, method in METHODS.items() if not method.judges} == {*NO_WIDTH, "prior", "npe"}


def test_a_version_that_is_one_point_is_refused_as_a_prior():
    model = narrow()
    with pytest.raises(InferError, match="bayesopt made it"):
        Problem.of(made_by("bayesopt", model.with_particles(model.particles[:1])), rollouts(), prior=MODEL)


def test_what_excludes_the_data_is_the_versions_prior_and_the_parameter_and_value_are_named():
    _, measured = bench_rollouts((0.65, 0.4, 0.6))  # narrow() expects a gain of 0.5 +- 0.02
    result = infer(Problem.of(narrow(), measured, prior=MODEL), particles=40, generations=6)
    line = next(line for line in result.warnings if line.startswith("the prior of gain seems to exclude the data"))
    assert "where the prior expects" in line and result.fits is False
    best = np.array(result.generations[-1]["best"])
    assert np.all((best[:, 0] > 0.53) & (best[:, 0] < 0.66)), "in the parameters' unit cube"


def test_an_unknown_prior_is_refused_by_name():
    with pytest.raises(InferError, match="jeffreys"):
        Problem.of(narrow(), rollouts(), prior="jeffreys")


def test_the_flat_prior_leaves_the_cube_alone():
    problem = Problem.of(narrow(), rollouts())
    cube = np.random.default_rng(0).random((5, 3))
    np.testing.assert_array_equal(problem.unit(cube), cube)


def diagnosed() -> Model:
    model = narrow()
    return dataclasses.replace(model, evidence={"kind": "diagnosis", "rollouts": []})


def test_after_a_diagnosis_the_prior_is_twice_as_wide_and_that_is_said():
    plain, wider = Prior.of(narrow()), Prior.of(diagnosed())
    np.testing.assert_array_equal(wider.means, plain.means)
    np.testing.assert_allclose(wider.root @ wider.root.T, 4 * plain.root @ plain.root.T, rtol=1e-6)
    problem = Problem.of(diagnosed(), rollouts(), prior=MODEL)
    assert any("2 times as wide as the diagnosis left it" in line for line in problem.warnings)


def test_the_posteriors_file_holds_the_prior_that_was_used():
    result = infer(Problem.of(diagnosed(), rollouts(), prior=MODEL), "prior")
    tree = posterior.dataset(result)
    gain = result.model.parameters[0]
    unit = gain.to_unit(tree["prior"]["gain"].values)
    assert unit.std() < 0.1  # the flat prior's is 0.29
    assert tree["posterior"]["gain"].shape == (1, posterior.DRAWS)


def test_a_doubled_prior_is_nowhere_wider_than_the_flat_one():
    model = base_model("servo_bench")
    vague = dataclasses.replace(model, evidence={"kind": "diagnosis"})
    root = Prior.of(vague).root
    assert np.linalg.eigvalsh(root @ root.T).max() <= 1 + 1e-9


def test_what_the_prior_knew_already_is_not_what_the_data_tell():
    """Particles drawn from a narrow prior: variance a tenth of the flat prior's, and none less than the prior's own."""
    prior = Prior.of(narrow())
    unit = prior.unit(np.random.default_rng(4).random((500, 3)))
    parameters, equal = narrow().parameters, np.zeros(500)
    assert any(e.identified for e in estimates(parameters, unit, equal))
    against = estimates(parameters, unit, equal, prior=prior.draws())
    assert not any(e.identified for e in against)
    assert all(e.variance_ratio == pytest.approx(1.0, abs=0.25) for e in against)


def test_a_parameter_that_is_not_told_says_what_stands_in_the_way():
    """Nothing new beside a version's prior, nothing beside a flat one, or too few particles to be sure."""
    method = METHODS["calibrated"]
    parameters, equal = narrow().parameters, np.zeros(12)
    problem = Problem.of(narrow(), rollouts(), prior=MODEL, timestep=0.01)
    result = dataclasses.replace(infer(problem, "prior"), fits=True, ess=12.0)
    unit = Prior.of(narrow()).unit(np.random.default_rng(4).random((12, 3)))
    (e, *_) = estimates(parameters, unit, equal, prior=result.prior)
    said = identifiability(dataclasses.replace(e, variance_ratio=1.0), result, method)
    assert said == f"little beyond {narrow().version}'s"
    flat = dataclasses.replace(result, prior=None)
    assert identifiability(dataclasses.replace(e, variance_ratio=1.0), flat, method) == "no: little more than the prior"
    unsure = dataclasses.replace(e, variance_ratio=0.4)
    assert identifiability(unsure, flat, method) == "not surely"
    assert identifiability(dataclasses.replace(unsure, identified=True), flat, method) == "yes"
    rests_on = dataclasses.replace(result, model=made_by("calibrated", fits=False))
    assert identifiability(unsure, rests_on, method) == "not identified: the prior is doubtful"


def test_variances_over_the_generations_are_compared_with_the_prior_that_was_used():
    result = infer(Problem.of(narrow(), rollouts(), prior=MODEL, timestep=0.01), "paper", particles=20, generations=2)
    expected = np.exp(result.log_weights) @ (result.unit - np.exp(result.log_weights) @ result.unit) ** 2
    assert result.prior is not None
    assert result.generations[-1]["variance_ratio"] == pytest.approx(expected / result.prior.var(axis=0))
    assert result.generations[-1]["variance_ratio"] == pytest.approx([e.variance_ratio for e in result.estimates])
