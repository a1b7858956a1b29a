"""``wavefocus operate``: instruments operated by hand, by orders on standard input."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from msgspec.structs import replace

from wavefocus.acquisition.setup import Openers, Sensor
from wavefocus.config.messages import Refused
from wavefocus.config.messages.operate import Done, End, Ended, Mute, Opening
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import named_rig
from wavefocus.console import Exit, say
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.timeouts import BoundedPlayer, CallThread, HungError
from wavefocus.ending import ending_at_once
from wavefocus.json_lines import LinesIn, LinesOut, ReadingFailedError
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.operation import SAMPLE_RATE_HZ, Operation, faulted, order_of
from wavefocus.rig.setup import in_time_or_failed, open_rig, setup_in_use
from wavefocus.storage.errors import InputError


def operate(rig_file: Path) -> Exit:
    """Carry out orders until they end; on every way out the outputs are muted and the mirror is parked.

    Raises InputError: the rig file is wrong. Raises InstrumentError: an instrument cannot be opened, or could not be
    put to rest. Raises ReadingFailedError: orders cannot be read any more; the outputs are muted at once.
    """
    rig = named_rig(rig_file)
    publish = LinesOut()
    publish(Opening(str(rig_file)))
    try:
        with ending_at_once():
            _operate(rig, publish)
    except InstrumentError as failure:
        publish(faulted(failure))
        raise
    except ReadingFailedError:
        publish(Ended())
        raise
    except KeyboardInterrupt:
        publish(Ended())
        say("stopped by the user; the outputs are muted, the mirror is parked")
        return Exit.STOPPED
    publish(Ended())
    return Exit.DONE


def _operate(rig: RigConfig, publish: LinesOut) -> None:
    """Open the rig, obey, and put it to rest however that ends."""
    openers = openers_of(rig)
    with setup_in_use(open_rig(openers), rig, SAMPLE_RATE_HZ) as setup:
        player = setup.player
        assert isinstance(player, BoundedPlayer)  # as every player of a set-up
        operation = Operation(rig, setup, player, _light(openers), publish)
        operation.introduce()
        _carry_out(operation, player, rig, publish)


def _carry_out(operation: Operation, player: BoundedPlayer, rig: RigConfig, publish: LinesOut) -> None:
    muting = CallThread("muting")
    orders = LinesIn()

    def is_mute(content: Mapping[str, object]) -> bool:
        return content.get("order") == "mute"

    def mute() -> None:
        with suppress(HungError, InstrumentError):  # reported by the next mute: the order itself, or the way out
            muting.call(player.shut, 5.0)

    def overtake(content: Mapping[str, object]) -> None:
        """What shall be silent is so at once, whatever is under way; orders that wait are no longer wanted."""
        if is_mute(content):
            orders.discard(is_mute)
            mute()

    orders.start(overtake, on_error=mute)
    while True:
        operation.look()
        due_s = operation.due_s()
        try:
            content = orders.next(1.0 if due_s is None else min(due_s, 1.0))
        except TimeoutError:
            continue
        except InputError as wrong:
            publish(Refused(str(wrong)))
            continue
        if content is None:
            return
        done = _done(content)
        try:
            order = order_of(content, rig)
        except InputError as wrong:
            publish(Refused(str(wrong)))
            if is_mute(content):  # silence is wanted all the same, and the gate was shut for it
                operation.carry_out(Mute())
            publish(done)
            continue
        ok = operation.carry_out(order)
        publish(replace(done, ok=ok))
        if isinstance(order, End):
            return


def _done(content: Mapping[str, object]) -> Done:
    """The end of an order that was not carried out; repeats what can be repeated of it."""
    word, number = content.get("order"), content.get("id")
    return Done(
        ok=False,
        order=word if isinstance(word, str) else None,
        id=number if isinstance(number, str | int | float) else None,
    )


def _light(openers: Openers) -> Sensor | None:
    rig, sensor = openers.rig, openers.sensors.get("light")
    if sensor is None or not (rig.is_virtual or hasattr(rig.vibrometer.make_driver(), "least_signal_level")):
        return None
    return in_time_or_failed("light", sensor, rig.recovery.hung_after_s)
