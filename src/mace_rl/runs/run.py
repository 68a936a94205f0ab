"""Carrying out one run on disk: train, save checkpoints, resume, write the results.

`mace_rl.files` names the files of a run's folder. The same call resumes to the bit from the
checkpoint that an interrupted one left.
"""

import fcntl
import gc
import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  (numba loads it: before threads are limited)
import torch
from threadpoolctl import threadpool_limits

from mace_rl import files
from mace_rl.config.run import RunConfig
from mace_rl.environments import resuming
from mace_rl.environments.rollout import fallback_reason
from mace_rl.files import write_atomically
from mace_rl.published import PublishedTrainer
from mace_rl.records import EpisodeRecord, as_columns, write_diagnostics, write_episodes
from mace_rl.refusal import Refusal
from mace_rl.runs import checkpoint, provenance
from mace_rl.runs.agent import Agent
from mace_rl.runs.finished import WAY_OUT, finished, otherwise
from mace_rl.trainer import Trainer

logger = logging.getLogger(__name__)

PROGRESS_SECONDS, OBSERVER_SECONDS = 2.0, 0.5
START_SHARE = 0.01  # of the episodes, which wait for their code to be compiled
# A checkpoint follows the last one after this time, or after as long as keeps its cost under 1 %.
CHECKPOINT_SECONDS, CHECKPOINT_VARIABLE = 10.0, "MACE_RL_CHECKPOINT_SECONDS"
CHECKPOINT_COST = 0.01
# A training whose Snakemake was killed takes a moment to notice; its successor waits as long.
LOCK_SECONDS = 5.0
CLAIM = b"mace-rl trains here\n"  # in the lock's file: a run's files beside it are its own


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
    """Train as `config` says and leave its results in `directory`.

    Whoever watches is told `how_far` it is: `observe` if given, else by a file in `directory`; and
    `after_episode` each episode, when the update that it was played for is done.

    Continues from its checkpoint if there is one of this very configuration, code and versions,
    and does nothing where this run is finished. Anything else that is in the way is refused, or
    moved into a folder below `directory`: "others" than this run, or "all", to start afresh.

    With `keep_checkpoint` a last one stays, from which results that are deleted come back without
    training. Uses one thread. Raises `RunError` if another process is at work in `directory` or
    something is in the way, `ConfigError` if a finished run is.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with exclusive(directory) as lock, threadpool_limits(1), single_threaded():
        if aside == "nothing" and finished(config, directory):
            (directory / files.CHECKPOINT).unlink(missing_ok=True)  # killed between the two
            return
        started = time.monotonic()
        identity = provenance.identity(config)
        trainer = (PublishedTrainer if config.trainer == "published" else Trainer)(config)
        state = to_continue(config, identity, directory, lock, aside)
        slow = fallback_reason(trainer.environment)
        if slow:
            logger.warning("the fast path for %s is not taken: %s", config.environment, slow)
        gc.freeze()  # what is there stays: the collector need not look through it again
        clock = Clock(started, OBSERVER_SECONDS if observe else PROGRESS_SECONDS)
        if state is not None:
            resume(trainer, clock, state)
        checkpoint.require_plain(trainer.state_dict(), "state")  # not when it is late
        told = directory / files.PROGRESS
        observe = observe or (lambda progress: write_atomically(told, json.dumps(progress)))

        def save() -> None:
            with clock.saving():
                state = {"trainer": trainer.state_dict(), **clock.account()}
                checkpoint.save(directory / files.CHECKPOINT, identity, state)

        for records in trainer.run():
            if after_episode:
                for record in records:
                    after_episode(record)
            if not clock.start_seconds or len(trainer.records) <= START_SHARE * config.episodes:
                clock.start_seconds = time.monotonic() - started
            if clock.progress_due():
                observe(how_far(trainer, clock))
            if clock.checkpoint_due():
                save()
        if keep_checkpoint:
            save()
        write_results(directory, trainer, identity, clock)
        if not keep_checkpoint:
            (directory / files.CHECKPOINT).unlink(missing_ok=True)
        told.unlink(missing_ok=True)


def to_continue(
    config: RunConfig, identity: dict[str, Any], directory: Path, lock: int, aside: str
) -> dict[str, Any] | None:
    """The state to continue from; None to start afresh. From then on the folder is a run's.

    `lock` is its open lock file, which says so: what nobody knows to be a training's is refused.
    See `run` for what becomes of anything else. Raises `RunError` for what is refused.
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
            others = content["identity"] != identity
            other = f" {otherwise(content['identity'], identity, config)}" if others else ""
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
        for name in files.OF_A_RUN:  # half written by a process that was killed
            for half_written in directory.glob(f".{name}.[0-9]*.tmp"):
                half_written.unlink()
    if not os.fstat(lock).st_size:
        os.write(lock, CLAIM)
    return content["state"] if content else None


