"""Rules for every test: none is judged by the clock, and in CI one that skips has failed, unless it may."""

import gc
import os
import shutil
import signal
import sys
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Modules and tests stay: to look for garbage among them is a tenth of the time that it takes to collect the tests.
gc.disable()

# Temporary files in memory, where there is enough of it: tests wait for no disk.
MEMORY = Path("/dev/shm")
if "PYTEST_DEBUG_TEMPROOT" not in os.environ and MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > 4 * 2**30:
    os.environ["PYTEST_DEBUG_TEMPROOT"] = str(MEMORY)

CI = os.environ.get("CI") == "true"

# As many tests run at once as there are cores: BLAS threads besides would spin for those cores. Before numpy.
for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ.setdefault(variable, "1")

# Cases may be slow to make, and share a test's folder.
SLOW_OR_SHARED = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
# No deadlines: benchmarks measure speed, and a busy machine is no defect. The same few cases are tried each time;
# `make test-nightly` looks for new ones.
for name, seeded, examples in (("wavefocus", True, 25), ("nightly", False, 100)):
    settings.register_profile(
        name, deadline=None, suppress_health_check=SLOW_OR_SHARED, derandomize=seeded, max_examples=examples
    )
settings.load_profile("wavefocus")


def pytest_xdist_auto_num_workers():
    """One more than there are cores: many tests wait for an emulated instrument's time to pass."""
    return (os.cpu_count() or 1) + 1


def pytest_addoption(parser):
    parser.addoption(
        "--hardware", metavar="RIG.toml", type=Path, help="run the contract suites on this rig's instruments instead"
    )


def failed_for_skipping(report):
    """Turn the report of a skip into that of a failure: a missing component must not pass for a test run."""
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
    report.outcome = "failed"
    report.longrepr = (
        f"{reason}\nA skip is a failure in CI: install what is missing, "
        "or mark the test may_skip(reason) where it is about another platform."
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    report = yield
    expected_failure = hasattr(report, "wasxfail")
    if CI and report.skipped and not expected_failure and item.get_closest_marker("may_skip") is None:
        failed_for_skipping(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    report = yield
    if CI and report.skipped:  # a whole module skipped itself; it holds no marker to look at
        failed_for_skipping(report)
    return report


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


LONGEST_NAME = 80
WHOLE = tuple(Path(__file__).parent / folder for folder in ("system", "gui"))


@cache
def of_whole_commands(file):
    """Whether a file of tests is one of whole commands and windows; asked once for all its tests."""
    return any(folder in file.parents for folder in WHOLE)


def pytest_collection_modifyitems(items):
    for item in items:
        if len(item.name.split("[")[0]) > LONGEST_NAME:
            raise pytest.UsageError(f"{item.nodeid}: a name of a test has at most {LONGEST_NAME} characters")
        if of_whole_commands(item.path) and item.get_closest_marker("smoke") is None:
            item.add_marker(pytest.mark.whole)
        marker = item.get_closest_marker("may_skip")
        if marker is not None and not (marker.args and marker.args[0]):
            raise pytest.UsageError(f"{item.nodeid}: may_skip needs a reason")


@pytest.fixture
def interruptible():
    """Ctrl-C raises here, also where the tests run in the background and it is ignored from the start."""
    former, hook = signal.signal(signal.SIGINT, signal.default_int_handler), sys.unraisablehook
    yield
    signal.signal(signal.SIGINT, former)
    sys.unraisablehook = hook
