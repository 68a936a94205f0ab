"""Trained agents as ordinary torch modules.

policy = load_agent("results/runs/CartPole-v1/ppo/seed0").policy
action = policy(observation).sample()
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from mace_rl import files
from mace_rl.agent.policy import ActingPolicy, Action, NetworkActing
from mace_rl.agent.ppo import PPO
from mace_rl.agent.torch_policy import TorchPolicy
from mace_rl.config.run import RunConfig
from mace_rl.config.section import check
from mace_rl.environments.environment import Environment
from mace_rl.numerics.normaliser import Normalisation
from mace_rl.runs.checkpoint import CheckpointError, unarchive
from mace_rl.runs.provenance import file_digest, read_record
from mace_rl.trainer import Trainer


class PolicyModule(TorchPolicy):
    """π(·|s) for observations as the environment gives them (Discrete ones: one-hot)."""

    mean: Tensor
    std: Tensor
    clip: Tensor

    def __init__(self, ppo: PPO) -> None:
        super().__init__(ppo.policy)
        mean, std, clip = ppo.normalisation()
        self.register_buffer("mean", torch.from_numpy(mean.copy()))
        self.register_buffer("std", torch.from_numpy(std.copy()))
        self.register_buffer("clip", torch.tensor(clip, dtype=torch.float64))

    def forward(self, observations: Tensor) -> Distribution:
        """The distribution over actions in each state; observations: [..., observation].

        Discrete actions count from 0; the others are not clipped to their bounds.
        """
        observations = torch.as_tensor(observations)
        seen = ((observations - self.mean) / self.std).clip(-self.clip, self.clip).float()
        return super().forward(seen)


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
        outputs = self.outputs(observation)
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
    normalisation = Normalisation.of(mean, std, float(state["policy.clip"]))
    return trainer.environment, acting(trainer.ppo, normalisation, deterministic)


def acting(ppo: PPO, normalisation: Normalisation, deterministic: bool) -> ActingPolicy:
    """The policy for rollouts: it samples its actions, or takes the most probable ones."""
    if deterministic:
        return MostProbable(ppo.policy, normalisation)
    return ppo.learner.acting(normalisation)


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
