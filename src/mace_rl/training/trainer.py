"""MACE-RL, the whole method: read this file first.

    R_total = R_extrinsic + β · R_curiosity                                            (paper)

One `Trainer` is one run. Each round plays whole episodes with the current policy, weighs the
curiosity bonus of each episode with its β, updates the policy by PPO, and lets the episodes become
memory. The phases are methods: `collect`, `appraise`, `adapt`, `improve`. What they use is in the
rooms `agent` (PPO), `bonus` (novelty, episodic memory), `beta` (schedules, meta network) and
`environments`; `factories` makes it as the settings ask for.
"""

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from mace_rl.agent.advantages import normalised, normalised_change, paid_returns
from mace_rl.agent.learner import Batch, Update
from mace_rl.base.errors import Refusal
from mace_rl.base.rng import Streams
from mace_rl.beta.controller import Effect
from mace_rl.config.beta import LARGEST_BETA
from mace_rl.config.run import RunConfig
from mace_rl.environments.episode import Episode
from mace_rl.numerics.arrays import mean, root_mean_square, total
from mace_rl.numerics.finite import TOO_LARGE, numbers, require_finite, require_within
from mace_rl.training import resuming
from mace_rl.training.diagnostics import diagnose, unseen
from mace_rl.training.experience import Experience, Rollout
from mace_rl.training.factories import beta_controller, environment, intrinsic_reward, ppo
from mace_rl.training.records import (
    EpisodeRecord,
    UpdateRecord,
    as_columns,
    as_rows,
    rounded,
)
from mace_rl.training.rollout import draw_noise, rollout_for

logger = logging.getLogger(__name__)


