"""Freed memory stays with the process, where the C library can be told so."""

import platform
import subprocess
import sys

import pytest

PROGRAM = """
import resource
import numpy as np
from cmig_jax.allocator import keep_freed_memory, return_freed_memory
{call}
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(64 * 2**17)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
{between}
print(faults())
"""
HOLES = """
import random
from cmig_jax.allocator import _glibc, keep_freed_memory, return_freed_memory
keep_freed_memory()
c = _glibc()
random.seed(0)
sizes = [random.randrange(2_000, 900_000) for _ in range(4_000)]
blocks = [c.malloc(n) for n in sizes]
large = c.malloc(2**26)
c.malloc(2**20)  # so that what is freed before it is a hole, not the heap's end
end = c.sbrk(0)
for block in [*blocks[::2], large]:
    c.free(block)
return_freed_memory()
print(c.malloc(2**26) == large, sum(c.malloc(n) < end for n in sizes[::2]))
"""


def second_time(call: str, between: str = "") -> int:
    """Count the pages that a process is given when it takes 64 MB for the second time."""
    program = PROGRAM.format(call=call, between=between)
    return int(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
def test_memory_is_taken_from_the_system_once():
    assert second_time("keep_freed_memory()") < 10 < second_time("")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
def test_memory_that_is_kept_can_be_returned():
    assert second_time("keep_freed_memory()", between="return_freed_memory()") > 10


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
def test_holes_are_not_used_again_but_large_blocks_are():
    large, reused = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True, check=True).stdout.split()
    assert large == "True"
    assert int(reused) < 100  # of 2,000, all of which fit into the holes
