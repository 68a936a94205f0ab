"""Trained agents as ordinary torch modules.

policy = load_agent("results/runs/CartPole-v1/ppo/seed0").policy
action = policy(observation).sample()
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from mace_rl import files
from mace_rl.agent.policy import ActingPolicy, Action, NetworkActing
from mace_rl.agent.ppo import PPO
from mace_rl.agent.torch_policy import TorchPolicy
from mace_rl.config.plugins import config_of_run
from mace_rl.environments.environment import Environment
from mace_rl.numerics.normaliser import Normalisation
from mace_rl.runs.checkpoint import CheckpointError, unarchive
from mace_rl.runs.observations import encoded
from mace_rl.runs.provenance import file_digest, read_record
from mace_rl.trainer import Trainer


class PolicyModule(TorchPolicy):
    """π(·|s) for observations as the environment gives them: `mace_rl.runs.observations`."""

    mean: Tensor
    std: Tensor
    clip: Tensor

    def __init__(self, trainer: Trainer) -> None:
        super().__init__(trainer.ppo.policy)
        ppo, self.space = trainer.ppo, trainer.environment.given_space
        mean, std, clip = ppo.normalisation()
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

    def __init__(self, trainer: Trainer) -> None:
        super().__init__()
        self.policy, ppo = PolicyModule(trainer), trainer.ppo
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


def load_agent(directory: str | Path, trust: bool = False) -> Agent:
    """The agent of the finished run in `directory`. Raises what `restored` raises."""
    return restored(Path(directory), trust)[1]


def load_acting(
    directory: Path, deterministic: bool = False, trust: bool = False
) -> tuple[Environment, ActingPolicy]:
    """The environment of the finished run in `directory`, and its policy for rollouts.

    That samples its actions, or if `deterministic` takes the most probable ones. Raises what
    `restored` raises.
    """
    trainer, agent = restored(directory, trust)
    policy, loaded = trainer.ppo.policy, agent.policy
    policy.network.load_module_state(loaded.network.state_dict())
    if not policy.discrete:
        policy.log_std[:] = loaded.log_std.detach().numpy()
    mean, std, clip = loaded.mean.numpy(), loaded.std.numpy(), float(loaded.clip)
    return trainer.environment, acting(
        trainer.ppo, Normalisation.of(mean, std, clip), deterministic
    )


def acting(ppo: PPO, normalisation: Normalisation, deterministic: bool) -> ActingPolicy:
    """The policy for rollouts: it samples its actions, or takes the most probable ones."""
    if deterministic:
        return MostProbable(ppo.policy, normalisation)
    return ppo.learner.acting(normalisation)


def restored(directory: Path, trust: bool) -> tuple[Trainer, Agent]:
    """The trainer of the finished run in `directory` as it began, and the agent that came of it.

    Nothing in the files is executed, and of the code that they name only this package's unless
    `trust`: `ConfigError`. Raises `CheckpointError` if `agent.pt` is not the file that `run.json`
    describes, or has something else than weights of such an agent, and `ProvenanceError` if
    `run.json` is damaged.
    """
    record = read_record(directory / files.RECORD)
    config = config_of_run(record["config"], str(directory / files.RECORD), trust)
    path = directory / files.AGENT
    if not path.exists() or file_digest(path) != record["outputs"][files.AGENT]:
        raise CheckpointError(f"{path}: missing, cut off or altered (SHA-256 not as in run.json)")
    state = unarchive(path.read_bytes(), path)
    trainer = Trainer(config)
    agent = Agent(trainer)
    wanted = agent.state_dict()
    for name in [*wanted, *state]:
        found, right = _kind(state.get(name)), _kind(wanted.get(name))
        if found != right:
            raise CheckpointError(f"{path}: {name} is {found}, but should be {right}")
        bad = state[name].isnan() if name == "policy.clip" else ~state[name].isfinite()
        if bad.any():
            raise CheckpointError(f"{path}: {name} has NaN or Inf in it")
    agent.load_state_dict(state)
    return trainer, agent


def _kind(entry: Any) -> str:
    """What an entry of a state is, without its values."""
    if isinstance(entry, Tensor):
        return f"{entry.layout} {entry.dtype} of shape {tuple(entry.shape)}"
    return "missing" if entry is None else f"a {type(entry).__name__}"
