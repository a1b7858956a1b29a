"""What a source emits, over time."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from numpy.typing import NDArray

from gui.shell.theme import Theme
from gui.surface.plot import Plot

_LINES = 7
_FEW = 32


class SignalPlot(Plot):
    """The chosen source's signal, amplitude included."""

    def __init__(self) -> None:
        super().__init__("Signal of the chosen source", "time (ms)", "amplitude")
        self.setFixedHeight(_LINES * self.fontMetrics().lineSpacing())
        self._shown: tuple[NDArray[np.float64] | str, float] = ("", 1.0)

    def show_signal(self, samples: NDArray[np.float64] | str, sample_rate_hz: float) -> None:
        """Show samples, or say why there are none."""
        if samples is self._shown[0] and sample_rate_hz == self._shown[1]:
            return
        self._shown = samples, sample_rate_hz
        plot = self.getPlotItem()
        plot.clear()
        if isinstance(samples, str):
            plot.setTitle(samples[:1].upper() + samples[1:], color=self.theme.faint, size="8pt")
            return
        plot.setTitle(None)
        time_ms, colour = np.arange(len(samples)) / sample_rate_hz * 1e3, self.theme.traces[0]
        if len(samples) <= _FEW:  # each by itself: an impulse is one sample, and nothing before and after it
            time_ms, samples = np.repeat(time_ms, 2), np.stack([np.zeros(len(samples)), samples], axis=1).ravel()
            plot.plot(time_ms, samples, pen=pyqtgraph.mkPen(colour, width=1.5), connect="pairs")
            plot.plot(
                time_ms[1::2], samples[1::2], pen=None, symbol="o", symbolSize=6, symbolBrush=colour, symbolPen=None
            )
        else:
            self.line(time_ms, samples, colour)
        plot.getViewBox().autoRange()

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        super().apply_theme(theme)
        samples, rate_hz = self._shown
        self._shown = "", 0.0
        self.show_signal(samples, rate_hz)
