"""Policies as files: equal to torch, refused by name of what differs, nothing pickled."""

import dataclasses
import hashlib
import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import torch

from tcbi_policy.artefact import Card, Policy, find_policy, load_policy, policy_paths, save_policy
from tcbi_policy.environment import HexapodVectorEnv
from tcbi_policy.errors import PolicyDamaged, PolicyError, PolicyMisfit, PolicyNotFound
from tcbi_policy.layout import HEXAPOD, Layout, robot_layout
from tcbi_policy.mlp import Mlp
from tcbi_sim.model import base_model


def network(seed: int = 0, sizes: tuple[int, ...] = (21, 256, 256, 18)) -> Mlp:
    rng = np.random.default_rng(seed)
    pairs = list(pairwise(sizes))
    weights = tuple(rng.normal(size=(b, a)) / np.sqrt(a) for a, b in pairs)
    return Mlp(weights, tuple(rng.normal(size=b) * 0.1 for _, b in pairs), np.full(sizes[0], 2.0), HEXAPOD.limit)


def saved(folder: Path, **changes: object) -> Path:
    card = Card(**{"name": "level", "task": "balance", **changes})  # type: ignore[arg-type]
    path = save_policy(folder / "level", network(), card).path
    assert path is not None
    return path


def torch_targets(mlp: Mlp, observation: np.ndarray, precision: torch.dtype = torch.float32) -> np.ndarray:
    """What the same network gives in torch."""
    layers: list[torch.nn.Module] = []
    for w, b in zip(mlp.weights, mlp.biases, strict=True):
        linear = torch.nn.Linear(w.shape[1], w.shape[0], dtype=precision)
        with torch.no_grad():
            linear.weight.copy_(torch.as_tensor(w))
            linear.bias.copy_(torch.as_tensor(b))
        layers += [linear, torch.nn.Tanh()]
    scaled = torch.as_tensor(observation * mlp.observation_scale, dtype=precision)
    with torch.no_grad():
        return np.asarray(mlp.limit * torch.nn.Sequential(*layers)(scaled).numpy())


def test_numpy_equals_torch_to_a_millionth(tmp_path: Path) -> None:
    mlp = load_policy(saved(tmp_path)).mlp
    observation = np.random.default_rng(1).normal(0, 0.3, (100, 21))
    np.testing.assert_allclose(mlp(observation), torch_targets(mlp, observation), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["balance-early", "balance", "forward-early", "forward"])
def test_numpy_equals_torch_on_what_a_shipped_policy_meets(name: str) -> None:
    policy = find_policy(name)
    assert isinstance(policy, Policy)
    environment = HexapodVectorEnv(base_model("hexapod"), policy.card.task, 16, 5)
    observation, _ = environment.reset()
    for _ in range(25):
        target = policy.act(0.0, observation)
        np.testing.assert_allclose(target, torch_targets(policy.mlp, observation), rtol=0, atol=1e-6)
        observation, *_ = environment.step(target / environment.limit)


@pytest.mark.parametrize("name", ["balance-early", "balance", "forward-early", "forward"])
def test_numpy_equals_torch_at_any_angle_but_for_torch_s_single_precision(name: str) -> None:
    policy = find_policy(name)
    assert isinstance(policy, Policy)
    observation = np.random.default_rng(2).uniform(-np.pi, np.pi, (500, 21))
    target = policy.act(0.0, observation)
    np.testing.assert_allclose(target, torch_targets(policy.mlp, observation, torch.float64), rtol=0, atol=1e-12)
    np.testing.assert_allclose(target, torch_targets(policy.mlp, observation), rtol=0, atol=3e-6)


def test_targets_stay_within_the_joint_range() -> None:
    targets = network()(np.random.default_rng(0).normal(0, 100, (50, 21)))
    assert np.abs(targets).max() <= HEXAPOD.limit


@pytest.mark.parametrize("size", [1, 5, 31, 33, 64])
def test_no_bit_of_a_target_depends_on_how_many_others_are_asked_for(size: int) -> None:
    mlp, observation = network(), np.random.default_rng(1).normal(0, 0.3, (100, 21))
    parts = [mlp(observation[i : i + size]) for i in range(0, 100, size)]
    assert np.array_equal(np.concatenate(parts), mlp(observation))
    assert np.array_equal(mlp(observation[7]), mlp(observation)[7]), "nor on the axes"


def test_what_is_saved_is_what_is_loaded(tmp_path: Path) -> None:
    path = saved(tmp_path, model="hexapod-v3", curve=[{"steps": 1.0, "mean_return": 2.0}])
    policy = load_policy(path)
    assert policy.card.model == "hexapod-v3" and policy.card.curve == [{"steps": 1.0, "mean_return": 2.0}]
    assert policy.policy_id == f"level@{policy.card.sha256[:8]}"
    observation = np.ones((3, 21)) * 0.1
    np.testing.assert_allclose(policy.act(0.0, observation), network()(observation), atol=1e-6)


