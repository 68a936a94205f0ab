"""How much of β's credit is signal, for each objective tried, and how well it knows the update.

    .venv/bin/python -m tools.meta_signal FILE ENVIRONMENT EPISODES SEEDS [CONFIG ...]

Trains SEEDS runs (tuning seeds, from 1000) at a constant β of 0.4 and measures, for each third of
training: the signal-to-noise ratio per update of each objective, mean over standard deviation over
updates and seeds; and the cosine between the direction that credit is given along and what a
little more β really does to the policy's weights, by finite differences through the whole update.
`docs/method.md` explains the objectives. The rows replace those of the environment in FILE (CSV),
which is reference/measured/meta_signal.csv for `tools.show signals`.
"""

import argparse
import copy
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from threadpoolctl import threadpool_limits

from mace_rl.agent.advantages import normalised, normalised_change, root_mean_square
from mace_rl.beta.controller import Effect
from mace_rl.beta.meta import MetaAdaptation
from mace_rl.config.beta import ConstantBeta
from mace_rl.config.section import ConfigError
from mace_rl.experience import (
    Experience,
    extrinsic_part,
    intrinsic_part,
    intrinsic_parts,
    steps,
    total_advantages,
)
from mace_rl.factories import beta_controller
from mace_rl.files import write_atomically
from mace_rl.streams import Streams
from mace_rl.train import Trainer
from tools.random_return import study_with

BETA, STEP = 0.4, 0.05
PROBES = 60  # updates of a run whose finite difference is taken, evenly over its episodes


class Probe(Trainer):
    """A run at constant β that measures every objective and changes nothing."""

    def measure(self, judge: MetaAdaptation) -> dict[str, list[float]]:
        """Train; for each objective a value for each update, NaN where there is none.

        judge: gives the credit of the method, from this run's gradients.
        """
        self.rows: dict[str, list[float]] = defaultdict(list)
        self.past: tuple[np.ndarray, np.ndarray, float] | None = None
        self.judge = judge
        self.probed = 0
        for _ in self.run():
            pass
        return self.rows

    def adapt(self, rollout: list[Experience]) -> float | None:
        """Note what each objective would say of the βs before."""
        extrinsic = np.concatenate([extrinsic_part(item) for item in rollout])
        centred = self.config.ppo.centre_advantages
        if centred:
            extrinsic -= extrinsic.mean()
        total, part = total_advantages(rollout), np.sum(intrinsic_parts(rollout), axis=0)
        vectors = self.ppo.policy_gradients(
            *steps(rollout),
            [extrinsic, normalised(total, centred), normalised_change(total, part, centred)],
        )
        extrinsic_gradient, update, change = (vector.astype(np.float64) for vector in vectors)
        preconditioned = self.ppo.optimisers["actor"].preconditioned(change)
        unit = extrinsic_gradient / (np.linalg.norm(extrinsic_gradient) + 1e-12)
        nan = float("nan")
        last = self.past
        self.rows["unit length"].append(unit @ last[0] / last[2] if last else nan)
        self.rows["unscaled"].append(extrinsic_gradient @ last[0] if last else nan)
        self.rows["preconditioned"].append(extrinsic_gradient @ last[1] if last else nan)
        self.past = change, preconditioned, float(np.linalg.norm(update)) + 1e-8
        self.judge.credit_all(vectors[0], root_mean_square(extrinsic))
        judged, horizon = self.judge.judged, self.judge.config.horizon
        done = [item for item in judged if item.updates == horizon]
        self.judge.judged = judged[len(done) :]
        credits = [self.judge.bounded(item.credit) for item in done]
        self.rows["the method's"].append(float(np.mean(credits)) if credits else nan)
        influence = root_mean_square(np.concatenate([intrinsic_part(item) for item in rollout]))
        effect = Effect(preconditioned.astype(np.float32), influence)
        self.judge.judged.append(self.judge.judge(None, effect))
        due = len(self.records) * PROBES // self.config.episodes > self.probed
        self.probed += due
        difference = self.finite_difference(rollout) if due else None
        for name, vector in (("plain", change), ("as Adam steps", preconditioned)):
            cosine = nan
            if difference is not None and np.linalg.norm(difference) > 0:
                cosine = vector @ difference / np.linalg.norm(vector) / np.linalg.norm(difference)
            self.rows[f"cosine, {name}"].append(cosine)
        return None

    def finite_difference(self, rollout: list[Experience]) -> np.ndarray:
        """dθ'/dβ over 2 · STEP, through `improve`, which is then undone; float64 [n]."""
        state = copy.deepcopy(self.ppo.state_dict())
        ends = []
        for sign in (1, -1):
            changed = [
                Experience(**vars(item) | {"beta": item.beta + sign * STEP}) for item in rollout
            ]
            self.improve(changed)
            ends.append(self.ppo.policy.parameters.astype(np.float64))
            self.ppo.load_state_dict(copy.deepcopy(state))
        return (ends[0] - ends[1]) / (2 * STEP)


def main(file: Path, environment: str, episodes: int, seeds: int, overlays: list[str]) -> None:
    """Measure one environment, and put its rows into `file`."""
    study = study_with(overlays)
    constant = ConstantBeta(kind="constant", value=BETA)
    runs = []
    for seed in range(1000, 1000 + seeds):
        settings = study.run_config(environment, "mace_full", seed)
        settings = settings.model_copy(update={"episodes": episodes})
        probe = Probe(settings.model_copy(update={"beta": constant}))
        judge = beta_controller(settings, probe.environment, Streams(seed))
        assert isinstance(judge, MetaAdaptation)
        runs.append(probe.measure(judge))
    rows = []
    updates = min(len(run["unscaled"]) for run in runs)
    for name in runs[0]:
        for third, part in enumerate(np.array_split(np.arange(updates), 3), start=1):
            values = np.array([np.array(run[name])[part] for run in runs])
            values = values[np.isfinite(values)]
            value = values.mean() if "cosine" in name else values.mean() / (values.std() or 1.0)
            rows.append((environment, episodes, seeds, name, third, value))
    table = pd.DataFrame(rows, columns=["env", "episodes", "seeds", "measure", "third", "value"])
    if file.exists():
        others = pd.read_csv(file)
        table = pd.concat([others[others["env"] != environment], table])
    write_atomically(file, table.to_csv(index=False, float_format="%.4f"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.meta_signal signal.csv DeepSea10-v0 3000 4"
        " config/exploration.yaml",
    )
    parser.add_argument("file", type=Path, help="where the rows go")
    parser.add_argument("environment")
    parser.add_argument("episodes", type=int)
    parser.add_argument("seeds", type=int, help="how many, from 1000")
    parser.add_argument("configs", nargs="*", help="files over config.yaml")
    arguments = parser.parse_args()
    for name in ("episodes", "seeds"):
        if (count := getattr(arguments, name)) < 1:
            sys.exit(f"meta_signal: {name.upper()} is {count}, but should be at least 1")
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            main(
                *(arguments.file, arguments.environment, arguments.episodes),
                *(arguments.seeds, arguments.configs),
            )
    except ConfigError as error:
        sys.exit(f"meta_signal: {error}")
