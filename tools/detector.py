"""What sets β, given invented credits of which it is known what β should do.

    .venv/bin/python -m tools.detector [--streams 200]

A stream has 1500 credits, as many as a training of 1500 episodes, each with noise of size 1. They
judge βs by what the meta network read: 32 rows of random numbers, of which the first says which of
two kinds of episodes it was. Printed is the share of streams in which β ends, or stays all along,
where it should: above 0.8 if more β helps, below 0.1 if it harms, from 0.2 to 0.6 without signal.
"""

import argparse
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import NamedTuple

import mace_rl.base.cpu_features  # noqa: F401  # isort: skip

import numpy as np

from mace_rl.beta.credit import Integrator
from mace_rl.beta.meta import Evidence
from mace_rl.beta.network import CompiledMetaNetwork
from mace_rl.beta.squash import beta_of, logit
from mace_rl.config.run import RunConfig
from mace_rl.library import settings

CREDITS, SIZE, ROWS = 1500, 6, 32
SIGNAL = 0.1  # mean of a credit that has one, over its noise; 0.2 where the signal changes
START = logit(0.4)


class Stream(NamedTuple):
    """Credits and the sequences that they judge."""

    sequences: np.ndarray  # float32 [CREDITS, ROWS, SIZE]
    kinds: np.ndarray  # ±1, [CREDITS]
    credits: np.ndarray  # [CREDITS]


def stream(signal: Callable[[np.ndarray, np.ndarray], np.ndarray], seed: int) -> Stream:
    """One with the mean credits that `signal` has of time, from 0 to 1, and kinds, [CREDITS]."""
    rng = np.random.default_rng(seed)
    sequences = rng.standard_normal((CREDITS, ROWS, SIZE)).astype(np.float32)
    kinds = rng.choice([-1, 1], CREDITS)
    sequences[:, :, 0] = kinds[:, None]
    means = signal(np.arange(CREDITS) / CREDITS, kinds)
    credits = np.clip(means + rng.standard_normal(CREDITS), -3, 3)
    return Stream(sequences, kinds, credits)


def of_network(given: Stream, config: RunConfig, seed: int) -> np.ndarray:
    """β before each credit, [CREDITS], by the meta network."""
    assert config.meta is not None
    network = CompiledMetaNetwork(config.meta, SIZE, np.random.default_rng(seed))
    evidence, betas = Evidence(config.meta), np.empty(CREDITS)
    for n, (sequence, credit) in enumerate(zip(given.sequences, given.credits, strict=True)):
        read = sequence if config.meta.reads else np.zeros_like(sequence[:1])
        output = network.output(read)
        betas[n] = beta_of(START + evidence.logit(output))
        evidence.add(float(credit), output)
        network.learn([read], float(credit))
    return betas


def of_integrator(given: Stream, config: RunConfig, seed: int) -> np.ndarray:
    """The same by the sum of all credits, `mace_credit`."""
    assert config.pretrained is not None
    integrator, betas = Integrator(config.pretrained), np.empty(CREDITS)
    for n, credit in enumerate(given.credits):
        betas[n] = beta_of(START + integrator.logit)
        integrator.add(float(credit), (n + 1) / CREDITS)
    return betas


def late(betas: np.ndarray, given: Stream, kind: int = 0) -> float:
    """Mean β of the last tenth, of one kind of episodes or all."""
    chosen = np.arange(CREDITS) >= 0.9 * CREDITS
    if kind:
        chosen &= given.kinds == kind
    return float(betas[chosen].mean())


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--streams", type=int, default=200, help="default: %(default)s")
    count = parser.parse_args().streams
    if count < 1:
        parser.error(f"--streams is {count}, but should be at least 1")
    of_meta = {
        "network": {},
        "a constant input": {"reads": False},
        "without trust": {"trusts_evidence": False},
    }
    who = {
        name: partial(of_network, config=settings("CartPole-v1", "mace_full", meta=changes))
        for name, changes in of_meta.items()
    }
    pretrained = settings("CartPole-v1", "mace_pretrained")
    who["the sum of credits"] = partial(of_integrator, config=pretrained)
    problems = {
        "helps": lambda time, kinds: np.full(CREDITS, SIGNAL),
        "harms": lambda time, kinds: np.full(CREDITS, -SIGNAL),
        "nothing": lambda time, kinds: np.zeros(CREDITS),
        "mixed": lambda time, kinds: 2 * SIGNAL * kinds,
        "turns": lambda time, kinds: np.where(time < 0.5, 2 * SIGNAL, -2 * SIGNAL),
    }
    columns = (
        *("helps: ends above 0.8", "harms: ends below 0.1", "nothing: ends in 0.2 to 0.6"),
        *("nothing: stays there", "mixed: β of one kind, of the other", "turns: β before, after"),
    )
    print("| |", " | ".join(columns), "|")
    print("|---|" + "--:|" * len(columns))
    for name, betas_of in who.items():
        found = {}
        for problem, seed in product(problems, range(count)):
            given = stream(problems[problem], seed)
            found[problem, seed] = betas_of(given, seed=seed), given
        ends = {
            problem: np.array([late(*found[problem, seed]) for seed in range(count)])
            for problem in problems
        }
        inside = [
            ((found["nothing", seed][0] >= 0.2) & (found["nothing", seed][0] <= 0.6)).all()
            for seed in range(count)
        ]
        kinds = [
            np.mean([late(*found["mixed", seed], kind) for seed in range(count)])
            for kind in (1, -1)
        ]
        half = slice(CREDITS // 2 - CREDITS // 20, CREDITS // 2)
        before = np.mean([found["turns", seed][0][half].mean() for seed in range(count)])
        cells = [
            f"{(ends['helps'] > 0.8).mean():.2f}",
            f"{(ends['harms'] < 0.1).mean():.2f}",
            f"{((ends['nothing'] >= 0.2) & (ends['nothing'] <= 0.6)).mean():.2f}",
            f"{np.mean(inside):.2f}",
            f"{kinds[0]:.2f}, {kinds[1]:.2f}",
            f"{before:.2f}, {ends['turns'].mean():.2f}",
        ]
        print("|", " | ".join([name, *cells]), "|", flush=True)


if __name__ == "__main__":
    main()
