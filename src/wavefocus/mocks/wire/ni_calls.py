"""What each remote procedure of the emulated NI gRPC Device Server does."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from wavefocus.config.emulation import WireFault
from wavefocus.drivers.protocols import Float64Array
from wavefocus.mocks.wire.ni_box import Alive, NiBox, NiCode, NiError, NiTask
from wavefocus.mocks.wire.ni_products import DIFFERENTIAL, NRSE, OUTPUT_V, RSE, SINGLE_ENDED_V

Answer = dict[str, Any]
"""Fields of the answering message."""
_Handler = Callable[[Any, Alive], Answer]
"""Takes the request and a function that returns whether the caller still waits; called with the box's lock held."""

_TERMINALS = {10106: DIFFERENTIAL, 10083: RSE, 10078: NRSE, -1: DIFFERENTIAL}  # nidaqmx.constants.TerminalConfiguration
_TERMINAL_BITS = {RSE: 1, NRSE: 2, DIFFERENTIAL: 4}  # nidaqmx.constants._TermCfg
_FINITE = 10178  # nidaqmx.constants.AcquisitionType
_BY_CHANNEL = 0  # nidaqmx.constants.FillMode
_COMMIT = 3  # nidaqmx.constants.TaskMode
_MIN_SAMPLES = 2  # NI-DAQmx refuses a finite task of one sample
_ANALOG_INPUT = 10100  # nidaqmx.constants.ChannelType
_ENUMERATIONS = (0x29A9, 0x2326, 0x1300, 0x187F, 0x0695)  # their values travel under another name
_KINDS = ("String", "UInt32", "UInt64", "Int32", "Bool", "Double", "DoubleArray")
"""Types of properties; each has a remote procedure of its own."""


