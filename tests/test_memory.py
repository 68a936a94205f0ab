"""The differentiable dictionary: against loops over its entries and finite differences."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mace_rl.bonus.memory import EpisodicMemory, Recollection
from mace_rl.config.bonus import MemoryConfig
from mace_rl.nearest import nearest

ORIGIN, UNIT = torch.zeros(3), torch.ones(3)  # the identity as an embedding


def make_memory(capacity=50, neighbours=4, key_size=3) -> EpisodicMemory:
    config = MemoryConfig(
        capacity=capacity, neighbours=neighbours, kernel_bandwidth=0.1, write_every=1
    )
    return EpisodicMemory(config, key_size)


def experiences(count, seed=0, key_size=3) -> list[torch.Tensor]:
    """Keys, next states, rewards and returns of `count` experiences."""
    generator = torch.Generator().manual_seed(seed)
    shapes = [(count, key_size), (count, key_size), (count,), (count,)]
    return [torch.randn(shape, generator=generator) for shape in shapes]


# --- Nearest neighbours -------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "total"), [(1, 30), (4, 500), (15, 2000)])
@pytest.mark.parametrize("count", [1, 5, 20])
def test_nearest_equals_a_full_sort(size, total, count):
    rng = np.random.default_rng(0)
    queries = rng.standard_normal((25, size)).astype(np.float32)
    points = rng.standard_normal((total, size)).astype(np.float32)
    mean, std = rng.standard_normal(size).astype(np.float32), np.float32([0.5, 2, 1] * 5)[:size]
    squares, indices = nearest(queries, points, mean, std, count)
    exact = (((queries[:, None].astype(np.float64) - points[None]) / std) ** 2).sum(2)
    expected = np.sort(exact, axis=1)[:, :count]
    np.testing.assert_allclose(squares, expected, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(np.take_along_axis(exact, indices, 1), expected, rtol=1e-5)
    assert all(len(set(row)) == count for row in indices.tolist())


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.data())
def test_nearest_equals_a_stable_sort_whatever_the_order_and_the_ties(data):
    """To the bit: differences of small integers are exact. Sorted points come nearest last."""
    size, total = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 200))
    count = data.draw(st.integers(1, total))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    points = rng.integers(-3, 4, (total, size)).astype(np.float32)
    if data.draw(st.booleans()):
        points = np.sort(points, axis=0)
    queries = rng.integers(-3, 4, (4, size)).astype(np.float32)
    identity = np.zeros(size, np.float32), np.ones(size, np.float32)
    squares, indices = nearest(queries, points, *identity, count)
    exact = np.square(queries[:, None] - points).sum(2)
    expected = np.argsort(exact, axis=1, kind="stable")[:, :count]
    assert (indices == expected).all()
    assert (squares == np.take_along_axis(exact, expected, 1)).all()


def test_distances_far_from_the_origin_keep_their_digits():
    """Positions like 1000 ± 0.01: the mean goes before the scale."""
    rng = np.random.default_rng(0)
    states = (1000 + 0.01 * rng.standard_normal((300, 2))).astype(np.float32)
    mean, std = states.mean(0, dtype=np.float64), states.std(0, dtype=np.float64)
    embedding = mean.astype(np.float32), std.astype(np.float32)
    squares, _ = nearest(states[:20], states[20:], *embedding, 3)
    exact = (((states[:20, None].astype(np.float64) - states[20:]) / std) ** 2).sum(2)
    np.testing.assert_allclose(squares, np.sort(exact, axis=1)[:, :3], rtol=1e-5)


def test_a_query_that_is_not_a_number_is_at_no_distance():
    points = np.zeros((30, 2), np.float32)
    identity = np.zeros(2, np.float32), np.ones(2, np.float32)
    squares, indices = nearest(np.array([[np.nan, 0], [0, 0]], np.float32), points, *identity, 5)
    assert np.isnan(squares[0]).all() and (squares[1] == 0).all()
    assert ((indices >= 0) & (indices < 30)).all()


# --- Lookup -------------------------------------------------------------------------------------


@pytest.mark.parametrize("stored", [1, 3, 40])
@pytest.mark.parametrize("differentiable", [False, True])
def test_lookup_equals_a_loop_over_all_entries(stored, differentiable):
    """Pritzel et al. 2017, eqs. 2 and 5, one query at a time in double precision."""
    memory = make_memory(neighbours=4)
    keys, next_states, rewards, returns = experiences(stored)
    memory.write(keys, next_states, rewards, returns)
    generator = torch.Generator().manual_seed(9)
    queries = torch.randn((12, 3), generator=generator)
    mean, std = torch.randn(3, generator=generator), torch.rand(3, generator=generator) + 0.5
    found = memory.lookup(queries.clone().requires_grad_(differentiable), mean, std)
    found = Recollection(*(part.detach() for part in found))
    for n, query in enumerate(queries.double()):
        entries = []
        for i in range(stored):
            difference = [(float(query[d]) - float(keys[i, d])) / float(std[d]) for d in range(3)]
            square = sum(d * d for d in difference) / 3
            value = [*next_states[i].tolist(), float(rewards[i]), float(returns[i])]
            entries.append((square, 1 / (square + 0.1), value))
        best = sorted(entries)[:4]
        total = sum(kernel for _, kernel, _ in best)
        expected = [sum(k / total * value[c] for _, k, value in best) for c in range(5)]
        np.testing.assert_allclose(found.values[n], expected, rtol=1e-3, atol=1e-4)
        assert float(found.similarity[n]) == pytest.approx(0.1 * best[0][1], rel=1e-3)


def test_lookup_of_a_remembered_state_by_hand():
    """At d = 0 the kernel is 1/δ = 10; at d² = 0.4 per dimension it is 1/0.5 = 2."""
    memory = make_memory(neighbours=2, key_size=1)
    memory.write(
        torch.tensor([[0.0], [0.4**0.5], [99.0]]),
        torch.tensor([[1.0], [2.0], [3.0]]),
        torch.tensor([0.0, 1.0, 2.0]),
        torch.tensor([-6.0, 6.0, 0.0]),
    )
    found = memory.lookup(torch.zeros(1, 1), torch.zeros(1), torch.ones(1))
    np.testing.assert_allclose(found.values, [[14 / 12, 2 / 12, -4]], rtol=1e-6)
    assert found.similarity.tolist() == pytest.approx([1.0])


def test_similarity_falls_from_1_to_0_with_distance():
    memory = make_memory()
    memory.write(*experiences(20))
    far = torch.arange(1, 6, dtype=torch.float32)[:, None] * 10 * torch.ones(3)
    similarity = memory.lookup(torch.cat([memory.keys[:1], far]), ORIGIN, UNIT).similarity
    assert similarity[0] == 1
    assert (similarity.diff() < 0).all() and similarity[-1] < 1e-3


def test_empty_memory_says_so():
    memory = make_memory()
    with pytest.raises(LookupError, match="empty"):
        memory.lookup(torch.zeros(1, 3), ORIGIN, UNIT)
    assert len(memory) == 0


# --- Gradients ----------------------------------------------------------------------------------


def lookup_in_double(count=20) -> tuple[EpisodicMemory, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A memory held in float64, for finite differences, with queries and an embedding."""
    memory = make_memory(capacity=count, neighbours=5)
    memory.write(*experiences(count))
    memory.keys, memory.values = memory.keys.double(), memory.values.double()
    generator = torch.Generator().manual_seed(1)
    queries = torch.randn((4, 3), generator=generator, dtype=torch.float64)
    mean, std = torch.tensor([0.1, -0.2, 0.3]).double(), torch.tensor([0.5, 1.0, 2.0]).double()
    return memory, queries, mean, std


