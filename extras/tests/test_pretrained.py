"""β by the pretrained LSTM, against computations of another kind; the making of its weights."""

import math
from itertools import count, product

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from shared import WEIGHED, environment_of, pretrained

from extras.pretrained.__main__ import LOGITS, Branch, Learner, as_one, earned, read_lives
from extras.pretrained.gauge import Gauge
from extras.pretrained.rule import Integrator, Pretrained, Settings
from extras.pretrained.tasks import Generated
from mace_rl.base.rng import Streams
from mace_rl.beta.controller import BetaGradient
from mace_rl.beta.lstm import MetaNetwork, lstm_output
from mace_rl.environments.episode import Episode
from mace_rl.library import settings
from mace_rl.training.factories import beta_controller


def episode_of(extrinsic_return: float) -> Episode:
    rewards = np.r_[np.zeros(7), extrinsic_return]
    return Episode(np.zeros((9, 1)), np.zeros(8, int), np.zeros(8), rewards, True)


def test_features_by_hand():
    """Two episodes a window; returns 0 and 1, bonus 1, then a tenth of it a step."""
    gauge = Gauge(200)
    closed = [gauge.update(r, b, 10) for r, b in ((0, 10), (0, 10), (1, 1), (0, 1))]
    assert closed == [False, True, False, True]
    first, second = gauge.windows
    assert first == pytest.approx([-0.98, 0, -1, 0, 0])  # no two returns differ
    assert second == pytest.approx([-0.96, 0.5, 0, -1, -1], abs=1e-6)


@pytest.mark.parametrize(("budget", "windows"), [(30, 30), (100, 100), (250, 100), (6000, 100)])
def test_windows_of_any_budget(budget, windows):
    """A hundred, or one per episode; all features stay small whatever is paid.

    One that is saved and restored after each episode has the same.
    """
    gauge, other, rng = Gauge(budget), Gauge(budget), np.random.default_rng(0)
    for n in range(budget):
        told = 1e6 * rng.standard_normal(), rng.random() / (1 + n) ** 3, 3
        saved, other = other.state_dict(), Gauge(budget)
        other.load_state_dict(saved)
        assert gauge.update(*told) == other.update(*told)
    assert (gauge.sequence() == other.sequence()).all()
    assert len(gauge.windows) == windows and np.abs(gauge.sequence()).max() <= 4
    assert gauge.windows[-1][0] == pytest.approx(1)


@pytest.fixture
def make():
    """`make(episodes, initial, **settings)`: the controller of mace_pretrained."""

    def build(episodes=1000, initial=0.4, **arguments) -> Pretrained:
        changes = {"episodes": episodes, "beta": pretrained(initial=initial, **arguments)}
        config = settings("CartPole-v1", "mace_fixed", **changes)
        return beta_controller(config, environment_of("CartPole-v1"), Streams(0))

    return build


@pytest.mark.parametrize("initial", [0.05, 0.4, 0.9])
def test_beta_starts_at_initial_and_stays_there_without_its_parts(make, initial):
    controller, alone = make(100, initial), make(100, initial, lstm=False, credit_gain=0.0)
    assert controller.learns and not alone.learns
    for n in range(100):
        assert (controller.next_beta() == pytest.approx(initial)) == (n == 0)
        assert alone.next_beta() == pytest.approx(initial)
        controller.next_episode(episode_of(n), np.full(8, 1 / (1 + n)))
        alone.next_episode(episode_of(n), np.full(8, 1 / (1 + n)))


