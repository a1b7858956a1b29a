"""A virtual rig in Python: a plate and instruments in software that measure a small bank in one call."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavefocus.acquisition.attempt import Attempt, AttemptResult, Recorded
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.engine.station import Station
from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.campaign.blueprint import blueprint_of
from wavefocus.campaign.session_files import opened_campaign, with_bank
from wavefocus.config.loading import validated
from wavefocus.config.messages.campaign import Event, Progress, State
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.configuration import Configuration, configuration_of
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import rim_places
from wavefocus.rig import virtual_bench
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.setup import open_rig
from wavefocus.storage.argument_types import Positions, bank_row, bank_rows, checked, real_array
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import InputError

SOURCE = "virtual_rig"


@checked
def virtual_rig(
    *,
    actuators: int | ArrayLike = 4,
    position_mm: ArrayLike | None = None,
    spacing_mm: float = 20.0,
    taps: int = 1000,
    sample_rate_hz: float = 10_000.0,
    plate: str = "soft",
    seed: int = 1,
    noise_v: float | None = None,
    run: Mapping[str, Mapping[str, Any]] | None = None,
    rig: Mapping[str, Mapping[str, Any]] | None = None,
) -> VirtualBench:
    """A virtual rig, ready to measure: a plate, a scanning laser, a recorder and a player in software.

    Its surface is a stadium of 250 mm x 150 mm. Sweeps are short (0.3 s from 20 to 500 Hz, two of each), so that a
    position takes milliseconds.

    Parameters
    ----------
    actuators
        How many, equally spaced on the rim; or their places in mm, (actuators, 2).
    position_mm
        Places to measure in mm, (positions, 2): x right, y up, the origin at the centre. By default a square grid.
    spacing_mm
        Spacing of that grid in mm, > 0.
    taps
        Length of a Green's function in samples.
    sample_rate_hz
        Rate of the recordings and of the bank in Hz, above 1000.
    plate
        ``"soft"``, ``"stadium"`` (needs scikit-fem), ``"thin"`` or ``"solid"``, as in run.toml.
    seed
        The same seed gives the same bytes.
    noise_v
        Rms noise at the vibrometer's output in V; by default 0.00015.
    run, rig
        Further tables of run.toml and rig.toml, by name, for example ``run={"sweep": {"stop_hz": 800}}``.

    Returns
    -------
    VirtualBench
        It measures a bank by ``measure(path)``, or step by step by ``record(position)`` and ``estimate(recorded)``.

    Raises
    ------
    InputError
        A value is out of range or does not fit another; the message names table and key.

    Examples
    --------
    >>> import wavefocus as wf
    >>> rig = wf.virtual_rig(actuators=4, position_mm=[[x, y] for y in (0, 5, 10) for x in (-5, 0, 5)])
    >>> with rig.measure("new.h5") as bank:
    ...     print(bank.positions, bank.actuators, bank.taps, bank.status)
    9 4 1000 [1 1 1 1 1 1 1 1 1]
    >>> recorded = rig.record(0)
    >>> len(recorded.recordings), recorded.recordings[0].volts.shape
    (4, (2, 9200))
    >>> result = rig.estimate(recorded)
    >>> result.judgement.good, result.estimate.green.shape
    (True, (4, 1000))
    """
    tables: dict[str, dict[str, Any]] = {
        "grid": {"spacing_mm": spacing_mm},
        "sweep": {"duration_s": 0.3},
        "capture": {"averages": 2, "decay_s": taps / sample_rate_hz, "taps": taps, "sample_rate_hz": sample_rate_hz},
        "virtual": {"seed": seed, "plate": plate} | ({} if noise_v is None else {"noise_v": noise_v}),
    }
    for name, table in (run or {}).items():
        tables[name] = {**tables.get(name, {}), **table}
    places = rim_places(actuators) if isinstance(actuators, int) else real_array("actuators", actuators).tolist()
    asked = validated(RunConfig, tables, SOURCE)
    bench = validated(RigConfig, {"actuators": {"position_mm": places}, **(rig or {})}, SOURCE)
    there = None if position_mm is None else _on_surface(position_mm, bench)
    return VirtualBench(configuration_of(asked, bench, there, SOURCE))


class VirtualBench:
    """A virtual rig with what it is to measure; made by `virtual_rig`.

    configuration: Its run and rig, as their files would have them.
    """

    def __init__(self, configuration: Configuration) -> None:
        self.configuration = configuration
        self._blueprint = blueprint_of(configuration)

    @property
    def position_mm(self) -> NDArray[np.float64]:
        """Places to measure in mm, (positions, 2)."""
        return self.configuration.position_mm

    @property
    def actuator_mm(self) -> NDArray[np.float64]:
        """Places of the actuators in mm, (actuators, 2)."""
        return self.configuration.rig.actuator_mm

    @checked
    def measure(
        self,
        bank: str | Path,
        positions: Positions | None = None,
        *,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> Bank:
        """Measure a bank, or go on with the one that is there; returns it, open for reading.

        Parameters
        ----------
        bank
            Path of the bank; it and the log of its events next to it are as those of ``wavefocus capture``.
        positions
            Rows to measure now, or a mask of them, again where they have been; by default all not measured yet.
        on_progress
            Called with the positions done and the positions in all.

        Raises
        ------
        InputError
            The bank is of another rig or run, or cannot be written.
        """
        path = Path(bank)
        rows = None if positions is None else bank_rows(positions, len(self.position_mm)).tolist()
        blueprint, earlier = with_bank(self._blueprint, path, Path(SOURCE))

        def show(event: Event) -> None:
            if on_progress is not None and isinstance(event, Progress):
                on_progress(event.done, event.total)

        with (
            BankWriter.open(path, plan_sha256=blueprint.plan.sha256) as writer,
            opened_campaign(blueprint, self._setup, writer, StopRequest(), {"on_progress": show}, earlier) as (
                campaign,
                _,
            ),
        ):
            if campaign.run(rows).state is State.STOPPED:
                raise KeyboardInterrupt
        return open_bank(path)

    def record(self, position: int) -> Recorded:
        """Point the laser at a position and record it.

        ``recordings`` of the result has a record per actuator, in staggered capture per group of them, and at check
        positions four times as many; its ``volts`` are float32 (2, samples), reference and response.

        Raises InputError: there is no such position.
        """
        attempt = Attempt(bank_row(position, len(self.position_mm)), 1, 1)
        return Recorded(attempt, self._station.take(attempt, "capture"))

    @checked
    def estimate(self, recorded: Recorded) -> AttemptResult:
        """Estimate and judge what `record` has recorded.

        ``estimate.green`` of the result is float32 (actuators, taps), in m/s per V; ``judgement`` says whether it is
        good, and why not.
        """
        with one_blas_thread():
            return self._station.evaluate(recorded)

    def truth(self, position: int) -> NDArray[np.float64]:
        """The plate's true Green's functions at a position, float64 (actuators, taps), in m/s per V.

        They hold all frequencies, and a measurement those of its sweep: compare within the band.
        """
        capture = self.configuration.run.capture
        x_mm, y_mm = self.position_mm[bank_row(position, len(self.position_mm))].tolist()
        return self._plate.truth(x_mm, y_mm, capture.taps, capture.sample_rate_hz)

    @cached_property
    def _setup(self) -> Setup:
        return open_rig(openers_of(self.configuration.rig, self.configuration.run.virtual))

    @cached_property
    def _station(self) -> Station:
        session = Session(self._setup.clock, lambda event: None, StopRequest())
        return Station(self._blueprint.plan, self._setup, session)

    @cached_property
    def _plate(self) -> VirtualRig:
        return virtual_bench.virtual_rig(self.configuration.rig, self.configuration.run.virtual)


def _on_surface(position_mm: ArrayLike, rig: RigConfig) -> NDArray[np.float64]:
    """Positions as an array; raises InputError where they are not pairs, not on the surface, or repeat each other."""
    places = real_array("position_mm", position_mm) + 0.0
    if places.ndim != 2 or places.shape[1] != 2 or not len(places):
        raise InputError(f"{SOURCE}: position_mm has shape {places.shape}; (positions, 2) is needed")
    outside = np.flatnonzero(~(np.isfinite(places).all(axis=1) & rig.surface.outline.contains(places)))
    if len(outside):
        row = int(outside[0])
        raise InputError(f"{SOURCE}: position_mm[{row}] = {places[row].tolist()} is not on the surface")
    if len(np.unique(places, axis=0)) < len(places):
        raise InputError(f"{SOURCE}: position_mm holds a position twice")
    return places
