"""The patch bay before the recorder: which cable is plugged into its response input."""

from __future__ import annotations

import re
import threading
from collections.abc import Sequence

VIBROMETER, SUM, BOTH = "vibrometer", "sum", "both"


class PatchBay:
    """Plugs one source at a time into the response input; safe to share between threads.

    The words are ``"vibrometer"`` (as for a campaign), ``"output K"`` (output K of the player), ``"sum"`` (all
    outputs that drive actuators, through a summing box of gain 1) and ``"both"`` (the loopback, which the reference
    input gets too).

    Parameters
    ----------
    actuator_outputs : sequence of int
        Outputs of the player that drive actuators.
    loopback_output : int
        The output that is looped back to the reference input.
    """

    def __init__(self, actuator_outputs: Sequence[int], loopback_output: int) -> None:
        self._actuator_outputs = tuple(actuator_outputs)
        self._loopback_output = loopback_output
        self._word = VIBROMETER
        self._lock = threading.Lock()

    @property
    def word(self) -> str:
        """What is plugged in now."""
        with self._lock:
            return self._word

    def connect(self, word: str) -> None:
        """Plug in something else.

        Parameters
        ----------
        word : str
            One of the words above.

        Raises
        ------
        ValueError
            Another word, or an output that is not wired.
        """
        _ = self._outputs_of(word)
        with self._lock:
            self._word = word

    @property
    def outputs(self) -> tuple[int, ...] | None:
        """Outputs whose voltages add up at the response input; None where the vibrometer is plugged in."""
        return self._outputs_of(self.word)

    def _outputs_of(self, word: str) -> tuple[int, ...] | None:
        if word == VIBROMETER:
            return None
        if word == SUM:
            return self._actuator_outputs
        if word == BOTH:
            return (self._loopback_output,)
        output = re.fullmatch(r"output (\d{1,4})", word)
        if output is not None and int(output[1]) in (*self._actuator_outputs, self._loopback_output):
            return (int(output[1]),)
        wired = ", ".join(str(one) for one in sorted((*self._actuator_outputs, self._loopback_output)))
        raise ValueError(f"patch is {word!r}; allowed: vibrometer, sum, both, or output K with K one of {wired}")
