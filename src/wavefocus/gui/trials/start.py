"""The dialog that starts a participant's trials, in a window and a process of their own."""

from functools import partial
from pathlib import Path

from PyQt5.QtWidgets import QDialog, QFormLayout, QLineEdit, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.files import FileKind, PathField, names_virtual_rig, short_path
from wavefocus.gui.process import CommandProcess
from wavefocus.gui.surface import VIRTUAL
from wavefocus.gui.tab import OwnCommand, TabContext


class TrialsStart(QDialog):
    """Names the participant, shows what is left of the trials, and starts the participant's window.

    trials: The trials file.
    """

    def __init__(self, context: TabContext, trials: Path, owner: QWidget) -> None:
        super().__init__(owner)
        self.setWindowTitle(f"Trials: {trials.name}")
        self._context, self._trials = context, trials
        self.command = OwnCommand(context)
        self.participant = ui.named(QLineEdit(), "Code of the participant, no name: letters, digits, -", "Participant")
        self.bank = PathField("", ".h5", "bank file", context)
        self.rig = PathField("", ".toml", "rig file", context, words=(VIRTUAL,))
        self.out = PathField("", "", "folder for the answers", context)
        for field, kind, name in ((self.bank, FileKind.BANK, "plate.h5"), (self.rig, FileKind.RIG, "rig.toml")):
            beside, found = trials.with_name(name), context.shared.get(kind)
            if beside.is_file() and (found is None or found.parent != trials.parent):
                found = beside
            if found is not None:
                field.show_path(found)
        self.out.show_path(trials.with_name("answers"))
        self.standing = ui.label("What is left of the trials", wraps=True)
        tip = "Open the participant's window; stimuli are prepared first"
        self.start = ui.push_button("&Start", tip, self._start)
        close = ui.push_button("&Close", "Close this dialog; a participant's window stays", self.close)
        form = QFormLayout()
        form.addRow("&Participant", self.participant)
        for words, field in (("&Bank", self.bank), ("&Rig", self.rig), ("&Answers", self.out)):
            label, _ = ui.labelled(words, field.line)
            form.addRow(label, field)
        ui.column(
            ui.label(text=short_path(trials), role="strong"), form, self.standing, ui.row(None, self.start, close),
            owner=self, margins=(12, 12, 12, 12), spacing=8,
        )  # fmt: skip
        self.resize(620, self.sizeHint().height())
        self._timer = ui.later(self, 300, self._read)
        for line in (self.participant, self.out.line):
            line.textChanged.connect(self._changed)
        self._changed()

    def _changed(self) -> None:
        self.start.setEnabled(False)
        self._timer.start()

    def _read(self) -> None:
        participant, out = self.participant.text().strip(), self.out.path
        if self.command.running or out is None:
            return
        work = partial(_standing, self._trials, out, participant)
        self._context.background.ask("trials", work, self._show, lambda failure: self._show((str(failure), False)))

    def _show(self, standing: tuple[str, bool]) -> None:
        sentence, can_start = standing
        self.standing.setText(sentence)
        self.start.setEnabled(can_start and not self.command.running)

    def _start(self) -> None:
        bank, rig, out = self.bank.path, self.rig.path or self.rig.line.text().strip(), self.out.path
        if bank is None or not rig or out is None:
            self.standing.setText("choose a bank, a rig and a folder for the answers first")
            return
        arguments = ["trials", str(self._trials), "--bank", str(bank), "--rig", str(rig), "--out", str(out)]
        arguments += ["--participant", self.participant.text().strip()]
        virtual = names_virtual_rig(rig)
        holds = "" if virtual else f"trials of participant {self.participant.text().strip()} are running"
        self._context.claim_instruments("Start", partial(self._run, arguments, holds), virtual=virtual)

    def _run(self, arguments: list[str], holds: str) -> None:
        self.command.run(arguments, self._ended, holds=holds, name="the trials", advice="Start resumes them")
        self.start.setEnabled(False)
        self.standing.setText("the participant's window opens when the stimuli are prepared")

    def _ended(self, process: CommandProcess) -> None:
        self._context.report_end(process, stopped="the trials were ended before; Start resumes them")
        self._read()


def _standing(trials: Path, out: Path, participant: str) -> tuple[str, bool]:
    """Say what is left of a participant's trials, and whether they can be started.

    Raises InputError: a file is wrong, or the participant is complete or has answered another experiment.
    """
    from wavefocus.trials.answers import ANSWERS, check_participant, read_answers  # loads SciPy, and runs in a thread
    from wavefocus.trials.design import load_trials
    from wavefocus.trials.order import resume_sequence

    design = load_trials(trials)
    of = "" if design.trials is None else f" of {design.trials}"
    if not participant:
        return f"{design.config.trials.name}: {len(design.stimuli)} stimuli; type the participant's code", False
    rows = read_answers(out) if (out / ANSWERS).exists() else ()
    order, done = resume_sequence(design, check_participant(participant), rows)
    trial, blocks = order.next_trial(), design.config.trials.blocks
    assert trial is not None
    left = blocks - trial.block + 1
    return f"participant {participant}: {done}{of} trials are answered, {left} of {blocks} blocks are left", True
