"""The trainer: β = 0 is PPO, the same seed is the same run, and what one round does to what."""

import copy

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from mace_rl.beta import MetaAdaptation
from mace_rl.checkpoint import archive
from mace_rl.finite import NonFiniteError
from mace_rl.hyperparameters import RunConfig
from mace_rl.train import Record, Trainer

ENVIRONMENTS = {"CartPole-v1": 25, "Acrobot-v1": 12, "HopperBulletEnv-v0": 20}  # episodes
VARIANTS = ["ppo", "mace_fixed", "mace_full"]
# One update per episode as in the paper's runs; and several episodes with minibatches.
ROLLOUTS = {
    "an episode": {},
    "several": {"rollout_steps": 100, "minibatch_size": 32, "gae_lambda": 0.95},
}


def finish(config: RunConfig) -> Trainer:
    trainer = Trainer(config)
    for _ in trainer.run():
        pass
    return trainer


def without_bonus(records: list[Record]) -> list[tuple]:
    """All that a record says of the environment's episode."""
    return [
        (r.episode, r.env_steps, r.length, r.extrinsic_return, r.beta, r.terminated)
        for r in records
    ]


def learnt(trainer: Trainer) -> dict[str, bytes]:
    """Weights and moments of the networks that plain PPO has, and its normaliser."""
    learners = {name: trainer.ppo.learners[name] for name in ("actor", "extrinsic")}
    arrays = {
        f"{name}.{part}": getattr(learner, part)
        for name, learner in learners.items()
        for part in ("parameters", "mean", "square")
    } | {"normaliser": trainer.ppo.standardiser.mean}
    return {name: array.tobytes() for name, array in arrays.items()}


# --- β = 0 is PPO -------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("rollout", ROLLOUTS)
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_beta_0_equals_ppo_to_the_bit(run_config, monkeypatch, environment, rollout):
    """Though memory, novelty, the intrinsic critic and the meta network are all at work."""
    changes = {"episodes": ENVIRONMENTS[environment], "ppo": ROLLOUTS[rollout]}
    plain = finish(run_config(environment, "ppo", 3, **changes))
    zero = {"kind": "exponential", "initial": 0.0, "decay": 0.9, "floor": 0.0}
    fixed = finish(run_config(environment, "mace_fixed", 3, beta=zero, **changes))
    monkeypatch.setattr(MetaAdaptation, "beta", property(lambda self: 0.0))
    full = finish(run_config(environment, "mace_full", 3, **changes))
    for trainer in (fixed, full):
        assert without_bonus(trainer.records) == without_bonus(plain.records)
        assert learnt(trainer) == learnt(plain)
        assert trainer.noise.bit_generator.state == plain.noise.bit_generator.state
        # The parts that must not matter did work.
        assert sum(record.intrinsic_return for record in trainer.records) > 10
        assert len(trainer.curiosity.memory) > 0
    untrained = Trainer(full.config).controller.network
    assert (full.controller.network.parameters != untrained.parameters).any()


def test_beta_above_0_changes_what_is_learnt(run_config):
    """Else the test above would pass for a bonus that is lost on the way."""
    plain = finish(run_config("CartPole-v1", "ppo", 3, episodes=3))
    fixed = finish(run_config("CartPole-v1", "mace_fixed", 3, episodes=3))
    assert learnt(plain)["actor.parameters"] != learnt(fixed)["actor.parameters"]


# --- The same seed is the same run --------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_training_twice_gives_the_same_bits(run_config, environment, variant):
    config = run_config(environment, variant, 1, episodes=ENVIRONMENTS[environment])
    one, other = finish(config), finish(config)
    assert one.records == other.records
    assert archive(one.state_dict()) == archive(other.state_dict())


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_another_seed_is_another_run(run_config, environment, variant):
    runs = [finish(run_config(environment, variant, seed, episodes=3)) for seed in (0, 1)]
    networks = [*runs[0].ppo.learners, "environment"]
    for name in networks:
        states = [
            archive(
                run.ppo.learners[name].state_dict()
                if name != "environment"
                else {"state": run.environment.generator.bit_generator.state}
            )
            for run in runs
        ]
        assert states[0] != states[1], name
    if environment != "Acrobot-v1":  # whose first episodes all end at the time limit
        assert runs[0].records != runs[1].records


