"""β: the schedule by hand; the meta gradient against finite differences of what it estimates."""

import copy
import math
from itertools import pairwise
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
from mace_rl.beta.meta import MetaAdaptation, alignment
from mace_rl.beta.schedule import ExponentialSchedule
from mace_rl.config.run import ExponentialBeta, RunConfig
from mace_rl.environments.rollout import Episode
from mace_rl.streams import Streams
from mace_rl.train import Experience, Trainer, beta_controller


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
    episode, bonus = episode_of(rng, "Pendulum-v1", length), rng.random(length)
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
    """dJ_E(θ + η (g_E + β g_I)) / dβ = η ⟨g_E(θ'), g_I(θ)⟩, β moved by hand on the left."""
    problem, rate = TwoStepProblem(seed), 0.5
    start = problem.parameters.copy()
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
    controller, rng = make(hidden_units=6), np.random.default_rng(0)
    for _ in range(len(credits) + 1):  # the first β is given, so one more
        controller.next_episode(episode_of(rng), rng.random(20))
    sequences = list(controller.sources)[1 : len(credits) + 1]
    # Changes whose component along g_E = (1, 0) is the credit.
    extrinsic = np.array([1.0, 0.0], np.float32)
    intrinsic = [np.array([c, math.sqrt(1 - c * c)], np.float32) for c in credits]
    controller.learn(np.ones(2, np.float32), [np.ones(2, np.float32), *intrinsic])
    twin = Twin(controller.network)
    assert not learnt
    controller.pending = controller.pending[1:]
    assert controller.learn(extrinsic, []) == pytest.approx(np.mean(credits), abs=1e-6)
    terms = [c * beta_of(twin, seen) for c, seen in zip(credits, sequences, strict=True)]
    # Adam descends, so the gradient is that of minus the objective.
    expected = twin.gradient(-torch.cat(terms).mean())
    (gradient,) = learnt
    np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-7)
    assert all((part != 0).any() for part in controller.network.split(gradient))


@pytest.mark.parametrize(("credit", "rises"), [(0.8, True), (-0.8, False)])
def test_beta_follows_what_helped_the_extrinsic_return(make, credit, rises):
    controller, rng = make(), np.random.default_rng(0)
    extrinsic = np.array([1.0, 0.0], np.float32)
    intrinsic = np.array([credit, math.sqrt(1 - credit**2)], np.float32)
    betas = []
    for _ in range(40):
        controller.learn(extrinsic, [intrinsic])
        controller.next_episode(episode_of(rng), rng.random(20))
        betas.append(controller.beta)
    assert (betas[-1] > 0.6) if rises else (betas[-1] < 0.2)
    assert all(0 < beta < 1 for beta in betas)


def test_without_credit_the_network_stays_as_it_is(make):
    """The first β is given, not chosen: nothing to learn from its effect."""
    controller = make()
    before = controller.network.parameters.copy()
    assert controller.learn(np.ones(3), [np.ones(3)]) is None  # nothing is pending
    controller.next_episode(episode_of(np.random.default_rng(0)), np.zeros(20))
    assert controller.learn(np.ones(3), [np.ones(3)]) is None  # the first β, which was given
    assert (controller.network.parameters == before).all()
    assert controller.optimiser.time == 0


# --- Which β is credited with what --------------------------------------------------------------


class Watched(Trainer):
    """Keeps, round by round, what was played, by which weights, and what reached the LSTM.

    learnt: the gradients that reached any optimiser so far.
    """

    def __init__(self, config: RunConfig, learnt: list[np.ndarray]) -> None:
        super().__init__(config)
        self.learnt = learnt
        self.rounds: list[Round] = []

    def collect(self) -> list[Experience]:
        self.played_by = self.ppo.policy.parameters.copy()
        return super().collect()

    def adapt(self, rollout: list[Experience]) -> float | None:
        assert (self.played_by == self.ppo.policy.parameters).all()  # before the update
        meta = Twin(self.controller.network)
        before = len(self.learnt)
        credit = super().adapt(rollout)
        learnt = self.learnt[before:]
        changes = [change.copy() for _, change in self.controller.pending]
        self.rounds.append(Round(rollout, self.played_by, meta, changes, learnt))
        return credit


