import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.reconstruction.colmap import exhaustive, merged, sequential, similar


def proper(pairs: list[tuple[int, int]], count: int) -> bool:
    return all(0 <= a < b < count for a, b in pairs) and pairs == sorted(set(pairs))


@settings(deadline=None)
@given(st.integers(0, 30), st.integers(1, 12))
def test_pairs_are_sorted_and_each_once(count: int, overlap: int) -> None:
    assert proper(exhaustive(count), count) and len(exhaustive(count)) == count * (count - 1) // 2
    assert proper(sequential(count, overlap), count)


def test_sequential_reaches_neighbours_and_powers_of_two() -> None:
    apart = {b - a for a, b in sequential(200, 5)}
    assert apart == {1, 2, 3, 4, 5, 8, 16, 32}
    assert set(sequential(6, 10)) == set(exhaustive(6)), "an overlap beyond the end is all with all"


@settings(deadline=None)
@given(st.integers(0, 20), st.integers(1, 8), st.integers(0, 99))
def test_similar_finds_the_nearest_by_angle(count: int, nearest: int, seed: int) -> None:
    vectors = np.random.default_rng(seed).normal(size=(count, 6)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    pairs = similar(vectors, nearest)
    assert proper(pairs, count)
    for a in range(count):
        others = sorted((b for b in range(count) if b != a), key=lambda b: -float(vectors[a] @ vectors[b]))
        assert all((min(a, b), max(a, b)) in pairs for b in others[:nearest])


def test_an_image_without_a_vector_is_like_none() -> None:
    vectors = np.eye(4, dtype=np.float32)
    vectors[2] = 0
    assert similar(vectors, 3) == [(0, 1), (0, 3), (1, 3)]


def test_merged_holds_each_pair_once() -> None:
    assert merged([(0, 1), (2, 3)], [(0, 1), (1, 2)]) == [(0, 1), (1, 2), (2, 3)] and merged() == []
