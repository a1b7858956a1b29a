"""What each remote procedure of the emulated NI gRPC Device Server does."""

from collections.abc import Callable
from typing import Any

import numpy as np

from wavefocus.drivers.protocols import Float64Array
from wavefocus.mocks.wire.faults import WireFault
from wavefocus.mocks.wire.ni_box import Alive, Channel, NiBox, NiCode, NiError, NiTask, TaskState
from wavefocus.mocks.wire.ni_products import DIFFERENTIAL, NRSE, RSE, Product

Answer = dict[str, Any]
"""Fields of the answering message."""
Handler = Callable[[Any, Alive], Answer]
"""Takes the request and a function that returns whether the caller still waits."""

TERMINALS = {10106: DIFFERENTIAL, 10083: RSE, 10078: NRSE, -1: DIFFERENTIAL}  # nidaqmx.constants.TerminalConfiguration
TERMINAL_BITS = {RSE: 1, NRSE: 2, DIFFERENTIAL: 4}  # nidaqmx.constants._TermCfg
FINITE = 10178  # nidaqmx.constants.AcquisitionType
BY_CHANNEL = 0  # nidaqmx.constants.FillMode
COMMIT = 3  # nidaqmx.constants.TaskMode
MIN_SAMPLES = 2  # NI-DAQmx refuses a finite task of one sample
ANALOG_INPUT = 10100  # nidaqmx.constants.ChannelType
ENUMERATIONS = (0x29A9, 0x2326, 0x1300)  # their values travel under another name