@pytest.mark.parametrize(
    ("robot", "says"),
    [
        (robot_layout((*HEXAPOD.action[:-1], "rr_wheel")), "needs rr_tibia.*lacks rr_wheel"),
        (robot_layout((HEXAPOD.action[1], HEXAPOD.action[0], *HEXAPOD.action[2:])), "order differs from entry 0"),
        (robot_layout(rate_hz=10.0), "control rate is 5 Hz, the robot's is 10 Hz"),
        (robot_layout(limit=0.3), r"joint range is \+-0.5236 rad, the robot's is \+-0.3000 rad"),
        (dataclasses.replace(HEXAPOD, unit="deg"), "unit is rad, the robot's is deg"),
    ],
)
def test_a_policy_for_another_robot_is_refused_by_what_differs_and_what_to_do(
    tmp_path: Path, robot: Layout, says: str
) -> None:
    with pytest.raises(PolicyMisfit, match=rf"{says}.*; take one that was trained for this robot .*\./tcbi train"):
        load_policy(saved(tmp_path), robot)


def test_a_gait_is_for_the_hexapod_alone() -> None:
    with pytest.raises(PolicyMisfit, match=r"gait:tripod does not fit this robot: .*lacks servo, which the robot has"):
        find_policy("gait:tripod", robot=robot_layout(("servo",)))


def test_weights_of_another_card_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path)
    save_policy(tmp_path / "other", network(seed=5), Card("other", "balance"))
    path.write_bytes((tmp_path / "other.safetensors").read_bytes())
    with pytest.raises(PolicyDamaged, match="not those that the card describes"):
        load_policy(path)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        *((text, "copy both files again") for text in ("{}", "not json", "[]", "[" * 100_000)),
        ("[1]", "got .*, allowed is an object of entries"),
        ('{"format": 1, "hello": 2}', "its card has entries that none has: hello"),
        (
            '{"format": 99}',
            r"card\.format: got 99, allowed is 1; another version of tcbi wrote it: use that one, or",
        ),
    ],
)
def test_a_damaged_card_is_named_with_what_to_do(tmp_path: Path, damage: str, says: str) -> None:
    path = saved(tmp_path)
    path.with_suffix(".json").write_text(damage)
    with pytest.raises(PolicyDamaged, match=rf"level\.safetensors: .*{says}"):
        load_policy(path)


def test_a_result_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path)
    card = json.loads(path.with_suffix(".json").read_text())
    card["training"]["mean_return"] = "abc"
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(PolicyDamaged, match=r"card\.training\.mean_return: got 'abc', allowed is a finite number"):
        load_policy(path)


def test_a_card_or_a_folder_in_place_of_a_policy_is_named_as_that(tmp_path: Path) -> None:
    with pytest.raises(PolicyNotFound, match=r"level\.json is a card; name the policy beside it, .*level\.safetensors"):
        load_policy(saved(tmp_path).with_suffix(".json"))
    with pytest.raises(PolicyNotFound, match=r"is a folder; name a \.safetensors file"):
        load_policy(tmp_path)


def with_weights(folder: Path, data: bytes) -> Path:
    """A policy with other weights, of which its card knows."""
    path = saved(folder)
    path.write_bytes(data)
    card = json.loads(path.with_suffix(".json").read_text())
    card["sha256"] = hashlib.sha256(data).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card))
    return path


def test_scales_that_are_not_finite_and_arrays_of_a_type_that_numpy_lacks_are_refused(tmp_path: Path) -> None:
    arrays = network().tensors()
    arrays["observation_scale"] = np.full_like(arrays["observation_scale"], np.nan)
    with pytest.raises(PolicyDamaged, match=r"observation_scale .* not finite"):
        load_policy(with_weights(tmp_path, safetensors.numpy.save(arrays)))
    header = b'{"layer0.weight":{"dtype":"BF16","shape":[1],"data_offsets":[0,2]}}'
    with pytest.raises(PolicyDamaged, match="cannot be read"):
        load_policy(with_weights(tmp_path, len(header).to_bytes(8, "little") + header + b"\0\0"))


def rewritten(folder: Path, part: str, **entries: object) -> Path:
    """A policy whose card holds other entries: in its `layout`, its `training`, or ("") itself."""
    path = saved(folder)
    card = json.loads(path.with_suffix(".json").read_text())
    (card[part] if part else card).update(entries)
    path.with_suffix(".json").write_text(json.dumps(card))
    return path


