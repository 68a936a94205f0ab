"""PureJaxRL's PPO beside ours and stable-baselines3's, in turn, in the environments it has, too.

PureJaxRL (Apache-2.0) trains in one compiled JAX program, environments included, and wants other
packages than this project: it has an environment of its own, made of purejaxrl.lock and a clone of
its code at `COMMIT` when it is first needed. Where one of these cannot be had, a line says why,
here and in measurements.csv.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks import speed
from benchmarks.measuring import ACROBOT, CARTPOLE, FIRST_SEED, ROOT, THREADS, Scale
from benchmarks.speed import OURS, REFERENCE, our_config

ENVIRONMENTS = (CARTPOLE, ACROBOT)
# Its contestants: environments side by side, steps of each in a rollout, minibatches.
ROLLOUTS = {
    "purejaxrl_4x128": (4, 128, 4),  # its own setting
    "purejaxrl_32x64": (32, 64, 4),
    "purejaxrl_1x2048": (1, 2048, 1),  # like `REFERENCE` and ppo_2048
}
LABELS = {name: f"PureJaxRL PPO, {n} × {length}" for name, (n, length, _) in ROLLOUTS.items()}

ADDRESS = "https://github.com/luchris429/purejaxrl"  # PUREJAXRL names another, such as a folder
COMMIT = "31756b197773a52db763fdbe6d635e4b46522a73"
LOCK = ROOT / "benchmarks" / "purejaxrl.lock"
HOME = ROOT / ".venv-purejaxrl"
CLONE = HOME / "purejaxrl"
PYTHON = HOME / "bin" / "python"

# One thread, on the processor.
VARIABLES = dict.fromkeys(THREADS, "1") | {
    "JAX_PLATFORMS": "cpu",
    "NPROC": "1",  # the size of XLA's thread pools
    # After what is set from outside, such as --xla_cpu_max_isa=AVX2.
    "XLA_FLAGS": os.environ.get("XLA_FLAGS", "")
    + " --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "GIT_TERMINAL_PROMPT": "0",  # nothing asks for a password
}


class LeftOut(Exception):
    """Why PureJaxRL cannot be had here, in one line."""


def measure(scale: Scale) -> list[dict[str, Any]]:
    """A row for each reading, or one that says why there are none.

    Only what has to be fetched can be left out: a training that fails ends the benchmark.
    """
    try:
        set_up()
    except LeftOut as reason:
        print(f"PureJaxRL is left out: {reason}", flush=True)
        return [{"note": str(reason)}]
    everybody = {environment: [REFERENCE, *OURS, *ROLLOUTS] for environment in ENVIRONMENTS}
    return speed.in_turn(scale, everybody, reading)


def reading(contestant: str, environment: str, seed: int, steps: int) -> dict[str, Any]:
    """Of one training, compiled beforehand, in a process of its own."""
    if contestant not in ROLLOUTS:
        return speed.reading(contestant, environment, seed, steps)
    return train(configuration(contestant, environment, steps), seed)


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
    """What purejaxrl_training.py prints, a script of PureJaxRL's environment.

    -I: nothing of this project can be imported there, nor is needed.
    """
    script = str(Path(__file__).with_name("purejaxrl_training.py"))
    arguments = (str(CLONE / "purejaxrl"), json.dumps(config), str(seed))
    said = carry_out("PureJaxRL's training failed", str(PYTHON), "-I", script, *arguments)
    return json.loads(said.splitlines()[-1])


def set_up() -> None:
    """Make `HOME`, unless it is there, complete, and of this place, lock and commit.

    `LeftOut` if its code or its packages cannot be had.
    """
    made_of = f"{HOME}\n{COMMIT}\n{LOCK.read_text(encoding='utf-8')}"
    complete = HOME / f"complete-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"
    if complete.exists():
        return
    print(f"Setting up {HOME.name} (once: 800 MB) ...", flush=True)
    shutil.rmtree(HOME, ignore_errors=True)
    source = os.environ.get("PUREJAXRL") or ADDRESS
    fetching = f"its code cannot be had from {source} (PUREJAXRL can name a clone)"
    git = ("git", "clone", "--quiet", "--no-checkout", source, str(CLONE))
    carry_out(fetching, *git, error=LeftOut)
    checkout = ("git", "-C", str(CLONE), "checkout", "--quiet", "--detach", COMMIT)
    carry_out(fetching, *checkout, error=LeftOut)
    carry_out("its environment cannot be made", sys.executable, "-m", "venv", str(HOME))
    pip = (str(PYTHON), "-m", "pip", "install", "--no-deps", "--only-binary=:all:", "--no-compile")
    failure = "its packages cannot be had"
    carry_out(failure, *pip, "--require-hashes", "-r", str(LOCK), error=LeftOut)
    complete.touch()


def carry_out(failure: str, *command: str, error: type[BaseException] = SystemExit) -> str:
    """What the command prints; if it fails, `error` says `failure` and what it complained of."""
    # GIT_DIR and the like would let git work in another repository than the clone.
    own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    variables = own | VARIABLES
    done = subprocess.run(
        command, cwd=ROOT, env=variables, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    if done.returncode:
        said = done.stderr.split("\n") if done.stderr.strip() else [f"exit code {done.returncode}"]
        errors = [line for line in said if line.startswith(("fatal:", "ERROR:"))]
        complaint = (errors or [line for line in said if line.strip()])[-1]
        raise error(f"{failure}: {complaint.strip()}")
    return done.stdout
