"""Settings that are kept between sessions."""

from __future__ import annotations

from pathlib import Path

from PyQt5.QtCore import QByteArray, QSettings

_MOST_RECENT = 10


class Settings:
    """Geometry, folders, recent files and choices, in the system's store; tests pass another one."""

    def __init__(self, settings: QSettings | None = None) -> None:
        self._settings = settings or QSettings("wavefocus", "wavefocus")

    def text(self, key: str, default: str = "") -> str:
        value = self._settings.value(key, default)
        return value if isinstance(value, str) else default

    def whole(self, key: str, default: int) -> int:
        try:
            return int(self.text(key, str(default)))
        except ValueError:
            return default

    def bytes(self, key: str) -> QByteArray:
        """A remembered geometry; empty when there is none."""
        value = self._settings.value(key)
        return value if isinstance(value, QByteArray) else QByteArray()

    def keep(self, key: str, value: str | int | QByteArray) -> None:
        self._settings.setValue(key, str(value) if isinstance(value, int) else value)

    def folder(self, kind: str, beside: Path | None = None) -> Path:
        """The folder where a file of a kind was last chosen; at first that of the file it is made from, if any."""
        found = Path(self.text(f"folder/{kind}") or (beside.parent if beside is not None else "."))
        return found if found.is_dir() else Path.cwd()

    def recent(self) -> list[Path]:
        """Files opened last, the latest first."""
        return [Path(line) for line in self.text("recent").split("\n") if line]

    def opened(self, path: Path) -> None:
        """Remember that a file was opened, and where."""
        path = path.absolute()
        others = [one for one in self.recent() if one != path]
        self.keep("recent", "\n".join(str(one) for one in [path, *others][:_MOST_RECENT]))
        self.keep(f"folder/{path.suffix}", str(path.parent))

    def forget_recent(self) -> None:
        self.keep("recent", "")
