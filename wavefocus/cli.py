"""The command line: names, arguments and help of every command; the work is in ``wavefocus.commands``."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from benchmarks import BENCHMARKS
from storage.exchange import EXPORTS

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    rich_markup_mode=None,  # help as plain text: rich would take longer to load than all else
    help=(
        "Measure a plate's Green's functions overnight, render moving tactile sources by time reversal, "
        "and check the focusing against new scans. Start with: wavefocus init lab"
    ),
)


def _finite(value: float | None) -> float | None:
    """Refuse NaN and infinity, which pass every comparison with a bound or none."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value


def _one_of(names: Iterable[str]) -> Callable[[str], str]:
    """Refuse a name that a registry does not have."""
    allowed = tuple(names)

    def check(name: str) -> str:
        if name not in allowed:
            raise typer.BadParameter(f"{name!r} is not one of {', '.join(allowed)}")
        return name

    return check


def _number(*names: str, **settings: Any) -> Any:
    """Declare an option that takes a finite number."""
    return typer.Option(*names, callback=_finite, **settings)


class RigKind(StrEnum):
    """Which rig file ``init`` writes."""

    VIRTUAL = "virtual"
    TEMPLATE = "template"
    EMULATED = "emulated"


class Person(StrEnum):
    """Where ``calibrate`` asks the person at the bench."""

    TERMINAL = "terminal"
    LINES = "lines"


class Method(StrEnum):
    """How a moving source is rendered."""

    SAMPLED = "sampled"
    EXACT = "exact"


class Focusing(StrEnum):
    """How waves are made to meet."""

    TIME_REVERSAL = "time-reversal"
    INVERSE = "inverse"


class ComputingDevice(StrEnum):
    """Where ``render`` and ``predict`` compute."""

    CPU = "cpu"
    CUDA = "cuda"


class Missing(StrEnum):
    """What becomes of positions without a measurement."""

    LEAVE_OUT = "leave-out"
    NAN = "nan"


class Per(StrEnum):
    """What one sound file holds."""

    POSITION = "position"
    ACTUATOR = "actuator"


BankArgument = Annotated[Path, typer.Argument(metavar="BANK.h5", help="The bank file.")]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN.toml", help="The run file.")]
RigArgument = Annotated[Path, typer.Argument(metavar="RIG.toml", help="The rig file.")]
SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE.toml", help="The scene file.")]
BankOption = Annotated[Path, typer.Option("--bank", metavar="BANK.h5", help="The bank file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]
JsonLines = Annotated[bool, typer.Option("--json", help="Print one JSON line per event on standard output.")]
DriftOption = Annotated[bool, typer.Option("--accept-drift", help="Go on although the sentinel position has changed.")]
CalibrationOption = Annotated[
    bool, typer.Option("--accept-calibration", help="Go on with another calibration, or on other devices than its own.")
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace older outputs; never an input, a bank or raw recordings.")
]
RigOption = Annotated[
    Path | None,
    typer.Option(
        "--rig", metavar="RIG.toml", help="A corrected rig file: other ports, device names, limits or time-outs."
    ),
]
WaitOption = Annotated[float, _number("--wait-s", min=0, max=86_400, help="Longest wait for it to be done.")]
ScenesOption = Annotated[
    list[Path] | None,
    typer.Option("--scene", metavar="SCENE.toml", help="Only the positions that this scene needs; may be repeated."),
]
ClusterOption = Annotated[
    str,
    typer.Option(
        "--cluster", metavar="ADDRESS", help="A dask scheduler, tcp://HOST:8786, or local, local:N: processes here."
    ),
]
AllowLargeOption = Annotated[
    bool, typer.Option("--allow-large", help="Allow scenes of over an hour, 8 GiB of drives or a million path points.")
]
NoChecksOption = Annotated[
    bool, typer.Option("--no-checks", help="With --scene: leave out the positions that only `verify` looks at.")
]


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"wavefocus {version('wavefocus')}")
        raise typer.Exit


@app.callback()
def wavefocus(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    traceback: Annotated[  # taken by `wavefocus.__main__.run`, wherever it stands; here for --help alone
        bool, typer.Option("--traceback", help="Show where in the program an error arose; or WAVEFOCUS_TRACEBACK=1.")
    ] = False,
    most_gib: Annotated[
        float | None,
        _number("--most-gib", help="Largest part of a file that is read at once, in GiB; 8 unless told otherwise."),
    ] = None,
) -> None:
    """Say what all commands share."""
    if most_gib is not None:
        os.environ["WAVEFOCUS_MOST_GIB"] = str(most_gib)  # for the processes that it starts, too


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to write; made when missing.")],
    rig: Annotated[
        RigKind, typer.Option("--rig", help="A virtual rig, a template of your own, or real drivers for `emulate`.")
    ] = (RigKind.VIRTUAL),
) -> None:
    """Write rig.toml, run.toml and scene.toml, commented."""
    from wavefocus.commands import init as command

    command.init(folder, rig.value)


