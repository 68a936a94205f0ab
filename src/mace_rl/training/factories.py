"""The parts of a run, made from its settings: what sets β, the bonus, the environment, PPO."""

import numpy as np

from mace_rl.agent.compiled_learner import CompiledLearner
from mace_rl.agent.learner import Learner
from mace_rl.agent.policy import Policy
from mace_rl.agent.ppo import PPO, ActorCritic
from mace_rl.base.rng import Streams
from mace_rl.beta.controller import BetaController
from mace_rl.beta.credit import Credit, Evidence
from mace_rl.beta.meta import MetaAdaptation
from mace_rl.beta.objectives import Objective, Progress, Return, Score, Words
from mace_rl.beta.schedule import Constant, ExponentialSchedule
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.bonus.intrinsic import IntrinsicReward
from mace_rl.config.agent import PPOConfig, TorchModule
from mace_rl.config.beta import (
    BetaRule,
    ConstantBeta,
    CreditObjective,
    CustomBeta,
    EvidenceObjective,
    ExponentialBeta,
    MetaBeta,
    MetaConfig,
    MetaObjective,
    NoBonus,
    ProgressObjective,
    ReturnObjective,
    ScoreObjective,
    WordsObjective,
)
from mace_rl.config.bonus import CuriosityBonus, CustomBonus
from mace_rl.config.plugins import load, make
from mace_rl.config.run import AgentConfig, RunConfig
from mace_rl.config.section import ConfigError
from mace_rl.environments.environment import Environment
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.network import CompiledMLP, Network, mlp
from mace_rl.numerics.normaliser import RunningNormaliser


def beta_controller(
    config: RunConfig, environment: Environment, streams: Streams
) -> BetaController | None:
    """What sets β in this variant; None for plain PPO."""
    match config.beta:
        case NoBonus():
            return None
        case MetaBeta() as beta:
            assert config.meta is not None  # `RunConfig` checked that
            return meta_adaptation(beta, config.meta, environment, config.engine, streams)
        case ConstantBeta() | ExponentialBeta() | CustomBeta() as rule:
            return beta_rule(rule, streams["beta"], config.episodes)


def meta_adaptation(
    beta: MetaBeta, config: MetaConfig, spaces: Spaces, engine: str, streams: Streams
) -> MetaAdaptation:
    """The meta-adaptation network, which is to set β."""
    assert beta.objective is not None  # whoever checked `beta` saw to that
    objective = meta_objective(beta.objective, config.sequences, streams["exploration"])
    return MetaAdaptation(config, objective, beta.initial, spaces, engine, streams["meta"])


def meta_objective(
    settings: MetaObjective, sequences: int, generator: np.random.Generator
) -> Objective:
    """What the meta network learns from."""
    match settings:
        case ReturnObjective():
            return Return(settings)
        case ScoreObjective():
            return Score(settings, generator)
        case ProgressObjective():
            return Progress(settings, generator)
        case WordsObjective():
            return Words(settings)
        case EvidenceObjective():
            return Evidence(settings, sequences)
        case CreditObjective():
            return Credit(settings, sequences)


def beta_rule(
    settings: BetaRule, generator: np.random.Generator, episodes: int | None = None
) -> BetaController:
    """What sets β, unless it is the meta network; episodes: the budget, None if nobody knows it."""
    match settings:
        case ConstantBeta():
            return Constant(settings)
        case ExponentialBeta():
            return ExponentialSchedule(settings)
        case CustomBeta(rule=rule, arguments=arguments):
            budget = {}
            if getattr(load(rule, "beta.rule"), "needs_budget", False):
                if episodes is None:
                    raise ConfigError(f"beta.rule has {rule!r}, which needs to know the budget")
                budget = {"episodes": episodes}
            return make(rule, "beta.rule", BetaController, False, generator, **budget, **arguments)


def intrinsic_reward(
    config: RunConfig, environment: Environment, streams: Streams
) -> IntrinsicReward | None:
    """The bonus that β weighs: curiosity, or a user's own; None in plain PPO."""
    match config.bonus:
        case None:
            return None
        case CuriosityBonus():
            assert config.novelty is not None
            space, size = environment.given_space, environment.observation_size
            return Curiosity(config.memory, config.novelty, space, size, streams)
        case CustomBonus(estimator=estimator, arguments=arguments):
            key, stream = "bonus.estimator", streams["bonus"]
            return make(estimator, key, IntrinsicReward, False, environment, stream, **arguments)


def environment(config: AgentConfig, streams: Streams) -> Environment:
    """The environment that the agent acts in."""
    made = Environment(
        config.environment,
        streams.sequence("environment"),
        max_episode_steps=config.max_episode_steps,
        arguments=config.environment_arguments,
        wrappers=config.wrappers,
    )
    made.clips_actions = config.ppo.clip_actions
    return made


def actor_critic(
    config: AgentConfig, spaces: Spaces, intrinsic: bool, streams: Streams
) -> ActorCritic:
    """The untrained policy and critics, one for each kind of reward."""
    settings, size = config.ppo, spaces.observation_size
    learner: type[Learner] = CompiledLearner
    if config.engine == "torch":
        from mace_rl.agent.torch_learner import TorchLearner as learner

    def network(outputs: int, output_gain: float, stream: str) -> Network:
        sizes, generator = [size, *settings.hidden_units, outputs], streams[stream]
        if config.engine == "torch":
            return torch_network(settings, sizes, output_gain, generator)
        return CompiledMLP(mlp(sizes, output_gain, generator))

    # With a small last layer the policy starts near uniform, or with means near 0.
    actor = network(spaces.action_size, 0.01, "actor")
    policy = Policy(actor, spaces.actions, settings.initial_log_std)
    kinds = ["extrinsic", "intrinsic"] if intrinsic else ["extrinsic"]
    critics = {kind: network(1, 1.0, f"{kind}_critic") for kind in kinds}
    return ActorCritic(settings, policy, critics, RunningNormaliser(size), learner)


def torch_network(
    settings: PPOConfig, sizes: list[int], output_gain: float, generator: np.random.Generator
) -> Network:
    """The user's own network, or the tanh network, in torch."""
    from mace_rl.agent.custom import custom_module
    from mace_rl.numerics.torch_network import TorchNetwork, tanh_layers

    if not isinstance(settings.network, TorchModule):
        return TorchNetwork(tanh_layers(mlp(sizes, output_gain, generator)))
    inputs, outputs = sizes[0], sizes[-1]
    units = settings.hidden_units
    return TorchNetwork(custom_module(settings.network, units, inputs, outputs, generator))


def ppo(config: AgentConfig, spaces: Spaces, intrinsic: bool, streams: Streams) -> PPO:
    """Policy and critics with their learner."""
    return PPO(actor_critic(config, spaces, intrinsic, streams), streams["minibatches"])
