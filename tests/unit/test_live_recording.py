"""Records of live sessions: scenes that render to the drives of the engine, at every moment of the session."""

import numpy as np
import pytest

from tests.unit.plate_banks import noise_bank
from wavefocus.config.scene import Regularisation
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.live.recording import SessionRecording
from wavefocus.rendering.scene.model import load_scene
from wavefocus.rendering.scene.signals import Noise
from wavefocus.storage.errors import InputError

RATE_HZ, TAPS, BLOCK = 1000.0, 40, 5
BANK = noise_bank(TAPS, status=None)
SINGLE = 2e-6
"""Rounding of single precision."""
HELD = Regularisation(saturation=0.8)


def engine_of():
    return LiveEngine(
        BANK, block_samples=BLOCK, look_ahead_samples=100, regularisation=HELD, interpolation="nearest",
        signal=Noise((50.0, 400.0), 0.1, 1), record=True,
    )  # fmt: skip


def recording_into(folder):
    return SessionRecording(
        folder, rate_hz=RATE_HZ, regularisation=HELD, interpolation="nearest", about="session\nof a test"
    )


def test_given_a_session_that_goes_on_then_its_folder_holds_a_scene_up_to_now(tmp_path):
    engine, recording = engine_of(), recording_into(tmp_path)
    drives = []
    for block in range(120):
        if block % 3 == 0:
            engine.move("finger", (0.1 * block, 0.0))
        drives.append(engine.next_block())
        recording.add(engine.take_record())
    while len((tmp_path / "source-0.csv").read_text().splitlines()) < 30:
        pass
    whole = render_with_report(load_scene(tmp_path / "scene.toml"), BANK)[0].drive_v[:, TAPS - 1 :]
    whole = whole[:, :300]
    made = np.concatenate(drives, axis=1)[:, :300]
    np.testing.assert_allclose(made, whole, rtol=0, atol=SINGLE * np.abs(whole).max())
    recording.close()


def test_given_silence_or_a_folder_with_a_scene_then_no_scene_is_written(tmp_path):
    with recording_into(tmp_path / "none") as recording:
        pass
    assert recording.scene is None
    assert list((tmp_path / "none").iterdir()) == []
    (tmp_path / "scene.toml").write_text("[scene]\n")
    with pytest.raises(InputError, match=r"scene\.toml"):
        recording_into(tmp_path)