def resume(trainer: Trainer, clock: "Clock", state: dict[str, Any]) -> None:
    """Continue from the state in a checkpoint.

    An interruption is told by the episode after which the run was continued, the machine that had
    done the part before, and whether the environment played the last episodes before it again, as
    it should.
    """
    differs = resuming.replay_differs(trainer.environment, state["trainer"]["last_episodes"])
    trainer.load_state_dict(state["trainer"])  # also what the replay drew from
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

    def __init__(self, start: float, progress_seconds: float) -> None:
        self.start = start  # by `time.monotonic`, as if there had been no interruption
        self.start_seconds = 0.0  # of this process until its first episodes were over
        self.progress_seconds = progress_seconds
        self.next_progress = time.monotonic()
        self.between_checkpoints = between_checkpoints()
        self.next_checkpoint = time.monotonic() + self.between_checkpoints
        self.checkpoint_seconds = 0.0  # spent on checkpoints
        self.interruptions: list[dict[str, Any]] = []

    def account(self) -> dict[str, Any]:
        """What a checkpoint and `run.json` have of the training's course."""
        return {
            "seconds": self.elapsed(),
            "checkpoint_seconds": self.checkpoint_seconds,
            "interruptions": self.interruptions,
            "machine": provenance.machine(),
        }

    def elapsed(self) -> float:
        """Seconds of this run, those before interruptions included."""
        return time.monotonic() - self.start

    def progress_due(self) -> bool:
        """Whether `progress_seconds` have passed since this last returned True."""
        now = time.monotonic()
        if now < self.next_progress:
            return False
        self.next_progress = now + self.progress_seconds
        return True

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
    """Seconds, as MACE_RL_CHECKPOINT_SECONDS says if it is set; `RunError` for what cannot be."""
    said = os.environ.get(CHECKPOINT_VARIABLE)
    try:
        seconds = CHECKPOINT_SECONDS if said is None else float(said)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < math.inf:
        raise RunError(f"{CHECKPOINT_VARIABLE} is {said!r}, but should be a number of seconds")
    return seconds


@contextmanager
def single_threaded() -> Iterator[None]:
    """PyTorch on one thread as it begins, and nothing frozen for the collector; then as before."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode(False), torch.enable_grad(), torch.autocast("cpu", enabled=False):
            yield
    except SystemExit as error:
        raise RunError(f"code of a plugin ended the program: {error!r}") from error
    finally:
        torch.set_num_threads(threads)
        gc.unfreeze()


@contextmanager
def exclusive(directory: Path) -> Iterator[int]:
    """Hold the run's folder for this process, by a file; the lock goes with the process."""
    # A file of its own: a folder on a network's disk can be locked by two machines at once.
    with open(directory / files.LOCK, "a+b") as file:
        # A copy in an environment's worker would hold it when the training has ended.
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


def how_far(trainer: Trainer, clock: Clock) -> dict[str, Any]:
    """How far it is; `left` are the seconds to its end if its episodes stay as long as the last."""
    records = trainer.records
    recent = records[-50:]
    seconds = clock.elapsed()
    speed = records[-1].env_steps / max(1e-9, seconds - clock.start_seconds)
    to_come = trainer.config.episodes - len(records)
    return {
        "episode": len(records),
        "episodes": trainer.config.episodes,
        "recent_return": float(np.mean([record.extrinsic_return for record in recent])),
        "beta": records[-1].beta,
        "env_steps": records[-1].env_steps,
        "steps_per_second": speed,
        "left": to_come * float(np.mean([record.length for record in recent])) / speed,
        "seconds": seconds,
        "start_seconds": clock.start_seconds,
        "pid": os.getpid(),
    }


def write_results(
    directory: Path, trainer: Trainer, identity: dict[str, Any], clock: Clock
) -> None:
    """Write the records, the agent and, when those are safe, where they come from."""
    write_episodes(directory / files.EPISODES, as_columns(EpisodeRecord, trainer.records))
    write_diagnostics(directory / files.DIAGNOSTICS, trainer.diagnostics)
    agent = checkpoint.archive(Agent(trainer.ppo, trainer.environment.given_space).state_dict())
    write_atomically(directory / files.AGENT, agent)
    origin = identity | {
        "code": provenance.git_state(),
        "threads": torch.get_num_threads(),
        **clock.account(),
        "start_seconds": clock.start_seconds,
        "peak_memory_mb": provenance.peak_memory_mb(),
        "outputs": {name: provenance.file_digest(directory / name) for name in files.RESULTS},
    }
    write_atomically(
        directory / files.RECORD, json.dumps(origin, indent=2, ensure_ascii=False) + "\n"
    )