@app.command()
def doctor(
    rig: RigArgument,
    json: JsonOption = False,
    no_play: Annotated[bool, typer.Option("--no-play", help="Play nothing.")] = False,
    reset_usb: Annotated[
        str, typer.Option("--reset-usb", metavar="ROLE", help="Reset that instrument's USB device first.")
    ] = "",
    test_message: Annotated[
        bool, typer.Option("--test-message", help="Send a message to each address of the rig file.")
    ] = False,
    lines: Annotated[
        bool, typer.Option("--lines", help="Print each finding as a JSON line when it is made, then the JSON of all.")
    ] = False,
) -> None:
    """Check every instrument, and say what to do about each fault."""
    from wavefocus.commands import doctor as command

    done = command.doctor(
        rig, as_json=json, play=not no_play, reset_usb=reset_usb, test_message=test_message, as_lines=lines
    )
    raise typer.Exit(done)


@app.command()
def calibrate(
    rig: RigArgument,
    only: Annotated[
        str, typer.Option("--only", help="Which: inputs, outputs, mirror, actuators; commas between several.")
    ] = "",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="By default calibration-DATE.toml beside RIG.toml.")
    ] = None,
    fiducials: Annotated[
        Path | None,
        typer.Option("--fiducials", metavar="FILE.csv", help="Marks: x_mm,y_mm to jog to, with x_mrad,y_mrad not."),
    ] = None,
    limit_mm: Annotated[
        float,
        _number("--limit-mm", min=1e-6, max=1e6, help="Largest residual of the mirror map."),
    ] = 1.0,
    summing_box: Annotated[
        bool, typer.Option("--summing-box", help="All outputs for actuators are in one box, none is plugged singly.")
    ] = False,
    box_gain: Annotated[
        float | None,
        _number("--box-gain", min=1e-6, max=1e6, help="The box's gain; without it no full scale is measured."),
    ] = None,
    amplitude_v: Annotated[
        float | None,
        _number("--amplitude-v", help="Peak of what is played; by default well below the limit."),
    ] = None,
    distance_mm: Annotated[
        float | None,
        _number("--distance-mm", min=1e-6, max=1e6, help="From each actuator to where it is listened to."),
    ] = None,
    sample_rate_hz: Annotated[
        float, _number("--sample-rate-hz", min=2_000, max=1e6, help="Rate of the records.")
    ] = 10_000.0,
    operator: Annotated[
        Person, typer.Option("--operator", help="lines: asks by JSON lines on standard output, for a window or script.")
    ] = Person.TERMINAL,
    use: Annotated[bool, typer.Option("--use", help="Name the new file in RIG.toml.")] = False,
    json: JsonOption = False,
) -> None:
    """Measure mirror map, latencies, levels and polarities.

    The result is a calibration file, which the rig file names.
    """
    from wavefocus.commands import calibrate as command
    from wavefocus.rig.calibration_request import Request

    request = Request(
        parts=command.parts_named(only),
        fiducials=fiducials,
        limit_mm=limit_mm,
        summing_box=summing_box,
        box_gain=box_gain,
        amplitude_v=amplitude_v,
        distance_mm=distance_mm,
        sample_rate_hz=sample_rate_hz,
    )
    as_lines = operator is Person.LINES
    raise typer.Exit(command.calibrate(rig, request, out, as_json=json, as_lines=as_lines, use=use))


