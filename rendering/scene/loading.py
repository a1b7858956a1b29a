"""From a scene file to the scene that rendering works on."""

from __future__ import annotations

from pathlib import Path

from config.loading import named_file, parse_toml, printable, read_toml, validated
from config.scene import (
    CircleTable,
    FileTable,
    ImpulseTable,
    LineTable,
    NoiseTable,
    PathTable,
    PointTable,
    PolylineTable,
    SceneConfig,
    SignalTable,
    SineTable,
    SvgTable,
    TextTable,
)
from rendering.scene import paths, signals
from rendering.scene.model import Scene, Source
from rendering.scene.paths import TextPath
from rendering.scene.svg import SvgPath
from storage.errors import InputError


def load_scene(path: str | Path, *, allow_large: bool = False) -> Scene:
    """Read a scene file with all that it names.

    Raises InputError: anything in the files is wrong.
    """
    file = Path(path)
    return build_scene(validated(SceneConfig, read_toml(file), str(file)), file, allow_large=allow_large)


def read_scene(text: str, path: Path, *, allow_large: bool = False) -> Scene:
    """Make the scene of a text, as `load_scene` would of a file of that text.

    Raises InputError: anything in the text or in the files that it names is wrong.
    """
    return build_scene(validated(SceneConfig, parse_toml(text, str(path)), str(path)), path, allow_large=allow_large)


def build_scene(config: SceneConfig, file: Path, *, allow_large: bool = False) -> Scene:
    """Make the scene of a validated scene file.

    Raises InputError: a file that the scene names is missing or cannot be understood.
    """
    built = []
    for index, table in enumerate(config.source):
        key = f"source[{index}]"
        try:
            built.append(
                Source(
                    path=_path(table.path, file, f"{key}.path", allow_large=allow_large),
                    signal=_signal(table.signal, file, f"{key}.signal"),
                    start_s=table.start_s,
                    speed_mm_s=table.speed_mm_s or 0.0,
                    step_mm=table.step_mm or 0.0,
                    amplitude=table.amplitude,
                    emission=table.emission,
                )
            )
        except InputError as error:
            text = str(error)
            raise InputError(printable(text if text.startswith(str(file)) else f"{file}: {key}: {text}")) from None
    return Scene(
        name=config.scene.name,
        sources=tuple(built),
        regularisation=config.regularisation,
        output=config.output,
        allow_large=allow_large,
    )


def _path(table: PathTable, file: Path, key: str, *, allow_large: bool) -> paths.Path:
    match table:
        case PointTable():
            return paths.Point(table.at_mm)
        case LineTable():
            return paths.Line(table.start_mm, table.end_mm)
        case CircleTable():
            return paths.Circle(table.centre_mm, table.radius_mm, table.turns, table.start_deg)
        case PolylineTable():
            return paths.Polyline(table.points_mm, table.closed)
        case SvgTable():
            drawing = named_file(file, f"{key}.file", table.file)
            return SvgPath(drawing, table.path_id, table.scale, table.origin_mm, allow_large)
        case TextTable():
            return TextPath(table.string, table.height_mm, table.centre_mm, allow_large)


def _signal(table: SignalTable, file: Path, key: str) -> signals.Signal:
    match table:
        case ImpulseTable():
            return signals.Impulse()
        case SineTable():
            return signals.Sine(table.frequency_hz, table.duration_s)
        case NoiseTable():
            return signals.Noise(table.band_hz, table.duration_s, table.seed)
        case FileTable():
            return signals.SoundFile(named_file(file, f"{key}.path", table.path))
