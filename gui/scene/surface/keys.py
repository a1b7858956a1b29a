"""What the keys of a scene are called, what they mean and what they may be."""

from __future__ import annotations

from config.interpolations import INTERPOLATIONS
from gui.scene.form import TINY, Key

_PLACE = "on the surface, x right and y up from its centre"

PATH_KEYS: dict[str, tuple[Key, ...]] = {
    "point": (Key("at_mm", "At", f"Where it stands {_PLACE}", "place"),),
    "line": (
        Key("start_mm", "Start", f"Where it starts {_PLACE}", "place"),
        Key("end_mm", "End", f"Where it ends {_PLACE}", "place"),
    ),
    "circle": (
        Key("centre_mm", "Centre", f"Of the circle, {_PLACE}", "place"),
        Key("radius_mm", "Radius", "Of the circle", unit="mm", low=0.0),
        Key("turns", "Turns", "How often round; below 0 clockwise", unit="turns", step=0.25),
        Key("start_deg", "Start", "Direction of the start from the centre, anticlockwise from x", unit="°", step=5.0),
    ),
    "polyline": (Key("closed", "Closed", "Whether a last line leads back to the first point", "switch"),),
    "text": (
        Key("string", "Text", "What is written, in letters and signs of DejaVu Sans", "text"),
        Key("height_mm", "Height", "Of the letters drawn, from lowest to highest", unit="mm", low=TINY),
        Key("centre_mm", "Centre", f"Of the text, {_PLACE}", "place"),
    ),
    "svg": (
        Key("scale", "Scale", "Size of a unit of the drawing", unit="mm", low=TINY, step=0.05),
        Key("origin_mm", "Origin", f"Where the drawing's (0, 0) lies {_PLACE}", "place"),
    ),
}
SIGNAL_KEYS: dict[str, tuple[Key, ...]] = {
    "impulse": (),
    "sine": (
        Key("frequency_hz", "Frequency", "Of the sine, below half the bank's rate", unit="Hz", low=TINY, step=10.0),
        Key("duration_s", "Lasts", "How long the sine is", unit="s", low=TINY, step=0.01),
    ),
    "noise": (
        Key("band_hz", "Band", "Of the noise, up to half the bank's rate", "band", unit="Hz", low=0.0, step=10.0),
        Key("duration_s", "Lasts", "How long the noise is", unit="s", low=TINY, step=0.005),
        Key("seed", "Seed", "The same seed gives the same noise everywhere", "whole", low=0.0),
    ),
    "file": (),
}
MOTION_KEYS = (
    Key("start_s", "Starts at", "When it starts, from the scene's start", unit="s", low=0.0, step=0.1),
    Key("speed_mm_s", "Speed", "How fast it moves along its path", unit="mm/s", low=TINY, step=5.0),
    Key("step_mm", "Step", "Distance d of the path's samples; one is emitted every d / v", unit="mm", low=TINY,
        step=0.5),
    Key("amplitude", "Amplitude", "Times the signal; where the scene normalises, what an impulse makes at the focus",
        step=0.1),
    Key("emission", "Emission", "Whether the signal runs on along the path, or every path point emits all of it",
        "choice", choices=(("continuous", "on along the path"), ("per_point", "anew at each point"))),
)  # fmt: skip
SCENE_KEYS = (Key("name", "Name", "For pictures and reports", "text"),)
REGULARISATION_KEYS = (
    Key("normalise", "Normalise", "An impulse makes the same at every focus (eq. 15); else it depends on the place",
        "switch"),
)  # fmt: skip
OUTPUT_KEYS = (
    Key("interpolation", "Between positions", "How Green's functions between the bank's positions are found", "choice",
        choices=tuple((kind, kind) for kind in INTERPOLATIONS)),
    Key("limit_v", "Peak limit", "Largest drive of any actuator; beyond it all drives are scaled down together",
        "optional", unit="V", low=TINY, step=0.1),
    Key("limit_rms_v", "Rms limit", "Largest rms of any actuator's drive over any second; likewise", "optional",
        unit="V", low=TINY, step=0.05),
)  # fmt: skip
