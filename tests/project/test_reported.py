"""Faults that were reported, each by its smallest input: a table of what must hold."""

import logging
import os
import random
import re
import resource
import shutil
import subprocess
import sys
from types import SimpleNamespace

import gymnasium
import numba
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from invented import PAPERS, QUICK, VARIANTS, table_for_claims
from shared import ROOT, Bonanza, call, environment_of, play

from mace_rl import CuriosityReward, VectorCuriosityReward, load_agent
from mace_rl.base.files import CHECKPOINT, LOCK, RECORD
from mace_rl.numerics import compiling
from mace_rl.runs import evaluate, run
from mace_rl.training.resuming import global_state
from mace_rl.training.rollout import roll_out
from mace_study.compare.verdicts import ledger
from mace_study.config.metrics import FigureConfig
from mace_study.measure.betas import BEFORE, CORRELATION, LABELS
from mace_study.show import tables
from mace_study.show.curves import PlotStyle, draw_figure, quantity
from mace_study.show.sections import _others, of_ledger

DRAWS = {
    "Python's": random.random,
    "NumPy's": lambda: np.random.random(),  # noqa: NPY002
    "PyTorch's": lambda: float(torch.rand(1)),
}


class Drawing(Bonanza):
    """Pays what a global generator draws, also in its constructor."""

    def __init__(self, draw):
        super().__init__()
        self.draw, self.first = draw, draw()

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.first + self.draw(), *rest


@pytest.mark.parametrize("generator", DRAWS)
def test_global_generators_repeat_themselves_and_are_given_back(
    generator, register, run_config, tmp_path
):
    name = register("Drawing-v0", Drawing, 5, draw=DRAWS[generator])
    found = []
    for place in ("one", "other"):
        DRAWS[generator]()  # elsewhere in the program
        before = global_state()
        run.run(run_config(name, "ppo", 1, episodes=3), tmp_path / place)
        after = global_state()
        assert [before[key] for key in ("random", "numpy")] == [after["random"], after["numpy"]]
        assert (before["torch"] == after["torch"]).all()
        found.append((tmp_path / place / "episodes.csv").read_bytes())
        found.append(evaluate.evaluate(tmp_path / place, 2, seed=4, trust=True).tolist())
    assert found[:2] == found[2:]
    other = run_config(name, "ppo", 2, episodes=3)
    run.run(other, tmp_path / "another seed")
    assert (tmp_path / "another seed" / "episodes.csv").read_bytes() != found[0]


def limited_outside(env, steps):
    return TimeLimit(CuriosityReward(env, 0.4), steps)


def limited_inside(env, steps):
    return CuriosityReward(TimeLimit(env, steps), 0.4)


def limited_as_a_vector(env, steps):
    vector = VectorCuriosityReward(SyncVectorEnv([lambda: env]), 0.4)

    class Limited(gymnasium.Wrapper):
        def __init__(self):
            self.env, self.count = vector, 0

        def reset(self, **given):
            self.count = 0
            return vector.reset(**given)

        def step(self, action):
            self.count += 1
            observation, reward, ended, _, info = vector.step(np.array([action]))
            return observation, float(reward[0]), bool(ended[0]), self.count == steps, info

    limited = Limited()
    limited.action_space = env.action_space
    return limited


@pytest.mark.parametrize("form", [limited_outside, limited_inside, limited_as_a_vector])
def test_a_bonus_is_paid_wherever_the_time_limit_is(form):
    env = form(gymnasium.make("MountainCar-v0").unwrapped, 50)
    extrinsic = -1.0  # each step's
    env.reset(seed=0)
    paid = 0.0
    for number in range(400):
        env.action_space.seed(number)
        _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        paid += abs(reward - extrinsic)
        if terminated or truncated:
            env.reset()
    assert paid > 1


