"""What several suites on emulated wires share."""

import pytest

from tests.threads import threads_end


@pytest.fixture(scope="module", autouse=True)
def nothing_is_left_open():
    """A module whose tests leave an instrument open fails."""
    yield from threads_end()
