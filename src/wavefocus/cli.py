"""The command line: names, arguments and help of every command; the work is in ``wavefocus.commands``.

A command is a row of `COMMANDS`. Its arguments are passed by their names in Python to a function of the module in
`wavefocus.commands`, which is imported only when the command is chosen.
"""

from __future__ import annotations

import argparse
import difflib
import math
import os
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from wavefocus.benchmarks import BENCHMARKS
from wavefocus.config.retired import OPTIONS, refused, retired_command
from wavefocus.storage.exchange import EXPORTS, IMPORTS

DESCRIPTION = (
    "Measure a plate's Green's functions overnight, render moving tactile sources by time reversal, and check the "
    "focusing against new scans. Start with: wavefocus init lab"
)


class UsageError(Exception):
    """The command line is wrong; the message names the argument."""


class Argument(NamedTuple):
    """One argument of a command: its flags or its name, and its settings for argparse."""

    names: tuple[str, ...]
    settings: Mapping[str, Any]


class Command(NamedTuple):
    """One command.

    `run` is ``"module:function"`` in `wavefocus.commands` or an adapter in this module; the first paragraph of `help`
    stands in the list of commands; `arguments` are in the order of the help.
    """

    name: str
    run: str | Callable[..., Any]
    help: str
    arguments: tuple[Argument, ...]


def argument(*names: str, **settings: Any) -> Argument:
    """Declare an argument, as ``add_argument`` of argparse does."""
    return Argument(names, settings)


def file(*names: str, **settings: Any) -> Argument:
    """Declare a file or folder."""
    return Argument(names, {"type": Path, **settings})


def switch(name: str, dest: str = "", *, off: bool = False, help: str) -> Argument:
    """Declare an option without a value; `off` where it is False when given."""
    named = {"dest": dest} if dest else {}
    return Argument((name,), {"action": "store_false" if off else "store_true", "help": help, **named})


def number(
    name: str, low: float = -math.inf, high: float = math.inf, *, help: str, whole: bool = False, **settings: Any
) -> Argument:
    """Declare an option that takes a finite number within bounds, which its help repeats."""

    def read(text: str) -> float:
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no {'whole ' if whole else ''}number") from None
        if not math.isfinite(value):
            raise argparse.ArgumentTypeError(f"{text} is not a finite number")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is out of range; allowed: {bounds}")
        return value

    bounds = f"{low:g} to {high:g}" if math.isfinite(high) else f"at least {low:g}"
    notes = [bounds] if math.isfinite(low) else []
    if settings.get("default") is not None:
        notes.append(f"default: {settings['default']:g}")
    text = f"{help} [{'; '.join(notes)}]" if notes else help
    return Argument((name,), {"type": read, "metavar": "N", "help": text, **settings})


def pair(text: str) -> tuple[float, float]:
    """Read two finite numbers, as ``"50,450"``."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a pair of finite numbers, as 50,450")
    return first, second


def pair_or_file(text: str) -> tuple[float, float] | Path:
    """Read two finite numbers; any other text is a path."""
    try:
        return pair(text)
    except argparse.ArgumentTypeError:
        return Path(text)


def mapping(text: str) -> tuple[str, str]:
    """Read ``"green=H"`` as a name of ours and the file's."""
    ours, _, theirs = text.partition("=")
    if not ours or not theirs:
        raise argparse.ArgumentTypeError(f"{text!r} is not OURS=THEIRS")
    return ours, theirs


