"""Rooms that are divided by a line that can be dragged; no part vanishes by that."""

from __future__ import annotations

from collections.abc import Sequence

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QSplitter, QWidget

# A part, and its width or height in pixels.
Part = tuple[QWidget, int]


def side_by_side(*parts: Part, growing: Sequence[int] = ()) -> QSplitter:
    """Parts from left to right; `growing` are the numbers of those that take more room when there is more."""
    return _divided(Qt.Orientation.Horizontal, parts, growing)


def stacked(*parts: Part, growing: Sequence[int] = ()) -> QSplitter:
    """Parts from top to bottom; `growing` as of `side_by_side`."""
    return _divided(Qt.Orientation.Vertical, parts, growing)


def _divided(orientation: Qt.Orientation, parts: Sequence[Part], growing: Sequence[int]) -> QSplitter:
    splitter = QSplitter(orientation)
    splitter.setChildrenCollapsible(False)
    for part, _ in parts:
        splitter.addWidget(part)
    splitter.setSizes([size for _, size in parts])
    for number in growing:
        splitter.setStretchFactor(number, 1)
    return splitter
