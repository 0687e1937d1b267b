import numpy as np
import pytest

from fprf.reconstruction.colmap import similar, vectors, words


def places(count: int, views: int, seed: int = 0) -> list[np.ndarray]:
    """Descriptors of `views` images of each of some places: a place has features of its own, seen with noise."""
    drawn = np.random.default_rng(seed)
    images = []
    for _ in range(count):
        own = drawn.gamma(0.6, 40, (120, 128))
        for _ in range(views):
            seen = own[drawn.permutation(120)[:80]] + drawn.normal(0, 6, (80, 128))
            other = drawn.gamma(0.6, 40, (30, 128))
            images.append(np.concatenate([seen, other]).clip(0, 255).astype(np.uint8))
    return images


def test_images_of_one_place_are_alike() -> None:
    images = places(8, 3)
    vocabulary = words(lambda i: images[i], len(images), 16)
    found = vectors(lambda i: images[i], len(images), vocabulary)
    assert vocabulary.shape == (16, 128) and found.shape == (24, 16 * 128)
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    pairs = similar(found, 2)
    same = [(a, b) for a in range(24) for b in range(a + 1, 24) if a // 3 == b // 3]
    assert len(set(pairs) & set(same)) >= 0.9 * len(same), "of each image's two nearest"


def test_order_of_features_does_not_matter_and_the_seed_does() -> None:
    images = places(3, 2)
    vocabulary = words(lambda i: images[i], 6, 8, seed=1)
    assert np.array_equal(vocabulary, words(lambda i: images[i], 6, 8, seed=1))
    assert not np.array_equal(vocabulary, words(lambda i: images[i], 6, 8, seed=2))
    turned = vectors(lambda i: images[i][::-1], 6, vocabulary)
    assert np.allclose(turned, vectors(lambda i: images[i], 6, vocabulary), atol=1e-4)


def test_one_word_by_hand() -> None:
    one = np.array([[0, 0], [4, 0], [1, 9]], np.uint8)
    vocabulary = np.array([[1.0, 0.0]], np.float32)
    sums = np.array([(0 - 1) + (4 - 1) + (1 - 1), 9.0])
    tamed = np.sign(sums) * np.sqrt(np.abs(sums))
    assert vectors(lambda _: one, 1, vocabulary)[0] == pytest.approx(tamed / np.linalg.norm(tamed))


def test_images_without_features() -> None:
    nothing = np.zeros((0, 128), np.uint8)
    assert not vectors(lambda _: nothing, 2, np.ones((4, 128), np.float32)).any()
    assert words(lambda _: nothing, 2, 4).shape == (0, 128) and words(lambda _: nothing, 0, 4).shape == (0, 128)
    few = np.ones((3, 128), np.uint8)
    assert words(lambda _: few, 1, 64).shape == (3, 128)
    many = np.random.default_rng(0).integers(0, 255, (5001, 128), dtype=np.uint8)
    assert np.linalg.norm(vectors(lambda _: many, 1, words(lambda _: many, 1, 4))[0]) == pytest.approx(1, abs=1e-5)
