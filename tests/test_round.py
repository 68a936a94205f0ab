"""One round of training: what is played, what the update learns from it, and what is noted."""

import math

import numpy as np
import pytest
import torch
from shared import VARIANTS, Bonanza, Twin, finish

from mace_rl.experience import Experience
from mace_rl.train import Trainer


def rollouts_of(trainer: Trainer, monkeypatch) -> list[list]:
    """The rollouts that `trainer` will learn from."""
    rollouts, improve = [], trainer.improve
    monkeypatch.setattr(trainer, "improve", lambda r: (rollouts.append(r), improve(r))[1])
    return rollouts


def parts(item: Experience, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The extrinsic and the intrinsic one of an episode."""
    return getattr(item, f"extrinsic_{name}"), getattr(item, f"intrinsic_{name}")


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


@pytest.mark.parametrize("scaled", [True, False])
def test_each_reward_has_its_own_returns_and_critic(run_config, scaled):
    """With λ = 1 and an episode that terminates: the discounted sums, minus each critic's value.

    Over the reward's scale, but as they were paid in memory.
    """
    settings = {"gae_lambda": 1.0, "scale_rewards": scaled}
    changes = {"episodes": 3, "ppo": settings, "memory": {"write_every": 1}}
    trainer, remembered = Trainer(run_config("CartPole-v1", "mace_full", 0, **changes)), []
    for _ in range(3):
        critics = {kind: Twin(critic) for kind, critic in trainer.ppo.critics.items()}
        (item,) = rollout = trainer.collect()
        assert item.episode.terminated
        both = {"extrinsic": item.episode.rewards, "intrinsic": item.bonus.reward}
        for kind, rewards in both.items():
            length = len(rewards)
            returns = np.array(
                [sum(0.99 ** (i - t) * rewards[i] for i in range(t, length)) for t in range(length)]
            )
            remembered += returns.tolist() if kind == "extrinsic" else []
            scale = trainer.ppo.reward_scales[kind].value if scaled else 1.0
            assert (abs(scale - 1) > 0.1) == scaled
            values = critics[kind](item.observations[:-1])[:, 0].detach().numpy()
            found = getattr(item, f"{kind}_returns"), getattr(item, f"{kind}_advantages")
            np.testing.assert_allclose(found[0], returns / scale, rtol=1e-5)
            np.testing.assert_allclose(found[1], returns / scale - values, rtol=1e-4, atol=1e-5)
        trainer.improve(rollout)
    memory = trainer.curiosity.memory
    np.testing.assert_allclose(memory.values[: len(memory), -1], remembered, rtol=1e-5)
    assert np.ptp(item.bonus.reward) > 0


@pytest.mark.parametrize(("scaled", "centred"), [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("variant", VARIANTS)
def test_update_learns_from_a_e_plus_beta_a_i(run_config, monkeypatch, variant, scaled, centred):
    """The batch that PPO gets, from the episodes by hand, with the episodes' own β.

    Each part over its root mean square in all episodes so far, and the sum normalised.
    """
    settings = {"rollout_steps": 60, "gae_lambda": 0.9, "scale_advantages": scaled}
    settings["centre_advantages"] = centred
    trainer = Trainer(run_config("CartPole-v1", variant, 0, episodes=9, ppo=settings))
    batches, update, rollouts = [], trainer.ppo.update, rollouts_of(trainer, monkeypatch)
    monkeypatch.setattr(trainer.ppo, "update", lambda b: (batches.append(b), update(b))[1])
    finish(trainer)
    assert max(map(len, rollouts)) > 1
    seen: tuple[list, list] = [], []
    for batch, rollout in zip(batches, rollouts, strict=True):
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
        assert (batch.observations == [o for one in rollout for o in one.observations[:-1]]).all()
        assert (batch.log_probs == [p for one in played for p in one.log_probs]).all()
        kinds = ["extrinsic"] if variant == "ppo" else ["extrinsic", "intrinsic"]
        assert list(batch.returns) == kinds
        for place, kind in enumerate(kinds):
            returns = [value for item in rollout for value in parts(item, "returns")[place]]
            np.testing.assert_allclose(batch.returns[kind], returns, rtol=1e-6)
            assert np.ptp(returns) > 0


def test_records_are_of_the_environment_s_own_reward(run_config, monkeypatch):
    """The return is logged before any shaping, whatever β and the bonus are."""
    trainer = Trainer(run_config("Pendulum-v1", "mace_full", 0, episodes=3))
    rollouts = rollouts_of(trainer, monkeypatch)
    finish(trainer)
    for (item,), record in zip(rollouts, trainer.records, strict=True):
        assert record.extrinsic_return == float(np.sum(item.episode.rewards))
        assert record.intrinsic_return == float(np.sum(item.bonus.reward))
        assert record.length == len(item.episode.rewards) == 200


def test_normaliser_of_the_update_is_that_of_acting(run_config):
    """New states change the normaliser after the update, never between acting and learning."""
    changes = {"episodes": 4, "ppo": {"normalise_observations": True}}
    trainer = Trainer(run_config("Pendulum-v1", "mace_full", 0, **changes))
    improve, seen = Trainer.improve, []

    def improve_watched(rollout):
        (item,) = rollout
        outputs = trainer.ppo.policy.forward(item.observations[:-1]).outputs
        log_probs = trainer.ppo.policy.log_probs(outputs, item.episode.actions)
        np.testing.assert_allclose(log_probs, item.episode.log_probs, atol=1e-4)
        seen.extend(item.episode.observations[:-1].astype(np.float64))
        update = improve(trainer, rollout)
        np.testing.assert_allclose(trainer.ppo.normaliser.mean, np.mean(seen, axis=0))
        np.testing.assert_allclose(trainer.ppo.normaliser.std, np.std(seen, axis=0))
        return update

    trainer.improve = improve_watched
    finish(trainer)
    assert len(seen) == 800


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1"])
def test_diagnostics_say_what_an_update_did(run_config, monkeypatch, environment, variant):
    """Every number of every row another way: two epochs over whole rollouts of some episodes."""
    settings = {"rollout_steps": 400 if environment == "Pendulum-v1" else 60, "epochs": 2}
    changes = {"ppo": settings | {"minibatch_size": None}, "meta": {"horizon": 1}}
    config = run_config(environment, variant, 1, episodes=9, **changes)
    trainer = Trainer(config)
    rollouts, policies, norms, critics = rollouts_of(trainer, monkeypatch), [], {}, []
    for name, adam in trainer.ppo.optimisers.items():

        def noted(gradient, name=name, step=adam.step) -> float:
            if name == "actor":
                policies.append(Twin(trainer.ppo.policy))
                critics.append({kind: Twin(one) for kind, one in trainer.ppo.critics.items()})
            norms.setdefault(name, []).append(np.linalg.norm(gradient.astype(np.float64)))
            return step(gradient)

        monkeypatch.setattr(adam, "step", noted)
    episodes = [records[-1] for records in trainer.run()]
    assert len(trainer.diagnostics) == len(rollouts) == len(episodes) > 2
    for number, (row, rollout) in enumerate(zip(trainer.diagnostics, rollouts, strict=True)):
        at = 2 * number  # of the update's first step; the last epoch's is the next
        observations = np.concatenate([item.observations[:-1] for item in rollout])
        actions = np.concatenate([item.episode.actions for item in rollout])
        policy = policies[at + 1].policy(observations)
        old = np.concatenate([item.episode.log_probs for item in rollout])
        log_ratio = policy.log_prob(torch.from_numpy(actions)) - torch.from_numpy(old)
        ratio = log_ratio.exp()
        expected = {
            "update": number + 1,
            "episode": episodes[number].episode,
            "env_steps": episodes[number].env_steps,
            "approximate_kl": (ratio - 1 - log_ratio).mean().item(),
            "clip_fraction": ((ratio > 1.2) | (ratio < 0.8)).double().mean().item(),
            "entropy": policy.entropy().mean().item(),
            "beta": np.mean([item.beta for item in rollout]),
        }
        own, weighted = [], []
        for item in rollout:
            extrinsic, intrinsic = parts(item, "advantages")
            own.extend(extrinsic / item.extrinsic_scale)
            weighted.extend(item.beta * intrinsic / item.intrinsic_scale)
        squares = np.square(own).sum(), np.square(weighted).sum()
        expected["bonus_share"] = squares[1] / sum(squares)
        expected |= {f"gradient_norm_{name}": norms[name][at + 1] for name in norms}
        for kind, critic in critics[at].items():
            returns = np.concatenate([getattr(item, f"{kind}_returns") for item in rollout])
            errors = returns - critic(observations)[:, 0].detach().numpy()
            expected[f"explained_variance_{kind}"] = 1 - np.var(errors) / np.var(returns)
        if variant != "ppo":
            for part in ("novelty", "relevance", "similarity"):
                steps = [value for item in rollout for value in getattr(item.bonus, part)]
                expected[part] = sum(steps) / len(steps)
        if variant == "mace_full" and number > 0:  # test_credit.py has its value
            expected["beta_credit"] = row.beta_credit
        found = {key: value for key, value in vars(row).items() if not math.isnan(value)}
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert row.approximate_kl > 0 and (row.bonus_share > 0) == (variant != "ppo")
