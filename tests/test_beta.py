"""β: the schedule by hand; the meta gradient against finite differences of what it estimates."""

import copy
import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete
from test_meta_network import MetaTwin

from mace_rl.beta import ExponentialSchedule, MetaAdaptation, alignment
from mace_rl.environments import Environment
from mace_rl.hyperparameters import ExponentialBeta, RunConfig
from mace_rl.learner import Learner
from mace_rl.policy import Actor
from mace_rl.ppo import PPO
from mace_rl.rollout import Episode
from mace_rl.train import Experience, Trainer


def episode_of(rng, environment: Environment, length=20) -> Episode:
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


@pytest.fixture
def make(run_config):
    """`make(environment, initial, **settings of meta)`: the controller of mace_full."""

    def build(environment="CartPole-v1", initial=0.4, **settings) -> MetaAdaptation:
        beta = {"kind": "meta", "initial": initial}
        config = run_config(environment, "mace_full", 0, beta=beta, meta=settings)
        return MetaAdaptation(config, Environment(environment, 0))

    return build


@pytest.fixture
def learnt(monkeypatch) -> list[np.ndarray]:
    """The gradients that reach learners, as they come."""
    gradients = []
    descend = Learner.descend

    def note(self: Learner, gradient: np.ndarray) -> float:
        gradients.append(gradient.copy())
        return descend(self, gradient)

    monkeypatch.setattr(Learner, "descend", note)
    return gradients


# --- The schedule -------------------------------------------------------------------------------


def test_exponential_schedule_by_hand():
    config = ExponentialBeta(kind="exponential", initial=0.4, decay=0.5, floor=0.06)
    schedule = ExponentialSchedule(config)
    betas = []
    for _ in range(6):
        betas.append(schedule.beta)
        schedule.next_episode(None, None)
    assert betas == pytest.approx([0.4, 0.2, 0.1, 0.06, 0.06, 0.06])
    assert not schedule.learns


def test_the_paper_s_schedules_start_where_the_variant_says(run_config):
    for variant, initial in (("mace_fixed", 0.4), ("mace_fixed_0.2", 0.2), ("mace_fixed_0.6", 0.6)):
        schedule = ExponentialSchedule(run_config("CartPole-v1", variant).beta)
        assert schedule.beta == initial
        for _ in range(1000):
            schedule.next_episode(None, None)
        assert schedule.beta == pytest.approx(initial * math.exp(1000 * math.log(0.999)))
        schedule.load_state_dict({"episodes": 100_000})
        assert schedule.beta == 0.01


# --- What the network is asked for --------------------------------------------------------------


@pytest.mark.parametrize("initial", [0.05, 0.4, 0.9])
@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
def test_beta_starts_at_initial_and_stays_in_0_to_1(make, environment, initial):
    controller = make(environment, initial)
    assert controller.beta == initial
    rng, played = np.random.default_rng(0), Environment(environment, 0)
    for scale in (1, 100, 1e4):
        episode = episode_of(rng, played)
        episode.rewards[:] *= scale
        controller.next_episode(episode, rng.random(20))
        assert 0 < controller.beta < 1
        assert controller.beta == pytest.approx(initial, abs=0.05)  # untrained


def test_sequence_is_state_action_reward_bonus(make):
    controller = make(max_sequence=None)
    rng = np.random.default_rng(0)
    episode, bonus = episode_of(rng, Environment("CartPole-v1", 0), length=6), rng.random(6)
    controller.standardiser.update(3 + 2 * rng.standard_normal((50, 4)))
    mean, std = controller.standardiser.mean, controller.standardiser.std
    rows = [
        [
            *((episode.observations[t] - mean) / std),
            *(float(episode.actions[t] == action) for action in (0, 1)),
            math.copysign(math.log(1 + abs(episode.rewards[t])), episode.rewards[t]),
            math.log(1 + bonus[t]),
        ]
        for t in range(6)
    ]
    found = controller.sequence(episode, bonus)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, rows, rtol=1e-5)


