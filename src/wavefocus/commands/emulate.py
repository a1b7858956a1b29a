"""``wavefocus emulate``: emulated instruments on a rig's wires, so that its real drivers run with no hardware."""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import load_rig
from wavefocus.console import Exit, say
from wavefocus.ending import stop_on_signals
from wavefocus.rig.virtual_bench import virtual_settings
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.mocks.wire.emulated_rig import EmulatedRig

COMMANDS = (
    "unplug ROLE, plug ROLE (mirror, recorder, player, vibrometer); "
    "patch vibrometer | sum | both | output K; spot; help; quit"
)


def emulate(rig_file: Path, *, as_json: bool) -> Exit:
    """Start the instruments that a rig file names, emulated, and obey the keyboard until it says quit.

    Raises InputError: the rig has virtual drivers, or an address that nothing can be put at.
    """
    rig = load_rig(rig_file)
    if rig.is_virtual:
        raise InputError(
            f"{rig_file}: its drivers are virtual and need no emulated instrument; "
            "wavefocus init DIR --rig emulated writes one whose drivers are real"
        )
    try:
        from wavefocus.mocks.wire.emulated_rig import EmulatedRig
        from wavefocus.mocks.wire.jack_server import JackServerError
    except ImportError as missing:
        raise InputError(
            f'emulate: the Python package {missing.name} is missing; install it with: pip install "wavefocus[emulate]"'
        ) from None
    stop = StopRequest()
    with stop_on_signals(stop):
        try:
            _check_addresses(rig, rig_file)
            emulated = EmulatedRig(virtual_settings(rig), rig)
        except InputError as wrong:
            raise InputError(f"{wrong}; wavefocus init DIR --rig emulated writes a rig that can be emulated") from None
        except (JackServerError, RuntimeError, ValueError) as refused:
            raise InputError(f"{rig_file}: {refused}") from None
        with emulated:
            environment = emulated.audio.environment
            if as_json:
                mirror = None if emulated.mirror is None else emulated.mirror.address
                print(json.dumps({"environment": environment, "mirror": mirror}), flush=True)
            settings = " ".join(f"{name}={value}" for name, value in environment.items())
            say("the emulated instruments run; in the other terminal, before doctor, calibrate or capture, type")
            say(f"    export {settings}")
            say(f"and here: {COMMANDS}")
            _carry_out(emulated, stop)
    say("the emulated instruments have stopped")
    return Exit.DONE


def _check_addresses(rig: RigConfig, rig_file: Path) -> None:
    """Refuse an address, of those where the rig's drivers look for their instruments, that none can be put at."""
    mirror, recorder = rig.mirror, rig.recorder
    if recorder.address is None:
        raise InputError(
            f'{rig_file}: recorder.address is missing: an emulated box is behind a gRPC Device Server; give "HOST:PORT"'
        )
    if mirror.driver == "analog" and (mirror.device, mirror.address) != (recorder.device, recorder.address):
        raise InputError(
            f"{rig_file}: mirror.device = {mirror.device!r}: only outputs of the recorder's own box are emulated; "
            "give it the recorder's device and address"
        )
    for key, port in (("mirror.port", mirror.port), ("vibrometer.port", rig.vibrometer.port)):
        if port is not None:
            _check_free(f"{rig_file}: {key} = {port}", port)


def _check_free(key: str, port: str) -> None:
    """Refuse an address that is in use, or at which no emulated instrument can be."""
    if port.startswith("socket://"):
        return
    link = Path(port)
    if os.name != "posix" or port.startswith("serial-number:"):
        raise InputError(f"{key}: nothing can be emulated there; use socket://localhost:PORT")
    if link.exists() and not link.is_symlink():
        raise InputError(f"{key}: something is there already; name a path of which nothing is lost, or socket://...")
    if not link.parent.is_dir():
        raise InputError(f"{key}: there is no folder {link.parent}")


def _carry_out(emulated: EmulatedRig, stop: StopRequest) -> None:
    """Do what is typed, until quit or a signal; a closed keyboard is no reason to end."""
    typed: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            typed.put(line)

    threading.Thread(target=read, name="keyboard", daemon=True).start()
    while not stop.requested:
        try:
            line = typed.get(timeout=0.1)
        except queue.Empty:
            continue
        words = line.split()
        if words == ["quit"]:
            return
        if words:
            say(_answer(emulated, words))


def _answer(emulated: EmulatedRig, words: list[str]) -> str:
    """Carry out one line from the keyboard; what it says of it."""
    try:
        match words:
            case ["unplug", role]:
                emulated.unplug(role)
                return f"{role} is unplugged"
            case ["plug", role]:
                emulated.plug(role)
                return f"{role} is plugged in"
            case ["patch", *rest]:
                emulated.bench.patch_bay.connect(" ".join(rest))
                return f"the response input is connected to: {emulated.bench.patch_bay.word}"
            case ["spot"]:
                spot_mm = emulated.bench.spot_mm()
                return "spot: not on the plate" if spot_mm is None else f"spot: {spot_mm[0]:.3f} {spot_mm[1]:.3f} mm"
    except ValueError as wrong:
        return str(wrong)
    return COMMANDS