@app.command()
def operate(rig: RigArgument) -> None:
    """Operate a rig by hand, by JSON lines.

    Orders are read from standard input, answers written to standard output:

    {"order": "jog", "x_mm": 10, "y_mm": 5} moves the beam; or x_mrad, y_mrad.

    {"order": "level"} tells levels; on, every_s, actuator, level_v.

    {"order": "sweep"} plays once; actuator, level_v, start_hz, stop_hz, duration_s.

    {"order": "reconnect", "instrument": "mirror"} connects afresh.

    "park", "mute", "state" and "end" need nothing more.

    However it ends, outputs are muted and the mirror is parked. docs/reference/operate.md has every order and answer.
    """
    from wavefocus.commands import operate as command

    raise typer.Exit(command.operate(rig))


@app.command()
def emulate(rig: RigArgument, json: JsonOption = False) -> None:
    """Emulate instruments at the far ends of a rig's wires."""
    from wavefocus.commands import emulate as command

    raise typer.Exit(command.emulate(rig, as_json=json))


@app.command()
def plan(
    run: RunArgument,
    scene: ScenesOption = None,
    no_checks: NoChecksOption = False,
    allow_large: AllowLargeOption = False,
    interpolation_error: Annotated[
        float,
        _number("--interpolation-error", min=1e-4, max=0.99, help="Allowed between the grid's positions."),
    ] = 0.05,
    wave_speed: Annotated[
        float,
        _number("--wave-speed", metavar="M_S", min=1e-3, help="Of the plate, in m/s; a gel's by default."),
    ] = 4.8,
    attenuation: Annotated[
        float,
        _number("--attenuation", metavar="DB_CM", min=0.0, max=1e6, help="Of the plate's waves, in dB/cm."),
    ] = 3.8,
    json: JsonOption = False,
) -> None:
    """Dry run: positions, hours, bytes, limits, finish time."""
    from wavefocus.commands import plan as command
    from wavefocus.commands.plan import Waves

    waves = Waves(interpolation_error, wave_speed, attenuation)
    command.plan(run, scene or (), waves, checks=not no_checks, allow_large=allow_large, as_json=json)


@app.command()
def capture(
    run: RunArgument,
    bank: BankOption,
    scene: ScenesOption = None,
    no_checks: NoChecksOption = False,
    allow_large: AllowLargeOption = False,
    json: JsonLines = False,
    accept_drift: DriftOption = False,
    accept_calibration: CalibrationOption = False,
) -> None:
    """Start, or go on with, a campaign.

    Ctrl-C finishes the position; twice stops at once.
    """
    from wavefocus.commands import capture as command

    raise typer.Exit(
        command.capture(
            run,
            bank,
            scene or (),
            checks=not no_checks,
            allow_large=allow_large,
            as_json=json,
            accept_drift=accept_drift,
            accept_calibration=accept_calibration,
        )
    )


@app.command()
def resume(
    bank: BankArgument,
    rig: RigOption = None,
    json: JsonLines = False,
    accept_drift: DriftOption = False,
    accept_calibration: CalibrationOption = False,
) -> None:
    """Go on with a campaign from its bank alone.

    A corrected rig file may replace the one that the bank holds.
    """
    from wavefocus.commands import capture as command

    raise typer.Exit(
        command.resume(bank, rig, as_json=json, accept_drift=accept_drift, accept_calibration=accept_calibration)
    )


@app.command()
def remeasure(
    bank: BankArgument,
    status: Annotated[
        str, typer.Option("--status", help="Which: poor, over-range or failed; commas between several.")
    ] = "",
    positions: Annotated[
        str, typer.Option("--positions", metavar="I,J,...", help="Bank rows; 5-9 names a range.")
    ] = "",
    replace: Annotated[
        bool, typer.Option("--replace", help="Also valid rows by others, where two attempts agree on them.")
    ] = False,
    rig: RigOption = None,
    json: JsonLines = False,
    accept_drift: DriftOption = False,
    accept_calibration: CalibrationOption = False,
) -> None:
    """Measure positions of a bank again.

    What the bank holds stays until something better is in, a valid row until one agrees.
    """
    from wavefocus.commands import capture as command

    raise typer.Exit(
        command.remeasure(
            bank,
            status,
            positions,
            rig,
            replace=replace,
            as_json=json,
            accept_drift=accept_drift,
            accept_calibration=accept_calibration,
        )
    )


@app.command()
def status(
    bank: BankArgument,
    force: ForceOption = False,
    json: JsonOption = False,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="Draw the sentinel position's drift over time.")
    ] = None,
) -> None:
    """Show counts, state, rate and finish time of a campaign.

    Safe while a run is on.
    """
    from wavefocus.commands import status as command

    command.status(bank, as_json=json, plot=plot, force=force)


