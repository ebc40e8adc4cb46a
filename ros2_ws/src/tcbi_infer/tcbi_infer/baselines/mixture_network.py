"""A mixture density network: from a summary of rollouts to a mixture of normals over parameters in probit space."""

import math

import numpy as np
import torch
from torch import nn

HELD_OUT = 0.2  # share of the simulations that decide when to stop
PATIENCE = 60  # epochs without a better held-out likelihood
MOST_EPOCHS = 1000
BATCH = 64
RATE = 3e-3
DECAY = 1e-3
LARGEST_LOG = 5.0  # of a component's inverse width, so that none collapses on one simulation
CLIP = 5.0  # standard deviations of the simulations that a summary is cut at


class MixtureNetwork(nn.Module):
    """Two hidden layers, then weights, means and the Cholesky factor of each component's precision."""

    def __init__(self, inputs: int, outputs: int, components: int, hidden: int):
        super().__init__()
        self.outputs, self.components = outputs, components
        self.body = nn.Sequential(nn.Linear(inputs, hidden), nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh())
        self.below = torch.tril_indices(outputs, outputs, offset=-1)
        self.head = nn.Linear(hidden, components * (1 + 2 * outputs + self.below.shape[1]))

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """(B, K) summaries -> log-weights (B, C), means (B, C, P), factors (B, C, P, P), their log-diagonals."""
        p = self.outputs
        raw = self.head(self.body(x)).reshape(len(x), self.components, -1)
        log_diagonal = raw[..., 1 + p : 1 + 2 * p].clamp(-LARGEST_LOG, LARGEST_LOG)
        factor = torch.diag_embed(log_diagonal.exp())
        factor[..., self.below[0], self.below[1]] = raw[..., 1 + 2 * p :]
        return raw[..., 0].log_softmax(-1), raw[..., 1 : 1 + p], factor, log_diagonal

    def log_density(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """(B,) of (B, P) parameters given (B, K) summaries, without its constant."""
        log_weights, means, factor, log_diagonal = self(x)
        white = torch.einsum("bcij,bci->bcj", factor, y[:, None] - means)
        return (log_weights + log_diagonal.sum(-1) - 0.5 * white.square().sum(-1)).logsumexp(-1)

    def draw(self, x: torch.Tensor, count: int) -> torch.Tensor:
        """(count, P) parameters given one summary (1, K)."""
        log_weights, means, factor, _ = self(x)
        chosen = torch.multinomial(log_weights[0].exp(), count, replacement=True)
        normal = torch.randn(count, self.outputs, 1)
        steps = torch.linalg.solve_triangular(factor[0, chosen].transpose(1, 2), normal, upper=True)
        return means[0, chosen] + steps[..., 0]


def posterior_draws(
    summary: np.ndarray, z: np.ndarray, real: np.ndarray, count: int, *, components: int, hidden: int, seed: int
) -> np.ndarray:
    """Train on simulations and draw from what the network says of the recorded rollouts.

    Args:
      summary: (M, K) of the simulations.
      z: (M, P) their parameters.
      real: (K,) of the recorded rollouts.
      count: draws.
      components: of the mixture.
      hidden: units of each hidden layer.
      seed: of the initial weights, the split, the batches and the draws.

    Returns:
      (count, P).
    """
    mean, sd = summary.mean(axis=0), summary.std(axis=0)
    told = sd > 1e-12 * np.maximum(np.abs(mean), 1e-12)
    standard = np.clip((np.vstack([summary, real])[:, told] - mean[told]) / sd[told], -CLIP, CLIP)
    x, y = torch.tensor(standard, dtype=torch.float32), torch.tensor(z, dtype=torch.float32)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = MixtureNetwork(x.shape[1], z.shape[1], components, hidden)
        _train(network, x[:-1], y)
        with torch.no_grad():
            draws = network.draw(x[-1:], count)
    return draws.numpy().astype(float)


def _train(network: MixtureNetwork, x: torch.Tensor, y: torch.Tensor) -> None:
    order = torch.randperm(len(x))
    held = max(1, math.floor(HELD_OUT * len(x)))
    judged, taught = order[:held], order[held:]
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    best, kept, since = math.inf, network.state_dict(), 0
    for _ in range(MOST_EPOCHS):
        for batch in taught[torch.randperm(len(taught))].split(BATCH):
            optimiser.zero_grad()
            loss = -network.log_density(x[batch], y[batch]).mean()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
        with torch.no_grad():
            score = float(-network.log_density(x[judged], y[judged]).mean())
        if score < best - 1e-4:
            best, since = score, 0
            kept = {name: value.clone() for name, value in network.state_dict().items()}
        else:
            since += 1
        if since > PATIENCE:
            break
    network.load_state_dict(kept)