def test_global_generators_are_left_alone(run_config):
    """Nothing depends on them, and nothing that uses them is disturbed."""
    config = run_config("CartPole-v1", "mace_full", 0, episodes=4)
    expected = finish(config).records
    np.random.seed(123)  # noqa: NPY002
    torch.manual_seed(123)
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    assert finish(config).records == expected
    assert (np.random.get_state()[1] == before).all()  # noqa: NPY002


# --- Every kind of environment ------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("environment", "changes"),
    [
        ("FrozenLake-v1", {}),  # Discrete observations
        ("Pendulum-v1", {}),  # Box actions
        ("Pendulum-v1", {"ppo": {"rollout_steps": 500, "normalise_observations": True}}),
        ("MountainCar-v0", {"meta": {"max_sequence": None}}),
        ("Taxi-v4", {}),
    ],
)
def test_any_environment_trains(run_config, environment, variant, changes):
    trainer = finish(run_config(environment, variant, 0, **{"episodes": 6} | changes))
    records = trainer.records
    assert [record.episode for record in records] == list(range(1, 7))
    assert [r.env_steps for r in records] == np.cumsum([r.length for r in records]).tolist()
    limit = trainer.environment.max_steps
    assert all(r.terminated or r.length == limit for r in records)
    assert all(0 <= r.intrinsic_return <= r.length for r in records)
    if variant == "ppo":
        assert all(r.beta == 0 and r.intrinsic_return == 0 for r in records)
    else:
        assert records[0].beta == 0.4 and all(0 < r.beta < 1 for r in records)
        assert records[0].intrinsic_return > 0


class Bonanza(gymnasium.Env):
    """Action 1 pays 1, action 0 nothing; five steps."""

    observation_space, action_space = Box(-1, 1, (2,), np.float32), Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.random(2).astype(np.float32), {}

    def step(self, action):
        state = self.np_random.random(2).astype(np.float32)
        return state, float(action), False, False, {}


@pytest.mark.parametrize("variant", VARIANTS)
def test_it_learns_what_pays(run_config, register, variant):
    name = register("Bonanza-v0", Bonanza, 5)
    settings = {"actor_learning_rate": 0.01, "rollout_steps": 50}
    config = run_config(name, variant, 0, episodes=200, ppo=settings)
    returns = [record.extrinsic_return for record in finish(config).records]
    assert np.mean(returns[:10]) < 3.5 and np.mean(returns[-50:]) > 4.5


# --- β ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_meta_network_learns_and_beta_moves(run_config, monkeypatch):
    trainer = Trainer(run_config("CartPole-v1", "mace_full", 0, episodes=60))
    network, learner = trainer.controller.network, trainer.controller.learner
    initial, norms = network.parameters.copy(), []
    descend = learner.descend
    monkeypatch.setattr(learner, "descend", lambda slope: norms.append(descend(slope)))
    for _ in trainer.run():
        pass
    assert len(norms) == 58  # the first β is given; the effect of the last is never seen
    assert all(0 < norm < np.inf for norm in norms)
    for before, after in zip(
        network.split(initial), network.split(network.parameters), strict=True
    ):
        assert (before != after).any() and np.isfinite(after).all()
    betas = [record.beta for record in trainer.records]
    assert betas[0] == 0.4 and len(set(betas)) == 60 and np.ptp(betas) > 0.02
    assert all(0 < beta < 1 for beta in betas)
    numbers = [value for record in trainer.records for value in vars(record).values()]
    assert np.isfinite(numbers).all()


def test_fixed_beta_decays_by_episode_however_long_the_rollout(run_config):
    changes = {"episodes": 10, "ppo": {"rollout_steps": 60}}
    trainer = finish(run_config("CartPole-v1", "mace_fixed", 0, **changes))
    betas = [record.beta for record in trainer.records]
    np.testing.assert_allclose(betas, [0.4 * 0.999**n for n in range(10)])


