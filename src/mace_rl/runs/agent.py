"""Trained agents as ordinary torch modules.

policy = load_agent("results/runs/CartPole-v1/ppo/seed0").policy
action = policy(observation).sample()
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, Normal

from mace_rl import files
from mace_rl.agent import kernels
from mace_rl.agent.policy import ActingPolicy, Action, NetworkActing, Policy
from mace_rl.agent.ppo import PPO
from mace_rl.config.run import RunConfig
from mace_rl.config.section import check
from mace_rl.environments.environment import Environment
from mace_rl.runs.checkpoint import CheckpointError, unarchive
from mace_rl.runs.provenance import file_digest, read_record
from mace_rl.trainer import Trainer


class PolicyModule(torch.nn.Module):
    """π(·|s) for observations as the environment gives them (Discrete ones: one-hot)."""

    mean: Tensor
    std: Tensor
    clip: Tensor

    def __init__(self, ppo: PPO) -> None:
        super().__init__()
        self.network = ppo.policy.network.module()
        self.discrete = ppo.policy.discrete
        if not self.discrete:
            self.log_std = torch.nn.Parameter(torch.from_numpy(ppo.policy.log_std.copy()))
        mean, std, clip = ppo.normalisation()
        self.register_buffer("mean", torch.from_numpy(mean.copy()))
        self.register_buffer("std", torch.from_numpy(std.copy()))
        self.register_buffer("clip", torch.from_numpy(np.array(clip)))

    def forward(self, observations: Tensor) -> Distribution:
        """The distribution over actions in each state; observations: [..., observation].

        Discrete actions count from 0; the others are not clipped to their bounds.
        """
        observations = torch.as_tensor(observations)
        seen = ((observations - self.mean) / self.std).clip(-self.clip, self.clip).float()
        outputs = self.network(seen)
        if self.discrete:
            return Categorical(logits=outputs)
        return Independent(Normal(outputs, self.log_std.exp()), 1)


class Agent(torch.nn.Module):
    """The policy and the critics, whose inputs are observations normalised as the policy's."""

    def __init__(self, ppo: PPO) -> None:
        super().__init__()
        self.policy = PolicyModule(ppo)
        self.critics = torch.nn.ModuleDict(
            {kind: critic.module() for kind, critic in ppo.critics.items()}
        )


@dataclass(frozen=True)
class MostProbable(NetworkActing):
    """Acting without chance: the most probable action, the first of several; the mean of a Box."""

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        """See `ActingPolicy`; the noise does not matter."""
        seen = np.empty_like(self.mean)
        kernels.normalise(observation, self.mean, self.inverse_std, self.clip, seen)
        with torch.no_grad():
            outputs = self.policy.network.forward(seen[None]).outputs
        action = int(outputs[0].argmax()) if self.policy.discrete else outputs[0]
        return action, self.policy.log_probs(outputs, np.array([action]))[0]


def load_agent(directory: str | Path) -> Agent:
    """The agent of the finished run in `directory`. Raises what `read_agent` raises."""
    config, state = read_agent(Path(directory))
    agent = Agent(Trainer(config).ppo)
    agent.load_state_dict(state)
    return agent


def load_acting(directory: Path, deterministic: bool = False) -> tuple[Environment, ActingPolicy]:
    """The environment of the finished run in `directory`, and its policy for rollouts.

    That samples its actions, or if `deterministic` takes the most probable ones. Raises what
    `read_agent` raises.
    """
    config, state = read_agent(directory)
    trainer = Trainer(config)
    policy, prefix = trainer.ppo.policy, "policy.network."
    policy.network.load_module_state(
        {n.removeprefix(prefix): tensor for n, tensor in state.items() if n.startswith(prefix)}
    )
    if not policy.discrete:
        policy.log_std[:] = state["policy.log_std"].numpy()
    mean, std = state["policy.mean"].numpy(), state["policy.std"].numpy()
    clip = float(state["policy.clip"])
    return trainer.environment, acting(policy, mean, std, clip, deterministic)


def acting(
    policy: Policy, mean: np.ndarray, std: np.ndarray, clip: float, deterministic: bool
) -> ActingPolicy:
    """The policy for rollouts, with observation normalisation in front of it.

    It samples its actions, or if `deterministic` takes the most probable ones.
    """
    if not deterministic:
        return policy.for_acting(mean, std, clip)
    unit = (1.0 / std).astype(np.float32)
    return MostProbable(policy, mean.astype(np.float32), unit, np.float32(clip))


def read_agent(directory: Path) -> tuple[RunConfig, dict[str, Tensor]]:
    """The configuration and the `Agent.state_dict` of the finished run in `directory`.

    Nothing in the file is executed. Raises `CheckpointError` if `agent.pt` is not the file that
    `run.json` describes, `ProvenanceError` if that is damaged.
    """
    record = read_record(directory / files.RECORD)
    path = directory / files.AGENT
    if not path.exists() or file_digest(path) != record["outputs"][files.AGENT]:
        raise CheckpointError(f"{path}: missing, cut off or altered (SHA-256 not as in run.json)")
    config = check(RunConfig, record["config"], str(directory / files.RECORD))
    return config, unarchive(path.read_bytes(), path)
