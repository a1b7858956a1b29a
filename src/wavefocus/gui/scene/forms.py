"""Forms of the Scene tab: the chosen source with its path, motion and signal; and what holds for the whole scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QFormLayout, QHeaderView, QSizePolicy, QTableWidget, QTableWidgetItem, QWidget

from wavefocus.config.scene import (
    FileTable,
    Output,
    PointTable,
    PolylineTable,
    Regularisation,
    SceneTable,
    SourceTable,
    SvgTable,
    TrajectoryTable,
)
from wavefocus.gui import widgets as ui
from wavefocus.gui.files import PathField
from wavefocus.gui.number_box import typed_number
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import NEW_PATHS, NEW_SIGNALS, PointMm, changed, new_source
from wavefocus.gui.scene.form import ChoiceField, Form, NumberField, align
from wavefocus.gui.scene.preview import Preview, trace_text
from wavefocus.gui.scene.tools import anchor_of, shifted
from wavefocus.gui.tab import TabContext

_MAX_ROWS = 200
_TABLE_LINES = 4
_MOTION = ("speed_mm_s", "step_mm")
_SATURATIONS = ("off", "saturation", "saturation_absolute")
_LEVEL_STEPS = {"saturation": 0.1, "saturation_absolute": 1e-5}


class SourceForm(QWidget):
    """The chosen source."""

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__()
        self._context, self._document = context, document
        self._listed: tuple[str, float] = "", 0.0
        self.path_kind = ChoiceField("Kind of path", "Path of the source", tuple(NEW_PATHS))
        self.signal_kind = ChoiceField("Kind of signal", "Signal that the source emits", tuple(NEW_SIGNALS))
        self.paths = {kind: Form(type(one), ("file", "path_id", "points_mm")) for kind, one in NEW_PATHS.items()}
        self.signals = {kind: Form(type(one), ("path",)) for kind, one in NEW_SIGNALS.items()}
        self.motion = Form(SourceTable, ("path", "signal"), needed=_MOTION)
        self.vertices = VertexTable()
        self.drawing = PathField("", ".svg", "drawing", context.settings)
        self.path_ids = ChoiceField("Path of the drawing", "Path of the drawing, by its id")
        self.trajectory = PathField("", ".csv", "trajectory", context.settings)
        self.sound = PathField("", ".wav", "sound", context.settings, also=(".flac", ".ogg", ".aiff"))
        self.figures = ui.label(role="faint", wraps=True)
        self._lay_out()
        self.path_kind.edited.connect(self._change_path_kind)
        self.signal_kind.edited.connect(self._change_signal_kind)
        for forms, edit, what in ((self.paths, self._edit_path, "path"), (self.signals, self._edit_signal, "signal")):
            for form in forms.values():
                form.edited.connect(lambda key, value, edit=edit, what=what: edit(f"{what} {key}", **{key: value}))
        self.motion.edited.connect(lambda key, value: document.edit_source("edit", key, **{key: value}))
        self.vertices.edited.connect(lambda points: self._edit_path("", points_mm=points))
        self.drawing.chosen.connect(lambda file: self._edit_path("", file=str(file), path_id=""))
        self.trajectory.chosen.connect(lambda file: self._edit_path("", file=str(file)))
        self.path_ids.edited.connect(lambda path_id: self._edit_path("", path_id=path_id))
        self.sound.chosen.connect(lambda file: self._edit_signal("", path=str(file)))
        document.edited.connect(self.show_source)
        document.chosen_changed.connect(self.show_source)
        self.show_source()

    def show_source(self) -> None:
        self.setEnabled(self._document.source is not None)
        if self._document.source is None:
            self.figures.setText("")
        source = self._document.source or new_source(NEW_PATHS["line"])
        path, signal = source.path, source.signal
        self.path_kind.show_value(path.kind)
        self.signal_kind.show_value(signal.kind)
        for forms, shown in ((self.paths, path.kind), (self.signals, signal.kind)):
            for kind, form in forms.items():
                form.setVisible(kind == shown)
        self.paths[path.kind].show_values(path)
        self.signals[signal.kind].show_values(signal)
        if isinstance(path, PolylineTable):
            self.vertices.show_points(path.points_mm)
        if isinstance(path, SvgTable):
            self.drawing.show_text(path.file)
            self._list_paths(path)
        if isinstance(path, TrajectoryTable):
            self.trajectory.show_text(path.file)
        if isinstance(signal, FileTable):
            self.sound.show_text(signal.path)
        self.motion.show_values(source)
        for key in _MOTION:
            self.motion.show_row(key, not isinstance(path, PointTable | TrajectoryTable))
        self.motion.show_row("emission", not isinstance(path, TrajectoryTable))
        self.motion.show_row("repeat", not isinstance(path, PointTable))

    def show_unit(self, unit: str) -> None:
        """Show the unit of amplitudes: that of the bank's response; empty without a bank."""
        self.motion.fields["amplitude"].setSuffix(f" {unit}" if unit else "")

    def show_preview(self, preview: Preview) -> None:
        if 0 <= self._document.chosen < len(preview.traces):
            self.figures.setText(trace_text(preview.traces[self._document.chosen]))

    def _lay_out(self) -> None:
        self.paths["polyline"].insert("Vertices", self.vertices)
        self.paths["svg"].insert("Path", self.path_ids)
        self.paths["svg"].insert("File", self.drawing)
        self.paths["trajectory"].insert("File", self.trajectory)
        self.signals["file"].insert("File", self.sound)
        path_row, signal_row = _kind_row("Path", self.path_kind), _kind_row("Signal", self.signal_kind)
        forms = [*self.paths.values(), self.motion, *self.signals.values()]
        parts: list[QWidget | QFormLayout] = [path_row, *self.paths.values(), self.motion, self.figures]
        parts += [signal_row, *self.signals.values()]
        ui.column(*parts, None, owner=self, margins=(6, 6, 6, 6), spacing=6)
        align([path_row, signal_row, *(form.rows for form in forms)])

    def _edit_path(self, gesture: str, **changes: object) -> None:
        if (source := self._document.source) is not None:
            self._document.edit_source("edit", gesture, path=changed(source.path, **changes))

    def _edit_signal(self, gesture: str, **changes: object) -> None:
        if (source := self._document.source) is not None:
            self._document.edit_source("edit", gesture, signal=changed(source.signal, **changes))

    def _change_path_kind(self, kind: str) -> None:
        source = self._document.source
        if source is None or source.path.kind == kind:
            return
        path = NEW_PATHS[kind]
        here, there = anchor_of(path), anchor_of(source.path)
        moved = new_source(shifted(path, (there[0] - here[0], there[1] - here[1])), source)
        self._document.edit_source("edit", **dict(moved))
        if kind in ("svg", "trajectory"):
            (self.drawing if kind == "svg" else self.trajectory).open_dialog()

    def _change_signal_kind(self, kind: str) -> None:
        source = self._document.source
        if source is None or source.signal.kind == kind:
            return
        signal, former = NEW_SIGNALS[kind], source.signal
        lasts_s = getattr(former, "duration_s", None)
        if lasts_s is not None and hasattr(signal, "duration_s"):
            signal = changed(signal, duration_s=lasts_s)
        self._document.edit_source("edit", signal=signal)
        if kind == "file":
            self.sound.open_dialog()

    def _list_paths(self, path: SvgTable) -> None:
        """List the drawing's paths, once for each state of the file."""
        file = Path(path.file)
        try:
            listed = path.file, file.stat().st_mtime
        except (OSError, ValueError):
            listed = path.file, 0.0
        if listed == self._listed:
            self.path_ids.show_value(path.path_id)
            return
        self._listed = listed
        self._show_path_ids((), path.path_id)
        if path.file:
            self._context.background.ask("drawing", lambda: _path_ids(file), self._ids_came, lambda _why: None)

    def _ids_came(self, path_ids: tuple[str, ...]) -> None:
        source = self._document.source
        if source is not None and isinstance(source.path, SvgTable):
            self._show_path_ids(path_ids, source.path.path_id)

    def _show_path_ids(self, path_ids: Sequence[str], chosen: str) -> None:
        self.path_ids.clear()
        for path_id in dict.fromkeys(["", *path_ids, chosen]):
            self.path_ids.addItem(path_id or "the first", path_id)
        self.path_ids.show_value(chosen)