@pytest.mark.parametrize("settings", [{}, {"lstm": False}, {"credit_gain": 0.5}])
def test_beta_is_what_the_lstm_says_and_what_the_credits_add_up_to(make, settings):
    """Its logit, by another sum over all credits; at most 6."""
    settings = {"horizon": 1, "credit_threshold": 0.5} | settings
    controller, gauge, rng = make(200, **settings), Gauge(200), np.random.default_rng(0)
    network, credits, betas = make().lstm.network, [], []
    gain, known = settings.get("credit_gain", 4.0), -math.log(1.5)
    for n in range(200):
        direction = np.array([1.0, 0.5 * rng.standard_normal()], np.float32)
        gradient = np.array([1.0 if n > 40 else -1.0, rng.standard_normal()], np.float32)
        credit = controller.learn(gradient, 1.0, BetaGradient(direction, 1.0))
        credits += [] if credit is None else [credit]
        expected = len(credits) * 200 / max(n, 1)  # of the whole training
        z = sum(credits) / math.sqrt(max(np.square(credits).sum(), expected / 2, 1e-9))
        logit = known + gain * (max(z - 0.5, 0) + min(z + 0.5, 0))
        betas.append(controller.next_beta())
        assert betas[-1] == pytest.approx(1 / (1 + math.exp(-np.clip(logit, -6, 6))), rel=1e-4)
        controller.next_episode(episode_of(n % 7), np.full(8, 1 / (1 + n)))
        if gauge.update(n % 7, 8 / (1 + n), 8) and settings.get("lstm", True):
            known = lstm_output(gauge.sequence(), network)
    assert len(credits) == 199 and max(betas) > 0.9 and min(betas) < 0.05


def test_it_explores_while_nothing_is_found_and_ends_it_when_learning_advances(make):
    """What the LSTM has learned, where the bonus fades; without credit."""
    found = np.where(np.arange(1000) < 300, 0.0, np.minimum(1, np.arange(1000) / 300 - 1))
    betas = []
    for returns in (np.zeros(1000), found):
        controller = make(credit_gain=0.0)
        for n, extrinsic_return in enumerate(returns):
            betas.append(controller.next_beta())
            controller.next_episode(episode_of(extrinsic_return), np.full(8, 0.3 / (1 + n / 30)))
    searching, advancing = np.split(np.array(betas), 2)
    assert searching[50:300].min() > 0.7 and advancing[50:300].min() > 0.7
    assert advancing[600:].max() < 0.3


def test_a_bonus_that_hardly_weighed_counts_for_little_and_a_heavy_one_for_one(make):
    """And so does extrinsic advantage."""
    gradient = np.array([1.0, 0.0], np.float32)
    for advantage_rms, strength, expected in (
        *((0.5, 1.0, 0.5), (1.0, 1.0, 1.0), (3.0, 1.0, 1.0)),
        *((1.0, 0.2, 0.2), (1.0, 5.0, 1.0), (1.0, 0.0, 0.0), (0.5, 0.5, 0.25)),
    ):
        controller = make(horizon=1)
        controller.next_episode(episode_of(1), np.full(8, 0.5))
        effect = BetaGradient(gradient, advantage_rms)
        credits = [controller.learn(strength * gradient, strength, effect) for _ in range(3)]
        # The gradient goes the effect's way, always as far: in its usual size, by 1.
        assert credits == [None, pytest.approx(expected), pytest.approx(expected)]


@pytest.mark.parametrize(
    ("signal", "low", "high"), [(0.1, 0.8, 1), (-0.1, 0, 0.1), (0.0, 0.2, 0.6), (0.02, 0.2, 0.95)]
)
def test_the_integrator_as_a_detector(signal, low, high):
    """After 1500 invented credits with noise 1, β lies there in 9 of 10 seeds."""
    config = Settings(**WEIGHED)
    paths = []
    for seed in range(200):
        integrator, rng = Integrator(config), np.random.default_rng(seed)
        path = []
        for n, credit in enumerate((signal + rng.standard_normal(1500)).clip(-3, 3)):
            integrator.add(float(credit), (n + 1) / 1500)
            path.append(1 / (1 + 1.5 * math.exp(-integrator.logit)))
        paths.append(path)
    inside = (np.array(paths) >= low) & (np.array(paths) <= high)
    assert inside[:, -1].mean() >= 0.9
    if signal == 0:  # nor does it leave on its way
        assert inside.all(axis=1).mean() >= 0.85


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
