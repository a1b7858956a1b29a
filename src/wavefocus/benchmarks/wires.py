"""Production drivers on emulated wires: how well clocks are recovered.

The emulated instruments (serial mirror, gRPC Device Server, JACK server on a dummy driver) run in processes of their
own, all in real time.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from wavefocus.acquisition.setup import Setup, take_record
from wavefocus.benchmarks.harness import Entry, Findings, Mark
from wavefocus.benchmarks.rig_bank import RATE_HZ
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.calibration.timing import ClockFitter
from wavefocus.config.rig import RigConfig
from wavefocus.drivers.audio.resampling import HALF_STEP, converted, lead_samples, rate_ratio
from wavefocus.drivers.audio.stream.player import StreamPlayer
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drivers.protocols import Float64Array, RecordLabel
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.setup import open_rig
from wavefocus.rig.virtual_bench import virtual_settings

ACTUATOR_MM = ((110.0, 0.0), (0.0, 60.0), (-110.0, 10.0), (20.0, -60.0))
SWEEP_V = 1.0
INTERFACE_RATE_HZ = 48_000
DEVICE = "wavefocus interface"


def rig_at(mirror: str = "socket://127.0.0.1:0", recorder: str = "localhost:0") -> RigConfig:
    """The rig, with the addresses of mirror and recorder; port 0 is any free one."""
    return RigConfig.model_validate({
        "actuators": {"position_mm": ACTUATOR_MM},
        "mirror": {"driver": "generic", "port": mirror, "settle_s": 0.0},
        "recorder": {
            "driver": "nidaqmx", "device": "Dev1", "address": recorder, "reference_range_v": 5.0, "post_roll_s": 0.4,
        },
        "player": {"driver": "sounddevice", "device": DEVICE, "interface_rate_hz": INTERFACE_RATE_HZ},
        # 60 dB below the rms of a sweep of 1 V peak.
        "emulation": {"reference_noise_v": SWEEP_V / np.sqrt(2) / 1000},
    })  # fmt: skip


def excitation(sweep_s: float, averages: int) -> PlayedExcitation:
    """Signal of each record."""
    return PlayedExcitation(RATE_HZ, 20.0, 500.0, sweep_s, 0.2, SWEEP_V, averages)


def _serve_instruments() -> None:
    """Be the emulated instruments until standard input ends; a line asks for the starts received since the last."""
    from wavefocus.mocks.wire.emulated_rig import EmulatedRig

    rig = rig_at()
    with EmulatedRig(virtual_settings(rig), rig) as sides:
        assert sides.mirror is not None  # it is on a serial line
        places = {"mirror": sides.mirror.address, "recorder": sides.recorder.address}
        print(json.dumps({**places, "environment": sides.audio.environment}), flush=True)
        for _ in sys.stdin:
            print(json.dumps(list(sides.bench.onsets)), flush=True)
            sides.bench.onsets.clear()


class EmulatedInstruments:
    """The emulated instruments in a process of their own."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "wavefocus.benchmarks.wires"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._keyboard, self._screen = self._process.stdin, self._process.stdout
        places = json.loads(self._screen.readline())
        self.mirror, self.recorder, self.environment = places["mirror"], places["recorder"], places["environment"]

    def received(self) -> list[float]:
        """At which sample the sound began in each record since the last question."""
        self._keyboard.write("starts\n")
        self._keyboard.flush()
        starts: list[float] = json.loads(self._screen.readline())
        return starts

    def close(self) -> None:
        """End them."""
        self._keyboard.close()
        self._process.wait(30)
        self._screen.close()


@contextmanager
def opened(sides: EmulatedInstruments) -> Iterator[Setup]:
    """Production drivers on the emulated instruments."""
    rig = rig_at(sides.mirror, sides.recorder)
    player = partial(
        StreamPlayer, "JACK Audio Connection Kit", DEVICE, channels=rig.player.outputs,
        channel_full_scale_v=rig.player.output_full_scale_v, interface_rate_hz=INTERFACE_RATE_HZ,
        environment=sides.environment,
    )  # fmt: skip
    setup = open_rig(replace(openers_of(rig), player=player))
    try:
        yield setup
    finally:
        setup.close()


def _clock_errors(
    setup: Setup, sides: EmulatedInstruments, records: int, sweep: PlayedExcitation
) -> tuple[Float64Array, Float64Array, int]:
    """Errors of the clock ratio in ppm and of the start offset in samples, of each record; how many were repeated."""
    signal_v = sweep.signal_v()
    fitter = ClockFitter(signal_v)
    # The first frame that is received is the first one that the player does not leave out as silence, near sample 0.
    ratio, true_ratio = rate_ratio(RATE_HZ, INTERFACE_RATE_HZ), virtual_settings(rig_at()).clock_ratio
    full_scale_v = setup.player.full_scale_v
    frames = np.flatnonzero(np.abs(converted(signal_v, ratio).astype(np.float32)) > HALF_STEP * full_scale_v)
    first = (frames[0] - lead_samples(ratio)) / INTERFACE_RATE_HZ * RATE_HZ * true_ratio
    ratio_ppm: list[float] = []
    offset: list[float] = []
    repeated = 0
    sides.received()
    while len(offset) < records:
        signals_v = {setup.actuator_channels[0]: signal_v, setup.loopback_channel: signal_v}
        try:
            recording = take_record(setup, signals_v, RATE_HZ, RecordLabel(0, 1, len(offset)))
        except TransientInstrumentError:
            sides.received()
            repeated += 1
            continue
        fit = fitter.fit(recording.volts[0].astype(np.float64))
        ratio_ppm.append(1e6 * (fit.ratio - true_ratio))
        offset.append(fit.offset_samples + first - sides.received()[-1])
    return np.array(ratio_ppm), np.array(offset), repeated


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Measure clocks on the wires."""
    records, averages, sweep_s = (2, 1, 0.3) if quick else (12, 3, 1.0)
    with closing(EmulatedInstruments()) as sides, opened(sides) as setup:
        ratio_ppm, offset, repeated = _clock_errors(setup, sides, records, excitation(sweep_s, averages))
    return Findings(
        [
            _point("clock ratio, reference at 60 dB", "rms_ppm", ratio_ppm, 0.1),
            _point("start offset, reference at 60 dB", "rms_samples", offset, 0.01),
        ],
        "the clocks of the emulated instruments",
        [f"{records} records, {averages} x {sweep_s:g} s sweeps; repeated as the audio server ran dry: {repeated}."],
    )


def _point(method: str, figure: str, values: Float64Array, limit: float) -> Entry:
    """Rms of some values and the worst of them."""
    figures = {figure: float(np.sqrt(np.mean(values**2))), "worst": float(np.abs(values).max())}
    marks = (Mark(figure, limit, at_most=True),)
    return Entry(work="production drivers on emulated wires", method=method, figures=figures, marks=marks)


if __name__ == "__main__":
    _serve_instruments()
