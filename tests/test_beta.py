"""β: the schedule by hand; the meta signal against finite differences of what it estimates."""

import copy
import math
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete
from shared import Twin, environment_of, finish

from mace_rl.agent.adam import Adam
from mace_rl.agent.network import CompiledMLP, mlp
from mace_rl.agent.policy import Policy
from mace_rl.agent.ppo import PPO
from mace_rl.beta.controller import Effect
from mace_rl.beta.meta import MetaAdaptation
from mace_rl.beta.progress import FAST, IMPROVEMENT, SLOW, Progress
from mace_rl.config.run import RunConfig
from mace_rl.config.study import read_study
from mace_rl.environments.rollout import Episode
from mace_rl.experience import Experience
from mace_rl.factories import beta_controller
from mace_rl.streams import Streams
from mace_rl.train import Trainer

ROOT = Path(__file__).parents[1]


def episode_of(rng, name="CartPole-v1", length=20) -> Episode:
    environment = environment_of(name)
    size, space = environment.observation_size, environment.action_space
    return Episode(
        observations=rng.standard_normal((length + 1, size)).astype(np.float32),
        actions=rng.integers(space.n, size=length)
        if isinstance(space, Discrete)
        else rng.standard_normal((length, *space.shape)).astype(np.float32),
        log_probs=np.zeros(length, np.float32),
        rewards=rng.standard_normal(length),
        terminated=True,
    )


def beta_of(twin: Twin, sequence: np.ndarray) -> torch.Tensor:
    """The logistic function of the reference network's answer to what an episode was, [1]."""
    return torch.sigmoid(twin(sequence))


@pytest.fixture
def make(run_config):
    """`make(environment, initial, **settings of meta)`: the controller of mace_full."""

    def build(environment="CartPole-v1", initial=0.4, **settings) -> MetaAdaptation:
        beta = {"kind": "meta", "initial": initial}
        config = run_config(environment, "mace_full", 0, beta=beta, meta=settings)
        return beta_controller(config, environment_of(environment), Streams(0))

    return build


@pytest.fixture
def learnt(monkeypatch) -> list[np.ndarray]:
    """The gradients that reach optimisers, as they come."""
    gradients = []
    step = Adam.step

    def note(self: Adam, gradient: np.ndarray) -> float:
        gradients.append(gradient.copy())
        return step(self, gradient)

    monkeypatch.setattr(Adam, "step", note)
    return gradients


# --- What the network is asked for --------------------------------------------------------------


@pytest.mark.parametrize("initial", [0.05, 0.4, 0.9])
@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
def test_beta_starts_at_initial_and_stays_in_0_to_1(make, environment, initial):
    controller = make(environment, initial)
    assert controller.beta == initial
    rng = np.random.default_rng(0)
    for scale in (1, 100, 1e4):
        episode = episode_of(rng, environment)
        episode.rewards[:] *= scale
        controller.next_episode(episode, rng.random(20))
        assert 0 < controller.beta < 1
        assert controller.beta == pytest.approx(initial, abs=0.05)  # untrained


def test_sequence_is_state_action_reward_bonus(make):
    controller, rng = make(max_sequence=None), np.random.default_rng(0)
    episode, bonus = episode_of(rng, length=6), rng.random(6)
    controller.normaliser.update(3 + 2 * rng.standard_normal((50, 4)))
    mean, std = controller.normaliser.mean, controller.normaliser.std
    rows = [
        [
            *((episode.observations[t] - mean) / std),
            *(float(episode.actions[t] == action) for action in (0, 1)),
            math.copysign(math.log(1 + abs(episode.rewards[t])), episode.rewards[t]),
            math.log(1 + bonus[t]),
            *controller.progress.features(0.3),
        ]
        for t in range(6)
    ]
    found = controller.sequence(episode, bonus, 0.3)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, rows, rtol=1e-5)