@app.command()
def pause(bank: BankArgument, wait_s: WaitOption = 15.0, json: JsonOption = False) -> None:
    """Pause a running capture after its position."""
    from wavefocus.commands import status as command

    raise typer.Exit(command.order(bank, "pause", wait_s, as_json=json))


@app.command()
def go_on(bank: BankArgument, wait_s: WaitOption = 15.0, json: JsonOption = False) -> None:
    """Let a paused capture go on."""
    from wavefocus.commands import status as command

    raise typer.Exit(command.order(bank, "go-on", wait_s, as_json=json))


@app.command()
def stop(bank: BankArgument, wait_s: WaitOption = 15.0, json: JsonOption = False) -> None:
    """End a running capture after its position."""
    from wavefocus.commands import status as command

    raise typer.Exit(command.order(bank, "stop", wait_s, as_json=json))


@app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE.h5", help="A bank, raw recordings, a drive or a field.")],
    json: JsonOption = False,
) -> None:
    """Verify checksums and, of banks, every row's plausibility."""
    from wavefocus.commands import check as command

    raise typer.Exit(command.check(file, as_json=json))


@app.command()
def estimate(
    raw: Annotated[Path, typer.Argument(metavar="RAW.h5", help="The file of raw recordings.")],
    bank: BankOption,
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, max=256, help="Threads, or processes of --cluster local; one per processor."),
    ] = None,
    cluster: ClusterOption = "",
    json: JsonOption = False,
) -> None:
    """Estimate Green's functions from kept recordings.

    Goes on where a stopped estimate left off.
    """
    from wavefocus.commands import estimate as command

    command.estimate(raw, bank, workers, cluster=cluster, as_json=json)


def _method_name(method: Method) -> Literal["sampled", "exact"]:
    return "sampled" if method is Method.SAMPLED else "exact"


@app.command()
def render(
    scene: SceneArgument,
    bank: BankOption,
    out: Annotated[Path, typer.Option("--out", metavar="DRIVE.h5", help="The drive file to write.")],
    wav: Annotated[
        Path | None, typer.Option("--wav", metavar="FILE", help="Also write the drives as a WAV file.")
    ] = None,
    method: Annotated[
        Method | None,
        typer.Option("--method", help="By default exact, or sampled where emission is per point."),
    ] = None,
    tolerance_db: Annotated[
        float | None,
        _number("--tolerance-db", help="Leave out what a proved bound allows, e.g. -60."),
    ] = None,
    interpolation_tolerance: Annotated[
        float | None,
        _number(
            "--interpolation-tolerance", min=1e-9, help="Refuse a larger error between the bank's positions, e.g. 0.05."
        ),
    ] = None,
    focusing: Annotated[
        Focusing, typer.Option("--focusing", help="Time reversal, or a regularised inverse of the path points.")
    ] = Focusing.TIME_REVERSAL,
    regularisation_db: Annotated[
        float | None,
        _number("--regularisation-db", help="Of the inverse, below 0; by default -20."),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", metavar="RIG.toml", help="Keep to this rig's limits too: volts, coil power.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE.png", help="Draw the scene before and after snapping.")
    ] = None,
    device: Annotated[ComputingDevice, typer.Option("--device", help="cuda: on a GPU, through CuPy.")] = (
        ComputingDevice.CPU
    ),
    stream: Annotated[
        bool,
        typer.Option("--stream", help="In constant memory, in two passes; drives above 2 GiB are streamed anyway."),
    ] = False,
    allow_large: AllowLargeOption = False,
    force: ForceOption = False,
    json: JsonOption = False,
) -> None:
    """Turn a scene into drive signals."""
    from wavefocus.commands import render as command
    from wavefocus.commands.render import RenderOptions

    options = RenderOptions(
        method=None if method is None else _method_name(method),
        tolerance_db=tolerance_db,
        interpolation_tolerance=interpolation_tolerance,
        focusing="inverse" if focusing is Focusing.INVERSE else "time-reversal",
        regularisation_db=regularisation_db,
        device="cpu" if device is ComputingDevice.CPU else "cuda",
    )
    command.render(
        scene,
        bank,
        out,
        wav=wav,
        picture=picture,
        rig_file=rig,
        options=options,
        stream=stream,
        allow_large=allow_large,
        force=force,
        as_json=json,
    )


