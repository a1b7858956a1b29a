"""The delay between the recorder's inputs: which value counts, and that all rows of a bank are corrected by one."""

from dataclasses import replace

import numpy as np
import pytest

from tests.unit.test_config_calibration import AT, measured
from tests.unit.test_doctor import KnowsItsConverter
from wavefocus.acquisition.setup import wired
from wavefocus.config.calibration import InputsMeasured
from wavefocus.config.rig import RigConfig
from wavefocus.drivers.registry import VibrometerReading
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.rig.setup import setup_in_use
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.errors import InputError

RATE_HZ = 10_000.0
VIRTUAL = VirtualRig(VirtualSettings(dropout_probability=0.0)).instruments


def opened(device_s, calibrated_s=None):
    """A rig whose file states 5 us, or a calibration another delay, and whose recorder states `device_s`."""
    section: dict[str, object] = {"actuators": {"position_mm": [[0, 0], [10, 0]]}}
    if calibrated_s is not None:
        inputs = InputsMeasured(at=AT, device="r", identity=None, inter_channel_delay_s=calibrated_s)
        record = measured().model_copy(update={"inputs": inputs}).model_dump()
        section["calibration"] = {"file": "cal.toml", "measured": record}
        section["recorder"] = {"inter_channel_delay_s": calibrated_s}
    rig = RigConfig.model_validate(section)
    roles = replace(VIRTUAL, recorder=KnowsItsConverter(VIRTUAL.recorder, device_s))
    return wired(rig, roles, VibrometerReading(0.1, "", None, None, "typed in")), rig


@pytest.mark.parametrize(
    ("device_s", "calibrated_s", "used_s"),
    [(14e-6, None, 14e-6), (5.2e-6, None, 5e-6), (None, None, 5e-6), (14e-6, 13e-6, 13e-6), (0.0, None, 0.0)],
)
def test_given_no_bank_then_the_calibrated_delay_counts_else_the_devices_own(device_s, calibrated_s, used_s, capsys):
    with setup_in_use(*opened(device_s, calibrated_s), RATE_HZ) as setup:
        assert setup.inter_channel_delay_s == pytest.approx(used_s)
    assert bool(capsys.readouterr().err) == (device_s is not None and abs(device_s - (calibrated_s or 5e-6)) > 0.5e-6)


@pytest.mark.parametrize(
    ("begun_s", "device_s", "calibrated_s", "used_s", "is_said"),
    [
        # Begun where the recorder stated nothing: what the rig file stated is used to the end.
        (None, None, None, 5e-6, False),
        (None, 5.2e-6, None, 5e-6, False),
        (None, 14e-6, None, 5e-6, True),
        # Begun where it did.
        (14e-6, 14.2e-6, None, 14e-6, True),
        (14e-6, None, None, 14e-6, True),
        (5e-6, 5e-6, None, 5e-6, False),
        # Another recorder, whose rows would be corrected by the wrong delay.
        (14e-6, 5e-6, None, None, False),
        (5e-6, 14e-6, None, None, False),
        # A calibration is part of the plan, which is compared elsewhere.
        (None, 14e-6, 13e-6, 13e-6, True),
    ],
)
def test_bank_that_is_begun_then_its_rest_is_measured_with_its_own_delay_or_refused(
    begun_s, device_s, calibrated_s, used_s, is_said, tmp_path, capsys
):
    path = tmp_path / "plate.h5"
    places = (np.zeros((2, 2)), np.zeros((2, 2)))
    header = BankHeader(RATE_HZ, 8, (20.0, 500.0), *places, "{}", "{}", "0" * 64, "", inter_channel_delay_s=begun_s)
    create_bank(path, header)
    with open_bank(path, contents=True) as bank:
        assert bank.inter_channel_delay_s == begun_s
    with BankWriter.open(path) as writer:
        if used_s is None:
            with pytest.raises(InputError, match=r"plate\.h5: was begun with a recorder"):
                setup_in_use(*opened(device_s, calibrated_s), RATE_HZ, writer).__enter__()
            return
        with setup_in_use(*opened(device_s, calibrated_s), RATE_HZ, writer) as setup:
            assert setup.inter_channel_delay_s == used_s
    assert bool(capsys.readouterr().err) == is_said
