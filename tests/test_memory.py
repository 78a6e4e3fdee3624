"""Free memory goes back to the system."""

import platform

import numpy as np
import psutil
import pytest

from edslam_ti.memory import release_free_memory

MIB = 1 << 20


def resident_mib() -> float:
    return psutil.Process().memory_info().rss / MIB


@pytest.mark.slow  # what is resident depends on the machine
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc's allocator can be told to")
def test_gaps_between_arrays_go_back_to_the_system() -> None:
    del_at_once = np.zeros(30 * MIB, np.uint8)  # its end makes glibc keep smaller arrays on its heap
    del del_at_once
    release_free_memory()  # of tests before this one
    before = resident_mib()
    arrays = [np.ones(MIB // 2, np.uint8) for _ in range(400)]
    assert resident_mib() > before + 150
    kept = arrays[::8]  # 25 MiB
    del arrays
    release_free_memory()
    assert resident_mib() < before + 75
    assert sum(int(a[0]) for a in kept) == 50
    release_free_memory()  # nothing to give: no harm
