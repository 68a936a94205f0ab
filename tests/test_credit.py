"""The credit of β: the meta gradient by finite differences; which β is credited with what."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete
from shared import Twin, beta_of, finish

from mace_rl.agent.compiled_learner import CompiledLearner
from mace_rl.agent.policy import Policy
from mace_rl.config.agent import PPOConfig
from mace_rl.config.run import RunConfig
from mace_rl.experience import Experience
from mace_rl.factories import beta_controller
from mace_rl.numerics.adam import Adam
from mace_rl.numerics.network import CompiledMLP, mlp
from mace_rl.streams import Streams
from mace_rl.trainer import Trainer

# --- The meta gradient --------------------------------------------------------------------------


class SmallProblem:
    """One decision in each of three states: J and its gradient are exact sums over 3 × 2 cases.

    The parameters are in float64, so that finite differences of J are; the gradient is of what
    float32 makes of them.
    """

    def __init__(self, config: PPOConfig, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.actor = Policy(CompiledMLP(mlp([3, 5, 2], 1.0, rng)), Discrete(2), 0.0)
        self.learner = CompiledLearner(config, self.actor, {})
        own = Twin(self.actor).own()
        self.parameters = 0.7 * rng.standard_normal(len(own)) * own
        # Reward of each action in each state, for the two kinds.
        self.extrinsic, self.intrinsic = rng.standard_normal((2, 3, 2))

    def returns(self, rewards: np.ndarray) -> np.ndarray:
        """What each action in each state adds to the current policy's J, [3, 2]."""
        (weights, biases), (out, out_biases) = self.actor.network.layers(self.parameters)
        logits = np.tanh(weights + biases) @ out + out_biases  # of the unit vectors
        return np.exp(logits) / np.exp(logits).sum(1, keepdims=True) * rewards

    def gradient(self, rewards: np.ndarray) -> np.ndarray:
        """∇J through `policy_gradients`: every case, weighted with its probability."""
        self.actor.parameters[:] = self.parameters
        states, actions = np.eye(3).repeat(2, axis=0), np.array([0, 1] * 3)
        (mean,) = self.learner.policy_gradients(states, actions, [self.returns(rewards).ravel()])
        return 6 * mean


@pytest.mark.parametrize("beta", [0.1, 0.9])
@pytest.mark.parametrize("seed", range(3))
def test_credit_is_the_derivative_of_the_next_policy_s_return(run_config, seed, beta):
    """dJ_E(θ') / dβ = η ⟨g_E(θ'), P g_I(θ)⟩ for θ' one Adam step along g_E + β g_I from θ.

    β is moved by hand on the left, through Adam as it is, whose moments have a history.
    """
    problem, rng = SmallProblem(run_config().ppo, seed), np.random.default_rng(seed)
    start = problem.parameters.copy()
    extrinsic = problem.gradient(problem.extrinsic)
    intrinsic = problem.gradient(problem.intrinsic)
    usual = rng.uniform(1, 3, len(start)) * np.abs(extrinsic + beta * intrinsic) + 1e-3
    moments = {
        "mean": torch.zeros(len(start), dtype=torch.float64),
        "square": torch.from_numpy(usual**2 * (1 - 0.999**500)),
        "decayed": torch.tensor([0.9**500, 0.999**500], dtype=torch.float64),
    }

    def adam(parameters: np.ndarray) -> Adam:
        optimiser = Adam(parameters, 1e-2)
        optimiser.mean, optimiser.square = np.zeros(len(start)), np.zeros(len(start))
        optimiser.load_state_dict({"parameters": torch.from_numpy(start), **moments})
        return optimiser

    def next_return(beta: float) -> float:
        problem.parameters = start.copy()
        adam(problem.parameters).step(-(extrinsic + beta * intrinsic))
        return problem.returns(problem.extrinsic).sum()

    measured = (next_return(beta + 1e-3) - next_return(beta - 1e-3)) / 2e-3
    after = problem.gradient(problem.extrinsic)
    direction = adam(start.copy()).preconditioned(intrinsic)
    # Of a gradient Adam's first moment takes in a tenth, and v̂ hardly anything.
    assert 1e-2 * 0.1 * after @ direction == pytest.approx(measured, rel=0.02, abs=1e-7)


# --- Which β is credited with what --------------------------------------------------------------