@pytest.mark.parametrize("length", [5, 6, 7, 13, 60])
def test_long_sequences_are_condensed(make, length):
    """At most 6 stretches of consecutive steps, as even as can be, none left out: mean state and
    action, logarithm of the summed reward and bonus."""
    rng = np.random.default_rng(0)
    episode = episode_of(rng, Environment("Pendulum-v1", 0), length)
    bonus = rng.random(length)
    whole = make("Pendulum-v1", max_sequence=None).sequence(episode, bonus)
    found = make("Pendulum-v1", max_sequence=6).sequence(episode, bonus)
    if length <= 6:
        assert (found == whole).all()
        return
    assert len(found) == 6
    bounds = [math.floor(i * length / 6) for i in range(7)]
    for row, (start, end) in zip(found, pairwise(bounds), strict=True):
        np.testing.assert_allclose(row[:-2], whole[start:end, :-2].mean(0), rtol=1e-4, atol=1e-6)
        reward, summed = episode.rewards[start:end].sum(), bonus[start:end].sum()
        assert row[-2] == pytest.approx(math.copysign(math.log(1 + abs(reward)), reward), rel=1e-5)
        assert row[-1] == pytest.approx(math.log(1 + summed), rel=1e-5)


def test_beta_of_the_next_episode_is_the_lstm_s_answer_to_the_last(make):
    """The recurrence written out (Hochreiter & Schmidhuber 1997, with a forget gate)."""
    controller = make(hidden_units=5)
    rng = np.random.default_rng(0)
    controller.next_episode(episode_of(rng, Environment("CartPole-v1", 0), 7), rng.random(7))
    network, sequence = controller.network, controller.sources[-1].astype(np.float64)
    parts = network.split(network.parameters.astype(np.float64))
    inward, recurrent, bias, readout, readout_bias = parts

    def logistic(x):
        return 1 / (1 + np.exp(-x))

    hidden, cell = np.zeros(5), np.zeros(5)
    for row in sequence:
        enter, forget, leave, candidate = np.split(row @ inward + hidden @ recurrent + bias, 4)
        cell = logistic(forget) * cell + logistic(enter) * np.tanh(candidate)
        hidden = logistic(leave) * np.tanh(cell)
    expected = logistic(readout @ hidden + readout_bias[0])
    assert controller.beta == pytest.approx(expected, abs=1e-6)


# --- The meta gradient --------------------------------------------------------------------------


class TwoStepProblem:
    """Two decisions, a reward after each: J and its gradient are exact sums over 4 × 2 paths.

    The second state is reached by the first action; the actor's parameters are in float64, so
    that finite differences of J are.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.actor = Actor(3, Discrete(2), [5], 0.0, rng)
        self.actor.parameters = 0.7 * rng.standard_normal(len(self.actor.parameters))
        self.set(self.actor.parameters)
        # Reward of each action in each state, for the two kinds.
        self.extrinsic, self.intrinsic = rng.standard_normal((2, 3, 2))
        self.paths = [(a, b) for a in (0, 1) for b in (0, 1)]

    def set(self, parameters: np.ndarray) -> None:
        self.actor.parameters = parameters
        self.actor.weights, self.actor.biases = self.actor.split(parameters)

    def policy(self) -> np.ndarray:
        """π(a|s), [3, 2]: softmax of the network's outputs."""
        logits = self.actor.forward(np.eye(3))[-1]
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
        mean_to_sum = len(states)
        ppo = PPO.__new__(PPO)
        ppo.actor = self.actor
        (gradient,) = ppo.policy_gradients(
            np.eye(3)[states], np.array(actions), [np.array(advantages)]
        )
        return mean_to_sum * gradient


