"""The command line: names, arguments and help of every command; the work is in ``wavefocus.commands``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    help=(
        "Measure a plate's Green's functions overnight, render moving tactile sources by time reversal, "
        "and check the focusing against new scans. Start with: wavefocus init lab"
    ),
)


class RigKind(StrEnum):
    """Which rig file ``init`` writes."""

    VIRTUAL = "virtual"
    TEMPLATE = "template"
    EMULATED = "emulated"


class Method(StrEnum):
    """How a moving source is rendered."""

    SAMPLED = "sampled"
    EXACT = "exact"


class Benchmark(StrEnum):
    """What ``bench`` measures."""

    RENDER = "render"
    ESTIMATE = "estimate"
    INTERPOLATION = "interpolation"
    FOCUSING = "focusing"
    PAPER = "paper"
    WIRES = "wires"
    ALL = "all"


BankArgument = Annotated[Path, typer.Argument(metavar="BANK.h5", help="The bank file.")]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN.toml", help="The run file.")]
RigArgument = Annotated[Path, typer.Argument(metavar="RIG.toml", help="The rig file.")]
SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE.toml", help="The scene file.")]
BankOption = Annotated[Path, typer.Option("--bank", metavar="BANK.h5", help="The bank file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]
JsonLines = Annotated[bool, typer.Option("--json", help="Print one JSON line per event on standard output.")]
DriftOption = Annotated[bool, typer.Option("--accept-drift", help="Go on although the sentinel position has changed.")]


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
) -> None:
    """Say what all commands share."""


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to write; made when missing.")],
    rig: Annotated[
        RigKind, typer.Option("--rig", help="A virtual rig, a template of your own, or real drivers for `emulate`.")
    ] = (RigKind.VIRTUAL),
) -> None:
    """Write rig.toml, run.toml and scene.toml with every key explained."""
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
) -> None:
    """Find, identify and exercise every instrument; say what is wrong and what to do about it."""
    from wavefocus.commands import doctor as command

    raise typer.Exit(command.doctor(rig, as_json=json, play=not no_play, reset_usb=reset_usb))


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
    limit_mm: Annotated[float, typer.Option("--limit-mm", min=1e-6, help="Largest residual of the mirror map.")] = 1.0,
    summing_box: Annotated[
        bool, typer.Option("--summing-box", help="All outputs for actuators are in one box, none is plugged singly.")
    ] = False,
    box_gain: Annotated[
        float | None, typer.Option("--box-gain", min=1e-6, help="The box's gain; without it no full scale is measured.")
    ] = None,
    amplitude_v: Annotated[
        float | None, typer.Option("--amplitude-v", help="Peak of what is played; by default well below the limit.")
    ] = None,
    distance_mm: Annotated[
        float | None, typer.Option("--distance-mm", min=1e-6, help="From each actuator to where it is listened to.")
    ] = None,
    sample_rate_hz: Annotated[
        float, typer.Option("--sample-rate-hz", min=2_000, max=1e6, help="Rate of the records.")
    ] = 10_000.0,
    json: JsonOption = False,
) -> None:
    """Measure mirror map, latencies, delays, levels and polarities, into a calibration file."""
    from wavefocus.calibration_request import Request
    from wavefocus.commands import calibrate as command

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
    raise typer.Exit(command.calibrate(rig, request, out, as_json=json))


@app.command()
def emulate(rig: RigArgument, json: JsonOption = False) -> None:
    """Stand in for a rig's instruments at the far ends of their wires, until it is told quit."""
    from wavefocus.commands import emulate as command

    raise typer.Exit(command.emulate(rig, as_json=json))


@app.command()
def plan(run: RunArgument, json: JsonOption = False) -> None:
    """Dry run: positions, hours, bytes, limits and finish time; nothing is played."""
    from wavefocus.commands import plan as command

    command.plan(run, as_json=json)


@app.command()
def capture(run: RunArgument, bank: BankOption, json: JsonLines = False, accept_drift: DriftOption = False) -> None:
    """Start, or go on with, a campaign. Ctrl-C finishes the position; twice stops at once."""
    from wavefocus.commands import capture as command

    raise typer.Exit(command.capture(run, bank, as_json=json, accept_drift=accept_drift))


