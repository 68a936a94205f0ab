"""Advantages: how much better an action was than the policy's average."""

import math

import numpy as np

from mace_rl.agent.kernels import kernel
from mace_rl.agent.products import dot


@kernel
def generalised_advantages(
    rewards: np.ndarray, values: np.ndarray, discount: float, gae_lambda: float
) -> np.ndarray:
    """Generalised advantage estimation over one episode (Schulman et al. 2016, eq. 16).

    rewards: [T]; values: [T + 1], V(s_0) … V(s_T), where V(s_T) is 0 if s_T is terminal and the
    critic's value if the time limit cut the episode off. Returns float64 [T]; adding values[:T]
    gives the λ-returns.
    """
    result = np.empty(len(rewards))
    following = 0.0
    for t in range(len(rewards) - 1, -1, -1):
        delta = rewards[t] + discount * values[t + 1] - values[t]
        following = delta + discount * gae_lambda * following
        result[t] = following
    return result


@kernel
def normalised(advantages: np.ndarray, centred: bool) -> np.ndarray:
    """Advantages with root mean square 1, float64 [N]; if `centred`, with mean 0 too.

    A rollout is often one episode. To centre it is to forget whether it went better or worse than
    expected as a whole, and to blow up what is left, which in an episode that went well all the way
    is noise.
    """
    if centred:
        advantages = advantages - mean(advantages)
    return advantages / (root_mean_square(advantages) + 1e-8)


@kernel
def normalised_change(advantages: np.ndarray, change: np.ndarray, centred: bool) -> np.ndarray:
    """d normalised(advantages + ε · change) / dε at ε = 0, [N].

    What of the change is parallel to the advantages is lost in the normalisation.
    """
    if centred:
        advantages, change = advantages - mean(advantages), change - mean(change)
    spread = root_mean_square(advantages) + 1e-8
    direction = advantages / spread
    return (change - direction * (dot(direction, change) / len(change))) / spread


@kernel
def root_mean_square(values: np.ndarray) -> float:
    """√(Σ x² / N)."""
    return math.sqrt(dot(values, values) / len(values))


@kernel
def total(values: np.ndarray) -> float:
    """Σ x of float64 [N], in order."""
    result = 0.0
    for value in values:
        result += value
    return result


@kernel
def mean(values: np.ndarray) -> float:
    """Σ x / N."""
    return total(values) / len(values)


@kernel
def variance(values: np.ndarray) -> float:
    """Mean squared deviation from the mean of float64 [N]."""
    centre, squares = mean(values), 0.0
    for value in values:
        squares += (value - centre) ** 2
    return squares / len(values)
