"""The trainer: β = 0 is PPO, the same seed is the same run, and every environment trains."""

import copy

import numpy as np
import pytest
import torch
from shared import ENGINES, LAYER_NORM, VARIANTS, Bonanza, finish

from mace_rl.beta.meta import MetaAdaptation
from mace_rl.config.reading import merge
from mace_rl.finite import NonFiniteError
from mace_rl.results.records import EpisodeRecord
from mace_rl.runs.agent import Agent
from mace_rl.runs.checkpoint import archive
from mace_rl.train import Trainer

ENVIRONMENTS = {"CartPole-v1": 25, "Acrobot-v1": 12, "HopperBulletEnv-v0": 20}  # episodes
SEVERAL = {"rollout_steps": 100, "minibatch_size": 32, "gae_lambda": 0.95}
AS_THEY_ARE = dict.fromkeys(("normalise_observations", "scale_rewards", "scale_advantages"), False)
# One update per episode as in the paper's runs; several episodes with minibatches; in torch.
SETTINGS = {
    "an episode": {},
    "several": {"ppo": SEVERAL},
    "torch": {"engine": "torch", "ppo": SEVERAL},
    "a network of one's own": {"ppo": {"network": LAYER_NORM}},
}


def without_bonus(records: list[EpisodeRecord]) -> list[dict]:
    """All that a record says of the environment's episode."""
    return [{**vars(record), "intrinsic_return": None} for record in records]


def learned(trainer: Trainer) -> list[bytes]:
    """Weights and moments of the networks that plain PPO has, and its normaliser."""
    optimisers = [trainer.ppo.optimisers[name] for name in ("actor", "extrinsic")]
    arrays = [part for adam in optimisers for part in (adam.parameters, adam.mean, adam.square)]
    return [array.tobytes() for array in (*arrays, trainer.ppo.normaliser.mean)]


# --- β = 0 is PPO -------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_beta_0_equals_ppo_to_the_bit(run_config, monkeypatch, environment, settings):
    """Though memory, novelty, the intrinsic critic and the meta network are all at work."""
    changes = {"episodes": ENVIRONMENTS[environment], "meta": {"horizon": 1}} | SETTINGS[settings]
    plain = finish(run_config(environment, "ppo", 3, **changes))
    zero = {"kind": "exponential", "initial": 0.0, "decay": 0.9, "floor": 0.0}
    fixed = finish(run_config(environment, "mace_fixed", 3, beta=zero, **changes))
    monkeypatch.setattr(MetaAdaptation, "beta", property(lambda self: 0.0))
    full = finish(run_config(environment, "mace_full", 3, **changes))
    for trainer in (fixed, full):
        assert without_bonus(trainer.records) == without_bonus(plain.records)
        assert learned(trainer) == learned(plain)
        assert trainer.noise.bit_generator.state == plain.noise.bit_generator.state
        # The parts that must not matter did work.
        assert sum(record.intrinsic_return for record in trainer.records) > 10
        assert len(trainer.curiosity.memory) > 0
    untrained = Trainer(full.config).controller.network
    assert (full.controller.network.parameters != untrained.parameters).any()


def test_beta_above_0_changes_what_is_learned(run_config):
    """Else the test above would pass for a bonus that is lost on the way."""
    plain = finish(run_config("CartPole-v1", "ppo", 3, episodes=3))
    fixed = finish(run_config("CartPole-v1", "mace_fixed", 3, episodes=3))
    assert learned(plain)[0] != learned(fixed)[0]


# --- The same seed is the same run --------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("settings", ["an episode", "torch"])
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_training_twice_gives_the_same_bits(run_config, environment, variant, settings):
    changes = {"episodes": ENVIRONMENTS[environment]} | SETTINGS[settings]
    config = run_config(environment, variant, 1, **changes)
    one, other = finish(config), finish(config)
    assert one.records == other.records
    assert archive(one.state_dict()) == archive(other.state_dict())


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_another_seed_is_another_run(run_config, environment, variant):
    runs = [finish(run_config(environment, variant, seed, episodes=3)) for seed in (0, 1)]
    for name in runs[0].ppo.optimisers:
        states = [archive(run.ppo.optimisers[name].state_dict()) for run in runs]
        assert states[0] != states[1], name
    states = [run.environment.generator.bit_generator.state for run in runs]
    assert states[0] != states[1]
    if environment != "Acrobot-v1":  # whose first episodes all end at the time limit
        assert runs[0].records != runs[1].records


@pytest.mark.parametrize("settings", SETTINGS)
def test_global_generators_are_left_alone(run_config, settings):
    """Nothing depends on them, and nothing that uses them is disturbed."""
    config = run_config("CartPole-v1", "mace_full", 0, **{"episodes": 4} | SETTINGS[settings])
    expected = finish(config).records
    np.random.seed(123)  # noqa: NPY002
    torch.manual_seed(123)
    before = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    assert finish(config).records == expected
    assert (np.random.get_state()[1] == before[0]).all()  # noqa: NPY002
    assert (torch.get_rng_state() == before[1]).all()


