"""OSC 1.0 packets: bundles taken apart, and messages read strictly.

Source: The Open Sound Control 1.0 specification (Wright, 2002), sections "OSC Packets", "OSC Messages", "OSC Bundles".

Read here and not by python-osc (1.10): that package logs each unknown type tag to the root logger, and so to standard
error; pads a number that was cut off; and reads all messages of a bundle before one can be left out.
"""

import struct

BUNDLE = b"#bundle\0"
MAX_MESSAGES = 2000
"""Most messages of one datagram: the shortest position takes 40 bytes, a datagram at most 65,507."""
NUMBERS = {"i": ">i", "h": ">q", "f": ">f", "d": ">d"}
CONSTANTS = {"T": True, "F": False, "N": None, "I": None}


class OscError(ValueError):
    """A datagram is not an OSC packet, or a message of it has a type that is not known."""


def split(datagram: bytes) -> list[bytes]:
    """The messages of a packet, not yet read, in their order; bundles within bundles too.

    Raises OscError: a size does not fit, or there are more than `MAX_MESSAGES`.
    """
    messages: list[bytes] = []
    parts = [datagram]
    while parts:
        part = parts.pop()
        if not part.startswith(BUNDLE):
            messages.append(part)
            if len(messages) > MAX_MESSAGES:
                raise OscError(f"more than {MAX_MESSAGES} messages in one datagram")
            continue
        # Behind the bundle's name, and a time tag that is not waited for.
        at, elements = 16, []
        while at != len(part):
            size = struct.unpack_from(">i", part, at)[0] if at + 4 <= len(part) else -1
            if size <= 0 or size % 4 or at + 4 + size > len(part):
                raise OscError("an element of the bundle does not fit into it")
            elements.append(part[at + 4 : at + 4 + size])
            at += 4 + size
        parts += reversed(elements)
    return messages


def read(message: bytes) -> tuple[str, list[object]]:
    """Address and arguments of a message.

    Numbers, texts, blobs, True, False and Nil; arrays are lists. Raises OscError.
    """
    address, at = _text(message, 0)
    if not address.startswith("/") or len(message) % 4:
        raise OscError("not an OSC message")
    if at == len(message):
        return address, []  # without type tags, as older programs send it
    tags, at = _text(message, at)
    if not tags.startswith(","):
        raise OscError(f"{address}: its arguments have no type tags")
    lists: list[list[object]] = [[]]
    for tag in tags[1:]:
        value: object
        if tag == "[":
            lists.append([])
            continue
        if tag == "]":
            value = lists.pop()
            if not lists:
                raise OscError(f"{address}: an array ends that has not begun")
        elif tag in CONSTANTS:
            value = CONSTANTS[tag]
        elif tag in NUMBERS:
            form = NUMBERS[tag]
            end = at + struct.calcsize(form)
            if end > len(message):
                raise OscError(f"{address}: cut off within an argument")
            value, at = struct.unpack_from(form, message, at)[0], end
        elif tag in "sS":
            value, at = _text(message, at)
        elif tag == "b":
            size = struct.unpack_from(">i", message, at)[0] if at + 4 <= len(message) else -1
            if size < 0 or at + 4 + size > len(message):
                raise OscError(f"{address}: cut off within an argument")
            value, at = message[at + 4 : at + 4 + size], at + 4 + size + -size % 4
        else:
            raise OscError(
                f"{address}: arguments of the type {tag!r} are not known; allowed: i, h, f, d, s, b, T, F, N"
            )
        lists[-1].append(value)
    if len(lists) != 1 or at != len(message):
        raise OscError(f"{address}: {len(message)} bytes, and its type tags {tags!r} stand for {at}")
    return address, lists[0]


def _text(message: bytes, at: int) -> tuple[str, int]:
    """A text that ends in a zero and fills a multiple of four bytes, and where it ends."""
    zero = message.find(b"\0", at)
    end = zero + 4 - zero % 4
    if zero < 0 or end > len(message):
        raise OscError("not an OSC message: a text has no end")
    try:
        return message[at:zero].decode(), end
    except UnicodeDecodeError:
        raise OscError("not an OSC message: a text is not UTF-8") from None
