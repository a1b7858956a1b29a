"""Before a calibration: which parts, which marks, how good the map must be."""

from __future__ import annotations

import tempfile
from pathlib import Path

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import (
    QCheckBox,
    QComboBox,
    QDoubleSpinBox,
    QFormLayout,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from acquisition.calibration_procedures.marks import default_marks_mm
from gui.shell.file_choice import PathField
from gui.shell.settings import Settings

_PARTS = (
    ("inputs", "&Inputs: how much later the response is sampled", "You plug the loopback into both inputs"),
    ("outputs", "&Outputs: latency, volts, polarity", "You plug the response input into each output in turn"),
    ("mirror", "&Mirror: the beam is brought onto marks", "You jog the beam onto marks on the surface"),
    ("actuators", "Actuato&rs: polarity and level", "Nothing to do; the mirror's map must be known"),
)
_SEVEN, _CORNERS, _FILE = range(3)
_USUAL_LIMIT_MM = 1.0


class CalibrationStart(QWidget):
    """Asks what to calibrate; `started` carries the command's options."""

    started = pyqtSignal(list)

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.size_mm = (250.0, 150.0)
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.parts: dict[str, QCheckBox] = {}
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        title = QLabel("Measure what the rig file can only believe")
        title.setProperty("role", "strong")
        column.addWidget(title)
        for part, words, tip in _PARTS:
            box = QCheckBox(words)
            box.setAccessibleName(words.replace("&", ""))
            box.setToolTip(tip)
            box.setChecked(part == "mirror")
            box.toggled.connect(self._show_possible)
            column.addWidget(box)
            self.parts[part] = box
        self.marks = QComboBox()
        self.marks.addItems(["seven places: middle, corners, ends", "five places: corners, middle", "a file of marks"])
        self.marks.setAccessibleName("Marks on the surface")
        self.marks.setToolTip("Where the beam is brought to; four marks decide the map, each more checks it")
        self.file = PathField("&File", ".csv", "file of marks", settings)
        self.file.setToolTip("x_mm,y_mm of each mark; with x_mrad,y_mrad nothing is jogged")
        self.limit_mm = QDoubleSpinBox()
        self.limit_mm.setRange(0.01, 100.0)
        self.limit_mm.setValue(_USUAL_LIMIT_MM)
        self.limit_mm.setSuffix(" mm")
        self.limit_mm.setAccessibleName("Largest residual in mm")
        self.limit_mm.setToolTip("A map that misses a mark by more, in mm on the surface, is refused")
        self.use = QCheckBox("&Name the new file in the rig file")
        self.use.setAccessibleName("Name the new file in the rig file")
        self.use.setChecked(True)
        self.use.setToolTip("Its values win over the rig file's; a bank that was measured keeps its own calibration")
        self.start = QPushButton("&Start the calibration")
        self.start.setAccessibleName("Start the calibration")
        self.start.setToolTip(
            "Open the instruments and measure what is ticked; you are asked what to plug and where to jog"
        )
        form = QFormLayout()
        form.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.FieldsStayAtSizeHint)
        form.addRow("Marks", self.marks)
        form.addRow("Largest residual", self.limit_mm)
        row = QHBoxLayout()
        row.addWidget(self.start)
        row.addStretch(1)
        column.addLayout(form)
        column.addWidget(self.file)
        column.addWidget(self.use)
        column.addLayout(row)
        self.marks.currentIndexChanged.connect(self._show_possible)
        self.start.clicked.connect(self._start)
        self._show_possible()

    def choose(self, part: str) -> None:
        """Choose one part alone; none named, all of them."""
        for name, box in self.parts.items():
            box.setChecked(part in ("", name))

    def close_down(self) -> None:
        """Remove what was written for the command."""
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _show_possible(self) -> None:
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
        """The command reads marks from a file."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="wavefocus-marks-")
        path = Path(self._folder.name) / "corners.csv"
        middle, *corners = default_marks_mm(*self.size_mm)[:5]
        path.write_text("x_mm,y_mm\n" + "".join(f"{x:g},{y:g}\n" for x, y in (*corners, middle)), encoding="utf-8")
        return path