@pytest.mark.parametrize("length", [5, 6, 7, 13, 60])
def test_long_sequences_are_condensed(make, length):
    """At most 6 stretches of consecutive steps, as even as can be, none left out: mean state and
    action, logarithm of the summed reward and bonus."""
    rng = np.random.default_rng(0)
    episode, bonus = episode_of(rng, "Pendulum-v1", length), rng.random(length)
    whole = make("Pendulum-v1", max_sequence=None).sequence(episode, bonus, 0.4)
    found = make("Pendulum-v1", max_sequence=6).sequence(episode, bonus, 0.4)
    if length <= 6:
        assert (found == whole).all()
        return
    assert len(found) == 6
    bounds = [math.floor(i * length / 6) for i in range(7)]
    for row, (start, end) in zip(found, pairwise(bounds), strict=True):
        means = [*range(4), *range(6, len(row))]  # state, action; progress, the same everywhere
        np.testing.assert_allclose(row[means], whole[start:end, means].mean(0), 1e-4, atol=1e-6)
        reward, summed = episode.rewards[start:end].sum(), bonus[start:end].sum()
        assert row[4] == pytest.approx(math.copysign(math.log(1 + abs(reward)), reward), rel=1e-5)
        assert row[5] == pytest.approx(math.log(1 + summed), rel=1e-5)


def test_beta_of_the_next_episode_is_the_lstm_s_answer_to_the_last(make):
    controller, rng = make(hidden_units=5), np.random.default_rng(0)
    controller.next_episode(episode_of(rng, length=7), rng.random(7))
    expected = beta_of(Twin(controller.network), controller.sources[-1])
    assert controller.beta == pytest.approx(expected.item(), abs=1e-6)


# --- The meta gradient --------------------------------------------------------------------------


class TwoStepProblem:
    """Two decisions, a reward after each: J and its gradient are exact sums over 4 × 2 paths.

    The second state is reached by the first action; the parameters are in float64, so that finite
    differences of J are.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.actor = Policy(CompiledMLP(mlp([3, 5, 2], 1.0, rng)), Discrete(2), 0.0)
        self.set(0.7 * rng.standard_normal(len(self.actor.parameters)))
        # Reward of each action in each state, for the two kinds.
        self.extrinsic, self.intrinsic = rng.standard_normal((2, 3, 2))
        self.paths = [(a, b) for a in (0, 1) for b in (0, 1)]

    def set(self, parameters: np.ndarray) -> None:
        self.parameters = self.actor.network.parameters = parameters

    def policy(self) -> np.ndarray:
        """π(a|s), [3, 2]: softmax of the network's outputs."""
        logits = self.actor.forward(np.eye(3)).outputs
        return np.exp(logits) / np.exp(logits).sum(1, keepdims=True)

    def objective(self, rewards: np.ndarray) -> float:
        """Expected return of the current policy, exactly."""
        policy = self.policy()
        return sum(
            policy[0, a] * policy[1 + a, b] * (rewards[0, a] + rewards[1 + a, b])
            for a, b in self.paths
        )

    def gradient(self, rewards: np.ndarray) -> np.ndarray:
        """∇J through `PPO.policy_gradients`: every path, weighted with its probability."""
        policy, states, actions, advantages = self.policy(), [], [], []
        for a, b in self.paths:
            probability = policy[0, a] * policy[1 + a, b]
            later = rewards[1 + a, b]
            states += [0, 1 + a]
            actions += [a, b]
            advantages += [probability * (rewards[0, a] + later), probability * later]
        ppo = PPO.__new__(PPO)
        ppo.policy = self.actor
        (gradient,) = ppo.policy_gradients(
            np.eye(3)[states], np.array(actions), [np.array(advantages)]
        )
        return len(states) * gradient  # of the sum


