"""What several test files share: an independent derivative, environments, runs, the command."""

import copy
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from matplotlib.axis import XAxis, YAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from mace_rl import cli
from mace_rl.agent.compiled_learner import CompiledLearner
from mace_rl.agent.policy import ActingPolicy, NetworkActing, Policy
from mace_rl.agent.torch_policy import Categoricals
from mace_rl.base.files import LOCK
from mace_rl.config.run import RunConfig
from mace_rl.environments.environment import Environment
from mace_rl.environments.episode import Episode
from mace_rl.numerics.network import CompiledMLP, Network
from mace_rl.numerics.normaliser import Normalisation
from mace_rl.numerics.torch_network import TorchNetwork, tanh_layers
from mace_rl.training.trainer import Trainer

ROOT = Path(__file__).parents[1]
ENGINES = {"compiled": CompiledMLP, "torch": lambda layers: TorchNetwork(tanh_layers(layers))}
ENVIRONMENTS = ["CartPole-v1", "Acrobot-v1", "HopperBulletEnv-v0"]
VARIANTS = ["ppo", "mace_fixed", "mace_full"]
NETWORKS = ["actor", "extrinsic", "intrinsic"]
SOON = {"write_every": 1, "refresh_every": 20}  # all of novelty is at work in few episodes
LAYER_NORM = {"kind": "torch", "module": "shared:layer_norm"}  # as `ppo.network`
ARMS = {"arms": [0.1, 0.5], "window": 5, "exploration": 1.0, "epsilon": 0.3}
WEIGHED = {"lstm": True, "credit_gain": 4.0, "credit_threshold": 2.0}
WEIGHED |= {"initial": 0.4, "horizon": 10, "max_credit": 3.0}
RULE = "extras.pretrained.rule:Pretrained"
EVIDENCE = {"horizon": 10, "max_credit": 3.0, "chance": 0.3, "scale": 50.0, "gain": 6.0}
BANDIT = {"kind": "custom", "rule": "extras.bandit:Bandit", "arguments": ARMS}  # as `beta`


def pretrained(**arguments: Any) -> dict[str, Any]:
    """β by the pretrained LSTM, as `beta`."""
    return {"kind": "custom", "rule": RULE, "arguments": WEIGHED | arguments}


def learned(kind: str = "evidence", **settings: Any) -> dict[str, Any]:
    """β by the meta network, which learns from evidence or the credit, as `beta`."""
    own = EVIDENCE if kind == "evidence" else {"horizon": 10, "max_credit": 3.0}
    return {"kind": "meta", "initial": 0.4, "objective": {"kind": kind, **own, **settings}}


# A program that trains a run, given as JSON, into a folder.
TRAIN = """
import sys
from pathlib import Path
from mace_rl.config.run import RunConfig
from mace_rl.runs.run import run

run(RunConfig.model_validate_json(sys.argv[1]), Path(sys.argv[2]), keep_checkpoint=True)
"""

# What is in the folder of a run, at its end and before.
OUTCOME = ["agent.pt", "diagnostics.csv", "episodes.csv"]
RESULTS = [*OUTCOME, "run.json"]
UNFINISHED = ["checkpoint.pt", "progress.json"]

# Options of `mace-rl train` that are good.
GOOD = {"--env": "CartPole-v1", "--variant": "ppo", "--seed": "0", "--episodes": "3"}


def vector_of(name: str, count: int, mode: AutoresetMode) -> SyncVectorEnv:
    makers = [lambda: gymnasium.make(name) for _ in range(count)]
    return SyncVectorEnv(makers, autoreset_mode=mode)


class Twin:
    """A network, or a policy, as its torch module in float64: outputs, gradients by autograd."""

    def __init__(self, owner: Network | Policy) -> None:
        self.network = getattr(owner, "network", owner)
        self.module = copy.deepcopy(self.network.module()).double()
        self.parts = getattr(owner, "parts", np.zeros(0, int)).tolist()
        log_std = getattr(owner, "log_std", np.zeros(0, np.float32))  # empty: categorical
        self.log_std = torch.nn.Parameter(torch.from_numpy(log_std.astype(np.float64)))

    def parameters(self) -> list[torch.nn.Parameter]:
        return [*self.module.parameters(), self.log_std]

    def flat(self, tensors: Iterable[torch.Tensor]) -> np.ndarray:
        """Tensors shaped like `parameters()` as one vector like the network's, or policy's."""
        return laid_out(self.network, [tensor.detach().numpy() for tensor in tensors])

    def own(self) -> np.ndarray:
        """Where in the flat vector a parameter is, and not a zero added."""
        return self.flat(torch.ones_like(part) for part in self.parameters()) == 1

    def gradient(self, loss: torch.Tensor) -> np.ndarray:
        """∇ loss by autograd, as one vector."""
        options = {"materialize_grads": True, "retain_graph": True}
        return self.flat(torch.autograd.grad(loss, self.parameters(), **options))

    def __call__(self, inputs: np.ndarray) -> torch.Tensor:
        return self.module(torch.as_tensor(inputs, dtype=torch.float64))

    def policy(self, observations: np.ndarray) -> torch.distributions.Distribution:
        """π(·|s) as torch.distributions has it."""
        outputs = self(observations)
        if len(self.parts):
            return Categoricals(outputs, self.parts)
        if len(self.log_std):
            normal = torch.distributions.Normal(outputs, self.log_std.exp())
            return torch.distributions.Independent(normal, 1)
        return torch.distributions.Categorical(logits=outputs)


