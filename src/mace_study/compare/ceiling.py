"""What any learner of β could gain at most: the data of tools.ceiling, summed up over seeds.

reference/readings/protocol.md says what is forked, and what is reported.
"""

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd

from mace_study.compare.statistics import paired_comparison
from mace_study.config.metrics import MetricsConfig

ORACLE, PPO = "oracle", "ppo"
KEY = ["world", "env", "episodes"]  # of a row of tools.ceiling: `episodes` is the horizon H
LAST = 300  # episodes that are forked, and whose mean return is reported
QUANTILES = 1.959964 + 0.841621  # of a level of 0.05, two-sided, and a probability of 0.8


def stretches(effect: float, noise: float) -> float:
    """How many of each β tell two of them apart: two samples whose means differ by `effect`."""
    return 2 * (QUANTILES * noise / effect) ** 2 if effect else math.inf


def gains(rows: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """The oracle's mean return less that of each other, paired by seed, with its interval.

    Columns: `KEY`, over, seeds, mean (of that other), gain, low, high, p_value.
    """
    how = settings.confidence, settings.bootstrap_repetitions
    found = []
    for key, forks in rows.groupby(KEY, sort=False):
        wide = forks.drop_duplicates(["seed", "who"]).pivot(
            index="seed", columns="who", values="mean_return"
        )
        for other in (name for name in forks["who"].unique() if name != ORACLE):
            difference = (wide[ORACLE] - wide[other]).to_numpy()
            generator = np.random.default_rng(settings.bootstrap_seed)
            compared = map(float, paired_comparison(difference, *how, generator))
            found.append((*key, other, len(wide), wide[other].mean(), *compared))
    return pd.DataFrame(
        found, columns=[*KEY, "over", "seeds", "mean", "gain", "low", "high", "p_value"]
    )


def effects(rows: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """What β = 1 earns over 0 in the next episodes, beside the noise of one stretch of them.

    Columns: `KEY`, stretch (episodes), seeds, effect (per episode), low, high, noise (root mean
    square over seeds), stretches (of each β that tell the effect from 0), needed (their episodes).
    """
    how = settings.confidence, settings.bootstrap_repetitions
    found = []
    groups = rows[rows["who"] == ORACLE].groupby([*KEY, "stretch"], sort=False)
    for (world, env, horizon, _), forks in groups:
        generator = np.random.default_rng(settings.bootstrap_seed)
        effect, low, high, _ = map(
            float, paired_comparison(forks["effect"].to_numpy(), *how, generator)
        )
        noise = math.sqrt((forks["noise"] ** 2).mean())
        count = stretches(effect, noise)
        key, length = (world, env, horizon), int(forks["stretch"].iloc[0])
        found.append(
            (*key, length, len(forks), effect, low, high, noise, count, 2 * count * length)
        )
    names = ["stretch", "seeds", "effect", "low", "high", "noise", "stretches", "needed"]
    return pd.DataFrame(found, columns=[*KEY, *names])


def over_ppo(
    means: Mapping[tuple[str, str], Mapping[int, float]], settings: MetricsConfig
) -> pd.DataFrame:
    """What each variant earns over `ppo`, paired by seed, as a share of all that can be earned.

    means: by environment and variant, by seed, a mean return. Columns: env, variant, seeds, gain,
    low, high.
    """
    how = settings.confidence, settings.bootstrap_repetitions
    found = []
    for (env, variant), by_seed in means.items():
        if variant != PPO:
            everything = settings.reference_return[env] - settings.random_return_in(env)
            difference = [mean - means[env, PPO][seed] for seed, mean in by_seed.items()]
            generator = np.random.default_rng(settings.bootstrap_seed)
            compared = paired_comparison(np.array(difference) / everything, *how, generator)
            found.append((env, variant, len(difference), *map(float, compared[:3])))
    return pd.DataFrame(found, columns=["env", "variant", "seeds", "gain", "low", "high"])


def of_oracle(rows: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """What the oracle and β = 0.4 earn over PPO, as `over_ppo` says it, with the column world."""
    found = []
    for (world, horizon), forks in rows.groupby(["world", "episodes"], sort=False):
        named = forks.assign(who=forks["who"].replace(ORACLE, f"{ORACLE}, H = {horizon}"))
        single = named.drop_duplicates(["env", "who", "seed"])
        means = {
            (str(env), str(who)): dict(zip(each["seed"], each["mean_return"], strict=True))
            for (env, who), each in single.groupby(["env", "who"], sort=False)
        }
        found.append(over_ppo(means, settings).assign(world=str(world)))
    return pd.concat(found).drop_duplicates(["world", "env", "variant"])
