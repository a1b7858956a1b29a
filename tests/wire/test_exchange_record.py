"""``wavefocus doctor --record``: every exchange is in the file, and an emulated device replays it."""

from __future__ import annotations

import json
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.wire.daq_bench import daq_bench, take_one
from tests.wire.emulated import emulated_instruments, free_port, rig_text
from tests.wire.serial_bench import DIALECTS, LOCAL, ImpatientClock, mirror_bench, wire
from wavefocus.__main__ import run
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.exchange_record import ExchangeRecord, noting_calls, recording
from wavefocus.drivers.registry import VIBROMETERS
from wavefocus.drivers.serial_mirror import SerialMirror
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial, PtyWire
from wavefocus.mocks.wire.faults import WireFault
from wavefocus.mocks.wire.replay import ReplayedDevice, read_exchanges
from wavefocus.mocks.wire.vibrometer import VIBROMETER_DRIVERS, vibrometer_device


def visited(mirror: SerialMirror) -> list[object]:
    """A short journey: what the mirror says of itself and of each place."""
    found: list[object] = [mirror.identify(), mirror.identity]
    for x_mrad, y_mrad in ((30.0, -20.0), (-15.0, 10.0)):
        mirror.move_to(x_mrad, y_mrad)
        mirror.wait_settled(5.0)
        found.append(mirror.where_mrad())
    mirror.park()
    mirror.close()
    return found


@pytest.mark.parametrize("dialect", DIALECTS)
def test_given_a_record_of_a_mirror_then_the_driver_reads_the_same_from_its_replay(
    dialect: str, tmp_path: Path
) -> None:
    record = tmp_path / "record.jsonl"
    with mirror_bench(dialect, LOCAL, tmp_path) as bench:
        with recording(record, {}):
            live = visited(bench.mirror())
        device = ReplayedDevice.of_record(record, "mirror")
        bench.far.close()
        with EmulatedSerial(device, wire(LOCAL, tmp_path)):
            assert visited(bench.mirror()) == live
    assert device.unknown == []


@pytest.mark.parametrize("driver", VIBROMETER_DRIVERS)
def test_given_a_record_of_a_vibrometer_then_its_replay_is_read_alike(driver: str, tmp_path: Path) -> None:
    record = tmp_path / "record.jsonl"
    reader: Any = VIBROMETERS.all()[driver]()
    devices = [vibrometer_device(driver, 0.025, 8.16e-6)]
    readings = []
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        with EmulatedSerial(devices[-1], wire(LOCAL, folder)) as emulated, recording(tmp_path / f"{number}.jsonl", {}):
            readings.append(reader.read(emulated.address, answer_s=0.5, clock=ImpatientClock()))
        record = tmp_path / f"{number}.jsonl"
        devices.append(ReplayedDevice.of_record(record, "vibrometer"))
    assert readings[0] == readings[1]
    first = read_exchanges(tmp_path / "0.jsonl", "vibrometer")
    assert first == read_exchanges(record, "vibrometer")
    with record.open("a", encoding="utf-8") as killed:
        killed.write('{"at_s": 1.0, "instr')
    assert first == read_exchanges(record, "vibrometer")


def test_given_garbled_and_lost_answers_then_the_record_has_each_byte_as_it_came(tmp_path: Path) -> None:
    faults = [WireFault("mirror", kind, "move", at_call=at) for kind, at in (("garbled", 1), ("truncated", 3))]
    with mirror_bench("asi-tiger", LOCAL, tmp_path, *faults) as bench, recording(tmp_path / "r.jsonl", {}):
        mirror = bench.mirror(answer_s=0.1)
        for x_mrad in (10.0, 20.0):
            try:
                mirror.move_to(x_mrad, 0.0)
            except InstrumentError:
                continue
        mirror.close()
    lines = [json.loads(line) for line in (tmp_path / "r.jsonl").read_text(encoding="utf-8").splitlines()]
    received = "".join(line.get("received", "") for line in lines)
    assert "\xba" in received  # ":" with its top bit set
    assert [line["at_s"] for line in lines[1:]] == sorted(line["at_s"] for line in lines[1:])
    assert any("closed" in line for line in lines)


