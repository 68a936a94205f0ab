"""Animations of agents: what is filmed is what was played, and how it is written."""

import gc
import io
import shutil

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv
from PIL import Image
from shared import likeliest

from mace_rl import files
from mace_rl.runs import watch
from mace_rl.runs.agent import Agent
from mace_rl.runs.evaluate import evaluate
from mace_rl.trainer import Trainer

pytestmark = pytest.mark.slow


class NoDisplay(CartPoleEnv):
    def render(self):
        raise OSError("no display")


@pytest.mark.parametrize("environment", ["CartPole-v1", "HopperBulletEnv-v0"])
def test_what_is_filmed_is_what_evaluate_plays(trained, environment):
    folder = trained(environment, episodes=2)
    threshold = gc.get_threshold()
    gc.set_threshold(10)  # what is no longer used goes while the film is made
    try:
        for deterministic in (False, True):
            film = watch.film(folder, 2, 5, deterministic=deterministic)
            assert film.returns == evaluate(folder, 2, 5, deterministic).tolist()
    finally:
        gc.set_threshold(*threshold)
    assert len({picture.tobytes() for picture in film.pictures}) > len(film.pictures) / 2


def test_the_untrained_agent_has_the_weights_that_training_began_with(trained, run_config):
    trainer = Trainer(run_config(episodes=2))
    policy = Agent(trainer.ppo, trainer.environment.given_space).policy
    film = watch.film(trained("CartPole-v1", episodes=2), 1, 5, deterministic=True, untrained=True)
    assert film.returns == likeliest(policy, 1, 5)


@pytest.mark.parametrize(
    ("environment", "rate", "stride", "durations"),
    [("CartPole-v1", 50, 3, {60}), ("Acrobot-v1", 15, 1, {60, 70})],  # a GIF has whole hundredths
)
def test_pictures_and_speed_are_the_environments(trained, environment, rate, stride, durations):
    """Thinned to at most 20 pictures a second, cut where it should be, and written whole."""
    env = gymnasium.make(environment, render_mode="rgb_array")
    env.reset(seed=0)
    env.reset()
    height, width, _ = env.render().shape
    folder = trained(environment, episodes=2)
    film = watch.film(folder, seconds=0.2, width=width)
    assert np.array_equal(np.asarray(film.pictures[0].crop((0, 0, width, height))), env.render())
    assert len(film.pictures) == 1 + rate // 5 // stride
    assert set(film.milliseconds[:-1]) == durations
    starts = np.cumsum([0, *film.milliseconds[:-1]])
    np.testing.assert_allclose(starts, np.arange(len(starts)) * 1000 * stride / rate, atol=5)
    assert film.returns == evaluate(folder, 1, 0).tolist()
    with Image.open(io.BytesIO(watch.gif(film))) as image:
        assert (image.format, image.info["loop"]) == ("GIF", 0)
        assert image.n_frames == len(film.pictures)
        for place, picture in enumerate(film.pictures):
            image.seek(place)
            assert image.info["duration"] == film.milliseconds[place]
            difference = np.subtract(image.convert("RGB"), picture, dtype=np.int16)
            assert abs(difference).mean() < 3


def test_what_cannot_be_filmed_is_said(trained, tmp_path, register):
    register("NoDisplay-v0", NoDisplay)
    register("Nothing-v0", type("Nothing", (NoDisplay,), {"render": lambda _: None}))
    register("NoMode-v0", lambda: CartPoleEnv())  # takes no mode, though it promises one
    for name, reason in (
        ("PlantedHelp-v0", "cannot be drawn: 'rgb_array' is not"),
        ("NoDisplay-v0", "cannot be drawn: OSError: no display"),
        ("Nothing-v0", r"cannot be drawn: TypeError: render\(\) gives no picture"),
        ("NoMode-v0", "with .* cannot be drawn"),
    ):
        with pytest.raises(watch.RenderError, match=f"'{name}' {reason}"):
            watch.film(trained(name, episodes=2))
    shutil.copy(trained("CartPole-v1", episodes=2) / files.RECORD, tmp_path)
    assert watch.film(tmp_path, untrained=True).pictures  # needs no weights but the first
