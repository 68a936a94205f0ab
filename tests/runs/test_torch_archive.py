"""Archives written without torch against `torch.save`, and trainings that never import it."""

import io
import random
import subprocess
import sys
from collections import OrderedDict

import numpy as np
import pytest
import torch
from shared import TRAIN, finish, provenance_of

from mace_rl.base import files
from mace_rl.base.state import SavedArray, saved
from mace_rl.runs import run, torch_archive
from mace_rl.runs.agent import Agent
from mace_rl.runs.agent_state import agent_state
from mace_rl.runs.checkpoint import unarchive

TYPES = ["float64", "float32", "int64", "int32", "uint8", "bool"]


def as_torch_saves(content) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def array(*shape: int, kind: str = "float32") -> SavedArray:
    return saved(np.random.default_rng(0).integers(0, 2, shape).astype(kind))


TWICE, ORDERED = array(3), OrderedDict(weight=array(2, 5), bias=array(5))
vars(ORDERED)["_metadata"] = OrderedDict(network={"version": 1})
CONTENTS = {
    "nothing": {},
    "types": {kind: array(2, 3, kind=kind) for kind in TYPES},
    "shapes": [array(*shape) for shape in ((), (0,), (0, 4), (3, 0), (1,), (2, 1, 3), (70, 9))],
    "the same twice": {"one": TWICE, "other": [TWICE, array(3)]},
    "a module's": ORDERED,
    "words of the format": {"storage": ["cpu", "0"], "0": array(2), "1": [array(1), "1"]},
    "numbers": [0, -5, 255, 256, 2**31, 2**70, 1e-300, float("inf"), True, None, ""],
    "texts": ["é" * 300, "β", "\n", "torch"],
    "long lists": [list(range(length)) for length in (999, 1000, 1001, 2001)],
    "long dictionaries": [{key: [key] for key in range(length)} for length in (1000, 1001)],
    "generators": [random.getstate(), np.random.default_rng(0).bit_generator.state],
}


@pytest.mark.parametrize("content", CONTENTS.values(), ids=CONTENTS)
def test_an_archive_has_the_bytes_that_torch_saves(content, tmp_path):
    archive = torch_archive.archive(content)
    assert archive == as_torch_saves(content)
    found = unarchive(torch_archive.archive({"content": content}), tmp_path)["content"]
    assert repr(found) == repr(torch.load(io.BytesIO(as_torch_saves(content))))


@pytest.mark.parametrize("count", [*range(1, 60), 121, 122, 123, 251, 252, 535, 536, 1103, 1104])
def test_an_archive_of_any_number_of_arrays_has_those_bytes(count):
    """Their names are in torch's digest, in an order that changes as a hash table grows."""
    content = [array(1) for _ in range(count)]
    assert torch_archive.archive(content) == as_torch_saves(content)


@pytest.mark.parametrize("content", [array(2, kind="float16"), array(2, kind="uint16")])
def test_arrays_of_other_types_are_left_to_torch(content):
    with pytest.raises(KeyError):
        torch_archive.archive([content])


@pytest.mark.parametrize("variant", ["ppo", "mace_full"])
@pytest.mark.parametrize("environment", ["CartPole-v1", "HopperBulletEnv-v0"])
def test_the_state_of_an_agent_is_that_of_its_module(environment, variant, run_config):
    trainer = finish(run_config(environment, variant, episodes=2))
    space = trainer.environment.given_space
    with_torch = Agent(trainer.ppo, space).state_dict()
    assert torch_archive.archive(agent_state(trainer.ppo, space)) == as_torch_saves(with_torch)


CHILD = f"""{TRAIN}
print([name for name in ("torch", "pandas", "networkx") if name in sys.modules])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "wrappers", "imported"),
    [
        ("CartPole-v1", None, []),
        # Whose package has graphs from networkx.
        ("MiniGrid-Empty-5x5-v0", ["minigrid.wrappers:FlatObsWrapper"], ["networkx"]),
    ],
)
def test_a_compiled_training_needs_no_torch_and_leaves_the_same(
    environment, wrappers, imported, run_config, tmp_path
):
    """Its checkpoint, too: the same run with more episodes goes on from it, here with torch."""
    changes = {"episodes": 6, "max_episode_steps": 60, "environment_wrappers": wrappers}
    config = run_config(environment, "mace_full", 3, **changes)
    command = [sys.executable, "-c", CHILD, config.model_dump_json(), str(tmp_path / "without")]
    child = subprocess.run(command, capture_output=True, text=True, check=True)
    assert child.stdout == f"{imported}\n"
    run.run(config, tmp_path / "with", keep_checkpoint=True)
    for name in files.RESULTS:
        assert (tmp_path / "without" / name).read_bytes() == (tmp_path / "with" / name).read_bytes()
    longer = config.model_copy(update={"episodes": 9})
    for place in ("without", "with", "anew"):
        run.run(longer, tmp_path / place, keep_checkpoint=True)
    agents = {(path / files.AGENT).read_bytes() for path in tmp_path.iterdir()}
    assert len(agents) == 1
    assert len(provenance_of(tmp_path / "without")["interruptions"]) == 1
