"""Settings, and records and tables that no run has given, for several test files."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.stats

from mace_rl.config.section import check
from mace_study.compare.aggregate import SCORED
from mace_study.compare.claims_config import parse_claims, parts_of
from mace_study.compare.ledger import Finding
from mace_study.config.metrics import MetricsConfig
from mace_study.config.study import read_study
from mace_study.measure.metrics import (
    BEFORE,
    CORRELATION,
    LearningCurve,
    Metric,
    final_return,
    metrics_columns,
)

SETTINGS = {"final_fraction": 0.1, "threshold": 0.75, "moving_average": 50, "comparisons": []}
SETTINGS |= {"convergence_slope": 0.1, "confidence": 0.95}
SETTINGS |= {"bootstrap_repetitions": 1000, "bootstrap_seed": 0}
SETTINGS["random_return"] = {"CartPole-v1": 22.1, "Acrobot-v1": -499.1}
SETTINGS["reference_return"] = {"CartPole-v1": 400.0, "Acrobot-v1": -200.0}
SETTINGS["solved_return"] = {"CartPole-v1": 475.0, "Acrobot-v1": -100.0}
CONFIG = check(MetricsConfig, SETTINGS, "test")

ROOT = Path(__file__).parents[1]
STUDY = read_study([ROOT / "config.yaml"])
CLAIMS = parse_claims(ROOT / STUDY.claims)
FIRST = next(iter(CLAIMS.families.items()))
OTHERS = [
    (title, family)
    for title, family in CLAIMS.families.items()
    if {part.metric for _, part in parts_of(family)} == {"area_under_curve"}
]
PAPERS, QUESTIONS = (CLAIMS.model_copy(update={"families": dict(own)}) for own in ([FIRST], OTHERS))
LITERAL, ROBUST = CLAIMS.ways
ENVIRONMENTS, VARIANTS = STUDY.environments, STUDY.variants
ASKED = ("tasks", "planted", "minigrid")
ASKED = [ROOT / "config" / f"{name}.yaml" for name in ASKED]
QUESTIONED = read_study([ROOT / "config.yaml", *ASKED]).metrics
FEW = {"bootstrap_repetitions": 1000}
QUESTIONED, QUICK = (metrics.model_copy(update=FEW) for metrics in (QUESTIONED, STUDY.metrics))

EPISODES = {"Acrobot-v1": 2000, "CartPole-v1": 2000, "HopperBulletEnv-v0": 6000}
LEARNED = {"Acrobot-v1": -85.0, "CartPole-v1": 500.0, "HopperBulletEnv-v0": 1500.0}
TIMES = ["sample_efficiency", "sample_efficiency_common"]
TIMES += ["convergence_steps", "convergence_steps_public_code"]
SEEDS = {"CartPole-v1": 12, "HopperBulletEnv-v0": 10}  # of `table_for_scores`


def noisy(seed: int, episodes: int = 400) -> np.ndarray:
    """A learning curve with noise, rounded so that equal values occur."""
    generator = np.random.default_rng(seed)
    level = 100 / (1 + np.exp(-(np.arange(episodes) - generator.integers(50, 300)) / 20))
    return np.round(level + generator.normal(size=episodes) * 10)


def episode_columns(episodes: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Those of episodes.csv, of random doubles."""
    draws = np.random.default_rng(seed)
    length = draws.integers(1, 500, episodes)
    return {
        "episode": np.arange(1, episodes + 1),
        "env_steps": np.cumsum(length),
        "length": length,
        "extrinsic_return": draws.normal(size=episodes) * 10.0 ** draws.integers(-20, 20, episodes),
        "intrinsic_return": draws.exponential(size=episodes),
        "beta": draws.random(episodes) ** 20,
        "terminated": draws.integers(0, 2, episodes),
    }


def frame(returns: np.ndarray, length: int = 1) -> pd.DataFrame:
    """The records of a run with these returns, every episode of this length."""
    episodes = np.arange(1, len(returns) + 1)
    return pd.DataFrame({"extrinsic_return": returns, "env_steps": episodes * length})


def curve(returns, final=None, random=-1e9, goals=(), **settings):
    """What a metric gets; settings that are not given are those of `CONFIG`."""
    returns, changed = np.asarray(returns, float), CONFIG.model_copy(update=settings)
    final = final_return(returns, 0.1) if final is None else final
    return LearningCurve(returns, final, random, changed, *goals)


