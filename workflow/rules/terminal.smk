# Around the jobs: one Snakemake at a time in a results folder, and a terminal that shows progress.

import fcntl
import platform
from types import SimpleNamespace

from snakemake.logging import logger
from snakemake_logger_plugin_mace_rl import Run, Study

# A job ends when the Snakemake that started it does, even by SIGKILL: workflow/scripts/job.py. On a
# cluster that is the Snakemake on the node, which reads this too, and not the one that submitted.
os.environ.update(MACE_RL_SNAKEMAKE_PID=str(os.getpid()))
# There several runs share a job. If that ends in the middle, Snakemake deletes the results of those
# that were done, too, and they come back from their last checkpoints.
if workflow.remote_exec:
    os.environ.update(MACE_RL_KEEP_CHECKPOINTS="yes")


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
    """Every run of the study, as what the terminal shows needs it."""
    for env, variant, seed, episodes in TRAININGS:
        wildcards = {"env": env, "variant": variant, "seed": str(seed)}
        work = most_work(SimpleNamespace(**wildcards))
        yield Run(*wildcards.values(), episodes, work, RUN.format(**wildcards))


onstart:
    global lock
    lock = occupy(RESULTS)
    # Snakemake tells its loggers how many jobs there will be, but not which.
    jobs = [job for job in workflow.dag.needrun_jobs() if job.rule.name == "train"]
    due = [tuple(job.wildcards_dict.values()) for job in jobs]
    cores = workflow.cores if workflow.local_exec else None
    watched = Study(watched_runs(), due, cores, workflow.execution_settings.retries)
    for line in study.metrics.incomplete(study.environments):
        logger.info(line)
    if HAS_PAPERS and not TESTS_CLAIMS:
        logger.info(
            "claims.json and claims.md are left out: they need metrics.reference_return of every environment"
        )
    told = {"study": watched, "quietness": Quietness.PROGRESS}
    logger.info(f"{len(due)} of {len(RUNS)} runs to train", extra=told)


onsuccess:
    for folder in {Path(episodes).parent for episodes in EPISODES}:
        # Not of an unfinished run, which was not asked for this time.
        if (folder / files.RECORD).exists():
            (folder / files.CHECKPOINT).unlink(missing_ok=True)