class NiCalls:
    """The remote procedures of one box, by name."""

    def __init__(self, box: NiBox) -> None:
        self._box = box
        self._spoilt: list[WireFault] = []
        self._generator = np.random.default_rng(box.serial_number)
        self.handlers: dict[str, _Handler] = {
            "GetErrorString": lambda request, alive: {"error_string": _text_of(request.error_code)},
            "GetPhysicalChanAttributeInt32": self._input_terminals,
            "ResetDevice": self._reset,
            "CreateTask": self._create_task,
            "ClearTask": self._clear_task,
            "CreateAIVoltageChan": self._create_channel,
            "CreateAOVoltageChan": self._create_outputs,
            "CreateDOChan": self._create_lines,
            "WriteAnalogF64": self._write_volts,
            "WriteDigitalLines": self._write_lines,
            "ReadDigitalLines": self._read_lines,
            "CfgSampClkTiming": self._time,
            "CfgDigEdgeStartTrig": self._trigger,
            "TaskControl": self._control,
            "StartTask": self._start,
            "StopTask": self._stop,
            "WaitUntilTaskDone": self._wait,
            "ReadAnalogF64": self._read,
        }
        properties: dict[str, Callable[[Any], dict[int, Any]]] = {
            "GetSystemInfoAttribute": self._of_system,
            "GetDeviceAttribute": self._of_device,
            "GetTaskAttribute": self._of_task,
            "GetChanAttribute": self._of_channel,
            "GetTimingAttribute": self._of_timing,
            "GetReadAttribute": self._of_read,
        }
        for name, values in properties.items():
            self.handlers |= dict.fromkeys((name + kind for kind in _KINDS), partial(_property, values))

    def spoil(self, fault: WireFault) -> None:
        """Let the next samples that are read meet a fault."""
        with self._box.condition:
            self._spoilt.append(fault)

    # -- properties, by the numbers that travel on the wire: those of the header NIDAQmx.h -----------

    def _of_system(self, request: Any) -> dict[int, Any]:
        # Version 24.5.0 of the driver, names of devices and of tasks.
        return {0x1272: 24, 0x1923: 5, 0x2F22: 0, 0x193B: self._box.name, 0x1267: ", ".join(self._box.task_names)}

    def _of_device(self, request: Any) -> dict[int, Any]:
        self._box.touch(request.device_name)
        product, name = self._box.product, self._box.name
        return {
            0x0631: product.name,
            0x0632: self._box.serial_number,
            0x231E: ", ".join(f"{name}/ai{number}" for number in range(product.inputs)),
            0x231F: ", ".join(f"{name}/ao{number}" for number in range(product.outputs)),
            0x2322: ", ".join(f"{name}/{line}" for line in product.lines),
            0x2A40: ", ".join(f"/{name}/{terminal}" for terminal in product.triggers),
            0x22CA: False,  # simulated
            0x29A9: 14646,  # nidaqmx.constants.ProductCategory.USBDAQ
            0x2326: 12586,  # nidaqmx.constants.BusType.USB
            0x2985: True,  # digital trigger supported
            0x2984: False,  # analog trigger supported
            0x298F: product.simultaneous,  # simultaneous sampling supported
            0x2990: [bound for range_v in product.ranges_v for bound in (-range_v, range_v)],
        }

    def _of_task(self, request: Any) -> dict[int, Any]:
        task = self._task(request)
        return {
            0x1276: task.name,
            0x1273: ", ".join(channel.name for channel in task.channels),
            0x230E: self._box.name,
            0x2181: len(task.channels) or len(task.outputs),
            0x230F: 1,
        }

    def _of_channel(self, request: Any) -> dict[int, Any]:
        several = not request.channel or "," in request.channel or ":" in request.channel
        for channel in self._task(request).channels:
            if several or request.channel == channel.name:
                return {
                    0x1765: 16.0,
                    0x1815: channel.range_v,
                    0x1816: -channel.range_v,
                    0x17DD: channel.range_v,
                    0x17DE: -channel.range_v,
                    0x1930: [channel.offset_v, channel.step_v, 0.0, 0.0],
                    0x187F: _ANALOG_INPUT,
                    0x0695: 10322,  # nidaqmx.constants.UsageTypeAI.VOLTAGE
                    0x18F5: f"{self._box.name}/{channel.input}",
                }
        raise NiError(NiCode.NO_SUCH_INPUT, f"Channel: {request.channel}")

    def _of_timing(self, request: Any) -> dict[int, Any]:
        task, product = self._task(request), self._box.product
        values = {
            0x1344: task.rate_hz,
            0x22C8: product.fastest_hz(len(task.channels)),
            0x1300: _FINITE,
            0x1310: task.samples,
        }
        if not product.simultaneous:  # AI Convert: its rate, and the fastest
            values |= {0x1848: 1 / task.channel_delay_s if task.channel_delay_s else 0.0, 0x22C9: product.aggregate_hz}
        return values

    def _of_read(self, request: Any) -> dict[int, Any]:
        task = self._task(request)
        return {
            0x1823: ", ".join(channel.name for channel in task.channels),
            0x217B: len(task.channels),
            0x1223: task.unread,
            0x1221: task.unread,
            0x192A: task.acquired(),
        }

    # -- device and tasks --------------------------------------------------------------------------

    def _input_terminals(self, request: Any, alive: Alive) -> Answer:
        device, _, wanted = request.physical_channel.partition("/")
        self._box.touch(device)
        terminals = self._box.product.terminals_of(self._box.input_number(wanted))
        return {"value_raw": sum(_TERMINAL_BITS[terminal] for terminal in terminals)}

    def _reset(self, request: Any, alive: Alive) -> Answer:
        self._box.reset(request.device_name)
        return {}

    def _create_task(self, request: Any, alive: Alive) -> Answer:
        # NI's server attaches to a session of this name where there is one: nidaqmx.SessionInitializationBehavior.AUTO.
        attached = bool(request.session_name) and request.session_name in self._box.task_names
        name = request.session_name if attached else self._box.create(request.session_name).name
        return {"task": {"name": name}, "new_session_initialized": not attached}

    def _clear_task(self, request: Any, alive: Alive) -> Answer:
        self._box.clear(request.task.name)
        return {}

    def _create_channel(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request, at_rest=True)
        inputs = _inputs(request.physical_channel)
        for index, (device, wanted) in enumerate(inputs):
            name = request.name_to_assign_to_channel or f"{device}/{wanted}"
            if request.name_to_assign_to_channel and len(inputs) > 1:
                name += str(index)
            self._box.touch(device)
            number = self._box.input_number(wanted)
            terminal = _TERMINALS.get(request.terminal_config_raw)
            if terminal not in self._box.product.terminals_of(number):
                raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_AI_TermCfg")
            largest_v = max(-request.min_val, request.max_val)
            channel = self._box.product.channel(name, number, largest_v, self._box.serial_number)
            if channel is None or not request.min_val < request.max_val:
                raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_AI_Max")
            if terminal != DIFFERENTIAL and largest_v > SINGLE_ENDED_V:
                raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_AI_Min")
            task.channels.append(channel)
        return {}

    def _create_outputs(self, request: Any, alive: Alive) -> Answer:
        if not -OUTPUT_V <= request.min_val < request.max_val <= OUTPUT_V:
            raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_AO_Max")
        return self._create_named(request, request.physical_channel)

    def _create_lines(self, request: Any, alive: Alive) -> Answer:
        return self._create_named(request, request.lines)

    def _create_named(self, request: Any, physical: str) -> Answer:
        task = self._task(request, at_rest=True)
        for device, wanted in _inputs(physical):
            self._box.touch(device)
            if wanted not in self._box.output_names:
                raise NiError(NiCode.NO_SUCH_INPUT, f"Physical Channel: {wanted}")
            task.outputs.append(wanted)
        return {}

    def _write_volts(self, request: Any, alive: Alive) -> Answer:
        if not all(abs(volts) <= OUTPUT_V for volts in request.write_array):
            raise NiError(NiCode.INVALID_VALUE, "Generated data is outside the range of the channel.")
        return self._write_lines(request, alive)

    def _write_lines(self, request: Any, alive: Alive) -> Answer:
        task = self._writing(request)
        self._box.set_levels(dict(zip(task.outputs, map(float, request.write_array), strict=True)))
        return {"samps_per_chan_written": 1}

    def _read_lines(self, request: Any, alive: Alive) -> Answer:
        task = self._writing(request)
        levels = bytes(int(self._box.level(name)) for name in task.outputs)
        return {"read_array": levels, "samps_per_chan_read": 1, "num_bytes_per_samp": 1}

    def _writing(self, request: Any) -> NiTask:
        """The task of an output that is written or read back now."""
        task = self._task(request)
        self._box.touch(self._box.name)
        if not task.outputs:
            raise NiError(NiCode.NO_CHANNELS)
        self._box.reserve(task)
        task.running = True
        return task

    def _time(self, request: Any, alive: Alive) -> Answer:
        task, product = self._task(request, at_rest=True), self._box.product
        if not task.channels:
            raise NiError(NiCode.NO_CHANNELS)
        fastest_hz = product.fastest_hz(len(task.channels))
        if request.rate > fastest_hz * (1 + 1e-9):
            code = NiCode.SAMPLE_RATE_TOO_HIGH if request.rate <= product.aggregate_hz else NiCode.INVALID_VALUE
            raise NiError(code, f"Property: DAQmx_SampClk_Rate. Maximum Value: {fastest_hz:g}")
        if request.rate < product.slowest_hz:
            raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_SampClk_Rate")
        if request.sample_mode_raw != _FINITE:
            raise NiError(NiCode.NOT_SUPPORTED, "Property: DAQmx_SampQuant_SampMode")
        if request.samps_per_chan < _MIN_SAMPLES:
            raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_SampQuant_SampPerChan. Minimum Value: 2")
        task.rate_hz = product.coerced_rate_hz(request.rate)
        task.samples = request.samps_per_chan
        task.channel_delay_s = product.channel_delay_s(task.rate_hz, len(task.channels))
        return {}

    def _trigger(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request, at_rest=True)
        terminal = request.trigger_source.removeprefix(f"/{self._box.name}/")
        if terminal not in self._box.product.triggers:
            raise NiError(NiCode.NO_SUCH_TERMINAL, f"Terminal: {request.trigger_source}")
        task.trigger = terminal
        return {}

    def _control(self, request: Any, alive: Alive) -> Answer:
        if request.action_raw != _COMMIT:
            raise NiError(NiCode.NOT_SUPPORTED, f"Task action: {request.action_raw}")
        task = self._task(request)
        self._box.reserve(task)
        task.commits, task.running = True, False
        return {}

    def _start(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request, at_rest=True)
        if not task.outputs and (not task.channels or not task.rate_hz):
            raise NiError(NiCode.NO_CHANNELS)
        self._box.reserve(task)
        task.begin()
        return {}

    def _stop(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request)
        early = task.end()
        if not task.commits:
            self._box.release(task)
        return {"status": NiCode.STOPPED_BEFORE_DONE if early else 0}

    def _wait(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request)
        self._box.touch(self._box.name)
        task.wait_done(request.time_to_wait, alive)
        return {}

    def _read(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request)
        self._box.touch(self._box.name)
        if not task.running:
            self._start(request, alive)
        asked = request.num_samps_per_chan if request.num_samps_per_chan >= 0 else task.samples
        if asked * len(task.channels) > request.array_size_in_samps:
            raise NiError(NiCode.NOT_STARTED, "The array is too small.")
        analog_v, complete = task.read(asked, request.timeout, alive)
        analog_v, complete, status = self._spoil(task, analog_v, complete)
        volts = np.zeros((len(task.channels), asked))
        count = analog_v.shape[1]
        volts[:, :count] = task.converted(analog_v)
        rows = volts if request.fill_mode_raw == _BY_CHANNEL else volts.T
        return {
            "read_array": rows.ravel().tolist(),  # twice as fast as the array itself
            "samps_per_chan_read": count,
            "status": status if complete else NiCode.NOT_YET_AVAILABLE,
        }

    def _spoil(self, task: NiTask, analog_v: Float64Array, complete: bool) -> tuple[Float64Array, bool, int]:
        """Let samples meet the faults that wait for them."""
        status = 0
        spoilt, self._spoilt = self._spoilt, []
        for fault in spoilt:
            if fault.kind in ("short_read", "read_timeout"):
                analog_v = analog_v[:, : analog_v.shape[1] // 2]
                complete = complete and fault.kind == "short_read"
            elif fault.kind == "missing_reference":
                analog_v = analog_v.copy()
                # noise of an input that nothing drives, volts rms
                analog_v[0] = 1e-4 * self._generator.standard_normal(analog_v.shape[1])
            elif fault.kind == "over_range":
                analog_v = analog_v.copy()
                largest_v = max(float(np.abs(analog_v[-1]).max()), 1e-9)
                analog_v[-1] *= 1.5 * task.channels[-1].range_v / largest_v
            elif fault.kind == "warning":
                status = NiCode.ADC_OVERLOADED
        return analog_v, complete, status

    def _task(self, request: Any, *, at_rest: bool = False) -> NiTask:
        return self._box.task(request.task.name, at_rest=at_rest)


def _property(values: Callable[[Any], dict[int, Any]], request: Any, alive: Alive) -> Answer:
    """The value of a property among those that there are. Raises NiError."""
    attribute, known = request.attribute_raw, values(request)
    if attribute not in known:
        raise NiError(NiCode.NOT_SUPPORTED, f"Property: {attribute:#x}")
    return {"value_raw" if attribute in _ENUMERATIONS else "value": known[attribute]}


def _inputs(physical: str) -> list[tuple[str, str]]:
    """Devices and inputs or outputs of a physical channel string: ``Dev1/ai0, Dev1/ai2``."""
    return [(device, name) for device, _, name in (part.strip().partition("/") for part in physical.split(","))]


def _text_of(code: int) -> str:
    return next((known.text for known in NiCode if known == code), "")
