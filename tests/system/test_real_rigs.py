"""Rigs with real drivers, on the command line: dry runs need no instrument, and what is missing is named."""

import pytest

from tests.lab_files import ABSENT_RIG
from tests.system.captures import answered, empty_bank, refused
from wavefocus.campaign.control import command_line
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial, TcpWire
from wavefocus.mocks.wire.vibrometer import PolytecDevice
from wavefocus.rig.instruments import openers_of


@pytest.fixture
def real_lab(tmp_path):
    (tmp_path / "rig.toml").write_text(ABSENT_RIG.format(folder=tmp_path.as_posix()), encoding="utf-8")
    (tmp_path / "run.toml").write_text('rig = "rig.toml"\n[grid]\npositions_file = "p.csv"\n', encoding="utf-8")
    (tmp_path / "p.csv").write_text("x_mm,y_mm\n0,0\n4,0\n", encoding="utf-8")
    return tmp_path


def test_given_real_instruments_then_the_dry_run_asks_none_of_them(real_lab, capsys):
    facts = answered(capsys, "plan", real_lab / "run.toml")
    assert (facts["records"], facts["second_looks"]) == (6, 0)
    # Two positions and the sentinel; the loopback alone at the beginning and with the sentinel.
    assert facts["duration_s"] == pytest.approx(3 * (3 * (3 * 1.2 + 0.12) + 0.05) + 2 * (0.52 + 0.12))
    assert facts["instruments"][0] == f"mirror generic at {real_lab.as_posix()}/no-such-port, not asked"
    assert "player sounddevice no such interface, 4 outputs, not asked" in facts["instruments"]


def test_instruments_that_are_not_there_then_capture_names_the_first_and_ends_with_3(real_lab, capsys):
    bank = real_lab / "plate.h5"
    command = ["capture", str(real_lab / "run.toml"), "--bank", str(bank)]
    told = refused(capsys, *command, code=3)
    assert told.startswith("wavefocus: recorder Dev1 at localhost:1: ")  # it is asked before a bank is made
    assert told.endswith(f"go on with: {command_line('wavefocus', *command)}")
    assert not bank.exists()
    empty_bank(real_lab, "plate.h5")
    told = refused(capsys, *command, code=3)
    assert told.startswith("wavefocus: mirror (generic at ")
    assert "no-such-port" in told


def test_a_vibrometer_states_its_sensitivity_and_another_in_the_file_is_refused(real_lab):
    rig, absent = real_lab / "rig.toml", (real_lab / "rig.toml").read_text(encoding="utf-8")

    def opened(port, sensitivity=""):
        table = f'[vibrometer]\ndriver = "polytec-ofv5000"\nport = "{port}"\n{sensitivity}'
        rig.write_text(absent + table, encoding="utf-8")
        return openers_of(load_rig(rig)).vibrometer()

    with EmulatedSerial(PolytecDevice("25mm/s/V"), TcpWire()) as emulated:
        for stated in ("", "sensitivity_m_s_per_v = 0.025"):
            found = opened(emulated.address, stated)
            assert found.sensitivity_m_s_per_v == pytest.approx(0.025)
            assert "OFV-5000 Vibrometer Controller, VD-09" in found.identity
            assert found.signal_level == pytest.approx(600 / 775)
        with pytest.raises(InstrumentError, match=r"it is set to 25mm/s/V, the rig file says 0\.125 m/s per V") as told:
            opened(emulated.address, "sensitivity_m_s_per_v = 0.125")
        assert "correct vibrometer.sensitivity_m_s_per_v" in told.value.remedy
