"""What portable arithmetic costs one update, library by library: update.csv.

Trainings with other bits have other episodes; here everybody computes the same, on fixed arrays:
one minibatch of PPO in CartPole. In each process one library, or all, or none, may use the widest
instructions that the processor has.
"""

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from benchmarks.process import THREADS, write_rows
from benchmarks.settings import ROOT, Scale
from mace_rl import arithmetic

# For each kind the variables of `arithmetic.PORTABLE` that are taken away.
KINDS = {
    "portable": (),
    "native": tuple(arithmetic.PORTABLE),
    "BLAS native": ("OPENBLAS_CORETYPE",),
    "numba native": ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"),
}
PRODUCTS = "products of 64 × 64, as in forward and backward"
OWN_PRODUCTS = "products of 64 × 64, loops of our own"
STATES, SIZES = 250, (4, 64, 64, 2)  # half an episode of 500 steps is a minibatch
ROUNDS, CALLS = 30, 50  # the fastest of so many rounds of so many calls counts


def measure_all(scale: Scale) -> None:
    """Measure everything `scale.repeats` times, every other time in the other order."""
    rows: list[dict[str, Any]] = []
    for repeat in range(scale.repeats):
        for kind in KINDS if repeat % 2 else reversed(KINDS):
            command = [sys.executable, "-m", "benchmarks.update", kind]
            environment = os.environ | dict.fromkeys(THREADS, "1")
            environment[arithmetic.VARIABLE] = "portable"  # from which the others take away
            done = subprocess.run(
                command, cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True
            )
            rows += [{"repeat": repeat, "kind": kind} | row for row in json.loads(done.stdout)]
            print(repeat, kind, flush=True)
            write_rows(scale.data / "update.csv", rows)


def measure() -> list[dict[str, Any]]:
    """For each part of an update its µs of CPU time and a digest of what it computed."""
    rows = []
    for name, (compute, results) in parts().items():
        compute()
        digest = hashlib.sha256(b"".join(result.tobytes() for result in results())).hexdigest()
        rounds = []
        for _ in range(ROUNDS):
            start = time.process_time()
            for _ in range(CALLS):
                compute()
            rounds.append((time.process_time() - start) / CALLS * 1e6)
        rows.append({"part": name, "microseconds": min(rounds), "digest": digest[:16]})
    return rows


def parts() -> dict[str, tuple[Callable[[], Any], Callable[[], list[Any]]]]:
    """What is timed, by name, and what gives the arrays that it computed."""
    import numpy as np

    from mace_rl.agent import kernels
    from mace_rl.agent.adam import adam

    @kernels.kernel
    def by_library(inputs, weights, grad, outputs, grad_inputs, grad_weights):
        np.dot(inputs, weights, outputs)
        np.dot(grad, weights.T, grad_inputs)
        np.dot(inputs.T, grad, grad_weights)

    @kernels.kernel
    def multiply(a, b, out):
        # One order of sums, whatever the processor; eight terms for each pass over a row of `out`.
        out[:] = 0
        whole = a.shape[1] - a.shape[1] % 8
        for n in range(a.shape[0]):
            row = out[n]
            for k in range(0, whole, 8):
                p, q, r, s = a[n, k], a[n, k + 1], a[n, k + 2], a[n, k + 3]
                t, u, v, w = a[n, k + 4], a[n, k + 5], a[n, k + 6], a[n, k + 7]
                for j in range(b.shape[1]):
                    total = row[j] + p * b[k, j] + q * b[k + 1, j] + r * b[k + 2, j]
                    total = total + s * b[k + 3, j] + t * b[k + 4, j] + u * b[k + 5, j]
                    row[j] = total + v * b[k + 6, j] + w * b[k + 7, j]
            for k in range(whole, a.shape[1]):
                for j in range(b.shape[1]):
                    row[j] += a[n, k] * b[k, j]

    @kernels.kernel
    def by_loops(inputs, weights, grad, outputs, grad_inputs, grad_weights):
        multiply(inputs, weights, outputs)
        multiply(grad, np.ascontiguousarray(weights.T), grad_inputs)
        multiply(inputs.T, grad, grad_weights)

    generator = np.random.default_rng(0)

    def random(*shape: int) -> np.ndarray:
        return generator.standard_normal(shape).astype(np.float32)

    sizes = np.array(SIZES)
    parameters = 0.15 * random(int(((sizes[:-1] + 1) * sizes[1:]).sum()))
    activations = (random(STATES, SIZES[0]), *(random(STATES, size) for size in SIZES[1:]))
    kernels.network_outputs(activations, parameters, sizes)
    logits, advantages = activations[-1], random(STATES)
    actions = generator.integers(0, SIZES[-1], STATES)
    acted = kernels.categorical_log_probs(logits, actions)
    grad_logits, _ = kernels.categorical_grad(logits, actions, advantages, 0.0)
    gradient = kernels.network_gradient(activations, grad_logits, parameters, sizes)
    learned = [parameters.copy(), np.zeros_like(parameters), np.zeros_like(parameters)]
    products = [random(STATES, 64), random(64, 64), random(STATES, 64)]
    products += [random(STATES, 64), random(STATES, 64), random(64, 64)]

    def surrogate() -> list[Any]:
        log_probs = kernels.categorical_log_probs(logits, actions)
        weights, *_ = kernels.surrogate_weights(log_probs, acted, advantages, 0.2)
        return [weights, kernels.categorical_grad(logits, actions, weights, 0.0)[0]]

    def backward() -> list[Any]:
        return [kernels.network_gradient(activations, grad_logits, parameters, sizes)]

    return {
        "forward": (
            lambda: kernels.network_outputs(activations, parameters, sizes),
            lambda: list(activations),
        ),
        "surrogate, its gradient at the logits": (surrogate, surrogate),
        "backward": (backward, backward),
        "Adam": (
            lambda: adam(learned[0], gradient, learned[1], learned[2], 5, 3e-4),
            lambda: learned,
        ),
        PRODUCTS: (lambda: by_library(*products), lambda: products[3:]),
        OWN_PRODUCTS: (lambda: by_loops(*products), lambda: products[3:]),
    }


if __name__ == "__main__":  # importing mace_rl has set the variables, and nothing has read them yet
    assert "numpy" not in sys.modules, "NumPy was loaded before its variables were taken away"
    for name in KINDS[sys.argv[1]]:
        del os.environ[name]
    print(json.dumps(measure()))