@pytest.mark.parametrize("beta", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("seed", range(5))
def test_credit_is_the_derivative_of_the_next_policy_s_return(seed, beta):
    """dJ_E(θ') / dβ = η ⟨g_E(θ'), P g_I(θ)⟩ for θ' one Adam step along g_E + β g_I from θ.

    β is moved by hand on the left, through Adam as it is, whose moments have a history.
    """
    problem, rng = TwoStepProblem(seed), np.random.default_rng(seed)
    start = problem.parameters.copy()
    extrinsic = problem.gradient(problem.extrinsic)
    intrinsic = problem.gradient(problem.intrinsic)
    usual = rng.uniform(1, 3, len(start)) * np.abs(extrinsic + beta * intrinsic) + 1e-3
    moments = {
        "mean": torch.zeros(len(start), dtype=torch.float64),
        "square": torch.from_numpy(usual**2 * (1 - 0.999**500)),
        "time": 500,
    }

    def adam(parameters: np.ndarray) -> Adam:
        optimiser = Adam(parameters, 1e-2)
        optimiser.mean, optimiser.square = np.zeros(len(start)), np.zeros(len(start))
        optimiser.load_state_dict({"parameters": torch.from_numpy(start), **moments})
        return optimiser

    def next_return(beta: float) -> float:
        problem.set(start.copy())
        adam(problem.parameters).step(-(extrinsic + beta * intrinsic))
        return problem.objective(problem.extrinsic)

    measured = (next_return(beta + 1e-3) - next_return(beta - 1e-3)) / 2e-3
    after = problem.gradient(problem.extrinsic)
    problem.set(start.copy())
    direction = adam(problem.parameters).preconditioned(intrinsic)
    # Of a gradient Adam's first moment takes in a tenth, and v̂ hardly anything.
    assert 1e-2 * 0.1 * after @ direction == pytest.approx(measured, rel=0.02, abs=1e-7)


# --- What is learnt from it ---------------------------------------------------------------------


def slow_progress(returns: list[float], beta: float) -> list[float]:
    """`Progress.features` from the whole history."""
    fast, slow, averages = returns[0], returns[0], []
    best, stalled = returns[0], 0
    for count, value in enumerate(returns[1:], start=2):
        weight_fast, weight_slow = max(FAST, 1 / count), max(SLOW, 1 / count)
        fast = (1 - weight_fast) * fast + weight_fast * value
        slow = (1 - weight_slow) * slow + weight_slow * value
        averages.append(fast)
        stalled += 1
        if fast > best + IMPROVEMENT * np.std(returns[:count]):
            best, stalled = fast, 0
    unit = np.std(returns) or 1.0
    features = [(fast - slow) / unit, (best - fast) / unit, math.log(1 + stalled) / 2]
    return [*features, math.log(beta / (1 - beta)) / 2]


@pytest.mark.parametrize("kind", ["noise", "rise", "constant", "fall"])
def test_progress_equals_a_slow_computation(kind):
    rng, progress = np.random.default_rng(0), Progress()
    trend = {"noise": 0.0, "rise": 1.0, "constant": 0.0, "fall": -1.0}[kind]
    returns = [trend * n + 5 * (kind != "constant") * rng.standard_normal() for n in range(60)]
    for count in range(1, 61):
        progress.update(returns[count - 1])
        expected = np.clip(slow_progress(returns[:count], 0.3), -3, 3)
        np.testing.assert_allclose(progress.features(0.3), expected, rtol=1e-6, atol=1e-9)
    stalled = progress.features(0.3)[2]
    assert (stalled < 1.0) == (kind == "rise")


def judge(controller: MetaAdaptation, credits: list[float]) -> float | None:
    """Let one episode each get these credits, with what is usual fixed at 1."""
    controller.alignments = controller.alignment_weight = 1e12
    gradient = np.array([1.0, 0.0], np.float32)
    effects = [Effect(np.array([c, math.sqrt(1 - c * c)], np.float32), 1.0) for c in credits]
    controller.learn(np.zeros(2, np.float32), 0.0, effects)
    return controller.learn(gradient, 1.0, [])


@pytest.mark.parametrize("credits", [[0.7], [-0.7], [0.5, -0.2, 0.9]])
def test_lstm_receives_credit_and_prior_through_the_logit(make, learnt, credits):
    controller, rng = make(hidden_units=6, horizon=1, prior=0.3), np.random.default_rng(0)
    controller.network.split(controller.network.parameters)[-1][:] += 0.7  # away from the prior
    for _ in range(len(credits) + 1):  # the first β is given, so one more
        controller.next_episode(episode_of(rng), rng.random(20))
    sequences = list(controller.sources)[1 : len(credits) + 1]
    controller.sources.popleft()
    twin = Twin(controller.network)
    assert judge(controller, credits) == pytest.approx(np.mean(credits), abs=1e-6)
    logits = [twin(sequence) for sequence in sequences]
    initial = math.log(0.4 / 0.6)
    terms = [c * x - 0.3 / 2 * (x - initial) ** 2 for c, x in zip(credits, logits, strict=True)]
    # Adam descends, so the gradient is that of minus the objective.
    expected = twin.gradient(-torch.cat(terms).mean())
    (gradient,) = learnt
    np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-6)
    assert all((part != 0).any() for part in controller.network.split(gradient))


