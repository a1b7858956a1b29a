"""All about the chosen source: its path, how it moves, what it emits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from PyQt5.QtWidgets import QFormLayout, QLabel, QVBoxLayout, QWidget

from gui.scene.document import SceneDocument
from gui.scene.draft import (
    PATHS,
    SIGNALS,
    FileDraft,
    NoiseDraft,
    PathDraft,
    PointDraft,
    PolylineDraft,
    SignalDraft,
    SineDraft,
    SourceDraft,
    SvgDraft,
)
from gui.scene.fields import ChoiceField
from gui.scene.file_row import FileRow
from gui.scene.form import Form
from gui.scene.live import Drawn
from gui.scene.surface.handles import anchor_of, shifted
from gui.scene.surface.keys import MOTION_KEYS, PATH_KEYS, SIGNAL_KEYS
from gui.scene.surface.vertices import Vertices
from gui.scene.words import figures_of
from gui.shell.tab import TabContext

_PATH_WORDS = {
    "point": "point, stands still", "line": "line", "circle": "circle or arc", "polyline": "polyline",
    "text": "text", "svg": "drawing (SVG)",
}  # fmt: skip
_SIGNAL_WORDS = {"impulse": "impulse", "sine": "sine", "noise": "noise in a band", "file": "sound file"}
_MOVES = ("speed_mm_s", "step_mm")
_USUAL_SPEED_MM_S, _USUAL_STEP_MM = 80.0, 4.0


class SourceForm(QWidget):
    """The chosen source's numbers.

    Parameters
    ----------
    context : TabContext
        Settings and background work.
    document : SceneDocument
        What is edited.
    """

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__()
        self._context, self._document = context, document
        self._listed: tuple[str, float] = "", 0.0
        self.path_kind = ChoiceField("Kind of path", [(one.kind, _PATH_WORDS[one.kind]) for one in PATHS],
                                     "Where the source goes")  # fmt: skip
        self.signal_kind = ChoiceField("Kind of signal", [(one.kind, _SIGNAL_WORDS[one.kind]) for one in SIGNALS],
                                       "What the source emits; its peak is 1 before the amplitude")  # fmt: skip
        self.paths = {kind: Form(keys) for kind, keys in PATH_KEYS.items()}
        self.signals = {kind: Form(keys) for kind, keys in SIGNAL_KEYS.items()}
        self.motion = Form(MOTION_KEYS)
        self.vertices = Vertices()
        self.drawing = FileRow("drawing", (".svg",), context.settings)
        self.path_ids = ChoiceField("Which path of the drawing", [], "Which of the drawing's paths, by its id")
        self.sound = FileRow("sound", (".wav", ".flac", ".ogg", ".aiff"), context.settings)
        self.figures = QLabel()
        self.figures.setWordWrap(True)
        self.figures.setProperty("role", "faint")
        self._lay_out()
        self.path_kind.edited.connect(self._change_path_kind)
        self.signal_kind.edited.connect(self._change_signal_kind)
        for path_form in self.paths.values():
            path_form.edited.connect(lambda key, value: self._edit_path({key: value}, key))
        for signal_form in self.signals.values():
            signal_form.edited.connect(lambda key, value: self._edit_signal({key: value}, key))
        self.motion.edited.connect(lambda key, value: self._edit({key: value}, key))
        self.vertices.edited.connect(lambda points: self._edit_path({"points_mm": points}, ""))
        self.drawing.edited.connect(lambda file: self._edit_path({"file": file, "path_id": ""}, ""))
        self.path_ids.edited.connect(lambda path_id: self._edit_path({"path_id": path_id}, ""))
        self.sound.edited.connect(lambda file: self._edit_signal({"path": file}, ""))
        document.edited.connect(self.show_source)
        document.chosen_changed.connect(self.show_source)
        self.show_source()

    def show_source(self) -> None:
        """Show the chosen source."""
        source = self._document.source
        self.setEnabled(source is not None)
        if source is None:
            self.figures.setText("")
            return
        path, signal = source.path, source.signal
        self.path_kind.show_value(path.kind)
        self.signal_kind.show_value(signal.kind)
        for kind, form in self.paths.items():
            form.setVisible(kind == path.kind)
        for kind, form in self.signals.items():
            form.setVisible(kind == signal.kind and (kind == "file" or bool(SIGNAL_KEYS[kind])))
        self.paths[path.kind].show_values(path)
        self.signals[signal.kind].show_values(signal)
        if isinstance(path, PolylineDraft):
            self.vertices.show_points(path.points_mm)
        if isinstance(path, SvgDraft):
            self.drawing.show_value(path.file)
            self._list_paths(path)
        if isinstance(signal, FileDraft):
            self.sound.show_value(signal.path)
        still = isinstance(path, PointDraft)
        shown = replace(source, speed_mm_s=source.speed_mm_s or 0.0, step_mm=source.step_mm or 0.0)
        self.motion.show_values(shown)
        for key in _MOVES:
            self.motion.fields[key].setVisible(not still)
            self.motion.labels[key].setVisible(not still)

    def show_drawn(self, drawn: Drawn) -> None:
        """Show the figures of what comes of it."""
        chosen = self._document.chosen
        if 0 <= chosen < len(drawn.traces):
            self.figures.setText(figures_of(drawn.traces[chosen]))

    def _lay_out(self) -> None:
        column = QVBoxLayout(self)
        column.setContentsMargins(6, 6, 6, 6)
        column.setSpacing(6)
        self.paths["polyline"].rows.insertRow(0, QLabel("Vertices"), self.vertices)
        svg = self.paths["svg"].rows
        svg.insertRow(0, QLabel("Path"), self.path_ids)
        svg.insertRow(0, QLabel("File"), self.drawing)
        self.signals["file"].rows.insertRow(0, QLabel("File"), self.sound)
        path_row, signal_row = _headed("Path", self.path_kind), _headed("Signal", self.signal_kind)
        column.addLayout(path_row)
        for form in self.paths.values():
            column.addWidget(form)
        column.addWidget(self.motion)
        column.addWidget(self.figures)
        column.addLayout(signal_row)
        for form in self.signals.values():
            column.addWidget(form)
        column.addStretch(1)
        forms = [*self.paths.values(), self.motion, *self.signals.values()]
        width = max(label.sizeHint().width() for form in forms for label in form.labels.values())
        for rows in (path_row, signal_row, *(form.rows for form in forms)):
            for row in range(rows.rowCount()):
                item = rows.itemAt(row, QFormLayout.ItemRole.LabelRole)
                label = None if item is None else item.widget()
                if label is not None:
                    label.setMinimumWidth(width)

    def _edit(self, changes: dict[str, Any], gesture: str) -> None:
        source = self._document.source
        if source is not None:
            self._document.edit_source("edit", replace(source, **changes), gesture=gesture)

    def _edit_path(self, changes: dict[str, Any], gesture: str) -> None:
        source = self._document.source
        if source is not None:
            self._edit({"path": replace(source.path, **changes)}, gesture and f"path {gesture}")

    def _edit_signal(self, changes: dict[str, Any], gesture: str) -> None:
        source = self._document.source
        if source is not None:
            self._edit({"signal": replace(source.signal, **changes)}, gesture and f"signal {gesture}")

    def _change_path_kind(self, kind: str) -> None:
        source = self._document.source
        if source is not None and source.path.kind != kind:
            path = moved_to(_first(PATHS, kind), source.path)
            self._edit({"path": path, **moving(source, path)}, "")
            if kind == "svg":
                self.drawing.browse()

    def _change_signal_kind(self, kind: str) -> None:
        source = self._document.source
        if source is None or source.signal.kind == kind:
            return
        signal: SignalDraft = _first(SIGNALS, kind)
        former = source.signal
        if isinstance(signal, SineDraft | NoiseDraft) and isinstance(former, SineDraft | NoiseDraft):
            signal = replace(signal, duration_s=former.duration_s)
        self._edit({"signal": signal}, "")
        if kind == "file":
            self.sound.browse()

    def _list_paths(self, path: SvgDraft) -> None:
        """List the drawing's paths, once for each file."""
        file = Path(path.file)
        try:
            listed = path.file, file.stat().st_mtime
        except (OSError, ValueError):
            listed = path.file, 0.0
        if listed == self._listed:
            self.path_ids.show_value(path.path_id)
            return
        self._listed = listed
        self._show_ids([], path.path_id)
        if path.file:
            self._context.background.ask("drawing", lambda: _path_ids(file), self._ids_came, lambda _why: None)

    def _ids_came(self, path_ids: tuple[str, ...]) -> None:
        source = self._document.source
        if source is not None and isinstance(source.path, SvgDraft):
            self._show_ids([one for one in path_ids if one], source.path.path_id)

    def _show_ids(self, path_ids: list[str], chosen: str) -> None:
        self.path_ids.clear()
        self.path_ids.addItem("the first", "")
        for path_id in dict.fromkeys([*path_ids, *([chosen] if chosen else [])]):
            self.path_ids.addItem(path_id, path_id)
        self.path_ids.show_value(chosen)


def moved_to(path: PathDraft, former: PathDraft) -> PathDraft:
    """A path put where another one was."""
    here, there = anchor_of(path), anchor_of(former)
    return shifted(path, (there[0] - here[0], there[1] - here[1]))


def moving(source: SourceDraft, path: PathDraft) -> dict[str, float]:
    """Speed and step for a path that needs them, where the source has none."""
    if isinstance(path, PointDraft):
        return {}
    return {"speed_mm_s": source.speed_mm_s or _USUAL_SPEED_MM_S, "step_mm": source.step_mm or _USUAL_STEP_MM}


def _first(kinds: tuple[type[Any], ...], kind: str) -> Any:
    return next(one for one in kinds if one.kind == kind)()


def _path_ids(file: Path) -> tuple[str, ...]:
    from rendering.scene.svg import svg_path_ids

    return svg_path_ids(file)


def _headed(words: str, field: ChoiceField) -> QFormLayout:
    row = QFormLayout()
    row.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
    label = QLabel(words)
    label.setProperty("role", "strong")
    label.setBuddy(field)
    row.addRow(label, field)
    return row
