"""Many registrations in one process: memory stays bounded, and threads get what one thread gets."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from cmig_jax import register

STATM = Path("/proc/self/statm")


def clouds(points, seed):
    rng = np.random.default_rng(seed)
    body = np.abs(rng.normal(size=(2, points, 3))) * [3, 2, 1]
    body[..., 0] += body[..., 1] ** 2
    return body[0], body[1][:, [1, 2, 0]]


@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
def test_memory_does_not_grow_with_calls_of_new_sizes():
    """A program compiled for every new size took 110 MB each."""
    sizes = np.random.default_rng(0).permutation(np.arange(11, 211))
    for i, size in enumerate(sizes):
        register(*clouds(int(size), i), rotations=1)
        if i == 20:
            before = pages()
    assert 4096 * (pages() - before) < 10e6


def pages() -> int:
    return int(STATM.read_text().split()[1])


def test_threads_get_the_same_result_to_the_last_bit():
    pairs = [clouds(points, points) for points in (150, 6_000, 20_000)]
    alone = [register(*pair, rotations=20) for pair in pairs]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda pair: register(*pair, rotations=20), pairs * 2))
    for one, other in zip(alone * 2, together, strict=True):
        np.testing.assert_array_equal(one.matrix, other.matrix)
        np.testing.assert_array_equal(one.information, other.information)
        assert one.confidence == other.confidence