class Careless(gymnasium.Env):
    """Writes into the action that it gets, and uses one buffer for all observations."""

    observation_space, action_space = Box(-9, 9, (1,)), Box(-1, 1, (1,))

    def __init__(self):
        self.buffer = np.zeros(1, np.float32)

    def reset(self, **given):
        super().reset(**given)
        self.buffer[:] = 0
        return self.buffer, {}

    def step(self, action):
        self.buffer += action
        action[:] = 7
        return self.buffer, 0.0, False, False, {}


def test_what_an_environment_changes_in_place_is_kept_as_it_was(register, run_config):
    actions = np.array([[0.5], [-0.25], [0.125]], np.float32)
    name = register("Careless-v0", Careless, 3)
    single = CuriosityReward(gymnasium.make(name))
    vector = VectorCuriosityReward(
        SyncVectorEnv([Careless], autoreset_mode=AutoresetMode.DISABLED), 0.4
    )
    for env, given in ((single, actions.copy()), (vector, actions[:, None].copy())):
        env.reset(seed=0)
        for action in given[:2]:
            env.step(action)
        kept = env.tracker.recordings[0]
        assert np.array_equal(kept.actions, actions[:2])
        assert np.array_equal(np.ravel(kept.observations), [0, 0.5, 0.25])
    environment = environment_of(name)
    environment.clips_actions = False
    policy = SimpleNamespace(act=lambda _, noise: (noise, np.float32(0)))
    episode = roll_out(environment, policy, actions.copy())
    assert np.array_equal(episode.actions, actions)
    assert np.array_equal(np.ravel(episode.observations), [0, 0.5, 0.25, 0.375])


class Wandering(Bonanza):
    def reset(self, **given):
        os.chdir("/")
        return super().reset(**given)


def test_an_environment_may_change_the_folder(register, monkeypatch, tmp_path, capsys):
    name = register("Wandering-v0", Wandering, 5)
    words = ("train", "--env", name, "--variant", "ppo", "--episodes", "3", "--out", "here")
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, *words) == (0, "")
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "evaluate", "here", "--episodes", "2") == (0, "")
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "verify", ".") == (0, "")
    assert (tmp_path / "here" / "run.json").exists()


class Failing(Bonanza):
    def __init__(self, error, where):
        super().__init__()
        self.error, self.where = error, where

    def reset(self, **given):
        found = super().reset(**given)
        if self.where == "reset" and self.resets == 4:
            raise self.error
        return found

    def step(self, action):
        if self.where == "step" and (self.resets, self.steps) == (4, 1):
            raise self.error
        return super().step(action)


MISSING = FileNotFoundError(2, "No such file or directory", "asset.urdf")


@pytest.mark.parametrize("where", ["step", "reset"])
@pytest.mark.parametrize("error", [MISSING, TimeoutError(), BrokenPipeError("gone"), KeyError("k")])
def test_an_error_in_an_environment_says_where(register, monkeypatch, tmp_path, error, where):
    name = register("Failing-v0", Failing, 5, error=error, where=where)
    words = ("train", "--env", name, "--variant", "ppo", "--episodes", "9", "--out", str(tmp_path))
    code, said = call(monkeypatch, *words)
    assert code == 1 and "\n" not in said
    assert f"mace-rl: in {name} ppo seed 0, episode 3, in " in said
    assert ("step 2 of an episode" if where == "step" else "a reset of") in said
    assert type(error).__name__ in said
    file = said.rpartition("(traceback: ")[2].rstrip(")")
    with open(file, encoding="utf-8") as kept:
        assert "test_reported.py" in kept.read()
    os.unlink(file)


def test_compiled_code_need_not_be_kept(monkeypatch, tmp_path, caplog):
    """As on a full disk, here by a limit on what a file may hold."""
    monkeypatch.setattr(compiling, "FOLDER", tmp_path / "numba" / "x")
    compiling.warn_unkept.cache_clear()

    def one_more(x):
        return x + 1

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    compiled = compiling.njit(cache=True)(one_more)
    assert isinstance(compiled, numba.core.dispatcher.Dispatcher)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        assert compiled(1) == 2 and compiled(1.5) == 2.5
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [str(tmp_path / "numba") in message for message in caplog.messages] == [True]


