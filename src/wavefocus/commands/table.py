"""All commands in three groups: names, arguments and help."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from wavefocus.benchmarks import BENCHMARKS
from wavefocus.command_line import Argument, Command, argument, file, number, options_of, switch
from wavefocus.options import (
    CalibrationOptions,
    DoctorOptions,
    ExportOptions,
    ImportOptions,
    LiveOptions,
    MovieOptions,
    RenderOptions,
    SessionOptions,
    TrialsOptions,
)
from wavefocus.storage.exchange import EXPORTS, IMPORTS

BANK = file("bank", metavar="BANK.h5", help="The bank file.")
RUN = file("run_file", metavar="RUN.toml", help="The run file.")
RIG = file("rig_file", metavar="RIG.toml", help="The rig file.")
SCENE = file("scene_file", metavar="SCENE.toml", help="The scene file.")
FROM_BANK = file("--bank", metavar="BANK.h5", required=True, help="The bank file.")
ON_RIG = file("--rig", dest="rig_file", metavar="RIG.toml", required=True, help="The rig file, or: virtual.")
JSON = switch("--json", "as_json", help="Print JSON on standard output.")
FORCE = switch("--force", help="Replace older outputs; never an input, a bank or raw recordings.")
POSITIONS = argument("--positions", default="", metavar="I,J,...", help="Bank rows; by default all measured.")
SCENES = file(
    "--scene", dest="scene_files", action="append", default=[], metavar="SCENE.toml",
    help="Only the positions that this scene needs; may be repeated.",
)  # fmt: skip
CLUSTER = argument(
    "--cluster", default="", metavar="ADDRESS",
    help="A dask scheduler, tcp://HOST:8786, or local, local:N: processes here.",
)  # fmt: skip
(JSON_LINES,) = options_of(SessionOptions, "as_json")


def _out(metavar: str, help: str, **settings: Any) -> Argument:
    return file("--out", metavar=metavar, help=help, **{"required": True, **settings})


def found(where: str) -> Any:
    """A definition of `wavefocus.commands`, from ``"module:name"``."""
    module, _, name = where.partition(":")
    return getattr(import_module(f"wavefocus.commands.{module}"), name)


def _order(word: Any) -> Callable[..., int]:
    def order(bank: Path, *, as_json: bool) -> int:
        return int(found("status:order")(bank, word, as_json=as_json))

    return order


UFF_BINARY = "uff-binary"
"""The format `uff` at a fifth of the size."""


def _export(to: str, options: ExportOptions, **rest: Any) -> None:
    binary = to == UFF_BINARY
    found("bank:export")(to="uff" if binary else to, options=replace(options, binary=binary), **rest)


MEASURE = (
    Command(
        "init", "init:init", "Write rig.toml, run.toml, scene.toml, trials.toml and fingers.toml, commented.",
        (
            file("folder", metavar="DIR", help="Where to write; made when missing."),
            argument("--rig", choices=("virtual", "template", "emulated"), default="virtual",
                     help="A virtual rig, a template of your own, or real drivers for `emulate`."),
        ),
    ),
    Command(
        "plan", "plan:plan", "Dry run: positions, hours, bytes, limits, finish time.",
        (RUN, SCENES, switch("--details", help="Also sweeps, sentinel and instruments."), JSON),
    ),
    Command(
        "capture", "capture:capture",
        "Start, or go on with, a campaign.\n\nCtrl-C finishes the position; twice stops at once.",
        (RUN, FROM_BANK, SCENES, *options_of(SessionOptions, "as_json", "accept_drift", "accept_calibration")),
        SessionOptions,
    ),
    Command(
        "resume", "capture:resume",
        "Go on with a campaign from its bank alone, or let a paused capture go on.\n\n"
        "A corrected rig file may replace the one that the bank holds.",
        (BANK, *options_of(SessionOptions)),
        SessionOptions,
    ),
    Command(
        "extend", "capture:extend",
        "Make a bank with more positions.\n\n"
        "Valid rows of a bank of the same rig and plate are taken over; the sentinel is measured first.",
        (
            file("old", metavar="BANK.h5", help="The bank that was measured before."),
            file("--run", dest="run_file", metavar="RUN.toml", required=True, help="The run with the new positions."),
            file("--bank", metavar="NEW.h5", required=True, help="The bank to make."),
            JSON_LINES,
        ),
        SessionOptions,
    ),
    Command(
        "remeasure", "capture:remeasure",
        "Measure positions of a bank again.\n\n"
        "What the bank holds stays until something better is in, a valid row until one agrees.",
        (
            BANK,
            argument("--status", dest="words", default="",
                     help="Which: poor, over-range or failed; commas between several."),
            argument("--positions", default="", metavar="I,J,...", help="Bank rows; 5-9 names a range."),
            switch("--replace", help="Also valid rows by others, where two attempts agree on them."),
            *options_of(SessionOptions),
        ),
        SessionOptions,
    ),
    Command(
        "status", "status:status",
        "Show counts, state, rate and finish time of a campaign.\n\nSafe while a run is on.",
        (BANK, JSON),
    ),
    Command("pause", _order("pause"), "Pause a running capture after its position.", (BANK, JSON)),
    Command("stop", _order("stop"), "End a running capture after its position.", (BANK, JSON)),
    Command(
        "check", "bank:check", "Verify checksums and, of banks, every row's plausibility.",
        (file("file", metavar="FILE.h5", help="A bank, raw recordings, a drive or a field."), JSON),
    ),
    Command(
        "note", "bank:note", "Add a dated note to a bank; `status` shows it, exports carry it.",
        (BANK, argument("text", metavar="TEXT", help="The note, in quotes."), JSON),
    ),
)  # fmt: skip

USE = (
    Command(
        "render", "render:render", "Turn a scene into drive signals.",
        (
            SCENE, FROM_BANK,
            _out("DRIVE.h5", "The drive file to write."),
            file("--wav", metavar="FILE", help="Also write the drives as a WAV file."),
            *options_of(RenderOptions),
            file("--rig", dest="rig_file", metavar="RIG.toml",
                 help="Keep to this rig's limits too: volts, coil power."),
            FORCE, JSON,
        ),
        RenderOptions,
    ),
    Command(
        "predict", "predict:predict", "Predict the field that a drive makes, from the bank.",
        (
            file("drive_file", metavar="DRIVE.h5", help="The drive file."),
            FROM_BANK,
            _out("FIELD.h5", "The field file to write."),
            POSITIONS,
            number("--rate", 1e-3, 1e9, dest="rate_hz", metavar="HZ",
                   help="Of the field: the bank's over a whole number."),
            CLUSTER, *options_of(RenderOptions, "device"), FORCE, JSON,
        ),
    ),
    Command(
        "play", "play:play", "Play drives on the rig.\n\nCtrl-C mutes at once.",
        (
            file("drive_file", metavar="DRIVE.h5", help="The drive file."),
            ON_RIG,
            number("--loop", 1, whole=True, default=1, help="How many times, without a gap."),
            *options_of(LiveOptions, "gain_db"),
            switch("--lines", "watched", help="End, muted, when standard input closes; a JSON line when it plays."),
            JSON,
        ),
    ),
    Command(
        "live", "live:live",
        "Move sources while they sound.\n\n"
        "Orders are JSON lines on standard input, or OSC messages; the end of standard input ends it, muted:\n\n"
        '{"order": "move", "name": "finger", "at_mm": [10, 5], "amplitude": 1} moves a source, or lets it appear.\n\n'
        '{"order": "signal", "name": "finger", "signal": {"kind": "sine", "frequency_hz": 200, "duration_s": 1}}\n\n'
        '{"order": "end_source", "name": "finger"} lets it fade; {"order": "end"} ends all.\n\n'
        "docs/reference/live.md has every order, event and OSC address. Ctrl-C mutes at once.",
        (
            BANK, ON_RIG,
            *options_of(LiveOptions, "scene", "look_ahead_ms", "ahead_ms", "gain_db", "duration_s", "record",
                        "independent"),
            argument("--osc", nargs="?", const="127.0.0.1:9000", metavar="HOST:PORT",
                     help="Also take orders by OSC over UDP; by default at 127.0.0.1:9000, of this computer alone."),
            JSON_LINES,
        ),
        LiveOptions,
    ),
    Command(
        "verify", "verify:verify", "Play a scene, scan it, compare it with the prediction.",
        (
            SCENE, FROM_BANK, ON_RIG,
            _out("DIR", "Folder for report.html and files."),
            argument("--positions", default="", metavar="I,J,...",
                     help="Bank rows to scan, or every:N for one of N, or path for those that the scene needs; by "
                     "default all."),
            switch("--linearity", help="Also play the scene 12 dB quieter, at up to 24 positions, and compare."),
            number("--correct", 1, 20, whole=True, dest="corrections", default=0, metavar="N",
                   help="Correct the drive by scans of foci and quiet places, at most N times; the best is kept in "
                   "drive-corrected.h5."),
            FORCE, JSON,
        ),
    ),
    Command(
        "movie", "movie:movie",
        "Draw a field on the surface: a movie, or snapshots.",
        (
            file("field_file", metavar="FIELD.h5", help="The field file, predicted or scanned."),
            FROM_BANK,
            _out("FILE.gif", "The movie to write.", required=False),
            file("--snapshots", dest="snapshot_file", metavar="FILE.png", help="Draw the field at focus instants."),
            file("--drive", dest="drive_file", metavar="DRIVE.h5", help="Whose foci and paths are shown."),
            *options_of(MovieOptions),
            FORCE, JSON,
        ),
        MovieOptions,
    ),
    Command(
        "trials", "trials:trials",
        "Run a perception experiment with a participant.\n\n"
        "Stimuli are rendered, held against the rig's limits and hashed first. Each answer is on disk before the next "
        "trial; the same command resumes. docs/reference/trials.md has orders, events and columns.",
        (
            file("trials_file", metavar="TRIALS.toml", help="The trials file."),
            FROM_BANK, ON_RIG,
            _out("FOLDER", "Folder for stimuli and answers, of all participants."),
            *options_of(TrialsOptions),
        ),
        TrialsOptions,
    ),
    Command(
        "analyse", "analyse:analyse",
        "Analyse the answers to trials: accuracy, psychometric functions, a report.\n\n"
        "docs/reference/trials.md defines every figure.",
        (file("folder", metavar="FOLDER", help="The folder that `wavefocus trials` wrote."),
         _out("OUT", "Folder for the results; by default FOLDER/analysis.", required=False), FORCE, JSON),
    ),
)  # fmt: skip

RIG_AND_DATA = (
    Command(
        "doctor", "doctor:doctor", "Check every instrument, and say what to do about each fault.",
        (RIG, *options_of(DoctorOptions)),
        DoctorOptions,
    ),
    Command(
        "calibrate", "calibrate:calibrate",
        "Measure mirror map, latencies, levels and polarities.\n\n"
        "The result is a calibration file, which the rig file names.",
        (
            RIG, *options_of(CalibrationOptions),
            _out("FILE", "By default calibration-DATE.toml next to RIG.toml.", required=False),
            argument("--operator", choices=("terminal", "lines"), default="terminal",
                     help="lines: asks by JSON lines on standard output, for a window or script."),
            switch("--use", help="Name the new file in RIG.toml."),
            JSON,
        ),
        CalibrationOptions,
    ),
    Command(
        "operate", "operate:operate",
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
    Command("emulate", "emulate:emulate", "Emulate instruments at the ends of a rig's wires.", (RIG, JSON)),
    Command(
        "estimate", "bank:estimate",
        "Estimate Green's functions from kept recordings.\n\nGoes on where a stopped estimate left off.",
        (file("raw", metavar="RAW.h5", help="The file of raw recordings."), FROM_BANK, CLUSTER, JSON),
    ),
    Command(
        "import", "bank:import_bank",
        "Make a bank of responses that were measured elsewhere.\n\n"
        "Reads impulse responses and frequency responses, and turns the latter into causal impulse responses. Prints "
        "what was read, assumed and left out, and stores it in the bank. A fact that the file lacks is asked for by "
        "the name of its option. docs/how-to/import.md shows each format.",
        (
            file("source", metavar="SRC", help="The file; for wav a folder."),
            file("--bank", metavar="OUT.h5", required=True, help="The bank to write."),
            argument("--from", dest="kind", choices=tuple(IMPORTS), default="", help="Format, by default recognised."),
            *options_of(ImportOptions),
            FORCE, JSON,
        ),
        ImportOptions,
    ),
    Command(
        "export", _export,
        "Write a bank in the format of another field.\n\n"
        "Title, people and licence come from [publication] of the bank's run file, or from --publication.",
        (
            BANK,
            file("out", metavar="OUT", help="The file to write; for wav a folder."),
            argument("--to", choices=(*EXPORTS, UFF_BINARY), required=True, metavar="FORMAT",
                     help=f"{', '.join(one.title for one in EXPORTS.values())}; or {UFF_BINARY}, of a fifth the size."),
            POSITIONS,
            *options_of(ExportOptions, "missing", "publication"), FORCE, JSON,
        ),
        ExportOptions,
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
            switch("--quick", help="A hundred positions on a plate without a rim: to see that it works."),
            FORCE,
        ),
    ),
)  # fmt: skip

GROUPS: Mapping[str, tuple[Command, ...]] = {
    "commands that measure": MEASURE,
    "commands that use a bank": USE,
    "commands for the rig and for data": RIG_AND_DATA,
}
COMMANDS = tuple(command for group in GROUPS.values() for command in group)
GENERAL = {
    name: one.settings["help"]
    for one in (
        FORCE,
        CLUSTER,
        *options_of(DoctorOptions, "as_lines"),
        *options_of(SessionOptions, "accept_drift", "accept_calibration"),
        *options_of(RenderOptions, "device"),
        *options_of(LiveOptions, "gain_db"),
    )
    for name in one.names
}
"""Options that mean the same in several commands: they stand in the help of the program alone."""
