# Around the jobs: one Snakemake at a time in a results folder, and what the terminal says of them.

import textwrap

from mace_study.around_jobs import occupy, outcome
from snakemake.logging import LogEvent, logger

# When Snakemake 9.27.1 is killed its jobs go on, so they end with it: workflow/scripts/job.py. On a
# cluster that is the Snakemake on the node, which reads this too, and not the one that submitted.
os.environ.update(MACE_RL_SNAKEMAKE_PID=str(os.getpid()))
# There several runs share a job. If that ends in the middle, Snakemake deletes the results of those
# that were done, too, and they come back from their last checkpoints.
if workflow.remote_exec:
    os.environ.update(MACE_RL_KEEP_CHECKPOINTS="yes")


def in_short(record):
    """Let Snakemake say in a line which job begins, and why one failed.

    Snakemake 9.27.1 lists all inputs of a job, thousands for a study's metrics, or with `quiet:
    rules` not even failures; and of a failed script it does not say what its log has.
    """
    event = getattr(record, "event", None)
    if event == LogEvent.JOB_INFO and not workflow.dryrun:
        record.rule_msg = " ".join([record.rule_name, *record.wildcards.values()])
        record.reason = textwrap.shorten(record.reason, 100, placeholder=" ...")
    elif event == LogEvent.JOB_ERROR:
        record.input = record.output = []
        logs = [log for log in map(Path, record.log[:1]) if log.exists()]
        last = [line for log in logs for line in log.read_text(errors="replace").splitlines()[-1:]]
        said = [record.rule_msg, *(f"its log ends: {line}" for line in last)]
        record.rule_msg = "; ".join(filter(None, said)) or "it has no log"
    elif str(record.msg).startswith(LAST) and workflow.is_main_process and not workflow.dryrun:
        record.msg = f"{record.msg}\n{last_words()}"
    return True


def last_words():
    jobs, targets = workflow.dag.jobs, workflow.dag.targetjobs
    wanted, asked = ({str(path) for job in own for path in job.output} for own in (jobs, targets))
    of_all = {str(path) for job in targets if not job.output for path in job.input}
    return outcome(plan, wanted, asked, of_all)


LAST = ("Nothing to be done",)  # with which Snakemake ends; `onsuccess` knows another
logger.addFilter(in_short)


def asked_for():
    """The runs that are asked for, of which some are due, for `mace-rl status`."""
    due = set(workflow.dag.needrun_jobs())
    jobs = [job for job in workflow.dag.jobs if job.rule.name == "train"]
    return [
        {**job.wildcards_dict, "work": plan.work[run_of(job.wildcards)[:2]], "due": job in due}
        for job in jobs
    ]


def make_room():
    """Set finished runs aside where they are to be trained anew; stop if they are another study's.

    Snakemake deletes what a job makes before it begins.
    """
    due = [job for job in workflow.dag.needrun_jobs() if job.rule.name == "train"]
    folders = [Path(RUN.format(**job.wildcards_dict)) for job in due]
    configs = [run_config(job.wildcards).settings() for job in due]
    found = in_the_way(zip(folders, configs))
    others = {folder: why for folder, why in found.items() if why}
    on_purpose = workflow.dag_settings.forceall or workflow.dag_settings.forcerun
    if others and not (study.replace or on_purpose):
        [(folder, why), *more] = others.items()
        sys.exit(
            f"Error: {folder} holds a finished run with other settings ({why})"
            f"{f', like {len(more)} more' if more else ''}: give this study a folder of its own,"
            " as in --config results=NAME, or replace them on purpose, --config replace=true"
        )
    for folder in found:
        there = [name for name in (*files.RESULTS, files.RECORD) if (folder / name).exists()]
        logger.info(f"set aside: {files.set_aside(folder, there)}")


onstart:
    global lock
    lock = occupy(RESULTS)
    if workflow.executor_plugin.name != "touch":
        make_room()
    planned = {"cores": workflow.cores if workflow.local_exec else None, "runs": asked_for()}
    os.makedirs(f"{RESULTS}/logs", exist_ok=True)
    files.write_atomically(f"{RESULTS}/{files.PLAN}", json.dumps(planned))
    for line in plan.remarks(registered()):
        logger.info(line)
    due, runs = sum(run["due"] for run in planned["runs"]), len(planned["runs"])
    if runs and workflow.executor_plugin.name != "touch":
        to_train = f"{due} of {runs} runs to train"
        logger.info(f"{to_train}; how far they are: mace-rl status {RESULTS}")


onsuccess:
    global LAST
    LAST += ("Elapsed time: ",)
    for folder in map(Path, plan.folders):
        # Not of an unfinished run, which was not asked for this time.
        if (folder / files.RECORD).exists():
            (folder / files.CHECKPOINT).unlink(missing_ok=True)
