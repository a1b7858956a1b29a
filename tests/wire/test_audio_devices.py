"""Which output is meant, and a sentence for each way of not getting it."""

from __future__ import annotations

import sys
import venv
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import pytest

from drivers.audio.stream.portaudio import DeviceChoiceError, OutputDevice, choose
from drivers.errors import InstrumentError, InstrumentLostError
from drivers.protocols import DeviceIdentity
from mocks.wire.jack_server import AlsaFile
from tests.wire.audio_bench import AudioBench, run_python

APIS = ("MME", "ASIO", "Windows WASAPI")
DEVICES = (
    OutputDevice(3, "MME", "Fireface UCX (1+2)", 2, 44_100.0),
    OutputDevice(7, "ASIO", "Fireface UCX", 28, 48_000.0),
    OutputDevice(8, "ASIO", "ASIO4ALL v2", 2, 48_000.0),
    OutputDevice(9, "Windows WASAPI", "Speakers (Fireface UCX)", 8, 48_000.0),
)
OPENING = """
from drivers.audio.stream.player import StreamPlayer
from drivers.errors import InstrumentError
from drivers.protocols import DeviceIdentity
try:
    StreamPlayer(None, "filed", channels=2, channel_full_scale_v=(1.0, 1.0), interface_rate_hz=48_000)
except InstrumentError as error:
    print(error.instrument, error.operation, error.cause, error.remedy, sep="|")
"""
linux_only = [
    pytest.mark.may_skip("ALSA and the loader's path are Linux's"),
    pytest.mark.skipif(sys.platform != "linux", reason="needs ALSA"),
]


@pytest.fixture
def bench():
    with ExitStack() as stack:
        yield AudioBench(stack)


@pytest.mark.parametrize(
    ("host_api", "name", "index"),
    [
        ("ASIO", "Fireface UCX", 7),
        ("asio", "fireface ucx", 7),
        ("ASIO", "Fireface", 7),
        (None, "Fireface UCX", 7),  # the one of exactly that name
        (None, "Speakers", 9),
        ("MME", "UCX", 3),
    ],
)
def test_given_a_host_api_and_a_name_or_a_part_of_it_then_that_device_is_meant(host_api, name, index):
    assert choose(DEVICES, APIS, host_api, name).index == index


def test_given_a_name_that_several_have_then_it_lists_them():
    with pytest.raises(DeviceChoiceError, match=r"3 outputs.*'Fireface UCX \(1\+2\)' \(MME.*player.host_api") as caught:
        choose(DEVICES, APIS, None, "Fire")
    assert not caught.value.absent


def test_given_no_such_host_api_then_it_names_those_there_are():
    with pytest.raises(
        DeviceChoiceError, match="no host API 'JACK'; there are 'MME', 'ASIO', 'Windows WASAPI'"
    ) as caught:
        choose(DEVICES, APIS, "JACK", "system")
    assert caught.value.absent


def test_given_no_such_device_then_it_names_those_there_are():
    with pytest.raises(DeviceChoiceError, match=r"'ASIO4ALL v2' \(ASIO, 2 channels, 48000 Hz\)") as caught:
        choose(DEVICES, APIS, "ASIO", "Babyface")
    assert "Speakers" not in caught.value.cause
    assert caught.value.absent


class TestOnAlsa:
    """Refusals of the real library."""

    pytestmark = linux_only

    def refusal(self, bench, folder, **settings):
        interface = AlsaFile(folder)
        with pytest.raises(InstrumentError) as caught:
            bench.player(interface, **settings)
        assert not isinstance(caught.value, InstrumentLostError)
        assert caught.value.operation == "opening"
        return caught.value

    def test_given_a_name_that_is_not_there_then_it_names_what_is(self, bench, tmp_path):
        error = self.refusal(bench, tmp_path, device="Babyface")
        assert error.instrument == "player Babyface"
        assert "no output of that name; host API 'ALSA' has 'filed'" in error.cause

    def test_given_a_host_api_that_is_not_there_then_it_names_what_is(self, bench, tmp_path):
        assert "'ALSA'" in self.refusal(bench, tmp_path, host_api="ASIO").cause

    def test_given_too_few_channels_then_it_says_how_many_there_are(self, bench, tmp_path):
        error = self.refusal(bench, tmp_path, channels=200, channel_full_scale_v=(1.0,) * 200)
        assert "needs 200 channels" in error.cause
        assert "'filed' (ALSA, 128 channels" in error.cause
        assert "player.channels" in error.remedy

    def test_given_a_rate_that_it_does_not_run_at_then_it_says_where_to_set_it(self, bench, tmp_path):
        error = self.refusal(bench, tmp_path, interface_rate_hz=1)
        assert "does not run at 1 Hz" in error.cause
        assert "player.interface_rate_hz" in error.remedy

    @pytest.mark.parametrize("full_scale_v", [(1.0, 1.0), (1.0, float("nan"), 1.0)])
    def test_given_full_scale_voltages_that_do_not_fit_then_it_says_what_is_allowed(
        self, bench, tmp_path, full_scale_v
    ):
        error = self.refusal(bench, tmp_path, channels=3, channel_full_scale_v=full_scale_v)
        assert "one finite voltage above 0 for each channel" in error.remedy

    def test_given_a_portaudio_that_cannot_be_loaded_then_it_says_what_to_install(self, tmp_path):
        # The loader finds an empty file first.
        (tmp_path / "libportaudio.so.2").write_bytes(b"")
        code, output, errors = run_python(OPENING, {"LD_LIBRARY_PATH": str(tmp_path)})
        assert code == 0, errors
        instrument, operation, cause, remedy = output.strip().split("|")
        assert (instrument, operation) == ("player filed", "opening")
        assert "the PortAudio library is missing or broken" in cause
        assert "apt install libportaudio2" in remedy


def test_given_no_sounddevice_then_it_says_how_to_install_it(tmp_path):
    # An environment of its own that has what the suite needs, and nothing more.
    packages = tmp_path / "packages"
    packages.mkdir()
    numpy = Path(find_spec("numpy").origin).parent
    for part in (numpy, numpy.with_name("numpy.libs")):
        if part.exists():
            (packages / part.name).symlink_to(part, target_is_directory=True)
    venv.create(tmp_path / "bare", with_pip=False, symlinks=sys.platform != "win32")
    python = next((tmp_path / "bare").glob("[bS]*/python*"))
    site = next((tmp_path / "bare").rglob("site-packages"))
    (site / "packages.pth").write_text(f"{packages}\n")
    code, output, errors = run_python(OPENING, {}, executable=python)
    assert code == 0, errors
    instrument, operation, cause, remedy = output.strip().split("|")
    assert (instrument, operation) == ("player filed", "opening")
    assert "the Python package sounddevice is missing" in cause
    assert remedy == "install it: pip install sounddevice"


def test_given_the_import_of_the_player_then_nothing_of_the_audio_library_is_loaded():
    code = "import sys, drivers.audio.stream.player; print('sounddevice' in sys.modules)"
    assert run_python(code, {})[1].strip() == "False"


@pytest.mark.parametrize("card", [1, 2])
def test_given_a_card_that_has_another_number_today_then_it_is_the_same_device(card: int) -> None:
    listed = OutputDevice(0, "ALSA", f"Fireface UCX: USB Audio (hw:{card},0)", 28, 48_000.0)
    assert listed.identity == DeviceIdentity("", "Fireface UCX: USB Audio")