@pytest.mark.parametrize(("credit", "rises"), [(0.8, True), (-0.8, False)])
def test_beta_follows_what_helped_and_comes_back_when_nothing_is_left_to_learn(make, credit, rises):
    """Also from the very end of its range."""
    controller, rng = make(horizon=1), np.random.default_rng(0)
    gradient = np.array([1.0, 0.0], np.float32)
    effect = Effect(np.array([credit, math.sqrt(1 - credit**2)], np.float32), 1.0)

    def play(episodes: int, strength: float) -> float:
        for _ in range(episodes):
            controller.next_episode(episode_of(rng), rng.random(20))
            controller.learn(strength * gradient, strength, [effect])
            assert 0 < controller.beta < 1
        return controller.beta

    learnt = play(150, 1.0)
    assert (learnt > 0.9) if rises else (learnt < 0.1)
    assert play(600, 1e-6) == pytest.approx(0.4, abs=0.05)


@pytest.mark.parametrize("missing", ["strength", "influence"])
def test_no_credit_without_extrinsic_or_intrinsic_advantage(make, missing):
    """Half as much of either is half the credit, however large the gradients are."""
    found = {}
    for share in (1.0, 0.5):
        controller = make(horizon=1)
        controller.next_episode(episode_of(np.random.default_rng(0)), np.ones(20))
        controller.sources.popleft()
        controller.alignments = controller.alignment_weight = 1e12
        given = {"strength": 1.0, "influence": 1.0} | {missing: share}
        effect = Effect(np.array([3.0, 4.0], np.float32), given["influence"])
        controller.learn(np.zeros(2, np.float32), 0.0, [effect])
        gradient = np.array([given["strength"], 0], np.float32)
        found[share] = controller.learn(gradient, given["strength"], [])
    assert found[1.0] == pytest.approx(0.6) and found[0.5] == pytest.approx(0.3)


def test_a_frozen_network_gives_the_initial_beta_for_ever(make):
    controller = make(learning_rate=0.0)
    before = controller.network.parameters.copy()
    assert not controller.learns
    for seed in range(5):
        controller.next_episode(episode_of(np.random.default_rng(seed)), np.ones(20))
        assert controller.beta == pytest.approx(0.4, abs=0.05)
    assert (controller.network.parameters == before).all()


# --- Which β is credited with what --------------------------------------------------------------


class Watched(Trainer):
    """Keeps, round by round, what was played, by which weights, and what reached the LSTM.

    learnt: the gradients that reached any optimiser so far.
    """

    def __init__(self, config: RunConfig, learnt: list[np.ndarray]) -> None:
        super().__init__(config)
        self.learnt = learnt
        self.rounds: list[Round] = []

    def adapt(self, rollout: list[Experience]) -> float | None:
        meta, adam = Twin(self.controller.network), self.ppo.optimisers["actor"]
        policy, square, before = adam.parameters.copy(), adam.square.copy(), len(self.learnt)
        credit = super().adapt(rollout)
        directions = [judged.direction.copy() for judged in self.controller.judged[-len(rollout) :]]
        learnt, time = self.learnt[before:], adam.time
        self.rounds.append(Round(rollout, policy, square, time, meta, directions, learnt))
        return credit


class Round(NamedTuple):
    """One round of training."""

    rollout: list[Experience]
    policy: np.ndarray  # the parameters that played it
    square: np.ndarray  # of the actor's optimiser, like `time`, before the update
    time: int
    meta: Twin  # as it was while it was played
    directions: list[np.ndarray]  # for each of its episodes the change of the update by its β
    learnt: list[np.ndarray]  # the gradient, if any, that reached the meta network after it


