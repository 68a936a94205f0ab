"""PureJaxRL's PPO beside ours and stable-baselines3's, steps and CPU time: purejaxrl.csv.

PureJaxRL trains in one compiled JAX program, environments included, and wants other packages than
this project: it has an environment of its own, made when it is first needed from purejaxrl.lock and
a clone at `COMMIT`. Where that cannot be made, one line says why, here and in purejaxrl.csv.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from benchmarks.process import THREADS, in_fresh_process, write_rows
from benchmarks.settings import ACROBOT, CARTPOLE, FIRST_SEED, REFERENCE, ROOT, Scale
from benchmarks.speed import measure, our_config, schedule, versions

ENVIRONMENTS = (CARTPOLE, ACROBOT)  # those that it has, too
# Its contestants: environments side by side, steps of each in a rollout, minibatches.
ROLLOUTS = {
    "purejaxrl_4x128": (4, 128, 4),  # its own setting
    "purejaxrl_32x64": (32, 64, 4),
    "purejaxrl_1x2048": (1, 2048, 1),  # like `REFERENCE` and ppo_2048
}
LABELS = {name: f"PureJaxRL PPO, {n} × {length}" for name, (n, length, _) in ROLLOUTS.items()}
OTHERS = (REFERENCE, "ppo_2048", "ppo", "mace_full")

ADDRESS = "https://github.com/luchris429/purejaxrl"  # PUREJAXRL names another, such as a folder
COMMIT = "31756b197773a52db763fdbe6d635e4b46522a73"
LOCK = ROOT / "benchmarks" / "purejaxrl.lock"
HOME = ROOT / ".venv-purejaxrl"
CLONE = HOME / "purejaxrl"
PYTHON = HOME / "bin" / "python"

# One thread, on the processor; nothing asks for a password.
VARIABLES = dict.fromkeys(THREADS, "1") | {
    "JAX_PLATFORMS": "cpu",
    "NPROC": "1",  # the size of XLA's thread pools
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "GIT_TERMINAL_PROMPT": "0",
}


class LeftOut(Exception):
    """Why there are no measurements of PureJaxRL, in one line."""


def measure_all(scale: Scale) -> None:
    """Measure everybody in turn and write purejaxrl.csv, anew after each; or why not."""
    data = scale.data / "purejaxrl.csv"
    try:
        set_up()
        rows: list[dict[str, Any]] = []
        for row in measurements(scale):
            rows.append(row)
            write_rows(data, rows)
            rate = row["steps"] / row["cpu_seconds"]
            print(f"{row['env']} {row['contestant']}: {rate:.0f} steps per CPU second", flush=True)
    except LeftOut as reason:
        write_rows(data, [{"left_out": str(reason)}])
        print(f"PureJaxRL is left out: {reason}", flush=True)


def measurements(scale: Scale) -> Iterator[dict[str, Any]]:
    """Rows of purejaxrl.csv, with the columns of results.csv."""
    from mace_rl.runs.provenance import cpu_model

    everybody = {environment: [*OTHERS, *ROLLOUTS] for environment in ENVIRONMENTS}
    for repeat, environment, contestant in schedule(scale.purejaxrl_repeats, everybody):
        seed = FIRST_SEED + repeat
        if contestant in ROLLOUTS:
            steps = scale.later_steps[environment]
            reading = train(configuration(contestant, environment, steps), seed)
            reading["versions"] = f"PureJaxRL {COMMIT[:7]}, {reading['versions']}"
        else:  # the reference's speed does not depend on when
            at = scale.steps if contestant == REFERENCE else scale.later_steps
            (reading,) = in_fresh_process(measure, contestant, environment, seed, [at[environment]])
            reading["versions"] = versions()
        identity = {"env": environment, "contestant": contestant, "repeat": repeat}
        yield identity | reading | {"cpu": cpu_model()}


def configuration(contestant: str, environment: str, steps: int) -> dict[str, Any]:
    """PureJaxRL's settings, by its names: ours of `ppo` wherever it has a name for them."""
    side_by_side, length, minibatches = ROLLOUTS[contestant]
    ours = our_config("ppo", environment, FIRST_SEED).ppo
    return {
        "ENV_NAME": environment,
        "TOTAL_TIMESTEPS": steps,
        "NUM_ENVS": side_by_side,
        "NUM_STEPS": length,
        "NUM_MINIBATCHES": minibatches,
        "LR": ours.actor_learning_rate,  # the critic's, too: it has one optimiser
        "ANNEAL_LR": False,
        "GAMMA": ours.discount,
        "UPDATE_EPOCHS": ours.epochs,
        "CLIP_EPS": ours.clip,
        "GAE_LAMBDA": ours.gae_lambda,
        "ENT_COEF": ours.entropy_coefficient,
        "MAX_GRAD_NORM": ours.max_gradient_norm,
        "VF_COEF": 0.5,  # its own
        "ACTIVATION": "tanh",  # between layers of 64 and 64, as it has them
    }


def train(config: dict[str, Any], seed: int) -> dict[str, Any]:
    """The reading of one training, compiled beforehand, in a process of its environment."""
    arguments = (str(CLONE / "purejaxrl"), json.dumps(config), str(seed))
    command = (str(PYTHON), "-m", "benchmarks.purejaxrl_training", *arguments)
    return json.loads(carry_out("its training failed", *command).splitlines()[-1])


def set_up() -> None:
    """Make `HOME`, unless it is there, complete, and of this lock, commit and folder."""
    made_of = f"{HOME}\n{COMMIT}\n{LOCK.read_text(encoding='utf-8')}"
    complete = HOME / f"complete-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"
    if complete.exists():
        return
    print(f"Setting up {HOME.name} (once: 800 MB) ...", flush=True)
    shutil.rmtree(HOME, ignore_errors=True)
    source = os.environ.get("PUREJAXRL") or ADDRESS
    fetching = f"its code cannot be had from {source} (PUREJAXRL can name a clone)"
    carry_out(fetching, "git", "clone", "--quiet", "--no-checkout", source, str(CLONE))
    carry_out(fetching, "git", "-C", str(CLONE), "checkout", "--quiet", "--detach", COMMIT)
    carry_out("its environment cannot be made", sys.executable, "-m", "venv", str(HOME))
    pip = (str(PYTHON), "-m", "pip", "install", "--no-deps", "--only-binary=:all:", "--no-compile")
    carry_out("its packages cannot be had", *pip, "--require-hashes", "-r", str(LOCK))
    complete.touch()


def carry_out(failure: str, *command: str) -> str:
    """What the command prints; if it fails, `LeftOut` says `failure` and what it complained of."""
    try:
        done = subprocess.run(
            command,
            cwd=ROOT,
            env=os.environ | VARIABLES,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
    except OSError as error:
        raise LeftOut(f"{failure}: {error}") from None
    if done.returncode:
        said = done.stderr.split("\n") if done.stderr.strip() else [f"exit code {done.returncode}"]
        errors = [line for line in said if line.startswith(("fatal:", "ERROR:"))]
        complaint = (errors or [line for line in said if line.strip()])[-1]
        raise LeftOut(f"{failure}: {complaint.strip()}")
    return done.stdout