class Watched(Trainer):
    """Keeps, round by round, what was played, by which weights, and what reached the LSTM."""

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        self.rounds: list[Round] = []

    def adapt(self, rollout: list[Experience]) -> float | None:
        meta, learner, learned = Twin(self.controller.network), self.ppo.learner, []
        policy, step = learner.parameters["actor"].copy(), Adam.step
        unit = 1 / learner.preconditioned(np.ones(len(policy), np.float32))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Adam, "step", lambda s, g: (learned.append(g.copy()), step(s, g))[1])
            credit = super().adapt(rollout)
        directions = [item.direction.copy() for item in self.controller.pending[-len(rollout) :]]
        self.rounds.append(Round(rollout, policy, unit, meta, directions, learned))
        return credit


class Round(NamedTuple):
    """One round of training."""

    rollout: list[Experience]
    policy: np.ndarray  # the parameters that played it
    unit: np.ndarray  # √v̂ + ε of the actor's optimiser before the update; test_ppo.py has it
    meta: Twin  # as it was while it was played
    directions: list[np.ndarray]  # for each of its episodes the change of the update by its β
    learned: list[np.ndarray]  # the gradient, if any, that reached the meta network after it


@pytest.fixture(
    scope="module",
    params=[
        ("CartPole-v1", 1, "compiled", 3),
        ("CartPole-v1", 1, "compiled", 1),
        ("CartPole-v1", 80, "compiled", 4),
        ("Pendulum-v1", 400, "compiled", 1),
        ("CartPole-v1", 80, "torch", 4),
    ],
    ids=str,
)
def watched(request, run_config) -> Watched:
    """A finished short run; a rollout is one episode, or several."""
    environment, steps, engine, learn_every = request.param
    several = steps > 1
    changes = {
        "episodes": 14,
        "engine": engine,
        "ppo": {"rollout_steps": steps, "gae_lambda": 0.95, "centre_advantages": several},
        "meta": {"hidden_units": 16, "horizon": 2, "learn_every": learn_every},
    }
    trainer = Watched(run_config(environment, "mace_full", 2, **changes))
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
        reader.normaliser.std = np.std(observed, axis=0)
        reader.progress.update(item.episode.rewards.sum())
        sequences.append(reader.sequence(item.episode, item.bonus.reward, item.beta))
    return sequences


def test_each_beta_comes_from_the_episode_before(watched):
    """From the meta network as it has learned from all rounds before; the first one is given."""
    sequences = read_sequences(watched)
    played = [(item.beta, each.meta) for each in watched.rounds for item in each.rollout]
    assert played[0][0] == 0.4
    for sequence, (beta, meta) in zip(sequences, played[1:], strict=False):
        assert beta == pytest.approx(beta_of(meta, sequence).item(), abs=1e-5)
    betas = [beta for beta, _ in played]
    six = [float(f"{beta:.6g}") for beta in betas]  # digits, as they are recorded
    assert six == [record.beta for record in watched.records]
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
    So what of A_I is parallel to A changes nothing, however well it is aligned with g_E.
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
        for number, found in enumerate(each.directions):
            change = (update(each, number, 1e-4) - update(each, number, -1e-4)) / 2e-4 / each.unit
            expected = change / np.linalg.norm(change)
            largest = np.abs(expected).max()
            np.testing.assert_allclose(found, expected, rtol=1e-2, atol=2e-3 * largest)


def test_each_beta_is_credited_with_its_own_effect(watched):
    """β weighed the update on its own episode, whose effect the next two rollouts' g_E show.

    What reaches the LSTM, by another backward pass, once enough β are judged: for each episode of
    the rollouts two and more before that it has not learned from, (credit - prior · way from the
    initial logit) · logit of the sequence that chose its β.
    """
    config, config_ppo = watched.config.meta, watched.config.ppo
    chosen_from = iter([None, *read_sequences(watched)])  # by episode, from 0
    chosen = [[next(chosen_from) for _ in each.rollout] for each in watched.rounds]
    squares = weight = 0.0
    known: list[tuple[float, np.ndarray]] = []  # judged and not learned from
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
            strength_of_bonus = min(1, np.sqrt(np.mean(scaled(item, "intrinsic") ** 2)))
            usual = np.sqrt(squares / weight)
            credits[earlier][place] += along / usual * min(1, strength) * strength_of_bonus
        credits.append(np.zeros(len(each.rollout)))
        told = watched.diagnostics[number].beta_credit
        if number >= 2:
            known += [
                (min(max(credit / math.sqrt(2), -config.max_credit), config.max_credit), source)
                for credit, source in zip(credits[number - 2], chosen[number - 2], strict=True)
                if source is not None  # but for the first β, which was given
            ]
        if len(known) < config.learn_every:
            assert each.learned == [] and math.isnan(told)
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
        (found,) = each.learned
        np.testing.assert_allclose(found, expected, rtol=2e-2, atol=5e-3 * largest)
        known = []
