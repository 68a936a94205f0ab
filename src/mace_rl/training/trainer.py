"""MACE-RL, the whole method: read this file first.

    R_total = R_extrinsic + β · R_curiosity                                            (paper)

One `Trainer` is one run. Each round plays whole episodes with the current policy, finds the
advantages of each episode's reward and of its curiosity bonus, and lets it become memory
(`collect`, `advantages`). Then the β controller learns (`meta_update`), and PPO updates the policy
with both advantages, weighed by β (`ppo_update`). What they use is in the folders `agent` (PPO),
`bonus` (novelty, episodic memory), `beta` (schedules, meta network) and `environments`; `factories`
makes it as the settings ask for. Where β meets the bonus: `experience.weigh`; before that, where
`ppo.normalise_returns` asks for returns in units of each episode's total reward (*plain*),
`Experience.with_normalised_returns`; in the public code's trainer, `published`, the reward itself.
PPO's clipped loss: `agent.torch_learner`; its gradient in compiled code: `agent.compiled_learner`.
What the meta network learns from: `beta.objectives`.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from mace_rl.agent.advantages import discounted_returns, normalised, normalised_change
from mace_rl.agent.learner import Batch, Update
from mace_rl.agent.policy import ActingPolicy
from mace_rl.base.rng import Streams
from mace_rl.base.state import saved
from mace_rl.beta.controller import BetaGradient
from mace_rl.bonus.intrinsic import Bonus
from mace_rl.config.run import RunConfig
from mace_rl.environments.episode import Episode
from mace_rl.numerics.arrays import mean, root_mean_square, total
from mace_rl.training import resuming
from mace_rl.training.checks import (
    checked_beta,
    checked_bonus,
    located,
    require_learned,
    warn_of_observations,
    warn_of_rewards,
)
from mace_rl.training.diagnostics import diagnose
from mace_rl.training.experience import Experience, Rollout, without_bonus
from mace_rl.training.factories import beta_controller, environment, intrinsic_reward, ppo
from mace_rl.training.records import EpisodeRecord, UpdateRecord, as_columns, as_rows, rounded
from mace_rl.training.rollout import draw_noise, rollout_for


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
        self.cut = False  # whether the budget ended the last rollout before it was full
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
            rollout = self.collect()
            with located(self.config, f"the update after episode {len(self.records)}"):
                credit = self.meta_update(rollout)
                update = self.ppo_update(rollout)
                count = len(self.diagnostics) + 1, len(self.records), self.records[-1].env_steps
                self.diagnostics.append(diagnose(count, rollout, update, credit))
            yield self.records[start:]

    def collect(self) -> Rollout:
        """Play episodes with the current policy until a rollout is full."""
        policy, rollout, steps = self.ppo.acting_policy(), Rollout(), 0
        while steps < self.config.ppo.rollout_steps and len(self.records) < self.config.episodes:
            with located(self.config, f"episode {len(self.records) + 1}"):
                episode = self.play_episode(policy)
                item = self.advantages(episode)
                own_units = self.config.ppo.normalise_returns
                rollout.append(item.with_normalised_returns() if own_units else item)
                steps += len(episode)
        self.cut = steps < self.config.ppo.rollout_steps
        return rollout

    def play_episode(self, policy: ActingPolicy) -> Episode:
        """One, with random numbers that are drawn beforehand."""
        noise = draw_noise(self.environment, self.noise)
        self.last_episodes.begin(self.environment)
        episode = self.play(self.environment, policy, noise)
        self.last_episodes.end(episode)
        return episode

    def advantages(self, episode: Episode) -> Experience:
        """Bonus, β and the advantages of both rewards; then the episode becomes memory."""
        observations = self.ppo.normalise(episode.observations)
        unit = self.ppo.unit("extrinsic")
        ends = episode.terminated
        extrinsic = self.ppo.advantages("extrinsic", observations, episode.rewards, ends)
        warn_of_rewards(self.config, unit, self.ppo.unit("extrinsic"), len(self.records) + 1)
        beta, bonus, intrinsic = 0.0, None, without_bonus(len(episode))
        if self.curiosity is not None and self.controller is not None:
            beta, bonus = checked_beta(self.controller), checked_bonus(self.curiosity, episode)
            intrinsic = self.ppo.advantages("intrinsic", observations, bonus.reward, ends)
            returns = discounted_returns(episode.rewards, self.config.ppo.discount)
            self.curiosity.remember(episode, returns)
            self.controller.next_episode(episode, bonus.reward)
        self.record(episode, bonus, beta)
        return Experience(episode, observations[:-1], beta, bonus, extrinsic, intrinsic)

    def record(self, episode: Episode, bonus: Bonus | None, beta: float) -> None:
        """Its row of `episodes.csv`."""
        before = self.records[-1].env_steps if self.records else 0
        self.records.append(
            EpisodeRecord(
                episode=len(self.records) + 1,
                env_steps=before + len(episode),
                length=len(episode),
                extrinsic_return=total(episode.rewards),
                intrinsic_return=rounded(total(bonus.reward)) if bonus else 0.0,
                beta=rounded(beta),
                terminated=int(episode.terminated),
            )
        )

    def meta_update(self, rollout: Rollout) -> float | None:
        """Show the β controller how β changes the policy's coming update.

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
        extrinsic, intrinsic, _, whole = rollout.advantages
        if centred:
            extrinsic = extrinsic - mean(extrinsic)
        change = normalised_change(whole, intrinsic, centred)
        gradient, of_change = learner.policy_gradients(
            rollout.observations, rollout.actions, [extrinsic, change]
        )
        of_beta = BetaGradient(learner.preconditioned(of_change), root_mean_square(intrinsic))
        return self.controller.learn(gradient, root_mean_square(extrinsic), of_beta)

    def ppo_update(self, rollout: Rollout) -> Update:
        """PPO on the total reward, R_E + β R_I, whose advantage is A_E + β A_I."""
        advantages = normalised(rollout.advantages.total, self.config.ppo.centre_advantages)
        batch = Batch(
            observations=rollout.observations,
            actions=rollout.actions,
            log_probs=rollout.log_probs,
            advantages=advantages.astype(np.float32),
        )
        update = self.ppo.update(batch, {kind: rollout.returns(kind) for kind in self.ppo.critics})
        require_learned(update, self.ppo.learner)
        for item in rollout:
            self.ppo.normaliser.update(item.episode.observations[:-1])
        if not self.diagnostics:
            warn_of_observations(self.config, self.ppo.normaliser)
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
            "records": saved(as_columns(EpisodeRecord, self.records)),
            "diagnostics": saved(as_columns(UpdateRecord, self.diagnostics)),
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
