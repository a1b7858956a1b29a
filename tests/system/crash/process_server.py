"""Forks a process for each order it reads, so that hundreds of captures start without importing anew.

What is forked runs the program as it is, from its entry point to the interpreter's end; `calls.c`, loaded before it,
sees its calls. Run as a script by :class:`tests.system.crash.processes.Processes`.
"""

import atexit
import ctypes
import gc
import json
import os
import sys
import threading
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path


def serve():
    """Read one order a line until there are no more; tell each process's number and how it ended."""
    for line in sys.stdin:
        order = json.loads(line)
        if "warm" in order:
            warm_up(order["warm"])
            tell("ready", 0)
            continue
        child = os.fork()
        if child == 0:
            become(order)
            return
        tell("pid", child)
        _, status = os.waitpid(child, 0)
        tell("end", os.waitstatus_to_exitcode(status))


def warm_up(commands):
    """Run commands here, so that whoever is forked finds everything imported and every cache filled."""
    from wavefocus.__main__ import run

    with Path(os.devnull).open("w", encoding="utf-8") as nothing, redirect_stdout(nothing), redirect_stderr(nothing):
        for command in commands:
            run(command)
    # A collection in a child would touch, and so copy, every page of what it inherits.
    gc.collect()
    gc.freeze()


def tell(word, number):
    os.write(1, f"{word} {number}\n".encode())


def become(order):
    """Be the process that was ordered."""
    for number, name in ((0, order["stdin"]), (1, order["stdout"]), (2, order["stderr"])):
        fd = os.open(str(name), os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(fd, number)
        os.close(fd)
    log = -1
    if order.get("log"):
        log = os.open(str(order["log"]), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    if order.get("ended"):
        atexit.register(note_end, str(order["ended"]))
    library = ctypes.CDLL(None)
    library.crash_order.argtypes = [
        ctypes.c_char_p,
        ctypes.c_int,
        ctypes.c_long,
        ctypes.c_long,
        ctypes.c_int,
        ctypes.c_int,
    ]
    how = [int(order[key]) for key in ("how", "call", "part", "error")]  # type: ignore[call-overload]
    sys.argv = ["wavefocus", *order["arguments"]]  # type: ignore[misc]
    from wavefocus.__main__ import main

    library.crash_order(os.fsencode(str(order["folder"])), *how, log)
    code = 0
    try:
        main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    # As the interpreter ends, but for taking down what it inherited, which takes longer than a capture.
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def note_end(path):
    """Note how many calls there were."""
    Path(path).write_text(str(ctypes.CDLL(None).crash_calls()), encoding="utf-8")


if __name__ == "__main__":
    serve()
