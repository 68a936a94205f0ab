"""The trainer: what a round plays, learns and notes; β = 0 is PPO; every environment trains."""

import io
import math

import numpy as np
import pytest
import torch
from shared import LAYER_NORM, NETWORKS, ROOT, SOON, VARIANTS, Bonanza, Twin, finish, pretrained
from shared import learned as by_evidence

from extras.pretrained.rule import Pretrained
from mace_rl.agent.compiled_learner import CompiledLearner
from mace_rl.beta.meta import MetaAdaptation
from mace_rl.config.reading import merge
from mace_rl.runs.agent import Agent
from mace_rl.runs.checkpoint import archive
from mace_rl.training.experience import Experience
from mace_rl.training.records import EpisodeRecord
from mace_rl.training.trainer import Trainer
from mace_study.config.study import read_study

SEVERAL = {"rollout_steps": 100, "minibatch_size": 32, "gae_lambda": 0.95}
AS_THEY_ARE = dict.fromkeys(("normalise_observations", "scale_rewards", "scale_advantages"), False)
# One update per episode as in the paper's runs; several episodes with minibatches; in torch.
SETTINGS = {
    "an episode": {},
    "several": {"ppo": SEVERAL},
    "torch": {"engine": "torch", "ppo": SEVERAL},
    "a network of one's own": {"engine": "torch", "ppo": {"network": LAYER_NORM}},
}
OBJECTIVES = ("score", "progress", "return", "centred", "words", "credit_network")  # of β


def rollouts_of(trainer: Trainer, monkeypatch) -> list[list]:
    rollouts, update = [], trainer.ppo_update
    monkeypatch.setattr(trainer, "ppo_update", lambda r: (rollouts.append(r), update(r))[1])
    return rollouts


def parts(item: Experience, name: str) -> tuple[np.ndarray, np.ndarray]:
    return getattr(item.extrinsic, name), getattr(item.intrinsic, name)


def test_rollout_ends_with_the_episode_that_fills_it(run_config, register):
    config = run_config("CartPole-v1", "mace_fixed", 0, episodes=30, ppo={"rollout_steps": 70})
    rounds = list(Trainer(config).run())
    records = [record for each in rounds for record in each]
    assert [record.episode for record in records] == list(range(1, 31))
    for each in rounds[:-1]:
        assert sum(record.length for record in each) >= 70 > sum(r.length for r in each[:-1])
    # β decays by episode, however long the rollout.
    betas = [record.beta for record in records]
    np.testing.assert_allclose(betas, 0.4 * 0.999 ** np.arange(30), rtol=5e-6)
    # Five steps an episode, ten a rollout: two episodes, not three.
    name = register("Bonanza-v0", Bonanza, 5)
    config = run_config(name, "ppo", 0, episodes=7, ppo={"rollout_steps": 10})
    assert [len(records) for records in Trainer(config).run()] == [2, 2, 2, 1]


@pytest.mark.parametrize("scaled", [True, False])
def test_each_reward_has_its_own_returns_and_critic(run_config, scaled):
    """With λ = 1 and an episode that terminates: the discounted sums, minus each critic's value.

    Over the reward's scale, but as they were paid in memory and in the records.
    """
    settings = {"gae_lambda": 1.0, "scale_rewards": scaled}
    changes = {"episodes": 3, "ppo": settings, "memory": {"write_every": 1}}
    trainer, remembered = Trainer(run_config("CartPole-v1", "mace_full", 0, **changes)), []
    for _ in range(3):
        critics = {kind: Twin(critic) for kind, critic in trainer.ppo.critics.items()}
        (item,) = rollout = trainer.collect()
        assert item.episode.terminated
        for kind, rewards in (
            ("intrinsic", item.bonus.reward),
            ("extrinsic", item.episode.rewards),
        ):
            assert getattr(trainer.records[-1], f"{kind}_return") == float(f"{np.sum(rewards):.6g}")
            ahead = np.triu(0.99 ** (np.arange(len(rewards)) - np.arange(len(rewards))[:, None]))
            scale = trainer.ppo.reward_scales[kind].value if scaled else 1.0
            assert (abs(scale - 1) > 0.1) == scaled
            values = critics[kind](item.observations)[:, 0].detach().numpy()
            found = getattr(item, kind).returns, getattr(item, kind).advantages
            returns = ahead @ rewards
            np.testing.assert_allclose(found[0], returns / scale, rtol=1e-5)
            np.testing.assert_allclose(found[1], returns / scale - values, rtol=1e-4, atol=1e-5)
        remembered += returns.tolist()
        trainer.ppo_update(rollout)
    memory = trainer.curiosity.memory
    np.testing.assert_allclose(memory.values[: len(memory), -1], remembered, rtol=1e-5)
    assert np.ptp(item.bonus.reward) > 0


