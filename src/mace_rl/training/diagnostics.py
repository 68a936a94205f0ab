"""The diagnostics of an update."""

import math

import numpy as np

from mace_rl.agent.learner import Update
from mace_rl.numerics.arrays import mean, variance
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.matmul import dot
from mace_rl.training.experience import Rollout
from mace_rl.training.records import UpdateRecord


def diagnose(
    count: tuple[int, int, int], rollout: Rollout, update: Update, credit: float | None
) -> UpdateRecord:
    """The row of `diagnostics.csv` of one update.

    count: updates, episodes and environment steps so far; credit: of earlier βs, None without one.
    """

    def mean_of(part: str) -> float:
        if getattr(rollout[0].bonus, part, None) is None:  # plain PPO, or another bonus
            return math.nan
        return mean(rollout.joined(lambda item: getattr(item.bonus, part)))

    extrinsic_variance, intrinsic_variance = (
        explained_variance(rollout.advantages_of(kind), rollout.returns(kind))
        for kind in ("extrinsic", "intrinsic")
    )
    parts = rollout.advantages
    extrinsic, weighted = (dot(part, part) for part in (parts.extrinsic, parts.weighted))
    number, episode, env_steps = count
    return UpdateRecord(
        update=number,
        episode=episode,
        env_steps=env_steps,
        approximate_kl=update.approximate_kl,
        clip_fraction=update.clip_fraction,
        entropy=update.entropy,
        explained_variance_extrinsic=extrinsic_variance,
        explained_variance_intrinsic=intrinsic_variance,
        gradient_norm_actor=update.gradient_norms["actor"],
        gradient_norm_extrinsic=update.gradient_norms["extrinsic"],
        gradient_norm_intrinsic=update.gradient_norms.get("intrinsic", math.nan),
        beta=sum(item.beta for item in rollout) / len(rollout),
        bonus_share=weighted / (extrinsic + weighted) if extrinsic + weighted > 0 else math.nan,
        novelty=mean_of("novelty"),
        relevance=mean_of("relevance"),
        similarity=mean_of("similarity"),
        beta_credit=math.nan if credit is None else credit,
    )


@kernel
def explained_variance(advantages: np.ndarray, returns: np.ndarray) -> float:
    """1 - Var(return - V) / Var(return), where a return minus V is the advantage; else NaN."""
    spread = variance(returns)
    return 1 - variance(advantages) / spread if spread > 0 else math.nan
