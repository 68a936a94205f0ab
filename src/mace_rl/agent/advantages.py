"""Advantages: how much better an action was than the policy's average."""

import numpy as np

from mace_rl.numerics.arrays import mean, root_mean_square
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.matmul import dot


@kernel
def generalised_advantages(
    rewards: np.ndarray, values: np.ndarray, discount: float, gae_lambda: float
) -> tuple[np.ndarray, np.ndarray]:
    """Generalised advantage estimation over one episode (Schulman et al. 2016, eq. 16).

    rewards: [T]; values: [T + 1], V(s_0) … V(s_T), where V(s_T) is 0 if s_T is terminal and the
    critic's value if the time limit cut the episode off. Returns them, and with values[:T] added
    the λ-returns, float64 [T] each.
    """
    result = np.empty(len(rewards))
    following = 0.0
    for t in range(len(rewards) - 1, -1, -1):
        delta = rewards[t] + discount * values[t + 1] - values[t]
        following = delta + discount * gae_lambda * following
        result[t] = following
    return result, result + values[:-1]


@kernel
def episode_advantages(
    rewards: np.ndarray,
    unit: float,
    outputs: np.ndarray,
    ends: bool,
    discount: float,
    gae_lambda: float,
) -> tuple[np.ndarray, np.ndarray]:
    """`generalised_advantages` of rewards / unit, by the critic's outputs, float32 [T + 1, 1].

    ends: whether the last state is worth 0.
    """
    values = outputs[:, 0].astype(np.float64)
    if ends:
        values[-1] = 0.0
    return generalised_advantages(rewards / unit, values, discount, gae_lambda)


def discounted_returns(rewards: np.ndarray, discount: float) -> np.ndarray:
    """The discounted return-to-go of each step as it was paid, [T].

    Without what a critic guesses for the rest, which early on differs by more than what is paid.
    """
    return generalised_advantages(rewards, np.zeros(len(rewards) + 1), discount, 1.0)[0]


@kernel
def normalised(advantages: np.ndarray, centred: bool) -> np.ndarray:
    """Advantages with root mean square 1, float64 [N]; if `centred`, with mean 0 too.

    Centring a rollout of one episode forgets whether the whole went better than expected.
    """
    if centred:
        advantages = advantages - mean(advantages)
    return advantages / (root_mean_square(advantages) + 1e-8)


@kernel
def normalised_change(advantages: np.ndarray, change: np.ndarray, centred: bool) -> np.ndarray:
    """d normalised(advantages + ε · change) / dε at ε = 0, [N]."""
    if centred:
        advantages, change = advantages - mean(advantages), change - mean(change)
    spread = root_mean_square(advantages) + 1e-8
    direction = advantages / spread
    return (change - direction * (dot(direction, change) / len(change))) / spread
