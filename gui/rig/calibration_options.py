"""Form of a calibration: parts to measure, marks, largest residual."""

from __future__ import annotations

import tempfile
from pathlib import Path

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QCheckBox, QComboBox, QFormLayout, QLabel, QPushButton, QVBoxLayout, QWidget

from config.outline import default_marks_mm
from gui.shell.files import PathField, Settings
from gui.shell.widgets import named, number_box

_PARTS = (
    ("inputs", "&Inputs: delay between response and reference", "You connect the loopback to both inputs"),
    ("outputs", "&Outputs: latency, volts, polarity", "You connect the response input to each output in turn"),
    ("mirror", "&Mirror: bring the beam onto marks", "You jog the beam onto marks on the surface"),
    ("actuators", "Actuato&rs: polarity and level", "Nothing to do; the mirror map must be measured before"),
)
_CORNERS, _FILE = 1, 2
_DEFAULT_LIMIT_MM = 1.0


class CalibrationOptions(QWidget):
    """Options of a calibration; `started` carries the command's options."""

    started = pyqtSignal(list)

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.size_mm = (250.0, 150.0)
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.parts: dict[str, QCheckBox] = {}
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        title = QLabel("Measure the rig's own values")
        title.setProperty("role", "strong")
        column.addWidget(title)
        for part, text, tip in _PARTS:
            box = named(QCheckBox(text), tip)
            box.setChecked(part == "mirror")
            box.toggled.connect(self._enable)
            column.addWidget(box)
            self.parts[part] = box
        tip = "Places of the beam; four marks determine the map, each more checks it"
        self.marks = named(QComboBox(), tip, "Marks on the surface")
        self.marks.addItems(["seven places: middle, corners, ends", "five places: corners, middle", "from a file"])
        self.file = PathField("&File", ".csv", "file of marks", settings)
        self.file.setToolTip("x_mm,y_mm of each mark; with x_mrad,y_mrad nothing is jogged")
        self.limit_mm = number_box(
            "Largest residual in mm", "A map that misses a mark by more, in mm on the surface, is refused",
            " mm", 2, 0.01, 100.0,
        )  # fmt: skip
        self.limit_mm.setValue(_DEFAULT_LIMIT_MM)
        self.use = named(
            QCheckBox("&Name the new file in the rig file"),
            "Its values override the rig file's; a measured bank keeps its own calibration",
        )
        self.use.setChecked(True)
        self.start = named(
            QPushButton("&Start the calibration"), "Open the instruments and measure; you are asked what to connect"
        )
        form = QFormLayout()
        form.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.FieldsStayAtSizeHint)
        form.addRow("Marks", self.marks)
        form.addRow("Largest residual", self.limit_mm)
        form.addRow(self.file)
        form.addRow(self.use)
        form.addRow(self.start)
        column.addLayout(form)
        self.marks.currentIndexChanged.connect(self._enable)
        self.start.clicked.connect(self._start)
        self._enable()

    def choose(self, part: str) -> None:
        """Tick one part alone, or all if the name is empty."""
        for name, box in self.parts.items():
            box.setChecked(part in ("", name))

    def shut_down(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _enable(self) -> None:
        mirror = self.parts["mirror"].isChecked()
        self.marks.setEnabled(mirror)
        self.limit_mm.setEnabled(mirror)
        self.file.setVisible(mirror and self.marks.currentIndex() == _FILE)
        self.start.setEnabled(any(box.isChecked() for box in self.parts.values()))

    def _start(self) -> None:
        options = ["--only", ",".join(name for name, box in self.parts.items() if box.isChecked())]
        if self.parts["mirror"].isChecked():
            options += ["--limit-mm", f"{self.limit_mm.value():g}"]
            if self.marks.currentIndex() == _CORNERS:
                options += ["--fiducials", str(self._corners())]
            elif self.marks.currentIndex() == _FILE:
                options += ["--fiducials", str(self.file.path or "")]
        if self.use.isChecked():
            options.append("--use")
        self.started.emit(options)

    def _corners(self) -> Path:
        """File with the corners and the middle."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="wavefocus-marks-")
        path = Path(self._folder.name) / "corners.csv"
        middle, *corners = default_marks_mm(*self.size_mm)[:5]
        path.write_text("x_mm,y_mm\n" + "".join(f"{x:g},{y:g}\n" for x, y in (*corners, middle)), encoding="utf-8")
        return path
