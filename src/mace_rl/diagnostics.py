"""What an update did, for whoever wants to know why a run went as it did."""

import math

import numpy as np

from mace_rl.agent.ppo import Update
from mace_rl.experience import Experience
from mace_rl.results.records import UpdateRecord


def diagnose(
    done: tuple[int, int, int], rollout: list[Experience], update: Update, credit: float | None
) -> UpdateRecord:
    """The row of `diagnostics.csv` of one update.

    done: updates, episodes and environment steps so far; credit: of earlier βs, None without one.
    """

    def stacked(name: str) -> np.ndarray:
        return np.concatenate([getattr(item, name) for item in rollout])

    def explained_variance(kind: str) -> float:
        advantages, returns = stacked(f"{kind}_advantages"), stacked(f"{kind}_returns")
        spread = returns.var()  # a return minus the critic's value is the advantage
        return float(1 - advantages.var() / spread) if spread > 0 else math.nan

    def mean_of(part: str) -> float:
        parts = [getattr(item.bonus, part) for item in rollout if item.bonus]
        return float(np.concatenate(parts).mean()) if parts else math.nan

    weighted = np.concatenate([item.beta * item.intrinsic_advantages for item in rollout])
    variances = stacked("extrinsic_advantages").var(), weighted.var()
    number, episode, env_steps = done
    return UpdateRecord(
        update=number,
        episode=episode,
        env_steps=env_steps,
        approximate_kl=update.approximate_kl,
        clip_fraction=update.clip_fraction,
        entropy=update.entropy,
        explained_variance_extrinsic=explained_variance("extrinsic"),
        explained_variance_intrinsic=explained_variance("intrinsic"),
        gradient_norm_actor=update.gradient_norms["actor"],
        gradient_norm_extrinsic=update.gradient_norms["extrinsic"],
        gradient_norm_intrinsic=update.gradient_norms.get("intrinsic", math.nan),
        beta=float(np.mean([item.beta for item in rollout])),
        bonus_share=float(variances[1] / sum(variances)) if sum(variances) > 0 else math.nan,
        novelty=mean_of("novelty"),
        relevance=mean_of("relevance"),
        similarity=mean_of("similarity"),
        beta_credit=math.nan if credit is None else credit,
    )
