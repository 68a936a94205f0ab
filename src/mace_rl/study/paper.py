"""What the paper has: its environments and variants, by our names for them, and its Table 1."""

from collections.abc import Iterable

ENVIRONMENTS = ACROBOT, CARTPOLE, HOPPER = "Acrobot-v1", "CartPole-v1", "HopperBulletEnv-v0"
VARIANTS = PPO, FIXED, FULL = "ppo", "mace_fixed", "mace_full"

PAPER_METRICS = ("sample_efficiency", "convergence_steps")  # of Table 1

# Paper, Table 1: (environment, variant) -> sample efficiency, convergence steps, in episodes.
PAPER_TABLE1 = {
    (ACROBOT, PPO): (186, 617),
    (ACROBOT, FIXED): (201, 595),
    (ACROBOT, FULL): (249, 586),
    (CARTPOLE, PPO): (140, 660),
    (CARTPOLE, FIXED): (120, 620),
    (CARTPOLE, FULL): (104, 634),
    (HOPPER, PPO): (865, 1841),
    (HOPPER, FIXED): (782, 1801),
    (HOPPER, FULL): (495, 1799),
}


def has_all(environments: Iterable[str], variants: Iterable[str]) -> bool:
    """Whether a study of these has all that the paper makes claims of."""
    return set(ENVIRONMENTS) <= set(environments) and set(VARIANTS) <= set(variants)
