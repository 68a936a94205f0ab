# Around the jobs: one Snakemake at a time in a results folder, and a terminal that shows progress.

import fcntl
import platform

from snakemake.logging import logger
from snakemake_interface_logger_plugins.common import LogEvent

from mace_rl import progress

# A job ends when the Snakemake that started it does, even by SIGKILL: workflow/scripts/job.py.
os.environ.update(MACE_RL_SNAKEMAKE_PID=str(os.getpid()))

# What Snakemake says of each job when all goes well; it stays in the log that is named at the end.
ROUTINE = {
    LogEvent.JOB_INFO,
    LogEvent.JOB_STARTED,
    LogEvent.JOB_FINISHED,
    LogEvent.PROGRESS,
    LogEvent.RESOURCES_INFO,
}


def of_interest(record):
    message = str(record.msg)
    return not (
        getattr(record, "event", None) in ROUTINE
        or message.startswith("Select jobs to execute")
        # The script of the job has said why, and Snakemake goes on to say which job it was.
        or message.endswith(("returned non-zero exit status 1.", "exit status 130."))
    )


def occupy(folder):
    """Keep other Snakemakes out of `folder` as long as this process lives.

    Snakemake's own lock, which profiles/default/config.yaml turns off, outlives a kill.
    """
    try:
        os.makedirs(folder, exist_ok=True)
        lock = open(f"{folder}/.lock", "a+", encoding="utf-8")
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.seek(0)
        sys.exit(f"Error: {lock.read() or 'another Snakemake'} is at work in {folder}; wait for it")
    except OSError as error:
        sys.exit(f"Error: the results folder {folder} cannot be used: {error.strerror}")
    lock.truncate(0)
    lock.write(f"Snakemake (process {os.getpid()} on {platform.node()})")
    lock.flush()
    return lock


def watched_runs():
    """Every run of the study; those that this Snakemake is to carry out are due."""
    due = {job.output.record for job in workflow.dag.needrun_jobs() if job.rule.name == "train"}
    for env, variant, seed, episodes in BUDGETS:
        folder = RUN.format(env=env, variant=variant, seed=seed)
        yield progress.Run(env, variant, seed, episodes, folder, f"{folder}/run.json" in due)


def stop_monitor():
    if monitor:
        progress.stop(monitor)


monitor = None


onstart:
    global lock, monitor
    lock = occupy(RESULTS)
    for handler in logger.handlers:
        if handler.name == "DefaultStreamHandler":
            handler.addFilter(of_interest)
    runs = list(watched_runs())
    if any(run.due for run in runs):
        monitor = progress.start(runs, workflow.cores or 1, workflow.local_exec)


onsuccess:
    stop_monitor()


onerror:
    stop_monitor()