class NiCalls:
    """The remote procedures of one box, by name."""

    def __init__(self, box: NiBox) -> None:
        self._box = box
        self._spoilt: list[WireFault] = []
        self._generator = np.random.default_rng(box.serial_number)
        self.handlers: dict[str, Handler] = {
            "GetSystemInfoAttributeUInt32": self._system_number,
            "GetSystemInfoAttributeString": self._system_text,
            "GetErrorString": lambda request, alive: {"error_string": _text_of(request.error_code)},
            "GetDeviceAttributeString": self._device_attribute,
            "GetDeviceAttributeUInt32": self._device_attribute,
            "GetDeviceAttributeInt32": self._device_attribute,
            "GetDeviceAttributeBool": self._device_attribute,
            "GetDeviceAttributeDouble": self._device_attribute,
            "GetDeviceAttributeDoubleArray": self._device_attribute,
            "GetPhysicalChanAttributeInt32": self._input_terminals,
            "ResetDevice": self._reset,
            "CreateTask": self._create_task,
            "ClearTask": self._clear_task,
            "GetTaskAttributeString": self._task_text,
            "GetTaskAttributeUInt32": self._task_number,
            "CreateAIVoltageChan": self._create_channel,
            "GetChanAttributeInt32": self._channel_attribute,
            "GetChanAttributeString": self._channel_attribute,
            "GetChanAttributeDouble": self._channel_attribute,
            "GetChanAttributeDoubleArray": self._channel_attribute,
            "CreateAOVoltageChan": self._create_outputs,
            "CreateDOChan": self._create_lines,
            "WriteAnalogF64": self._write_volts,
            "WriteDigitalLines": self._write_lines,
            "ReadDigitalLines": self._read_lines,
            "CfgSampClkTiming": self._time,
            "GetTimingAttributeDouble": self._timing_attribute,
            "GetTimingAttributeInt32": self._timing_attribute,
            "GetTimingAttributeUInt64": self._timing_attribute,
            "GetReadAttributeString": self._read_attribute,
            "GetReadAttributeUInt32": self._read_attribute,
            "GetReadAttributeUInt64": self._read_attribute,
            "CfgDigEdgeStartTrig": self._trigger,
            "TaskControl": self._control,
            "StartTask": self._start,
            "StopTask": self._stop,
            "WaitUntilTaskDone": self._wait,
            "ReadAnalogF64": self._read,
        }

    def spoil(self, fault: WireFault) -> None:
        """Let the next samples that are read meet a fault."""
        with self._box.condition:
            self._spoilt.append(fault)

    # -- system and device ---------------------------------------------------------------------

    def _system_number(self, request: Any, alive: Alive) -> Answer:
        major, minor, update = (24, 5, 0)
        return {"value": _found({0x1272: major, 0x1923: minor, 0x2F22: update}, request.attribute_raw)}

    def _system_text(self, request: Any, alive: Alive) -> Answer:
        values = {0x193B: self._box.name, 0x1267: ", ".join(self._box.task_names)}
        return {"value": _found(values, request.attribute_raw)}

    def _device_attribute(self, request: Any, alive: Alive) -> Answer:
        box = self._box
        box.touch(request.device_name)
        value = _device_value(box.product, box.name, box.serial_number, request.attribute_raw)
        return {"value_raw" if request.attribute_raw in ENUMERATIONS else "value": value}

    def _input_terminals(self, request: Any, alive: Alive) -> Answer:
        device, _, wanted = request.physical_channel.partition("/")
        self._box.touch(device)
        terminals = self._box.product.terminals(self._box.input_number(wanted))
        return {"value_raw": sum(TERMINAL_BITS[terminal] for terminal in terminals)}

    def _reset(self, request: Any, alive: Alive) -> Answer:
        self._box.reset(request.device_name)
        return {}

    # -- tasks -----------------------------------------------------------------------------------

    def _create_task(self, request: Any, alive: Alive) -> Answer:
        # NI's server attaches to a session of this name where there is one: nidaqmx.SessionInitializationBehavior.AUTO.
        attached = bool(request.session_name) and request.session_name in self._box.task_names
        name = request.session_name if attached else self._box.create(request.session_name).name
        return {"task": {"name": name}, "new_session_initialized": not attached}

    def _clear_task(self, request: Any, alive: Alive) -> Answer:
        self._box.clear(request.task.name)
        return {}

    def _task_text(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request)
        names = ", ".join(channel.name for channel in task.channels)
        return {"value": _found({0x1276: task.name, 0x1273: names, 0x230E: self._box.name}, request.attribute_raw)}

    def _task_number(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request)
        return {"value": _found({0x2181: len(task.channels) or len(task.outputs), 0x230F: 1}, request.attribute_raw)}

    def _create_channel(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._task(request, at_rest=True)
            inputs = _inputs(request.physical_channel)
            for index, (device, wanted) in enumerate(inputs):
                name = request.name_to_assign_to_channel or f"{device}/{wanted}"
                if request.name_to_assign_to_channel and len(inputs) > 1:
                    name += str(index)
                task.channels.append(self._channel(device, wanted, name, request))
            return {}

    def _channel(self, device: str, wanted: str, name: str, request: Any) -> Channel:
        product = self._box.product
        self._box.touch(device)
        number = self._box.input_number(wanted)
        terminal = TERMINALS.get(request.terminal_config_raw)
        if terminal not in product.terminals(number):
            raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_AI_TermCfg")
        range_v = product.range_v(terminal, max(-request.min_val, request.max_val))
        if range_v is None or not request.min_val < request.max_val:
            raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_AI_Max")
        return Channel(name, wanted, product.converter(terminal, range_v, self._box.serial_number, number))

    def _create_outputs(self, request: Any, alive: Alive) -> Answer:
        lowest_v, highest_v = self._box.product.output_range_v
        if not lowest_v <= request.min_val < request.max_val <= highest_v:
            raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_AO_Max")
        return self._create_named(request, request.physical_channel)

    def _create_lines(self, request: Any, alive: Alive) -> Answer:
        return self._create_named(request, request.lines)

    def _create_named(self, request: Any, physical: str) -> Answer:
        with self._box.condition:
            task = self._task(request, at_rest=True)
            for device, wanted in _inputs(physical):
                self._box.touch(device)
                if wanted not in self._box.output_names:
                    raise NiError(NiCode.NO_SUCH_INPUT, f"Physical Channel: {wanted}")
                task.outputs.append(wanted)
            return {}

    def _write_volts(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task, volts = self._writing(request), list(request.write_array)
            lowest_v, highest_v = self._box.product.output_range_v
            if not all(lowest_v <= value <= highest_v for value in volts):
                raise NiError(NiCode.INVALID_VALUE, "Generated data is outside the range of the channel.")
            self._box.set_levels(dict(zip(task.outputs, volts, strict=True)))
            return {"samps_per_chan_written": 1}

    def _write_lines(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._writing(request)
            self._box.set_levels(dict(zip(task.outputs, map(float, request.write_array), strict=True)))
            return {"samps_per_chan_written": 1}

    def _read_lines(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
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
        task.state = TaskState.RUNNING
        return task

    def _channel_attribute(self, request: Any, alive: Alive) -> Answer:
        task = self._task(request)
        several = not request.channel or "," in request.channel or ":" in request.channel
        for channel in task.channels:
            if several or request.channel == channel.name:
                value = _channel_value(channel, self._box.name, request.attribute_raw)
                # Enumerations travel under another name.
                return {"value_raw" if isinstance(value, int) else "value": value}
        raise NiError(NiCode.NO_SUCH_INPUT, f"Channel: {request.channel}")

    def _time(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._task(request, at_rest=True)
            if not task.channels:
                raise NiError(NiCode.NO_CHANNELS)
            fastest_hz = self._box.product.fastest_hz(len(task.channels))
            if request.rate > fastest_hz * (1 + 1e-9):
                code = (
                    NiCode.SAMPLE_RATE_TOO_HIGH
                    if request.rate <= self._box.product.aggregate_hz
                    else NiCode.INVALID_VALUE
                )
                raise NiError(code, f"Property: DAQmx_SampClk_Rate. Maximum Value: {fastest_hz:g}")
            if request.rate < self._box.product.slowest_hz:
                raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_SampClk_Rate")
            if request.sample_mode_raw != FINITE:
                raise NiError(NiCode.NOT_SUPPORTED, "Property: DAQmx_SampQuant_SampMode")
            if request.samps_per_chan < MIN_SAMPLES:
                raise NiError(NiCode.INVALID_VALUE, "Property: DAQmx_SampQuant_SampPerChan. Minimum Value: 2")
            task.rate_hz = self._box.product.coerced_rate_hz(request.rate)
            task.samples = request.samps_per_chan
            task.channel_delay_s = self._box.product.channel_delay_s(task.rate_hz, len(task.channels))
            return {}

    def _timing_attribute(self, request: Any, alive: Alive) -> Answer:
        task, product = self._task(request), self._box.product
        values = {
            0x1344: task.rate_hz,
            0x22C8: product.fastest_hz(len(task.channels)),
            0x1300: FINITE,
            0x1310: task.samples,
        }
        if not product.simultaneous:  # AI Convert: its rate, and the fastest
            values |= {0x1848: 1 / task.channel_delay_s if task.channel_delay_s else 0.0, 0x22C9: product.aggregate_hz}
        value = _found(values, request.attribute_raw)
        return {"value_raw" if request.attribute_raw in ENUMERATIONS else "value": value}

    def _read_attribute(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._task(request)
            values = {
                0x1823: ", ".join(channel.name for channel in task.channels),
                0x217B: len(task.channels),
                0x1223: task.unread,
                0x1221: task.unread,
                0x192A: task.acquired(),
            }
            return {"value": _found(values, request.attribute_raw)}

    def _trigger(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._task(request, at_rest=True)
            terminal = request.trigger_source.removeprefix(f"/{self._box.name}/")
            if terminal not in self._box.product.triggers:
                raise NiError(NiCode.NO_SUCH_TERMINAL, f"Terminal: {request.trigger_source}")
            task.trigger = terminal
            return {}

    def _control(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task, action = self._task(request), request.action_raw
            if action != COMMIT:
                raise NiError(NiCode.NOT_SUPPORTED, f"Task action: {action}")
            self._box.reserve(task)
            task.commits = True
            task.state = TaskState.COMMITTED
            return {}

    def _start(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._task(request, at_rest=True)
            if not task.outputs and (not task.channels or not task.rate_hz):
                raise NiError(NiCode.NO_CHANNELS)
            self._box.reserve(task)
            task.begin()
            return {}

    def _stop(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._task(request)
            early = task.end()
            if task.state is TaskState.IDLE:
                self._box.release(task)
            return {"status": NiCode.STOPPED_BEFORE_DONE if early else 0}

    def _wait(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._task(request)
            self._box.touch(self._box.name)
            task.wait_done(request.time_to_wait, alive)
            return {}

    def _read(self, request: Any, alive: Alive) -> Answer:
        with self._box.condition:
            task = self._task(request)
            self._box.touch(self._box.name)
            if task.state is not TaskState.RUNNING:
                self._start(request, alive)
            asked = request.num_samps_per_chan
            if asked < 0:
                asked = task.samples
            if asked * len(task.channels) > request.array_size_in_samps:
                raise NiError(NiCode.NOT_STARTED, "The array is too small.")
            analog_v, complete = task.read(asked, request.timeout, alive)
            analog_v, complete, status = self._spoil(task, analog_v, complete)
            volts = np.zeros((len(task.channels), asked))
            count = analog_v.shape[1]
            volts[:, :count] = task.converted(analog_v)
        rows = volts if request.fill_mode_raw == BY_CHANNEL else volts.T
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
                analog_v[-1] *= 1.5 * task.channels[-1].converter.range_v / largest_v
            elif fault.kind == "warning":
                status = NiCode.ADC_OVERLOADED
        return analog_v, complete, status

    def _task(self, request: Any, *, at_rest: bool = False) -> NiTask:
        return self._box.task(request.task.name, at_rest=at_rest)


# -- properties, by the numbers that travel on the wire: those of the header NIDAQmx.h


def _device_value(product: Product, name: str, serial_number: int, attribute: int) -> Any:
    """A property of the device. Raises NiError."""
    ranges_v = [bound for range_v in product.all_ranges_v for bound in (-range_v, range_v)]
    values = {
        0x0631: product.name,
        0x0632: serial_number,
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
        0x298C: product.aggregate_hz,
        0x298D: product.aggregate_hz,
        0x298E: product.slowest_hz,
        0x2990: ranges_v,
    }
    return _found(values, attribute)


def _channel_value(channel: Channel, device: str, attribute: int) -> Any:
    """A property of a channel. Raises NiError."""
    converter = channel.converter
    values = {
        0x1765: float(converter.bits),
        0x1815: converter.range_v,
        0x1816: -converter.range_v,
        0x17DD: converter.range_v,
        0x17DE: -converter.range_v,
        0x1930: [converter.offset_v, converter.step_v, 0.0, 0.0],
        0x187F: ANALOG_INPUT,
        0x0695: 10322,  # nidaqmx.constants.UsageTypeAI.VOLTAGE
        0x18F5: f"{device}/{channel.input}",
    }
    return _found(values, attribute)


def _inputs(physical: str) -> list[tuple[str, str]]:
    """Devices and inputs or outputs of a physical channel string: ``Dev1/ai0, Dev1/ai2``."""
    return [(device, name) for device, _, name in (part.strip().partition("/") for part in physical.split(","))]


def _found(values: dict[int, Any], attribute: int) -> Any:
    """The value of a property among those that there are; raises `NiError` for others."""
    if attribute not in values:
        raise NiError(NiCode.NOT_SUPPORTED, f"Property: {attribute:#x}")
    return values[attribute]


def _text_of(code: int) -> str:
    return next((known.text for known in NiCode if known == code), "")
