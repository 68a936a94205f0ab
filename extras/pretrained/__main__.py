"""Make the pretrained LSTM's weights: lives in generated tasks, and an LSTM that learns from them.

    .venv/bin/python -m extras.pretrained LIVES ROUNDS WEIGHTS

In the first round LIVES lives go by chance, in each of ROUNDS more as the LSTM of the round before
says (DAgger: Ross et al. 2011). Each is continued at two points under three βs: some three seconds
of one core a life. Round N writes WEIGHTSN.npz; the last is extras/pretrained/weights.npz. What the
lives found is kept in WEIGHTS.jsonl, so the same command goes on with what was interrupted.
"""

import argparse
import json
import os
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from extras.pretrained.gauge import Gauge
from extras.pretrained.lives import GRID, Branch, branches
from mace_rl.beta.lstm import MetaNetwork, lstm_output, read_network
from mace_rl.beta.squash import beta_of

UNITS, NETWORKS = 4, 4  # small ones whose logits are averaged: as one LSTM in blocks
EPOCHS, BATCH, RATE, DECAY = 120, 64, 0.01, 1e-4
NOISE = 0.05  # added to what is read, so that no single number is relied on
PULL = 0.0002  # of the logit to that of 0.4, where β does not matter
LOGITS = torch.logit(torch.tensor(GRID))


def earned(logits: Tensor, known: Tensor) -> Tensor:
    """What each β earns, linear in its logit between those of the grid; known: [B, 3]."""
    logits = logits.clamp(LOGITS[0], LOGITS[-1])
    place = torch.searchsorted(LOGITS[1:-1], logits.detach())
    low, high = LOGITS[place], LOGITS[place + 1]
    share = (logits - low) / (high - low)
    rows = torch.arange(len(known))
    return known[rows, place] * (1 - share) + known[rows, place + 1] * share


class Learner(torch.nn.Module):
    """An LSTM and a readout, in torch's layout, for many sequences at once."""

    def __init__(self) -> None:
        super().__init__()
        self.lstm = torch.nn.LSTM(Gauge.SIZE, UNITS, batch_first=True)
        self.readout = torch.nn.Linear(UNITS, 1)
        with torch.no_grad():
            self.readout.bias.fill_(float(torch.logit(torch.tensor(0.4))))

    def forward(self, seen: Tensor) -> Tensor:
        """The logit of β after each window, [B, T]."""
        return self.readout(self.lstm(seen)[0])[..., 0]


def train(found: Sequence[Branch], seed: int) -> Learner:
    """One network, by Adam."""
    torch.manual_seed(seed)
    learner = Learner()
    adam = torch.optim.AdamW(learner.parameters(), RATE, weight_decay=DECAY)
    last = torch.tensor([len(one.seen) - 1 for one in found])
    seen = torch.zeros(len(found), int(last.max()) + 1, Gauge.SIZE)
    for row, one in zip(seen, found, strict=True):
        row[: len(one.seen)] = torch.tensor(one.seen)
    known = torch.tensor([one.earned for one in found], dtype=torch.float32)
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(found)).split(BATCH):
            noisy = seen[rows] + NOISE * torch.randn(seen[rows].shape)
            logits = learner(noisy)[torch.arange(len(rows)), last[rows]]
            pull = PULL * (logits - LOGITS.new_tensor(0.4).logit()).square()
            loss = (pull - earned(logits, known[rows])).mean()
            adam.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(learner.parameters(), 1.0)
            adam.step()
    return learner


def as_one(learners: Sequence[Learner]) -> dict[str, np.ndarray]:
    """The mean of their logits as one `MetaNetwork`, whose recurrent weights are in blocks."""
    size = UNITS * len(learners)
    inputs, recurrent = np.zeros((Gauge.SIZE, 4, size)), np.zeros((size, 4, size))
    bias, readout, readout_bias = np.zeros((4, size)), np.zeros(size), np.zeros(1)
    for n, learner in enumerate(learners):
        part = slice(n * UNITS, (n + 1) * UNITS)
        theirs = {name: value.numpy() for name, value in learner.lstm.state_dict().items()}
        for gate, place in enumerate((0, 1, 3, 2)):  # torch has the output gate last
            rows = slice(place * UNITS, (place + 1) * UNITS)
            inputs[:, gate, part] = theirs["weight_ih_l0"][rows].T
            recurrent[part, gate, part] = theirs["weight_hh_l0"][rows].T
            bias[gate, part] = theirs["bias_ih_l0"][rows] + theirs["bias_hh_l0"][rows]
        readout[part] = learner.readout.weight.detach().numpy()[0] / len(learners)
        readout_bias += learner.readout.bias.item() / len(learners)
    gates = inputs.reshape(Gauge.SIZE, -1), recurrent.reshape(size, -1)
    weights = MetaNetwork(*gates, bias.ravel(), readout, readout_bias)
    return {name: part.astype(np.float32) for name, part in weights._asdict().items()}


def lived(task: tuple[int, Path | None]) -> list[Branch]:
    """One life, by chance or as these weights say."""
    number, weights = task
    network = None if weights is None else read_network(weights)

    def choose(gauge: Gauge) -> float:
        assert network is not None
        return beta_of(float(lstm_output(gauge.sequence(), network)))

    return branches(number, 1000 + number % 1000, choose if network else None)


def read_lives(path: Path) -> list[list[Branch]]:
    """The lives in a file; what an interruption left of one more is cut off."""
    content = path.read_bytes() if path.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    path.write_bytes(whole)
    return [[Branch(**one) for one in json.loads(line)] for line in whole.splitlines()]


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lives", type=int)
    parser.add_argument("rounds", type=int)
    parser.add_argument("weights", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)  # of such small networks more would wait for each other
    kept = given.weights.with_suffix(".jsonl")
    found, weights = read_lives(kept), None
    with get_context("fork").Pool(len(os.sched_getaffinity(0))) as pool, kept.open("a") as file:
        for turn in range(given.rounds + 1):
            last = (turn + 1) * given.lives
            tasks = [(number, weights) for number in range(len(found), last)]
            for life in pool.imap(lived, tasks):
                found.append(life)
                print(json.dumps([vars(one) for one in life]), file=file, flush=True)
            points = [one for life in found[:last] for one in life]
            weights = given.weights.with_name(f"{given.weights.stem}{turn}.npz")
            np.savez(
                weights, allow_pickle=False, **as_one([train(points, n) for n in range(NETWORKS)])
            )
            print(f"round {turn}: {len(points)} points, written to {weights}")


if __name__ == "__main__":
    main()
