"""Trained agents as ordinary torch modules.

policy = load_agent("results/runs/CartPole-v1/ppo/seed0").policy
action = policy(observation).sample()
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from torch import Tensor
from torch.distributions import Distribution

from mace_rl import files
from mace_rl.agent.policy import ActingPolicy, Action, NetworkActing
from mace_rl.agent.ppo import ActorCritic
from mace_rl.agent.torch_policy import TorchPolicy
from mace_rl.config.run import AgentConfig
from mace_rl.factories import actor_critic, environment
from mace_rl.numerics.normaliser import Normalisation
from mace_rl.runs.checkpoint import CheckpointError
from mace_rl.runs.finished import FinishedRun
from mace_rl.runs.observations import encoded
from mace_rl.streams import Streams


class PolicyModule(TorchPolicy):
    """π(·|s) for observations as the environment gives them: `mace_rl.runs.observations`."""

    mean: Tensor
    std: Tensor
    clip: Tensor

    def __init__(self, networks: ActorCritic, space: Space[Any]) -> None:
        """space: that of what the environment gives."""
        super().__init__(networks.policy)
        self.space = space
        mean, std, clip = networks.normalisation()
        self.register_buffer("mean", torch.from_numpy(mean.copy()))
        self.register_buffer("std", torch.from_numpy(std.copy()))
        self.register_buffer("clip", torch.from_numpy(np.array(clip)))

    def forward(self, observations: Any) -> Distribution:
        """The distribution over actions in each state; observations: one, or a batch of them.

        Discrete actions count from 0; the others are not clipped to their bounds. Raises
        `ObservationError` for what is no observation.
        """
        rows = encoded(observations, self.space, len(self.mean)).to(self.mean.device)
        seen = ((rows - self.mean) / self.std).clip(-self.clip, self.clip).float()
        return super().forward(seen)


class Agent(torch.nn.Module):
    """The policy and the critics, whose inputs are observations normalised as the policy's."""

    def __init__(self, networks: ActorCritic, space: Space[Any]) -> None:
        super().__init__()
        self.policy = PolicyModule(networks, space)
        critics = {kind: critic.module() for kind, critic in networks.critics.items()}
        self.critics = torch.nn.ModuleDict(critics)


@dataclass(frozen=True)
class MostProbable(NetworkActing):
    """Acting without chance: the most probable action, the first of several; the mean of a Box."""

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        """See `ActingPolicy`; the noise does not matter."""
        outputs = self.outputs(observation)
        action = int(outputs[0].argmax()) if self.policy.discrete else outputs[0]
        return action, self.policy.log_probs(outputs, np.array([action]))[0]


def load_agent(directory: str | Path, trust: bool = False) -> Agent:
    """The agent of the finished run in `directory`.

    Nothing in the files is executed, and of the code that they name only this package's unless
    `trust`: `ConfigError`. Raises `CheckpointError` if `agent.pt` has something else than weights
    of such an agent, and what the parts of a `FinishedRun` raise.
    """
    return Player.of(FinishedRun(directory, trust)).agent


class Player:
    """The environment of a run and its agent, without what trains that; untrained at first."""

    def __init__(self, config: AgentConfig) -> None:
        streams = Streams(config.seed)
        self.environment = environment(config, streams)
        self.networks = actor_critic(config, self.environment, config.bonus is not None, streams)
        self.agent = Agent(self.networks, self.environment.given_space)

    @classmethod
    def of(cls, run: FinishedRun) -> "Player":
        """With the agent that came of `run`; raises what `load_agent` raises."""
        player = cls(run.agent_config)
        player._load(run.agent_state, run.folder / files.AGENT)
        return player

    def _load(self, state: dict[str, Any], path: Path) -> None:
        wanted = self.agent.state_dict()
        for name in [*wanted, *state]:
            found, right = _kind(state.get(name)), _kind(wanted.get(name))
            if found != right:
                raise CheckpointError(f"{path}: {name} is {found}, but should be {right}")
            bad = state[name].isnan() if name == "policy.clip" else ~state[name].isfinite()
            bad |= (state[name] <= 0) & (name in ("policy.std", "policy.clip"))
            if bad.any():
                raise CheckpointError(f"{path}: {name} has NaN or Inf in it, or is not positive")
        self.agent.load_state_dict(state)
        policy, loaded = self.networks.policy, self.agent.policy
        policy.network.load_module_state(loaded.network.state_dict())
        if not policy.discrete:
            policy.log_std[:] = loaded.log_std.detach().numpy()

    def acting(self, deterministic: bool) -> ActingPolicy:
        """Its policy for rollouts: it samples its actions, or takes the most probable ones."""
        policy, module = self.networks.policy, self.agent.policy
        mean, std, clip = module.mean.numpy(), module.std.numpy(), float(module.clip)
        normalisation = Normalisation.of(mean, std, clip)
        if deterministic:
            return MostProbable(policy, normalisation)
        return self.networks.learner_of.acting(policy, normalisation)


def _kind(entry: Any) -> str:
    """What an entry of a state is, without its values."""
    if isinstance(entry, Tensor):
        return f"{entry.device} {entry.layout} {entry.dtype} of shape {tuple(entry.shape)}"
    return "missing" if entry is None else f"a {type(entry).__name__}"
