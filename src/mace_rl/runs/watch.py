"""Animations of a finished run's agent, drawn by its environment's own renderer."""

import io
import math
import os
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mace_rl.config.section import ConfigError
from mace_rl.environments.environment import Environment, nothing_printed
from mace_rl.environments.remembered import hold_still
from mace_rl.runs.agent import Player
from mace_rl.runs.finished import FinishedRun
from mace_rl.training.resuming import seeded
from mace_rl.training.rollout import draw_noise, roll_out

# pygame draws into memory: it should not look for a screen or a loudspeaker.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")

MOST_PER_SECOND = 20  # pictures; of more some are left out, the speed stays
LAST_SECONDS = 1.0  # for which an episode's last picture stays
COLOURS = 48
LINE_HEIGHT = 18  # pixels, below the picture, for the step and the return so far


class RenderError(ConfigError):
    """An environment that cannot be drawn; the message names it and says why."""


@dataclass(frozen=True)
class Film:
    """Pictures with the time that each is shown, and the returns of the episodes in them."""

    pictures: list[Image.Image]
    milliseconds: list[int]
    returns: list[float]  # of whole episodes, also where the film ends earlier


class Filmed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Films the first `seconds` of each episode of an environment, `width` pixels wide."""

    def __init__(self, env: gymnasium.Env[Any, Any], name: str, width: int, seconds: float) -> None:
        super().__init__(env)
        self.name, self.width = name, width
        per_second = env.metadata.get("render_fps") or MOST_PER_SECOND
        self.stride = math.ceil(per_second / MOST_PER_SECOND)  # steps from picture to picture
        self.duration = 1000 * self.stride / per_second  # milliseconds
        self.last_step = seconds * per_second
        self.font = ImageFont.load_default(12)
        self.film = Film([], [], [])
        self.begun = 0.0  # when the next picture begins, milliseconds

    def reset(self, **arguments: Any) -> Any:
        result = super().reset(**arguments)
        self.steps, self.extrinsic_return = 0, 0.0
        self._take()
        return result

    def step(self, action: Any) -> Any:
        result = super().step(action)
        _, reward, terminated, truncated, _ = result
        self.steps += 1
        self.extrinsic_return += float(reward)
        over = terminated or truncated
        if self.steps <= self.last_step and (over or self.steps % self.stride == 0):
            self._take()
        if over:
            self.film.milliseconds[-1] += round(1000 * LAST_SECONDS)
            self.film.returns.append(self.extrinsic_return)
        return result

    def _take(self) -> None:
        try:
            rendered = self.env.render()
            if rendered is None:
                raise TypeError("render() gives no picture")
            drawn = Image.fromarray(as_bytes(np.asarray(rendered)))
        except Exception as error:  # renderers raise many types
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise RenderError(f"environment {self.name!r} cannot be drawn: {reason}") from error
        height = round(drawn.height * self.width / drawn.width)
        picture = Image.new("RGB", (self.width, height + LINE_HEIGHT), "white")
        picture.paste(drawn.convert("RGB").resize((self.width, height), Image.Resampling.BOX))
        text = f"step {self.steps}   return {self.extrinsic_return:.1f}"
        ImageDraw.Draw(picture).text((4, height + 2), text, fill="black", font=self.font)
        self.film.pictures.append(picture)
        begun, self.begun = self.begun, self.begun + self.duration
        # A GIF has hundredths of a second.
        self.film.milliseconds.append(10 * (round(self.begun / 10) - round(begun / 10)))


def as_bytes(frame: np.ndarray) -> np.ndarray:
    """A frame as uint8; fractions from 0 to 1 are shares of 255. `ValueError` for other numbers."""
    if frame.dtype.kind in "fb" and frame.size and frame.max() <= 1:
        frame = frame * 255.0
    if not (frame.dtype.kind in "uif" and frame.size and frame.min() >= 0 and frame.max() <= 255):
        raise ValueError(f"render() gives {frame.dtype} outside 0 to 255, or no numbers")
    return np.round(frame).astype(np.uint8)


def film(
    directory: Path,
    episodes: int = 1,
    seed: int = 0,
    *,
    deterministic: bool = False,
    untrained: bool = False,
    trust: bool = False,
    width: int = 300,
    seconds: float = 10.0,
) -> Film:
    """The first `episodes` that `evaluate` plays; untrained: with the agent before training.

    Raises what `load_agent` raises, and `RenderError` if the environment cannot be drawn.
    """
    run = FinishedRun(directory.absolute(), trust)
    config = run.agent_config
    player = Player(config) if untrained else Player.of(run)
    environment, policy = player.environment, player.acting(deterministic)
    # Closed before another is made: pybullet loses other simulators when one is collected.
    environment.env.close()
    if "rgb_array" not in (environment.env.metadata.get("render_modes") or []):
        raise RenderError(
            f"environment {config.environment!r} cannot be drawn: 'rgb_array' is not among its"
            " render modes"
        )
    drawn = {**config.environment_arguments, "render_mode": "rgb_array"}
    seeds, limit = np.random.SeedSequence(0), config.max_episode_steps
    globally = np.random.SeedSequence(seed)
    try:
        with seeded(globally):
            environment = Environment(config.environment, seeds, limit, drawn, config.wrappers)
    except ConfigError as error:  # it trains, so it does not take this mode
        raise RenderError(f"{error}, so it cannot be drawn") from None
    environment.clips_actions = config.ppo.clip_actions
    if untrained:
        hold_still(environment.env)
    else:
        environment.recall(player.memory)
    filmed = environment.env = Filmed(environment.env, config.environment, width, seconds)
    generator = np.random.default_rng(seed)
    with closing(filmed), nothing_printed(), seeded(globally):
        filmed.env.reset(seed=seed)  # as `evaluate` does; no picture of it
        for _ in range(episodes):
            roll_out(environment, policy, draw_noise(environment, generator))
    return filmed.film


def gif(shown: Film) -> bytes:
    """A film as an animated GIF that plays without end."""
    # One palette, from pictures all over the film, and no dithering keep it small.
    sample = shown.pictures[:: math.ceil(len(shown.pictures) / 16)]
    width, height = sample[0].size
    wall = Image.new("RGB", (width, height * len(sample)))
    for place, picture in enumerate(sample):
        wall.paste(picture, (0, place * height))
    palette = wall.quantize(COLOURS, Image.Quantize.FASTOCTREE)  # keeps white white
    first, *others = (
        picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in shown.pictures
    )
    file, times = io.BytesIO(), shown.milliseconds
    first.save(file, "GIF", save_all=True, append_images=others, duration=times, loop=0)
    return file.getvalue()
