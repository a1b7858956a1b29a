"""A calibration of a rig: the request, its parts one by one, and the record of both."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from datetime import datetime
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.calibrate_channels import (
    REMEDIES,
    Probe,
    listening_places,
    measure_actuators,
    measure_inputs,
    measure_outputs,
)
from wavefocus.acquisition.calibrate_mirror import (
    VIBROMETER,
    NotMeasuredError,
    Operator,
    Place,
    measure_mirror,
    output,
    read_fiducials,
    suspect_mark,
)
from wavefocus.acquisition.leak import crosstalk_finding, measure_leak
from wavefocus.acquisition.setup import Setup, identities_of, names_of
from wavefocus.calibration.mirror_map import MIN_MARKS, MirrorMap, fit_mirror_map
from wavefocus.config.calibration import (
    FORMAT,
    FORMAT_VERSION,
    ActuatorMeasured,
    ActuatorsMeasured,
    CalibrationRecord,
    Fiducial,
    InputsMeasured,
    MirrorMeasured,
    OutputMeasured,
    OutputsMeasured,
)
from wavefocus.config.fields import Table
from wavefocus.config.outline import default_marks_mm
from wavefocus.config.rig import RigConfig
from wavefocus.console import progress
from wavefocus.drivers.timeouts import Role
from wavefocus.options import CALIBRATION_PARTS, CalibrationOptions
from wavefocus.rig.operation import MIN_LEVEL_V, SAMPLE_RATE_HZ, largest_level_v
from wavefocus.storage.errors import InputError


def amplitude_v(rig: RigConfig, request: CalibrationOptions) -> float:
    """Peak of what is played: asked for within the limits, or well below them.

    Raises InputError: more than the rig may put out, or next to nothing.
    """
    largest_v, rms = largest_level_v(rig), rig.player.rms_limit
    if request.amplitude_v is None:
        return min(rig.safe_amplitude_v, largest_v)
    if not MIN_LEVEL_V <= request.amplitude_v <= largest_v * (1 + 1e-5):  # it is named to six digits
        raise InputError(
            f"--amplitude-v {request.amplitude_v:g}: must be above 0 and at most {largest_v:g} (the rig's "
            f"player.limit_v{f', {rms[0]}' if rms else ''}, or the full scale of its weakest output), and "
            f"{MIN_LEVEL_V:g} V or more"
        )
    return min(request.amplitude_v, largest_v)


def marks(rig: RigConfig, request: CalibrationOptions) -> tuple[tuple[Place, ...], tuple[Place, ...] | None]:
    """Places of the marks in millimetres, and their angles in milliradians where they are given.

    Raises InputError: A file that cannot be understood, or marks that no map can be fitted through.
    """
    angles: tuple[Place, ...] | None = None
    if request.fiducials is None:
        places = default_marks_mm(rig.surface.length_mm, rig.surface.width_mm)
        if not rig.surface.outline.contains(places).all():
            raise InputError("the usual marks do not fit on this polygon; name your own with --fiducials marks.csv")
    else:
        places, angles = read_fiducials(request.fiducials)
    if "mirror" in request.parts:
        # Refused now rather than after the last mark: the first guess replaces angles not measured yet.
        if angles is None:
            guessed = np.column_stack(MirrorMap(rig.mirror.matrix).angles_mrad(*np.array(places).T)).tolist()
        else:
            guessed = list(angles)
        fit_mirror_map(places, guessed)
        if len(places) == MIN_MARKS:
            raise InputError(
                f"{request.fiducials}: {MIN_MARKS} marks decide the map alone, so that nothing shows a mark that is "
                f"wrong; at least {MIN_MARKS + 1} are needed"
            )
    return places, angles


def listening(rig: RigConfig, request: CalibrationOptions) -> tuple[float, NDArray[np.float64]]:
    """How far from each actuator it is listened to, and where.

    Raises InputError: A place off the surface.
    """
    distance_mm = 0.2 * rig.surface.width_mm
    places = listening_places(rig.actuator_mm, distance_mm)
    there = rig.surface.outline.contains(places)
    if "actuators" in request.parts and not there.all():
        raise InputError(
            f"actuators: {distance_mm:g} mm from actuator {there.argmin()} is off the surface; leave them out by --only"
        )
    return distance_mm, places


class CalibrationSession:
    """Carries out a calibration: `measured` are the parts measured, `problems` what is not good enough and what to do.

    Raises InputError: a request that the rig cannot fulfil.
    """

    def __init__(self, rig: RigConfig, request: CalibrationOptions) -> None:
        self._rig, self._request = rig, request
        self._amplitude_v = amplitude_v(rig, request)
        self._marks, self._angles = marks(rig, request)
        self._distance_mm, self._places = listening(rig, request)
        before = rig.calibration.measured
        self._found: dict[str, Table] = {}
        if before is not None:
            kept = {name: getattr(before, name) for name in CALIBRATION_PARTS}
            self._found = {name: part for name, part in kept.items() if part is not None}
        self._names: dict[str, str] = {}
        self.measured: list[str] = []
        self.problems: list[str] = []

    def carry_out(self, setup: Setup, operator: Operator, plug: Callable[[str], object] | None = None) -> None:
        """Measure every part asked for; one that cannot be measured does not keep the others from it.

        plug: Plugs the response input of a virtual rig, see `Openers`.

        Raises InputError: angles that no map can be fitted through, or an operator who is gone. Raises InstrumentError:
        of the instrument that failed for good.
        """
        self._names = names_of(setup)
        self._identities = identities_of(setup)
        operator.plug = plug
        try:
            for part in CALIBRATION_PARTS:
                if part not in self._request.parts:
                    continue
                try:
                    if part == "actuators" or (part == "mirror" and operator.source != VIBROMETER):
                        self._need_vibrometer(setup, operator)
                    setup = getattr(self, f"_{part}")(setup, operator)
                except NotMeasuredError as failure:
                    self.problems.append(f"{part}: {failure}")
            if operator.source != VIBROMETER:
                try:
                    self._need_vibrometer(setup, operator)
                except NotMeasuredError as failure:
                    self.problems.append(str(failure))
        finally:
            if operator.source != VIBROMETER:
                operator.report("the response input is not on the vibrometer: plug it back before anything is measured")

    def record(self) -> CalibrationRecord:
        """All that is known: what was measured now, and what the rig's calibration held of the rest."""
        about = {"format": FORMAT, "format_version": FORMAT_VERSION, "made": _now(), "rig": self._rig.rig.name}
        software = f"wavefocus {version('wavefocus')}"
        return CalibrationRecord.model_validate({**about, "software": software, **self._found})

    # -- the parts: each measures with the setup so far, and returns it with its results ---------

    def _inputs(self, setup: Setup, operator: Operator) -> Setup:
        found = measure_inputs(self._probe(setup), operator)
        delay_s = _rounded(found.late_s)
        operator.report(
            f"inputs: the response is sampled {1e6 * delay_s:.3f} us after the reference, spread "
            f"{1e9 * found.spread_s:.0f} ns; clocks {found.clock_ppm:+.1f} ppm apart"
        )
        self._take_up("inputs", InputsMeasured(**self._by("recorder"), inter_channel_delay_s=delay_s))
        return replace(setup, inter_channel_delay_s=delay_s)

    def _outputs(self, setup: Setup, operator: Operator) -> Setup:
        player, request = self._rig.player, self._request
        # Cable by cable the person sees how far it is, and a bar would write over what is typed.
        box_gain = request.summing_box
        with nullcontext(_silent) if box_gain is None else progress("outputs", len(player.channels)) as report:
            found = measure_outputs(self._probe(setup), player.output_full_scale_v, operator, report, box_gain)
        given_up = sorted(set(player.channels) - {one.channel for one in found})
        if given_up:
            named = f"output{'s' * (len(given_up) > 1)} {', '.join(map(str, given_up))}"
            self.problems.append(f"outputs: {named} no signal: check the cables, then --only outputs")
        for one in found:
            # Latencies that scatter by more are reported: one record gives them a thousand times better.
            if one.spread_s > 1e-6:
                self.problems.append(
                    f"outputs: the latency of output {one.channel} scatters by {1e6 * one.spread_s:.1f} us: check "
                    "the interface's clock and its buffer"
                )
            if one.polarity < 0:
                self.problems.append(f"outputs: output {one.channel} is reversed: swap its two wires")
        if not found:
            raise NotMeasuredError("no signal from any output: is the response input plugged into the player?")
        loudest = max(abs(one.latency_s) for one in found)
        operator.report(f"outputs: {len(found)} measured, latencies within {1e6 * loudest:.2f} us of the loopback's")
        channel = tuple(
            OutputMeasured(
                channel=one.channel, latency_s=_rounded(one.latency_s), polarity=one.polarity,
                full_scale_v=None if one.full_scale_v is None else round(one.full_scale_v, 6),
            )
            for one in found
        )  # fmt: skip
        loopback = player.loopback_channel
        self._take_up("outputs", OutputsMeasured(**self._by("player"), loopback_channel=loopback, channel=channel))
        return setup

    def _mirror(self, setup: Setup, operator: Operator) -> Setup:
        if self._angles is None:
            limits = self._rig.mirror.limit_mrad, operator, self._request.limit_mm
            found = measure_mirror(setup, self._marks, *limits)
        else:
            found = fit_mirror_map(self._marks, self._angles)
        operator.report(f"mirror: residual {found.rms_mm:.3f} mm rms, worst {found.worst_mm:.3f} mm")
        if found.worst_mm > self._request.limit_mm:
            raise NotMeasuredError(
                f"the map misses a mark by {found.worst_mm:.2f} mm, more than --limit-mm {self._request.limit_mm:g}: "
                f"most likely mark {suspect_mark(found) + 1} is wrong; check its place and jog the beam onto it again"
            )
        each = zip(self._marks, found.angles_mrad.round(6).tolist(), found.residual_mm.round(6).tolist(), strict=True)
        fiducial = tuple(Fiducial(place_mm=place, angles_mrad=angles, residual_mm=off) for place, angles, off in each)
        matrix, rms_mm = found.mirror_map.matrix, round(found.rms_mm, 6)
        measured = MirrorMeasured(**self._by("mirror"), map=matrix, residual_rms_mm=rms_mm, fiducial=fiducial)
        self._take_up("mirror", measured)
        return replace(setup, mirror_map=MirrorMap(matrix))

    def _actuators(self, setup: Setup, operator: Operator) -> Setup:
        channels = self._rig.player.channels
        leak = crosstalk_finding(measure_leak(setup, self._places[0], self._amplitude_v, SAMPLE_RATE_HZ))
        operator.report(f"crosstalk: {leak.what}")
        if leak.verdict != "ok":
            self.problems.append(f"crosstalk: {leak.what}: {leak.remedy}")
        with progress("actuators", len(channels)) as report:
            found = measure_actuators(self._places, self._amplitude_v, SAMPLE_RATE_HZ, setup, report)
        for actuator, verdict in enumerate(found.verdict):
            if verdict != "good":
                self.problems.append(
                    f"actuators: actuator {actuator} on output {channels[actuator]} is {verdict} "
                    f"({found.level_db[actuator]:+.1f} dB): {REMEDIES[verdict]}"
                )
        good = sum(verdict == "good" for verdict in found.verdict)
        operator.report(f"actuators: {good} of {len(channels)} good, measured at {self._distance_mm:g} mm from each")
        each = tuple(
            ActuatorMeasured(
                actuator=actuator, channel=channel, polarity=found.polarity[actuator],
                level_db=round(float(found.level_db[actuator]), 3), verdict=found.verdict[actuator],
            )
            for actuator, channel in enumerate(channels)
        )  # fmt: skip
        distance_mm = self._distance_mm
        self._take_up("actuators", ActuatorsMeasured(**self._by("player"), distance_mm=distance_mm, actuator=each))
        return setup

    def _need_vibrometer(self, setup: Setup, operator: Operator) -> None:
        """Have the vibrometer plugged in; an output that was plugged there must have no signal there any more."""
        plugged = [one for one in self._rig.player.channels if output(one) == operator.source]
        probe, channel = self._probe(setup), (plugged or self._rig.player.channels)[0]
        while True:
            if operator.source != VIBROMETER:
                operator.connect(VIBROMETER)
            if not probe.detects(channel):
                return
            problem = "the response input still carries an output of the player, not the vibrometer"
            operator.source = ""
            if not operator.again(problem):
                raise NotMeasuredError(problem)

    def _probe(self, setup: Setup) -> Probe:
        return Probe(setup, SAMPLE_RATE_HZ, self._amplitude_v)

    def _by(self, role: Role) -> dict[str, Any]:
        """When and by which device a part was measured."""
        return {"at": _now(), "device": self._names[role], "identity": self._identities[role]}

    def _take_up(self, part: str, figures: Table) -> None:
        self._found[part] = figures
        self.measured.append(part)


def _silent(done: int, total: int, note: str = "") -> None:
    """Progress that nobody needs to see."""


def _now() -> datetime:
    return datetime.now().astimezone().replace(microsecond=0)


def _rounded(seconds: float) -> float:
    """To the picosecond: digits beyond are noise."""
    return round(seconds, 12)
