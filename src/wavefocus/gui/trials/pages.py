"""Pages of the trials' window: the first page, a question, and a notice for all else."""

from collections.abc import Callable
from functools import partial

from PyQt5.QtWidgets import QWidget

from wavefocus.config.messages.trials import Welcome
from wavefocus.gui import widgets as ui
from wavefocus.gui.trials.parts import LARGE, TEXT, TITLE, Input, LargeButton, Pressed, calm, counted, key_text, sized

REPLAY_KEY = "R"
_CLOSING = "The window can be closed at any time: the surface is muted at once, and your answers are kept."


class WelcomePage(QWidget):
    """Instruction, keys, what is stored, and where the session begins."""

    def __init__(self, welcome: Welcome, act: Pressed) -> None:
        super().__init__()
        place = f"  ·  resumes at trial {counted(welcome.done + 1, welcome.of)}" if welcome.resumed else ""
        keys = "     ".join(f"{key_text(key)}  {answer}" for answer, key in welcome.answers.items())
        self.participant = sized(
            ui.label("Participant", f"Participant {welcome.participant}{place}", role="faint", wraps=True), TEXT
        )
        texts = (
            ("", welcome.instruction),
            ("Question", f"{welcome.question}\n{keys}"),
            ("Stored", "\n".join(welcome.stored)),
            ("", _CLOSING),
        )
        parts: list[ui.Item] = [sized(ui.label("Name", welcome.name, wraps=True), TITLE), self.participant]
        for title, text in texts:
            if title:
                parts += [4, sized(ui.label(text=title, role="faint"), 1.0)]
            if text:
                parts.append(sized(ui.label(title, text, wraps=True), TEXT))
        content, foot = QWidget(), QWidget()
        calm(*parts, owner=content)
        self.button = LargeButton("Resume" if welcome.resumed else "Start", "Space", act)
        calm(ui.row(None, self.button, None), owner=foot)
        ui.column((ui.scrolling(content), 1), foot, owner=self)


class QuestionPage(QWidget):
    """The question, a button for each answer from left to right, and one to feel the stimulus again.

    answer: Receives choice, instant and input.
    replay: None where the design does not allow it.
    """

    def __init__(self, welcome: Welcome, answer: Callable[[str, float, Input], None], replay: Pressed | None) -> None:
        super().__init__()
        self.question = sized(ui.label("Question", welcome.question, wraps=True), TITLE, centred=True)
        self.note = sized(ui.label("Note", role="faint", wraps=True), TEXT, centred=True)
        size = LARGE if len(welcome.answers) <= 4 else TEXT
        self.answers = {
            choice: LargeButton(choice, key, partial(answer, choice), lines=5.0, columns=0, size=size)
            for choice, key in welcome.answers.items()
        }
        taken = REPLAY_KEY in (key.upper() for key in welcome.answers.values())
        self.replay = None if replay is None else LargeButton("Feel it again", "" if taken else REPLAY_KEY, replay)
        again = [] if self.replay is None else [ui.row(None, self.replay, None)]
        row = ui.row(*((button, 1) for button in self.answers.values()), spacing=18)
        calm(self.question, 10, row, 20, *again, self.note, owner=self, columns=90)

    def ask(self) -> None:
        """Wait for an answer."""
        self._enable(True)
        self.setFocus()  # no button: Space must not answer by chance

    def close_question(self, choice: str = "") -> None:
        """Take no more answers; the one given stays marked."""
        self._enable(False)
        if choice:
            self.answers[choice].setDown(True)

    def _enable(self, on: bool) -> None:
        ui.put(self.note, "")
        for button in [*self.answers.values(), *([] if self.replay is None else [self.replay])]:
            button.setEnabled(on)
            button.setDown(False)


class NoticePage(QWidget):
    """A title, some text, a bar where something is counted, and at most one button."""

    def __init__(self, act: Pressed) -> None:
        super().__init__()
        self.title = sized(ui.label("Title", wraps=True), TITLE, centred=True)
        self.text = sized(ui.label("Text", wraps=True), TEXT, centred=True)
        self.bar = ui.progress_bar("Progress")
        self.button = LargeButton("Continue", "Space", act)
        calm(self.title, self.text, self.bar, 10, ui.row(None, self.button, None), owner=self)

    def show_notice(
        self, title: str, text: str = "", button: str = "", progress: tuple[int, int] | None = None
    ) -> None:
        """Show a title and a text; a button with a text, a bar with a part and its whole."""
        ui.put(self.title, title)
        ui.put(self.text, text)
        self.text.setVisible(bool(text))
        self.bar.setVisible(progress is not None)
        done, of = progress or (0, 1)
        self.bar.setMaximum(max(1, of))
        self.bar.setValue(done)
        self.button.setVisible(bool(button))
        if button:
            self.button.show_text(button)
            self.button.setDown(False)  # the press that hid it
            self.button.setFocus()
