"""The parts of a run, made as its settings ask for: what sets β, the bonus, PPO."""

import numpy as np
from gymnasium.spaces import Discrete

from mace_rl.agent.dictionary_critic import DictionaryCritic
from mace_rl.agent.network import Network, network
from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.agent.policy import Policy
from mace_rl.agent.ppo import PPO, Critic, NetworkCritic
from mace_rl.beta.controller import BetaController
from mace_rl.beta.controls import RandomDraw, SlidingWindowBandit
from mace_rl.beta.meta import MetaAdaptation
from mace_rl.beta.schedule import Constant, ExponentialSchedule
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.bonus.hashing import HashCounts
from mace_rl.bonus.icm import IntrinsicCuriosityModule
from mace_rl.bonus.intrinsic import IntrinsicReward
from mace_rl.bonus.rnd import RandomNetworkDistillation
from mace_rl.config.agent import DictionaryValue
from mace_rl.config.beta import (
    BanditBeta,
    BetaRule,
    ConstantBeta,
    CustomBeta,
    ExponentialBeta,
    MetaBeta,
    NoBonus,
    RandomBeta,
)
from mace_rl.config.bonus import CuriosityBonus, CustomBonus, HashCountsBonus, ICMBonus, RNDBonus
from mace_rl.config.plugins import make
from mace_rl.config.run import RunConfig
from mace_rl.environments.environment import Environment
from mace_rl.streams import Streams


def beta_controller(
    config: RunConfig, environment: Environment, streams: Streams
) -> BetaController | None:
    """What sets β in this variant; None for plain PPO."""
    match config.beta:
        case NoBonus():
            return None
        case MetaBeta(initial=initial):
            size, actions = environment.observation_size, environment.action_space
            generator = streams["meta"]
            assert config.meta is not None  # what a variant uses is there: `RunConfig`
            return MetaAdaptation(config.meta, initial, config.engine, size, actions, generator)
        case rule:
            return beta_rule(rule, config.ppo.rollout_steps, streams["beta"])


def beta_rule(
    settings: BetaRule, rollout_steps: int, generator: np.random.Generator
) -> BetaController:
    """What sets β without a network of ours; `rollout_steps`: between updates of the policy."""
    match settings:
        case ConstantBeta():
            return Constant(settings)
        case RandomBeta():
            return RandomDraw(settings, generator)
        case BanditBeta():
            return SlidingWindowBandit(settings, rollout_steps, generator)
        case ExponentialBeta():
            return ExponentialSchedule(settings)
        case CustomBeta(rule=rule, arguments=arguments):
            return make(rule, "beta.rule", BetaController, False, generator, **arguments)


def intrinsic_reward(
    config: RunConfig, environment: Environment, streams: Streams
) -> IntrinsicReward | None:
    """What β weighs: the curiosity bonus with its memory and novelty, or another; None in PPO."""
    space, size = environment.observation_space, environment.observation_size
    actions, generator, engine = environment.action_space, streams["bonus"], config.engine
    match config.bonus:
        case None:
            return None
        case CuriosityBonus():
            assert config.novelty is not None  # as above
            return Curiosity(config.memory, config.novelty, engine, space, size, streams)
        case ICMBonus():
            of = config.bonus, engine, space, actions, size, generator
            return IntrinsicCuriosityModule(*of)
        case RNDBonus():
            return RandomNetworkDistillation(config.bonus, engine, space, size, generator)
        case HashCountsBonus():
            return HashCounts(config.bonus, space, size, generator)
        case CustomBonus(estimator=estimator, arguments=arguments):
            key, own = "bonus.estimator", (size, actions, generator)
            return make(estimator, key, IntrinsicReward, False, *own, **arguments)


def ppo(config: RunConfig, environment: Environment, intrinsic: bool, streams: Streams) -> PPO:
    """Policy and critics, one for each kind of reward."""
    space, size = environment.action_space, environment.observation_size

    def new(outputs: int, output_gain: float, stream: str) -> Network:
        return network(config.ppo, config.engine, size, outputs, output_gain, streams[stream])

    actions = int(space.n) if isinstance(space, Discrete) else space.shape[0]
    # A small last layer starts near the uniform policy, or at means near 0.
    policy = Policy(new(actions, 0.01, "actor"), space, config.ppo.initial_log_std)
    kinds = ["extrinsic", "intrinsic"] if intrinsic else ["extrinsic"]
    normaliser = RunningNormaliser(size)

    def critic(kind: str) -> Critic:
        settings = config.ppo.critic
        if isinstance(settings, DictionaryValue):
            normalised = config.ppo.normalise_observations
            return DictionaryCritic(kind, settings, normaliser, normalised)
        return NetworkCritic(kind, new(1, 1.0, f"{kind}_critic"), config.ppo)

    critics = {kind: critic(kind) for kind in kinds}
    return PPO(config.ppo, policy, critics, normaliser, streams["minibatches"])
