"""Error codes of the emulated NI-DAQmx, as the nidaqmx package and the header NIDAQmx.h have them."""

from __future__ import annotations

INVALID_VALUE = -200077
SAMPLE_RATE_TOO_HIGH = -200081
INVALID_TASK = -200088
DUPLICATE_TASK = -200089
NO_SUCH_INPUT = -200170
NO_SUCH_DEVICE = -200220
OVERWRITTEN = -200279
NOT_YET_AVAILABLE = -200284
NOT_STARTED = -200278
NOT_SUPPORTED = -200452
NO_CHANNELS = -200478
TASK_RUNNING = -200479
NOT_DONE = -200560
UNPLUGGED = -201003
ABSENT = -88705
ABORTED = -88709
NO_SUCH_TERMINAL = -89120
IN_USE = -50103
TRANSFER_ABORTED = -50405
STOPPED_BEFORE_DONE = 200010
ADC_OVERLOADED = 200005
NOT_CALIBRATED = 200016

TEXTS = {
    INVALID_VALUE: "Requested value is not a supported value for this property.",
    SAMPLE_RATE_TOO_HIGH: "Sample rate, number of channels and convert period do not go together.",
    INVALID_TASK: "Task specified is invalid or does not exist.",
    DUPLICATE_TASK: "Task name conflicts with an existing task name.",
    NO_SUCH_INPUT: "Physical channel specified does not exist on this device.",
    NO_SUCH_DEVICE: "Device identifier is invalid.",
    OVERWRITTEN: "The application is not able to keep up with the hardware acquisition; data was overwritten.",
    NOT_STARTED: "Samples will never be available: the task has ended or was never started.",
    NOT_SUPPORTED: "Attribute is not supported in this context.",
    NO_CHANNELS: "Operation cannot be performed because there are no channels in the task.",
    TASK_RUNNING: "Operation cannot be performed while the task is running.",
    NOT_DONE: "Wait Until Done did not indicate that the task was done within the specified timeout.",
    UNPLUGGED: "Device cannot be accessed: it may be unplugged, off or in reset.",
    ABSENT: "Specified device is not present or is not active in the system.",
    ABORTED: "Task was aborted while the operation was under way.",
    NO_SUCH_TERMINAL: "Source terminal to be routed could not be found on the device.",
    IN_USE: "The specified resource is reserved. The operation could not be completed as specified.",
    TRANSFER_ABORTED: "The transfer was aborted on the bus.",
    STOPPED_BEFORE_DONE: "Finite acquisition was stopped before all requested samples were acquired.",
    NOT_CALIBRATED: "The device was never self-calibrated with NI-DAQmx.",
    ADC_OVERLOADED: "The analog-to-digital converter was overloaded.",
}


class NiError(Exception):
    """An NI-DAQmx error code on its way to the client."""

    def __init__(self, code: int, detail: str = "") -> None:
        text = TEXTS.get(code, "")
        super().__init__(" ".join(part for part in (text, detail, f"Status Code: {code}") if part))
        self.code = code
