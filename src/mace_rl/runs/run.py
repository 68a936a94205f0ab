"""Carrying out one run on disk: train, save checkpoints, resume to the bit, write the results."""

import fcntl
import gc
import json
import logging
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import scipy.linalg.cython_blas  # noqa: F401  (numba loads it: before threads are limited)
from threadpoolctl import threadpool_limits

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.base.files import write_atomically
from mace_rl.base.rng import Streams
from mace_rl.config.run import IDENTITY, RunConfig
from mace_rl.environments import spec_of
from mace_rl.runs import checkpoint, provenance
from mace_rl.runs.agent_state import ENVIRONMENT, agent_state
from mace_rl.runs.finished import WAY_OUT, continues, difference_from, finished
from mace_rl.training import resuming
from mace_rl.training.records import EpisodeRecord, as_columns, write_diagnostics, write_episodes
from mace_rl.training.resuming import seeded
from mace_rl.training.rollout import fallback_reason
from mace_rl.training.trainer import Trainer

logger = logging.getLogger(__name__)

PROGRESS_SECONDS = 2.0
START_SHARE = 0.01  # of the episodes: these wait for their code to be compiled
# Between checkpoints are this time, and as much as keeps their cost under 1 %.
CHECKPOINT_SECONDS, CHECKPOINT_VARIABLE = 10.0, "MACE_RL_CHECKPOINT_SECONDS"
CHECKPOINT_COST = 0.01
FIRST_CHECKPOINT_SECONDS = 2.0  # after the start, or as soon as what that compiles has run
LOCK_SECONDS = 5.0  # for which a run waits until one whose Snakemake was killed has ended
# Packages whose environments and wrappers draw nothing from torch's generator.
WITHOUT_TORCH = ("mace_rl.", "gymnasium.", "minigrid.", "pybullet_envs_gymnasium.")
CLAIM = b"mace-rl trains here\n"  # in the lock file: the files of a run beside it are ours


class RunError(Refusal, RuntimeError):
    """A run that cannot be carried out in its folder; the message says why."""


def run(
    config: RunConfig,
    directory: Path,
    observe: Callable[[dict[str, Any]], None] | None = None,
    keep_checkpoint: bool = False,
    after_episode: Callable[[EpisodeRecord], object] | None = None,
    aside: Literal["nothing", "others", "all"] = "nothing",
) -> None:
    """Train as `config` says, on one thread, and leave the results in `directory`.

    observe: gets `progress_of` the run, as a file in `directory` does.
    keep_checkpoint: keep the last before a rollout that the budget cuts short: from it the same run
        with more episodes goes on, and deleted results come back.
    after_episode: is called with each episode after the update on it.
    aside: what is moved into a folder below `directory`: files of "others" than this run, or "all".

    Continues from a checkpoint of this configuration, code and versions, or of one with another
    number of episodes; does nothing if the run is finished and nothing is to be moved. Raises
    `RunError` if another process trains in `directory` or other files are in the way, `ConfigError`
    if another finished run is.
    """
    directory = directory.absolute()  # an environment may change the current folder
    directory.mkdir(parents=True, exist_ok=True)
    if may_use_torch(config):
        import torch  # noqa: F401  (now, so that what follows sets its generator and threads)
    with (
        exclusive(directory) as lock,
        threadpool_limits(1),
        single_threaded(),
        seeded(Streams(config.seed).sequence("global")),
        ExitStack() as end,
    ):
        if aside == "nothing" and finished(config, directory):
            if not keep_checkpoint:
                (directory / files.CHECKPOINT).unlink(missing_ok=True)  # of one killed at its end
            return
        started = time.monotonic()
        identity, code = provenance.identity(config), provenance.git_state()
        trainer = trainer_of(config)
        end.callback(trainer.environment.env.close)
        # Before files are moved: what cannot be is refused now rather than after minutes.
        clock = Clock(started)
        checkpoint.require_plain(trainer.state_dict(), "state")
        state = to_continue(config, identity, directory, lock, aside)
        slow = fallback_reason(trainer.environment)
        if slow:
            logger.warning("the fast path for %s is not taken: %s", config.environment, slow)
        gc.freeze()  # the collector need not look again at what stays
        if state is not None:
            resume(trainer, clock, state)
        file = directory / files.PROGRESS

        def save() -> None:
            state = {"trainer": trainer.state_dict(), **clock.account()}
            checkpoint.save(directory / files.CHECKPOINT, identity, state)

        if keep_checkpoint and state is None:
            save()
        for records in trainer.run():
            if after_episode:
                for record in records:
                    after_episode(record)
            if not clock.start_seconds or len(trainer.records) <= START_SHARE * config.episodes:
                clock.start_seconds = time.monotonic() - started
            if time.monotonic() >= clock.next_progress:
                clock.next_progress = time.monotonic() + PROGRESS_SECONDS
                progress = progress_of(trainer, clock)
                write_atomically(file, json.dumps(progress))
                if observe:
                    observe(progress)
            if clock.checkpoint_due() and not trainer.cut:
                with clock.saving():
                    save()
        if keep_checkpoint and not trainer.cut:
            save()
        write_results(directory, trainer, identity | {"code": code}, clock)
        if not keep_checkpoint:
            (directory / files.CHECKPOINT).unlink(missing_ok=True)
        file.unlink(missing_ok=True)