BANK = file("bank", metavar="BANK.h5", help="The bank file.")
RUN = file("run_file", metavar="RUN.toml", help="The run file.")
RIG = file("rig_file", metavar="RIG.toml", help="The rig file.")
SCENE = file("scene_file", metavar="SCENE.toml", help="The scene file.")
FROM_BANK = file("--bank", metavar="BANK.h5", required=True, help="The bank file.")
ON_RIG = file("--rig", dest="rig_file", metavar="RIG.toml", required=True, help="The rig file, or: virtual.")
JSON = switch("--json", "as_json", help="Print JSON on standard output.")
JSON_LINES = switch("--json", "as_json", help="Print one JSON line per event on standard output.")
FORCE = switch("--force", help="Replace older outputs; never an input, a bank or raw recordings.")
DRIFT = switch("--accept-drift", help="Go on although the sentinel position has changed.")
CALIBRATION = switch("--accept-calibration", help="Go on with another calibration, or on other devices than its own.")
OTHER_RIG = file(
    "--rig", dest="rig_file", metavar="RIG.toml",
    help="A corrected rig file: other ports, device names, limits or time-outs.",
)  # fmt: skip
WAIT = number("--wait-s", 0, 86_400, default=15.0, help="Longest wait for it to be done.")
POSITIONS = argument("--positions", default="", metavar="I,J,...", help="Bank rows; by default all measured.")
SCENES = file(
    "--scene", dest="scene_files", action="append", default=[], metavar="SCENE.toml",
    help="Only the positions that this scene needs; may be repeated.",
)  # fmt: skip
CLUSTER = argument(
    "--cluster", default="", metavar="ADDRESS",
    help="A dask scheduler, tcp://HOST:8786, or local, local:N: processes here.",
)  # fmt: skip
LARGE = switch("--allow-large", help="Allow scenes of over an hour, 8 GiB of drives or a million path points.")
NO_CHECKS = switch(
    "--no-checks", "checks", off=True, help="With --scene: leave out the positions that only `verify` looks at."
)
METHOD = argument(
    "--method", choices=("sampled", "exact"), help="By default exact, or sampled where emission is per point."
)
TOLERANCE = number("--tolerance-db", help="Leave out what a proved bound allows, e.g. -60.")
DEVICE = argument("--device", choices=("cpu", "cuda"), default="cpu", help="cuda: on a GPU, through CuPy.")


def _out(metavar: str, help: str, **settings: Any) -> Argument:
    return file("--out", metavar=metavar, help=help, **{"required": True, **settings})


def _found(where: str) -> Any:
    """A definition of `wavefocus.commands`, from ``"module:name"``."""
    module, _, name = where.partition(":")
    return getattr(import_module(f"wavefocus.commands.{module}"), name)


def _bundling(run: str, keyword: str, kind: str) -> Callable[..., Any]:
    """A command that takes as one object the arguments that are fields of a dataclass."""

    def call(**given: Any) -> Any:
        bundle = _found(kind)
        own = {name: given.pop(name) for name in bundle.__dataclass_fields__ if name in given}
        return _found(run)(**{keyword: bundle(**own)}, **given)

    return call


def _calibrate(
    rig_file: Path, only: str, out: Path | None, *, as_json: bool, operator: str, use: bool, **asked: Any
) -> int:
    from wavefocus.commands.rig import calibrate as command
    from wavefocus.rig.calibration_session import Request

    request = Request(parts=command.parts_named(only), **asked)
    return command.calibrate(rig_file, request, out, as_json=as_json, as_lines=operator == "lines", use=use)


def _import(names: Sequence[tuple[str, str]], **given: Any) -> None:
    _bundling("bank.import_bank:import_bank", "options", "bank.import_bank:ImportOptions")(names=dict(names), **given)


def _order(word: Any) -> Callable[..., int]:
    def order(bank: Path, wait_s: float, *, as_json: bool) -> int:
        from wavefocus.commands.status import order as give

        return give(bank, word, wait_s, as_json=as_json)

    return order


def _predict(spectra: bool, cluster: str, device: str, **rest: Any) -> None:
    from wavefocus.commands import predict as command

    if spectra:
        command.predict_energy(**rest)
    else:
        command.predict(cluster=cluster, device=device, **rest)


def _play(
    what: Path,
    bank: Path | None,
    loop: int,
    method: Any,
    tolerance_db: float | None,
    ahead_s: float | None,
    allow_large: bool,
    **rest: Any,
) -> int:
    from wavefocus.commands import play as command

    if bank is None:
        command.refuse_for_drives(what, method=method, tolerance_db=tolerance_db, ahead_s=ahead_s)
        return command.play(what, loop=loop, **rest)
    command.refuse_for_scenes(what, loop=loop)
    from wavefocus.drives import RenderOptions

    return command.play_scene(
        what,
        bank,
        options=RenderOptions(method=method, tolerance_db=tolerance_db),
        ahead_s=command.AHEAD_S if ahead_s is None else ahead_s,
        allow_large=allow_large,
        **rest,
    )