# --- One round ----------------------------------------------------------------------------------


def test_rollout_ends_with_the_episode_that_fills_it(run_config):
    config = run_config("CartPole-v1", "ppo", 0, episodes=30, ppo={"rollout_steps": 70})
    trainer, rounds = Trainer(config), []
    for records in trainer.run():
        rounds.append([record.length for record in records])
    assert sum(map(len, rounds)) == 30
    for lengths in rounds[:-1]:
        assert sum(lengths) >= 70 > sum(lengths[:-1])
    assert [record.length for record in trainer.records] == sum(rounds, [])  # noqa: RUF017


def test_rollout_that_is_exactly_full_ends(run_config, register):
    """Five steps an episode, ten a rollout: two episodes, not three."""
    name = register("Bonanza-v0", Bonanza, 5)
    config = run_config(name, "ppo", 0, episodes=7, ppo={"rollout_steps": 10})
    assert [len(records) for records in Trainer(config).run()] == [2, 2, 2, 1]


def test_each_reward_has_its_own_returns_and_critic(run_config, twin):
    """With λ = 1 and an episode that terminates: the discounted sums, minus each critic's value."""
    trainer = Trainer(run_config("CartPole-v1", "mace_full", 0, episodes=3))
    for _ in range(3):
        critics = {kind: twin(critic) for kind, critic in trainer.ppo.critics.items()}
        (item,) = rollout = trainer.collect()
        assert item.episode.terminated
        for kind, rewards in (("extrinsic", item.episode.rewards), ("intrinsic", item.bonus)):
            length = len(rewards)
            returns = [
                sum(0.99 ** (i - t) * rewards[i] for i in range(t, length)) for t in range(length)
            ]
            values = critics[kind](item.observations[:-1])[:, 0].detach().numpy()
            found = getattr(item, f"{kind}_returns"), getattr(item, f"{kind}_advantages")
            np.testing.assert_allclose(found[0], returns, rtol=1e-5)
            np.testing.assert_allclose(found[1], returns - values, rtol=1e-4, atol=1e-5)
        trainer.improve(rollout)
    assert np.ptp(item.bonus) > 0


