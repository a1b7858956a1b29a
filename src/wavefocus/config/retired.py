"""Commands, options and keys of earlier versions that are gone, and what serves instead."""

from collections.abc import Sequence

_SHELL = "a shell carries out commands one after the other, see docs/how-to/several-runs.md"
_CHOSEN = "choose the schedule in [capture]; capture measures one position both ways and states the difference"

COMMANDS = {
    "publish": "wavefocus export writes a bank for others; docs/how-to/publish.md lists what to upload",
    "queue": _SHELL,
    "go-on": "wavefocus resume lets a paused capture go on",
    "service": "the system's own scheduler starts wavefocus resume, see docs/how-to/several-runs.md",
    "bench choose": "wavefocus bench render and bench estimate show error against run time",
    "bench symptoms": "wavefocus verify names the causes that it measures",
}
OPTIONS = {
    "--documents": "BANK.events.jsonl next to the bank has every event of a session",
    "--focusing": "quiet places keep the response low where a scene asks for it",
    "--regularisation-db": "quiet places keep the response low where a scene asks for it",
    "--spectra": "predict a field of a few positions, and transform it",
    "--stream": "render always writes block by block",
    "--pilot": "choose [grid] spacing_mm, and check_positions to measure the error between positions",
    "--pilot-positions": "choose [grid] spacing_mm, and check_positions to measure the error between positions",
    "--binary": "give --to uff-binary",
    "--per": "give --to wav-actuator",
    "--convention": "give --to sofa-room",
    "--list": "export prints how much it leaves out, and --json the facts of what it wrote",
    "--wait-s": "pause, stop and resume wait up to 15 s for the capture",
    "--plate": "demo --quick has a plate without a rim, bench measures all plates",
    "--frame-rate-hz": "movies have 25 frames a second, and --slow says how slow they are",
    "--limit": "colours reach to what is seen at the foci",
    "--sample-rate-hz": "calibrate records at 10 kHz",
    "--workers": "all processors are used; --cluster local:N starts N processes",
    "--watched": "give --lines",
    "--no-checks": "the positions that verify looks at are measured with those of a scene",
    "--wave-speed": "plan takes that of a gel, 4.8 m/s",
    "--plot": "the window's Campaign page draws the drift, and BANK.drift.jsonl holds it",
    "--most-gib": "set the environment variable WAVEFOCUS_MOST_GIB",
    "--traceback": "a defect's line names the log that holds it; or set the environment variable WAVEFOCUS_TRACEBACK=1",
    **dict.fromkeys(
        ("play --bank", "play --method", "play --tolerance-db"), "render the scene, and play the drive file"
    ),
    "--picture": "the window's Scene page shows the scene on the surface",
    "--control": "a correction is judged at the foci and quiet places of its scene",
    "--against": "verify.json of both verifications has their figures, and the symptoms of each against the bank",
    "--allow-large": "a scene may have 8 GiB of drives and a million path points; split a larger one",
    "import --end": "responses are kept as they are; fade or damp them before the import",
    "extend --accept-drift": "wavefocus resume takes it for the new bank",
    "extend --accept-calibration": "wavefocus resume takes it for the new bank",
    "status --force": "status writes nothing",
    "--ahead-s": "2 s are handed over before a drive sounds",
    "--distance-mm": "actuators are listened to at a fifth of the surface's width",
    "--box-gain": "give it to --summing-box",
    "--width-px": "movies are 720 px wide",
    "--no-sentinel": "verify measures the bank's sentinel position first",
    "--interpolation-tolerance": "an error above 5 % is warned of, and --json states it",
    "--block-ms": "a block lasts 5 ms",
    "--coarse": "write [grid] spacing_mm = 10 in run.toml for a grid that is measured in minutes",
}
KEYS = {
    "refine_to": "choose spacing_mm; check_positions measures the error between positions",
    "refine_positions": "choose spacing_mm; wavefocus extend adds positions to a bank",
    "response_error": "the response at the focus is that of time reversal",
    "when_staggered_does_not_pay": _CHOSEN,
    "allowed_loss_db": _CHOSEN,
    "x_position": "take settle_s from the mirror's data sheet",
    "y_position": "take settle_s from the mirror's data sheet",
}


def refused(word: str, instead: str) -> str:
    """The sentence that refuses a word of an earlier version."""
    return f"{word} is gone: {instead}"


def retired_command(words: Sequence[str]) -> str:
    """The sentence about a command line that begins with a command of an earlier version; else an empty text."""
    for name in (" ".join(words[:2]), *words[:1]):
        if name in COMMANDS:
            return refused(name, COMMANDS[name])
    return ""
