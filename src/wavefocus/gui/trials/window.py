"""The trials' window: pages by the session's state, answers by keyboard, mouse and touch, closing that mutes."""

import signal
import time
from collections.abc import Callable, Sequence
from typing import Literal

from PyQt5.QtCore import QSize, Qt, QTimer, pyqtSignal
from PyQt5.QtGui import QCloseEvent, QKeyEvent, QKeySequence, QMouseEvent
from PyQt5.QtWidgets import QApplication, QLabel, QMainWindow, QPushButton, QSizePolicy, QStackedWidget, QWidget

from wavefocus.config.messages import Refused, message_of, to_record
from wavefocus.config.messages import trials as messages
from wavefocus.gui import widgets as ui
from wavefocus.gui.message_bar import ErrorHook
from wavefocus.gui.process import CommandProcess, Message
from wavefocus.gui.theme import use_desktop_theme
from wavefocus.gui.window import make_application

Input = Literal["keyboard", "button", "touch"]

TITLE, LARGE, TEXT = 2.4, 1.7, 1.25
"""Sizes of text, as factors of the application's."""
_ARROWS = {"Left": "←", "Right": "→", "Up": "↑", "Down": "↓"}


def sized(label: QLabel, factor: float, *, centred: bool = False) -> QLabel:
    """Give a label another size of text; return it."""
    font = QApplication.font()
    font.setPointSizeF(font.pointSizeF() * factor)
    label.setFont(font)
    label.setTextFormat(Qt.TextFormat.PlainText)
    if centred:
        label.setAlignment(Qt.AlignmentFlag.AlignCenter)
    return label


def _key_code(name: str) -> int:
    """Qt's number of a key by its name, as ``Left``, ``F`` or ``1``; 0 where there is none."""
    sequence = QKeySequence(name)
    return int(sequence[0]) if sequence.count() == 1 else 0


class _LargeButton(QPushButton):
    """A large button that acts when it is pressed, not when it is released: the press is what reaction times mean.

    text, key: Its text, and the name of its key, which is shown under it; the window itself listens to keys.
    lines, columns: Least height and width, in its text.
    size: Of the text, as a factor.

    by: The input of the last press.
    """

    def __init__(self, text: str, key: str, *, lines: float = 2.8, columns: int = 16, size: float = LARGE) -> None:
        super().__init__()
        self.by: Input = "button"
        self.setAccessibleName(text)
        self.setAccessibleDescription(f"Key {key}" if key else "")
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.name = sized(ui.label(text=text, wraps=True), size, centred=True)
        self.key = sized(ui.label(text=_ARROWS.get(key, key), role="faint"), TEXT, centred=True)
        for part in (self.name, self.key):
            part.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        ui.column(None, self.name, *([self.key] if key else []), None, owner=self, margins=(8, 4, 8, 4), spacing=2)
        metrics = self.name.fontMetrics()
        self.setMinimumSize(columns * metrics.horizontalAdvance("0"), int(lines * metrics.lineSpacing()))

    def show_text(self, text: str) -> None:
        """Show another text."""
        self.name.setText(text)
        self.setAccessibleName(text)

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Qt makes mouse events of touches; their source says so."""
        real = event is None or event.source() == Qt.MouseEventSource.MouseEventNotSynthesized
        self.by = "button" if real else "touch"
        super().mousePressEvent(event)

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Act on Space alone, once per press; arrow keys are answers and move no focus."""
        if event is None or event.key() != Qt.Key.Key_Space:
            if event is not None:
                event.ignore()
            return
        self.by = "keyboard"
        super().keyPressEvent(event)


def counted(number: int, of: int | None) -> str:
    """A number, and of how many where that is known."""
    return f"{number}" if of is None else f"{number} of {of}"


def _calm(*items: ui.Item, owner: QWidget, columns: int = 62) -> QWidget:
    """Lay a page out: its items in the middle, no wider than a line is easily read."""
    centre = QWidget()
    ui.column(None, *items, None, owner=centre, spacing=14)
    centre.setMaximumWidth(int(columns * TEXT * owner.fontMetrics().horizontalAdvance("0")))
    ui.row(None, (centre, 8), None, owner=owner, margins=(24, 16, 24, 16))
    return owner


REPLAY_KEY = "R"
_CLOSING = "The window can be closed at any time: the surface is muted at once, and your answers are kept."


class _QuestionPage(QWidget):
    """The question, a button for each answer from left to right, and one to feel the stimulus again, if allowed.

    answer: Receives choice, instant of the press on the monotonic clock, in seconds, and input.
    """

    def __init__(self, welcome: messages.Welcome, answer: Callable[[str, float, Input], None]) -> None:
        super().__init__()
        self.question = sized(ui.label("Question", welcome.question, wraps=True), TITLE, centred=True)
        self.note = sized(ui.label("Note", role="faint", wraps=True), TEXT, centred=True)
        size = LARGE if len(welcome.answers) <= 4 else TEXT
        self.answers = {
            choice: _LargeButton(choice, key, lines=5.0, columns=0, size=size)
            for choice, key in welcome.answers.items()
        }
        for choice, button in self.answers.items():
            button.pressed.connect(lambda choice=choice, button=button: answer(choice, time.monotonic(), button.by))
        taken = REPLAY_KEY in (key.upper() for key in welcome.answers.values())
        self.replay = _LargeButton("Feel it again", "" if taken else REPLAY_KEY)
        row = ui.row(*((button, 1) for button in self.answers.values()), spacing=18)
        _calm(self.question, 10, row, 20, ui.row(None, self.replay, None), self.note, owner=self, columns=90)
        self.replay.setVisible(welcome.replay_allowed)

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
        self.note.setText("")
        for button in (*self.answers.values(), self.replay):
            button.setEnabled(on)
            button.setDown(False)


