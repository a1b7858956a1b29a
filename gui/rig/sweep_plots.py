"""Waveform and spectrum of one sweep."""

from __future__ import annotations

import numpy as np
import pyqtgraph

from gui.rig.facts import Sweep
from gui.surface.plot import Plot

_LEGEND_AT = (-8, 6)
_MILLI_BELOW_V = 0.5
_BELOW_DB, _ABOVE_DB = 15.0, 10.0


class WaveformPlot(Plot):
    """Both inputs over time; the reference is drawn as high as the response."""

    def __init__(self) -> None:
        super().__init__("Waveform of the sweep", "time (s)", "response (mV)", legend_at=_LEGEND_AT)

    def show_sweep(self, sweep: Sweep) -> None:
        """Draw it."""
        plot = self.getPlotItem()
        plot.clear()
        milli = sweep.response.peak_v < _MILLI_BELOW_V
        factor, unit = (1e3, "mV") if milli else (1.0, "V")
        plot.setLabel("left", f"response ({unit})")
        time_s = np.arange(len(sweep.response_v)) / sweep.sample_rate_hz
        reference_peak_v = float(np.abs(sweep.reference_v).max(initial=0.0))
        share = sweep.response.peak_v / reference_peak_v if reference_peak_v > 0 else 1.0
        for name, values, colour in (
            (f"reference × {share:.2g}", share * sweep.reference_v, self.theme.grid),
            ("response", sweep.response_v, self.theme.traces[0]),
        ):
            self.line(time_s, factor * values, colour, 1.2, name)
        plot.getViewBox().autoRange()


class SweepSpectrumPlot(Plot):
    """Spectra of the response with the sweep and in silence, with the sweep's band."""

    def __init__(self) -> None:
        super().__init__(
            "Spectrum of the sweep", "frequency (Hz); dashed: the sweep's band", "dB re 1 V/√Hz", legend_at=_LEGEND_AT
        )

    def show_sweep(self, sweep: Sweep) -> None:
        """Draw it."""
        plot = self.getPlotItem()
        plot.clear()
        for name, values, colour, width in (
            ("in silence", sweep.noise_db, self.theme.faint, 1.0),
            ("with the sweep", sweep.response_db, self.theme.traces[0], 1.6),
        ):
            plot.plot(sweep.frequency_hz, values, pen=pyqtgraph.mkPen(colour, width=width), name=name)
        self.mark_band(*sweep.band_hz)
        low_db = float(np.median(sweep.noise_db)) - _BELOW_DB
        plot.setYRange(low_db, float(sweep.response_db.max()) + _ABOVE_DB, padding=0)
        plot.setXRange(0.0, float(sweep.frequency_hz[-1]), padding=0.01)