@pytest.mark.parametrize(
    ("variant", "scaled", "centred"),
    [("ppo", True, False), ("mace_fixed", False, True), ("mace_full", True, True)],
)
def test_update_learns_from_a_e_plus_beta_a_i(run_config, monkeypatch, variant, scaled, centred):
    """The batch that PPO gets, from the episodes by hand, with the episodes' own β.

    Each part over its root mean square in all episodes so far, and the sum normalised.
    """
    settings = {"rollout_steps": 60, "gae_lambda": 0.9, "scale_advantages": scaled}
    settings["centre_advantages"] = centred
    trainer = Trainer(run_config("CartPole-v1", variant, 0, episodes=9, ppo=settings))
    batches, update, rollouts = [], trainer.ppo.update, rollouts_of(trainer, monkeypatch)
    monkeypatch.setattr(trainer.ppo, "update", lambda *b: (batches.append(b), update(*b))[1])
    finish(trainer)
    assert max(map(len, rollouts)) > 1
    seen: tuple[list, list] = [], []
    for (batch, targets), rollout in zip(batches, rollouts, strict=True):
        total = []
        for item in rollout:
            scales = []
            for advantages, before in zip(parts(item, "advantages"), seen, strict=True):
                before += advantages.tolist()
                scales.append(math.sqrt(np.mean(np.square(before))) if scaled else 1.0)
            extrinsic, intrinsic = parts(item, "advantages")
            total += (extrinsic / scales[0]).tolist()
            if variant != "ppo":
                total[-len(item.episode) :] += item.beta * intrinsic / scales[1]
        deviations = np.array(total) - (np.mean(total) if centred else 0)
        expected = deviations / math.sqrt(np.mean(np.square(deviations)))
        np.testing.assert_allclose(batch.advantages, expected, rtol=1e-4, atol=1e-5)
        played = [item.episode for item in rollout]
        assert (batch.actions == [a for one in played for a in one.actions]).all()
        assert (batch.observations == [o for one in rollout for o in one.observations]).all()
        assert (batch.log_probs == [p for one in played for p in one.log_probs]).all()
        kinds = ["extrinsic"] if variant == "ppo" else ["extrinsic", "intrinsic"]
        assert list(targets) == kinds
        for place, kind in enumerate(kinds):
            returns = [value for item in rollout for value in parts(item, "returns")[place]]
            np.testing.assert_allclose(targets[kind], returns, rtol=1e-6)
            assert np.ptp(returns) > 0


def test_normaliser_of_the_update_is_that_of_acting(run_config):
    """New states change the normaliser after the update, never between acting and learning."""
    changes = {"episodes": 4, "ppo": {"normalise_observations": True}}
    trainer = Trainer(run_config("Pendulum-v1", "mace_full", 0, **changes))
    ppo_update, seen = Trainer.ppo_update, []

    def watched_update(rollout):
        (item,) = rollout
        outputs = trainer.ppo.policy.network.outputs(item.observations)
        log_probs = trainer.ppo.policy.log_probs(outputs, item.episode.actions)
        np.testing.assert_allclose(log_probs, item.episode.log_probs, atol=1e-4)
        seen.extend(item.episode.observations[:-1].astype(np.float64))
        update = ppo_update(trainer, rollout)
        np.testing.assert_allclose(trainer.ppo.normaliser.mean, np.mean(seen, axis=0))
        np.testing.assert_allclose(trainer.ppo.normaliser.std, np.std(seen, axis=0))
        return update

    trainer.ppo_update = watched_update
    finish(trainer)
    assert len(seen) == 800


