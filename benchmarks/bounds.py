"""What a training cannot be faster than: its products and distances, and what it moves.

Arithmetic: the operations of matrix products (columns padded to 16) and k-NN distances, at the rate
of our product of two 64 × 64 matrices. Traffic: bytes that pass between the nearest cache and the
next, at the rate at which our `dot` reads 256 KB. Neither includes tanh, exp, Adam's roots and
simulators. Traffic counts as if nothing were computed meanwhile.
"""

import math
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit

from mace_rl.agent import compiled_learner
from mace_rl.numerics.matmul import dot, product
from mace_rl.numerics.nearest import Neighbours
from mace_rl.numerics.network import CompiledMLP
from mace_rl.numerics.network_kernels import FEW

BOUNDS = ("arithmetic", "traffic")
NUMBER = 4  # bytes of a float32
VECTOR = 2**15  # numbers: two of them are 256 KB
OF_ADAM = 7  # reads and writes of a step, of each parameter


class Work:
    """The operations of a training, and its bytes beyond the nearest cache."""

    def __init__(self) -> None:
        self.operations = self.bytes = 0.0

    def network(self, sizes: Any, rows: int, forward: int = 1, backward: int = 0) -> None:
        """So many passes of `rows` through a network; a single row stays in the nearest cache."""
        layers = [(int(ins), math.ceil(outs / 16) * 16) for ins, outs in pairwise(sizes)]
        one = sum(2 * ins * outs for ins, outs in layers)
        hidden = sum(2 * int(ins) * int(outs) for ins, outs in pairwise(sizes[1:]))
        # The weights' gradient of a narrow last layer is computed along its inputs.
        ins, outs = layers[-1]
        unpadded = 2 * ins * (outs - int(sizes[-1])) if sizes[-1] <= FEW else 0
        self.operations += rows * (forward * one + backward * (one + hidden - unpadded))
        if rows > 1:
            blocks = math.ceil(rows / compiled_learner.BLOCK)
            parameters = sum((ins + 1) * outs for ins, outs in layers)
            # Backward: what forward moves, and the gradients of both, which are read and written.
            moved = blocks * parameters + rows * sum(outs for _, outs in layers)
            self.bytes += NUMBER * moved * (forward + 3 * backward)

    def update(self, minibatches: Any, sizes: Any, adam: Any) -> None:
        """All epochs of a network's update."""
        epochs, rows = minibatches.epochs.shape
        self.network(sizes, rows, epochs, epochs)
        steps = epochs * len(minibatches.ends)
        self.bytes += NUMBER * OF_ADAM * steps * len(adam.parameters)

    def search(self, queries: int, points: int, size: int) -> None:
        """Each dimension of a distance: a difference, and a fused multiply-add."""
        self.operations += 3 * queries * points * size
        self.bytes += NUMBER * queries * points * size

    def watch(self, trainer: Any) -> None:
        """Count what a new trainer does; for good, so in a process of its own."""
        sizes = trainer.ppo.policy.network.sizes
        counted(trainer, "play", lambda episode, *_: self.network(sizes, 1, len(episode)))
        counted(
            compiled_learner,
            "update_policy",
            lambda _, batch, order, sizes, *rest: self.update(order, sizes, rest[-2]),
        )
        counted(
            compiled_learner,
            "update_critic",
            lambda _, seen, returns, order, sizes, adam: self.update(order, sizes, adam),
        )
        counted(
            compiled_learner,
            "policy_gradients",
            lambda found, seen, *_: self.network(sizes, len(seen), 1, len(found)),
        )
        for name in ("forward", "outputs"):
            counted(CompiledMLP, name, lambda _, own, x: self.network(own.sizes, len(x)))
        counted(
            CompiledMLP,
            "backward",
            lambda _, own, trace, grad: self.network(own.sizes, len(grad), 0, 1),
        )
        counted(
            Neighbours,
            "nearest",
            lambda _, own, x, count: self.search(len(x), len(own), x.shape[1]),
        )

    def seconds(self) -> dict[str, float]:
        """By `BOUNDS`, at this core's rates."""
        operations, moved = core_rates()
        return {"arithmetic": self.operations / operations, "traffic": self.bytes / moved}


def counted(owner: Any, name: str, count: Callable[..., None]) -> None:
    """Replace a function by itself, and a call of `count` with its result and arguments."""
    function = getattr(owner, name)

    def and_count(*arguments: Any) -> Any:
        result = function(*arguments)
        count(result, *arguments)
        return result

    setattr(owner, name, and_count)


def core_rates() -> tuple[float, float]:
    """Operations a second of a product in the nearest cache, bytes a second from the next one."""
    matrix, vector = np.full((64, 64), 0.01, np.float32), np.ones(VECTOR, np.float32)
    operands = matrix, matrix.copy(), matrix[0].copy(), matrix.copy()
    product_seconds = best_seconds(multiply, *operands)
    return 2 * 64**3 / product_seconds, 2 * vector.nbytes / best_seconds(
        read, vector, vector.copy()
    )


def best_seconds(function: Callable[..., Any], *arguments: Any, times: int = 2000) -> float:
    """Of one of so many calls in compiled code, the best of five measurements."""
    function(*arguments, 1)
    found = []
    for _ in range(5):
        start = time.process_time()
        function(*arguments, times)
        found.append((time.process_time() - start) / times)
    return min(found)


@njit
def multiply(a, b, start, c, times):
    for _ in range(times):
        product(a, b, start, c)


@njit
def read(a, b, times):
    total = np.float32(0)
    for _ in range(times):
        total += dot(a, b)
    return total
