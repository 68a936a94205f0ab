"""Running scales: from their definitions, and what they are for, β as a relative strength."""

import copy
import math

import numpy as np
import pytest
from shared import Bonanza, finish

from mace_rl.agent.scale import AdvantageScale, RewardScale
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.train import Trainer


def episodes(seed=0, shift=0.7) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [shift + rng.standard_normal(length) for length in (1, 7, 2, 30, 1, 12)]


# --- Rewards ------------------------------------------------------------------------------------


@pytest.mark.parametrize("discount", [0.0, 0.5, 0.99, 1.0])
def test_reward_scale_is_the_deviation_of_discounted_sums(discount):
    scale, sums = RewardScale(discount, 1e-8), []
    for rewards in episodes():
        scale.update(rewards)
        sums += [
            sum(discount ** (t - i) * rewards[i] for i in range(t + 1)) for t in range(len(rewards))
        ]
        if len(sums) > 1:
            assert scale.value == pytest.approx(np.std(sums), rel=1e-9)


@pytest.mark.parametrize("smallest", [0.5, 1.0])
def test_reward_scale_is_never_below_smallest(smallest):
    """±¼ in turn, undiscounted: sums 0 and ¼, deviation ⅛; then sums up to 50."""
    scale = RewardScale(1.0, smallest)
    assert scale.value == 1.0  # nothing seen yet
    scale.update(np.tile([0.25, -0.25], 10))
    assert scale.value == smallest
    scale.update(np.ones(50))
    assert scale.value > 10


@pytest.mark.parametrize(("discount", "length"), [(0.99, 1), (0.0, 30)])
def test_rewards_whose_sums_have_not_varied_are_not_blown_up(discount, length):
    """A first episode of one step; or every step worth 1 without a future."""
    scale = RewardScale(discount, 1e-8)
    scale.update(np.ones(length))
    assert scale.value > 0.1


# --- Advantages ---------------------------------------------------------------------------------


def test_advantage_scale_is_the_root_mean_square_of_all_so_far():
    scale, seen = AdvantageScale(1e-8), []
    for advantages in episodes():
        scale.update(advantages)
        seen += advantages.tolist()
        assert scale.value == pytest.approx(math.sqrt(sum(x * x for x in seen) / len(seen)))


def test_advantage_scale_fades_slowly_down_to_smallest():
    scale = AdvantageScale(0.1)
    assert scale.value == 0.1
    scale.update(np.full(100, -3.0))
    found = []
    for zeros in (300, 500, 10**6):  # 900 / 400, 900 / 900, next to nothing
        scale.update(np.zeros(zeros))
        found.append(scale.value)
    assert found == [1.5, 1.0, 0.1]


@pytest.mark.parametrize("make", [lambda: RewardScale(0.9, 0.1), lambda: AdvantageScale(0.1)])
def test_restored_scale_continues_to_the_bit(make):
    original, restored = make(), make()
    first, *rest = episodes()[1:]
    original.update(first)
    restored.load_state_dict(copy.deepcopy(original.state_dict()))
    for part in rest:
        assert original.value == restored.value
        original.update(part)
        restored.update(part)
    assert original.value == restored.value != make().value


# --- β as a relative strength -------------------------------------------------------------------


class Paid(Bonanza):
    """Bonanza in another currency."""

    def __init__(self, unit: float) -> None:
        super().__init__()
        self.unit = unit

    def step(self, action):
        observation, reward, *ends = super().step(action)
        return observation, self.unit * reward, *ends


@pytest.fixture
def play(run_config, register, monkeypatch):
    """`play(reward, bonus, beta, scaled, episodes)`: a run in these units of the two rewards."""
    curiosity = Curiosity.bonus

    def run(reward=64.0, bonus=1.0, beta=0.4, scaled=True, episodes=40) -> Trainer:
        def in_units(self, episode):
            found = curiosity(self, episode)
            return found._replace(reward=bonus * found.reward)

        monkeypatch.setattr(Curiosity, "bonus", in_units)
        config = run_config(
            register("Paid-v0", Paid, 5, unit=reward),
            "mace_fixed",
            episodes=episodes,
            ppo={"rollout_steps": 20, "scale_rewards": scaled, "scale_advantages": scaled},
            beta={"kind": "constant", "value": beta},
        )
        return finish(config)

    return run


def weights(trainer: Trainer) -> dict[str, bytes]:
    return {name: adam.parameters.tobytes() for name, adam in trainer.ppo.optimisers.items()}


@pytest.mark.parametrize("change", [{"reward": 128.0}, {"bonus": 2.0**-10}])
def test_units_do_not_matter(play, change):
    """To the bit, as a power of two rounds nothing; unscaled they do matter."""
    one, other = play(), play(**change)
    assert weights(one) == weights(other)
    factors = change.get("reward", 64.0) / 64, change.get("bonus", 1.0)
    for before, after in zip(one.records, other.records, strict=True):
        assert after.extrinsic_return == factors[0] * before.extrinsic_return
        assert after.intrinsic_return == factors[1] * before.intrinsic_return
    assert sum(record.extrinsic_return for record in one.records) > 0
    assert len(one.curiosity.novelty.visited) > 20  # all of novelty was at work
    assert weights(play(scaled=False)) != weights(play(scaled=False, **change))


def shares(trainer: Trainer) -> list[float]:
    """The bonus's share of the squares of both parts of the advantages, in each update."""
    return [row.bonus_share for row in trainer.diagnostics]


def test_share_of_the_bonus_does_not_depend_on_its_size(play):
    large, small = shares(play()), shares(play(bonus=0.001))
    assert large == pytest.approx(small, rel=1e-2) and np.mean(large) > 0.05
    assert max(shares(play(bonus=0.001, scaled=False))) < 1e-4


def test_share_of_the_bonus_grows_with_beta(play):
    """Of the same first rollout: β² V / (V_E + β² V), so the odds grow with β²."""
    odds = []
    for beta in (0.1, 0.2, 0.4, 0.8):
        share = shares(play(beta=beta, episodes=4))[0]
        odds.append(share / (1 - share))
    assert odds == pytest.approx([odds[0] * factor for factor in (1, 4, 16, 64)], rel=1e-9)