class SceneForm(QWidget):
    """Name, regularisation and output: what all sources share."""

    def __init__(self, document: SceneDocument) -> None:
        super().__init__()
        self._document = document
        self._usual_level = {"saturation": 0.5, "saturation_absolute": 1e-4}
        self.tables = {
            "scene": Form(SceneTable),
            "regularisation": Form(Regularisation, ("saturation", "saturation_absolute")),
            "output": Form(Output),
        }
        tip = "Also render scenes of over an hour, 8 GiB of drives or a million path points"
        self.large = ui.check("Allow large scenes (--allow-large)", tip, "Allow large scenes")
        self.saturates = ChoiceField("Saturation", "Limits the weight of the nearest actuators (eq. 14)", _SATURATIONS)
        self.saturates.setItemText(1, "fraction of the bank's median")
        self.saturates.setItemText(2, "level in the bank's unit")
        self.level = NumberField("Saturation level", "C of eq. (14)", low=1e-6)
        self.tables["regularisation"].insert("C", self.level)
        self.tables["regularisation"].insert("Saturation", self.saturates)
        parts: list[QWidget | int] = []
        for key, form in self.tables.items():
            parts += [ui.label(text=key.capitalize(), role="strong"), form, 6]
            form.edited.connect(lambda name, value, key=key: self._edit(key, f"{key} {name}", **{name: value}))
        ui.column(*parts, self.large, None, owner=self, margins=(6, 6, 6, 6))
        align([form.rows for form in self.tables.values()])
        self.large.toggled.connect(document.allow)
        self.saturates.edited.connect(self._saturate)
        self.level.edited.connect(
            lambda value: self._edit("regularisation", "level", **{self.saturates.currentData(): value})
        )
        document.edited.connect(self.show_scene)
        self.show_scene()

    def show_scene(self) -> None:
        for key, form in self.tables.items():
            form.show_values(getattr(self._document.draft, key))
        held = self._document.draft.regularisation
        which = "saturation_absolute" if held.saturation_absolute else "saturation" if held.saturation else "off"
        self.saturates.show_value(which)
        self.level.setEnabled(which != "off")
        if which != "off":
            self._usual_level[which] = getattr(held, which)
            self.level.setSingleStep(_LEVEL_STEPS[which])
            self.level.show_value(getattr(held, which))

    def _saturate(self, which: str) -> None:
        levels = {"saturation": 0.0, "saturation_absolute": 0.0}
        if which != "off":
            levels[which] = self._usual_level[which]
        self._edit("regularisation", "", **levels)

    def _edit(self, table: str, gesture: str, **changes: object) -> None:
        draft = self._document.draft
        after = changed(draft, **{table: changed(getattr(draft, table), **changes)})
        self._document.edit("edit the scene", after, gesture=gesture)


