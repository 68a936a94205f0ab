"""The credit of β: the meta gradient by finite differences; which β is credited with what."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete
from shared import Twin, finish, learned

from mace_rl.agent.compiled_learner import CompiledLearner
from mace_rl.agent.policy import Policy
from mace_rl.config.agent import PPOConfig
from mace_rl.config.run import RunConfig
from mace_rl.environments.actions import Actions
from mace_rl.numerics.adam import Adam
from mace_rl.numerics.network import CompiledMLP, mlp
from mace_rl.training.experience import Experience
from mace_rl.training.trainer import Trainer


class SmallProblem:
    """One decision in each of three states: J and its gradient are exact sums over 3 × 2 cases.

    The parameters are in float64, so that finite differences of J are; the gradient is of what
    float32 makes of them.
    """

    def __init__(self, config: PPOConfig, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.actor = Policy(CompiledMLP(mlp([3, 5, 2], 1.0, rng)), Actions("", Discrete(2)), 0.0)
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


class Watched(Trainer):
    """Keeps, round by round, what was played, by which weights, and what β does in the update."""

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        self.rounds: list[Round] = []

    def meta_update(self, rollout: list[Experience]) -> float | None:
        learner = self.ppo.learner
        policy = learner.parameters["actor"].copy()
        unit = 1 / learner.preconditioned(np.ones(len(policy), np.float32))
        credit = super().meta_update(rollout)
        direction = self.controller.objective.judge.directions[-1].copy()
        self.rounds.append(Round(rollout, policy, unit, direction))
        return credit


class Round(NamedTuple):
    rollout: list[Experience]
    policy: np.ndarray  # the parameters that played it
    unit: np.ndarray  # √v̂ + ε of the actor's optimiser before the update; test_ppo.py has it
    direction: np.ndarray  # the change of the update by its β


@pytest.fixture(
    scope="module",
    params=[
        ("CartPole-v1", 1, "compiled"),
        ("CartPole-v1", 80, "compiled"),
        ("Pendulum-v1", 400, "compiled"),
        ("CartPole-v1", 80, "torch"),
    ],
    ids=str,
)
def watched(request, run_config) -> Watched:
    """A finished short run; a rollout is one episode, or several."""
    environment, steps, engine = request.param
    several = steps > 1
    changes = {
        "episodes": 14,
        "engine": engine,
        "ppo": {"rollout_steps": steps, "gae_lambda": 0.95, "centre_advantages": several},
        "beta": learned("credit", horizon=2),
    }
    trainer = Watched(run_config(environment, "mace_credit_network", 2, **changes))
    assert [record.episode for record in finish(trainer).records] == [*range(1, 15)]
    assert (max(len(each.rollout) for each in trainer.rounds) > 1) == several
    return trainer


def policy_gradient(watched, each: Round, advantages: np.ndarray) -> np.ndarray:
    """∇ mean(log π · A) over a round's steps, by autograd, of the policy that played it."""
    watched.ppo.policy.parameters[:] = each.policy
    other = Twin(watched.ppo.policy)
    observations = np.concatenate([item.observations for item in each.rollout])
    actions = np.concatenate([item.episode.actions for item in each.rollout])
    log_probs = other.policy(observations).log_prob(torch.from_numpy(actions))
    return other.gradient((log_probs * torch.from_numpy(advantages)).mean())


def scaled(item: Experience, kind: str) -> np.ndarray:
    """Advantages of one kind in units of their scale."""
    return getattr(item, kind).advantages / getattr(item, kind).scale


def test_direction_is_how_the_update_moves_with_beta(watched):
    """The change of the first step's direction with β, over √v̂ + ε, at length 1.

    That direction is the policy gradient of normalised A_E + β A_I, each in units of its scale.
    So what of A_I is parallel to A changes nothing, however well it is aligned with g_E.
    """
    centred = watched.config.ppo.centre_advantages

    def update(each: Round, step: float) -> np.ndarray:
        total = np.concatenate(
            [
                scaled(item, "extrinsic") + (item.beta + step) * scaled(item, "intrinsic")
                for item in each.rollout
            ]
        )
        total -= total.mean() if centred else 0
        return policy_gradient(watched, each, total / np.sqrt(np.mean(total**2)))

    for each in watched.rounds:
        change = (update(each, 1e-4) - update(each, -1e-4)) / 2e-4 / each.unit
        expected = change / np.linalg.norm(change)
        largest = np.abs(expected).max()
        np.testing.assert_allclose(each.direction, expected, rtol=1e-2, atol=2e-3 * largest)


def test_each_beta_is_credited_with_its_own_effect(watched):
    """β weighed the update on its own rollout, whose effect the next two rollouts' g_E show."""
    squares = weight = 0.0
    credits: list[float] = []  # of the βs of each round
    for number, each in enumerate(watched.rounds):
        advantages = np.concatenate([scaled(item, "extrinsic") for item in each.rollout])
        advantages -= advantages.mean() if watched.config.ppo.centre_advantages else 0
        gradient = policy_gradient(watched, each, advantages)
        strength = np.sqrt(np.mean(advantages**2))
        judged = range(max(0, number - 2), number)
        along = [gradient @ watched.rounds[earlier].direction / strength for earlier in judged]
        if along:
            squares = 0.99 * squares + np.mean(np.square(along))
            weight = 0.99 * weight + 1
        for earlier, value in zip(judged, along, strict=True):
            rollout = watched.rounds[earlier].rollout
            intrinsic = np.concatenate([scaled(item, "intrinsic") for item in rollout])
            of_bonus = min(1, np.sqrt(np.mean(intrinsic**2)))
            credits[earlier] += value / np.sqrt(squares / weight) * min(1, strength) * of_bonus
        credits.append(0.0)
        told = watched.diagnostics[number].beta_credit
        expected = np.clip(credits[number - 2] / math.sqrt(2), -3, 3) if number >= 2 else math.nan
        assert told == pytest.approx(expected, rel=2e-2, abs=1e-3, nan_ok=True)
    assert max(map(abs, credits)) > 0.01