# --- Both engines -------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", [*ENVIRONMENTS, "FrozenLake-v1", "Pendulum-v1"])
def test_both_engines_begin_alike(run_config, environment, variant):
    """The first rollout, and the weights after its update; later rounding may change an action."""
    first, weights = [], []
    for engine in ENGINES:
        changes = {"episodes": 4, "engine": engine, "ppo": {"rollout_steps": 40}}
        trainer = Trainer(run_config(environment, variant, 0, **changes))
        rounds = trainer.run()
        first.append(next(rounds))
        weights.append(copy.deepcopy(Agent(trainer.ppo).state_dict()))
        for _ in rounds:
            pass
        assert len(trainer.records) == 4
    for one, other in zip(*first, strict=True):
        assert vars(one) == pytest.approx(vars(other), rel=1e-3)
        assert one.length == other.length
    for name, tensor in weights[0].items():
        torch.testing.assert_close(tensor, weights[1][name], rtol=1e-3, atol=1e-5)


# --- Every kind of environment ------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("environment", "changes"),
    [
        ("FrozenLake-v1", {}),  # Discrete observations
        ("Pendulum-v1", {}),  # Box actions
        ("Pendulum-v1", {"ppo": {"rollout_steps": 500} | AS_THEY_ARE}),
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


@pytest.mark.parametrize("network", [{"kind": "mlp"}, LAYER_NORM], ids=["mlp", "LayerNorm"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_it_learns_what_pays(run_config, register, variant, network):
    name = register("Bonanza-v0", Bonanza, 5)
    settings = {"actor_learning_rate": 0.01, "rollout_steps": 50, "network": network}
    settings["centre_advantages"] = True  # its states do not tell how many steps are left
    config = run_config(name, variant, 0, episodes=200, ppo=settings)
    returns = [record.extrinsic_return for record in finish(config).records]
    assert np.mean(returns[:10]) < 3.5 and np.mean(returns[-50:]) > 4.5


# --- β ------------------------------------------------------------------------------------------


def test_meta_network_learns_and_beta_moves(run_config, monkeypatch):
    trainer = Trainer(run_config("CartPole-v1", "mace_full", 0, episodes=60))
    network, adam = trainer.controller.network, trainer.controller.optimiser
    initial, norms = network.parameters.copy(), []
    step = adam.step
    monkeypatch.setattr(adam, "step", lambda gradient: norms.append(step(gradient)))
    finish(trainer)
    # The first β is given, and each is judged by the 10 updates that follow: those of 2 to 50.
    assert len(norms) == 49
    assert all(0 < norm < np.inf for norm in norms)
    for before, after in zip(*map(network.split, (initial, network.parameters)), strict=True):
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


# --- Numbers that go bad ------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["reward", "observation", "first observation"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_bad_numbers_stop_the_run_and_say_where(run_config, register, where, value):
    name = register("Bonanza-v0", Bonanza, 5, where=where, value=value)
    trainer = Trainer(run_config(name, "mace_full", 7, episodes=9))
    finished = []
    with pytest.raises(NonFiniteError) as caught:
        for records in trainer.run():
            finished += records
    place = "the reset" if "first" in where else "step 3"
    what = where.removeprefix("first ")
    message = f"Bonanza-v0 mace_full seed 7, episode 4: the {what} is {value} after {place}"
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
            trainer.ppo.optimisers[network].parameters[place] = value
        return update(batch)

    trainer.ppo.update = overflowing
    message = f"seed 0, the update after episode 3: .*{network}.* is (nan|inf)"
    with pytest.raises(NonFiniteError, match=message):
        finish(trainer)


@pytest.mark.parametrize("place", [0, -1])
@pytest.mark.parametrize(
    ("part", "message"),
    [("density", "episode 1: a log-density is nan"), ("meta", "episode 2: β is nan")],
)
def test_other_bad_weights_stop_the_run(run_config, part, message, place):
    novelty = {"write_every": 1, "neighbours": [1]}  # enough states in the first episode
    trainer = Trainer(run_config("CartPole-v1", "mace_full", 0, episodes=9, novelty=novelty))
    owner = trainer.curiosity.novelty.density if part == "density" else trainer.controller
    owner.network.parameters[place] = np.nan
    with pytest.raises(NonFiniteError, match=f"CartPole-v1 mace_full seed 0, {message}"):
        finish(trainer)


# --- State --------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("environment", "settings"),
    [
        ("CartPole-v1", "several"),
        ("FrozenLake-v1", "several"),
        ("HopperBulletEnv-v0", "several"),
        ("CartPole-v1", "torch"),
        ("FrozenLake-v1", "torch"),
        ("CartPole-v1", "a network of one's own"),
        ("Pendulum-v1", "a network of one's own"),
    ],
)
def test_state_holds_all_that_the_rest_depends_on(run_config, environment, variant, settings):
    """Continued by a new trainer from a copy of the state, with several episodes a rollout."""
    changes = merge(SETTINGS[settings], {"episodes": 16, "ppo": {"rollout_steps": 40}})
    config = run_config(environment, variant, 2, **changes)
    whole = Trainer(config)
    rounds = whole.run()
    for _ in range(2):
        next(rounds)
    state = copy.deepcopy(whole.state_dict())
    for _ in rounds:
        pass
    rest = Trainer(config)
    rest.load_state_dict(state)
    assert 0 < len(rest.records) < 16 and len(rest.diagnostics) == 2
    finish(rest)
    assert rest.records == whole.records
    for one, other in zip(rest.diagnostics, whole.diagnostics, strict=True):
        np.testing.assert_equal(vars(one), vars(other))
    assert archive(rest.state_dict()) == archive(whole.state_dict())
    assert archive(Agent(rest.ppo).state_dict()) == archive(Agent(whole.ppo).state_dict())