def averages(returns, window):
    """Moving averages by episode number (from 1), from pandas."""
    rolling = pd.Series(returns).rolling(window).mean()
    return {t + 1: value for t, value in enumerate(rolling) if not np.isnan(value)}


def table_for_tables(
    metrics: Sequence[Metric], environments=ENVIRONMENTS, variants=VARIANTS, seeds=3, **values
) -> pd.DataFrame:
    """A metrics.csv; `values` are per variant, [seeds] each: `sample_efficiency={"ppo": [...]}`."""
    draws = np.random.default_rng(0)
    rows = []
    for environment, variant, seed in itertools.product(environments, variants, range(seeds)):
        row: dict[str, object] = dict.fromkeys(metrics_columns(metrics), 0)
        row |= {metric.name: int(draws.integers(100, 990)) for metric in metrics}
        row |= {"env": environment, "variant": variant, "seed": seed, "episodes": 2000}
        row |= {"convergence_steps": int(draws.integers(1000, 2000))}
        row |= {"final_return": -85.25, "area_under_curve": -116.75}
        row |= {name: given[variant][seed] for name, given in values.items()}
        rows.append(row)
    return pd.DataFrame(rows)


def digits_of(part: Finding) -> int:
    """With how many a part is printed: of a return so many that the margin has two figures."""
    decimals = f"{part.worth_mentioning:.1e}".partition("e")[2]
    return {"episodes": 0, "return": max(1, 1 - int(decimals))}.get(part.unit, 3)


def table_for_claims(seeds: int, advantage: dict[str, float], noise: float) -> pd.DataFrame:
    """metrics.csv in which a variant is better by `advantage` of everything, in all it does."""
    draws = np.random.default_rng(1)
    rows = []
    for env, variant, seed in itertools.product(EPISODES, advantage, range(seeds)):
        row: dict[str, object] = {"env": env, "variant": variant, "seed": seed}
        row["episodes"] = EPISODES[env]
        for name in TIMES:
            share = 0.5 - advantage[variant] + noise * draws.normal()
            row[name] = round(share * EPISODES[env])
        for name in ("final_return", "area_under_curve", "early_return"):
            share = 0.5 + advantage[variant] + noise * draws.normal()
            row[name] = share * LEARNED[env]
            if env == "Acrobot-v1":
                row[name] = -500 + share * 415
        if variant == "mace_full":
            row[CORRELATION] = row[BEFORE] = advantage[variant] + noise * draws.normal()
        rows.append(row)
    return pd.DataFrame(rows)


def table_for_questions(seeds: int, **better: float) -> pd.DataFrame:
    """metrics.csv with mean returns of all that our questions need; some variants are better."""
    draws = np.random.default_rng(4)
    parts = [part for own in QUESTIONS.families.values() for _, part in parts_of(own)]
    environments = dict.fromkeys(env for part in parts for env in part.environments)
    variants = dict.fromkeys(name for part in parts for name in (part.variant, *part.over))
    cells = itertools.product(environments, variants)
    rows = [
        {"env": env, "variant": variant, "seed": seed, "episodes": 2000}
        | {"area_under_curve": draws.normal() + better.get(variant, 0)}
        for env, variant in cells
        for seed in range(seeds)
    ]
    return pd.DataFrame(rows)


def table_for_scores(seeds: dict[str, int]) -> pd.DataFrame:
    """metrics.csv of two variants that are alike, with what scores are of."""
    draws = np.random.default_rng(3)
    rows = [
        {"env": env, "variant": variant, "seed": seed}
        for env, count in seeds.items()
        for variant in ("ppo", "mace_full")
        for seed in range(count)
    ]
    frame = pd.DataFrame(rows)
    for metric in SCORED:
        frame[metric] = draws.normal(300, 50, len(frame)).round(1)
    return frame


def expanded(resampled: Sequence[float] | np.ndarray, seeds: int) -> np.ndarray:
    """Bounds that a t interval of as many seeds would have, if `resampled` were normal."""
    z = scipy.stats.t.ppf(0.975, seeds - 1) * np.sqrt(seeds / (seeds - 1))
    return np.quantile(resampled, scipy.stats.norm.cdf([-z, z]))
