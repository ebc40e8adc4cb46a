"""What the page tells of a version: the same numbers in every table, and the prior by its name."""

import dataclasses
import json

import numpy as np
import pytest

from tcbi_dashboard import versions
from tcbi_infer.tcbi import channels
from tcbi_sim.model import base_model
from tcbi_sim.store import ModelStore

V0, V1, V2 = (f"servo_bench-v{n}" for n in range(3))
FEW = f"{channels.SILENT}: contact_ratio/left_front"  # a warning as an inference words it


def narrowed(model, share):
    """The particles of a model, nearer to their middle."""
    return model.from_unit(0.5 + share * (model.to_unit(model.particles) - 0.5))


@pytest.fixture
def store(tmp_path):
    """A version from a diagnosis, and one inferred from there on."""
    store = ModelStore(tmp_path)
    base = base_model("servo_bench")
    fitted = store.save(
        base.with_particles(narrowed(base, 0.3), kind="diagnosis", use="", rollouts=["a", "b"], accepted=True)
    )
    weights = np.random.default_rng(1).normal(0, 1, len(fitted.particles))
    told = [
        {"name": n, "mean": float(i + 1), "variance_ratio": ratio, "identified": identified}
        for i, (n, ratio, identified) in enumerate(
            zip(base.names, [0.1, 0.27, *[0.9] * len(base.names)], [True, *[False] * len(base.names)], strict=False)
        )
    ]
    store.save(
        fitted.with_particles(
            narrowed(base, 0.2),
            weights,
            inference={
                "method": "calibrated", "rollouts": ["c"], "ess": 25.6, "parameters": told, "prior": V1, "fits": True,
                "warnings": ["more could be learnt: with 26 effective particles", "closed loop: balance", FEW],
            },
        )
    )  # fmt: skip
    return store


@pytest.mark.parametrize("version", [V0, V1, V2])
def test_both_tables_show_the_same_interval_of_a_version(store, version):
    told = {p["name"]: [p["mean"], p["low90"], p["high90"]] for p in versions.posterior(store, version)["parameters"]}
    beside = {p["name"]: p["after"] for p in versions.difference(store, V0, version)["parameters"]}
    assert told == beside


def test_two_servers_show_the_same_numbers(store):
    assert versions.posterior(store, V2) == versions.posterior(ModelStore(store.root), V2)


def test_an_inference_names_its_prior_and_says_what_could_be_learnt(store):
    found = versions.posterior(store, V2)
    assert f"its prior is what {V1} says" in found["origin"]
    assert found["notes"] == ["more could be learnt: with 26 effective particles"]
    assert found["technical"] == ["closed loop: balance", FEW]


@pytest.mark.parametrize(("fits", "why"), [(None, "the search was too short"), (False, "the model fits poorly")])
def test_an_inference_says_why_no_parameter_is_called_told(store, fits, why):
    model = store.load(V2)
    inference = {**model.evidence["inference"], "fits": fits}
    told = versions.origin(dataclasses.replace(model, evidence={**model.evidence, "inference": inference}))
    assert f"No parameter counts as identified, since {why}" in told


def test_a_parameter_is_told_only_where_the_inference_is_sure_and_much_narrower_is_not_called_little(store):
    tells = [p["tells"] for p in versions.posterior(store, V2)["parameters"]]
    assert tells[0] == "yes: variance 10% of its prior's"
    assert tells[1] == "not surely: variance 27% of its prior's"
    assert all(t.startswith("little: ") for t in tells[2:])


def test_a_fitted_version_is_set_beside_its_parent_as_the_other_table_does(store):
    ratios = {p["name"]: p["width_ratio"] for p in versions.difference(store, V0, V1)["parameters"]}
    for p in versions.posterior(store, V1)["parameters"]:
        assert p["tells"] == f"fitted; interval {ratios[p['name']]:.0%} as wide as in {V0}"


def test_generations_that_a_version_does_not_hold_are_those_of_the_run_that_ended_with_it(store):
    assert versions.posterior(store, V2)["generations"] is None
    means = [p["mean"] for p in store.load(V2).evidence["inference"]["parameters"]]
    for name, last in (("other", [9.0] * len(means)), ("this", means)):
        rows = [
            {"generation": g, "mean": m, "variance": [0.04] * len(means)}
            for g, m in ((1, [0.5] * len(means)), (2, last))
        ]
        place = store.folder(f"runs/infer-calibrated-{name}") / "generations.json"
        place.write_text(json.dumps(rows))
    found = versions.posterior(store, V2)["generations"]
    name = store.load(V2).names[0]
    assert found["number"] == [1, 2]
    assert found["mean"][name] == [0.5, means[0]] and found["sd"][name] == [0.2, 0.2]