@app.command()
def resume(bank: BankArgument, json: JsonLines = False, accept_drift: DriftOption = False) -> None:
    """Go on with a campaign from its bank alone."""
    from wavefocus.commands import capture as command

    raise typer.Exit(command.resume(bank, as_json=json, accept_drift=accept_drift))


@app.command()
def remeasure(
    bank: BankArgument,
    status: Annotated[
        str, typer.Option("--status", help="Which: poor, over-range or failed; commas between several.")
    ] = "",
    positions: Annotated[
        str, typer.Option("--positions", metavar="I,J,...", help="Bank rows; 5-9 names a range.")
    ] = "",
    json: JsonLines = False,
    accept_drift: DriftOption = False,
) -> None:
    """Measure positions again; what the bank holds stays until something better is in."""
    from wavefocus.commands import capture as command

    raise typer.Exit(command.remeasure(bank, status, positions, as_json=json, accept_drift=accept_drift))


@app.command()
def status(bank: BankArgument, json: JsonOption = False) -> None:
    """Counts per status, rate and finish time; safe while a run is on."""
    from wavefocus.commands import status as command

    command.status(bank, as_json=json)


@app.command()
def check(bank: BankArgument, json: JsonOption = False) -> None:
    """Checksums and physical sanity of every row."""
    from wavefocus.commands import check as command

    raise typer.Exit(command.check(bank, as_json=json))


@app.command()
def estimate(
    raw: Annotated[Path, typer.Argument(metavar="RAW.h5", help="The file of raw recordings.")],
    bank: BankOption,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, max=256, help="Threads; by default one per processor.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Green's functions from kept recordings; goes on where a stopped estimate left off."""
    from wavefocus.commands import estimate as command

    command.estimate(raw, bank, workers, as_json=json)


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
        typer.Option("--tolerance-db", help="Leave out what a proved bound allows, e.g. -60."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Turn a scene into drive signals by time reversal."""
    from wavefocus.commands import render as command

    command.render(scene, bank, out, wav, None if method is None else _method_name(method), tolerance_db, as_json=json)


@app.command()
def predict(
    drive: Annotated[Path, typer.Argument(metavar="DRIVE.h5", help="The drive file.")],
    bank: BankOption,
    out: Annotated[Path, typer.Option("--out", metavar="FIELD.h5", help="The field file to write.")],
    positions: Annotated[
        str, typer.Option("--positions", metavar="I,J,...", help="Bank rows; by default all measured.")
    ] = "",
    json: JsonOption = False,
) -> None:
    """Predict the field that a drive makes, from the bank."""
    from wavefocus.commands import predict as command

    command.predict(drive, bank, out, positions, as_json=json)


@app.command()
def verify(
    scene: SceneArgument,
    bank: BankOption,
    rig: Annotated[Path, typer.Option("--rig", metavar="RIG.toml", help="The rig file, or: virtual.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for report.html and files.")],
    positions: Annotated[
        str, typer.Option("--positions", metavar="I,J,...", help="Bank rows to scan; by default all.")
    ] = "",
    json: JsonOption = False,
) -> None:
    """Play a scene on the rig, scan it, compare with the prediction, write a report."""
    from wavefocus.commands import verify as command

    raise typer.Exit(command.verify(scene, bank, rig, out, positions, as_json=json))


@app.command()
def bench(
    what: Annotated[Benchmark, typer.Argument(help="Which benchmark.")] = Benchmark.ALL,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for tables.")] = Path("bench-out"),
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes, to see that it works.")] = False,
) -> None:
    """Error against run time, ours beside peers, in one run."""
    from wavefocus.commands import bench as command

    command.bench(what.value, out, quick=quick)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the demo's files; its own alone.")
    ] = Path("demo-out"),
) -> None:
    """All of it on the virtual rig: capture, power cut, resume, render, verify, report."""
    from wavefocus.commands import demo as command

    raise typer.Exit(command.demo(out))
