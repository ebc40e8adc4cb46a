"""Policies as files: `NAME.safetensors` holds the arrays, `NAME.json` the card. Nothing pickled is ever loaded.

save_policy(folder / "balance", mlp, card)
policy = load_policy(folder / "balance.safetensors")
policy.act(0.0, observation)                 # a Controller for the simulation, and what the policy node runs
find_policy("gait:stand")                    # or a file, a name in the store, or a shipped name
"""

import contextlib
import dataclasses
import fcntl
import hashlib
import itertools
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from tcbi_contract.errors import describe
from tcbi_contract.files import replace_file
from tcbi_policy.entries import FILE_NAME, LIST, NAMES, NUMBER, NUMBER_OR_NONE, OBJECT, TEXT, faults
from tcbi_policy.errors import PolicyDamaged, PolicyError, PolicyNotFound
from tcbi_policy.gaits import GAITS, Gait
from tcbi_policy.layout import ENTRIES as LAYOUT_ENTRIES
from tcbi_policy.layout import HEXAPOD, Layout, check_fit
from tcbi_policy.mlp import Mlp

CARD_FORMAT = 1
CARD_ENTRIES = {
    "name": FILE_NAME,  # under which the policy may be kept in a store
    **dict.fromkeys(("task", "model", "parent", "created", "sha256"), TEXT),
    **dict.fromkeys(("posterior", "libraries"), OBJECT),
    "curve": LIST,
}
TRAINING_ENTRIES = {
    **{"effects": NAMES, "effect_share": NUMBER, "observation_noise": NUMBER},  # what retraining takes over
    **dict.fromkeys(("mean_return", "steps_taken", "best_steps", "cpu_s"), NUMBER_OR_NONE),  # what is shown
}
SHIPPED = Path(__file__).parent / "policies"
GAIT_PREFIX = "gait:"
LOCK = ".lock"


class Actor(Protocol):
    """What the policy node and the simulation run: a trained policy or a scripted gait."""

    @property
    def policy_id(self) -> str:
        """Name and short hash, or `gait:<name>`."""

    @property
    def needs_attitude(self) -> bool:
        """Whether it cannot act without the attitude."""

    def reset(self, count: int, rng: np.random.Generator | None = None) -> None:
        """Start `count` rollouts."""

    def act(self, time: float, observation: np.ndarray) -> np.ndarray:
        """Joint targets (B, J) in rad at `time` (s since the start) for observations (B, J + 3) in rad."""


@dataclass(frozen=True)
class Card:
    """What a policy is, for people and for the check that it fits a robot."""

    name: str
    task: str
    layout: Layout = HEXAPOD
    model: str = ""  # the model version that it was trained on
    posterior: dict[str, Any] = field(default_factory=dict)  # mean and standard deviation of each parameter drawn
    training: dict[str, Any] = field(default_factory=dict)  # algorithm, configuration, seeds, steps, CPU seconds
    curve: list[dict[str, float]] = field(default_factory=list)  # evaluations: steps, mean_return, ...
    libraries: dict[str, str] = field(default_factory=dict)
    parent: str = ""  # id of the policy that the training started from
    created: str = ""  # UTC, ISO 8601
    sha256: str = ""  # of the safetensors file

    def to_json(self) -> str:
        """The card as it lies on disk."""
        return strict_json({"format": CARD_FORMAT, **dataclasses.asdict(self)}, indent=1) + "\n"

    @staticmethod
    def from_json(text: str) -> "Card":
        """Read a card.

        Raises:
          PolicyDamaged: it is not a card, of an unknown format, lacks an entry, or has some that cannot be (all named).
        """
        try:
            data = json.loads(text)
            if not isinstance(data, dict):
                raise PolicyDamaged(f"{describe('card', data, 'an object of entries')}; copy both files again")
            if (found := data.pop("format")) != CARD_FORMAT:
                remedy = "another version of tcbi wrote it: use that one, or train the policy again with this one"
                raise PolicyDamaged(describe("card.format", found, str(CARD_FORMAT), remedy))
            if strange := sorted(set(data) - {f.name for f in dataclasses.fields(Card)}):
                raise PolicyDamaged(f"its card has entries that none has: {', '.join(strange)}; copy both files again")
            wrong = [
                *faults(data, CARD_ENTRIES, "card"),
                *faults(data["layout"], LAYOUT_ENTRIES, "card.layout"),
                *faults(data.get("training", {}), TRAINING_ENTRIES, "card.training"),
            ]
            if wrong:
                raise PolicyDamaged(f"{'; '.join(wrong)}; copy both files again")
            return Card(**{**data, "layout": Layout.from_json(data["layout"])})
        except KeyError as e:
            raise PolicyDamaged(f"its card lacks {e}; copy both files again") from e
        except (ValueError, TypeError, AttributeError, RecursionError) as e:
            raise PolicyDamaged(f"its card is none ({e}); copy both files again") from e