@pytest.fixture(
    params=[
        ("CartPole-v1", 1, "compiled"),
        ("CartPole-v1", 80, "compiled"),
        ("Pendulum-v1", 1, "compiled"),
        ("Pendulum-v1", 400, "compiled"),
        ("CartPole-v1", 80, "torch"),
    ],
    ids=str,
)
def watched(request, run_config, learnt) -> Watched:
    """A finished short run; a rollout is one episode, or several."""
    environment, steps, engine = request.param
    several = steps > 1
    changes = {
        "episodes": 14,
        "engine": engine,
        "ppo": {"rollout_steps": steps, "gae_lambda": 0.95, "centre_advantages": several},
        "meta": {"hidden_units": 16, "horizon": 2},
    }
    trainer = Watched(run_config(environment, "mace_full", 2, **changes), learnt)
    assert [record.episode for record in finish(trainer).records] == [*range(1, 15)]
    assert (max(len(each.rollout) for each in trainer.rounds) > 1) == several
    return trainer


def read_sequences(trainer: Watched) -> list[np.ndarray]:
    """What the LSTM reads of each episode, standardised by all states up to its end."""
    reader = beta_controller(trainer.config, trainer.environment, Streams(0))
    sequences, observed = [], []
    for item in (item for each in trainer.rounds for item in each.rollout):
        observed += [*item.episode.observations[:-1].astype(np.float64)]
        reader.normaliser.count = len(observed)
        reader.normaliser.mean = np.mean(observed, axis=0)
        reader.normaliser.sum_of_squares = np.var(observed, axis=0) * len(observed)
        reader.progress.update(item.episode.rewards.sum())
        sequences.append(reader.sequence(item.episode, item.bonus.reward, item.beta))
    return sequences


def test_each_beta_comes_from_the_episode_before(watched):
    """From the meta network as it has learnt from all rounds before; the first one is given."""
    sequences = read_sequences(watched)
    played = [(item.beta, each.meta) for each in watched.rounds for item in each.rollout]
    assert played[0][0] == 0.4
    for sequence, (beta, meta) in zip(sequences, played[1:], strict=False):
        assert beta == pytest.approx(beta_of(meta, sequence).item(), abs=1e-5)
    betas = [beta for beta, _ in played]
    assert betas == [record.beta for record in watched.records]
    assert len(set(betas)) == 14 and all(0 < beta < 1 for beta in betas)


def policy_gradient(watched, each: Round, advantages: np.ndarray) -> np.ndarray:
    """∇ mean(log π · A) over a round's steps, by autograd, of the policy that played it."""
    watched.ppo.policy.parameters[:] = each.policy
    other = Twin(watched.ppo.policy)
    observations = np.concatenate([item.observations[:-1] for item in each.rollout])
    actions = np.concatenate([item.episode.actions for item in each.rollout])
    log_probs = other.policy(observations).log_prob(torch.from_numpy(actions))
    return other.gradient((log_probs * torch.from_numpy(advantages)).mean())


def scaled(item: Experience, kind: str) -> np.ndarray:
    """Advantages of one kind in units of their scale."""
    return getattr(item, f"{kind}_advantages") / getattr(item, f"{kind}_scale")


def test_direction_is_how_the_update_moves_with_beta(watched):
    """The change of the first step's direction with each episode's β, over √v̂ + ε, at length 1.

    That direction is the policy gradient of normalised A_E + β A_I, each in units of its scale.
    So what of A_I is parallel to A changes nothing, however well it is aligned with
    g_E.
    """

    centred = watched.config.ppo.centre_advantages

    def update(each: Round, number: int, step: float) -> np.ndarray:
        total = np.concatenate(
            [
                scaled(item, "extrinsic")
                + (item.beta + step * (place == number)) * scaled(item, "intrinsic")
                for place, item in enumerate(each.rollout)
            ]
        )
        total -= total.mean() if centred else 0
        return policy_gradient(watched, each, total / np.sqrt(np.mean(total**2)))

    for each in watched.rounds:
        steps = 1.0
        if each.time:
            steps = np.sqrt(each.square / (1 - 0.999**each.time)) + 1e-5
        for number, found in enumerate(each.directions):
            change = (update(each, number, 1e-4) - update(each, number, -1e-4)) / 2e-4 / steps
            expected = change / np.linalg.norm(change)
            largest = np.abs(expected).max()
            np.testing.assert_allclose(found, expected, rtol=1e-2, atol=2e-3 * largest)


