"""tools.meta, which makes the weights of the LSTM that sets β."""

from itertools import count, product

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from mace_rl.beta.gauge import Gauge
from mace_rl.beta.lstm import MetaNetwork, lstm_output
from tools.meta.__main__ import LOGITS, Branch, Learner, as_one, earned, read_lives
from tools.meta.tasks import Generated


def test_several_networks_as_one_answer_with_their_mean():
    torch.manual_seed(0)
    learners = [Learner() for _ in range(3)]
    seen = torch.randn(1, 30, Gauge.SIZE)
    with torch.no_grad():
        expected = np.mean([learner(seen)[0, -1].item() for learner in learners])
    found = lstm_output(seen[0].numpy(), MetaNetwork(**as_one(learners)))
    assert found == pytest.approx(expected, rel=1e-5)


def test_what_a_beta_earns_is_interpolated_between_those_that_were_tried():
    known = torch.tensor([[1.0, 3.0, 2.0]])
    logits = torch.tensor([-9.0, *LOGITS, (LOGITS[0] + LOGITS[1]) / 2, 9.0])
    found = earned(logits, known.expand(6, 3)).tolist()
    assert found == pytest.approx([1, 1, 3, 2, 2, 2], abs=1e-5)


def test_lives_are_kept_and_a_torn_one_is_cut_off(tmp_path):
    path = tmp_path / "weights.jsonl"
    assert read_lives(path) == []
    whole = '[{"task": 7, "seen": [[0.5]], "earned": [0.1, 0.2, 0.3]}]\n[]\n'
    path.write_text(whole + '[{"task": 8, "se')
    assert read_lives(path) == [[Branch(7, [[0.5]], [0.1, 0.2, 0.3])], []]
    assert path.read_text() == whole


@pytest.mark.parametrize(
    ("kind", "door", "dense"),
    [*product(["sea", "corridor", "lake"], ["start", "end"], [0, 1])],
)
def test_generated_tasks_can_be_solved_as_fast_as_they_say(kind, door, dense):
    """By going where fewer steps are left; and the archive is never left."""
    for seed, pages, coordinates in product(range(3), (0, 50), (False, True)):
        env = Generated(kind, 7, seed, pages, door, bool(dense), coordinates)
        check_env(env, skip_render_check=True)
        env.reset(seed=0)
        total, end, steps = 0.0, False, count(1)
        while not end:
            moves = env.world.next[env.cell]
            left = np.where(env.world.goal[env.cell], -1, env.distance[moves])
            _, reward, end, *_ = env.step(int(np.argmin(left)))
            total, taken = total + reward, next(steps)
        assert taken == env.distance[0] and total == pytest.approx(1, abs=0.02)
        if pages and door == "start":
            env.reset()
            walked = [env.step(action) for action in (env.actions, *range(env.actions))]
            assert all(reward == -0.001 and not end for _, reward, end, *_ in walked)
