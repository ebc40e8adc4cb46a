"""Energies expected between the simulated particles, and where the posterior is expected."""

import numpy as np
import pytest

from tcbi_infer.tcbi.emulator import _crowding, emulator, expected_draws
from tcbi_infer.tcbi.proposal import log_kernels

CENTER, SD = np.array([0.4, -0.8, 0.2]), np.array([0.3, 0.1, 0.02])


def energies(z: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """Squares near the minimum, and roughly proportional to the distance far from it, as divergences are."""
    distance = np.sqrt((((z - CENTER) / SD) ** 2).sum(axis=1))
    smooth = np.where(distance < 3, distance**2, 6 * distance - 9)
    found = np.maximum(smooth + noise * np.random.default_rng(5).standard_normal(len(z)), 0.0)
    return found - found.min()


def particles(count: int = 120) -> np.ndarray:
    """Half of the prior, half about the minimum."""
    rng = np.random.default_rng(3)
    near = CENTER + 4 * SD * rng.standard_normal((count // 2, 3))
    return np.concatenate([rng.standard_normal((count - count // 2, 3)), near])


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_energies_between_the_particles_are_foreseen(noise: float) -> None:
    z = particles()
    found = emulator(z, energies(z, noise))
    assert found is not None
    elsewhere = CENTER + 2 * SD * np.random.default_rng(4).standard_normal((200, 3))
    right = energies(elsewhere)
    error = found.energy(elsewhere) - right
    assert np.sqrt(np.mean((error - error.mean()) ** 2)) < 0.5 * right.std()


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_draws_lie_where_the_posterior_does(noise: float) -> None:
    z = particles()
    drawn = expected_draws(np.random.default_rng(1), z, energies(z, noise), 0.5, 200)
    assert drawn is not None and drawn.shape == (200, 3)
    assert np.all(np.abs(drawn.mean(axis=0) - CENTER) < SD)
    assert np.all(drawn.std(axis=0) < 2.5 * SD) and np.all(drawn.std(axis=0) > 0.4 * SD)


def test_simulations_that_diverged_are_left_out_and_few_are_no_ground_for_a_forecast() -> None:
    z = particles()
    energy = energies(z)
    energy[::3] = np.inf
    assert np.isfinite(expected_draws(np.random.default_rng(1), z, energy, 0.5, 50)).all()
    assert emulator(z[:15], energies(z[:15])) is None
    assert expected_draws(np.random.default_rng(1), z[:15], energies(z[:15]), 0.5, 50) is None


def test_energies_that_are_all_alike_do_no_harm() -> None:
    z = particles()
    drawn = expected_draws(np.random.default_rng(1), z, np.zeros(len(z)), 0.5, 50)
    assert drawn is not None and np.isfinite(drawn).all()


def test_candidates_are_weighed_as_by_kernels_in_double_precision() -> None:
    rng = np.random.default_rng(4)
    centers = CENTER + 40.0 + SD * rng.standard_normal((200, 3))
    sd = 0.5 * centers.std(axis=0)
    drawn = centers[rng.integers(0, 200, 1000)] + sd * rng.standard_normal((1000, 3))
    exact = log_kernels(drawn, centers, np.full(200, 1 / 200), np.diag(sd**2))
    assert np.ptp(_crowding(drawn / sd, centers / sd) - exact) < 1e-3, "alike but for a constant"