def test_each_beta_is_credited_with_its_own_effect(watched):
    """β weighed the update on its own episode, whose effect the next two rollouts' g_E show.

    What reaches the LSTM, by another backward pass: for each episode of the rollout two before,
    (credit - prior · way from the initial logit) · logit of the sequence that chose its β.
    """
    config, config_ppo = watched.config.meta, watched.config.ppo
    chosen_from = iter([None, *read_sequences(watched)])  # by episode, from 0
    chosen = [[next(chosen_from) for _ in each.rollout] for each in watched.rounds]
    squares = weight = 0.0
    credits: list[np.ndarray] = []  # of the episodes of each round
    for number, each in enumerate(watched.rounds):
        advantages = np.concatenate([scaled(item, "extrinsic") for item in each.rollout])
        advantages -= advantages.mean() if config_ppo.centre_advantages else 0
        gradient = policy_gradient(watched, each, advantages)
        strength = np.sqrt(np.mean(advantages**2))
        judged = [
            (earlier, place, gradient @ direction / strength)
            for earlier in range(max(0, number - 2), number)
            for place, direction in enumerate(watched.rounds[earlier].directions)
        ]
        if judged:
            squares = 0.99 * squares + np.mean([along**2 for *_, along in judged])
            weight = 0.99 * weight + 1
        for earlier, place, along in judged:
            item = watched.rounds[earlier].rollout[place]
            influence = min(1, np.sqrt(np.mean(scaled(item, "intrinsic") ** 2)))
            usual = np.sqrt(squares / weight)
            credits[earlier][place] += along / usual * min(1, strength) * influence
        credits.append(np.zeros(len(each.rollout)))
        told = watched.diagnostics[number].beta_credit
        known = number >= 2 and [
            (min(max(credit / math.sqrt(2), -config.max_credit), config.max_credit), source)
            for credit, source in zip(credits[number - 2], chosen[number - 2], strict=True)
            if source is not None
        ]
        if not known:  # too early, or only the first β, which was given
            assert each.learnt == [] and math.isnan(told)
            continue
        assert told == pytest.approx(np.mean([credit for credit, _ in known]), rel=2e-2, abs=1e-3)
        terms = []
        for credit, source in known:
            logit = each.meta(source)
            step = credit - config.prior * (logit.item() - math.log(0.4 / 0.6))
            terms.append(step * logit)
        expected = each.meta.gradient(-sum(terms).sum() / len(terms))
        largest = np.abs(expected).max()
        assert largest > 0
        (found,) = each.learnt
        np.testing.assert_allclose(found, expected, rtol=2e-2, atol=5e-3 * largest)


def test_restored_controller_continues_to_the_bit(make):
    original, restored, rng = make(horizon=3), make(horizon=3), np.random.default_rng(0)

    def step(controllers, several: bool) -> None:
        episodes = [episode_of(rng) for _ in range(2 if several else 1)]
        gradient, *changes = rng.standard_normal((len(episodes) + 1, 9)).astype(np.float32)
        for controller in controllers:
            for episode in episodes:
                controller.next_episode(episode, np.ones(20))
            controller.learn(gradient, 0.7, [Effect(change, 0.5) for change in changes])

    for several in (False, True, False, False, True):
        step([original], several)
    restored.load_state_dict(copy.deepcopy(original.state_dict()))
    for several in (True, False, False, True, False):
        step([original, restored], several)
        assert original.beta == restored.beta
    assert (original.network.parameters == restored.network.parameters).all()
    assert original.optimiser.time > 5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("problem", "low", "high"), [("Help", 0.6, 1), ("Harm", 0, 0.1), ("Nothing", 0.2, 0.6)]
)
def test_planted_problems(problem, low, high):
    """A bonus that helps, one that harms, one without any bearing; all starting from β = 0.4."""
    study = read_study([ROOT / "config.yaml", ROOT / "config" / "planted.yaml"])
    config = study.run_config(f"Planted{problem}-v0", "mace_full", 0)
    records = finish(config.model_copy(update={"episodes": 800})).records
    assert low <= np.mean([record.beta for record in records[-80:]]) <= high