class Round(NamedTuple):
    """One round of training."""

    rollout: list[Experience]
    policy: np.ndarray  # the parameters that played it
    meta: Twin  # as it was while it was played
    changes: list[np.ndarray]  # for each of its episodes the change of the update by its β
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
        "episodes": 12,
        "engine": engine,
        "ppo": {"rollout_steps": steps, "gae_lambda": 0.95},
        "meta": {"hidden_units": 16},
    }
    trainer = Watched(run_config(environment, "mace_full", 2, **changes), learnt)
    assert [record.episode for record in finish(trainer).records] == [*range(1, 13)]
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
        sequences.append(reader.sequence(item.episode, item.bonus.reward))
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
    assert len(set(betas)) == 12 and all(0 < beta < 1 for beta in betas)


def policy_gradient(watched, each: Round, advantages: np.ndarray) -> np.ndarray:
    """∇ mean(log π · A) over a round's steps, by autograd, of the policy that played it."""
    watched.ppo.policy.parameters[:] = each.policy
    other = Twin(watched.ppo.policy)
    observations = np.concatenate([item.observations[:-1] for item in each.rollout])
    actions = np.concatenate([item.episode.actions for item in each.rollout])
    log_probs = other.policy(observations).log_prob(torch.from_numpy(actions))
    return other.gradient((log_probs * torch.from_numpy(advantages)).mean())


def test_change_is_how_the_update_moves_with_beta(watched):
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
        return policy_gradient(watched, each, (total - total.mean()) / total.std())

    for each in watched.rounds:
        length = np.linalg.norm(update(each, 0, 0.0))
        for number, found in enumerate(each.changes):
            expected = (update(each, number, 1e-4) - update(each, number, -1e-4)) / 2e-4 / length
            largest = np.abs(expected).max()
            np.testing.assert_allclose(found, expected, rtol=1e-2, atol=2e-3 * largest)


def test_each_beta_is_credited_with_its_own_effect(watched):
    """β weighed the update on its own episode, whose effect the next rollout's g_E shows.

    What reaches the LSTM, by another backward pass: for each episode of the rollout before,
    credit × β of the sequence that chose its β.
    """
    chosen_from = [None, *read_sequences(watched)]  # by episode, from 0
    diagnostics = iter([row.beta_credit for row in watched.diagnostics])
    assert watched.rounds[0].learnt == [] and math.isnan(next(diagnostics))
    start = 0
    for before, after in pairwise(watched.rounds):
        advantages = np.concatenate([item.extrinsic_advantages for item in after.rollout])
        extrinsic = policy_gradient(watched, after, advantages - advantages.mean())
        towards = extrinsic / np.linalg.norm(extrinsic)
        credits = [
            (float(towards @ change), sequence)
            for change, sequence in zip(before.changes, chosen_from[start:], strict=False)
            if sequence is not None
        ]
        start += len(before.rollout)
        told = next(diagnostics)
        if not credits:  # only the first β, which was given
            assert after.learnt == [] and math.isnan(told)
            continue
        assert told == pytest.approx(np.mean([credit for credit, _ in credits]), rel=1e-2, abs=2e-4)
        terms = [credit * beta_of(after.meta, sequence) for credit, sequence in credits]
        expected = after.meta.gradient(-sum(terms).sum() / len(terms))
        largest = np.abs(expected).max()
        assert largest > 0
        (found,) = after.learnt
        np.testing.assert_allclose(found, expected, rtol=1e-2, atol=2e-3 * largest)


def test_restored_controller_continues_to_the_bit(make):
    original, restored, rng = make(), make(), np.random.default_rng(0)

    def step(controllers, several: bool) -> None:
        episodes = [episode_of(rng) for _ in range(2 if several else 1)]
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
