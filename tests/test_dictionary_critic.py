"""NEC's dictionary as a critic: against loops over its entries, and what it promises."""

import numpy as np
import pytest
import torch
from shared import finish

from mace_rl.agent.ppo import Batch
from mace_rl.config.section import ConfigError
from mace_rl.runs.agent import Agent, load_agent
from mace_rl.trainer import Trainer

DICTIONARY = {"kind": "dictionary", "capacity": 2000, "neighbours": 10}
DICTIONARY |= {"kernel_bandwidth": 0.05, "learning_rate": 0.1}


def batch_of(observations: np.ndarray, returns: np.ndarray) -> Batch:
    """Steps with these returns, extrinsic and intrinsic ones."""
    count = len(observations)
    rng = np.random.default_rng(0)
    return Batch(
        observations=observations.astype(np.float32),
        actions=rng.integers(2, size=count),
        log_probs=np.full(count, np.log(0.5), np.float32),
        advantages=rng.standard_normal(count).astype(np.float32),
        returns=dict.fromkeys(("extrinsic", "intrinsic"), np.asarray(returns, np.float32)),
    )


class Slow:
    """The dictionary as NEC's paper says it, entry by entry: [state, return, last use]."""

    def __init__(self, capacity, neighbours, kernel_bandwidth, learning_rate, normaliser):
        self.capacity, self.k = capacity, neighbours
        self.delta, self.alpha = kernel_bandwidth, learning_rate
        self.normaliser, self.entries, self.time = normaliser, [], 0

    def value(self, state):
        def distance(entry):
            return np.mean(((entry[0] - state) / self.normaliser.std) ** 2)

        chosen = sorted(self.entries, key=distance)[: self.k]
        for entry in chosen:
            entry[2] = self.time
        kernels = [1 / (distance(entry) + self.delta) for entry in chosen]
        return sum(k * e[1] for k, e in zip(kernels, chosen, strict=True)) / sum(kernels)

    def values(self, states):
        self.time += 1
        return [self.value(state) for state in states]

    def remember(self, states, returns):
        self.time += 1
        new = []
        for state, target in zip(states, returns, strict=True):
            for entry in self.entries + new:
                if (entry[0] == state).all():
                    entry[1:] = [entry[1] + self.alpha * (target - entry[1]), self.time]
                    break
            else:
                new.append([state, target, self.time])
        for entry in new:
            if len(self.entries) < self.capacity:
                self.entries.append(entry)
            else:
                uses = [entry[2] for entry in self.entries]
                self.entries[uses.index(min(uses))] = entry


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("capacity", [12, 50])
def test_values_equal_a_search_entry_by_entry(make_ppo, monkeypatch, capacity, normalise):
    """States that come again, capacity that does not last, a standardisation that moves."""
    settings = {"capacity": capacity, "neighbours": 4}
    settings |= {"kernel_bandwidth": 0.1, "learning_rate": 0.3}
    critic = DICTIONARY | settings
    ppo = make_ppo(intrinsic=True, critic=critic, normalise_observations=normalise)
    critic, slow = ppo.critics["intrinsic"], Slow(**settings, normaliser=ppo.normaliser)
    rng = np.random.default_rng(0)
    pool = (rng.standard_normal((30, 4)) * [1, 5, 0.1, 3] + [0, 100, 0, 2]).astype(np.float32)
    assert (critic.values(pool) == 0).all()
    for _ in range(40):
        ppo.normaliser.update(pool[rng.integers(30, size=5)])
        states, returns = pool[rng.integers(30, size=9)], 10 * rng.standard_normal(9)
        critic.remember(batch_of(ppo.normalise(states), returns))
        slow.remember(states, returns)
        assert len(critic) == len(slow.entries)
        asked = pool[rng.integers(30, size=3)]
        found = critic.values(ppo.normalise(asked))
        np.testing.assert_allclose(found, slow.values(asked), rtol=1e-3, atol=1e-3)
    assert len(critic) == min(capacity, 30)


def test_of_more_new_states_than_fit_the_last_are_kept(make_ppo):
    settings = {"capacity": 3, "neighbours": 1, "kernel_bandwidth": 0.001}
    critic = make_ppo(critic=DICTIONARY | settings).critics["extrinsic"]
    states = np.eye(5, 4, dtype=np.float32)[[4, 2, 0, 3, 1]]
    critic.remember(batch_of(states, [1, 2, 3, 4, 5]))
    assert (critic.values(states[2:]) == [3, 4, 5]).all() and len(critic) == 3


def test_the_actor_learns_as_with_networks(make_ppo):
    batch = batch_of(np.random.default_rng(0).standard_normal((50, 4)), np.ones(50))
    kinds = DICTIONARY, {"kind": "network"}
    ppos = [make_ppo(intrinsic=True, critic=kind, minibatch_size=16) for kind in kinds]
    norms = [ppo.update(batch).gradient_norms for ppo in ppos]
    assert (ppos[0].policy.parameters == ppos[1].policy.parameters).all()
    assert norms[0] == {"actor": norms[1]["actor"], "extrinsic": 0.0, "intrinsic": 0.0}
    assert list(ppos[0].optimisers) == ["actor"]


@pytest.mark.parametrize(
    ("environment", "normalise"), [("CartPole-v1", True), ("FrozenLake-v1", False)]
)
def test_agent_on_disk_has_the_same_values(run_config, trained, environment, normalise):
    ppo = {"critic": DICTIONARY, "normalise_observations": normalise}
    config = run_config(environment, "mace_fixed", 0, episodes=4, ppo=ppo)
    empty, trainer = Agent(Trainer(config)), finish(config)
    agent = load_agent(trained(environment, "mace_fixed", episodes=4, ppo=ppo))
    space = trainer.environment.observation_space
    space.seed(0)
    rows = np.stack([trainer.environment.encode(space.sample()) for _ in range(40)])
    seen = trainer.ppo.normalise(rows.clip(-3, 3))
    for kind, critic in trainer.ppo.critics.items():
        values = agent.critics[kind](torch.from_numpy(seen))[:, 0]
        np.testing.assert_allclose(values, critic.values(seen), rtol=1e-3, atol=1e-3)
        assert (empty.critics[kind](torch.from_numpy(seen)) == 0).all()


@pytest.mark.parametrize(
    ("critic", "message"),
    [
        ({"neighbours": 2001}, "neighbours is 2001, which must not exceed capacity, 2000"),
        ({"learning_rate": 1.5}, "ppo.critic.learning_rate is 1.5, but .* less than or equal to 1"),
        ({"capacty": 3}, "unknown key 'ppo.critic.capacty' .* 'capacity'"),
    ],
)
def test_wrong_settings_get_one_line(run_config, critic, message):
    with pytest.raises(ConfigError, match=message) as caught:
        run_config("CartPole-v1", "ppo", ppo={"critic": DICTIONARY | critic})
    assert "\n" not in str(caught.value)
