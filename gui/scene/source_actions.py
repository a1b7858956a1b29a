"""What can be done with sources: add, copy, paste, duplicate, delete, reorder; and drawings and sounds that come in."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from PyQt5.QtCore import QObject, pyqtSignal
from PyQt5.QtWidgets import QApplication, QWidget

from gui.scene.document import SceneDocument
from gui.scene.draft import FileDraft, PathDraft, SourceDraft, SvgDraft
from gui.scene.live import Live
from gui.scene.source_form import moving
from gui.scene.surface.handles import box_of, shifted
from gui.scene.toml_text import source_toml
from gui.shell.file_choice import choose_file
from gui.shell.tab import TabContext
from storage.errors import WavefocusError

# A drawing that is larger than the surface, or too small to be felt, is brought to this share of its width.
_SHARE = 0.6
_SMALLEST_MM = 10.0
_SCALE_FIGURES = 3
_ASIDE_MM = (5.0, -5.0)
_LOOKED_AT = 1000


class SourceActions(QObject):
    """Acts on the document's sources.

    Parameters
    ----------
    context : TabContext
        Messages, memory and background work.
    document : SceneDocument
        What is edited.
    live : Live
        Knows the surface.
    owner : QWidget
        Dialogs stand over it.
    """

    added = pyqtSignal(object)

    def __init__(self, context: TabContext, document: SceneDocument, live: Live, owner: QWidget) -> None:
        super().__init__(owner)
        self._context, self._document, self._live, self._owner = context, document, live, owner

    def add(self, path: PathDraft) -> None:
        """Add a source on a path; all else is as the chosen source, or the last one, has it."""
        sources = self._document.draft.sources
        model = self._document.source or (sources[-1] if sources else SourceDraft(path, emission="per_point"))
        moves: dict[str, Any] = moving(model, path)
        self._insert(replace(model, path=path, start_s=0.0, **moves), f"draw a {path.kind}", len(sources))

    def duplicate(self) -> None:
        """Add a copy of the chosen source, a little aside."""
        source = self._document.source
        if source is not None:
            copy = replace(source, path=shifted(source.path, _ASIDE_MM))
            self._insert(copy, "duplicate", self._document.chosen + 1)

    def delete(self) -> None:
        """Delete the chosen source."""
        chosen, sources = self._document.chosen, self._document.draft.sources
        if self._document.source is not None:
            left = (*sources[:chosen], *sources[chosen + 1 :])
            draft = self._document.draft.with_sources(left)
            self._document.edit("delete a source", draft, chosen=min(chosen, len(left) - 1))

    def move(self, by: int) -> None:
        """Put the chosen source further up or down."""
        chosen, sources = self._document.chosen, list(self._document.draft.sources)
        to = chosen + by
        if self._document.source is not None and 0 <= to < len(sources):
            sources.insert(to, sources.pop(chosen))
            self._document.edit("reorder", self._document.draft.with_sources(tuple(sources)), chosen=to)

    def copy(self) -> None:
        """Put the chosen source on the clipboard, as a scene file has it."""
        source, clipboard = self._document.source, QApplication.clipboard()
        if source is not None and clipboard is not None:
            clipboard.setText(source_toml(source))

    def paste(self) -> None:
        """Add the sources that the clipboard's text holds, whoever wrote it."""
        clipboard = QApplication.clipboard()
        text = "" if clipboard is None else clipboard.text()
        if "[[source]]" not in text:
            self._context.messages.warn(
                "nothing is pasted: the clipboard holds no text with a [[source]] of a scene file"
            )
            return
        try:
            pasted = self._document.sources_of(text)
        except WavefocusError as failure:
            self._context.messages.fault(f"nothing is pasted: {str(failure).removeprefix(f'{self._document.place}: ')}")
            return
        sources = self._document.draft.sources
        draft = self._document.draft.with_sources((*sources, *pasted))
        self._document.edit("paste", draft, chosen=len(draft.sources) - 1)

    def choose_drawing(self, _checked: bool = False) -> None:
        """Let somebody choose an SVG file to add; nothing is held up meanwhile."""
        folder = self._context.settings.folder(".svg")
        choose_file(self._owner, "Add a drawing", folder, "drawing", [".svg"], self.add_drawing)

    def add_drawing(self, file: Path) -> None:
        """Add the first path of an SVG file, in the middle of the surface and of a size that fits."""
        self._context.settings.keep("folder/.svg", str(file.parent))
        outline_mm = self._live.ground.outline_mm
        (left, bottom), (right, top) = box_of(outline_mm.tolist())
        size_mm = right - left, top - bottom
        middle = (left + right) / 2, (bottom + top) / 2
        self._context.background.ask(
            "fit", partial(_fitted, file, size_mm, middle), self.add, self._context.report_failure
        )  # fmt: skip

    def use_sound(self, file: Path) -> None:
        """Let the chosen source emit a sound file."""
        source = self._document.source
        if source is None:
            self._context.messages.warn(f"{file}: no source is chosen that could emit it; draw or choose one first")
            return
        self._document.edit_source("use a sound", replace(source, signal=FileDraft(str(file))))

    def _insert(self, source: SourceDraft, words: str, at: int) -> None:
        sources = self._document.draft.sources
        draft = self._document.draft.with_sources((*sources[:at], source, *sources[at:]))
        self._document.edit(words, draft, chosen=at)
        self.added.emit(source)


def _fitted(file: Path, size_mm: tuple[float, float], middle_mm: tuple[float, float]) -> SvgDraft:
    """A drawing on the surface: in its own scale where that can be."""
    import numpy as np

    from rendering.scene.svg import SvgPath

    drawing = SvgPath(file)
    points = drawing.point_at(np.linspace(0.0, drawing.length_mm, _LOOKED_AT))
    (left, bottom), (right, top) = box_of(points.tolist())
    width, height = right - left, top - bottom
    largest = min(size_mm[0] / max(width, 1e-9), size_mm[1] / max(height, 1e-9))
    scale = 1.0
    if largest < 1.0 or max(width, height) < _SMALLEST_MM:
        scale = float(f"{_SHARE * largest:.{_SCALE_FIGURES}g}")
    x, y = (round(at - scale * (low + high) / 2, 2) for at, low, high in zip(middle_mm, (left, bottom), (right, top),
                                                                             strict=True))  # fmt: skip
    return SvgDraft(str(file), "", scale, (x + 0.0, y + 0.0))