@pytest.mark.parametrize("seed", range(5))
def test_policy_gradient_is_the_gradient_of_the_expected_return(seed):
    """So that what follows tests the meta gradient and not this."""
    problem = TwoStepProblem(seed)
    start = problem.actor.parameters.copy()
    found = problem.gradient(problem.extrinsic)
    for i in range(len(start)):
        values = []
        for step in (1e-6, -1e-6):
            problem.set(start + step * (np.arange(len(start)) == i))
            values.append(problem.objective(problem.extrinsic))
        assert found[i] == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("beta", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("seed", range(5))
def test_credit_is_the_derivative_of_the_next_policy_s_return(seed, beta):
    """dJ_E(θ + η (g_E + β g_I)) / dβ = η ⟨g_E(θ'), g_I(θ)⟩, β moved by hand on the left."""
    problem, rate = TwoStepProblem(seed), 0.5
    start = problem.actor.parameters.copy()
    extrinsic = problem.gradient(problem.extrinsic)
    intrinsic = problem.gradient(problem.intrinsic)

    def next_return(beta: float) -> float:
        problem.set(start + rate * (extrinsic + beta * intrinsic))
        return problem.objective(problem.extrinsic)

    measured = (next_return(beta + 1e-5) - next_return(beta - 1e-5)) / 2e-5
    problem.set(start + rate * (extrinsic + beta * intrinsic))
    after = problem.gradient(problem.extrinsic)
    assert rate * after @ intrinsic == pytest.approx(measured, rel=1e-5, abs=1e-9)
    # What the controller uses differs by a positive factor that no β has a part in.
    factor = rate * np.linalg.norm(after)
    assert factor * alignment(after, intrinsic) == pytest.approx(measured, rel=1e-5)


def test_alignment_by_hand():
    assert alignment(np.array([3.0, 4.0]), np.array([4.0, 3.0])) == pytest.approx(24 / 5)
    assert alignment(np.array([0.1, 0.0]), np.array([-5.0, 7.0])) == pytest.approx(-5)
    assert alignment(np.array([1.0, 0.0]), np.array([0.0, 2.0])) == 0
    assert alignment(np.zeros(2), np.array([0.0, 2.0])) == 0
    tiny = np.full(1000, 1e-12, np.float32)
    assert alignment(tiny, tiny) == pytest.approx(1e-12 * 1000**0.5, rel=1e-3)


@pytest.mark.parametrize("credits", [[0.7], [-0.7], [0.5, -0.2, 0.9]])
def test_lstm_receives_the_gradient_of_credit_times_beta(make, learnt, credits):
    """Every parameter's gradient after `learn`, a sample of them against finite differences."""
    controller = make(hidden_units=6)
    environment, rng = Environment("CartPole-v1", 0), np.random.default_rng(0)
    for _ in range(len(credits) + 1):  # the first β is given, so one more
        controller.next_episode(episode_of(rng, environment), rng.random(20))
    sequences = list(controller.sources)[1 : len(credits) + 1]
    # Changes whose component along g_E = (1, 0) is the credit.
    extrinsic = np.array([1.0, 0.0], np.float32)
    intrinsic = [np.array([c, math.sqrt(1 - c * c)], np.float32) for c in credits]
    controller.learn(np.ones(2, np.float32), [np.ones(2, np.float32), *intrinsic])
    twin = MetaTwin(controller.network)
    assert not learnt
    controller.pending = controller.pending[1:]
    controller.learn(extrinsic, [])
    (gradient,) = learnt
    assert np.isfinite(gradient).all()
    assert all((part != 0).any() for part in controller.network.split(gradient))

    def mean_credited_beta() -> float:
        with torch.no_grad():
            betas = [twin(sequence).item() for sequence in sequences]
        return float(np.mean([c * beta for c, beta in zip(credits, betas, strict=True)]))

    for part, slopes in zip(twin.parts, controller.network.split(gradient), strict=True):
        flat = part.data.view(-1)
        for i in rng.choice(len(flat), min(4, len(flat)), replace=False):
            original, values = float(flat[i]), []
            for step in (1e-5, -1e-5):
                flat[i] = original + step
                values.append(mean_credited_beta())
            flat[i] = original
            # Adam descends, so the gradient is that of minus the objective.
            expected = -(values[0] - values[1]) / 2e-5
            assert slopes.ravel()[i] == pytest.approx(expected, rel=1e-3, abs=1e-7)


@pytest.mark.parametrize(("credit", "rises"), [(0.8, True), (-0.8, False)])
def test_beta_follows_what_helped_the_extrinsic_return(make, credit, rises):
    controller = make()
    environment, rng = Environment("CartPole-v1", 0), np.random.default_rng(0)
    extrinsic = np.array([1.0, 0.0], np.float32)
    intrinsic = np.array([credit, math.sqrt(1 - credit**2)], np.float32)
    betas = []
    for _ in range(40):
        controller.learn(extrinsic, [intrinsic])
        controller.next_episode(episode_of(rng, environment), rng.random(20))
        betas.append(controller.beta)
    assert (betas[-1] > 0.6) if rises else (betas[-1] < 0.2)
    assert all(0 < beta < 1 for beta in betas)


def test_without_credit_the_network_stays_as_it_is(make):
    """The first β is given, not chosen: nothing to learn from its effect."""
    controller = make()
    before = controller.network.parameters.copy()
    controller.learn(np.ones(3), [np.ones(3)])  # the first rollout: nothing is pending
    controller.next_episode(
        episode_of(np.random.default_rng(0), Environment("CartPole-v1", 0)), np.zeros(20)
    )
    controller.learn(np.ones(3), [np.ones(3)])  # credits the first β
    assert (controller.network.parameters == before).all()
    assert controller.learner.time == 0


# --- Which β is credited with what --------------------------------------------------------------


class Watched(Trainer):
    """Keeps, round by round, what was played, by which weights, and what reached the LSTM.

    learnt: the gradients that reached any learner so far.
    """

    def __init__(self, config: RunConfig, learnt: list[np.ndarray]) -> None:
        super().__init__(config)
        self.learnt = learnt
        self.rounds: list[Round] = []

    def collect(self) -> list[Experience]:
        self.played_by = self.ppo.actor.parameters.copy()
        return super().collect()

    def adapt(self, rollout: list[Experience]) -> None:
        assert (self.played_by == self.ppo.actor.parameters).all()  # before the update
        meta = MetaTwin(self.controller.network)
        before = len(self.learnt)
        super().adapt(rollout)
        learnt = self.learnt[before:]
        changes = [change.copy() for _, change in self.controller.pending]
        self.rounds.append(Round(rollout, self.played_by, meta, changes, learnt))


class Round(NamedTuple):
    """One round of training."""

    rollout: list[Experience]
    policy: np.ndarray  # the actor's parameters that played it
    meta: MetaTwin  # as it was while it was played
    changes: list[np.ndarray]  # for each of its episodes the change of the update by its β
    learnt: list[np.ndarray]  # the gradient, if any, that reached the meta network after it


@pytest.fixture(params=["CartPole-v1", "Pendulum-v1"])
def environment(request) -> str:
    return request.param


@pytest.fixture(params=["an episode", "several episodes"])
def watched(request, environment, run_config, learnt) -> Watched:
    """A finished short run; a rollout is one episode, or several."""
    steps = {"CartPole-v1": 80, "Pendulum-v1": 400}[environment]
    several = request.param == "several episodes"
    trainer = Watched(
        run_config(
            environment,
            "mace_full",
            2,
            episodes=12,
            ppo={"rollout_steps": steps if several else 1, "gae_lambda": 0.95},
            meta={"hidden_units": 16},
        ),
        learnt,
    )
    assert [record.episode for records in trainer.run() for record in records] == [*range(1, 13)]
    assert (max(len(each.rollout) for each in trainer.rounds) > 1) == several
    return trainer


def read_sequences(trainer: Watched) -> list[np.ndarray]:
    """What the LSTM reads of each episode, standardised by all states up to its end."""
    reader = MetaAdaptation(trainer.config, trainer.environment)
    sequences, observed = [], []
    for item in (item for each in trainer.rounds for item in each.rollout):
        observed += [*item.episode.observations[:-1].astype(np.float64)]
        reader.standardiser.count = len(observed)
        reader.standardiser.mean = np.mean(observed, axis=0)
        reader.standardiser.sum_of_squares = np.var(observed, axis=0) * len(observed)
        sequences.append(reader.sequence(item.episode, item.bonus))
    return sequences


def test_each_beta_comes_from_the_episode_before(watched):
    """From the meta network as it has learnt from all rounds before; the first one is given."""
    sequences = read_sequences(watched)
    played = [(item.beta, each.meta) for each in watched.rounds for item in each.rollout]
    assert played[0][0] == 0.4
    for sequence, (beta, meta) in zip(sequences, played[1:], strict=False):
        assert beta == pytest.approx(meta(sequence).item(), abs=1e-5)
    betas = [beta for beta, _ in played]
    assert betas == [record.beta for record in watched.records]
    assert len(set(betas)) == 12 and all(0 < beta < 1 for beta in betas)


def policy_gradient(watched, twin, each: Round, advantages: np.ndarray) -> np.ndarray:
    """∇ mean(log π · A) over a round's steps, by autograd, of the policy that played it."""
    watched.ppo.actor.parameters[:] = each.policy
    other = twin(watched.ppo.actor)
    observations = np.concatenate([item.observations[:-1] for item in each.rollout])
    actions = np.concatenate([item.episode.actions for item in each.rollout])
    log_probs = other.policy(observations).log_prob(torch.from_numpy(actions))
    return other.gradient((log_probs * torch.from_numpy(advantages)).mean())


def test_change_is_how_the_update_moves_with_beta(watched, twin):
    """The direction g of the first step, for each episode's β a little more and less, over |g|.

    g is the policy gradient of (A − mean) / std with A = A_E + β A_I. So what of A_I is parallel
    to A changes nothing, however well it is aligned with g_E.
    """

    def update(each: Round, number: int, step: float) -> np.ndarray:
        total = np.concatenate(
            [
                item.extrinsic_advantages
                + (item.beta + step * (place == number)) * item.intrinsic_advantages
                for place, item in enumerate(each.rollout)
            ]
        )
        return policy_gradient(watched, twin, each, (total - total.mean()) / total.std())

    for each in watched.rounds:
        length = np.linalg.norm(update(each, 0, 0.0))
        for number, found in enumerate(each.changes):
            expected = (update(each, number, 1e-4) - update(each, number, -1e-4)) / 2e-4 / length
            largest = np.abs(expected).max()
            np.testing.assert_allclose(found, expected, rtol=1e-2, atol=2e-3 * largest)


def test_each_beta_is_credited_with_its_own_effect(watched, twin):
    """β weighed the update on its own episode, whose effect the next rollout's g_E shows.

    What reaches the LSTM, by another backward pass: for each episode of the rollout before,
    credit × β of the sequence that chose its β.
    """
    chosen_from = [None, *read_sequences(watched)]  # by episode, from 0
    assert watched.rounds[0].learnt == []
    start = 0
    for before, after in pairwise(watched.rounds):
        advantages = np.concatenate([item.extrinsic_advantages for item in after.rollout])
        extrinsic = policy_gradient(watched, twin, after, advantages - advantages.mean())
        towards = extrinsic / np.linalg.norm(extrinsic)
        terms = [
            float(towards @ change) * after.meta(sequence)
            for change, sequence in zip(before.changes, chosen_from[start:], strict=False)
            if sequence is not None
        ]
        start += len(before.rollout)
        if not terms:  # only the first β, which was given
            assert after.learnt == []
            continue
        expected = after.meta.gradient(-sum(terms) / len(terms))
        largest = np.abs(expected).max()
        assert largest > 0
        (found,) = after.learnt
        np.testing.assert_allclose(found, expected, rtol=1e-2, atol=2e-3 * largest)


def test_restored_controller_continues_to_the_bit(make):
    original, restored = make(), make()
    environment, rng = Environment("CartPole-v1", 0), np.random.default_rng(0)

    def step(controllers, several: bool) -> None:
        episodes = [episode_of(rng, environment) for _ in range(2 if several else 1)]
        gradients = [rng.standard_normal(9).astype(np.float32) for _ in range(len(episodes) + 1)]
        for controller in controllers:
            for episode in episodes:
                controller.next_episode(episode, np.ones(20))
            controller.learn(gradients[0], gradients[1:])

    for several in (False, True, False):
        step([original], several)
    restored.load_state_dict(copy.deepcopy(original.state_dict()))
    for several in (True, False, False):
        step([original, restored], several)
        assert original.beta == restored.beta
    assert (original.network.parameters == restored.network.parameters).all()