def _live(**given: Any) -> int:
    from wavefocus.commands import live as command
    from wavefocus.live_session.opening import LiveOptions

    options = {name: given.pop(name) for name in LiveOptions.__dataclass_fields__ if name in given}
    return command.live(options=LiveOptions(**options), **given)


COMMANDS = (
    Command(
        "init", "init:init", "Write rig.toml, run.toml, scene.toml, trials.toml and fingers.toml, commented.",
        (
            file("folder", metavar="DIR", help="Where to write; made when missing."),
            argument("--rig", choices=("virtual", "template", "emulated"), default="virtual",
                     help="A virtual rig, a template of your own, or real drivers for `emulate`."),
        ),
    ),
    Command(
        "doctor", "rig.doctor:doctor", "Check every instrument, and say what to do about each fault.",
        (
            RIG, JSON,
            switch("--no-play", "play", off=True, help="Play nothing."),
            argument("--reset-usb", default="", metavar="ROLE", help="Reset that instrument's USB device first."),
            switch("--test-message", help="Send a message to each address of the rig file."),
            switch("--lines", "as_lines",
                   help="Print each finding as a JSON line when it is made, then the JSON of all."),
            file("--record", metavar="FILE.jsonl", help="Write every exchange with the instruments to a new file."),
        ),
    ),
    Command(
        "calibrate", _calibrate,
        "Measure mirror map, latencies, levels and polarities.\n\n"
        "The result is a calibration file, which the rig file names.",
        (
            RIG,
            argument("--only", default="", help="Which: inputs, outputs, mirror, actuators; commas between several."),
            _out("FILE", "By default calibration-DATE.toml next to RIG.toml.", required=False),
            file("--fiducials", metavar="FILE.csv", help="Marks: x_mm,y_mm to jog to, with x_mrad,y_mrad not."),
            number("--limit-mm", 1e-6, 1e6, default=1.0, help="Largest residual of the mirror map."),
            switch("--summing-box", help="All outputs for actuators are in one box, none is plugged singly."),
            number("--box-gain", 1e-6, 1e6, help="The box's gain; without it no full scale is measured."),
            number("--amplitude-v", help="Peak of what is played; by default well below the limit."),
            number("--distance-mm", 1e-6, 1e6, help="From each actuator to where it is listened to."),
            number("--sample-rate-hz", 2000, 1e6, default=10_000.0, help="Rate of the records."),
            argument("--operator", choices=("terminal", "lines"), default="terminal",
                     help="lines: asks by JSON lines on standard output, for a window or script."),
            switch("--use", help="Name the new file in RIG.toml."),
            JSON,
        ),
    ),
    Command(
        "operate", "rig.operate:operate",
        "Operate a rig by hand, by JSON lines.\n\n"
        "Orders are read from standard input, answers written to standard output:\n\n"
        '{"order": "jog", "x_mm": 10, "y_mm": 5} moves the beam; or x_mrad, y_mrad.\n\n'
        '{"order": "level"} reports levels; on, every_s, actuator, level_v.\n\n'
        '{"order": "sweep"} plays once; actuator, level_v, start_hz, stop_hz, duration_s.\n\n'
        '{"order": "reconnect", "instrument": "mirror"} connects afresh.\n\n'
        '"park", "mute", "state" and "end" need nothing more.\n\n'
        "However it ends, outputs are muted and the mirror is parked. docs/reference/operate.md has every order and "
        "answer.",
        (RIG,),
    ),
    Command("emulate", "rig.emulate:emulate", "Emulate instruments at the ends of a rig's wires.", (RIG, JSON)),
    Command(
        "plan", "plan:plan", "Dry run: positions, hours, bytes, limits, finish time.",
        (
            RUN, SCENES, NO_CHECKS, LARGE,
            number("--wave-speed", 1e-3, dest="speed_m_s", default=4.8,
                   help="Of the plate, in m/s; a gel's by default."),
            JSON,
        ),
    ),
    Command(
        "capture", _bundling("capture:capture", "options", "capture:SessionOptions"),
        "Start, or go on with, a campaign.\n\nCtrl-C finishes the position; twice stops at once.",
        (RUN, FROM_BANK, SCENES, NO_CHECKS, LARGE, JSON_LINES, DRIFT, CALIBRATION),
    ),
    Command(
        "resume", _bundling("capture:resume", "options", "capture:SessionOptions"),
        "Go on with a campaign from its bank alone.\n\nA corrected rig file may replace the one that the bank holds.",
        (BANK, OTHER_RIG, JSON_LINES, DRIFT, CALIBRATION),
    ),
    Command(
        "extend", _bundling("capture:extend", "options", "capture:SessionOptions"),
        "Make a bank with more positions.\n\n"
        "Valid rows of one bank, or of several of one rig and plate, are taken over; the sentinel is measured first.",
        (
            file("banks", metavar="BANK.h5", nargs="+", help="Banks that were measured before."),
            file("--run", dest="run_file", metavar="RUN.toml",
                 help="The run with the new positions; without it only what the banks hold."),
            file("--bank", metavar="NEW.h5", required=True, help="The bank to make."),
            JSON_LINES, DRIFT, CALIBRATION,
        ),
    ),
    Command(
        "remeasure", _bundling("capture:remeasure", "options", "capture:SessionOptions"),
        "Measure positions of a bank again.\n\n"
        "What the bank holds stays until something better is in, a valid row until one agrees.",
        (
            BANK,
            argument("--status", dest="words", default="",
                     help="Which: poor, over-range or failed; commas between several."),
            argument("--positions", default="", metavar="I,J,...", help="Bank rows; 5-9 names a range."),
            switch("--replace", help="Also valid rows by others, where two attempts agree on them."),
            OTHER_RIG, JSON_LINES, DRIFT, CALIBRATION,
        ),
    ),
    Command(
        "status", "status:status",
        "Show counts, state, rate and finish time of a campaign.\n\nSafe while a run is on.",
        (
            BANK, FORCE, JSON,
            file("--plot", metavar="FILE.png", help="Draw the sentinel position's drift over time."),
        ),
    ),
    Command("pause", _order("pause"), "Pause a running capture after its position.", (BANK, WAIT, JSON)),
    Command("go-on", _order("go-on"), "Let a paused capture go on.", (BANK, WAIT, JSON)),
    Command("stop", _order("stop"), "End a running capture after its position.", (BANK, WAIT, JSON)),
    Command(
        "check", "bank.check:check", "Verify checksums and, of banks, every row's plausibility.",
        (file("file", metavar="FILE.h5", help="A bank, raw recordings, a drive or a field."), JSON),
    ),
    Command(
        "note", "bank.note:note", "Add a dated note to a bank; `status` shows it, exports carry it.",
        (BANK, argument("text", metavar="TEXT", help="The note, in quotes."), JSON),
    ),
    Command(
        "estimate", "bank.estimate:estimate",
        "Estimate Green's functions from kept recordings.\n\nGoes on where a stopped estimate left off.",
        (
            file("raw", metavar="RAW.h5", help="The file of raw recordings."),
            FROM_BANK,
            number("--workers", 1, 256, whole=True,
                   help="Threads, or processes of --cluster local; one per processor."),
            CLUSTER, JSON,
        ),
    ),
    Command(
        "render", _bundling("render:render", "options", "render:RenderOptions"), "Turn a scene into drive signals.",
        (
            SCENE, FROM_BANK,
            _out("DRIVE.h5", "The drive file to write."),
            file("--wav", metavar="FILE", help="Also write the drives as a WAV file."),
            METHOD, TOLERANCE,
            number("--interpolation-tolerance", 1e-9,
                   help="Refuse a larger error between the bank's positions, e.g. 0.05."),
            file("--rig", dest="rig_file", metavar="RIG.toml",
                 help="Keep to this rig's limits too: volts, coil power."),
            file("--picture", metavar="FILE.png", help="Draw the scene before and after snapping."),
            DEVICE,
            switch("--stream", help="In constant memory, in two passes; drives above 2 GiB are streamed anyway."),
            LARGE, FORCE, JSON,
        ),
    ),
    Command(
        "predict", _predict, "Predict the field that a drive makes, from the bank.",
        (
            file("drive_file", metavar="DRIVE.h5", help="The drive file."),
            FROM_BANK,
            _out("FIELD.h5", "The field file to write."),
            POSITIONS,
            number("--rate", 1e-3, 1e9, dest="rate_hz", metavar="HZ",
                   help="Of the field: the bank's over a whole number."),
            switch("--spectra", help="Energy spectra alone, into an .npz file: far faster than the field."),
            CLUSTER, DEVICE, FORCE, JSON,
        ),
    ),
    Command(
        "movie", _bundling("movie:movie", "options", "movie:MovieOptions"),
        "Draw a field on the surface: a movie, or snapshots.",
        (
            file("field_file", metavar="FIELD.h5", help="The field file, predicted or scanned."),
            FROM_BANK,
            _out("FILE.gif", "The movie to write.", required=False),
            file("--snapshots", dest="snapshot_file", metavar="FILE.png", help="Draw the field at focus instants."),
            file("--drive", dest="drive_file", metavar="DRIVE.h5", help="Whose foci and paths are shown."),
            number("--from-s", -1e9, 1e9, help="Start in scene time."),
            number("--to-s", -1e9, 1e9, help="End in scene time."),
            number("--slow", 1e-3, 1e6, help="Times slower than life; by default 240 frames."),
            number("--frame-rate-hz", 1, 50, default=25.0, help="Frames a second of the movie."),
            number("--width-px", 240, 3840, whole=True, default=720, help="Width of the movie."),
            number("--limit", 1e-30, 1e30, help="End of the colour scale, in the field's unit."),
            FORCE, JSON,
        ),
    ),
    Command(
        "play", _play, "Play drives, or a scene of any length, on the rig.\n\nCtrl-C mutes at once.",
        (
            file("what", metavar="DRIVE.h5|SCENE.toml", help="A drive file; or, with --bank, a scene file."),
            ON_RIG,
            number("--loop", 1, whole=True, default=1, help="How many times, without a gap; of a drive."),
            number("--gain-db", -200, 200, default=0.0,
                   help="Softer (negative) or louder; limits hold all the same."),
            file("--bank", metavar="BANK.h5", help="The bank to render a scene from while it is played."),
            METHOD, TOLERANCE,
            number("--ahead-s", 0.05, 60, help="How much of a scene is rendered ahead; by default 2 s."),
            switch("--watched", help="End, muted, when standard input closes; print a JSON line when it plays."),
            LARGE, JSON,
        ),
    ),
    Command(
        "live", _live,
        "Move sources while they sound.\n\n"
        "Orders are JSON lines on standard input, or OSC messages; the end of standard input ends it, muted:\n\n"
        '{"order": "move", "name": "finger", "at_mm": [10, 5], "amplitude": 1} moves a source, or lets it appear.\n\n'
        '{"order": "signal", "name": "finger", "signal": {"kind": "sine", "frequency_hz": 200, "duration_s": 1}}\n\n'
        '{"order": "end_source", "name": "finger"} lets it fade; {"order": "end"} ends all.\n\n'
        "docs/reference/live.md has every order, event and OSC address. Ctrl-C mutes at once.",
        (
            BANK, ON_RIG,
            file("--scene", dest="scene_file", metavar="SCENE.toml",
                 help="Its regularisation, output and first source's signal; by default noise of the bank's band."),
            number("--look-ahead-ms", 0, 2000, default=50.0,
                   help="By how much sources lag their positions; what is not known by then is predicted."),
            number("--block-ms", 1, 50, default=5.0, help="Time of a block; orders take effect with the next."),
            number("--ahead-ms", 1, 1000, help="So much waits to be played; by default 40 ms, more where needed."),
            number("--gain-db", -200, 200, default=0.0, help="Softer (negative) or louder; limits hold all the same."),
            number("--duration-s", 0, 1e6, help="End by itself after so long."),
            file("--record", metavar="FOLDER",
                 help="Record the session as a scene that renders to its drives; if independent, to similar ones."),
            switch("--independent", help="Each source is quiet where the others are."),
            argument("--osc", nargs="?", const="127.0.0.1:9000", metavar="HOST:PORT",
                     help="Also take orders by OSC over UDP; by default at 127.0.0.1:9000, of this computer alone."),
            JSON_LINES,
        ),
    ),
    Command(
        "trials", "trials:trials",
        "Run a perception experiment with a participant.\n\n"
        "Stimuli are rendered, held against the rig's limits and hashed first. Each answer is on disk before the next "
        "trial; the same command resumes. docs/reference/trials.md has orders, events and columns.",
        (
            file("trials_file", metavar="TRIALS.toml", help="The trials file."),
            FROM_BANK, ON_RIG,
            argument("--participant", default="", metavar="ID", help="Code of the participant; no name."),
            _out("FOLDER", "Folder for stimuli and answers, of all participants."),
            switch("--prepare", "only_prepare", help="Only prepare the stimuli."),
            switch("--lines", "as_lines", help="Orders and events as JSON lines, in place of the window."),
            switch("--fast", help="Let a virtual rig's seconds take no time, for programs that answer."),
            switch("--json", "as_json", help="With --prepare: print JSON on standard output."),
        ),
    ),
    Command(
        "analyse", "analyse:analyse",
        "Analyse the answers to trials: accuracy, psychometric functions, report, BIDS-like folder.\n\n"
        "docs/reference/analysis-of-trials.md defines every figure.",
        (
            file("folder", metavar="FOLDER", help="The folder that `wavefocus trials` wrote."),
            _out("OUT", "Folder for the results; by default FOLDER/analysis.", required=False),
            FORCE, JSON,
        ),
    ),
    Command(
        "verify", "verify:verify", "Play a scene, scan it, compare it with the prediction.",
        (
            SCENE, FROM_BANK, ON_RIG,
            _out("DIR", "Folder for report.html and files."),
            argument("--positions", default="", metavar="I,J,...",
                     help="Bank rows to scan, or every:N for one of N, or path for those that the scene needs; by "
                     "default all."),
            file("--against", metavar="verify.json",
                 help="Also state what has changed since this earlier verification."),
            switch("--linearity", help="Also play the scene 12 dB quieter, at up to 24 positions, and compare."),
            number("--correct", 1, 20, whole=True, dest="corrections", default=0, metavar="N",
                   help="Correct the drive by scans of foci and quiet places, at most N times; the best is kept in "
                   "drive-corrected.h5."),
            argument("--control", choices=("scene", "all"), default="scene",
                     help="Where a correction is judged: foci and quiet places, or all scanned positions."),
            switch("--no-sentinel", "sentinel", off=True,
                   help="Do not measure the bank's sentinel position again."),
            LARGE, FORCE, JSON,
        ),
    ),
    Command(
        "export", "bank.export:export",
        "Write a bank in the format of another field.\n\n"
        "Title, people and licence come from [publication] of the bank's run file, or from --publication.",
        (
            BANK,
            file("out", metavar="OUT", help="The file to write; for wav a folder."),
            argument("--to", choices=tuple(EXPORTS), required=True,
                     help=", ".join(one.title for one in EXPORTS.values()) + "."),
            POSITIONS,
            argument("--missing", choices=("leave-out", "nan"), default="leave-out",
                     help="Positions that are not measured, failed or disabled."),
            argument("--per", choices=("position", "actuator"), default="position",
                     help="For wav: what one file holds."),
            argument("--convention", choices=("GeneralFIR-E", "SingleRoomMIMOSRIR"), default="GeneralFIR-E",
                     help="For sofa: what room acoustics reads, too, is SingleRoomMIMOSRIR."),
            switch("--binary", help="For uff: functions in binary (58b), a fifth of the size of text."),
            file("--publication", metavar="FILE.toml",
                 help="A run file, or another with a table [publication], in place of the bank's."),
            switch("--list", "only_list", help="List what would be written, with sizes, and write nothing."),
            FORCE, JSON,
        ),
    ),
    Command(
        "import", _import,
        "Make a bank of responses that were measured elsewhere.\n\n"
        "Reads impulse responses and frequency responses, and turns the latter into causal impulse responses. Prints "
        "what was read, assumed and left out, and stores it in the bank. A fact that the file lacks is asked for by "
        "the name of its option. docs/how-to/import.md shows each format.",
        (
            file("source", metavar="SRC", help="The file; for wav a folder."),
            file("--bank", metavar="OUT.h5", required=True, help="The bank to write."),
            argument("--from", dest="kind", choices=tuple(IMPORTS), default="", help="Format, by default recognised."),
            file("--places", metavar="FILE.csv",
                 help="Table of places: x_mm,y_mm[,z_mm] (or _m) or azimuth_deg,elevation_deg,radius_m; role, file, "
                 "channel, actuator, node."),
            argument("--unit", default="", metavar="RESPONSE/DRIVE",
                     help="Unit of the values, as m/s/V, mm/s/V, g/N, Pa/V or 1."),
            argument("--length-unit", default="", choices=("m", "cm", "mm", "um", "in", "ft"),
                     help="Unit of places that have none."),
            switch("--to-velocity", help="Turn displacement or acceleration into velocity in m/s."),
            argument("--band", dest="band_hz", type=pair, metavar="LOW,HIGH", help="Frequencies to use, in Hz."),
            number("--taps", 1, whole=True, help="Length of the Green's functions in samples."),
            number("--sample-rate-hz", 1e-3, 1e12, help="Rate of the Green's functions."),
            argument("--frequencies", type=pair_or_file, metavar="FIRST,STEP|FILE",
                     help="Frequencies of complex values, in Hz, where the file holds none."),
            argument("--end", choices=("keep", "window", "damp"), default="keep",
                     help="Ends of the Green's functions: as they are, a half cosine over the last tenth, or damped to "
                     "-60 dB."),
            argument("--direction", default="", metavar="NAME",
                     help="Response direction: x, y, z (uff), receiver (sofa) or index (arrays)."),
            argument("--columns", default="", metavar="X,Y",
                     help="Coordinates that become x and y of the bank; by default the positions' own plane."),
            argument("--axes", default="", metavar="A,B,C",
                     help="Order of an array's axes: position, actuator, direction, sample."),
            argument("--names", type=mapping, action="append", default=[], metavar="OURS=THEIRS",
                     help="A variable by its name in the file, as green=H; may be repeated."),
            argument("--measurements", choices=("positions", "actuators", "pairs"), default="",
                     help="For sofa: what its measurements count."),
            switch("--swap-roles", help="Positions are where it was driven, actuators where it was measured: "
                   "reciprocity, as with a roving hammer."),
            FORCE, JSON,
        ),
    ),
    Command(
        "bench", "bench:bench", "Measure error against run time, ours and peers.",
        (
            argument("what", nargs="?", choices=(*BENCHMARKS, "all"), default="all",
                     help="Which benchmark."),
            _out("DIR", "Folder for tables, diagrams and a page.", required=False, default=Path("bench-out")),
            switch("--quick", help="Small sizes, to see that it works."),
            number("--seconds", 1, 86_400,
                   help="Of live_latency: ten sources, then independent ones, on the virtual player for so long each."),
            number("--workers", 1, 256, whole=True,
                   help="Of coarse_grids: processes, each with cases of its own. [default: as many as processors]"),
            argument("--plate", metavar="NAME", help="Of coarse_grids: only this plate, e.g. soft. [default: all]"),
            FORCE,
        ),
    ),
    Command(
        "gui", "gui:gui", "Open the window; everything works without it.",
        (file("files", nargs="*", metavar="RUN.toml|BANK.h5", help="What to open."),),
    ),
    Command(
        "demo", "demo:demo", "Run everything on the virtual rig, with a power cut.",
        (
            _out("DIR", "Folder for the demo's files; its own alone.", required=False, default=Path("demo-out")),
            argument("--plate", choices=("stadium", "soft"),
                     help="A gel with a rim that reflects waves, or without a rim. [default: stadium]"),
            switch("--quick", help="A hundred positions and, unless --plate is given, no rim: to see that it works."),
            FORCE,
        ),
    ),
)  # fmt: skip


