"""Trained agents as torch modules, and playing with them.

policy = load_agent("results/runs/CartPole-v1/ppo/seed0").policy
action = policy(observation).sample()
"""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from torch import Tensor
from torch.distributions import Distribution

from mace_rl import published
from mace_rl.agent.policy import ActingPolicy, NetworkActing
from mace_rl.agent.ppo import ActorCritic
from mace_rl.agent.torch_policy import TorchPolicy
from mace_rl.base import files
from mace_rl.base.rng import Streams
from mace_rl.config.run import AgentConfig
from mace_rl.environments.actions import Action
from mace_rl.environments.environment import LOST
from mace_rl.numerics.normaliser import Normalisation
from mace_rl.runs.agent_state import ENVIRONMENT
from mace_rl.runs.checkpoint import CheckpointError
from mace_rl.runs.finished import FinishedRun
from mace_rl.runs.observations import encoded
from mace_rl.training.factories import actor_critic, environment

logger = logging.getLogger(__name__)


class PolicyModule(TorchPolicy):
    """π(·|s) for observations as the environment gives them: `mace_rl.runs.observations`."""

    mean: Tensor
    std: Tensor
    clip: Tensor

    def __init__(self, networks: ActorCritic, space: Space[Any]) -> None:
        """space: of the environment's observations."""
        super().__init__(networks.policy)
        self.space = space
        for name, value in zip(("mean", "std", "clip"), networks.normalisation(), strict=True):
            self.register_buffer(name, torch.from_numpy(np.array(value)))

    def forward(self, observations: Any) -> Distribution:
        """The distribution over actions in each state; observations: one, or a batch of them.

        Discrete actions count from 0; the others are not clipped to their bounds. Raises
        `ObservationError` for other inputs.
        """
        rows = encoded(observations, self.space, len(self.mean)).to(self.mean.device)
        return super().forward(self.normalised(rows))

    def normalised(self, rows: Tensor) -> Tensor:
        """What the network sees of flat observations, [N, observation]."""
        return ((rows - self.mean) / self.std).clip(-self.clip, self.clip).float()


class Outputs(torch.nn.Module):
    """Flat observations, float32 [N, observation] → logits of actions, or their means.

    Plain PyTorch: what `torch.export` or `torch.onnx.export` makes of it needs no mace_rl.
    """

    def __init__(self, policy: PolicyModule) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, rows: Tensor) -> Tensor:
        return self.policy.network(self.policy.normalised(rows))


class Agent(torch.nn.Module):
    """The policy, and the critics, which take normalised observations."""

    def __init__(self, networks: ActorCritic, space: Space[Any]) -> None:
        super().__init__()
        self.policy = PolicyModule(networks, space)
        critics = {kind: critic.module() for kind, critic in networks.critics.items()}
        self.critics = torch.nn.ModuleDict(critics)

    @property
    def outputs(self) -> Outputs:
        """What the policy computes before it becomes a distribution, to export."""
        return Outputs(self.policy)


@dataclass(frozen=True)
class MostProbable(NetworkActing):
    """Acts without sampling: the first most probable action, or the mean of a Gaussian."""

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        outputs = self.outputs(observation)
        action: Action = outputs[0]
        if self.policy.discrete:
            action = int(outputs[0].argmax())
        elif len(self.policy.parts):
            each = np.split(outputs[0], self.policy.parts.cumsum()[:-1])
            action = np.array([part.argmax() for part in each])
        return action, self.policy.log_probs(outputs, np.array([action]))[0]


def load_agent(directory: str | Path, trust: bool = False) -> Agent:
    """The agent of the finished run in `directory`.

    Nothing in the files is executed. `ConfigError` if they name code from outside this package,
    unless `trust`. Raises `CheckpointError` if `agent.pt` is not of such an agent, and what the
    parts of a `FinishedRun` raise.
    """
    player = Player.of(FinishedRun(directory, trust))
    player.environment.env.close()
    return player.agent


class Player:
    """The environment of a run and its agent, untrained at first, without a trainer."""

    memory: dict[str, Any]  # what its environment learned; nothing of an untrained one

    def __init__(self, config: AgentConfig) -> None:
        streams, self.memory = Streams(config.seed), {}
        self.environment = environment(config, streams)
        if config.trainer == "published":
            self.networks = published.networks(config, self.environment, streams)
        else:
            bonus = config.bonus is not None
            self.networks = actor_critic(config, self.environment, bonus, streams)
        self.agent = Agent(self.networks, self.environment.given_space)

    @classmethod
    def of(cls, run: FinishedRun) -> "Player":
        """With the trained agent of `run`; raises what `load_agent` raises."""
        player, state = cls(run.agent_config), dict(run.agent_state)
        player.memory = state.pop(ENVIRONMENT, {})
        player._load(state, run.folder / files.AGENT)
        player.environment.recall(player.memory)
        if lost := player.memory.get(LOST):
            said = "%s: what %s learned in training is not in agent.pt, and it begins anew"
            logger.warning(said, run.folder, lost)
        return player

    def _load(self, state: dict[str, Any], path: Path) -> None:
        wanted = self.agent.state_dict()
        for name in [*wanted, *state]:
            found, right = (
                _kind(kept[name]) if name in kept else "missing" for kept in (state, wanted)
            )
            if found != right:
                raise CheckpointError(f"{path}: {name} is {found}, but should be {right}")
            bad = state[name].isnan() if name == "policy.clip" else ~state[name].isfinite()
            bad |= (state[name] <= 0) & (name in ("policy.std", "policy.clip"))
            if bad.any():
                raise CheckpointError(f"{path}: {name} has NaN or Inf in it, or is not positive")
        self.agent.load_state_dict(state)
        policy, loaded = self.networks.policy, self.agent.policy
        policy.network.load_module_state(loaded.network.state_dict())

    def acting(self, deterministic: bool) -> ActingPolicy:
        """The policy for rollouts, which samples actions, or takes the most probable ones."""
        policy, module = self.networks.policy, self.agent.policy
        mean, std, clip = module.mean.numpy(), module.std.numpy(), float(module.clip)
        normalisation = Normalisation.of(mean, std, clip)
        if deterministic:
            return MostProbable(policy, normalisation)
        return self.networks.learner_of.acting(policy, normalisation)


def _kind(entry: Any) -> str:
    """The type and shape of an entry of a state, for messages."""
    if isinstance(entry, Tensor) and not entry.is_nested:  # which has no shape
        return f"{entry.device} {entry.layout} {entry.dtype} of shape {tuple(entry.shape)}"
    return f"a {type(entry).__name__}"
