"""Drives of sources whose positions arrive while they sound, block by block.

A position becomes that of the source `look_ahead_samples` later. With at least `sufficient_samples` and the time
between positions nothing is predicted, and the drives are those of the recorded scene.
"""

import math
from dataclasses import dataclass

import numpy as np

from wavefocus.config.messages.live import SoundingSource
from wavefocus.config.scene import Regularisation
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.live.blocks import CrossfadedBlocks
from wavefocus.rendering.live.finer import finer_rows
from wavefocus.rendering.live.lives import Emitted, Life, Timing, default_signal, emitted_by, trajectory
from wavefocus.rendering.live.surface import PlayableSurface
from wavefocus.rendering.scene.signals import Signal
from wavefocus.rendering.scene.trajectory import Trajectory
from wavefocus.storage.errors import InputError

MAX_SOURCES = 32
MAX_NAME = 100
MAX_AMPLITUDE = 1e9


@dataclass(frozen=True, slots=True)
class RecordedLife:
    """Knots of one life of a source that became final: from its appearance to its end, with one signal.

    number: Counts lives from 0; the parts of one life have the same.
    signal, repeat: Begins at the life's first knot.
    knots: Those since the part before; they continue it.
    over: No further part follows.
    """

    number: int
    name: str
    signal: Signal
    repeat: bool
    knots: Trajectory
    over: bool


@dataclass(slots=True)
class _Source:
    """A name, its signal, and its life where it sounds."""

    emitted: Emitted
    amplitude: float = 1.0
    life: Life | None = None
    appeared: int = 0
    """Number of the life with which it appeared."""
    due: int = -1
    """Sample of the last position."""


