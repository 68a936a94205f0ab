"""One training of PureJaxRL, timed: `python -I purejaxrl_training.py FOLDER CONFIG SEED`.

A script of the environment that `benchmarks.purejaxrl` makes; it imports nothing of this project,
and prints the reading as JSON. FOLDER has PureJaxRL's ppo.py.
"""

import json
import os
import re
import sys
import time
from importlib import import_module, metadata
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

# Simulators of environments that are not measured here: wrappers.py imports them all the same.
UNUSED = "brax brax.envs brax.envs.wrappers brax.envs.wrappers.training navix"
PACKAGES = "jax jaxlib flax optax distrax gymnax"


def measure(folder: str, config: dict[str, Any], seed: int) -> dict[str, Any]:
    """The reading of a training from scratch, after one with another seed as a warm-up.

    Not timed: imports, compilation. Timed: the compiled program from the first reset to its end.
    """
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before JAX counts the cores
    import jax

    sys.modules |= {name: MagicMock() for name in UNUSED.split()}
    sys.path.insert(0, folder)
    program = jax.jit(import_module("ppo").make_train(config))
    key = jax.random.PRNGKey(seed)
    train = program.lower(key).compile()
    jax.block_until_ready(train(jax.random.PRNGKey(seed + 10**6)))
    seconds, cpu_seconds = time.perf_counter(), time.process_time()
    outcome = jax.block_until_ready(train(key))
    seconds, cpu_seconds = time.perf_counter() - seconds, time.process_time() - cpu_seconds
    [peak] = re.findall(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text(encoding="ascii"))
    return {
        "steps": outcome["metrics"]["returned_episode"].size,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "memory_mb": int(peak) / 1024,
        "note": ", ".join(f"{name} {metadata.version(name)}" for name in PACKAGES.split()),
    }


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3]))))
