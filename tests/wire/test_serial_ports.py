"""Ports by path, by address and by serial number; each way of not opening one has its own sentence."""

import errno
import re
import socket

import pytest

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.serial_line import LineSettings, SerialLine, SerialPort, find_port, open_failure

PRESENT = (
    SerialPort("/dev/ttyUSB0", "A1"),
    SerialPort("/dev/ttyUSB1", "B2"),
    SerialPort("/dev/ttyUSB2", "B2"),
    SerialPort("/dev/ttyS0"),
)


def line(port):
    return SerialLine("mirror", port, LineSettings(115200, "\n", 0.5))


CP2105 = (SerialPort("/dev/ttyUSB0", "00AB12", 0), SerialPort("/dev/ttyUSB1", "00AB12", 1))


@pytest.mark.parametrize(
    ("number", "present", "found"),
    [
        ("01a2b3c4", (SerialPort("COM9", "01A2B3C4"),), "COM9"),
        ("00AB12:0", CP2105, "/dev/ttyUSB0"),
        ("00ab12:1", CP2105, "/dev/ttyUSB1"),
        ("AA:BB:01", (SerialPort("COM3", "AA:BB:01"), SerialPort("COM4", "AA:BB")), "COM3"),
        ("b2", (SerialPort("COM1", "B2"), SerialPort("COM2", "b2")), "COM2"),
        ("C3", PRESENT, r"'C3': no port has it; those present: A1 \(/dev/ttyUSB0\), B2"),
        ("C3", (), "none with a serial number"),
        ("", PRESENT, "no port has it"),
        ("00AB12:7", CP2105, "no port has it"),
        ("FT3BNM1O", (SerialPort("COM9", "FT3BNM1OA"),), r"those present: FT3BNM1OA \(COM9\)"),
        ("B2:0", PRESENT, "no port has it"),
        ("B2", PRESENT, "/dev/ttyUSB1 and /dev/ttyUSB2 have it; name one of them in the rig file, port, by its path"),
    ],
)  # fmt: skip
def test_a_serial_number_then_its_port_is_found_or_those_present_are_named(number, present, found):
    port = f"serial-number:{number}"
    if " " not in found:
        assert find_port(port, "mirror", present) == found
        return
    with pytest.raises(InstrumentLostError, match=found):
        find_port(port, "mirror", present)


def test_given_an_adapter_with_several_ports_then_the_remedy_names_what_finds_each():
    with pytest.raises(InstrumentLostError) as caught:
        find_port("serial-number:00AB12", "mirror", CP2105)
    forms = re.findall(r"(serial-number:\S+) is ([^,;]+)", caught.value.remedy)
    assert [find_port(form, "mirror", CP2105) for form, _ in forms] == [device for _, device in forms]
    assert len(forms) == len(CP2105)


@pytest.mark.parametrize(
    "port", ["", "socket://", "socket://host", "socket://host:name", "socket://host:70000", "socket://host:1/x"]
)
def test_given_a_port_that_names_nothing_then_the_right_form_is_told(port):
    with pytest.raises(InstrumentError, match=r"rig file, port|write socket://host:port"):
        find_port(port, "mirror", PRESENT)


# -- opening -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("nowhere", r"opening .*/nowhere: there is no such port now; plug the device in"),
        ("notes.txt", r"not a serial port|no such port"),
    ],
)
def test_given_no_port_there_then_the_plug_is_asked_for_and_a_file_is_none(name, sentence, tmp_path):
    (tmp_path / "notes.txt").write_text("no port")
    with pytest.raises(InstrumentLostError, match=sentence):
        line(str(tmp_path / name)).open()
    with pytest.raises(InstrumentError, match="rig file"):
        SerialLine("mirror", str(tmp_path / name), LineSettings(-1, "\n")).open()


def test_given_an_address_where_nobody_listens_then_that_is_said():
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        with pytest.raises(InstrumentLostError, match="nothing there accepts connections; switch the device"):
            line(f"socket://127.0.0.1:{reserved.getsockname()[1]}").open()


@pytest.mark.parametrize(
    ("address", "failure", "sentence"),
    [
        ("COM3", ("could not open port 'COM3': FileNotFoundError(2, 'The system cannot', None, 2)",), "no such port"),
        ("COM3", ("could not open port 'COM3': PermissionError(13, 'Access is denied.', None, 5)",), "another program"),
        ("COM3", ("could not open port 'COM3': OSError(22, 'The semaphore timeout period')",), "cannot be opened"),
        ("/dev/ttyUSB0", (errno.EAGAIN, "text"), "another program"),
        ("/dev/ttyUSB0", (errno.EACCES, "text"), "may not open"),
        ("/dev/ttyUSB0", (errno.ENXIO, "text"), "no such port"),
        ("/dev/ttyUSB0", (errno.ENOTTY, "text"), "not a serial port"),
        ("socket://10.0.0.1:1", (errno.EHOSTUNREACH, "text"), "cannot be reached"),
        ("socket://10.0.0.1:1", (errno.EPIPE, "text"), "no conn"),
    ],
)
def test_given_an_error_of_windows_posix_or_the_network_then_it_has_its_sentence(address, failure, sentence):
    cause, remedy = open_failure(address, OSError(*failure))
    assert sentence in cause
    assert ("may not open" in cause) == ("join the group that owns it (often dialout" in remedy)