class _NoticePage(QWidget):
    """A title, some text, a bar where something is counted, and at most one button."""

    def __init__(self) -> None:
        super().__init__()
        self.title = sized(ui.label("Title", wraps=True), TITLE, centred=True)
        self.text = sized(ui.label("Text", wraps=True), TEXT)
        self.bar = ui.progress_bar("Progress")
        self.button = _LargeButton("Continue", "Space")
        content, foot = QWidget(), QWidget()
        _calm(self.title, self.text, self.bar, owner=content)
        _calm(ui.row(None, self.button, None), owner=foot)
        ui.column((ui.scrolling(content), 1), foot, owner=self)

    def show_notice(
        self,
        title: str,
        text: str = "",
        button: str = "",
        progress: tuple[int, int] | None = None,
        align: Qt.AlignmentFlag = Qt.AlignmentFlag.AlignCenter,
    ) -> None:
        """Show a title and a text; a button with a text, a bar with a part and its whole."""
        self.title.setText(title)
        self.text.setText(text)
        self.text.setAlignment(align)
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


_SIZE, _FRAME = QSize(1000, 700), QSize(16, 48)
_THANKS = ("Thank you", "All trials are done. Please call the experimenter.", "Close")
_RESUME = "Every answer given so far is stored. The session can go on later at the next trial."
_SHORTCUTS = (Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.AltModifier, Qt.KeyboardModifier.MetaModifier)


