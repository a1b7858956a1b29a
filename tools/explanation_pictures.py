"""Draw the pictures of docs/explanation: a record to its Green's function, power cuts, a scene to its drives and field.

python -m tools.explanation_pictures docs/pictures
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.system.crash.logged import INODE, LoggedFile, WithoutSecondBarrier
from tests.system.crash.power_cuts import Disk, images
from tests.system.test_bank_crash import green_of, header, record_of
from tools.compare_versions import bank_of
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Line
from wavefocus.rendering.scene.sampling import sample_scene
from wavefocus.rendering.scene.signals import Noise
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank

RATE_HZ, TAPS, PPM, START = 10_000.0, 2000, 30e-6, 412.37
PLACE_MM, ACTUATOR = (22.0, 12.0), 3
NOISE_V, M_S_PER_V = 5e-3, 0.125


def draw_recording(folder: Path) -> None:
    """Write recording-to-green.png into a folder."""
    from matplotlib.figure import Figure

    excitation = PlayedExcitation(RATE_HZ, 20.0, 500.0, 1.0, 0.2, 1.0, 3)
    truth = VirtualRig().truth(*PLACE_MM, TAPS)[ACTUATOR] / M_S_PER_V
    reference, response = _record(excitation, truth)
    found = SequentialEstimator(excitation, TAPS).estimate(reference[None], response[None], range_v=(10.0, 10.0))
    green, period = found.green[0].astype(np.float64), excitation.period_samples
    hertz = np.fft.rfftfreq(period, 1 / RATE_HZ)
    band = (hertz >= 20) & (hertz <= 500)
    repeats = [
        np.fft.rfft(channel[round(START) :][: 3 * period].reshape(3, period))[:, band]
        for channel in (reference, response)
    ]
    averaged = (repeats[0].conj() * repeats[1]).sum(axis=0) / np.square(np.abs(repeats[0])).sum(axis=0)
    fitted, wanted = (np.fft.rfft(fir, period)[band] for fir in (green, truth))

    figure = Figure(figsize=(11, 6.6), layout="constrained")
    axes = figure.subplots(2, 2)
    time_s = np.arange(len(reference)) / RATE_HZ
    axes[0, 0].plot(time_s, reference, lw=0.5, color="#777777", label="reference (V)")
    times = round(1 / float(np.abs(response).max()))
    axes[0, 0].plot(time_s, times * response - 2.4, lw=0.5, color="#0b5fa5", label=f"response ({times} x V)")
    axes[0, 0].set(
        title="1  record: three sweeps, both DAQ channels", xlabel="DAQ time (s)", yticks=[], ylim=(-4.6, 1.2)
    )
    axes[0, 0].legend(loc="lower right", fontsize=8, ncols=2)

    def level_db(spectrum: np.ndarray) -> np.ndarray:
        return np.asarray(20 * np.log10(np.abs(spectrum)))

    axes[0, 1].plot(hertz[band], level_db(averaged), lw=0.7, color="#bbbbbb", label="averaged quotient H")
    axes[0, 1].plot(hertz[band], level_db(fitted), lw=1.2, color="#0b5fa5", label="causal FIR of 2000 taps")
    axes[0, 1].set(title="2  transfer function", xlabel="frequency (Hz)", ylabel="dB re 1 V/V")
    axes[0, 1].legend(loc="lower right", fontsize=8)
    axes[1, 0].plot(hertz[band], level_db(averaged - wanted), lw=0.6, color="#bbbbbb", label="error of H")
    axes[1, 0].plot(hertz[band], level_db(fitted - wanted), lw=1.0, color="#b3541e", label="error of the FIR")
    axes[1, 0].set(title="3  error against the plate's true response", xlabel="frequency (Hz)", ylabel="dB re 1 V/V")
    axes[1, 0].legend(loc="lower right", fontsize=8)
    tap_ms = 1e3 * np.arange(TAPS) / RATE_HZ
    axes[1, 1].plot(tap_ms, _in_band(green, period, band), lw=1.4, color="#0b5fa5", label="estimated, 20-500 Hz")
    axes[1, 1].plot(tap_ms, _in_band(truth, period, band), lw=0.8, ls="--", color="#222222", label="true, 20-500 Hz")
    axes[1, 1].set(title="4  Green's function", xlabel="time (ms)", ylabel="V/V per sample", xlim=(0, 80))
    axes[1, 1].legend(loc="upper right", fontsize=8)
    for panel in axes.ravel():
        panel.title.set_fontsize(10)
        panel.spines[["top", "right"]].set_visible(False)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "recording-to-green.png", dpi=110)
    error_db = 10 * np.log10(np.sum(np.abs(fitted - wanted) ** 2) / np.sum(np.abs(wanted) ** 2))
    print(f"clock {1e6 * (found.clock_ratio[0] - 1):.3f} ppm, start {found.offset_samples[0]:.4f} samples")
    print(f"residual {found.residual_db[0]:.1f} dB, error {error_db:.1f} dB")


def _record(excitation: PlayedExcitation, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reference and response of one record on the DAQ's clock, with noise: float32 (samples,) each."""
    from scipy.interpolate import CubicSpline
    from scipy.signal import resample

    played = np.concatenate([excitation.signal_v(), np.zeros(4000)])
    answer = np.convolve(played, truth)[: len(played)]
    place = (np.arange(len(played) + 1000) - START) / (1 + PPM)
    draw = np.random.default_rng(1)
    channels = []
    for signal, noise_v in ((played, 1e-4), (answer, NOISE_V)):
        finer = resample(signal, 8 * len(signal))
        wave = CubicSpline(np.arange(len(finer)) / 8, finer)(np.clip(place, 0.0, len(signal) - 1.0))
        channels.append((wave + noise_v * draw.standard_normal(len(place))).astype(np.float32))
    return channels[0], channels[1]