@app.command()
def predict(
    drive: Annotated[Path, typer.Argument(metavar="DRIVE.h5", help="The drive file.")],
    bank: BankOption,
    out: Annotated[Path, typer.Option("--out", metavar="FIELD.h5", help="The field file to write.")],
    positions: Annotated[
        str, typer.Option("--positions", metavar="I,J,...", help="Bank rows; by default all measured.")
    ] = "",
    rate_hz: Annotated[
        float | None,
        _number("--rate", metavar="HZ", min=1e-3, max=1e9, help="Of the field: the bank's over a whole number."),
    ] = None,
    tolerance_db: Annotated[
        float | None,
        _number("--tolerance-db", help="Leave out what a proved bound allows to, e.g. -60."),
    ] = None,
    spectra: Annotated[
        bool, typer.Option("--spectra", help="Energy spectra alone, into an .npz file: far faster than the field.")
    ] = False,
    cluster: ClusterOption = "",
    device: Annotated[ComputingDevice, typer.Option("--device", help="cuda: on a GPU, through CuPy.")] = (
        ComputingDevice.CPU
    ),
    force: ForceOption = False,
    json: JsonOption = False,
) -> None:
    """Predict the field that a drive makes, from the bank."""
    from wavefocus.commands import predict as command

    if spectra:
        command.predict_energy(
            drive, bank, out, positions, rate_hz=rate_hz, tolerance_db=tolerance_db, force=force, as_json=json
        )
        return
    command.predict(
        drive, bank, out, positions, rate_hz=rate_hz, tolerance_db=tolerance_db, cluster=cluster, device=device.value,
        force=force, as_json=json,
    )  # fmt: skip


@app.command()
def movie(
    field: Annotated[Path, typer.Argument(metavar="FIELD.h5", help="The field file, predicted or scanned.")],
    bank: BankOption,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE.gif", help="The movie to write.")] = None,
    snapshots: Annotated[
        Path | None, typer.Option("--snapshots", metavar="FILE.png", help="Draw the field at focus instants.")
    ] = None,
    drive: Annotated[
        Path | None, typer.Option("--drive", metavar="DRIVE.h5", help="Whose foci and paths are shown.")
    ] = None,
    from_s: Annotated[float | None, _number("--from-s", min=-1e9, max=1e9, help="Start in scene time.")] = None,
    to_s: Annotated[float | None, _number("--to-s", min=-1e9, max=1e9, help="End in scene time.")] = None,
    slow: Annotated[
        float | None,
        _number("--slow", min=1e-3, max=1e6, help="Times slower than life; by default 240 frames."),
    ] = None,
    frame_rate_hz: Annotated[
        float, _number("--frame-rate-hz", min=1, max=50, help="Frames a second of the movie.")
    ] = 25.0,
    width_px: Annotated[int, typer.Option("--width-px", min=240, max=3840, help="Width of the movie.")] = 720,
    limit: Annotated[
        float | None,
        _number("--limit", min=1e-30, max=1e30, help="End of the colour scale, in the field's unit."),
    ] = None,
    force: ForceOption = False,
    json: JsonOption = False,
) -> None:
    """Draw a field on the surface: a movie, snapshots at focus instants."""
    from wavefocus.commands import movie as command

    options = command.MovieOptions(from_s, to_s, slow, frame_rate_hz, width_px, limit)
    command.movie(field, bank, out, snapshots, drive, options, force=force, as_json=json)