def test_gradient_with_respect_to_queries_equals_finite_differences():
    memory, queries, mean, std = lookup_in_double()
    assert torch.autograd.gradcheck(
        lambda q: tuple(memory.lookup(q, mean, std)), queries.requires_grad_()
    )
    gradient = torch.autograd.grad(memory.lookup(queries, mean, std).values.sum(), queries)[0]
    assert (gradient != 0).all()


def test_gradient_with_respect_to_values_equals_finite_differences():
    memory, queries, mean, std = lookup_in_double()
    values = memory.values.clone().requires_grad_()

    def read(changed: torch.Tensor) -> torch.Tensor:
        memory.values = changed
        return memory.lookup(queries, mean, std).values

    assert torch.autograd.gradcheck(read, values)
    # Only what was read has a gradient, and the weights of each query sum to 1.
    gradient = torch.autograd.grad(read(values)[0, 0], values)[0]
    assert (gradient[:, 0] > 0).sum() == 5 and (gradient[:, 1:] == 0).all()
    assert float(gradient.sum()) == pytest.approx(1)


# --- Replacement --------------------------------------------------------------------------------


class ListOfSlots:
    """Least recently used by its definition: slots with an identity and when they were used."""

    def __init__(self, capacity: int, neighbours: int) -> None:
        self.slots: list[tuple[int, int, float | None]] = [(0, 0, None)] * capacity
        self.neighbours, self.time, self.written = neighbours, 0, 0

    def write(self, keys: list[float]) -> None:
        self.time += 1
        for key in keys[-len(self.slots) :]:
            self.written += 1
            oldest = min(range(len(self.slots)), key=lambda i: (*self.slots[i][:2], i))
            self.slots[oldest] = (self.time, self.written, key)

    def read(self, queries: list[float]) -> None:
        self.time += 1
        filled = [i for i, (*_, key) in enumerate(self.slots) if key is not None]
        for query in queries:
            by_distance = sorted(filled, key=lambda i: abs(self.slots[i][2] - query))
            for i in by_distance[: self.neighbours]:
                self.slots[i] = (self.time, *self.slots[i][1:])


