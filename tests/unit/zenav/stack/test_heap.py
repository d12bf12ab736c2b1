# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys

# Freeing a large block raises glibc's threshold to its size, so the next large one comes from the heap. It stays there
# after it is freed, as a small block lies above it.
GROWTH = """
import ctypes, re, sys
from zenav.stack.heap import limit_heap, release_free_memory

libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
libc.free.argtypes = [ctypes.c_void_p]

def block(size):
    place = libc.malloc(size)
    ctypes.memset(place, 1, size)
    return place

def own_mb():
    with open("/proc/self/smaps_rollup") as file:
        return int(re.search(r"Private_Dirty: *(\\d+)", file.read())[1]) / 1024

if "limit" in sys.argv:
    limit_heap()
before = own_mb()
libc.free(block(30_000_000))
large, small = block(20_000_000), block(100_000)
libc.free(large)
held = own_mb() - before
if "release" in sys.argv:
    release_free_memory()
print(held, own_mb() - before)
"""


def growth(*arguments):
    """MB that a process keeps after it freed all but 0.1, and after `release_free_memory` where that is asked for."""
    command = [sys.executable, "-c", GROWTH, *arguments]
    output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    return [float(number) for number in output.split()]


def test_freed_memory_goes_back_to_the_system():
    by_default, after_release = growth("release")
    assert by_default > 15.0  # MB: what the two functions are for
    assert after_release < 2.0
    assert growth("limit")[0] < 2.0