@app.command()
def play(
    what: Annotated[
        Path, typer.Argument(metavar="DRIVE.h5|SCENE.toml", help="A drive file; or, with --bank, a scene file.")
    ],
    rig: Annotated[Path, typer.Option("--rig", metavar="RIG.toml", help="The rig file, or: virtual.")],
    loop: Annotated[int, typer.Option("--loop", min=1, help="How many times, without a gap; of a drive.")] = 1,
    gain_db: Annotated[
        float,
        _number("--gain-db", min=-200, max=200, help="Softer (negative) or louder; limits hold all the same."),
    ] = 0.0,
    bank: Annotated[
        Path | None,
        typer.Option("--bank", metavar="BANK.h5", help="The bank to render a scene from while it is played."),
    ] = None,
    method: Annotated[Method | None, typer.Option("--method", help="Of a scene, as for render.")] = None,
    tolerance_db: Annotated[
        float | None,
        _number("--tolerance-db", help="Of a scene, as for render: faster, e.g. -60."),
    ] = None,
    ahead_s: Annotated[
        float | None,
        _number("--ahead-s", min=0.05, max=60, help="How much of a scene is rendered ahead; by default 2 s."),
    ] = None,
    watched: Annotated[
        bool,
        typer.Option("--watched", help="End, muted, when standard input closes; print a JSON line when it plays."),
    ] = False,
    allow_large: AllowLargeOption = False,
    json: JsonOption = False,
) -> None:
    """Play drives, or a scene of any length, on the rig.

    Ctrl-C mutes at once.
    """
    from wavefocus.commands import play as command

    if bank is None:
        command.refuse_for_drives(what, method=method, tolerance_db=tolerance_db, ahead_s=ahead_s)
        raise typer.Exit(command.play(what, rig, loop=loop, gain_db=gain_db, as_json=json, watched=watched))
    command.refuse_for_scenes(what, loop=loop)
    from wavefocus.commands.render import RenderOptions

    options = RenderOptions(method=None if method is None else _method_name(method), tolerance_db=tolerance_db)
    ahead = command.AHEAD_S if ahead_s is None else ahead_s
    raise typer.Exit(
        command.play_scene(
            what,
            bank,
            rig,
            options=options,
            gain_db=gain_db,
            ahead_s=ahead,
            as_json=json,
            watched=watched,
            allow_large=allow_large,
        )
    )


@app.command()
def verify(
    scene: SceneArgument,
    bank: BankOption,
    rig: Annotated[Path, typer.Option("--rig", metavar="RIG.toml", help="The rig file, or: virtual.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for report.html and files.")],
    positions: Annotated[
        str,
        typer.Option(
            "--positions",
            metavar="I,J,...",
            help="Bank rows to scan, or every:N for one of N, or path for those that the scene needs; by default all.",
        ),
    ] = "",
    allow_large: AllowLargeOption = False,
    force: ForceOption = False,
    json: JsonOption = False,
) -> None:
    """Play a scene, scan it, compare it with the prediction."""
    from wavefocus.commands import verify as command

    raise typer.Exit(
        command.verify(scene, bank, rig, out, positions, force=force, allow_large=allow_large, as_json=json)
    )


@app.command()
def export(
    bank: BankArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The file to write; for wav a folder.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="|".join(EXPORTS),
            callback=_one_of(EXPORTS),
            help=", ".join(one.title for one in EXPORTS.values()) + ".",
        ),
    ],
    positions: Annotated[
        str, typer.Option("--positions", metavar="I,J,...", help="Bank rows; by default all measured.")
    ] = "",
    missing: Annotated[
        Missing, typer.Option("--missing", help="Positions that are not measured, failed or disabled.")
    ] = Missing.LEAVE_OUT,
    per: Annotated[Per, typer.Option("--per", help="For wav: what one file holds.")] = Per.POSITION,
    force: ForceOption = False,
    json: JsonOption = False,
) -> None:
    """Write a bank in the format of another field."""
    from wavefocus.commands import export as command

    command.export(
        bank,
        out,
        to,
        positions=positions,
        missing_as_nan=missing is Missing.NAN,
        per=per.value,
        force=force,
        as_json=json,
    )


@app.command()
def bench(
    what: Annotated[
        str,
        typer.Argument(metavar="NAME", callback=_one_of((*BENCHMARKS, "all")), help=", ".join((*BENCHMARKS, "all"))),
    ] = "all",
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for tables.")] = Path("bench-out"),
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes, to see that it works.")] = False,
    force: ForceOption = False,
) -> None:
    """Measure error against run time, ours beside peers."""
    from wavefocus.commands import bench as command

    command.bench(what, out, quick=quick, force=force)


@app.command()
def gui(
    files: Annotated[list[Path] | None, typer.Argument(metavar="[RUN.toml|BANK.h5]...", help="What to open.")] = None,
) -> None:
    """Open the window; everything works without it."""
    from wavefocus.commands import gui as command

    raise typer.Exit(command.gui(files or ()))


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the demo's files; its own alone.")
    ] = Path("demo-out"),
    force: ForceOption = False,
) -> None:
    """Run everything on the virtual rig, with a power cut."""
    from wavefocus.commands import demo as command

    raise typer.Exit(command.demo(out, force=force))
