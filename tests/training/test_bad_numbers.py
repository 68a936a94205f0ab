"""Numbers that go bad stop a run, and say where; what float32 loses is named."""

from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformObservation
from shared import NETWORKS, SOON, Bonanza, Twin, finish

from mace_rl.base.errors import Refusal
from mace_rl.numerics.finite import NonFiniteError
from mace_rl.training.trainer import Trainer


@pytest.mark.parametrize(
    ("where", "value"),
    [
        *(("reward", value) for value in (np.nan, 1e160, -1.7e308)),
        ("observation", np.inf),
        ("observation", np.float32(-3e38)),
        ("first observation", -np.inf),
    ],
)
@pytest.mark.parametrize(("variant", "scaled"), [("ppo", True), ("mace_full", False)])
def test_bad_numbers_stop_the_run(run_config, register, where, value, variant, scaled):
    name = register("Bonanza-v0", Bonanza, 5, where=where, value=value)
    settings = {"scale_rewards": scaled, "scale_advantages": scaled}
    trainer = Trainer(run_config(name, variant, 7, episodes=9, ppo=settings))
    finished = []
    with pytest.raises(NonFiniteError) as caught:
        for records in trainer.run():
            finished += records
    place = "the reset" if "first" in where else "step 3"
    what = where.removeprefix("first ")
    message = f"Bonanza-v0 {variant} seed 7, episode 4: the {what} is {value:g} after {place}"
    assert str(caught.value).partition(", but float32 learns from less than 1e+12")[0] == message
    assert len(finished) == 3


def moved(unit: float, offset: float, reward: float = 0.0) -> gymnasium.Env:
    """Bonanza with another first dimension and a large reward."""
    space, env = Box(-1e9, 1e9, (2,), np.float64), Bonanza("reward", reward)
    return TransformObservation(env, lambda x: x * [unit, 1.0] + [offset, 0.0], space)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        *((given, "differences in observation[0]") for given in ((1e-9, 0), (1, 1e8), (1, 1e7))),
        *((given, "") for given in ((1, 1e4), (1e-6, 0), (0, 0.3), (0, 12345.6))),
        ((1, 0, 1e11), "the rewards of episode 4"),
    ],
)
def test_what_is_lost_is_named_once(run_config, register, caplog, given, said):
    names = ("unit", "offset", "reward")
    name = register("Moved-v0", moved, 50, **dict(zip(names, given, strict=False)))
    finish(run_config(name, "ppo", 0, episodes=9))
    found = [record.message.split(" are")[0] for record in caplog.records]
    assert found == ([f"Moved-v0: {said}"] if said else [])


@pytest.mark.parametrize("place", [0, -1])  # around every tanh
@pytest.mark.parametrize(
    ("part", "message"),
    [
        *((name, f"the update after episode 3: .*{name}.* is (nan|inf)") for name in NETWORKS),
        ("density", "episode 1: a log-density is nan"),
        ("meta", "episode 2: β is nan"),
    ],
)
def test_bad_weights_stop_the_run_and_say_whose(run_config, part, message, place):
    novelty = SOON | {"neighbours": [1], "refresh_every": 1}
    trainer = Trainer(run_config("CartPole-v1", "mace_full", 0, episodes=9, novelty=novelty))
    owners = {"actor": trainer.ppo.policy, "density": trainer.curiosity.novelty.density}
    owner = (owners | trainer.ppo.critics).get(part)
    update = trainer.ppo.update

    def spoil(value):
        if part == "meta":
            trainer.controller.network.weights.bias[place] = value
            return
        own = np.flatnonzero(Twin(owner).own())  # none of the zeros that are added
        getattr(owner, "network", owner).parameters[own[place]] = value

    def update_spoilt(batch, returns):
        if len(trainer.records) == 3:
            spoil(np.nan if place else np.inf)  # which a tanh hides
        return update(batch, returns)

    if part in NETWORKS:
        trainer.ppo.update = update_spoilt
    else:
        spoil(np.nan)
    with pytest.raises(NonFiniteError, match=f"CartPole-v1 mace_full seed 0, {message}"):
        finish(trainer)


@pytest.mark.parametrize("ends", [SystemExit(0), SystemExit("why"), GeneratorExit()], ids=repr)
def test_code_that_ends_the_program_is_an_error(run_config, register, monkeypatch, ends):
    name = register("Bonanza-v0", Bonanza, 5)
    trainer = Trainer(run_config(name, "ppo", 3, episodes=9))
    monkeypatch.setattr(Bonanza, "step", Mock(side_effect=ends))
    with pytest.raises(Refusal, match="ppo seed 3, episode 1: code raised") as refused:
        list(trainer.run())
    assert repr(ends) in str(refused.value)
