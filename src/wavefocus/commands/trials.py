"""``wavefocus trials``: a perception experiment, one participant at a time, in a window or by JSON lines."""

from __future__ import annotations

import json
import platform
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path

from wavefocus.campaign.blueprint import bank_configuration
from wavefocus.config.messages import Message, tag
from wavefocus.config.messages.trials import ORDERS, EndTrials, Preparing, TrialsEnded
from wavefocus.config.rig import RigConfig
from wavefocus.config.trials import MaskingTable
from wavefocus.console import Exit, progress, say
from wavefocus.ending import ending_at_once, interrupt
from wavefocus.input_files import require_sound
from wavefocus.json_lines import LinesIn, LinesOut, read_order
from wavefocus.options import TrialsOptions
from wavefocus.rig.limits import interface_of, rig_of, stricter
from wavefocus.rig.setup import open_setup
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError
from wavefocus.trials.answers import AnswersFile, check_participant, write_facts
from wavefocus.trials.design import FACTS_OF_A_STIMULUS, TrialsDesign, load_trials
from wavefocus.trials.order import resume_sequence
from wavefocus.trials.presentation import MASKING_CREST, Onset, RigPresenter, Sound
from wavefocus.trials.session import TrialsSession
from wavefocus.trials.stimuli import Prepared, prepare


def trials(trials_file: Path, bank: Path, rig_file: Path, out: Path, options: TrialsOptions) -> int:
    """Carry out the trials of one participant, in a window or by JSON lines; or only prepare the stimuli.

    Exit code 0 when the participant is complete, 130 when the session was ended before; the same command resumes it.

    Raises InputError: anything in the files is wrong, alone or against each other, or the participant's answers are of
    another experiment. BankBusyError: another process stores answers in the folder. InstrumentError: an instrument
    failed for good; all answers are stored.
    """
    design, participant, fast = load_trials(trials_file), options.participant, options.fast
    if not options.only_prepare:
        if not participant:
            raise InputError("trials: --participant is missing; only --prepare goes without one")
        check_participant(participant)
        if not options.as_lines:
            from wavefocus.commands.gui import open_trials

            arguments = [str(trials_file), "--bank", str(bank), "--rig", str(rig_file), "--participant", participant]
            return open_trials([*arguments, "--out", str(out), *(["--fast"] if fast else [])], say)
    line = None if options.only_prepare else _Line(LinesOut())
    with open_bank(bank) as view, AnswersFile(out) as answers:
        require_sound(view)
        rig = rig_of(rig_file, view)
        assert rig is not None  # one that is named is there
        if fast and not rig.is_virtual:
            raise InputError(f"{rig_file}: --fast is for a virtual rig")
        _masking(design, rig)  # refused before anything is rendered
        if line is not None:
            resume_sequence(design, participant, answers.rows)
            line.start()
        with nullcontext() if line is None else line.breakable():
            prepared = _prepared(design, view, rig, out, line, anew=not answers.rows)
        if line is None:
            say(f"{out}: {len(design.stimuli)} stimuli are ready")
            if options.as_json:
                print(json.dumps({"bank_sha256": prepared.bank_sha256, "stimuli": dict(prepared.sha256)}))
            return Exit.DONE
        resume_sequence(design, participant, answers.rows, prepared)
        write_facts(out, _facts(design, view, rig, prepared))
        return _carried_out(line, design, prepared, view, rig, answers, participant, fast=fast)


def _carried_out(
    line: _Line,
    design: TrialsDesign,
    prepared: Prepared,
    bank: Bank,
    rig: RigConfig,
    answers: AnswersFile,
    participant: str,
    *,
    fast: bool,
) -> Exit:
    """Carry out a session on the instruments, by JSON lines."""
    run = None if bank.rig_json is None or bank.run_json is None else bank_configuration(bank).run
    masking, table = _masking(design, rig), design.config.trials
    outputs = 0 if masking is None else masking.output + 1
    complete, session = False, None

    def sound(name: str) -> Sound:
        """A stimulus as it is presented. Raises InputError: its drive file is missing or damaged."""
        drive = prepared.drive(name)
        return Sound(drive.drive_v, max(0, round(-drive.start_s * drive.sample_rate_hz)), design.stimuli[name].plays)

    try:
        with ending_at_once(), open_setup(rig, run, realtime=not fast, outputs=outputs) as setup:
            rate_hz = float(bank.sample_rate_hz)
            line.presenter = RigPresenter(setup, sound, rate_hz, table.pause_s, masking, table.seed)
            session = TrialsSession(design, prepared, participant, answers, line, line, line.publish, hurried=fast)
            complete = session.run()
    except KeyboardInterrupt:
        pass
    finally:
        if session is not None:
            line.publish(TrialsEnded(session.done, session.of, complete))
    if session is None:
        say("stopped by the user; the outputs are muted")
        return Exit.STOPPED
    of = "" if session.of is None else f" of {session.of}"
    where = f"participant {participant}: {session.done}{of} trials are answered"
    say(f"{where}; the outputs are muted" + ("" if complete else "; the same command resumes"))
    return Exit.DONE if complete else Exit.STOPPED


