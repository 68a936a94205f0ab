"""What could any learner of β gain? Forks of one training under several βs, by a clairvoyant.

    .venv/bin/python -m tools.ceiling ENVIRONMENT OUT.csv [--config FILE …] [--seeds 800 820]

At every tenth episode up to `LAST` a training is forked from its exact state. Under each β of
`GRID` it goes on for H episodes, `STREAMS` times with fresh random numbers of policy and
environment. The training then goes on for `STEP` episodes under the β with the best mean, with
random numbers of its own: what is reported is not what was chosen by. A seed has three rows: of
this oracle, of PPO, and of β = 0.4, each with the mean return of the first `LAST` episodes; and the
oracle's has, for 1, 10 and H episodes, the effect of β = 1 over 0 and the noise of one fork.
"""

import argparse
import copy
import csv
import math
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from mace_rl.base.errors import Refusal
from mace_rl.config.run import RunConfig
from mace_rl.library import settings
from mace_rl.training.trainer import Trainer
from mace_study.compare.ceiling import LAST

GRID, STREAMS = (0.0, 0.1, 0.4, 1.0), 4
STEP = 10  # episodes from fork to fork
STRETCHES = (1, 10)  # episodes over which an effect is measured, beside H
COLUMNS = ("env", "seed", "episodes", "who", "mean_return", "stretch", "effect", "noise", "forks")


def with_beta(config: RunConfig, beta: float) -> RunConfig:
    """The same run with a constant β."""
    changes = {"beta": {"kind": "constant", "value": beta}}
    return RunConfig.model_validate(config.settings() | changes)


def go_on(config: RunConfig, state: dict[str, Any], stream: int, episodes: int) -> Trainer:
    """From a trainer's state `episodes` more, with fresh random numbers."""
    budget = len(state["records"]["episode"]) + episodes
    trainer = Trainer(config.model_copy(update={"episodes": budget}))
    trainer.load_state_dict(copy.deepcopy(state))
    own = np.random.SeedSequence(config.seed, spawn_key=(budget, stream)).spawn(3)
    trainer.noise, trainer.ppo.generator = map(np.random.default_rng, own[:2])
    fresh = np.random.default_rng(own[2]).bit_generator.state
    trainer.environment.generator.bit_generator.state = fresh
    for _ in trainer.run():
        pass
    trainer.environment.env.close()
    return trainer


def returns(trainer: Trainer, since: int) -> np.ndarray:
    """Those of its episodes after the first `since`."""
    return np.array([record.extrinsic_return for record in trainer.records[since:]])


def oracle(config: RunConfig, horizon: int) -> tuple[float, np.ndarray]:
    """Mean return of the first `LAST` episodes, and of all forks, [forks, β, stream, horizon]."""
    trainer = Trainer(with_beta(config.model_copy(update={"episodes": STEP}), 0.4))
    for _ in trainer.run():
        pass
    forks = []
    while (done := len(trainer.records)) < LAST:
        state, found = trainer.state_dict(), np.empty((len(GRID), STREAMS, horizon))
        for stream, own in enumerate(found.reshape(-1, horizon)):
            beta = GRID[stream // STREAMS]
            own[:] = returns(go_on(with_beta(config, beta), state, stream, horizon), done)
        forks.append(found)
        best = GRID[int(found.mean(axis=(1, 2)).argmax())]
        trainer = go_on(with_beta(config, best), state, len(GRID) * STREAMS, STEP)
    return float(returns(trainer, 0)[:LAST].mean()), np.array(forks)


def effects(forks: np.ndarray) -> Iterator[tuple[int, float, float]]:
    """Episodes of a stretch; what β = 1 earns in it over 0, per episode; the noise of a fork."""
    for stretch in (*STRETCHES, forks.shape[-1]):
        means = forks[..., :stretch].mean(axis=-1)  # [forks, β, stream]
        effect = float((means[:, -1] - means[:, 0]).mean())
        yield stretch, effect, math.sqrt(means.var(axis=-1, ddof=1).mean())


def rows(environment: str, seed: int, horizon: int, config: list[Path]) -> list[list[Any]]:
    """Of one seed, as `COLUMNS`."""
    with threadpool_limits(1):
        run = settings(environment, "mace_fixed", seed=seed, config=config)
        found, start = [], [environment, seed, horizon]
        mean, forks = oracle(run, horizon)
        for stretch in effects(forks):
            found.append([*start, "oracle", mean, *stretch, len(forks)])
        plain = settings(environment, "ppo", seed=seed, config=config, episodes=LAST)
        constant = with_beta(run.model_copy(update={"episodes": LAST}), 0.4)
        for who, one in {"ppo": plain, "beta_0.4": constant}.items():
            trainer = Trainer(one)
            for _ in trainer.run():
                pass
            found.append([*start, who, float(returns(trainer, 0).mean()), "", "", "", ""])
    return found


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.ceiling Acrobot-v1 acrobot.csv --config config/plain.yaml",
    )
    parser.add_argument("environment")
    parser.add_argument("out", type=Path)
    parser.add_argument("--config", type=Path, nargs="*", default=[])
    parser.add_argument("--seeds", type=int, nargs=2, default=(800, 820), metavar=("FIRST", "END"))
    parser.add_argument("--horizon", type=int, default=20, metavar="H")
    given = parser.parse_args()
    seeds = range(*given.seeds)
    if not seeds or given.horizon < max(STRETCHES):
        parser.error(f"--seeds should be FIRST < END, and --horizon at least {max(STRETCHES)}")
    same = repeat(given.environment), seeds, repeat(given.horizon), repeat(given.config)
    try:
        settings(given.environment, "mace_fixed", config=given.config)  # or out would be emptied
        with (
            ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool,
            given.out.open("w", newline="") as file,
        ):
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            for found in pool.map(rows, *same):
                writer.writerows(found)
                file.flush()
    except (Refusal, OSError) as error:
        sys.exit(f"ceiling: {error}")


if __name__ == "__main__":
    main()