@pytest.mark.skipif(LOCAL != "pty", reason="the emulated mirror is behind a path")
def test_given_the_emulated_rig_then_the_doctors_record_replays_as_the_same_mirror_and_vibrometer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, record = tmp_path / "rig.toml", tmp_path / "rig.jsonl"
    vibrometer = f'[vibrometer]\ndriver = "polytec-ofv3001"\nport = "{tmp_path / "vibrometer"}"\n'
    rig.write_text(rig_text(tmp_path, f"localhost:{free_port()}") + vibrometer, encoding="utf-8")

    def findings(*options: str) -> dict[tuple[str, str], tuple[str, str]]:
        capsys.readouterr()
        run(["doctor", str(rig), "--json", "--no-play", *options])
        found = json.loads(capsys.readouterr().out)["findings"]
        return {(one["instrument"], one["check"]): (one["verdict"], one["what"]) for one in found}

    with emulated_instruments(rig) as emulated:
        for name, value in emulated.environment.items():
            monkeypatch.setenv(name, value)
        live = findings("--record", str(record))
        assert run(["doctor", str(rig), "--record", str(record)]) == 2  # it exists, and is left alone
    assert live["record", "file"][0] == "ok"
    head, *lines = (json.loads(line) for line in record.read_text(encoding="utf-8").splitlines())
    assert head["drivers"]["mirror"] == "asi-tiger"
    called = {(line["instrument"], line["called"]) for line in lines if "called" in line}
    assert {("mirror", "move_to"), ("recorder", "start"), ("recorder", "read"), ("player", "identify")} <= called
    devices = {role: ReplayedDevice.of_record(record, role) for role in ("mirror", "vibrometer")}
    with ExitStack() as wires:
        for role, device in devices.items():
            wires.enter_context(EmulatedSerial(device, PtyWire(tmp_path / role)))
        again = findings()
    asked = {key: found for key, found in again.items() if key[0] in devices and found[0] != "skipped"}
    assert {role for role, _ in asked} == set(devices)
    assert asked == {key: live[key] for key in asked}
    assert [device.unknown for device in devices.values()] == [[], []]


def test_given_no_folder_for_the_record_then_exit_2_before_any_instrument_is_opened(tmp_path: Path) -> None:
    assert run(["init", str(tmp_path / "lab")]) == 0
    assert run(["doctor", str(tmp_path / "lab" / "rig.toml"), "--record", str(tmp_path / "none" / "r.jsonl")]) == 2


def test_given_a_recorder_that_fails_then_the_record_has_nis_own_error(tmp_path: Path) -> None:
    with daq_bench(faults=(WireFault("recorder", "overwritten", "ReadAnalogF64", at_call=1),)) as bench:
        with recording(tmp_path / "r.jsonl", {}):
            recorder = noting_calls(bench.recorder(), "recorder")
            with pytest.raises(InstrumentError):
                take_one(recorder)
        recorder.abort()  # noted no more
    lines = [json.loads(line) for line in (tmp_path / "r.jsonl").read_text(encoding="utf-8").splitlines()[1:]]
    assert [line.get("called") for line in lines] == ["start", None, "read", None]
    assert "-222" in lines[-1]["because"] or "-200" in lines[-1]["because"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux")
def test_given_a_full_disk_then_no_instrument_fails_and_the_record_says_so() -> None:
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        record = ExchangeRecord(full, {})
        record.note("mirror", sent="/")
        assert "No space left" in record.failure
        with suppress(OSError):
            full.close()


@pytest.mark.parametrize("text", ["", "{}\n", "not JSON\n", '{"format": "wavefocus-exchanges", "format_version": 2}\n'])
def test_given_another_file_then_it_is_not_a_record(text: str, tmp_path: Path) -> None:
    (tmp_path / "r.jsonl").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"r\.jsonl"):
        read_exchanges(tmp_path / "r.jsonl", "mirror")