class _Line:
    """Orders from standard input, and work that their end breaks off.

    publish: Writes events.
    presenter: Set before the first stimulus.
    """

    presenter: RigPresenter

    def __init__(self, publish: LinesOut) -> None:
        self.publish, self._lines = publish, LinesIn()
        self._lock = threading.Lock()
        self._breakable = self._over = False

    def start(self) -> None:
        """Begin to read orders."""
        self._lines.start(self._overtake, self._end, self._end)

    @contextmanager
    def breakable(self) -> Iterator[None]:
        """Raise KeyboardInterrupt in the block where the end comes meanwhile, or came before."""
        with self._lock:
            if self._over:
                raise KeyboardInterrupt
            self._breakable = True
        try:
            yield
        finally:
            with self._lock:
                self._breakable = False

    def next(self, timeout_s: float | None) -> Message | None:
        """The next order, as of `wavefocus.trials.session.Orders`."""
        while True:
            try:
                # A wait without an end cannot be broken off by Ctrl-C on Windows.
                content = self._lines.next(1.0 if timeout_s is None else timeout_s)
            except TimeoutError:
                if timeout_s is not None:
                    raise
                continue
            return None if content is None else read_order(content, ORDERS)

    def present(self, stimulus: str, trial: int, note: Callable[[str], object]) -> Onset:
        """Present a stimulus; breakable."""
        with self.breakable():
            return self.presenter.present(stimulus, trial, note)

    def mute(self) -> None:
        self.presenter.mute()

    def _overtake(self, content: Mapping[str, object]) -> None:
        if content.get("order") == tag(EndTrials):
            self._end()

    def _end(self) -> None:
        with self._lock:
            self._over = True
            if self._breakable:
                interrupt()


def _masking(design: TrialsDesign, rig: RigConfig) -> MaskingTable | None:
    """The masking noise, checked against the rig."""
    table, player = design.config.masking, rig.player
    if table is None:
        return None
    if table.output in player.channels or table.output == player.loopback_channel:
        use = "the loopback" if table.output == player.loopback_channel else "an actuator"
        raise design.wrong("masking.output", table.output, f"is the output of {use} in the rig file; use a spare one")
    wired_v = player.output_full_scale_v
    full_scale_v = wired_v[table.output] if table.output < len(wired_v) else player.full_scale_v
    if table.rms_v * MASKING_CREST > full_scale_v:
        allowed = f"must be at most {full_scale_v / MASKING_CREST:g} V, a fifth of the output's full scale"
        raise design.wrong("masking.rms_v", table.rms_v, allowed)
    return table


def _prepared(
    design: TrialsDesign,
    bank: Bank,
    rig: RigConfig,
    out: Path,
    line: _Line | None,
    *,
    anew: bool,
) -> Prepared:
    limits = stricter(design.config.output, rig.player)
    with progress("prepare", len(design.stimuli)) as report:

        def show(done: int, total: int) -> None:
            report(done, total)
            if line is not None:
                line.publish(Preparing(done, total))

        interface = interface_of(rig)
        prepared = prepare(design, bank, out, limits=limits, interface=interface, on_progress=show, anew=anew)
    for warning in prepared.warnings:
        say(f"warning: {warning}")
    return prepared


def _facts(design: TrialsDesign, bank: Bank, rig: RigConfig, prepared: Prepared) -> dict[str, object]:
    """What ``trials.json`` says of the experiment."""
    return {
        "name": design.config.trials.name,
        "trials_file": design.file.name,
        "trials_sha256": design.sha256,
        "bank": bank.path.name,
        "bank_sha256": prepared.bank_sha256,
        "sample_rate_hz": float(bank.sample_rate_hz),
        "rig": rig.rig.name,
        "software": {name: version(name) for name in ("wavefocus", "numpy", "scipy")}
        | {"python": platform.python_version()},
        "design": design.config.model_dump(mode="json", exclude_none=True),
        "stimuli": {
            name: {key: getattr(one, key) for key in FACTS_OF_A_STIMULUS} | {"sha256": prepared.sha256[name]}
            for name, one in design.stimuli.items()
        },
    }