def _in_band(fir: np.ndarray, period: int, band: np.ndarray) -> np.ndarray:
    """A FIR without what lies outside of a band."""
    spectrum = np.fft.rfft(fir, period)
    return np.asarray(np.fft.irfft(np.where(band, spectrum, 0), period)[: len(fir)])


def draw_power_cuts(folder: Path, count: int = 12) -> None:
    """Write power-cuts.png into a folder: what is found after a cut at any call, with both syncs and without one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    writers = {"with both syncs": LoggedFile, "without the second sync": WithoutSecondBarrier}
    for axes, (name, opened) in zip(figure.subplots(1, 2, sharey=True), writers.items(), strict=True):
        with TemporaryDirectory() as place:
            bank = Path(place, "bank.h5")
            create_bank(bank, header(count))
            before, committed = bank.read_bytes(), [0]
            with BankWriter.open(bank, open_file=opened) as writer:
                LoggedFile.log.clear()
                for position in range(count):
                    writer.commit(position, green_of(position, 1), record_of(position, 1))
                    committed.append(len(LoggedFile.log))
            cuts = list(images(Disk({bank: before}, {bank: INODE}), list(LoggedFile.log), np.random.default_rng(1), 6))
            found = np.array([(cut.step, _whole_positions(bank, cut.files[str(bank)])) for cut in cuts])
        promised = np.searchsorted(committed, found[:, 0], "right") - 1
        lost = found[:, 1] < promised
        axes.step(committed, range(count + 1), where="post", color="#222222", lw=1.2, label="reported as committed")
        axes.plot(*found[~lost].T, ".", color="#0b5fa5", ms=6, label=f"found after the cut, {np.sum(~lost)} cuts")
        if lost.any():
            axes.plot(*found[lost].T, "x", color="#b3541e", ms=6, label=f"fewer than reported, {np.sum(lost)} cuts")
        axes.set(title=name, xlabel="calls (writes and syncs) before the power cut", ylabel="positions")
        axes.legend(loc="upper left", fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "power-cuts.png", dpi=110)


def _whole_positions(path: Path, content: bytes) -> int:
    path.write_bytes(content)
    with open_bank(path) as bank:
        return len(set(np.flatnonzero(bank.status).tolist()).difference(bank.verify()))


def draw_scene(folder: Path) -> None:
    """Write scene-to-drive.png into a folder: a noise source that moves over the bank of `tools.compare_versions`."""
    from matplotlib.figure import Figure

    bank = bank_of()
    rate_hz = float(bank.sample_rate_hz)
    path = Line((-12.0, 0.0), (12.0, 0.0))
    scene = Scene("line", (Source(path, Noise((50, 400), 0.14, 2), 0.0, 200.0, 4.0),))
    drive, _ = render_with_report(scene, bank, method="sampled")
    field = predict(drive, bank)
    source = sample_scene(scene, bank, "sampled").sources[0]
    rows, hop = BankRows(bank, scene.regularisation), round(0.02 * rate_hz)
    emitted = source.emission.events(0, 3 * hop)
    visited = emitted.rows[::hop, 0]
    gain, _ = rows.weigh(visited, visited)

    figure = Figure(figsize=(11, 8), layout="constrained")
    axes = figure.subplots(2, 2)
    time_ms = 1e3 * np.arange(3 * hop) / rate_hz
    for row, factor in zip(visited.tolist(), gain / gain.max(), strict=True):
        window = np.where(emitted.rows[:, 0] == row, factor * emitted.values, 0.0)
        axes[0, 0].plot(time_ms, window, lw=1.4, label=f"row {row}")
    axes[0, 0].plot(time_ms, 0.7 * emitted.values, color="#777777", lw=0.7, label="signal")
    axes[0, 0].set(title="1. Windows: samples that each row emits in a block", xlabel="time in ms", yticks=[])
    axes[0, 0].legend(loc="upper left", fontsize=8, frameon=False, ncols=2)
    green, tap_ms = bank.values[visited[0], 3], 1e3 * np.arange(bank.taps) / rate_hz
    axes[0, 1].plot(tap_ms, green, color="#999999", label="g(t), as measured")
    axes[0, 1].plot(tap_ms, green[::-1], label="reversed in time")
    axes[0, 1].set(title="2. One Green's function of a row", xlabel="time in ms", yticks=[])
    axes[0, 1].legend(loc="lower center", fontsize=8, frameon=False)
    drive_ms = 1e3 * (drive.start_s + np.arange(drive.drive_v.shape[1]) / rate_hz)
    for actuator, volts in enumerate(drive.drive_v):
        axes[1, 0].plot(drive_ms, actuator + 0.5 * volts / np.abs(drive.drive_v).max(), color="#1f77b4", lw=0.7)
    axes[1, 0].axvline(0.0, color="#444444", lw=0.8, ls="--")
    axes[1, 0].set(title="3. Drives of all actuators", xlabel="time in ms (0: first focus)", ylabel="actuator")
    focus = round((0.05 - field.start_s) * rate_hz)
    sample = focus + int(np.argmax(np.abs(field.field[visited[2], focus - hop // 2 : focus + hop // 2]))) - hop // 2
    snapshot = field.field[:, sample]
    most = float(np.abs(snapshot).max())
    axes[1, 1].tripcolor(*bank.position_mm.T, snapshot, shading="gouraud", cmap="RdBu_r", vmin=-most, vmax=most)
    axes[1, 1].plot(*path.point_at([0.0, path.length_mm]).T, color="black", lw=1.0)
    shown_ms = 1e3 * (field.start_s + sample / rate_hz)
    title = f"4. Predicted field, {shown_ms:.0f} ms after the first focus"
    axes[1, 1].set(title=title, xlabel="x in mm", ylabel="y in mm", aspect="equal")
    for panel in axes.ravel():
        panel.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "scene-to-drive.png", dpi=100)


if __name__ == "__main__":
    draw_recording(Path(sys.argv[1]))
    draw_power_cuts(Path(sys.argv[1]))
    draw_scene(Path(sys.argv[1]))
