"""Playing with a trained agent: load `agent.pt` safely, roll out, report the returns."""

from pathlib import Path

import numpy as np

from mace_rl.checkpoint import CheckpointError, unarchive
from mace_rl.hyperparameters import RunConfig, check
from mace_rl.provenance import file_digest, read_record
from mace_rl.rollout import draw_noise
from mace_rl.train import Trainer


def load_agent(directory: Path) -> Trainer:
    """The agent that a finished run left in `directory`, in a fresh `Trainer`.

    Nothing in the file is executed. Raises `CheckpointError` if `agent.pt` is not the file that
    `run.json` describes, `ProvenanceError` if that is damaged.
    """
    record = read_record(directory / "run.json")
    path = directory / "agent.pt"
    if not path.exists() or file_digest(path) != record["outputs"]["agent.pt"]:
        raise CheckpointError(f"{path}: missing, cut off or altered (SHA-256 not as in run.json)")
    agent = unarchive(path.read_bytes(), path)
    trainer = Trainer(check(RunConfig, record["config"], str(directory / "run.json")))
    networks = {"actor": trainer.ppo.actor} | trainer.ppo.critics
    for name, network in networks.items():
        network.parameters[:] = agent["networks"][name]["parameters"].numpy()
    trainer.ppo.standardiser.load_state_dict(agent["standardiser"])
    return trainer


def evaluate(directory: Path, episodes: int, seed: int) -> np.ndarray:
    """Undiscounted extrinsic returns, [episodes], of the agent in `directory`.

    It acts as it did in training, by sampling. Environment and actions draw from `seed`.
    """
    trainer = load_agent(directory)
    generator = np.random.default_rng(seed)
    trainer.environment.env.reset(seed=seed)
    returns = np.empty(episodes)
    for episode in range(episodes):
        noise = draw_noise(trainer.environment, generator)
        played = trainer.rollout(trainer.environment, trainer.ppo.acting_policy(), noise)
        returns[episode] = played.rewards.sum()
    return returns
