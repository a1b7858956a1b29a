"""Random single mutations of files, and whether one changes what h5py reads."""

import random

import h5py
import numpy as np


def snapshot(path):
    """All that h5py reads of a file, names and attributes included."""
    found: dict[str, object] = {}

    def note(name, item):
        for key in sorted(item.attrs):
            value = item.attrs[key]
            if key not in ("DIMENSION_LIST", "REFERENCE_LIST"):
                found[f"{name}@{key}"] = np.asarray(value).tobytes() if not isinstance(value, str) else value
        if isinstance(item, h5py.Dataset) and item.id.get_storage_size():
            values = item[...]
            whole = repr(values.tolist()) if values.dtype.kind == "O" else values.tobytes()
            found[name] = (item.shape, str(item.dtype), whole)

    with h5py.File(path, "r", locking=False) as file:
        note("/", file)
        file.visititems(note)
    return found


def stored_bytes(path):
    """Where values of datasets lie: (offset, size) of each piece."""
    extents: list[tuple[int, int]] = []

    def note(_, item):
        if not isinstance(item, h5py.Dataset) or not item.id.get_storage_size():
            return
        if item.chunks is None:
            extents.append((item.id.get_offset(), item.id.get_storage_size()))
        else:
            item.id.chunk_iter(lambda chunk: extents.append((chunk.byte_offset, chunk.size)))

    with h5py.File(path, "r") as file:
        file.visititems(note)
    return extents


def mutations(content, extents, count, seed):
    """Some mutated copies: in the values of any dataset, and anywhere in the first pages and the file."""
    rng = random.Random(seed)
    for _ in range(count):
        if rng.random() < 0.7:
            start, size = rng.choice(extents)
            at = start + rng.randrange(size)
        else:
            at = rng.randrange(min(len(content), rng.choice([4096, 1 << 16, len(content)])))
        kind = rng.choice(["flip", "byte", "zero page", "double", "swap"])
        if (changed := mutated(content, at, kind, rng)) != content:
            yield f"{kind} at {at}", changed


def mutated(content, at, kind, rng):
    """A copy with one change of a kind at a byte."""
    changed = bytearray(content)
    match kind:
        case "flip":
            changed[at] ^= 1 << rng.randrange(8)
        case "byte":
            changed[at] = rng.randrange(256)
        case "zero page":
            page = at // 4096 * 4096
            changed[page : page + 4096] = bytes(len(changed[page : page + 4096]))
        case "double":
            part = slice(at // 8 * 8, at // 8 * 8 + 8)
            changed[part] = rng.randbytes(len(changed[part]))
        case "swap":
            other = rng.randrange(len(content))
            changed[at], changed[other] = changed[other], changed[at]
        case "cut":
            del changed[at:]
        case "twice":
            changed[at:at] = changed[at : at + 100]
        case "digit":
            digits = [place for place in range(min(len(changed), 4096)) if 48 <= changed[place] < 58] or [at]
            changed[rng.choice(digits)] = rng.choice(b"0123456789-e.n ")
    return bytes(changed)