@dataclass(frozen=True)
class Policy:
    """A trained policy: the network and its card."""

    mlp: Mlp
    card: Card
    path: Path | None = None
    needs_attitude: bool = True

    @property
    def policy_id(self) -> str:
        """Name and short hash, unique for these weights."""
        return f"{self.card.name}@{self.card.sha256[:8]}"

    def reset(self, count: int, rng: np.random.Generator | None = None) -> None:
        """The network has no state."""

    def act(self, time: float, observation: np.ndarray) -> np.ndarray:
        """Joint targets (B, J) in rad for observations (B, J + 3) in rad."""
        return self.mlp(observation)


def save_policy(stem: Path, mlp: Mlp, card: Card) -> Policy:
    """Write `stem.safetensors` and `stem.json`, each to a temporary name that is then renamed."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    data = save(mlp.tensors())
    card = dataclasses.replace(card, sha256=hashlib.sha256(data).hexdigest())
    path = stem.with_name(stem.name + ".safetensors")
    replace_file(path, data)
    replace_file(stem.with_name(stem.name + ".json"), card.to_json().encode())
    return Policy(Mlp.from_tensors(load(data), card.layout.limit), card, path)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make a folder, and keep other processes that ask for it out meanwhile; waits for the one that is in.

    A name chosen in here is still free, and the two files of a policy written in here belong together. The lock is the
    kernel's: it vanishes with its process, however that ends.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def strict_json(value: Any, indent: int | None = None) -> str:
    """A value as JSON, null for a number that is not finite."""
    return json.dumps(json.loads(json.dumps(value), parse_constant=lambda _: None), indent=indent, allow_nan=False)


def load_policy(path: Path, robot: Layout = HEXAPOD) -> Policy:
    """Read and check a policy.

    Raises:
      PolicyNotFound: there is no such file.
      PolicyDamaged: its card is missing, either cannot be read, or they do not belong together.
      PolicyMisfit: it is for another robot.
    """
    card_path = path.with_suffix(".json")
    try:
        if path.suffix == ".json" and path.with_suffix(".safetensors").is_file():
            raise PolicyNotFound(f"{path} is a card; name the policy beside it, {path.with_suffix('.safetensors')}")
        if path.is_dir():
            raise PolicyNotFound(f"{path} is a folder; name a .safetensors file, with its .json card beside it")
        if not path.is_file():
            raise PolicyNotFound(
                f"{path} does not exist; a policy is a .safetensors file with its .json card beside it"
            )
        if not card_path.is_file():
            raise PolicyDamaged(f"its card {card_path.name} is missing beside it; copy both files again")
        data = path.read_bytes()
        card = Card.from_json(card_path.read_text())
        if hashlib.sha256(data).hexdigest() != card.sha256:
            raise PolicyDamaged("the weights are not those that the card describes; copy both files again")
        check_fit(card.name, card.layout, robot)
        policy = Policy(Mlp.from_tensors(load(data), card.layout.limit), card, path)
        _check_shape(policy)
    except PolicyDamaged as e:
        raise PolicyDamaged(f"{path}: {e}") from e
    except OSError as e:
        raise PolicyDamaged(f"{path}: {e}; see that it and its card can be read") from e
    except (SafetensorError, UnicodeDecodeError) as e:
        raise PolicyDamaged(f"{path}: {e}; copy both files again") from e
    except (KeyError, TypeError, ValueError) as e:  # of the safetensors library, for a type that numpy has not
        raise PolicyDamaged(f"{path}: holds arrays that cannot be read ({e!r}); allowed is float32") from e
    return policy


def _check_shape(policy: Policy) -> None:
    layout, mlp = policy.card.layout, policy.mlp
    seen = (len(mlp.observation_scale), len(mlp.biases[-1]))
    expected = (len(layout.observation), len(layout.action))
    if seen != expected:
        raise PolicyDamaged(
            f"the network maps {seen[0]} values to {seen[1]}, its card says {expected[0]} to {expected[1]}; "
            "copy both files again"
        )


def load_all(paths: Mapping[str, Path]) -> tuple[dict[str, Policy], list[PolicyError]]:
    """Those of some policies that can be read, by name, and why the others cannot."""
    found: dict[str, Policy] = {}
    faults: list[PolicyError] = []
    for name, path in paths.items():
        try:
            found[name] = load_policy(path)
        except PolicyError as error:
            faults.append(error)
    return found, faults


def name_of(policy_id: str, store_root: Path) -> str:
    """The name under which a policy is shipped or kept in the store, "" if it is not."""
    paths, own = policy_paths(store_root), policy_id.partition("@")[0]
    for name in sorted(paths, key=lambda name: name != own):
        try:
            if load_policy(paths[name]).policy_id == policy_id:
                return name
        except PolicyError:  # another one's fault
            continue
    return ""


def keep_policy(policy: Policy, store_root: Path) -> None:
    """Keep a policy of a file in the store, under its own name or the next free one, if it is not there yet."""
    if name_of(policy.policy_id, store_root):
        return
    with locked(store_root / "policies"):
        if name_of(policy.policy_id, store_root):  # by another process, meanwhile
            return
        paths, own = policy_paths(store_root), policy.card.name
        name = next(n for n in itertools.chain([own], (f"{own}-{k}" for k in itertools.count(1))) if n not in paths)
        save_policy(store_root / "policies" / name, policy.mlp, policy.card)


def find_policy(reference: str, store_root: Path | None = None, robot: Layout = HEXAPOD) -> Policy | Gait:
    """The policy behind a reference.

    Args:
      reference: `gait:<name>`, the path of a .safetensors file, a name in the store, or a shipped name; a name in
        the store hides a shipped one.
      store_root: the store's folder.
      robot: what the policy must fit.

    Raises:
      PolicyNotFound: with the names that exist.
      PolicyDamaged, PolicyMisfit: see `load_policy`.
    """
    if reference.startswith(GAIT_PREFIX):
        check_fit(reference, HEXAPOD, robot)
        return Gait(reference.removeprefix(GAIT_PREFIX))
    if reference.endswith(".safetensors") or "/" in reference:
        return load_policy(Path(os.path.expanduser(reference)), robot)  # leaves an unknown user's "~" as it is
    paths = policy_paths(store_root)
    if reference not in paths:
        raise PolicyNotFound(
            f"policy {reference!r} does not exist; there are {', '.join(paths) or 'none'}, "
            f"gait:<name> with one of {', '.join(GAITS)}, or the path of a .safetensors file"
        )
    return load_policy(paths[reference], robot)


def policy_paths(store_root: Path | None = None) -> dict[str, Path]:
    """Name to file of every policy that is shipped or in the store."""
    folders = [SHIPPED] + ([store_root / "policies"] if store_root else [])
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.safetensors"))}


def newest_policy(task: str, store_root: Path) -> tuple[str, list[PolicyError]]:
    """The name of the newest policy for a task in the store, or the shipped one of the task's name; and whom it passes
    over because they cannot be read.

    Raises:
      PolicyNotFound: there is neither.
    """
    paths = policy_paths(store_root)
    own, faults = load_all({name: path for name, path in paths.items() if path.is_relative_to(store_root)})
    made = {name: policy.card.created for name, policy in own.items() if policy.card.task == task}
    if made:
        return max(made, key=lambda name: made[name]), faults
    if task in paths:
        return task, faults
    raise PolicyNotFound(f"no policy for task {task!r} exists; make one with ./tcbi train --task {task}")
