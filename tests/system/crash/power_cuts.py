"""What a disk may hold after the power went: rebuilt from a log of calls.

What was synced is there. Of what was not, any part may be: each sector of each write as it was, as it was to be, or,
where it was just being written, as garbage; each name of a file made, moved or removed, or not.
"""

import hashlib
import itertools
import struct
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import ClassVar, NamedTuple

from wavefocus.storage.durable import PositionedFile

SECTOR, PAGE = 512, 4096
_ENTRY = struct.Struct("<IIIIQQ")


class Kind(IntEnum):
    """Kinds of calls, as `calls.c` knows them."""

    WRITE = 1
    SYNC = 2
    RESIZE = 3
    RESERVE = 4
    LINK = 5
    RENAME = 6
    UNLINK = 7
    MKDIR = 8
    RMDIR = 9
    CREATE = 10


class Call(NamedTuple):
    """One call of the log: `offset` is the new size of a `RESIZE` or `RESERVE`."""

    kind: Kind
    path: str
    other: str
    offset: int
    inode: int
    data: bytes


def read_log(path):
    """Read the log that a process was told to keep; a process killed while logging leaves a torn end."""
    content, at, calls = path.read_bytes(), 0, []
    while at + _ENTRY.size <= len(content):
        kind, size, other_size, data_size, offset, inode = _ENTRY.unpack_from(content, at)
        at += _ENTRY.size
        end = at + size + other_size + data_size
        if end > len(content):
            break
        name, other = content[at : at + size].decode(), content[at + size : at + size + other_size].decode()
        calls.append(Call(Kind(kind), name, other, offset, inode, content[end - data_size : end]))
        at = end
    return calls


@dataclass(slots=True)
class _File:
    synced: bytearray = field(default_factory=bytearray)
    flying: list[Call] = field(default_factory=list)


class Image(NamedTuple):
    """What the disk holds: `files` by path, and `folders`; `step` calls had returned when the power went."""

    step: int
    files: dict[str, bytes]
    folders: frozenset[str]

    def digest(self):
        """Tell images apart."""
        return self.folders, *(
            (name, len(one), hashlib.sha256(one).digest()) for name, one in sorted(self.files.items())
        )


class Disk:
    """A disk that takes calls one by one and may lose power at any.

    before: What lies there, on the disk for good, before the first call: bytes by path, None for a folder.
    inodes: The number that the log has for each of them.
    """

    def __init__(self, before, inodes):
        self._files = {inodes[path]: _File(bytearray(one)) for path, one in before.items() if one is not None}
        self._names = {str(path): None if one is None else inodes[path] for path, one in before.items()}
        self._flying_names = []

    def take(self, call):
        """Let a call happen."""
        if call.kind is Kind.SYNC:
            self._sync(call)
            return
        if call.kind is Kind.CREATE and call.path not in _named(self._names, self._flying_names):
            self._files[call.inode] = _File()  # numbers of removed files are given to new ones
        elif call.kind is Kind.CREATE and call.offset:  # it was opened to be written anew
            self._flies(call._replace(kind=Kind.RESIZE, offset=0))
        if call.kind in (Kind.WRITE, Kind.RESIZE, Kind.RESERVE):
            self._flies(call)
        else:
            self._flying_names.append(call)

    def _flies(self, call):
        self._files.setdefault(call.inode, _File()).flying.append(call)

    def _sync(self, call):
        if call.inode in self._files:
            file = self._files[call.inode]
            for one in file.flying:
                _apply(file.synced, one)
            file.flying.clear()
            return
        here = [one for one in self._flying_names if str(Path(one.other or one.path).parent) == call.path]
        self._names = _named(self._names, here)
        self._flying_names = [one for one in self._flying_names if one not in here]

    def cut(self, step, chance, last, torn, subset):
        """Lose power after `step` calls, `torn` bytes of the write `last` done; negative: and garbage after them.

        Of what had returned and was not synced, ``"all"``, ``"none"`` or ``"some"`` is there.
        """
        names = [one for one in self._flying_names if subset == "all" or (subset == "some" and chance.random() < 0.5)]
        contents = {inode: self._content(file, chance, subset) for inode, file in self._files.items()}
        if last is not None and last.inode in contents:
            _tear(contents[last.inode], last, torn, chance)
        found = _named(self._names, names)
        files = {name: bytes(contents[inode]) for name, inode in found.items() if inode is not None}
        return Image(step, files, frozenset(name for name, inode in found.items() if inode is None))

    def _content(self, file, chance, subset):
        content = bytearray(file.synced)
        if subset == "none":
            return content
        for call in file.flying:
            if subset == "all":
                _apply(content, call)
            elif call.kind is Kind.WRITE:
                for start in range(0, len(call.data), SECTOR):
                    if chance.random() < 0.5:
                        _put(content, call.offset + start, call.data[start : start + SECTOR])
            elif chance.random() < 0.5:
                _apply(content, call)
        return content


