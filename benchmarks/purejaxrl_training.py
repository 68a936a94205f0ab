"""One training of PureJaxRL, timed: `python -m benchmarks.purejaxrl_training FOLDER CONFIG SEED`.

Runs in the environment that `purejaxrl` makes, and prints the reading as JSON. FOLDER has ppo.py.
"""

import json
import os
import sys
import time
from importlib import import_module, metadata
from typing import Any
from unittest.mock import MagicMock

from benchmarks.process import memory_mb

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
    jax.block_until_ready(train(key))
    seconds, cpu_seconds = time.perf_counter() - seconds, time.process_time() - cpu_seconds
    steps = config["TOTAL_TIMESTEPS"]
    return {
        "target_steps": steps,
        "steps": steps,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "steps_per_second": steps / seconds,
        "peak_memory_mb": memory_mb("VmHWM"),
        "versions": ", ".join(f"{name} {metadata.version(name)}" for name in PACKAGES.split()),
    }


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3]))))