def laid_out(network: Network, arrays: list[np.ndarray]) -> np.ndarray:
    """Arrays like its module's parameters as one vector like the network's.

    A compiled network has its columns filled up to a multiple of 16 with zeros. What follows the
    module's parameters, a policy's own, stays as it is.
    """

    def filled(array: np.ndarray) -> np.ndarray:
        return np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, -array.shape[-1] % 16)])

    own, rest = len(list(network.module().parameters())), list(arrays)
    arrays, rest = rest[:own], rest[own:]
    if isinstance(network, CompiledMLP):  # each layer's weights with the biases as a last row
        layers = zip(arrays[::2], arrays[1::2], strict=True)
        arrays = [filled(np.vstack([weights.T, biases])) for weights, biases in layers]
    return np.concatenate([part.ravel() for part in [*arrays, *rest]])


def acting(policy: Policy, mean: np.ndarray, std: np.ndarray, clip: float) -> ActingPolicy:
    """The policy for rollouts, as its learner gives it."""
    normalisation = Normalisation.of(mean, std, clip)
    if isinstance(policy.network, CompiledMLP):
        return CompiledLearner.acting(policy, normalisation)
    return NetworkActing(policy, normalisation)


def layer_norm(inputs: int, outputs: int, hidden_units: list[int]) -> torch.nn.Module:
    units = hidden_units[0]
    hidden = torch.nn.Linear(inputs, units), torch.nn.LayerNorm(units), torch.nn.ReLU()
    return torch.nn.Sequential(*hidden, torch.nn.Linear(units, outputs))


def environment_of(name: str, seed: int = 0, *settings: Any) -> Environment:
    return Environment(name, np.random.SeedSequence(seed), *settings)


def random_episode(
    rng: np.random.Generator, steps: int, seen: int = 4, actions: int = 2
) -> tuple[Episode, np.ndarray]:
    """An episode that nobody has played, and a bonus for each of its steps."""
    observations = rng.standard_normal((steps + 1, seen)).astype(np.float32)
    chosen = rng.integers(actions, size=steps)
    rewards = 1 + rng.standard_normal(steps)
    return Episode(observations, chosen, np.zeros(steps), rewards, True), rng.random(steps)


def finish(run: RunConfig | Trainer) -> Trainer:
    trainer = run if isinstance(run, Trainer) else Trainer(run)
    for _ in trainer.run():
        pass
    return trainer


def returns_of(name: str, act: Callable, episodes: int, seed: int) -> list[float]:
    """The returns of the actions that `act` gives for observations, by the library alone."""
    env, returns = gymnasium.make(name), []
    env.reset(seed=seed)  # an environment's first reset is thrown away
    env.reset(seed=seed)
    for _ in range(episodes):
        (observation, _), total, ends = env.reset(), 0.0, [False]
        while not any(ends):
            observation, reward, *ends, _ = env.step(act(observation))
            total += reward
        returns.append(total)
    return returns


def step(env, number: int):
    """A step with an action that depends on its number alone, the same in several environments."""
    vector = isinstance(env, VectorEnv)
    space = env.single_action_space if vector else env.action_space
    space.seed(number)
    action = space.sample()
    return env.step(np.full(env.num_envs, action) if vector else action)


def play(env, steps: int, seed: int | None = 0, first=0) -> list[tuple]:
    """What so many steps returned, episode after episode; from a reset, or on without a seed."""
    if seed is not None:
        env.reset(seed=seed)
    found = []
    for number in range(first, first + steps):
        found.append(copy.deepcopy(step(env, number)))
        if not isinstance(env, VectorEnv) and (found[-1][2] or found[-1][3]):
            env.reset()
    return found


class Killed(BaseException):
    """Ends a run as a signal would: nothing in the program catches it."""


