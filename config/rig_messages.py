"""Whom a campaign tells how the night went."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from config.fields import NonNegative, Table, Text

About = Literal["finished", "failed", "stopped", "suspended", "drift"]
ABOUT: tuple[About, ...] = ("finished", "failed", "suspended", "drift")


class MessagesSection(Table):
    """Addresses, as apprise has them, and what they are told about.

    The addresses are secrets: they are left out wherever a rig is written, so a bank never holds them.
    """

    urls: Annotated[tuple[Text, ...], Field(max_length=64, exclude=True, repr=False)] = ()
    about: tuple[About, ...] = ABOUT
    suspended_after_min: Annotated[NonNegative, Field(le=10_000)] = 10.0