class _Formatter(argparse.HelpFormatter):
    """Help whose paragraphs are wrapped one by one."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=32)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n\n".join(textwrap.fill(one, width) for one in text.split("\n\n"))


class _Parser(argparse.ArgumentParser):
    """Raises `UsageError` in place of ending the process; reads -1e-3 as a number and not as an option."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(formatter_class=_Formatter, allow_abbrev=False, **settings)
        self.of_commands: dict[str, argparse.ArgumentParser] = {}
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)")

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} ({self.prog} --help shows what there is)")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Name the nearest command or choice in place of all."""
        if action.choices is None or value in action.choices:
            return
        known = [str(one) for one in action.choices]
        what = f"{value!r} is not a command" if action.dest == "command" else f"{value!r} is not allowed"
        guess = nearest(str(value), known)
        if action.dest == "command":
            raise UsageError(f"{what}{guess or '; wavefocus --help lists all'}")
        raise argparse.ArgumentError(action, f"{what}{guess or '; allowed: ' + ', '.join(known)}")

    def refuse(self, extra: Sequence[str], command: str) -> NoReturn:
        """Refuse what is left over of a command line, with the option that may have been meant."""
        known = [name for one in self.of_commands[command]._actions for name in one.option_strings]
        option = next((one for one in extra if one.startswith("-")), extra[0])
        if gone := OPTIONS.get(option.partition("=")[0]):
            raise UsageError(f"{command}: {refused(option.partition('=')[0], gone)}")
        guess = nearest(option.partition("=")[0], known) if option.startswith("-") else ""
        raise UsageError(f"{command}: {option} is not known{guess} (wavefocus {command} --help shows what there is)")


