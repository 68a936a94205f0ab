"""MACE-RL, the whole method: read this file first.

    R_total = R_extrinsic + β · R_curiosity                                            (paper)

One `Trainer` is one run. Each round plays whole episodes with the current policy, weighs the
curiosity bonus of each episode with its β, updates the policy by PPO, and lets the episodes become
memory. The phases are methods, named after the paper's terms; what they use is in the file of
that name: `rollout`, `curiosity` (`memory`, `novelty`, `density`), `beta` (`meta_network`), `ppo`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from mace_rl.beta import BetaController, ExponentialSchedule, MetaAdaptation
from mace_rl.curiosity import Curiosity
from mace_rl.environments import Environment
from mace_rl.finite import NonFiniteError, require_finite
from mace_rl.hyperparameters import ExponentialBeta, MetaBeta, NoBonus, RunConfig
from mace_rl.ppo import PPO, Batch
from mace_rl.records import EPISODE_COLUMNS, Record
from mace_rl.rollout import Episode, draw_noise, rollout_for
from mace_rl.streams import numpy_generator


@dataclass(frozen=True)
class Experience:
    """An episode with all that the update needs of it; arrays are [T]."""

    episode: Episode
    observations: np.ndarray  # float32 [T + 1, observation], normalised as the networks see them
    beta: float
    bonus: np.ndarray  # R_curiosity
    extrinsic_advantages: np.ndarray
    extrinsic_returns: np.ndarray
    intrinsic_advantages: np.ndarray  # zeros without a bonus, like the next
    intrinsic_returns: np.ndarray


def beta_controller(config: RunConfig, environment: Environment) -> BetaController | None:
    """What sets β in this variant; None for plain PPO."""
    match config.beta:
        case NoBonus():
            return None
        case ExponentialBeta():
            return ExponentialSchedule(config.beta)
        case MetaBeta():
            return MetaAdaptation(config, environment)


class Trainer:
    """One training run; iterate over `run` to carry it out."""

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        self.environment = Environment(config.environment, config.seed)
        self.rollout = rollout_for(self.environment)
        self.noise = numpy_generator(config.seed, "actions")
        self.controller = beta_controller(config, self.environment)
        self.curiosity = Curiosity(config, self.environment) if self.controller else None
        self.ppo = PPO(config.ppo, self.environment, config.seed, self.curiosity is not None)
        self.records: list[Record] = []

    def run(self) -> Iterator[list[Record]]:
        """Train to the last episode; yields the records of each round after its update.

        Raises `NonFiniteError` as soon as a number goes bad, before its round is yielded.
        """
        while len(self.records) < self.config.episodes:
            start = len(self.records)
            updating = False
            try:
                rollout = self.collect()
                updating = True
                self.adapt(rollout)
                self.improve(rollout)
            except NonFiniteError as error:
                run = f"{self.config.environment} {self.config.variant} seed {self.config.seed}"
                done = len(self.records)
                where = f"the update after episode {done}" if updating else f"episode {done + 1}"
                raise NonFiniteError(f"{run}, {where}: {error}") from None
            yield self.records[start:]

    def collect(self) -> list[Experience]:
        """Play episodes with the current policy until a rollout is full."""
        policy = self.ppo.acting_policy()
        rollout: list[Experience] = []
        collected = 0
        wanted = self.config.ppo.rollout_steps
        while collected < wanted and len(self.records) < self.config.episodes:
            noise = draw_noise(self.environment, self.noise)
            episode = self.rollout(self.environment, policy, noise)
            rollout.append(self.appraise(episode))
            collected += len(episode)
        return rollout

    def appraise(self, episode: Episode) -> Experience:
        """Curiosity bonus, advantages and β of a finished episode, which then becomes memory."""
        observations = self.ppo.normalise(episode.observations)
        beta, bonus = 0.0, np.zeros(len(episode))
        intrinsic = bonus, bonus
        extrinsic = self.ppo.advantages_and_returns(
            "extrinsic", observations, episode.rewards, episode.terminated
        )
        if self.curiosity and self.controller:
            beta = self.controller.beta
            require_finite("β", beta)
            bonus = self.curiosity.bonus(episode)
            require_finite("the curiosity bonus", bonus)
            intrinsic = self.ppo.advantages_and_returns(
                "intrinsic", observations, bonus, episode.terminated
            )
            self.curiosity.remember(episode, extrinsic[1])
            self.controller.next_episode(episode, bonus)
        before = self.records[-1].env_steps if self.records else 0
        self.records.append(
            Record(
                episode=len(self.records) + 1,
                env_steps=before + len(episode),
                length=len(episode),
                extrinsic_return=float(episode.rewards.sum()),
                intrinsic_return=float(bonus.sum()),
                beta=beta,
                terminated=int(episode.terminated),
            )
        )
        return Experience(episode, observations, beta, bonus, *extrinsic, *intrinsic)

    def adapt(self, rollout: list[Experience]) -> None:
        """Meta-adaptation: tell the controller what each β changes in the update, before it.

        The update starts along the policy gradient of the normalised total advantage. Shown are its
        derivative with respect to each episode's β, relative to its length, and the policy gradient
        of the extrinsic advantage.
        """
        if not (self.controller and self.controller.learns):
            return
        extrinsic = np.concatenate([item.extrinsic_advantages for item in rollout])
        total = total_advantages(rollout)
        extrinsic_gradient, update, *changes = self.ppo.policy_gradients(
            *steps(rollout),
            [
                extrinsic - extrinsic.mean(),
                normalised(total),
                *(normalised_change(total, change) for change in intrinsic_parts(rollout)),
            ],
        )
        length = max(float(np.linalg.norm(update)), 1e-8)
        self.controller.learn(extrinsic_gradient, [change / length for change in changes])

    def improve(self, rollout: list[Experience]) -> None:
        """PPO on the total reward, R_E + β R_I, whose advantage is A_E + β A_I."""
        returns = {"extrinsic": joined([item.extrinsic_returns for item in rollout])}
        if self.curiosity:
            returns["intrinsic"] = joined([item.intrinsic_returns for item in rollout])
        norms = self.ppo.update(
            Batch(
                *steps(rollout),
                log_probs=joined([item.episode.log_probs for item in rollout]),
                advantages=normalised(total_advantages(rollout)).astype(np.float32),
                returns=returns,
            )
        )
        for name, norm in norms.items():
            require_finite(f"the {name}'s gradient norm", norm)
        # What went bad in an earlier epoch is in the weights, and may be hidden by a tanh.
        for name, learner in self.ppo.learners.items():
            require_finite(f"a weight of the {name}", learner.parameters)
        for item in rollout:
            self.ppo.standardiser.update(item.episode.observations[:-1])

    def agent(self) -> dict[str, Any]:
        """The policy and critics as they are now, with the observation normaliser."""
        networks = {"actor": self.ppo.actor} | self.ppo.critics
        return {
            "networks": {
                name: {
                    "sizes": network.sizes.tolist(),
                    "parameters": torch.from_numpy(network.parameters.copy()),
                }
                for name, network in networks.items()
            },
            "standardiser": self.ppo.standardiser.state_dict(),
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything the rest of the run depends on, at the end of a round."""
        return {
            "ppo": self.ppo.state_dict(),
            "curiosity": self.curiosity.state_dict() if self.curiosity else None,
            "controller": self.controller.state_dict() if self.controller else None,
            "noise": self.noise.bit_generator.state,
            "environment": self.environment.generator.bit_generator.state,
            "records": {
                name: torch.tensor(
                    [getattr(record, name) for record in self.records],
                    dtype=torch.float64 if kind is float else torch.int64,
                )
                for name, kind in EPISODE_COLUMNS.items()
            },
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.ppo.load_state_dict(state["ppo"])
        if self.curiosity and self.controller:
            self.curiosity.load_state_dict(state["curiosity"])
            self.controller.load_state_dict(state["controller"])
        self.noise.bit_generator.state = state["noise"]
        self.environment.generator.bit_generator.state = state["environment"]
        columns = {name: column.tolist() for name, column in state["records"].items()}
        self.records = [
            Record(**dict(zip(columns, row, strict=True)))
            for row in zip(*columns.values(), strict=True)
        ]


def steps(rollout: list[Experience]) -> tuple[np.ndarray, np.ndarray]:
    """Observations, [N, observation], and actions of the episodes, one after the other."""
    observations = np.concatenate([item.observations[:-1] for item in rollout])
    return observations, np.concatenate([item.episode.actions for item in rollout])


def joined(pieces: list[np.ndarray]) -> np.ndarray:
    """The episodes' arrays one after the other, float32 [N]."""
    return np.concatenate(pieces).astype(np.float32)


def total_advantages(rollout: list[Experience]) -> np.ndarray:
    """A_E + β A_I of every step, float64 [N]."""
    return np.concatenate(
        [item.extrinsic_advantages + item.beta * item.intrinsic_advantages for item in rollout]
    )


def intrinsic_parts(rollout: list[Experience]) -> list[np.ndarray]:
    """For each episode what `total_advantages` changes by with its β: A_I there, 0 elsewhere."""
    parts = np.zeros((len(rollout), sum(len(item.episode) for item in rollout)))
    start = 0
    for part, item in zip(parts, rollout, strict=True):
        part[start : start + len(item.episode)] = item.intrinsic_advantages
        start += len(item.episode)
    return list(parts)


def normalised(advantages: np.ndarray) -> np.ndarray:
    """Advantages with mean 0 and standard deviation 1, [N]."""
    centred = advantages - advantages.mean()
    return centred / (root_mean_square(centred) + 1e-8)


def normalised_change(advantages: np.ndarray, change: np.ndarray) -> np.ndarray:
    """d normalised(advantages + ε · change) / dε at ε = 0, [N].

    What of the change is parallel to the advantages is lost in the normalisation.
    """
    centred, change = advantages - advantages.mean(), change - change.mean()
    spread = root_mean_square(centred) + 1e-8
    direction = centred / spread
    return (change - direction * (direction @ change / len(change))) / spread


def root_mean_square(values: np.ndarray) -> float:
    """√(Σ x² / N)."""
    return math.sqrt(values @ values / len(values))
