"""Spots on a surface that leave the mouse to what is beneath them."""

from __future__ import annotations

import pyqtgraph


class Spots(pyqtgraph.ScatterPlotItem):
    """Spots that let clicks through; pyqtgraph's own keep every click on a spot to themselves."""

    def mouseClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Leave it to the view."""
        event.ignore()