def nearest(word: str, known: Sequence[str]) -> str:
    """``; did you mean ...?`` with the nearest of some words; empty where none is near."""
    found = difflib.get_close_matches(word.lower(), known, n=1, cutoff=0.6)
    begun = [one for one in known if len(word) > 1 and one.startswith(word.lower())]
    guesses = found or begun[:1]
    return f"; did you mean {guesses[0]}?" if guesses else ""


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"wavefocus {version('wavefocus')}")
        parser.exit()


def parser(commands: Sequence[Command] = COMMANDS, words: Sequence[str] | None = None) -> _Parser:
    """The parser of the command line.

    words: The command line to read; commands that it does not name get no arguments, which halves the time.
    """
    whole = _Parser(prog="wavefocus", description=DESCRIPTION)
    whole.add_argument("--version", action=_Version, nargs=0, default=argparse.SUPPRESS, help="Print the version.")
    # Taken by `wavefocus.__main__.run`, wherever it stands; here for the help alone.
    whole.add_argument(
        "--traceback", action="store_true", help="Show where in the program an error arose; or WAVEFOCUS_TRACEBACK=1."
    )
    most = number("--most-gib", help="Largest part of a file that is read at once, in GiB; 8 by default.")
    whole.add_argument(*most.names, **most.settings)
    chosen = whole.add_subparsers(dest="command", metavar="COMMAND", title="commands", required=True)
    for one in commands:
        first = one.help.partition("\n\n")[0]
        under = whole.of_commands[one.name] = chosen.add_parser(one.name, help=first, description=one.help)
        for each in one.arguments if words is None or one.name in words else ():
            under.add_argument(*each.names, **each.settings)
    return whole