def may_use_torch(config: RunConfig) -> bool:
    """Whether something in this training may use torch, which other ones are quicker without."""
    entry_point = getattr(spec_of(config.environment), "entry_point", None)
    places = [entry_point, *config.references().values()]
    ours = all(isinstance(place, str) and place.startswith(WITHOUT_TORCH) for place in places)
    return not ours or config.engine == "torch"


def trainer_of(config: RunConfig) -> Trainer:
    """The one that the settings ask for."""
    if config.trainer == "published":
        from mace_rl.published import PublishedTrainer

        return PublishedTrainer(config)
    return Trainer(config)


def to_continue(
    config: RunConfig, identity: dict[str, Any], directory: Path, lock: int, aside: str
) -> dict[str, Any] | None:
    """The state to continue from; None to start afresh. `run` says what happens to other files.

    `lock`, the folder's open lock file, then claims the folder. Without a claim, files named as a
    run's may be somebody else's. Raises `RunError` for what is refused.
    """
    path, content = directory / files.CHECKPOINT, None
    trained_here = os.pread(lock, len(CLAIM), 0) == CLAIM
    harmless = {files.PROGRESS} if trained_here else set()
    there = [name for name in files.OF_A_RUN if os.path.lexists(directory / name)]
    others = not trained_here and files.RECORD not in there
    reason = f"{directory} holds {', '.join(there)}" + ", which no training left" * others
    if path.exists():
        try:
            content = checkpoint.read(path)
            played = len(content["state"]["trainer"]["records"]["episode"])
            fits = continues(content["identity"], identity, config)
            others = not fits or played > config.episodes
            other = f" {difference_from(content['identity'], identity, config)}" if others else ""
            reason = f"{directory} holds an unfinished run{other}"
        except checkpoint.CheckpointError as error:
            reason = str(error)
    if (content is None or others or aside == "all") and set(there).difference(harmless):
        if others and aside == "nothing":
            raise RunError(f"{reason}; {WAY_OUT}")
        moved = files.set_aside(directory, there)
        logger.warning("starting afresh: %s; set aside in %s", reason, moved)
        content = None
    if trained_here or path.exists():
        for name in files.OF_A_RUN:
            for half_written in directory.glob(f".{name}.[0-9]*.tmp"):  # by a killed process
                half_written.unlink()
    if trained_here and not content and not set(there).difference(harmless):
        logger.info("starting over: what was trained in %s left no checkpoint", directory)
    if not os.fstat(lock).st_size:
        os.write(lock, CLAIM)
    return content["state"] if content else None


def resume(trainer: Trainer, clock: "Clock", state: dict[str, Any]) -> None:
    """Continue from the state in a checkpoint, and note the interruption for `run.json`."""
    differs = resuming.replay_differs(trainer.environment, state["trainer"]["last_episodes"])
    trainer.load_state_dict(state["trainer"])  # after the replay, which drew random numbers
    logger.info("resuming after episode %d", len(trainer.records))
    if differs:
        logger.warning(
            "%s plays its last episodes otherwise than before the interruption (%s), by state "
            "that the checkpoint has not: this run is not the one that it would have been",
            *(trainer.config.environment, differs),
        )
    interruption = {
        "after_episode": len(trainer.records),
        "machine": state["machine"],
        "environment_replayed": not differs,
    }
    clock.start -= state["seconds"]
    clock.checkpoint_seconds = state["checkpoint_seconds"]
    clock.interruptions = [*state["interruptions"], interruption]


