"""The paper's figures 3A-D and 4A-D, measured and drawn; our numbers go to `Paper.found`."""

from dataclasses import replace

import numpy as np

from wavefocus.benchmarks.paper_measures import (
    CLEAR_MM,
    SATURATION,
    Paper,
    fields_at,
    focus_fields,
    impulse_drive,
    line_scene,
    line_spectrum,
    moving_drive,
    row_at,
    smiling_face,
)
from wavefocus.benchmarks.rig_bank import BAND_HZ, rig_setup
from wavefocus.config.scene import Regularisation
from wavefocus.rendering.field import metrics
from wavefocus.rendering.field.foci import FOCUS_RADIUS_MM
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.field.wave_figures import correlation_over_distance, crosstalk_table
from wavefocus.rendering.greens.regularisation import focus_gain_map
from wavefocus.rendering.report.canvas import FAINT, INK, MAP_GAP_PX, TITLE_PX, Canvas, Panel, Picture, draw_maps
from wavefocus.rendering.report.figures import PREDICTION, SCAN
from wavefocus.rendering.report.waves import draw_correlation, draw_crosstalk
from wavefocus.rendering.scene.paths import Circle, TextPath
from wavefocus.rendering.scene.signals import Impulse
from wavefocus.rendering.verify.scan import scan

WIDTH_PX = 1120
LEFT_PX = 58
BAR_PX = (WIDTH_PX / 2 - 180, 8.0, 360.0, 10.0)
BLUE, ORANGE = "#0072b2", "#d55e00"  # Okabe & Ito's, for the colour-blind
AROUND_MS = (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0, 24.0)
FOCUS_MM = (-30.0, 12.0)
NEGLIGIBLE = 0.01
"""Crosstalk (energy ratio) that we call negligible; the paper does not say."""
SPEEDS_CM_S = (4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 100.0)
STEPS = (1, 2, 4, 6)
SEEDS, QUICK_SEEDS = 8, 2


