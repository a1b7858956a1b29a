"""Text that is safe to show: names from files and devices may hold characters that control a terminal."""

from __future__ import annotations

import unicodedata

# Control, format (bidirectional overrides among them), surrogate, line and paragraph separator.
_UNSAFE = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
_LONGEST = 900


def escaped(text: str) -> str:
    r"""Return a text with control and bidirectional characters as escapes (``\x1b``); line ends and tabs stay."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escape(one) if unicodedata.category(one) in _UNSAFE and one not in "\n\t" else one for one in text)


def one_line(text: str, longest: int = _LONGEST) -> str:
    """A message as one escaped line of bounded length: what is too long loses its middle.

    Parameters
    ----------
    text : str
        The message.
    longest : int
        Most characters, at least 20.
    """
    line = escaped(" ".join(text.split()))
    if len(line) <= longest:
        return line
    head = longest // 2
    tail = longest - head - 5
    return f"{line[:head]} ... {line[-tail:]}"


def _escape(one: str) -> str:
    code = ord(one)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
