"""What the meta network learns from: each reading's slope by autograd or sums of another kind."""

import math

import numpy as np
import pytest
import torch
from shared import environment_of, random_episode

from mace_rl.base.rng import Streams
from mace_rl.beta.network import CompiledMetaNetwork
from mace_rl.beta.objectives import Played, Progress, Return, Score, Words
from mace_rl.config.beta import ProgressObjective, ReturnObjective, ScoreObjective, WordsObjective
from mace_rl.training.factories import beta_controller

BY_RETURNS = [
    "mace_full",
    "mace_score",
    "mace_progress",
    "mace_return",
    "mace_centred",
    "mace_words",
]
SEQUENCE = np.zeros((1, 3), np.float32)


def slopes(objective, returns, output: float = 0.3) -> list[float]:
    """dL/do after each episode of these returns, played with β = 0.3; NaN where nothing is said."""
    found = []
    for extrinsic_return in returns:
        asked = SEQUENCE, output, objective.logit(output), 0.3
        lesson = objective.after_episode(Played(*asked, float(extrinsic_return)))
        found.append(math.nan if lesson is None else lesson.slope)
    return found


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("level", [-200.0, 50.0])
def test_return_by_autograd(centred, level):
    """L = −R β, β = sigmoid(o), in units of the last ten returns."""
    returns = level + 10 * np.random.default_rng(0).standard_normal(60)
    found = slopes(Return(ReturnObjective(kind="return", centred=centred, recent=10)), returns)
    assert found[0] == 0
    for n in range(1, 60):
        before = returns[max(0, n - 10) : n]
        centre = before.mean() if centred else 0.0
        usual = np.sqrt(np.square(before - centre).mean())
        paid = float(np.clip((returns[n] - centre) / usual, -3, 3)) if usual else 0.0
        output = torch.tensor(math.log(0.3 / 0.7), dtype=torch.float64, requires_grad=True)
        (-paid * output.sigmoid()).backward()
        assert found[n] == pytest.approx(output.grad.item(), rel=1e-9, abs=1e-12)
    if not centred:  # the sign of the return alone decides
        assert all(np.sign(found[1:]) == -np.sign(level))


@pytest.mark.parametrize("value", [0.99, -0.006, -200.0])  # means of the first two are rounded
def test_where_all_returns_are_equal_they_say_nothing(value):
    centred = Return(ReturnObjective(kind="return", centred=True, recent=100))
    config = ScoreObjective(kind="score", window=3, noise=1.5, lag=2.0, recent=100)
    for objective in (centred, Score(config, np.random.default_rng(0))):
        assert not np.nan_to_num(slopes(objective, [value] * 150)).any()


def test_perturbations_come_in_pairs_of_windows():
    config = ScoreObjective(kind="score", window=3, noise=1.5, lag=2.0, recent=9)
    score, found = Score(config, np.random.default_rng(0)), []
    for _ in range(240):
        found.append(score.logit(0.25) - 0.25)
        slopes(score, [1.0])
    pairs = np.array(found).reshape(40, 2, 3)
    assert (np.abs(pairs) == 1.5).all() and (pairs[:, 0] == -pairs[:, 1]).all()
    assert (pairs == pairs[:, :, :1]).all() and 8 < (pairs[:, 0, 0] > 0).sum() < 32