class LiveEngine:
    """Drives of several sources, block by block; not for several threads.

    bank: Read a row at a time, when a source first comes near; see `preload`.
    block_samples: Drive samples of a block, at the bank's rate, B.
    look_ahead_samples: By how much sources lag their positions, >= 0.
    regularisation, interpolation: As of a scene; sources that are independent are as
        `wavefocus.rendering.live.finer` has them. Of "kernel", "waves" and "auto" the rows between positions are
        made before the first block.
    signal: Of sources that were given none; by default noise of the bank's band, 1 s, repeating.
    record: Whether knots are kept for `take_record`.
    frame_rate_hz: Rate of the blocks that come out; by default the bank's.

    Raises InputError: the bank does not allow the interpolation or regularisation.
    """

    interpolation: str
    """The one in use, "auto" resolved."""
    next_sample: int = 0
    """Scene sample of the first sample of the next block."""

    def __init__(
        self,
        bank: GreenSource,
        *,
        block_samples: int,
        look_ahead_samples: int,
        regularisation: Regularisation | None = None,
        interpolation: str = "nearest",
        signal: Signal | None = None,
        record: bool = False,
        frame_rate_hz: float | None = None,
    ) -> None:
        self.rate_hz, self.actuators, self.block_samples = float(bank.sample_rate_hz), bank.actuators, block_samples
        self._look_ahead = look_ahead_samples
        regularisation = Regularisation() if regularisation is None else regularisation
        self._default = emitted_by(default_signal(bank) if signal is None else signal, self.rate_hz)
        self.interpolation, finer = finer_rows(bank, interpolation, self._default.values)
        self._surface = PlayableSurface(bank, self.interpolation, self._read, finer)
        self._blocks = CrossfadedBlocks(
            BankRows(bank, regularisation),
            block_samples,
            self.rate_hz if frame_rate_hz is None else frame_rate_hz,
            self._surface.nearest_nodes,
            independent=regularisation.independent,
            finer=finer,
        )
        self.sufficient_samples = self._blocks.window_samples
        self._reach = self.sufficient_samples + block_samples
        self.x_mm, self.y_mm = self._surface.x_mm, self._surface.y_mm
        self._timing = Timing(self.rate_hz)
        self._record, self._positions = record, bank.positions
        self._sources: dict[str, _Source] = {}
        self._lives: dict[int, Life] = {}
        self._lives_begun = 0
        self._changed = False  # a course, since the last block

    def preload(self) -> None:
        """Read rows beforehand, as many as fit into memory: about 1 ms each."""
        for row in range(min(self._positions, self._blocks.most_rows)):
            self._surface.try_admit(row)
        self._blocks.load_finer()
        self._surface.holds()

    def move(self, name: str, at_mm: tuple[float, float], amplitude: float | None = None) -> None:
        """Take a position of a source, as it is now; a name that does not sound begins to.

        amplitude: None: as before, 1 at first.

        Raises InputError: the place cannot be rendered from, a number is out of range, or too many sources sound.
        """
        if len(at_mm) != 2 or not all(map(math.isfinite, at_mm)):
            raise InputError(f"at_mm of source {name!r} is {at_mm}; two finite numbers (x, y) in mm are expected")
        if amplitude is not None and not abs(amplitude) <= MAX_AMPLITUDE:
            raise InputError(
                f"amplitude of source {name!r} is {amplitude}; it must be a number from {-MAX_AMPLITUDE:g} to"
                f" {MAX_AMPLITUDE:g}"
            )
        place, due = (float(at_mm[0]), float(at_mm[1])), self.next_sample + self._look_ahead
        sounding = self._active(due)
        if name not in sounding and len(sounding) >= MAX_SOURCES:
            raise InputError(f"source {name!r} is one too many; at most {MAX_SOURCES} may sound at a time")
        former = self._sources[name] if name in sounding else None
        loudness = (1.0 if former is None else former.amplitude) if amplitude is None else float(amplitude)
        life = None if former is None else former.life
        end = -1 if life is None else life.end
        goes_on = life is not None and life.moved(due, place, loudness)
        if not goes_on:
            self._surface.require(place, name)
        source = self._named(name)
        self._sources[name] = self._sources.pop(name)  # the last to be forgotten
        if former is None:
            source.appeared = self._lives_begun
        source.due, source.amplitude = due, loudness
        # Of a source that rests only the end of its course changes, mostly after all that is computed now.
        self._changed |= not (goes_on and life is not None and life.rests and end > self.next_sample + self._reach)
        if goes_on:
            return
        if life is not None:
            life.finish(due)
        source.life = self._begin(name, source, due, place)

    def set_signal(self, name: str, emitted: Emitted) -> None:
        """Give a source another signal; what sounds with the former one fades while the new one appears."""
        known = self._sources.get(name)
        if known and (emitted.signal, emitted.repeat) == (known.emitted.signal, known.emitted.repeat):
            return
        source = self._named(name, emitted)
        source.emitted = emitted
        due, before = self.next_sample + self._look_ahead, source.life
        if before is None:
            return
        self._changed = True
        before.settle(due)
        if not before.ended:
            (place_mm,), _ = before.course.at(np.array([due]))
            before.finish(due)
            source.life = self._begin(name, source, due, (float(place_mm[0]), float(place_mm[1])), before)

    def end_source(self, name: str) -> None:
        """Let a source fade and vanish. Raises InputError: none of that name sounds."""
        due = self.next_sample + self._look_ahead
        if name not in self._active(due):
            raise InputError(f"no source {name[:MAX_NAME]!r} sounds; allowed are the names that do")
        source = self._sources[name]
        source.due, self._changed = -1, True
        if source.life is not None:
            source.life.finish(due)

    def state(self) -> tuple[SoundingSource, ...]:
        """Sources that sound now, in the order of their appearance."""
        due, now = self.next_sample + self._look_ahead, np.array([self.next_sample])
        states = []
        for name, source in sorted(self._sources.items(), key=lambda item: item[1].appeared):
            life = source.life
            if life is not None and life.end >= self.next_sample:
                (place_mm,), (amplitude,) = life.course.at(now)
                fading = life.ended or due > source.due + self._timing.hold
                at_mm = (float(place_mm[0]), float(place_mm[1]))
                states.append(SoundingSource(name, at_mm, float(amplitude), fading))
        return tuple(states)

    @property
    def foreseen(self) -> bool:
        """Whether the next block was computed with the last one, and no course has changed since."""
        return not self._changed and self._blocks.foreseen(self.next_sample)

    @property
    def energy_bounded(self) -> bool:
        """Whether independent sources are so near to one another that their energy is bounded: they are less quiet."""
        return self._blocks.bounded

    def late_sources(self) -> list[str]:
        """Names of sources that fade since no position came in time."""
        latest = self.next_sample + self._look_ahead - self._timing.hold
        return [name for name, source in self._sources.items() if source.life is not None and 0 <= source.due < latest]

    def take_record(self) -> tuple[RecordedLife, ...]:
        """Knots that became final since the last call, life by life; they are given once."""
        due, parts = self.next_sample + self._look_ahead, []
        for number, life in self._lives.items():
            before = life.taken
            knots = life.take(due)
            if knots and not before:
                parts.append(
                    RecordedLife(
                        number, life.name, life.emitted.signal, life.emitted.repeat, trajectory(knots), over=life.ended
                    )
                )
        return tuple(parts)

    def next_block(self) -> Float64Array:
        """Compute the next block of drives, float64 (actuators, frames), in volts.

        Raises InputError: the drives do not fit into float32.
        """
        due = self.next_sample + self._look_ahead
        for life in self._lives.values():
            life.settle(due)
        if self.foreseen:
            block = self._blocks.unchanged(self.next_sample)
        else:
            block = self._blocks.next(self._lives.values(), self.next_sample, due)
        self._changed = False
        if not np.isfinite(block).all():
            raise InputError(
                f"the drive from sample {self.next_sample} on does not fit into float32; lower the amplitude or check"
                " the bank"
            )
        self.next_sample += self.block_samples
        self._forget()
        return block

    def _read(self, row: int) -> None:
        self._blocks.load(row)

    def _begin(
        self, name: str, source: _Source, due: int, at_mm: tuple[float, float], before: Life | None = None
    ) -> Life:
        life = Life(
            name, source.emitted, self._surface, self._timing, begin=due, at_mm=at_mm, amplitude=source.amplitude,
            before=before,
        )  # fmt: skip
        self._lives[self._lives_begun] = life
        self._lives_begun += 1
        return life

    def _forget(self) -> None:
        """Drop knots and lives that no later block needs."""
        due, needed = self.next_sample + self._look_ahead, self.next_sample - self._blocks.memory_samples
        for number, life in list(self._lives.items()):
            if not self._record:
                life.take(due)
            life.forget(needed)
            if life.taken and life.end < needed:
                del self._lives[number]
                source = self._sources.get(life.name)
                if source is not None and source.life is life:
                    source.life = None

    def _active(self, due: int) -> list[str]:
        """Names of sources that sound: those with a position not too late."""
        return [
            name for name, source in self._sources.items() if source.due >= 0 and due <= source.due + self._timing.hold
        ]

    def _named(self, name: str, emitted: Emitted | None = None) -> _Source:
        """The source of a name, a new one with the default signal, or the given one."""
        if name in self._sources:
            return self._sources[name]
        if not 0 < len(name) <= MAX_NAME:
            raise InputError(f"a source's name has {len(name)} characters; allowed are 1 to {MAX_NAME}")
        source = _Source(self._default if emitted is None else emitted)
        active = self._active(self.next_sample + self._look_ahead)
        # Names whose signals are kept; of more, those that were silent longest are forgotten.
        while len(self._sources) >= 64:
            del self._sources[next(name for name in self._sources if name not in active)]
        self._sources[name] = source
        return source