class Clock:
    """Training time, and when progress and checkpoints are due; seconds."""

    def __init__(self, start: float) -> None:
        self.start = start  # by `time.monotonic`, as if there had been no interruption
        self.start_seconds = 0.0  # from the start of this process to the end of its first episodes
        self.next_progress = time.monotonic()
        self.between_checkpoints = between_checkpoints()
        soon = min(FIRST_CHECKPOINT_SECONDS, self.between_checkpoints)
        self.next_checkpoint = time.monotonic() + soon
        self.checkpoint_seconds = 0.0  # spent on checkpoints
        self.interruptions: list[dict[str, Any]] = []

    def account(self) -> dict[str, Any]:
        """The entries of a checkpoint and `run.json` about the training's course."""
        return {
            "seconds": self.elapsed(),
            "checkpoint_seconds": self.checkpoint_seconds,
            "interruptions": self.interruptions,
            "machine": provenance.machine(),
        }

    def elapsed(self) -> float:
        """Seconds of this run, those before interruptions included."""
        return time.monotonic() - self.start

    def checkpoint_due(self) -> bool:
        """Whether it is time for a checkpoint."""
        return time.monotonic() >= self.next_checkpoint

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Measure a checkpoint and set the time of the next."""
        start = time.monotonic()
        yield
        cost = time.monotonic() - start
        self.checkpoint_seconds += cost
        self.next_checkpoint = start + max(self.between_checkpoints, cost / CHECKPOINT_COST)


def between_checkpoints() -> float:
    """Seconds, by MACE_RL_CHECKPOINT_SECONDS if it is set; `RunError` unless it is a number."""
    said = os.environ.get(CHECKPOINT_VARIABLE, CHECKPOINT_SECONDS)
    try:
        seconds = float(said)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < math.inf:
        raise RunError(f"{CHECKPOINT_VARIABLE} is {said!r}, but should be a number of seconds")
    return seconds


@contextmanager
def single_threaded() -> Iterator[None]:
    """PyTorch, if used, on one thread with its default modes; afterwards as before.

    Nothing stays frozen, and code that would end the program ends this run.
    """
    try:
        with ExitStack() as end:
            if torch := sys.modules.get("torch"):
                end.callback(torch.set_num_threads, torch.get_num_threads())
                torch.set_num_threads(1)
                end.enter_context(torch.inference_mode(False))
                end.enter_context(torch.enable_grad())
                end.enter_context(torch.autocast("cpu", enabled=False))
            yield
    except SystemExit as error:
        raise RunError(f"code from outside mace_rl ended the program: {error!r}") from error
    finally:
        gc.unfreeze()


@contextmanager
def exclusive(directory: Path) -> Iterator[int]:
    """Lock the run's folder for this process; gives the lock file's descriptor."""
    # By a file: two machines can lock the same folder on a network's disk.
    path = directory / files.LOCK
    if path.exists() and not path.is_file():
        raise RunError(f"{path}: it is no ordinary file")
    with open(path, "a+b") as file:
        # A copy in an environment's worker would hold the lock after the training.
        os.register_at_fork(after_in_child=file.close)
        patience = time.monotonic() + LOCK_SECONDS
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > patience:
                    reason = "another process is training in this folder"
                    raise RunError(f"{directory}: {reason}") from None
                time.sleep(0.1)
        yield file.fileno()


def progress_of(trainer: Trainer, clock: Clock) -> dict[str, Any]:
    """A run's progress; `left`, seconds to its end, if episodes stay as long as the last 50."""
    records, episodes, seconds = trainer.records, trainer.config.episodes, clock.elapsed()
    last, recent = records[-1], records[-50:]
    speed = last.env_steps / max(1e-9, seconds - clock.start_seconds)
    steps_left = (episodes - len(records)) * fmean(record.length for record in recent)
    return {
        **{key: getattr(trainer.config, key) for key in IDENTITY},
        "episode": len(records),
        "episodes": episodes,
        "recent_return": fmean(record.extrinsic_return for record in recent),
        "beta": last.beta,
        "env_steps": last.env_steps,
        "steps_per_second": speed,
        "left": steps_left / speed,
        "seconds": seconds,
        "start_seconds": clock.start_seconds,
        "pid": os.getpid(),
    }


def write_results(
    directory: Path, trainer: Trainer, identity: dict[str, Any], clock: Clock
) -> None:
    """Write the records, the agent and, last, `run.json`; identity: with the code's commit."""
    (directory / files.RECORD).unlink(missing_ok=True)  # of the run that this one goes on from
    write_episodes(directory / files.EPISODES, as_columns(EpisodeRecord, trainer.records))
    write_diagnostics(directory / files.DIAGNOSTICS, trainer.diagnostics)
    state = agent_state(trainer.ppo, trainer.environment.given_space)
    if memory := trainer.environment.memory():
        state[ENVIRONMENT] = memory
    agent = checkpoint.archive(state)
    write_atomically(directory / files.AGENT, agent)
    record = identity | {
        "threads": 1,
        **clock.account(),
        "start_seconds": clock.start_seconds,
        "peak_memory_mb": provenance.peak_memory_mb(),
        "outputs": {name: provenance.file_digest(directory / name) for name in files.RESULTS},
    }
    text = json.dumps(record, indent=2, ensure_ascii=False)
    write_atomically(directory / files.RECORD, f"{text}\n")