def files(directory: Path) -> list[str]:
    """Those of a run but for its lock, which stays, and for what was set aside."""
    return sorted({path.name for path in directory.iterdir() if path.is_file()} - {LOCK})


def content_of(directory: Path) -> dict[str, bytes]:
    """The bytes of `files(directory)` by their names."""
    return {name: (directory / name).read_bytes() for name in files(directory)}


def provenance_of(directory: Path) -> dict:
    return json.loads((directory / "run.json").read_text(encoding="utf-8"))


def contents(results: Path) -> dict[str, bytes]:
    """By name what a study has to give again: all but what tells of the circumstances."""
    circumstances, found = {"logs", "benchmarks", "run.json", LOCK}, {}
    for path in sorted(results.rglob("*")):
        name = path.relative_to(results)
        if path.is_file() and not circumstances.intersection(name.parts):
            found[str(name)] = path.read_bytes()
            if path.stem == "claims":  # the claim ledger says how long all trainings took
                found[str(name)] = re.sub(rb"[^,\n]*core.hours.*", b"", found[str(name)])
    return found


def call(monkeypatch, *words: str, tool: ModuleType = cli) -> tuple[int, str]:
    """Exit code and message of `mace-rl words`, or of another tool's."""
    monkeypatch.setattr(sys, "argv", [tool.__name__, *words])
    try:
        tool.main()
    except SystemExit as exit_:
        return (exit_.code, "") if isinstance(exit_.code, int) else (1, str(exit_.code))
    return 0, ""


def refusal(monkeypatch, *words: str, tool: ModuleType = cli) -> str:
    """The line with which it fails."""
    code, said = call(monkeypatch, *words, tool=tool)
    assert code == 1 and said and "\n" not in said
    return said


NO_LATEX = shutil.which("pdflatex") is None and "CI" not in os.environ


def pdflatex(folder: Path, packages: Iterable[str], body: str) -> str:
    """What the real one says of a page."""
    head = "\n".join(["\\documentclass{article}", *packages])
    page = f"{head}\n\\begin{{document}}\n{body}\\end{{document}}\n"
    (folder / "page.tex").write_text(page, encoding="utf-8")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page.tex"]
    run = subprocess.run(command, cwd=folder, capture_output=True, check=False)
    said = run.stdout.decode(errors="replace")
    assert run.returncode == 0, re.findall(r"(?m)^!.*\n(?:.*\n){3}", said)
    return said


@contextmanager
def refused(error: type[Exception], pattern: str) -> Iterator[pytest.ExceptionInfo]:
    """What is in the block is refused in one line, in which the pattern is found."""
    with pytest.raises(error, match=pattern) as caught:
        yield caught
    assert "\n" not in str(caught.value)


class Bonanza(gymnasium.Env):
    """Action 1 pays 1, action 0 nothing; in step 3 after the fifth reset `value` goes wrong."""

    observation_space, action_space = Box(-1, 1, (2,), np.float32), Discrete(2)

    def __init__(self, where: str = "nowhere", value: float = 0.0) -> None:
        self.where, self.value, self.resets = where, value, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets, self.steps = self.resets + 1, 0
        bad = self.where == "first observation" and self.resets == 5
        return np.full(2, self.value if bad else 0.0, np.float32), {}

    def step(self, action):
        self.steps += 1
        add = {self.where: self.value if (self.resets, self.steps) == (5, 3) else 0.0}
        state = self.np_random.random(2) + add.get("observation", 0.0)
        return state.astype(np.float32), action + add.get("reward", 0.0), False, False, {}


def illegible(figure: Figure) -> list[tuple[str, ...]]:
    """Words of a figure that lie on each other, in pairs, or that its edge cuts off."""
    FigureCanvasAgg(figure).draw()  # lays it out, and makes the ticks
    unseen: list[Text] = []
    for axis in (*figure.findobj(XAxis), *figure.findobj(YAxis)):
        low, high = sorted(axis.get_view_interval()) if axis.axes.axison else (1, 0)
        for tick in axis.get_major_ticks():
            if not low <= tick.get_loc() <= high:
                unseen += (tick.label1, tick.label2)
        if not axis.axes.axison:
            unseen.append(axis.label)
    words = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text()]
    shown = [(text.get_text(), text.get_window_extent()) for text in words if text not in unseen]
    cut = [(word,) for word, box in shown if not figure.bbox.padded(1).contains(*box.min)]
    cut += [(word,) for word, box in shown if not figure.bbox.padded(1).contains(*box.max)]
    pairs = itertools.combinations(shown, 2)
    return cut + [(one, two) for (one, a), (two, b) in pairs if a.padded(-1).overlaps(b.padded(-1))]
