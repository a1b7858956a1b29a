/* A stand-in for NI's driver library: what the nidaqmx package calls for a finite two-channel record, and no more.
 * Dev1 is a USB-6001 with a sine on both inputs, 0.5 V and 2 V. While the file that the environment variable
 * SHIM_UNPLUGGED names is there, the device is unplugged; whoever asks for a property then gets no other answer until
 * the process ends, as nidaqmx-python's users report. While that of SHIM_HANGS is there, properties do not return.
 * Compiled by test_daq_local_driver.py. */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

typedef int32_t status;
typedef struct {
    int channels, running;
    double rate;
    uint64_t samples;
    struct timespec start;
} task;

static char last_error[128];

static status fail(status code, const char *text) {
    snprintf(last_error, sizeof last_error, "%s", text);
    return code;
}

/* A string attribute is asked for twice: for its size, then for itself. */
static status give(void *value, uint32_t size, const char *text) {
    if (size == 0) return (status)strlen(text) + 1;
    snprintf(value, size, "%s", text);
    return 0;
}

static status give_doubles(void *value, uint32_t size, const double *doubles, uint32_t count) {
    if (size == 0) return (status)count;
    memcpy(value, doubles, count * sizeof *doubles);
    return 0;
}

static int there(const char *variable) {
    const char *path = getenv(variable);
    return path && !access(path, F_OK);
}

/* Broken for good, once the device was found unplugged. */
static int broken(void) {
    static int found;
    while (there("SHIM_HANGS")) usleep(10000);
    return found = found || there("SHIM_UNPLUGGED");
}

static double elapsed(const task *t) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)(now.tv_sec - t->start.tv_sec) + 1e-9 * (double)(now.tv_nsec - t->start.tv_nsec);
}

status DAQmxGetExtendedErrorInfo(char *text, uint32_t size) { return give(text, size, last_error); }

status DAQmxGetErrorString(status code, char *text, uint32_t size) {
    snprintf(text, size, "shim says %d", code);
    return 0;
}

status DAQmxGetSystemInfoAttribute(int32_t attribute, void *value, uint32_t size) {
    if (attribute == 0x193B) return give(value, size, "Dev1, Dev2");
    *(uint32_t *)value = attribute == 0x1272 ? 23 : attribute == 0x1923 ? 8 : 1;
    return 0;
}

status DAQmxGetDeviceAttribute(const char *device, int32_t attribute, void *value, uint32_t size) {
    static const double ranges[] = {-10.0, 10.0};
    if (broken()) return fail(-201003, "Device cannot be accessed.");
    if (strcmp(device, "Dev1")) return fail(-200220, "Device identifier is invalid.");
    switch (attribute) {
    case 0x0631: return give(value, size, "USB-6001");
    case 0x0632: *(uint32_t *)value = 0x01C0FFEE; return 0;
    case 0x231E: return give(value, size, "Dev1/ai0, Dev1/ai1, Dev1/ai2, Dev1/ai3");
    case 0x2A40: return give(value, size, "/Dev1/PFI0, /Dev1/PFI1, /Dev1/ai/SampleClock");
    case 0x298C: case 0x298D: *(double *)value = 20000.0; return 0;
    case 0x2990: return give_doubles(value, size, ranges, 2);
    default: return fail(-200197, "Attribute not supported."); /* the slowest rate is one */
    }
}

status DAQmxGetPhysicalChanAttribute(const char *channel, int32_t attribute, void *value) {
    (void)channel, (void)attribute;
    *(int32_t *)value = 1 | 4; /* rse, differential */
    return 0;
}

status DAQmxResetDevice(const char *device) {
    (void)device;
    return 0;
}

status DAQmxCreateTask(const char *name, task **made) {
    (void)name;
    *made = calloc(1, sizeof(task));
    return 0;
}

status DAQmxClearTask(task *t) {
    free(t);
    return 0;
}

status DAQmxGetTaskAttribute(task *t, int32_t attribute, void *value, uint32_t size) {
    (void)t, (void)attribute;
    return give(value, size, "_unnamedTask<0>");
}

status DAQmxCreateAIVoltageChan(task *t, const char *channel, const char *name, int32_t terminal, double low,
                                double high, int32_t units, const char *scale) {
    (void)channel, (void)name, (void)low, (void)units, (void)scale;
    if (terminal != 10106 || high > 10.0) return fail(-200077, "Requested value is not supported.");
    t->channels++;
    return 0;
}

status DAQmxCfgSampClkTiming(task *t, const char *source, double rate, int32_t edge, int32_t mode, uint64_t samples) {
    (void)source, (void)edge;
    if (mode != 10178 || samples < 2 || t->channels != 2) return fail(-200077, "Requested value is not supported.");
    t->rate = rate;
    t->samples = samples;
    return 0;
}

status DAQmxGetTimingAttribute(task *t, int32_t attribute, void *value) {
    (void)attribute;
    *(double *)value = t->rate;
    return 0;
}

status DAQmxGetChanAttribute(task *t, const char *channel, int32_t attribute, void *value, uint32_t size) {
    static const double coefficients[] = {0.002, 20.0 / 16384 * 1.01, 0.0, 0.0};
    (void)t, (void)channel;
    switch (attribute) {
    case 0x1765: *(double *)value = 14.0; return 0;
    case 0x1815: *(double *)value = 10.0; return 0;
    case 0x1930: return give_doubles(value, size, coefficients, 4);
    default: return fail(-200197, "Attribute not supported.");
    }
}

status DAQmxTaskControl(task *t, int32_t action) {
    if (action != 3) return fail(-200077, "Requested value is not supported.");
    (void)t;
    return 0;
}

status DAQmxStartTask(task *t) {
    if (broken()) return fail(-201003, "Device cannot be accessed.");
    if (t->running) return fail(-200479, "Specified operation cannot be performed while the task is running.");
    t->running = 1;
    clock_gettime(CLOCK_MONOTONIC, &t->start);
    return 0;
}

status DAQmxStopTask(task *t) {
    int early = t->running && elapsed(t) < (double)t->samples / t->rate;
    t->running = 0;
    return early ? 200010 : 0; /* a warning */
}

status DAQmxWaitUntilTaskDone(task *t, double timeout) {
    double left = (double)t->samples / t->rate - elapsed(t);
    double wait = left < timeout ? left : timeout;
    struct timespec nap = {(time_t)wait, (long)(1e9 * (wait - (double)(time_t)wait))};
    if (wait > 0) nanosleep(&nap, NULL);
    return left <= timeout ? 0 : fail(-200560, "Wait Until Done did not indicate that the task was done.");
}

status DAQmxReadAnalogF64(task *t, int32_t samples, double timeout, uint32_t layout, double *volts, uint32_t size,
                          int32_t *count, void *unused) {
    const double step = 20.0 / 16384 * 1.01;
    (void)timeout, (void)unused;
    if (layout != 0 || (uint64_t)samples != t->samples || size < 2 * t->samples) return fail(-200077, "Wrong array.");
    *count = samples;
    for (int channel = 0; channel < 2; channel++)
        for (int k = 0; k < samples; k++)
            volts[channel * samples + k] =
                0.002 + step * rint((channel ? 2.0 : 0.5) * sin(2 * 3.14159265358979 * 200 * k / t->rate) / step);
    return 0;
}