class VertexTable(QWidget):
    """Vertices of a polyline; text that is no number goes back to what it was."""

    edited = pyqtSignal(object)

    def __init__(self) -> None:
        super().__init__()
        self._points: tuple[PointMm, ...] = ()
        tip = "Vertices in mm, in order; a double click on a line of the polyline adds one"
        self.table = ui.named(QTableWidget(0, 2), tip, "Vertices in mm")
        self.table.setHorizontalHeaderLabels(["x (mm)", "y (mm)"])
        header, numbers = self.table.horizontalHeader(), self.table.verticalHeader()
        assert header is not None
        assert numbers is not None
        header.setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        row_px = self.table.fontMetrics().height() + 6
        numbers.setDefaultSectionSize(row_px)
        self.table.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.table.setFixedHeight(row_px * (_TABLE_LINES + 1) + 6)
        self.table.cellChanged.connect(self._changed)
        self._more = ui.label(role="faint")
        ui.column(self.table, self._more, owner=self)

    def show_points(self, points: Sequence[PointMm]) -> None:
        if tuple(points) == self._points:
            return
        self._points = tuple(points)
        rows = min(len(points), _MAX_ROWS)
        self.table.blockSignals(True)
        self.table.setRowCount(rows)
        self.table.setVerticalHeaderLabels([str(row) for row in range(rows)])
        for row in range(rows):
            for place in (0, 1):
                self.table.setItem(row, place, QTableWidgetItem(f"{points[row][place]:.10g}"))
        self.table.blockSignals(False)
        self._more.setText(f"and {len(points) - rows} more")
        self._more.setVisible(len(points) > rows)

    def _changed(self, row: int, column: int) -> None:
        item = self.table.item(row, column)
        assert item is not None
        at, number = list(self._points[row]), typed_number(item.text())
        at[column] = math.nan if number is None else number
        points = (*self._points[:row], (at[0], at[1]), *self._points[row + 1 :])
        if math.isfinite(at[column]):
            self.edited.emit(points)
        else:
            points, self._points = self._points, ()
            self.show_points(points)


def _path_ids(file: Path) -> tuple[str, ...]:
    from wavefocus.rendering.scene.svg import svg_path_ids

    return svg_path_ids(file)


def _kind_row(title: str, field: ChoiceField) -> QFormLayout:
    row = QFormLayout()
    row.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
    label = ui.label(text=title, role="strong")
    label.setBuddy(field)
    row.addRow(label, field)
    return row