@pytest.mark.parametrize("variant", VARIANTS)
def test_update_learns_from_a_e_plus_beta_a_i(run_config, monkeypatch, variant):
    """The batch that PPO gets, from the episodes by hand, with the episodes' own β."""
    config = run_config(
        "CartPole-v1", variant, 0, episodes=9, ppo={"rollout_steps": 60, "gae_lambda": 0.9}
    )
    trainer, batches = Trainer(config), []
    update, improve = trainer.ppo.update, trainer.improve
    monkeypatch.setattr(trainer.ppo, "update", lambda b: (batches.append(b), update(b))[1])
    rollouts = []
    monkeypatch.setattr(trainer, "improve", lambda r: (rollouts.append(r), improve(r))[1])
    for _ in trainer.run():
        pass
    assert max(map(len, rollouts)) > 1
    for batch, rollout in zip(batches, rollouts, strict=True):
        total, extrinsic, intrinsic = [], [], []
        for item in rollout:
            total += [
                a + item.beta * b
                for a, b in zip(item.extrinsic_advantages, item.intrinsic_advantages, strict=True)
            ]
            extrinsic += [*item.extrinsic_returns]
            intrinsic += [*item.intrinsic_returns]
        expected = (np.array(total) - np.mean(total)) / np.std(total)
        np.testing.assert_allclose(batch.advantages, expected, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(batch.returns["extrinsic"], extrinsic, rtol=1e-6)
        played = [item.episode for item in rollout]
        assert (batch.actions == [a for one in played for a in one.actions]).all()
        assert (batch.observations == [o for one in played for o in one.observations[:-1]]).all()
        assert (batch.log_probs == [p for one in played for p in one.log_probs]).all()
        if variant == "ppo":
            assert list(batch.returns) == ["extrinsic"]
        else:
            np.testing.assert_allclose(batch.returns["intrinsic"], intrinsic, rtol=1e-6)
            assert np.ptp(intrinsic) > 0


def test_records_are_of_the_environment_s_own_reward(run_config, monkeypatch):
    """The return is logged before any shaping, whatever β and the bonus are."""
    trainer, rollouts = Trainer(run_config("Pendulum-v1", "mace_full", 0, episodes=3)), []
    improve = trainer.improve
    monkeypatch.setattr(trainer, "improve", lambda r: (rollouts.append(r), improve(r))[1])
    for _ in trainer.run():
        pass
    for (item,), record in zip(rollouts, trainer.records, strict=True):
        assert record.extrinsic_return == float(np.sum(item.episode.rewards))
        assert record.intrinsic_return == float(np.sum(item.bonus))
        assert record.length == len(item.episode.rewards) == 200


def test_normaliser_of_the_update_is_that_of_acting(run_config):
    """New states change the normaliser after the update, never between acting and learning."""
    config = run_config(
        "Pendulum-v1", "mace_full", 0, episodes=4, ppo={"normalise_observations": True}
    )
    trainer, improve, seen = Trainer(config), Trainer.improve, []

    def improve_watched(rollout) -> None:
        (item,) = rollout
        outputs = trainer.ppo.actor.forward(item.observations[:-1])[-1]
        log_probs = trainer.ppo.actor.log_probs(outputs, item.episode.actions)
        np.testing.assert_allclose(log_probs, item.episode.log_probs, atol=1e-4)
        seen.extend(item.episode.observations[:-1].astype(np.float64))
        improve(trainer, rollout)
        np.testing.assert_allclose(trainer.ppo.standardiser.mean, np.mean(seen, axis=0))
        np.testing.assert_allclose(trainer.ppo.standardiser.std, np.std(seen, axis=0))

    trainer.improve = improve_watched
    for _ in trainer.run():
        pass
    assert len(seen) == 800


# --- Numbers that go bad ------------------------------------------------------------------------


class Faulty(gymnasium.Env):
    """Gives `value` as reward or observation at step 3 of the fourth episode."""

    observation_space, action_space = Box(-1, 1, (2,), np.float32), Discrete(2)

    def __init__(self, where: str, value: float) -> None:
        self.where, self.value, self.resets = where, value, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets += 1
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        # The first reset is the throw-away one of every environment.
        bad = self.value if (self.resets, self.steps) == (5, 3) else 0.0
        reward = 1.0 + bad if self.where == "reward" else 1.0
        state = self.np_random.random(2) + (bad if self.where == "observation" else 0.0)
        return state.astype(np.float32), reward, False, False, {}


@pytest.mark.parametrize("where", ["reward", "observation"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_bad_numbers_stop_the_run_and_say_where(run_config, register, where, value):
    name = register("Faulty-v0", Faulty, 5, where=where, value=value)
    trainer = Trainer(run_config(name, "mace_full", 7, episodes=9))
    finished = []
    with pytest.raises(NonFiniteError) as caught:
        for records in trainer.run():
            finished += records
    message = f"Faulty-v0 mace_full seed 7, episode 4: the {where} is {value} after step 3"
    assert str(caught.value) == message
    assert len(finished) == 3


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("place", [0, -1])  # before and after every tanh
@pytest.mark.parametrize("network", ["actor", "extrinsic", "intrinsic"])
def test_bad_weights_stop_the_run_and_say_whose(run_config, network, place, value):
    trainer = Trainer(run_config("CartPole-v1", "mace_fixed", 0, episodes=9))
    update = trainer.ppo.update

    def overflowing(batch):
        if len(trainer.records) == 3:
            trainer.ppo.learners[network].parameters[place] = value
        return update(batch)

    trainer.ppo.update = overflowing
    with pytest.raises(
        NonFiniteError, match=f"seed 0, the update after episode 3: .*{network}.* is (nan|inf)"
    ):
        for _ in trainer.run():
            pass


def test_bad_first_observation_stops_the_run(run_config, register):
    class Lost(Faulty):
        def reset(self, *, seed=None, options=None):
            state, info = super().reset(seed=seed)
            return state + (np.nan if self.resets == 3 else 0), info

    name = register("Lost-v0", Lost, 5, where="nowhere", value=0.0)
    trainer = Trainer(run_config(name, "mace_full", 0, episodes=9))
    with pytest.raises(NonFiniteError, match="episode 2: the observation is nan after the reset"):
        for _ in trainer.run():
            pass


@pytest.mark.parametrize("place", [0, -1])
def test_bad_density_stops_the_run(run_config, place):
    trainer = Trainer(run_config("CartPole-v1", "mace_full", 0, episodes=9))
    trainer.curiosity.novelty.density.parameters[place] = np.nan
    with pytest.raises(NonFiniteError, match="seed 0, episode 1: a log-density is nan"):
        for _ in trainer.run():
            pass


@pytest.mark.parametrize("place", [0, -1])
def test_bad_beta_stops_the_run(run_config, place):
    trainer = Trainer(run_config("CartPole-v1", "mace_full", 0, episodes=9))
    trainer.controller.network.parameters[place] = np.nan
    with pytest.raises(NonFiniteError, match=r"CartPole-v1 mace_full seed 0, episode 2: β is nan"):
        for _ in trainer.run():
            pass


# --- State --------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", ["CartPole-v1", "FrozenLake-v1", "HopperBulletEnv-v0"])
def test_state_holds_all_that_the_rest_depends_on(run_config, environment, variant):
    """Continued by a new trainer from a copy of the state, with several episodes a rollout."""
    settings = ROLLOUTS["several"] | {"rollout_steps": 40}
    config = run_config(environment, variant, 2, episodes=16, ppo=settings)
    whole = Trainer(config)
    rounds = whole.run()
    for _ in range(2):
        next(rounds)
    state = copy.deepcopy(whole.state_dict())
    for _ in rounds:
        pass
    rest = Trainer(config)
    rest.load_state_dict(state)
    assert 0 < len(rest.records) < 16
    for _ in rest.run():
        pass
    assert rest.records == whole.records
    assert archive(rest.state_dict()) == archive(whole.state_dict())
    assert archive(rest.agent()) == archive(whole.agent())


def test_agent_acts_as_the_trainer_does(run_config, twin):
    """The weights and the normaliser in agent.pt are all that is needed to act."""
    trainer = finish(
        run_config("Pendulum-v1", "mace_full", 0, episodes=3, ppo={"normalise_observations": True})
    )
    agent = trainer.agent()
    assert set(agent["networks"]) == {"actor", "extrinsic", "intrinsic"}
    actor, normaliser = agent["networks"]["actor"], agent["standardiser"]
    assert actor["sizes"] == [3, 64, 64, 1]
    layers, start = [], 0
    flat = actor["parameters"].double()
    observation = torch.tensor([0.5, -0.5, 2.0]).double()
    std = (normaliser["sum_of_squares"] / normaliser["count"]).sqrt()
    activation = ((observation - normaliser["mean"]) / std).clamp(-10, 10)
    for inputs, outputs in zip(actor["sizes"], actor["sizes"][1:], strict=False):
        weights = flat[start : start + inputs * outputs].reshape(inputs, outputs)
        start += inputs * outputs
        layers.append((weights, flat[start : start + outputs]))
        start += outputs
    for number, (weights, biases) in enumerate(layers):
        activation = activation @ weights + biases
        activation = activation.tanh() if number < len(layers) - 1 else activation
    from mace_rl.compiled import act_box

    found, _ = act_box(
        observation.numpy().astype(np.float32), *trainer.ppo.acting_policy(), np.zeros(1)
    )
    np.testing.assert_allclose(found, activation, rtol=1e-4, atol=1e-5)
    assert len(flat) == start + 1  # the log standard deviation