@pytest.mark.parametrize("name", [RECORD, CHECKPOINT, "episodes.csv", "progress.json", LOCK])
def test_a_pipe_in_a_run_s_place_is_refused(run_config, tmp_path, name):
    config = run_config("CartPole-v1", "ppo", 0, episodes=2)
    if name == "episodes.csv":
        run.run(config, tmp_path)
        (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    with pytest.raises((run.RunError, OSError, ValueError), match=name):
        run.run(config, tmp_path)


class Showing(gymnasium.Env):
    """Any observation at random; the actions that it got."""

    def __init__(self, observations=None, actions=None):
        self.observation_space = observations or Box(-1, 1, (2,))
        self.action_space = actions or Discrete(2)

    def reset(self, **given):
        super().reset(**given)
        self.observation_space.seed(int(self.np_random.integers(1000)))
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("spaces", "size"),
    [
        ({"observations": Box(0, 255, (4, 4), np.uint16)}, 16),
        ({"observations": Box(0, 255, (8, 8, 3), np.uint8)}, 192),
        ({"observations": MultiDiscrete([2, 3])}, 5),
        ({"observations": MultiBinary(3)}, 3),
        ({"observations": Dict(a=MultiDiscrete([[2, 3], [1, 4]]), b=Box(0, 1, (2, 2)))}, 14),
        ({"actions": Box(-0.3, 0.7, (3,), np.float16)}, 2),
    ],
)
def test_spaces_are_trained_and_played_in_and_wrapped(register, run_config, tmp_path, spaces, size):
    name = register("Showing-v0", Showing, 4, **spaces)
    for clips in (True, False) if "observations" in spaces else (True,):
        config = run_config(name, "mace_full", 0, episodes=2, ppo={"clip_actions": clips})
        run.run(config, tmp_path / str(clips))
    env = gymnasium.make(name)
    policy = load_agent(tmp_path / "True", trust=True).policy
    assert len(policy.mean) == size
    policy(env.reset(seed=0)[0]).sample()
    play(CuriosityReward(env), 9)


def test_a_time_limit_that_only_the_environment_keeps(register, run_config):
    class Stopping(Bonanza):
        max_steps = 3  # as MiniGrid's call it

    name = register("Stopping-v0", Stopping, None)
    assert run_config(name, "ppo", 0).max_episode_steps == 3


def test_every_column_of_a_table_has_the_label_of_what_is_in_it():
    """Each number is unlike all others, so that a cell tells the column that it is from."""
    values = dict(zip(LABELS, (0.1, 0.2, 0.3, 0.4, 0.5), strict=True))
    rows = [
        {"env": "E", "variant": "v", "seed": seed, "beta_highest": 0.9 + seed / 100} | values
        for seed in range(10)
    ]
    frame = tables.betas(pd.DataFrame(rows), QUICK)
    for name, value in values.items():
        cell = frame[LABELS[name]].iloc[0]
        text = cell if isinstance(cell, str) else cell.values[0].text
        assert float(text.split(",")[0]) == value
    compared = {"difference": 11.0, "low": 12.0, "high": 13.0, "p_value": 0.14, "p_holm": 0.15}
    compared |= {"probability": 0.16, "probability_low": 0.17, "probability_high": 0.18}
    what = {"env": "E", "metric": "final_return", "variant": "v", "baseline": "w", "seeds": 19}
    means = pd.DataFrame([{**what, "mean": 11.0, "low": 12.0, "high": 13.0}])
    shown = tables.comparisons(pd.DataFrame([what | compared]), means, QUICK).iloc[0]
    heads = {"n": "seeds", "difference": "difference", "p": "p_value", "p (Holm)": "p_holm"}
    for head, name in (heads | {"P": "probability"}).items():
        assert float(shown[head].values[0].text) == pytest.approx((what | compared)[name])
    mean = {"mean": 0.21, "mean_low": 0.2, "mean_high": 0.3, "iqm": 0.22, "iqm_low": 0.1}
    one = {"variant": "v", "metric": "m", "runs": 23, **mean, "iqm_high": 0.4}
    shown = tables.aggregate(pd.DataFrame([one])).iloc[0]
    for head, name in {"runs": "runs", "mean": "mean", "interquartile mean": "iqm"}.items():
        assert float(shown[head].values[0].text) == pytest.approx(one[name])