@pytest.mark.parametrize(
    ("environment", "variant"),
    [
        ("Pendulum-v1", "mace_evidence"),
        *(("CartPole-v1", variant) for variant in (*VARIANTS, "mace_evidence")),
    ],
)
def test_diagnostics_say_what_an_update_did(run_config, monkeypatch, environment, variant):
    """The learner's own numbers, which test_ppo.py checks, and the others another way."""
    changes = {"ppo": {"rollout_steps": 400 if environment == "Pendulum-v1" else 60}}
    if variant == "mace_evidence":
        changes["beta"] = by_evidence(horizon=1)
    trainer = Trainer(run_config(environment, variant, 1, episodes=9, **changes))
    rollouts, told, critics = rollouts_of(trainer, monkeypatch), [], []
    update = trainer.ppo.update

    def noted(batch, returns):
        critics.append({kind: Twin(one) for kind, one in trainer.ppo.critics.items()})
        told.append(update(batch, returns))
        return told[-1]

    monkeypatch.setattr(trainer.ppo, "update", noted)
    episodes = [records[-1] for records in trainer.run()]
    assert len(trainer.diagnostics) == len(rollouts) == len(episodes) > 2
    for number, (row, rollout) in enumerate(zip(trainer.diagnostics, rollouts, strict=True)):
        observations = np.concatenate([item.observations for item in rollout])
        expected = {
            "update": number + 1,
            "episode": episodes[number].episode,
            "env_steps": episodes[number].env_steps,
            "beta": np.mean([item.beta for item in rollout]),
        }
        for name in ("approximate_kl", "clip_fraction", "entropy"):
            expected[name] = getattr(told[number], name)
        for name, norm in told[number].gradient_norms.items():
            expected[f"gradient_norm_{name}"] = norm
        own, weighted = [], []
        for item in rollout:
            extrinsic, intrinsic = parts(item, "advantages")
            own.extend(extrinsic / item.extrinsic.scale)
            weighted.extend(item.beta * intrinsic / item.intrinsic.scale)
        squares = np.square(own).sum(), np.square(weighted).sum()
        expected["bonus_share"] = squares[1] / sum(squares)
        for kind, critic in critics[number].items():
            returns = np.concatenate([getattr(item, kind).returns for item in rollout])
            errors = returns - critic(observations)[:, 0].detach().numpy()
            expected[f"explained_variance_{kind}"] = 1 - np.var(errors) / np.var(returns)
        if variant != "ppo":
            for part in ("novelty", "relevance", "similarity"):
                steps = [value for item in rollout for value in getattr(item.bonus, part)]
                expected[part] = sum(steps) / len(steps)
        if variant == "mace_evidence" and number > 0:  # test_credit.py has its value
            expected["beta_credit"] = row.beta_credit
        found = {key: value for key, value in vars(row).items() if not math.isnan(value)}
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert row.approximate_kl > 0 and (row.bonus_share > 0) == (variant != "ppo")


def without_bonus(records: list[EpisodeRecord]) -> list[dict]:
    return [{**vars(record), "intrinsic_return": None} for record in records]


def learned(trainer: Trainer) -> list[bytes]:
    """Weights and moments of the networks that plain PPO has, and its normaliser."""
    learner, names = trainer.ppo.learner, ("actor", "extrinsic")
    arrays = [learner.parameters[name] for name in names]
    if isinstance(learner, CompiledLearner):
        adams = [learner.optimisers[name] for name in names]
        arrays += [part for adam in adams for part in (adam.mean, adam.square)]
    return [array.tobytes() for array in (*arrays, trainer.ppo.normaliser.mean)]


