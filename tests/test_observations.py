"""What a loaded policy takes: observations as the environment gives them, and nothing else."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from gymnasium.spaces.utils import flatdim, flatten
from gymnasium.vector.utils import concatenate, create_empty_array

from mace_rl import settings, train
from mace_rl.runs.observations import ObservationError, encoded

FOUR, BOX = Discrete(4, start=-1), Box(-1, 1, (4,))
CARDS = Tuple([Discrete(32), Discrete(11), Discrete(2)])
MIXED = Dict({"a": Box(-1, 1, (2, 3)), "b": FOUR, "c": MultiBinary(2), "d": CARDS})
MIXED["e"] = MultiDiscrete([2, 3], start=[-1, 1])


@pytest.mark.parametrize("space", [FOUR, BOX, Box(-1, 1, (1, 4)), CARDS, MIXED], ids=str)
def test_one_or_a_batch_is_encoded_as_in_training(space):
    """As Gymnasium's flatten has it; a batch as its vector environments give it, too."""
    space.seed(0)
    ones, size = [space.sample() for _ in range(3)], flatdim(space)
    rows = np.stack([flatten(space, one) for one in ones]).astype(np.float32)
    for one, row in zip(ones, rows, strict=True):
        assert (encoded(one, space, size).numpy() == row).all()
    batch = concatenate(space, ones, create_empty_array(space, 3))
    for given in (batch, ones, rows, torch.from_numpy(rows), rows.tolist(), rows[None]):
        assert (encoded(given, space, size).numpy() == rows).all()


PAIR, HOT = Tuple([FOUR, FOUR]), [0.0, 1.0, 0.0, 0.0]
FORMS = [(FOUR, given, HOT) for given in (0, np.uint16(0), np.array(0), torch.tensor(0), HOT)]
FORMS += [(FOUR, given, [HOT] * 2) for given in ([0, 0], (0, 0), torch.zeros(2).int())]
FORMS += [(BOX, given, HOT) for given in ([0, 1, 0, 0], np.array(HOT[::-1])[::-1])]
FORMS += [(PAIR, given, HOT * 2) for given in ([0, 0], np.zeros(2, int), HOT * 2)]
FORMS += [(Dict(a=MultiDiscrete([2, 2])), {"a": np.array([0, 1])}, [1.0, 0.0, 0.0, 1.0])]


@pytest.mark.parametrize(("space", "given", "expected"), FORMS)
def test_whatever_the_space_contains(space, given, expected):
    assert encoded(given, space, flatdim(space)).tolist() == expected


WRONG = [
    (FOUR, [3, -2, 0.0, None, "x", (0, {}), [3, 0], [0.5, 0.5, 0, 0], [[0, 1]], np.eye(3), 1j]),
    (BOX, [0, 0.5, np.zeros(3), np.zeros((4, 3)), [np.nan] * 4, [1e300] * 4, (HOT, {})]),
    (CARDS, [(1, 2), (1, 2, 2), (1.0, 2, 1), {1: 0, 2: 0, 0: 0}, ((1, 2, 1), {}), 3, [], ()]),
    (MIXED, [{}, {"a": 1}, (MIXED.sample(), {}), {**MIXED.sample(), "f": 1}]),
    (MIXED, [{**MIXED.sample(), "e": [1, 1]}]),
    (BOX, [np.zeros((0, 4))]),
]


@pytest.mark.parametrize(
    ("space", "given"), [(space, one) for space, all_ in WRONG for one in all_]
)
def test_anything_else_is_one_line(space, given):
    with pytest.raises(
        ObservationError, match=r"^[^\n]*no finite observation of [^\n]*$"
    ) as caught:
        encoded(given, space, flatdim(space))
    pair = isinstance(given, tuple) and given[-1:] == ({},)
    assert ("only the first is one" in str(caught.value)) == pair


@pytest.mark.parametrize(("name", "one"), [("FrozenLake-v1", 5), ("Blackjack-v1", (14, 9, 0))])
def test_a_loaded_policy_knows_its_space(name, one):
    policy = train(settings(name, "ppo", episodes=2, max_episode_steps=20)).agent.policy
    assert (policy(one).logits == policy(np.float32(flatten(policy.space, one))).logits).all()
    with pytest.raises(ObservationError, match="only the first"):
        policy((one, {}))