class Trainer:
    """One training run; iterate over `run` to carry it out."""

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        streams = Streams(config.seed)
        self.environment = environment(config, streams)
        self._make_parts(streams)
        self.noise = streams["actions"]
        self.records: list[EpisodeRecord] = []
        self.diagnostics: list[UpdateRecord] = []
        self.last_episodes = resuming.LastEpisodes(self.environment)

    def _make_parts(self, streams: Streams) -> None:
        self.controller = beta_controller(self.config, self.environment, streams)
        self.curiosity = intrinsic_reward(self.config, self.environment, streams)
        self.ppo = ppo(self.config, self.environment, self.curiosity is not None, streams)
        self.play = rollout_for(self.environment, self.ppo.acting_policy())

    def run(self) -> Iterator[list[EpisodeRecord]]:
        """Train to the last episode; yields the records of each round after its update.

        Raises `NonFiniteError` as soon as a number goes bad, before its round is yielded.
        """
        while len(self.records) < self.config.episodes:
            start = len(self.records)
            updating = False
            try:
                rollout = self.collect()
                updating = True
                credit = self.adapt(rollout)
                update = self.improve(rollout)
                done = len(self.diagnostics) + 1, len(self.records), self.records[-1].env_steps
                self.diagnostics.append(diagnose(done, rollout, update, credit))
            except (Exception, SystemExit, GeneratorExit) as error:
                run = f"{self.config.environment} {self.config.variant} seed {self.config.seed}"
                played = len(self.records)
                where = (
                    f"the update after episode {played}" if updating else f"episode {played + 1}"
                )
                if isinstance(error, Refusal):
                    raise type(error)(f"{run}, {where}: {error}") from error.__cause__
                if not isinstance(error, Exception):
                    raise Refusal(f"{run}, {where}: code raised {error!r}") from error
                error.add_note(f"in {run}, {where}")
                raise
            yield self.records[start:]

    def collect(self) -> Rollout:
        """Play episodes with the current policy until a rollout is full."""
        policy = self.ppo.acting_policy()
        rollout = Rollout()
        collected = 0
        wanted = self.config.ppo.rollout_steps
        while collected < wanted and len(self.records) < self.config.episodes:
            noise = draw_noise(self.environment, self.noise)
            self.last_episodes.begin(self.environment)
            episode = self.play(self.environment, policy, noise)
            self.last_episodes.end(episode)
            item = self.appraise(episode)
            own_units = self.config.ppo.normalise_returns
            rollout.append(item.with_normalised_returns() if own_units else item)
            collected += len(episode)
        return rollout

    def appraise(self, episode: Episode) -> Experience:
        """Curiosity bonus, advantages and β of a finished episode, which then becomes memory."""
        observations = self.ppo.normalise(episode.observations)
        unit = self.ppo.unit("extrinsic")
        extrinsic_advantages, extrinsic_returns = self.ppo.advantages_and_returns(
            "extrinsic", observations, episode.rewards, episode.terminated
        )
        if self.records and self.ppo.unit("extrinsic") > 1e6 * unit:
            logger.warning(
                "%s: the rewards of episode %d are so large that others now count for a millionth",
                *(self.config.environment, len(self.records) + 1),
            )
        beta, bonus, intrinsic_scale = 0.0, None, 1.0
        reward = intrinsic_advantages = intrinsic_returns = np.zeros(len(episode))
        if self.curiosity is not None and self.controller is not None:
            beta = float(numbers("β", self.controller.beta, ()))
            require_within("β", beta, largest=LARGEST_BETA)
            bonus = self.curiosity.bonus(episode)
            reward = numbers("the curiosity bonus", bonus.reward, (len(episode),))
            largest = min(self.curiosity.largest, TOO_LARGE)
            require_within("the curiosity bonus", reward, 1e-6, largest)
            reward = np.maximum(reward, 0.0)
            intrinsic_advantages, intrinsic_returns = self.ppo.advantages_and_returns(
                "intrinsic", observations, reward, episode.terminated
            )
            intrinsic_scale = self.ppo.advantage_scale("intrinsic")
            paid = paid_returns(episode.rewards, self.config.ppo.discount)
            self.curiosity.remember(episode, paid)
            self.controller.next_episode(episode, reward)
        self._record(episode, reward, beta)
        return Experience(
            episode=episode,
            observations=observations[:-1],
            beta=beta,
            bonus=bonus,
            extrinsic_advantages=extrinsic_advantages,
            extrinsic_returns=extrinsic_returns,
            intrinsic_advantages=intrinsic_advantages,
            intrinsic_returns=intrinsic_returns,
            extrinsic_scale=self.ppo.advantage_scale("extrinsic"),
            intrinsic_scale=intrinsic_scale,
        )

    def _record(self, episode: Episode, bonus: np.ndarray, beta: float) -> None:
        before = self.records[-1].env_steps if self.records else 0
        self.records.append(
            EpisodeRecord(
                episode=len(self.records) + 1,
                env_steps=before + len(episode),
                length=len(episode),
                extrinsic_return=total(episode.rewards),
                intrinsic_return=rounded(total(bonus)),
                beta=rounded(beta),
                terminated=int(episode.terminated),
            )
        )

    def adapt(self, rollout: Rollout) -> float | None:
        """Meta-adaptation: tell the controller what β changes in the update, before it.

        The update steps along the policy gradient g of the normalised total advantage, as Adam
        preconditions it. Shown are dg/dβ, preconditioned alike, and g_E, that of the extrinsic
        advantage. Returns the credit of an earlier β, None if there is none.
        """
        if self.controller is None:
            return None
        self.controller.end_rollout()
        if not self.controller.learns:
            return None
        centred, learner = self.config.ppo.centre_advantages, self.ppo.learner
        extrinsic, intrinsic, _, weighed = rollout.advantages
        if centred:
            extrinsic = extrinsic - mean(extrinsic)
        change = normalised_change(weighed, intrinsic, centred)
        acted = rollout.observations, rollout.actions
        gradient, change = learner.policy_gradients(*acted, [extrinsic, change])
        effect = Effect(learner.preconditioned(change), root_mean_square(intrinsic))
        return self.controller.learn(gradient, root_mean_square(extrinsic), effect)

    def improve(self, rollout: Rollout) -> Update:
        """PPO on the total reward, R_E + β R_I, whose advantage is A_E + β A_I."""
        returns = {kind: rollout.returns(kind) for kind in self.ppo.critics}
        advantages = normalised(rollout.advantages.total, self.config.ppo.centre_advantages)
        acted = rollout.observations, rollout.actions, rollout.log_probs
        update = self.ppo.update(Batch(*acted, advantages.astype(np.float32)), returns)
        for name, norm in update.gradient_norms.items():
            require_finite(f"the {name}'s gradient norm", norm)
        # What went bad in an earlier epoch is in the weights, and may be hidden by a tanh.
        for name, parameters in self.ppo.learner.parameters.items():
            require_finite(f"a weight of the {name}", parameters)
        for item in rollout:
            self.ppo.normaliser.update(item.episode.observations[:-1])
        if not self.diagnostics and (dimensions := unseen(self.ppo.normaliser)):
            logger.warning(
                "%s: differences in observation%s are below 1e-8, or below what float32 tells "
                "apart, and are not learned from: use a smaller unit, or leave an offset out",
                *(self.config.environment, dimensions),
            )
        return update

    def state_dict(self) -> dict[str, Any]:
        """Everything the rest of the run depends on, at the end of a round."""
        return {
            "ppo": self.ppo.state_dict(),
            "curiosity": self.curiosity.state_dict() if self.curiosity is not None else None,
            "controller": self.controller.state_dict() if self.controller is not None else None,
            "noise": self.noise.bit_generator.state,
            "environment": resuming.state_of(self.environment),
            "last_episodes": self.last_episodes.saved(),
            "records": as_tensors(as_columns(EpisodeRecord, self.records)),
            "diagnostics": as_tensors(as_columns(UpdateRecord, self.diagnostics)),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.ppo.load_state_dict(state["ppo"])
        if self.curiosity is not None and self.controller is not None:
            self.curiosity.load_state_dict(state["curiosity"])
            self.controller.load_state_dict(state["controller"])
        self.noise.bit_generator.state = state["noise"]
        resuming.set_state(self.environment, state["environment"])
        self.last_episodes.blocks = state["last_episodes"]
        self.records = as_rows(EpisodeRecord, state["records"])
        self.diagnostics = as_rows(UpdateRecord, state["diagnostics"])


def as_tensors(columns: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """For a checkpoint."""
    return {name: torch.from_numpy(column) for name, column in columns.items()}