class TrialsWindow(QMainWindow):
    """One participant's session, which a child process runs.

    arguments: Of ``wavefocus trials``, without ``--lines``.

    waiting: Of the last state until an order answers it, then ``"nothing"``; ``"closing"`` at the end.
    """

    closed = pyqtSignal()

    def __init__(self, arguments: Sequence[str]) -> None:
        super().__init__()
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        use_desktop_theme(application)
        self.setWindowTitle("Trials - wavefocus")
        self.tracebacks: list[str] = []
        """Tracebacks of errors that nobody caught."""
        self._error_hook = ErrorHook(self._report_error, self.close)
        self.notice = _NoticePage()
        self.notice.button.pressed.connect(self._continue)
        self.question: _QuestionPage | None = None
        self._state: messages.TrialsState | None = None
        self.waiting = "nothing"
        self._keys: dict[int, str] = {}
        self._pages = QStackedWidget()
        self._pages.addWidget(self.notice)
        self.setCentralWidget(self._pages)
        full = Qt.WindowState.WindowFullScreen
        toggle = ui.action(self, "Full screen", lambda: self.setWindowState(self.windowState() ^ full), "F11")
        self.addAction(toggle)
        self.addAction(ui.action(self, "Leave full screen", self.showNormal, "Esc"))
        screen = QApplication.primaryScreen()
        self.resize(_SIZE if screen is None else _SIZE.boundedTo(screen.availableSize() - _FRAME))
        self.process = CommandProcess(["trials", *arguments, "--lines"], self, name="wavefocus trials")
        self.process.received.connect(self._receive)
        self.process.finished.connect(self._finished)

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Answer, replay or continue by a key; a key that is held down counts once."""
        at_s = time.monotonic()
        if event is None or event.isAutoRepeat() or any(event.modifiers() & key for key in _SHORTCUTS):
            return
        key = event.key()
        if self.waiting == "go_on" and key in (Qt.Key.Key_Space, Qt.Key.Key_Return, Qt.Key.Key_Enter):
            self._continue()
        elif key in self._keys:
            self._answer(self._keys[key], at_s, "keyboard")
        elif key == _key_code(REPLAY_KEY):
            self._replay()

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802
        """Mute at once; the window disappears when the instruments are free."""
        assert event is not None
        if not self.process.running:
            self._error_hook.remove()
            event.accept()
            self.closed.emit()
            return
        event.ignore()
        self.waiting = "closing"
        self.notice.show_notice("Muting", _RESUME)
        self._pages.setCurrentWidget(self.notice)
        self._send(messages.EndTrials())
        self.process.stop(20_000, 10_000)  # the child mutes when its input ends; a driver that hangs is not waited for

    def _receive(self, message: Message) -> None:
        if self.waiting == "closing":
            return
        match message_of(message, messages.EVENTS):
            case messages.Preparing(done=done, of=of):
                self.notice.show_notice("Preparing", f"{done} of {of} stimuli", progress=(done, of))
                self.show()
            case messages.Welcome() as welcome:
                self._introduce(welcome)
                self.show()
            case messages.TrialsState() as state:
                self._state = state
                self._enter(state)
            case Refused(sentence=sentence):
                if self._state is not None:
                    self._enter(self._state)
                if self.question is not None:
                    self.question.note.setText(sentence)

    def _introduce(self, welcome: messages.Welcome) -> None:
        self.setWindowTitle(f"{welcome.name}, participant {welcome.participant} - wavefocus")
        self._keys = {_key_code(key): choice for choice, key in welcome.answers.items()}
        self.question = _QuestionPage(welcome, self._answer)
        self.question.replay.pressed.connect(self._replay)
        self._pages.addWidget(self.question)
        place = f"  ·  resumes at trial {counted(welcome.done + 1, welcome.of)}" if welcome.resumed else ""
        keys = "     ".join(f"{_ARROWS.get(key, key)}  {answer}" for answer, key in welcome.answers.items())
        question, stored = f"{welcome.question}\n{keys}", "\n".join(["Stored:", *welcome.stored])
        texts = f"Participant {welcome.participant}{place}", welcome.instruction, question, stored, _CLOSING
        button = "Resume" if welcome.resumed else "Start"
        text = "\n\n".join(filter(None, texts))
        self.notice.show_notice(welcome.name, text, button, align=Qt.AlignmentFlag.AlignLeft)

    def _enter(self, state: messages.TrialsState) -> None:
        """Show the page of a state."""
        self.waiting = state.waiting
        if self.question is None or (state.phase == "welcome" and state.waiting == "go_on"):
            return
        if state.waiting == "answer":
            self._pages.setCurrentWidget(self.question)
            self.question.ask()
            return
        notice = self.notice.show_notice
        done = max(0, state.trial - 1)
        match state.phase, state.waiting:
            case "done", _:
                notice(*_THANKS)
            case "break", "go_on":
                bar = None if state.of is None else (done, state.of)
                notice("A break", f"{counted(done, state.of)} trials are done.", "Continue", bar)
            case "familiarisation", "go_on":
                notice("To get to know them", f"You feel {state.of} stimuli, without a question.", "Continue")
            case _, "go_on":
                notice("Ready?", "After each stimulus, answer the question." if state.trial == 1 else "", "Feel")
            case "familiarisation", "playing":
                notice("Feel", counted(state.trial, state.of))
            case _, "playing":
                notice("Feel", "The stimulus is repeated." if state.note else "")
            case _:
                notice("One moment, please", state.note)
        self._pages.setCurrentWidget(self.notice)

    def _continue(self) -> None:
        if not self.process.running or (self._state is not None and self._state.phase == "done"):
            self.close()
        elif self.waiting == "go_on":
            self.waiting = "nothing"
            self._send(messages.GoOn())

    def _answer(self, choice: str, at_s: float, by: Input) -> None:
        if self.waiting == "answer" and self.question is not None:
            self.waiting = "nothing"
            self.question.close_question(choice)
            self._send(messages.Answer(choice, at_s, by))

    def _replay(self) -> None:
        if self.waiting == "answer" and self.question is not None and not self.question.replay.isHidden():
            self.waiting = "nothing"
            self.question.close_question()
            self._send(messages.Replay())

    def _send(self, order: messages.Answer | messages.EndTrials | messages.GoOn | messages.Replay) -> None:
        self.process.send(**to_record(order))

    def _finished(self) -> None:
        """The child has ended: close, or say why and stay."""
        if self.waiting == "closing" or not self.isVisible():
            self.close()
            return
        self.waiting = "nothing"
        if not self.process.failure:
            self.notice.show_notice(*_THANKS)
        elif self.question is None:
            self.notice.show_notice("The trials cannot begin", self.process.failure, "Close")
        else:
            rest = "" if self._state is not None and self._state.phase == "done" else f"\n\n{_RESUME}"
            self.notice.show_notice("Please call the experimenter", f"{self.process.failure}{rest}", "Close")
        self._pages.setCurrentWidget(self.notice)

    def _report_error(self, sentence: str, details: str) -> None:
        """Show an error that nobody caught; the session goes on."""
        if details:
            self.tracebacks.append(details)
        (self.notice.text if self.question is None else self.question.note).setText(sentence)


def show(arguments: Sequence[str], say: Callable[[str], object]) -> int:
    """Run the window until it is closed; return the child's exit code. It does not appear where the input is wrong.

    say: Receives why the child ended early, a sentence.
    """
    application = make_application()
    application.setQuitOnLastWindowClosed(False)
    window = TrialsWindow(arguments)
    window.closed.connect(application.quit)
    alive = QTimer()  # Python runs signal handlers between Qt's events
    alive.timeout.connect(lambda: None)
    alive.start(200)
    former = signal.signal(signal.SIGTERM, lambda _number, _frame: window.close())
    try:
        application.exec_()
    finally:
        signal.signal(signal.SIGTERM, former)
    if window.process.failure:
        say(window.process.failure)
    code = window.process.exit_code or 0
    return 128 - code if code < 0 else code