@pytest.mark.parametrize(
    ("environment", "settings"),
    [
        *(("CartPole-v1", settings) for settings in SETTINGS),
        pytest.param("Acrobot-v1", "an episode", marks=pytest.mark.slow),
        pytest.param("HopperBulletEnv-v0", "an episode", marks=pytest.mark.slow),
    ],
)
def test_beta_0_equals_ppo_to_the_bit(run_config, monkeypatch, environment, settings):
    changes = {"episodes": 12, "novelty": SOON} | SETTINGS[settings]
    plain = finish(run_config(environment, "ppo", 3, **changes))
    zero = {"kind": "exponential", "initial": 0.0, "decay": 0.9, "floor": 0.0}
    fixed = finish(run_config(environment, "mace_fixed", 3, beta=zero, **changes))
    for controller in (MetaAdaptation, Pretrained):
        asked = controller.next_beta
        monkeypatch.setattr(controller, "next_beta", lambda self, asked=asked: 0.0 * asked(self))
    full = finish(run_config(environment, "mace_full", 3, **changes))
    beta = by_evidence(horizon=1)
    evidence = finish(run_config(environment, "mace_evidence", 3, beta=beta, **changes))
    beta = pretrained(horizon=1)
    ours = finish(run_config(environment, "mace_fixed", 3, beta=beta, **changes))
    some = finish(run_config(environment, "mace_fixed", 3, **changes))
    assert learned(some)[0] != learned(plain)[0]  # else a bonus that is lost would pass, too
    for trainer in (fixed, full, evidence, ours):
        assert without_bonus(trainer.records) == without_bonus(plain.records)
        assert learned(trainer) == learned(plain)
        assert trainer.noise.bit_generator.state == plain.noise.bit_generator.state
        # The parts that must not matter did work.
        assert sum(record.intrinsic_return for record in trainer.records) > 10
        assert len(trainer.curiosity.memory) > 0
        assert len(trainer.curiosity.novelty.visited) > 100  # so that all of novelty is estimated
    assert full.controller.objective.episodes == 11
    assert evidence.controller.objective.weight > 0
    assert ours.controller.integrator.squares > 0 and len(ours.controller.lstm.gauge.windows) == 12


def test_another_seed_is_another_run(run_config):
    runs = [finish(run_config("CartPole-v1", "mace_full", seed, episodes=3)) for seed in (0, 1)]
    for name in NETWORKS:
        states = [archive(run.ppo.learner.optimisers[name].state_dict()) for run in runs]
        assert states[0] != states[1], name
    states = [run.environment.generator.bit_generator.state for run in runs]
    assert states[0] != states[1] and runs[0].records != runs[1].records


@pytest.mark.parametrize("settings", ["an episode", "torch", "a network of one's own"])
def test_global_generators_are_left_alone(run_config, settings):
    changes = {"episodes": 4, "novelty": SOON} | SETTINGS[settings]
    config = run_config("CartPole-v1", "mace_full", 0, **changes)
    expected = finish(config).records
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    try:
        assert finish(config).records == expected
        assert torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
    np.random.seed(123)  # noqa: NPY002
    torch.manual_seed(123)
    before = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    assert finish(config).records == expected
    assert (np.random.get_state()[1] == before[0]).all()  # noqa: NPY002
    assert (torch.get_rng_state() == before[1]).all()


