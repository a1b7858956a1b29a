"""The trials' window: pages by the session's state, answers by keyboard, mouse and touch, closing that mutes."""

import signal
import time
from collections.abc import Callable, Sequence

from PyQt5.QtCore import QSize, Qt, QTimer, pyqtSignal
from PyQt5.QtGui import QCloseEvent, QKeyEvent
from PyQt5.QtWidgets import QApplication, QMainWindow, QStackedWidget, QWidget

from wavefocus.config.messages import Refused, message_of, to_record
from wavefocus.config.messages.trials import (
    EVENTS,
    Answer,
    EndTrials,
    GoOn,
    Preparing,
    Replay,
    TrialsEnded,
    TrialsState,
    Welcome,
)
from wavefocus.gui import widgets as ui
from wavefocus.gui.message_bar import ErrorHook
from wavefocus.gui.process import CommandProcess, Message
from wavefocus.gui.theme import use_desktop_theme
from wavefocus.gui.trials.pages import REPLAY_KEY, Input, NoticePage, QuestionPage, WelcomePage, counted, key_code
from wavefocus.gui.window import make_application

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
        self._error_hook.install()
        self.notice = NoticePage(lambda _at_s, _by: self._continue())
        self.welcome: WelcomePage | None = None
        self.question: QuestionPage | None = None
        self._state: TrialsState | None = None
        self._ended: TrialsEnded | None = None
        self.waiting = "nothing"
        self._keys: dict[int, str] = {}
        self._pages = QStackedWidget()
        self._pages.addWidget(self.notice)
        self.setCentralWidget(self._pages)
        self.addAction(ui.action(self, "Full screen", self._toggle_full_screen, "F11"))
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
        elif key == key_code(REPLAY_KEY):
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
        self._show(self.notice)
        self.notice.show_notice("Muting", _RESUME)
        self._send(EndTrials())
        self.process.stop(20_000, 10_000)  # the child mutes when its input ends; a driver that hangs is not waited for

    def _receive(self, message: Message) -> None:
        if self.waiting == "closing":
            return
        match message_of(message, EVENTS):
            case Preparing(done=done, of=of):
                self.notice.show_notice("Preparing", f"{done} of {of} stimuli", progress=(done, of))
                self.show()
            case Welcome() as welcome:
                self._introduce(welcome)
                self.show()
            case TrialsState() as state:
                self._state = state
                self._enter(state)
            case Refused(sentence=sentence):
                self._refused(sentence)
            case TrialsEnded() as ended:
                self._ended = ended

    def _introduce(self, welcome: Welcome) -> None:
        self.setWindowTitle(f"{welcome.name}, participant {welcome.participant} - wavefocus")
        self._keys = {key_code(key): choice for choice, key in welcome.answers.items()}
        self.welcome = WelcomePage(welcome, lambda _at_s, _by: self._continue())
        replay = (lambda _at_s, _by: self._replay()) if welcome.replay_allowed else None
        self.question = QuestionPage(welcome, self._answer, replay)
        self._pages.addWidget(self.welcome)
        self._pages.addWidget(self.question)
        self._show(self.welcome)
        self.welcome.button.setFocus()

    def _enter(self, state: TrialsState) -> None:
        """Show the page of a state."""
        self.waiting = state.waiting
        if self.welcome is None or self.question is None or (state.phase == "welcome" and state.waiting == "go_on"):
            return
        if state.waiting == "answer":
            self._show(self.question)
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
        self._show(self.notice)

    def _show(self, page: QWidget) -> None:
        self._pages.setCurrentWidget(page)

    def _continue(self) -> None:
        if not self.process.running or (self._state is not None and self._state.phase == "done"):
            self.close()
        elif self.waiting == "go_on":
            self.waiting = "nothing"
            self._send(GoOn())

    def _answer(self, choice: str, at_s: float, by: Input) -> None:
        if self.waiting == "answer" and self.question is not None:
            self.waiting = "nothing"
            self.question.close_question(choice)
            self._send(Answer(choice, at_s, by))

    def _replay(self) -> None:
        if self.waiting == "answer" and self.question is not None and self.question.replay is not None:
            self.waiting = "nothing"
            self.question.close_question()
            self._send(Replay())

    def _refused(self, sentence: str) -> None:
        if self._state is not None:
            self._enter(self._state)
        if self.question is not None:
            self.question.note.setText(sentence)

    def _send(self, order: Answer | EndTrials | GoOn | Replay) -> None:
        self.process.send(**to_record(order))

    def _finished(self) -> None:
        """The child has ended: close, or say why and stay."""
        if self.waiting == "closing" or not self.isVisible():
            self.close()
            return
        self.waiting = "nothing"
        complete = self._ended is not None and self._ended.complete
        if complete:
            self.notice.show_notice(*_THANKS)
        elif self.welcome is None:
            self.notice.show_notice("The trials cannot begin", self.process.failure, "Close")
        else:
            self.notice.show_notice("Please call the experimenter", f"{self.process.failure}\n\n{_RESUME}", "Close")
        self._show(self.notice)

    def _toggle_full_screen(self) -> None:
        self.showNormal() if self.isFullScreen() else self.showFullScreen()

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
