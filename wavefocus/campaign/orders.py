"""Orders to a running capture: a small file beside its bank, so that any terminal on any system can give them."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from wavefocus.campaign.sidecar_files import read_whole, write_whole

WORDS = ("pause", "go-on", "stop")


@dataclass(frozen=True, slots=True)
class Order:
    """One order.

    Parameters
    ----------
    word : str
        One of `WORDS`.
    number : str
        What the capture repeats in its heartbeat, so that the order is known to have been heard.
    """

    word: str
    number: str


def orders_path(bank: Path) -> Path:
    """Where orders for a bank's capture are laid: ``plate.h5`` -> ``plate.h5.orders``."""
    return bank.with_name(bank.name + ".orders")


def give_order(bank: Path, word: str) -> Order:
    """Lay an order; one that was not yet taken is replaced.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    order = Order(word, uuid.uuid4().hex)
    write_whole(orders_path(bank), {"order": order.word, "number": order.number}, by_many=True)
    return order


def take_order(bank: Path) -> Order | None:
    """Take the order that is there, if any; what is no order is taken away too.

    Raises
    ------
    OSError
        It cannot be taken away.
    """
    path = orders_path(bank)
    if not path.exists():
        return None
    found = _taken(path)
    word, number = found.get("order"), found.get("number")
    return Order(word, number) if isinstance(word, str) and word in WORDS and isinstance(number, str) else None


def withdraw(bank: Path, order: Order) -> None:
    """Take an order back that nobody took."""
    path = orders_path(bank)
    found = read_whole(path)
    if found is not None and found.get("number") == order.number:
        taken = _taken(path)
        if taken.get("number") not in (None, order.number):  # another one was laid in its place meanwhile
            write_whole(path, taken, by_many=True)


def _taken(path: Path) -> Mapping[str, object]:
    """Take a file away and return what it held; one that is laid meanwhile stays for the next call."""
    own = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        path.rename(own)
    except FileNotFoundError:
        return {}
    try:
        return read_whole(own) or {}
    finally:
        own.unlink(missing_ok=True)