def test_the_page_names_the_column_that_a_claim_is_judged_by():
    for name, title in ((CORRELATION, LABELS[CORRELATION]), (BEFORE, LABELS[BEFORE])):
        rows = [{"env": "E", "variant": "v", "seed": seed} for seed in range(10)]
        betas = pd.DataFrame(rows).assign(**dict.fromkeys([*LABELS, "beta_highest"], 0.5))
        betas["beta_end"] = betas["seed"] / 10
        asked = [("C9", name)]
        [beta] = _others({"metrics": betas, "betas": betas}, QUICK, asked)
        assert LABELS[name] == title and f"Of C9 it is the column *{title}*" in beta.note


def test_an_inset_never_lies_on_a_curve():
    early = np.concatenate([np.arange(20), np.full(180, 19.0)])
    low = np.where(np.arange(200) < 25, early, 8.0)  # it comes down to where the inset would be
    curves = [
        pd.DataFrame({"env": "E", "variant": variant, "episode": np.arange(1, 201), "n": 1}).assign(
            mean=mean, lower=np.nan, upper=np.nan
        )
        for variant, mean in (("a", early), ("b", early), ("c", low))
    ]
    shown, found = quantity("1", QUICK), []
    for own in (curves[:2], curves):
        seeds = pd.concat(own).rename(columns={"mean": shown.name}).assign(seed=0)
        names = {name: name for name in "abc"}
        colours = dict(zip("abc", ("red", "green", "blue"), strict=True))
        look = PlotStyle(FigureConfig(columns=1, inset=0.1), 0.95, names, colours, {})
        [panel] = draw_figure(pd.concat(own), seeds, shown, look).axes[:1]
        found.append(len(panel.child_axes))
    assert found == [1, 0]


def test_an_unfinished_run_that_left_nothing_starts_over_in_words(run_config, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    (tmp_path / LOCK).write_bytes(run.CLAIM)
    run.run(run_config("CartPole-v1", "ppo", 0, episodes=2), tmp_path)
    assert f"starting over: what was trained in {tmp_path} left no checkpoint" in caplog.text


@pytest.mark.slow
def test_a_policy_leaves_for_plain_pytorch_as_the_page_says(trained, tmp_path, monkeypatch):
    shutil.copytree(trained("CartPole-v1", "ppo", 0, episodes=10), tmp_path / "cartpole_run")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    exec(re.findall(r"```py\n(.*?)```", page, re.DOTALL)[0], {})
    rows, agent = torch.randn(5, 4), load_agent("cartpole_run")
    torch.save(rows, "rows.pt")
    alone = "import sys; sys.modules['mace_rl'] = None\nimport torch\n"
    alone += "policy = torch.export.load('policy.pt2').module()\n"
    alone += "torch.save(policy(torch.load('rows.pt')), 'logits.pt')"
    subprocess.run([sys.executable, "-c", alone], check=True)
    logits = torch.load("logits.pt")
    assert torch.equal(logits, agent.outputs(rows))
    assert torch.equal(logits - logits.logsumexp(-1, keepdim=True), agent.policy(rows).logits)


def test_too_few_seeds_are_named_where_claims_are_judged():
    equal = dict.fromkeys(VARIANTS, 0.0)
    said = "No claim can have a verdict: that takes 10 seeds, and there are 9."
    for seeds, expected in ((9, True), (10, False)):
        answers = ledger(table_for_claims(seeds, equal, 0.1), QUICK, PAPERS)
        notes = [one.note for one in of_ledger(answers, PAPERS) if one.level == 2]
        assert notes and all((said in note) == expected for note in notes)