def _figure_3a(paper: Paper) -> Picture:
    """Field of an impulse around the focus instant, relative to its value at the focus."""
    bank, surface = paper.bank, paper.surface()
    row = row_at(bank, *FOCUS_MM)
    samples = [round(time_ms * 1e-3 * bank.sample_rate_hz) for time_ms in AROUND_MS]
    fields = fields_at(impulse_drive(bank, row, SATURATION), bank, samples).astype(np.float64)
    width = (WIDTH_PX - LEFT_PX - 8) / 4 - MAP_GAP_PX
    canvas = Canvas("3A", WIDTH_PX, 84 + -(-len(fields) // 4) * (surface.height_px(width) + TITLE_PX) + 26)
    titles = [
        f"t = T {'+' if time > 0 else '−'} {abs(time):g} ms" if time else "t = T, the focus" for time in AROUND_MS
    ]
    panels = [Panel(title, one, bank.position_mm[[row]]) for title, one in zip(titles, fields, strict=True)]
    cells = draw_maps(canvas, surface, panels, (LEFT_PX, 84, width), columns=4, limits=(-1.0, 1.0), colours="RdBu_r")
    canvas.colour_bar(cells, BAR_PX, "y(x, t) over its value at the focus, all panels", extend="both")
    return canvas.picture()


def _figure_3b(paper: Paper) -> Picture:
    """Field of a focus near an actuator with and without saturation, and the actuators' relative rms drive."""
    bank, surface = paper.bank, paper.surface()
    row = row_at(bank, 86.0, 40.0)
    fields = [focus_fields(bank, [row], c)[0] for c in (None, SATURATION)]
    drives = [impulse_drive(bank, row, c).drive_v for c in (None, SATURATION)]
    rms = [np.sqrt(np.mean(np.square(drive), axis=1)) for drive in drives]
    levels = [
        metrics.artefact_level_db(bank.position_mm, one, bank.position_mm[row], FOCUS_RADIUS_MM) for one in fields
    ]
    active = [int(np.count_nonzero(one > 0.25 * one.max())) for one in rms]
    louder_db = metrics.level_db(float(np.abs(drives[0]).max() / np.abs(drives[1]).max()))
    paper.found["artefacts of a focus near an actuator, without and with saturation"] = (
        f"{levels[0]:.1f} dB and {levels[1]:.1f} dB", None,
    )  # fmt: skip
    paper.found["actuators that take part in that focus"] = f"{active[0]} and {active[1]} of 20", active[1] > active[0]
    paper.found["louder focus at the same peak drive, by saturation"] = f"{louder_db:+.1f} dB", louder_db > 0
    width = 360
    height = surface.height_px(width)
    canvas = Canvas("3B", WIDTH_PX, height + 140)
    titles = ("without saturation", f"with saturation, C = {SATURATION:g} median rms")
    panels = [Panel(title, np.abs(one)) for title, one in zip(titles, fields, strict=True)]
    cells = draw_maps(canvas, surface, panels, (LEFT_PX, 30, width), columns=2, limits=(0.0, 1.0))
    bar_px = (LEFT_PX + width - 170, height + 84, 360, 10)
    canvas.colour_bar(cells, bar_px, "|y(x, T)| over its value at the focus", extend="max")
    left_px = LEFT_PX + 2 * (width + MAP_GAP_PX) + 46
    number = np.arange(len(rms[0]))
    axes = canvas.plot(
        left_px, 30, WIDTH_PX - left_px - 10, height, xlabel="actuator", ylabel="relative rms drive", ylim=(0.0, 1.05),
        xticks=number[::2],
    )  # fmt: skip
    for one, place, colour, label in zip(rms, (-0.2, 0.2), (INK, BLUE), ("without", "with saturation"), strict=True):
        axes.bar(number + place, one / one.max(), 0.4, color=colour, label=label)
    axes.margins(x=0.01)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, columnspacing=1.0)
    return canvas.picture()


def _figure_3c(paper: Paper) -> Picture:
    """Normalisation n(x) over the surface."""
    bank, surface = paper.bank, paper.surface()
    gains = {"range of n(x) with saturation": focus_gain_map(bank, Regularisation(saturation=SATURATION)),
             "range of n(x) without": focus_gain_map(bank, Regularisation())}  # fmt: skip
    for name, gain in gains.items():
        whole, clear = (
            metrics.gain_range_db(gain, bank.position_mm, bank.actuator_mm, clear_mm) for clear_mm in (0.0, CLEAR_MM)
        )
        text = f"{whole:.0f} dB; {clear:.0f} dB further than {CLEAR_MM:g} mm from actuators"
        paper.found[name] = text, clear <= 17.0
    gain = gains["range of n(x) with saturation"]
    gain_db = 20.0 * np.log10(gain / np.nanmin(gain))
    width = 620
    height = surface.height_px(width)
    canvas = Canvas("3C", width + 180, height + 66 + TITLE_PX)
    known = np.flatnonzero(np.isfinite(gain_db))
    panels, limits = [Panel("normalisation n(x)", gain_db[known])], (0.0, float(gain_db[known].max()))
    cells = draw_maps(canvas, surface, panels, (LEFT_PX, 12 + TITLE_PX, width), columns=1, limits=limits, rows=known)
    bar_px = (LEFT_PX + width + 24, 12 + TITLE_PX + 0.1 * height, 12, 0.8 * height)
    canvas.colour_bar(cells, bar_px, "n(x) (dB above its least)")
    return canvas.picture()


def _figure_3d(paper: Paper) -> Picture:
    """A focus scanned on the virtual rig and its prediction: at the focus instant, and waveforms."""
    bank, surface = paper.bank, paper.surface()
    row = row_at(bank, *FOCUS_MM)
    drive = impulse_drive(bank, row, SATURATION)
    # Largest drive of the scanned focus.
    drive = replace(drive, drive_v=drive.drive_v * (0.5 / float(np.abs(drive.drive_v).max())))
    gap_mm = np.hypot(*(bank.position_mm - bank.position_mm[row]).T)
    rows = np.flatnonzero(gap_mm < 24.0).tolist() if paper.quick else list(range(bank.positions))
    found = scan(rows, rig_setup(paper.rig), drive, bank)
    index = found.position_index
    measured, expected = (
        metrics.band_limited(one, bank.sample_rate_hz, BAND_HZ).astype(np.float32)
        for one in (found.field, predict(drive, bank, index.tolist(), dtype=np.float32).field)
    )
    error, alike = metrics.normalised_error(measured, expected), metrics.correlation(measured, expected)
    paper.found["measured and predicted field"] = (
        f"error {100 * error:.2f} %, correlation {alike:.5f}, {len(index)} positions", error < 0.05,
    )  # fmt: skip
    focus = round(-drive.start_s * bank.sample_rate_hz)
    width = 338
    height = surface.height_px(width)
    canvas = Canvas("3D", WIDTH_PX, 84 + height + 66 + 190)
    top = float(np.abs(expected[:, focus]).max())
    measured, expected = measured / top, expected / top
    maps = {
        "measured (virtual scan)": measured, "predicted (eq. 17)": expected, "difference": measured - expected,
    }  # fmt: skip
    panels = [Panel(title, values[:, focus], bank.position_mm[[row]]) for title, values in maps.items()]
    cells = draw_maps(
        canvas, surface, panels, (LEFT_PX, 84, width), columns=3, limits=(-1.0, 1.0), colours="RdBu_r", rows=index
    )
    canvas.colour_bar(cells, BAR_PX, "y(x, T) over its value at the focus, all panels", extend="both")
    window = slice(focus - 250, focus + 350)
    time_ms = 1e3 * np.arange(-250, 350) / bank.sample_rate_hz
    for place, gap in enumerate((0.0, 12.0, 20.0)):
        at = int(np.argmin(np.abs(gap_mm[index] - gap)))
        axes = canvas.plot(
            LEFT_PX + 14 + place * 360, 84 + height + 84, 300, 120, xlabel="t − T (ms)",
            title=f"{gap_mm[index[at]]:.0f} mm from the focus", xlim=(float(time_ms[0]), float(time_ms[-1])),
        )  # fmt: skip
        axes.plot(time_ms, expected[at, window], color=PREDICTION, lw=3.2, label="predicted")
        axes.plot(time_ms, measured[at, window], color=SCAN, lw=0.9, label="measured")
        if place == 0:
            axes.set_ylabel("y over its peak")
            axes.legend(loc="upper right")
    return canvas.picture()


def _figure_4a(paper: Paper) -> Picture:
    """Focus instants of a source on a circle, and the largest magnitude over all of them."""
    bank, path = paper.bank, Circle((0.0, 0.0), 30.0, 1.0)
    drive = moving_drive(bank, path, Impulse(), 80.0, 4.0)
    fields = fields_at(drive, bank, drive.focus_sample.tolist())
    off = []
    for one, point in zip(fields, path.point_at(4.0 * np.arange(len(fields))), strict=True):
        peak = metrics.focus_peak(bank.position_mm, one, point, FOCUS_RADIUS_MM)
        off.append(np.nan if peak is None else float(np.hypot(*(np.array(peak.at_mm) - point))))
    paper.found["foci of a circle at 8 cm/s"] = (
        f"median {np.nanmedian(off):.2f} mm off, worst {np.nanmax(off):.1f} mm", bool(np.nanmax(off) < 4.0),
    )  # fmt: skip
    surface = paper.surface(path.point_at(np.linspace(0.0, path.length_mm, 200)))
    width = 212
    left_px = LEFT_PX + 3 * (width + MAP_GAP_PX) + 54
    wide = WIDTH_PX - left_px - 8
    canvas = Canvas("4A", WIDTH_PX, 34 + 2 * (surface.height_px(width) + TITLE_PX) + 24)
    relative = np.abs(fields)
    chosen = np.linspace(0, len(fields), 7)[:6].astype(int).tolist()
    top = float(np.median(relative[chosen].max(axis=1)))
    panels = [Panel(f"t = {drive.focus_sample[at] / bank.sample_rate_hz:.2f} s", relative[at] / top) for at in chosen]
    draw_maps(canvas, surface, panels, (LEFT_PX, 34, width), columns=3, limits=(0.0, 1.0), path_colour="white")
    whole = [Panel("largest over all focus instants", relative.max(axis=0) / top)]
    cells = draw_maps(canvas, surface, whole, (left_px, 34, wide), columns=1, limits=(0.0, 1.0), path_colour="white")
    bar_px = (left_px, 34 + surface.height_px(wide) + 64, wide, 10)
    canvas.colour_bar(cells, bar_px, "|y(x, tₘ)| over the median peak", extend="max")
    return canvas.picture()


def _figure_4b(paper: Paper) -> Picture:
    """Largest magnitude over the focus instants of sources that draw letters and an emoji."""
    surface, panels = paper.surface(), []
    for name, path in (("letters", TextPath("TR", 44.0, (0.0, 0.0))), ("emoji", smiling_face(30.0))):
        drive = moving_drive(paper.bank, path, Impulse(), 80.0, 4.0)
        fields = np.abs(fields_at(drive, paper.bank, drive.focus_sample.tolist()))
        panels.append(Panel(f"{name}, 8 cm/s", fields.max(axis=0) / np.median(fields.max(axis=1))))
    width = (WIDTH_PX - LEFT_PX - 90) / 2 - MAP_GAP_PX
    height = surface.height_px(width)
    canvas = Canvas("4B", WIDTH_PX, height + 76)
    cells = draw_maps(canvas, surface, panels, (LEFT_PX, 28, width), columns=2, limits=(0.0, 1.0))
    bar_px = (WIDTH_PX - 84, 28 + 0.1 * height, 12, 0.8 * height)
    canvas.colour_bar(cells, bar_px, "largest |y| over focus instants, relative", extend="max")
    return canvas.picture()


def _figure_4c(paper: Paper) -> Picture:
    """A line of six points: fields of impulses, waveforms of bursts at the points, and their average spectrum."""
    bank, surface, seeds = paper.bank, paper.surface(), QUICK_SEEDS if paper.quick else SEEDS
    fast, slow = line_scene(bank, 250.0, 0.015), line_scene(bank, 100.0, 0.050)
    spectra = [
        ("25 cm/s", line_spectrum(bank, 250.0, 0.015, seeds)), ("10 cm/s", line_spectrum(bank, 100.0, 0.050, seeds)),
    ]  # fmt: skip
    share = spectra[1][1].share_within((150.0, 300.0))
    paper.found["spectrum at the path points"] = (
        f"{100 * share:.0f} % of the energy there, centroid {spectra[1][1].centroid_hz:.0f} Hz", share > 0.5,
    )  # fmt: skip
    points = len(fast.rows)
    width = (WIDTH_PX - LEFT_PX) / points - MAP_GAP_PX
    height = surface.height_px(width)
    canvas = Canvas("4C", WIDTH_PX, 30 + height + 92 + 340)
    top = float(np.median(np.abs(fast.fields).max(axis=1)))
    panels = [
        Panel(f"impulse {place}: |y| at t{chr(0x2080 + place)}", np.abs(one) / top, bank.position_mm[[row]])
        for place, (one, row) in enumerate(zip(fast.fields, fast.rows, strict=True), 1)
    ]
    draw_maps(canvas, surface, panels, (LEFT_PX, 30, width), columns=points, limits=(0.0, 1.0), ring_colour="white")
    below = 30 + height + 92
    for place, (title, scene) in enumerate((("25 cm/s, bursts of 15 ms", fast), ("10 cm/s, bursts of 50 ms", slow))):
        axes = canvas.plot(LEFT_PX + 10 + place * 372, below, 330, 290, xlabel="time (s)", title=title)
        rate_hz = scene.drive.sample_rate_hz
        time_s = scene.drive.start_s + np.arange(scene.responses.shape[1]) / rate_hz
        shown = (time_s > -0.04) & (time_s < scene.drive.focus_sample[-1] / rate_hz + 0.12)
        scale = 0.42 / float(np.abs(scene.responses).max())
        for point, response in enumerate(scene.responses):
            axes.plot(time_s[shown], point + 1 + scale * response[shown], color=BLUE, lw=0.7)
            axes.axvline(scene.drive.focus_sample[point] / rate_hz, color=FAINT, lw=0.7, ls="--", zorder=0)
        axes.set(yticks=np.arange(1, points + 1), ylim=(points + 0.7, 0.3))
        axes.set_xlim(float(time_s[shown][0]), float(time_s[shown][-1]))
        if place == 0:
            axes.set_ylabel("path point m; y(pₘ, t), one scale")
    axes = canvas.plot(
        LEFT_PX + 794, below, WIDTH_PX - LEFT_PX - 808, 290, xlabel="frequency (Hz)", xlim=(0, 600), ylim=(0.0, 1.2),
        ylabel="mean magnitude over its largest", title="spectrum at the path points",
    )  # fmt: skip
    for (label, spectrum), colour in zip(spectra, (BLUE, ORANGE), strict=True):
        shown = spectrum.frequency_hz <= 600.0
        axes.plot(spectrum.frequency_hz[shown], spectrum.mean[shown] / spectrum.mean.max(), color=colour, label=label)
    axes.legend(loc="upper right", ncols=2)
    return canvas.picture()


def _figure_4d(paper: Paper) -> Picture:
    """Crosstalk of impulses along a line of 30 rows over speed and path sample distance; correlation over distance."""
    bank = paper.bank
    line = [row_at(bank, x, 0.0) for x in np.arange(-58.0, 60.0, 4.0)]
    speeds = [10.0 * speed for speed in SPEEDS_CM_S]
    table = crosstalk_table(bank, line, 4.0, speeds, STEPS, Regularisation(saturation=SATURATION))
    near = [row_at(bank, x, y) for x in np.arange(-58.0, 60.0, 4.0) for y in (-4.0, 0.0, 4.0)]
    correlation = correlation_over_distance(bank, np.arange(2.0, 62.0, 4.0).tolist(), near)
    for speed, step in ((16.0, 1), (100.0, 4)):
        ratio = float(table.energy_ratio[SPEEDS_CM_S.index(speed), STEPS.index(step)])
        paper.found[f"crosstalk at d = {4 * step} mm, {speed:g} cm/s"] = f"{100 * ratio:.2f} %", ratio < NEGLIGIBLE
    paper.found["correlation of Green's functions 4 mm apart"] = f"{correlation.mean[0]:.2f}", None
    canvas = Canvas("4D", WIDTH_PX, 390)
    axes = canvas.plot(
        LEFT_PX + 22, 34, 500, 296, xlabel="speed v (cm/s)", ylabel="crosstalk: energy ratio (%)",
        title="crosstalk of impulses along a line",
    )  # fmt: skip
    draw_crosstalk(axes, table, 100.0)
    axes.axvline(16.0, color=FAINT, lw=0.8, ls=":")
    axes = canvas.plot(
        LEFT_PX + 602, 34, 440, 296, xlabel="distance (mm)", ylabel="correlation at lag 0",
        title="Green's functions: mean, and 10 to 90 % of all pairs",
    )  # fmt: skip
    draw_correlation(axes, correlation, (-0.6, 1.0))
    return canvas.picture()


FIGURES = {
    "3A": _figure_3a, "3B": _figure_3b, "3C": _figure_3c, "3D": _figure_3d,
    "4A": _figure_4a, "4B": _figure_4b, "4C": _figure_4c, "4D": _figure_4d,
}  # fmt: skip
