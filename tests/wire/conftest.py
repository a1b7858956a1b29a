"""What several suites on emulated wires share."""

import pytest

from tests.threads import threads_end
from tests.wire.emulated import emulated_instruments, free_port, rig_text


@pytest.fixture(scope="module", autouse=True)
def nothing_is_left_open():
    """A module whose tests leave an instrument open fails."""
    yield from threads_end()


@pytest.fixture
def rig(tmp_path):
    """A rig file whose response range is the widest."""
    file = tmp_path / "rig.toml"
    text = rig_text(tmp_path, f"localhost:{free_port()}", period_frames=8192)
    file.write_text(text.replace("response_range_v = 1.0\n", ""), encoding="utf-8")
    return file


@pytest.fixture
def sides(rig):
    """Its emulated instruments."""
    with emulated_instruments(rig) as sides:
        yield sides
