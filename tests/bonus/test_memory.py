"""The episodic memory: against loops over its entries."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mace_rl.bonus.memory import EpisodicMemory
from mace_rl.config.bonus import MemoryConfig

ORIGIN, UNIT = np.zeros(3), np.ones(3)  # the identity as an embedding


def make_memory(capacity=50, neighbours=4, key_size=3) -> EpisodicMemory:
    config = MemoryConfig(
        capacity=capacity, neighbours=neighbours, kernel_bandwidth=0.1, write_every=1
    )
    return EpisodicMemory(config, key_size)


def experiences(count, seed=0, key_size=3) -> list[np.ndarray]:
    """Keys, next states, rewards and returns of `count` experiences."""
    rng = np.random.default_rng(seed)
    shapes = [(count, key_size), (count, key_size), (count,), (count,)]
    return [rng.standard_normal(shape).astype(np.float32) for shape in shapes]


@pytest.mark.parametrize("stored", [1, 3, 40])
def test_recalling_equals_a_loop_over_all_entries(stored):
    """Pritzel et al. 2017, eqs. 2 and 5, one query at a time in double precision."""
    memory = make_memory(neighbours=4)
    keys, next_states, rewards, returns = experiences(stored)
    memory.write(keys, next_states, rewards, returns)
    rng = np.random.default_rng(9)
    queries = rng.standard_normal((12, 3)).astype(np.float32)
    mean, std = rng.standard_normal(3), rng.random(3) + 0.5
    memory.build_index(mean, std)
    found = memory.recall(queries)
    for n, query in enumerate(queries):
        entries = []
        for i in range(stored):
            difference = [(float(query[d]) - float(keys[i, d])) / std[d] for d in range(3)]
            square = sum(d * d for d in difference) / 3
            entries.append((square, 1 / (square + 0.1), float(returns[i])))
        best = sorted(entries)[:4]
        total = sum(kernel for _, kernel, _ in best)
        expected = sum(kernel / total * value for _, kernel, value in best)
        assert found[0][n] == pytest.approx(expected, rel=1e-3, abs=1e-4)
        assert found[1][n] == pytest.approx(0.1 * best[0][1], rel=1e-3)
    one = memory.recall(queries[:1])  # a single one gets what it gets among many
    assert all((part == whole[:1]).all() for part, whole in zip(one, found, strict=True))


def test_what_cannot_be_recalled():
    """A state too far away for float32 recalls NaN, which stops the run and says where."""
    memory, state = make_memory(), np.zeros((1, 3), np.float32)
    for step in (lambda: None, lambda: memory.build_index(ORIGIN, UNIT)):
        step()
        with pytest.raises(LookupError, match="empty"):
            memory.recall(state)
    memory.write(*experiences(10))
    with pytest.raises(LookupError, match="not indexed since"):
        memory.recall(state)
    memory.build_index(ORIGIN, UNIT)
    assert np.isnan(memory.recall(state + np.float32(1e25))[0]).all()


class ListOfSlots:
    """Least recently used by its definition: slots with an identity and when they were used."""

    def __init__(self, capacity: int, neighbours: int) -> None:
        self.slots: list[tuple[int, int, float | None]] = [(0, 0, None)] * capacity
        self.neighbours, self.time, self.written, self.pending = neighbours, 0, 0, set()

    def write(self, keys: list[float]) -> None:
        """What was read since the last time is used first, all of it at once."""
        self.time += 1
        for i in self.pending:
            self.slots[i] = (self.time, *self.slots[i][1:])
        self.pending.clear()
        self.time += 1
        for key in keys[-len(self.slots) :]:
            self.written += 1
            oldest = min(range(len(self.slots)), key=lambda i: (*self.slots[i][:2], i))
            self.slots[oldest] = (self.time, self.written, key)

    def read(self, queries: list[float]) -> None:
        filled = [i for i, (*_, key) in enumerate(self.slots) if key is not None]
        for query in queries:
            by_distance = sorted(filled, key=lambda i: abs(self.slots[i][2] - query))
            self.pending.update(by_distance[: self.neighbours])


operations = st.lists(
    st.tuples(st.sampled_from(["write", "read"]), st.lists(st.integers(0, 10**6), min_size=1)),
    max_size=25,
)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(operations, st.integers(2, 12), st.integers(1, 2))
def test_replacement_equals_a_model_of_least_recently_used(operations, capacity, neighbours):
    """Any sequence of writes and reads, of any size, beyond the capacity too; saved in between."""
    memory = make_memory(capacity, neighbours, key_size=1)
    model, written = ListOfSlots(capacity, neighbours), 0
    for kind, numbers in operations:
        # Irrational steps: no two keys are equal and no query is halfway between two.
        places = [(n * 2**0.5) % 1000 for n in numbers]
        if kind == "write":
            keys = []
            for place in places:
                written += 1
                keys.append(float(np.float32(place + written * 3**0.5)))
            column = np.float32(keys)
            memory.write(column[:, None], column[:, None], column, column)
            model.write(keys)
        elif written:
            memory.build_index(np.zeros(1), np.ones(1))
            memory.recall(np.float32(places)[:, None])
            model.read([float(np.float32(place)) for place in places])
        saved, memory = memory.state_dict(), make_memory(capacity, neighbours, key_size=1)
        memory.load_state_dict(saved)
        held = [
            float(key) if used else None
            for key, used in zip(memory.keys[:, 0], memory.usage > 0, strict=True)
        ]
        assert held == [key for *_, key in model.slots]
        assert len(memory) == min(sum(key is not None for key in held), capacity)
        assert memory.values[: len(memory), -1].tolist() == [key for key in held if key is not None]


def test_of_equal_keys_the_newest_is_read_and_the_oldest_goes():
    """As with one-hot states, which lie at distance 0 from their like for ever."""
    memory, zero = make_memory(capacity=4, neighbours=1, key_size=1), np.zeros(1)
    for result in range(6):
        memory.write(zero[None], zero[None], zero, np.array([result]))
        memory.build_index(np.zeros(1), np.ones(1))
        assert memory.recall(np.zeros((1, 1), np.float32))[0] == [result]
    assert sorted(memory.values[: len(memory), -1].tolist()) == [2, 3, 4, 5]