operations = st.lists(
    st.tuples(st.sampled_from(["write", "read"]), st.lists(st.integers(0, 10**6), min_size=1)),
    max_size=25,
)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(operations, st.integers(2, 12), st.integers(1, 2))
def test_replacement_equals_a_model_of_least_recently_used(operations, capacity, neighbours):
    """Any sequence of writes and reads, of any size, beyond the capacity too."""
    memory = make_memory(capacity, neighbours, key_size=1)
    model = ListOfSlots(capacity, neighbours)
    written = 0
    for kind, numbers in operations:
        # Irrational steps: no two keys are equal and no query is halfway between two.
        places = [(n * 2**0.5) % 1000 for n in numbers]
        if kind == "write":
            keys = []
            for place in places:
                written += 1
                keys.append(float(np.float32(place + written * 3**0.5)))
            column = torch.tensor(keys)
            memory.write(column[:, None], column[:, None], column, column)
            model.write(keys)
        elif written:
            queries = [float(np.float32(place)) for place in places]
            memory.lookup(torch.tensor(queries)[:, None], torch.zeros(1), torch.ones(1))
            model.read(queries)
        held = [
            float(key) if used else None
            for key, used in zip(memory.keys[:, 0], memory.usage > 0, strict=True)
        ]
        assert held == [key for *_, key in model.slots]
        assert len(memory) == min(sum(key is not None for key in held), capacity)
        assert memory.values[: len(memory), -1].tolist() == [key for key in held if key is not None]


def test_of_equal_keys_the_newest_is_read_and_the_oldest_goes():
    """As with one-hot states, which lie at distance 0 from their like for ever."""
    memory = make_memory(capacity=4, neighbours=1, key_size=1)
    zero, one = torch.zeros(1), torch.ones(1)
    for result in range(6):
        memory.write(zero[None], zero[None], zero, torch.tensor([float(result)]))
        assert float(memory.lookup(zero[None], zero, one).values[0, -1]) == result
    assert sorted(memory.values[: len(memory), -1].tolist()) == [2, 3, 4, 5]


def test_values_are_next_state_reward_and_return():
    memory = make_memory()
    keys, next_states, rewards, returns = experiences(5)
    memory.write(keys, next_states, rewards.double(), returns.double())
    assert (memory.keys[:5] == keys).all()
    expected = torch.cat([next_states, rewards[:, None], returns[:, None]], dim=1)
    assert (memory.values[:5] == expected).all() and memory.values.dtype == torch.float32


def test_restored_memory_is_the_same_and_apart():
    original, restored = make_memory(capacity=8), make_memory(capacity=8)
    original.write(*experiences(6))
    original.lookup(torch.zeros(1, 3), ORIGIN, UNIT)
    restored.load_state_dict(original.state_dict())
    for memory in (original, restored):
        memory.write(*experiences(3, seed=1))
    assert (original.keys == restored.keys).all() and (original.usage == restored.usage).all()
    original.write(*experiences(3, seed=2))
    assert not (original.keys == restored.keys).all()


def test_a_state_too_far_away_for_float32_recalls_nan():
    """Which stops the run; an error from within compiled code would not say where."""
    memory = make_memory()
    memory.write(*experiences(10))
    recollection = memory.lookup(torch.full((1, 3), 1e25), ORIGIN, UNIT)
    assert recollection.values.isnan().all()