@pytest.mark.parametrize(
    ("environment", "variant", "settings"),
    [
        ("CartPole-v1", "mace_full", "several"),
        ("FrozenLake-v1", "mace_fixed", "several"),
        ("HopperBulletEnv-v0", "mace_full", "an episode"),
        ("FrozenLake-v1", "mace_full", "torch"),
        ("CartPole-v1", "mace_evidence", "several"),
        *(("CartPole-v1", f"mace_{objective}", "several") for objective in OBJECTIVES),
        ("CartPole-v1", "pretrained", "several"),
        ("Pendulum-v1", "mace_full", "a network of one's own"),
    ],
)
def test_state_holds_all_that_the_rest_depends_on(run_config, environment, variant, settings):
    """Continued by a new trainer from what a file would hold, with several episodes a rollout."""
    # Some objectives of β learn from the 20th episode on.
    changes = {"episodes": 16 if variant in VARIANTS else 40, "ppo": {"rollout_steps": 25}}
    changes["novelty"] = SOON | {"refresh_every": 60}  # so that some states wait
    # And each credit moves β.
    if variant == "mace_evidence":
        changes["beta"] = by_evidence(horizon=2, chance=0.999, scale=0.1)
    if variant == "pretrained":
        variant = "mace_fixed"
        changes["beta"] = pretrained(horizon=2, credit_threshold=0.0)
    config = run_config(environment, variant, 2, **merge(SETTINGS[settings], changes))
    whole = Trainer(config)
    rounds = whole.run()
    for _ in range(3):
        next(rounds)
    state = archive(whole.state_dict())
    if "beta" in changes:
        judge = getattr(whole.controller, "objective", whole.controller).judge
        assert len(judge.directions) == 2
    for _ in rounds:
        pass
    rest = Trainer(config)
    rest.load_state_dict(torch.load(io.BytesIO(state), weights_only=True))
    assert 0 < len(rest.records) < 16 and len(rest.diagnostics) == 3
    finish(rest)
    assert rest.records == whole.records
    for one, other in zip(rest.diagnostics, whole.diagnostics, strict=True):
        np.testing.assert_equal(vars(one), vars(other))
    assert archive(rest.state_dict()) == archive(whole.state_dict())
    agents = [Agent(run.ppo, run.environment.given_space) for run in (rest, whole)]
    assert archive(agents[0].state_dict()) == archive(agents[1].state_dict())


def test_equal_states_have_equal_bytes():
    """Though in one of them two equal strings, or lists, are one object."""
    texts = ["".join(("PCG", "64")) for _ in range(2)]
    apart, together = {"a": texts, "b": [[1.5], [1.5]]}, {"a": [texts[0]] * 2, "b": [[1.5]] * 2}
    assert archive(apart) == archive(together)


OTHERS = read_study([ROOT / "config.yaml", ROOT / "examples" / "environments.yaml"])


@pytest.mark.parametrize(
    ("environment", "variant", "changes"),
    [
        ("FrozenLake-v1", "ppo", {}),  # Discrete observations
        ("Pendulum-v1", "mace_fixed", {"ppo": {"rollout_steps": 500} | AS_THEY_ARE}),  # Box actions
        ("MountainCar-v0", "mace_full", {}),
        *(
            pytest.param(environment, "mace_full", None, marks=pytest.mark.slow)
            for environment in OTHERS.environments
        ),
    ],
)
def test_any_environment_trains(run_config, environment, variant, changes):
    if changes is None:
        config = OTHERS.run_config(environment, variant, 0, {"max_episode_steps": 200})
    else:
        config = run_config(environment, variant, 0, **{"episodes": 6} | changes)
    trainer = finish(config)
    records = trainer.records
    assert len(records) == config.episodes
    assert [r.env_steps for r in records] == np.cumsum([r.length for r in records]).tolist()
    limit = trainer.environment.max_steps
    assert all(r.terminated or r.length == limit for r in records)
    assert all(0 <= r.intrinsic_return <= r.length for r in records)
    assert np.isfinite([r.extrinsic_return for r in records]).all()
    if variant == "ppo":
        assert all(r.beta == 0 and r.intrinsic_return == 0 for r in records)
    else:
        assert records[0].beta == 0.4 and all(0 < r.beta < 1 for r in records)
        assert records[0].intrinsic_return > 0


@pytest.mark.parametrize(
    ("variant", "engine", "network"),
    [
        *((variant, "compiled", {"kind": "mlp"}) for variant in VARIANTS),
        ("ppo", "torch", LAYER_NORM),
    ],
)
def test_it_learns_what_pays(run_config, register, variant, engine, network):
    name = register("Bonanza-v0", Bonanza, 5)
    settings = {"actor_learning_rate": 0.01, "rollout_steps": 50, "network": network}
    settings["centre_advantages"] = True  # its states do not tell how many steps are left
    config = run_config(name, variant, 0, episodes=200, engine=engine, ppo=settings)
    returns = [record.extrinsic_return for record in finish(config).records]
    assert np.mean(returns[:10]) < 3.5 and np.mean(returns[-50:]) > 4.5