def images(disk, log, chance, subsets, drawn_from=0, count=None):
    """Every cut that is worth a look in what was done to a disk, or `count` of them; each image once.

    Of what was not synced `subsets` are drawn at random for each call, from the call `drawn_from` on.
    """
    places, seen, taken = list(_places(log, chance, subsets, drawn_from)), set(), 0
    for step, subset, torn in evenly(places, len(places), count or len(places)):
        for call in log[taken:step]:
            disk.take(call)
        taken = step
        last = log[step] if step < len(log) and log[step].kind is Kind.WRITE else None
        image = disk.cut(step, chance, last, torn, subset)
        if (digest := image.digest()) not in seen:
            seen.add(digest)
            yield image


def _places(log, chance, subsets, drawn_from):
    """Where the power may go: after how many calls, what is left, and how much is done of the write on its way."""
    for step, call in enumerate(log):
        size = len(call.data)
        tears = {min(size, cut) for cut in (0, SECTOR, PAGE, PAGE + SECTOR, size // 2, size)}
        for subset, torn in itertools.product(("all", "none"), sorted(tears) if call.kind is Kind.WRITE else [0]):
            yield step, subset, torn
            if torn < size:
                yield step, subset, -torn - 1
        for _ in range(subsets if step >= drawn_from else 0):
            torn = int(chance.integers(0, size + 1)) // SECTOR * SECTOR
            yield step, "some", -torn - 1 if chance.random() < 0.5 else torn
    yield from ((len(log), subset, 0) for subset in ("all", "none", *["some"] * subsets))


def evenly(found, total, count):
    """Choose about `count` of `total` things, evenly from the first to the last."""
    for place, one in enumerate(found):
        if not place or count >= total or place * count // total != (place - 1) * count // total:
            yield one


class Share(NamedTuple):
    """A part, counted from 0, of so many faults of a kind."""

    count: int
    part: int = 0
    parts: int = 1

    def of(self, found, total):
        """Choose this part of about `count` of `total` things, evenly from the first to the last."""
        return itertools.islice(evenly(found, total, self.count), self.part, None, self.parts)


def _tear(content, call, torn, chance):
    kept = -torn - 1 if torn < 0 else torn
    _put(content, call.offset, call.data[:kept])
    if torn < 0:
        _put(content, call.offset + kept, chance.bytes(min(SECTOR, len(call.data) - kept)))


def _put(content, offset, data):
    if len(content) < offset + len(data):
        content.extend(bytes(offset + len(data) - len(content)))
    content[offset : offset + len(data)] = data


def _apply(content, call):
    if call.kind is Kind.WRITE:
        _put(content, call.offset, call.data)
    elif len(content) < call.offset:
        content.extend(bytes(call.offset - len(content)))
    elif call.kind is Kind.RESIZE:
        del content[call.offset :]


def _named(names, calls):
    """Names after some calls; what had no ground to happen on did not happen."""
    found = dict(names)
    for call in calls:
        if call.kind not in (Kind.MKDIR, Kind.CREATE, Kind.LINK):
            found.pop(call.path, None)
        if call.kind in (Kind.LINK, Kind.RENAME):
            found[call.other] = call.inode
        elif call.kind in (Kind.MKDIR, Kind.CREATE):
            found[call.path] = None if call.kind is Kind.MKDIR else call.inode

    def is_there(name):
        """A file in a folder that is not there is not there either."""
        parent = Path(name).parent
        return not parent.name.endswith(".partial") or found.get(str(parent), 0) is None

    return {name: inode for name, inode in found.items() if is_there(name)}


INODE = 1


class LoggedFile(PositionedFile):
    """A file of the program's own that notes its writes and barriers, without a library loaded before the program."""

    log: ClassVar[list[Call]] = []
    barriers: ClassVar[tuple[bool, bool]] = (True, True)
    """Which are kept: that between Green's functions and ledger row, and that after the row."""

    def __init__(self, path, *, write=False):
        super().__init__(path, write=write)
        self._name, self._syncs = str(path), 0

    def write(self, offset, data):
        LoggedFile.log.append(Call(Kind.WRITE, self._name, "", offset, INODE, bytes(data)))
        super().write(offset, data)

    def sync(self):
        if self.barriers[self._syncs % 2]:
            LoggedFile.log.append(Call(Kind.SYNC, self._name, "", 0, INODE, b""))
        self._syncs += 1


class WithoutFirstBarrier(LoggedFile):
    """Leaves out the barrier between Green's functions and ledger row."""

    barriers = (False, True)
