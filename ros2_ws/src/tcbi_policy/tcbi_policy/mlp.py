"""The policy network, evaluated with numpy alone: what runs on the robot needs no torch.

mlp = Mlp(weights, biases, observation_scale, limit)
target = mlp(observation)     # (..., n) rad -> (..., J) rad, within +-limit
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tcbi_policy.errors import PolicyDamaged

ROWS = 32  # evaluated together, always as many: BLAS adds up in another order at another size


@dataclass(frozen=True)
class Mlp:
    """tanh layers on a scaled observation; the output is limit * tanh of the last layer.

    Attributes:
      weights: per layer (out, in), as torch keeps them.
      biases: per layer (out,).
      observation_scale: (n,) factors that bring the observation to the order of one.
      limit: rad.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    observation_scale: np.ndarray
    limit: float

    def __post_init__(self) -> None:
        faults = []
        width = self.observation_scale.shape
        for k, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            if w.ndim != 2 or w.shape[1:] != width or b.shape != w.shape[:1]:
                faults.append(f"layer {k} has shapes {w.shape} and {b.shape}, which do not follow from {width}")
            width = w.shape[:1]
            if not (np.isfinite(w).all() and np.isfinite(b).all()):
                faults.append(f"layer {k} holds values that are not finite")
        if not np.isfinite(self.observation_scale).all():
            faults.append("observation_scale holds values that are not finite")
        if faults:
            raise PolicyDamaged(f"{'; '.join(faults)}; copy the policy again, or train it again")

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Joint targets (..., J) in rad of observations (..., n) in rad; no bit depends on the size of a batch."""
        given = np.asarray(observation, np.float64)
        rows = given.reshape(-1, given.shape[-1])
        hidden = np.zeros((-(-len(rows) // ROWS), ROWS, rows.shape[1]))
        hidden.reshape(-1, rows.shape[1])[: len(rows)] = rows * self.observation_scale
        for w, b in zip(self.weights, self.biases, strict=True):
            hidden = np.tanh(hidden @ w.T + b)
        targets = self.limit * hidden.reshape(-1, hidden.shape[-1])[: len(rows)]
        return targets.reshape(*given.shape[:-1], targets.shape[-1])

    def tensors(self) -> dict[str, np.ndarray]:
        """The arrays by name, as the file keeps them (float32)."""
        layers = {}
        for k, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            layers[f"layer{k}.weight"], layers[f"layer{k}.bias"] = w, b
        layers["observation_scale"] = self.observation_scale
        return {name: np.ascontiguousarray(array, np.float32) for name, array in layers.items()}

    @property
    def layers(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return tuple(len(bias) for bias in self.biases[:-1])

    @staticmethod
    def from_tensors(tensors: Mapping[str, np.ndarray], limit: float) -> "Mlp":
        """The network of a file.

        Raises:
          PolicyDamaged: an array is missing, or shapes do not follow from one another.
        """
        count = sum(name.endswith(".weight") for name in tensors)
        expected = [f"layer{k}.{part}" for k in range(count) for part in ("weight", "bias")] + ["observation_scale"]
        missing = [name for name in expected if name not in tensors]
        if missing or count == 0:
            raise PolicyDamaged(
                f"arrays {', '.join(missing) or 'layer0.weight'} are missing; found {', '.join(tensors) or 'none'}; "
                "copy the policy again"
            )
        arrays = {name: np.asarray(tensors[name], np.float64) for name in expected}
        return Mlp(
            tuple(arrays[f"layer{k}.weight"] for k in range(count)),
            tuple(arrays[f"layer{k}.bias"] for k in range(count)),
            arrays["observation_scale"],
            limit,
        )