@pytest.mark.parametrize("kind", ["score", "progress"])
def test_a_perturbation_is_paid_by_what_follows(kind):
    """−p e: e a weighted mean of all perturbations before, p in units of the payments before."""
    settings = {"window": 4, "noise": 2.0, "lag": 5.0, "recent": 20}
    if kind == "score":
        objective = Score(ScoreObjective(kind="score", **settings), np.random.default_rng(3))
    else:
        config = ProgressObjective(kind="progress", stretch=6, **settings)
        objective = Progress(config, np.random.default_rng(3))
    returns, signs, found = np.random.default_rng(1).standard_normal(90).cumsum(), [], []
    for extrinsic_return in returns:
        signs.append(objective.logit(0.0) / 2)
        found += slopes(objective, [extrinsic_return])
    rises = [
        returns[n - 5 : n + 1].mean() - returns[n - 11 : n - 5].mean() if n >= 11 else None
        for n in range(90)
    ]
    assert np.isnan(found[0])
    for n in range(1, 90):
        trace = sum(0.2 * 0.8**age * sign for age, sign in enumerate(signs[n - 1 :: -1]))
        if kind == "score":
            before = returns[max(0, n - 20) : n]
            usual = before.std()
            paid = (returns[n] - before.mean()) / usual if usual else 0.0
        else:
            before = [rise for rise in rises[:n] if rise is not None][-20:]
            paid = rises[n] / np.sqrt(np.square(before).mean()) if before else 0.0
        assert found[n] == pytest.approx(-np.clip(paid, -3, 3) * trace, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("effect", [0.6, 0.0, -0.6])
def test_a_perturbation_finds_what_beta_does(effect):
    """Returns that follow β's logit slowly, in much noise: the output goes the way that pays."""
    ends = []
    for seed in range(12):
        rng, output, level = np.random.default_rng(seed), 0.0, 0.0
        config = ScoreObjective(kind="score", window=50, noise=2.0, lag=30.0, recent=100)
        objective = Score(config, np.random.default_rng(100 + seed))
        for _ in range(1500):
            level += (effect * objective.logit(output) - level) / 30
            [slope] = slopes(objective, [level + 3 * rng.standard_normal()], output)
            output -= 0.02 * np.nan_to_num(slope)
        ends.append(output)
    if effect:
        assert (np.sign(ends) == np.sign(effect)).all()
    else:
        assert 2 <= (np.array(ends) > 0).sum() <= 10


def test_words_by_autograd():
    """The cross-entropy to 0 where the last five returns are clearly above the five before."""
    rng = np.random.default_rng(0)
    rising = np.concatenate([np.zeros(15), np.arange(15), np.full(30, 15)])
    returns = rising + 0.5 * rng.standard_normal(60)
    found = slopes(Words(WordsObjective(kind="words", stretch=5)), returns)
    assert np.isnan(found[:9]).all()
    for n in range(9, 60):
        before, last = returns[n - 9 : n - 4], returns[n - 4 : n + 1]
        error = math.sqrt((before.var() + last.var()) / 5)
        target = torch.tensor(0.0 if last.mean() - before.mean() > error else 1.0).double()
        output = torch.tensor(math.log(0.3 / 0.7), dtype=torch.float64, requires_grad=True)
        torch.nn.functional.binary_cross_entropy_with_logits(output, target).backward()
        assert found[n] == pytest.approx(output.grad.item(), rel=1e-9)
    assert (np.array(found[20:30]) > 0).all() and (np.array(found[50:]) < 0).mean() > 0.6


@pytest.mark.parametrize("variant", BY_RETURNS)
def test_the_network_learns_what_its_objective_says(run_config, variant):
    """By hand: β from the last episode alone, and one step down the slope after each."""
    config = run_config("CartPole-v1", variant, 0)
    spaces, streams = environment_of("CartPole-v1"), Streams(0)
    controller = beta_controller(config, spaces, streams)
    twin = beta_controller(config, spaces, Streams(0))
    network = CompiledMetaNetwork(config.meta, twin.reader.inputs, Streams(0)["meta"])
    rng, before, read, betas = np.random.default_rng(5), None, None, []
    for _ in range(80):
        episode, bonus = random_episode(rng, int(rng.integers(1, 60)))
        output = 0.0 if read is None else network.output(read)
        added = 0.0 if read is None else twin.objective.logit(output)
        betas.append(controller.next_beta())
        assert betas[-1] == pytest.approx(1 / (1 + 1.5 * math.exp(-added)), rel=1e-5)
        controller.next_episode(episode, bonus)
        if read is not None:
            total = float(sum(episode.rewards.tolist()))
            lesson = twin.objective.after_episode(Played(read, output, added, betas[-1], total))
            if lesson is not None:
                perturbed = hasattr(twin.objective, "trace")  # a β acts after its episode
                assert lesson.sequences == [before if perturbed else read]
                network.learn(*lesson)
            before = read
        read = twin.reader.read(episode, bonus)
    assert (network.optimiser.parameters == controller.network.optimiser.parameters).all()
    assert len(set(betas)) > 20
