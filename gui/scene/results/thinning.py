"""Curves of many samples that are drawn quickly at any zoom."""

from __future__ import annotations

import pyqtgraph


def thinning_curve() -> pyqtgraph.PlotDataItem:
    """A curve that draws smallest and largest value of each column of what is seen.

    To be kept in its plot and filled anew: taken out, it asks a view that it has no longer.
    """
    return pyqtgraph.PlotDataItem(autoDownsample=True, downsampleMethod="peak", clipToView=True, skipFiniteCheck=True)
