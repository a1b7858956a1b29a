"""Which output is meant, and a sentence for each way of not getting it."""

import sys
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest

from tests.wire.audio_bench import AudioBench
from wavefocus.drivers.audio.stream import DeviceChoiceError, OutputDevice, StreamRequest, WatchedStream, choose
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.protocols import DeviceIdentity

APIS = ("MME", "ASIO", "Windows WASAPI", "Core Audio")
DEVICES = (
    OutputDevice(3, "MME", "Fireface UCX (1+2)", 2, 44_100.0),
    OutputDevice(7, "ASIO", "Fireface UCX", 28, 48_000.0),
    OutputDevice(8, "ASIO", "ASIO4ALL v2", 2, 48_000.0),
    OutputDevice(9, "Windows WASAPI", "Speakers (Fireface UCX)", 8, 48_000.0),
    OutputDevice(10, "Windows WASAPI", "Line (3- UMC1820)", 10, 48_000.0),
    *(OutputDevice(index, "Core Audio", "AVB 24", 24, 48_000.0) for index in (11, 12)),
)


@pytest.mark.parametrize(
    ("host_api", "name", "found"),
    [
        ("ASIO", "Fireface UCX", 7),
        ("asio", "fireface ucx", 7),
        ("ASIO", "Fireface", 7),
        (None, "Fireface UCX", 7),  # the one of exactly that name
        (None, "Speakers", 9),
        ("MME", "UCX", 3),
        (None, "Line (3- UMC1820)", 10),
        (None, "Line (2- UMC1820)", 10),  # in another socket than when the rig file was written
        (None, "line (umc1820)", 10),
        ("Core Audio", "AVB", "2 outputs are called that: 'AVB 24' .*where both have one name, unplug one or rename"),
        (None, "Fire", r"3 outputs.*'Fireface UCX \(1\+2\)' \(MME.*player.host_api"),
        ("JACK", "system", "no host API 'JACK'; there are 'MME', 'ASIO', 'Windows WASAPI', 'Core Audio'; .*host_api"),
        ("ASIO", "Babyface", r"'ASIO' has 'Fireface UCX' .*'ASIO4ALL v2' \(ASIO, 2 channels, 48000 Hz\);"),
    ],
)
def test_a_host_api_and_a_part_of_a_name_mean_one_device_or_it_says_which_there_are(host_api, name, found):
    if isinstance(found, int):
        assert choose(DEVICES, APIS, host_api, name).index == found
        return
    with pytest.raises(DeviceChoiceError, match=found) as caught:
        choose(DEVICES, APIS, host_api, name)
    assert caught.value.absent == (name not in ("Fire", "AVB"))


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("Speakers (2- Scarlett 18i20 USB)", "Speakers (3- Scarlett 18i20 USB)", True),
        ("Speakers (Scarlett 18i20 USB)", "Speakers (12- Scarlett 18i20 USB)", True),
        ("Speakers (2- Scarlett 18i20 USB)", "Speakers (2- Scarlett 18i8 USB)", False),
        ("Analog 1-2 (UMC)", "Analog 3-4 (UMC)", False),
        ("Fireface UCX: USB Audio (hw:1,0)", "Fireface UCX: USB Audio (hw:2,0)", True),
    ],
)
def test_given_the_number_that_windows_or_alsa_counts_by_then_it_is_the_same_device(one, other, same):
    api = "ALSA" if "hw:" in other else "Windows WASAPI"
    identities = [OutputDevice(1, api, name, 8, 48_000.0).identity for name in (one, other)]
    assert (identities[0] == identities[1]) == same
    if api != "ALSA":  # as an earlier version wrote it into a calibration
        assert DeviceIdentity("", one).is_same(identities[1]) == same


class AllOrNothing:
    """The calls of the package sounddevice, as an interface answers that opens only with all its 24 channels."""

    class PortAudioError(Exception):
        pass

    class OutputStream:
        latency = 0.01
        active = True

        def __init__(self, *, channels, callback, **settings):
            self.opened, self.callback = channels, callback

        def start(self):
            self.buffer = np.full((16, self.opened), np.nan, dtype=np.float32)
            self.callback(self.buffer, 16, None, SimpleNamespace(output_underflow=False))

    def query_hostapis(self):
        return [{"name": "ASIO"}]

    def query_devices(self):
        return [{"index": 0, "hostapi": 0, "name": "AVB 24", "max_output_channels": 24, "default_samplerate": 48e3}]

    def check_output_settings(self, *, channels, **settings):
        if channels != 24:
            raise self.PortAudioError("Invalid number of channels", -9998)


def test_an_interface_that_needs_all_channels_gets_all_and_no_more_than_there_are():
    stream = WatchedStream(AllOrNothing(), StreamRequest("ASIO", "AVB 24", 7, 48_000, 0))
    assert stream._stream.opened == 24
    assert (stream._stream.buffer == 0).all()
    with pytest.raises(DeviceChoiceError, match="needs 25 channels"):
        WatchedStream(AllOrNothing(), StreamRequest("ASIO", "AVB 24", 25, 48_000, 0))


@pytest.mark.may_skip("ALSA and the loader's path are Linux's")
@pytest.mark.skipif(sys.platform != "linux", reason="needs ALSA")
@pytest.mark.parametrize(
    ("settings", "cause", "remedy"),
    [
        ({"device": "Babyface"}, "no output of that name; host API 'ALSA' has 'filed'", "player.device"),
        ({"channels": 200, "channel_full_scale_v": (1.0,) * 200}, "needs 200 channels, 'filed' (ALSA, 128 channels",
         "player.channels"),
        ({"interface_rate_hz": 1}, "does not run at 1 Hz", "player.interface_rate_hz"),
        # The loader finds an empty file first.
        ({"environment": {"LD_LIBRARY_PATH": "."}}, "PortAudio library is missing or broken", "install libportaudio2"),
        ({"channels": 3, "channel_full_scale_v": (1.0, 1.0)}, "", "one finite voltage above 0 for each channel"),
        ({"channels": 3, "channel_full_scale_v": (1.0, np.nan, 1.0)}, "", "one finite voltage above 0"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)  # fmt: skip
def test_what_library_refuses_then_it_says_what_there_is_and_which_key_to_correct(
    tmp_path, monkeypatch, settings, cause, remedy
):
    # An ALSA device that writes into a file. Without ALSA's own description PortAudio aborts when it lists devices.
    description = tmp_path / "asound.conf"
    description.write_text(f'pcm.filed {{ type file file "{tmp_path}/frames.raw" format "raw" slave.pcm "null" }}\n')
    environment = {"ALSA_CONFIG_PATH": f"/usr/share/alsa/alsa.conf:{description}"}
    (tmp_path / "libportaudio.so.2").touch()
    monkeypatch.chdir(tmp_path)
    filed = SimpleNamespace(host_api="ALSA", device="filed", environment=environment)
    with ExitStack() as stack, pytest.raises(InstrumentError) as caught:
        AudioBench(stack).player(filed, **settings)
    assert not isinstance(caught.value, InstrumentLostError)
    assert caught.value.instrument == f"player {settings.get('device', 'filed')}"
    assert caught.value.operation == "opening"
    assert cause in caught.value.cause
    assert remedy in caught.value.remedy
