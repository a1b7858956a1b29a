"""Memory that is freed stays with the process where the C library can be told so."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import pytest

from rendering.freed_memory import APART_BYTES, KEPT_BYTES, SETTINGS, keep_freed_memory

FAULTS_OF_AN_ARRAY_TAKEN_AGAIN_AND_AGAIN = """
import resource
import numpy as np
from rendering.freed_memory import keep_freed_memory
assert keep_freed_memory({})
def take_and_free(times):
    for _ in range(times):
        np.ones(2**18)
take_and_free(3)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
take_and_free(100)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="page faults are counted on Linux")
def test_given_it_is_told_then_an_array_taken_again_is_not_fetched_from_the_system_again():
    command = [sys.executable, "-c", FAULTS_OF_AN_ARRAY_TAKEN_AGAIN_AND_AGAIN]
    faults = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    pages = 100 * 2**21 // 4096
    assert faults < pages / 10


@pytest.mark.parametrize("name", SETTINGS)
def test_given_the_environment_tells_otherwise_then_it_is_left_so(name):
    assert not keep_freed_memory({name: "1"}, SimpleNamespace(mallopt=pytest.fail))


def test_given_a_library_without_the_means_then_nothing_is_done():
    assert not keep_freed_memory({}, SimpleNamespace())


@pytest.mark.parametrize("allows", [True, False])
def test_given_a_library_then_it_is_told_both_and_its_answer_counts(allows):
    told = []

    def mallopt(parameter, value):
        told.append((parameter, value))
        return int(allows)

    assert keep_freed_memory({}, SimpleNamespace(mallopt=mallopt)) is allows
    assert dict(told).items() <= {-1: KEPT_BYTES, -3: APART_BYTES}.items()
