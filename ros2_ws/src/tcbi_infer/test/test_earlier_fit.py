"""What a node that starts again finds of its earlier life: the newest fit of its line, and the posterior as it was."""

from pathlib import Path

import pytest
from tcbi_cases import bench_rollouts

from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.earlier_fit import newest_fit, posterior_of
from tcbi_infer.inference_worker import INFER, Job, run_inference
from tcbi_infer.rollout_folder import RolloutFolder
from tcbi_sim.model import base_model
from tcbi_sim.store import ModelStore

BASE = base_model("servo_bench")


def test_the_posterior_of_a_saved_version_is_that_which_was_published(tmp_path: Path) -> None:
    bags = [str(write_measurement(tmp_path / "bags", m)) for m in bench_rollouts(count=4, duration=2.0)[1]]
    events: list[tuple[str, dict]] = []
    asked = Job(INFER, str(tmp_path), BASE.version, tuple(bags), particles=20, generations=2)
    run_inference(asked, lambda event, **content: events.append((event, content)))
    (published,) = (content for kind, content in events if kind == "posterior")
    store = ModelStore(tmp_path)
    version = newest_fit(store, BASE, "calibrated")
    assert version is not None and version.version == published["model"]
    found = posterior_of(store, version)
    drawn = ("particles", "prior_variance")
    assert set(found) == set(published) - {"moved", "warnings"}
    assert {k: v for k, v in found.items() if k not in drawn} == {k: published[k] for k in found if k not in drawn}
    assert found["prior_variance"] == pytest.approx(published["prior_variance"], rel=0.2)
    assert len(found["particles"]) == len(published["particles"])
    folder = RolloutFolder(tmp_path / "bags", 0)
    folder.look()
    assert folder.holding(found["source_rollouts"]) == set(folder.bags)


def test_the_newest_fit_is_of_the_same_method_and_line_and_has_the_same_effects(tmp_path: Path) -> None:
    store = ModelStore(tmp_path)

    def fitted(parent: str, method: str = "calibrated", effect: str = "") -> str:
        model = store.load(parent)
        model = store.save(model.with_effect(effect)) if effect else model
        child = model.with_particles(model.particles, model.log_weights, inference={"method": method})
        return store.save(child).version

    assert newest_fit(store, BASE, "calibrated") is None
    first = fitted(BASE.version)
    second = fitted(first)
    fitted(second, method="paper")
    other = fitted(second, effect="command_latency")
    assert newest_fit(store, BASE, "calibrated").version == second
    assert newest_fit(store, store.load(first), "calibrated").version == second
    assert newest_fit(store, store.load(other), "calibrated").version == other
    assert newest_fit(store, store.load(other), "paper") is None


def test_a_version_that_was_not_saved_whole_is_told_from_others(tmp_path: Path) -> None:
    child = BASE.with_particles(BASE.particles, BASE.log_weights, inference={"method": "paper", "parameters": []})
    store = ModelStore(tmp_path)
    with pytest.raises((OSError, KeyError)):
        posterior_of(store, store.save(child))
