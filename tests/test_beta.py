"""β by schedule, and pretrained: each against a computation of its own."""

import math

import numpy as np
import pytest
from shared import ROOT, environment_of, finish

from mace_rl.base.rng import Streams
from mace_rl.beta.controller import BetaController, BetaGradient
from mace_rl.beta.credit import Integrator
from mace_rl.beta.gauge import Gauge
from mace_rl.beta.lstm import lstm_output
from mace_rl.beta.pretrained import PretrainedAdaptation
from mace_rl.environments.episode import Episode
from mace_rl.training.factories import beta_controller
from mace_rl.training.trainer import Trainer
from mace_study.config.study import read_study


def episode_of(extrinsic_return: float) -> Episode:
    rewards = np.r_[np.zeros(7), extrinsic_return]
    return Episode(np.zeros((9, 1)), np.zeros(8, int), np.zeros(8), rewards, True)


HALVED = {"kind": "exponential", "initial": 0.4, "decay": 0.5, "floor": 0.06}
PAPER_S = 0.999 ** np.arange(5000)


@pytest.mark.parametrize(
    ("beta", "expected"),
    [
        ({"kind": "constant", "value": 0.3}, [0.3] * 3),
        (HALVED, [0.4, 0.2, 0.1, 0.06, 0.06]),
        ({"variant": "mace_fixed"}, np.maximum(0.4 * PAPER_S, 0.01)),
        ({"variant": "mace_fixed_0.2"}, np.maximum(0.2 * PAPER_S, 0.01)),
        ({"variant": "mace_fixed_0.6"}, np.maximum(0.6 * PAPER_S, 0.01)),
    ],
)
def test_schedules_by_hand(run_config, beta, expected):
    changes = {"variant": "mace_fixed"} | (beta if "variant" in beta else {"beta": beta})
    config = run_config("CartPole-v1", **changes)
    rule, betas = beta_controller(config, environment_of("CartPole-v1"), Streams(0)), []
    for _ in expected:
        betas.append(rule.beta)
        rule.next_episode(None, None)  # whatever it was
    assert betas == pytest.approx(expected) and not rule.learns


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
def make(run_config):
    """`make(episodes, initial, **settings)`: the controller of mace_pretrained."""

    def build(episodes=1000, initial=0.4, **settings) -> PretrainedAdaptation:
        beta = {"kind": "pretrained", "initial": initial}
        changes = {"episodes": episodes, "beta": beta, "pretrained": settings}
        config = run_config("CartPole-v1", "mace_pretrained", 0, **changes)
        return beta_controller(config, environment_of("CartPole-v1"), Streams(0))

    return build


@pytest.mark.parametrize("initial", [0.05, 0.4, 0.9])
def test_beta_starts_at_initial_and_stays_there_without_its_parts(make, initial):
    controller, alone = make(100, initial), make(100, initial, lstm=False, credit_gain=0.0)
    assert controller.learns and not alone.learns
    for n in range(100):
        assert (controller.beta == pytest.approx(initial)) == (n == 0)
        assert alone.beta == pytest.approx(initial)
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
        betas.append(controller.beta)
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
            betas.append(controller.beta)
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
def test_the_integrator_as_a_detector(run_config, signal, low, high):
    """After 1500 invented credits with noise 1, β lies there in 9 of 10 seeds."""
    config = run_config("CartPole-v1", "mace_pretrained", 0).pretrained
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


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["mace_evidence", "mace_pretrained"])
@pytest.mark.parametrize(
    ("problem", "low", "high"), [("Help", 0.6, 1), ("Harm", 0, 0.1), ("Nothing", 0.1, 0.6)]
)
def test_planted_problems(problem, low, high, variant):
    """A bonus that helps, one that harms, one without any bearing; all starting from β = 0.4."""
    records = planted(f"Planted{problem}-v0", variant).records[-80:]
    assert low <= np.mean([record.beta for record in records]) <= high


@pytest.mark.slow
def test_the_network_reads_which_kind_of_episode_comes_next():
    """In one kind the bonus helps, in the other it harms; they alternate. A sum sees neither."""
    trainer = planted("PlantedMixed-v0", "mace_evidence")
    late = np.array([record.beta for record in trainer.records[-80:]])
    kinds = [late[1::2].mean(), late[0::2].mean()]  # the last episode's first
    helps, harms = kinds if trainer.environment.env.unwrapped.flag == "right" else kinds[::-1]
    assert helps > 0.8 and harms < 0.1
    credit = planted("PlantedMixed-v0", "mace_credit").records[-80:]
    assert np.ptp([record.beta for record in credit]) < 0.2


def planted(environment: str, variant: str) -> Trainer:
    """A training of 800 episodes."""
    over = [ROOT / "config" / f"{name}.yaml" for name in ("questions", "planted")]
    config = read_study([ROOT / "config.yaml", *over]).run_config(environment, variant, 0)
    return finish(config.model_copy(update={"episodes": 800}))