@pytest.mark.parametrize(
    ("part", "entry", "value"),
    [
        *(("layout", entry, value) for entry in ("limit", "rate_hz") for value in (
            None, "0.5", True, float("nan"), float("inf"), 0.0, -0.5
        )),
        *(("layout", entry, value) for entry in ("observation", "action") for value in (
            None, "roll", [1], [["roll"]], ["roll", "roll"]
        )),
        pytest.param("layout", "limit", 10**400, id="layout-limit-beyond every float"),
        ("layout", "unit", None),
        *(("", entry, 7) for entry in ("name", "task", "layout", "model", "parent", "created", "sha256")),
        *(("", entry, None) for entry in ("layout", "posterior", "training", "curve", "libraries")),
        *(("training", "effects", value) for value in (None, "wind", [None])),
        *(("training", entry, value) for entry in ("observation_noise", "effect_share") for value in (
            None, "0.1", float("nan")
        )),
    ],
)  # fmt: skip
def test_a_card_whose_entry_cannot_be_is_refused_in_one_line(
    tmp_path: Path, part: str, entry: str, value: object
) -> None:
    with pytest.raises(PolicyDamaged) as refused:
        load_policy(rewritten(tmp_path, part, **{entry: value}))
    said = str(refused.value)
    assert f"level.safetensors: card.{f'{part}.' if part else ''}{entry}: got " in said
    assert "allowed is" in said and "\n" not in said


def test_all_faults_of_a_card_are_named_at_once(tmp_path: Path) -> None:
    with pytest.raises(PolicyDamaged, match=r"card\.layout\.limit: got None.*; card\.layout\.unit: got 3.*; copy both"):
        load_policy(rewritten(tmp_path, "layout", limit=None, unit=3))


@pytest.mark.parametrize("name", ["", ".", "..", "../../x", "/x", "a/b", "a/", "a\n", "a\0", "\ud800"])
def test_a_policy_whose_name_is_no_plain_file_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(PolicyDamaged, match=r"card\.name: got .*, allowed is a plain file name"):
        load_policy(rewritten(tmp_path, "", name=name))


@pytest.mark.parametrize("name", ["balance-1", "v1.2", "my policy", "läuft"])
def test_a_plain_file_name_is_a_policys_name(tmp_path: Path, name: str) -> None:
    assert load_policy(rewritten(tmp_path, "", name=name)).card.name == name


def test_the_folder_of_an_unknown_user_holds_no_policy() -> None:
    with pytest.raises(PolicyNotFound, match=r"~nouser/x\.safetensors does not exist"):
        find_policy("~nouser/x.safetensors")


@pytest.mark.parametrize("step", ["is_file", "read_bytes", "read_text"])
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    path = saved(tmp_path)

    def denied(self: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, step, denied)
    with pytest.raises(PolicyError, match=r"level\.safetensors: .*Permission denied"):
        load_policy(path)


@pytest.mark.parametrize("name", ["observation_scale", "layer0.weight", "layer2.bias"])
def test_an_array_without_axes_is_refused(tmp_path: Path, name: str) -> None:
    tensors = network().tensors() | {name: np.zeros((), np.float32)}
    with pytest.raises(PolicyDamaged, match=r"layer [02] has shapes"):
        Mlp.from_tensors(tensors, HEXAPOD.limit)


def test_a_network_of_the_wrong_size_is_refused(tmp_path: Path) -> None:
    save_policy(tmp_path / "small", network(sizes=(20, 8, 18)), Card("small", "balance"))
    with pytest.raises(PolicyDamaged, match="maps 20 values to 18, its card says 21 to 18"):
        load_policy(tmp_path / "small.safetensors")


def test_a_pickle_is_never_loaded(tmp_path: Path) -> None:
    path = saved(tmp_path)
    torch.save({"layer0.weight": torch.zeros(1)}, path)
    card = json.loads(path.with_suffix(".json").read_text())
    import hashlib

    card["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(PolicyDamaged):
        load_policy(path)


def test_unknown_names_are_answered_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(PolicyNotFound, match="tripod"):
        find_policy("gait:moonwalk")
    with pytest.raises(PolicyNotFound, match="balance"):
        find_policy("balnce", tmp_path)
    with pytest.raises(PolicyNotFound, match="json card"):
        find_policy(str(tmp_path / "no.safetensors"))


def test_a_policy_in_the_store_hides_the_shipped_one(tmp_path: Path) -> None:
    save_policy(tmp_path / "policies" / "balance", network(), Card("balance", "balance"))
    assert policy_paths(tmp_path)["balance"].is_relative_to(tmp_path)
    assert not policy_paths(None)["balance"].is_relative_to(tmp_path)


@pytest.mark.parametrize("name", ["balance", "forward"])
def test_shipped_policies_load_and_fit(name: str) -> None:
    policy = find_policy(name)
    assert policy.policy_id.startswith(f"{name}@")
    assert [w.shape for w in policy.mlp.weights] == [(256, 21), (256, 256), (18, 256)]  # type: ignore[union-attr]


def test_a_robot_needs_no_torch_to_act() -> None:
    code = (
        "import sys, numpy as np\n"
        "from tcbi_policy.artefact import find_policy\n"
        "print(find_policy('balance').act(0.0, np.zeros((1, 21))).shape, 'torch' in sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True).stdout
    assert said.split("\n")[0] == "(1, 18) False"