def parsed(arguments: Sequence[str]) -> tuple[Command, dict[str, Any]]:
    """Read one command line: the command, and its arguments by their names in Python.

    Raises UsageError: the command line is wrong.
    """
    words = [word for word in arguments if not word.startswith("-")]
    if gone := retired_command(words):
        raise UsageError(gone)
    whole = parser(COMMANDS, arguments)
    read, extra = whole.parse_known_args(arguments)
    given = vars(read)
    name = given.pop("command")
    if extra:
        whole.refuse(extra, name)
    del given["traceback"]
    if (most_gib := given.pop("most_gib")) is not None:
        os.environ["WAVEFOCUS_MOST_GIB"] = str(most_gib)  # for the processes that it starts, too
    return next(one for one in COMMANDS if one.name == name), given


def run_command(arguments: Sequence[str]) -> int:
    """Run one command line.

    Returns the exit code. Raises UsageError: the command line is wrong.
    """
    command, given = parsed(arguments)
    name = command.name
    from wavefocus.console import named_while_silent, working_on

    # What a command imports is part of its silence.
    with named_while_silent(f"{name}: {_first_sentence(command.help)}"):
        working_on("loading its modules")
        run = _found(command.run) if isinstance(command.run, str) else command.run
        working_on("")
        return int(run(**given) or 0)


def _first_sentence(text: str) -> str:
    first = re.split(r"\n\n|; |\. ", text)[0].rstrip(".")
    return first[:1].lower() + first[1:]
