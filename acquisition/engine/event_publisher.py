"""Events to their subscribers; one that fails does not end the campaign."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from acquisition.engine.events import Event, Subscriber

LOG = logging.getLogger(__name__)


class EventPublisher:
    """Calls every subscriber with every event; the first failure of each is reported, and the others go on.

    A subscriber that failed gets the later events too: what failed may pass, as a full disk does.

    Parameters
    ----------
    subscribers : mapping from str to callable
        By the name under which a failure is reported.
    report : callable
        Receives one sentence about the first failure of a subscriber; by default it goes to Python's log.
    """

    def __init__(self, subscribers: Mapping[str, Subscriber], report: Callable[[str], object] = LOG.error) -> None:
        self._subscribers = dict(subscribers)
        self._report = report
        self._failed: set[str] = set()

    def __call__(self, event: Event) -> None:
        """Publish one event. Ctrl-C and the like pass through."""
        for name, subscriber in self._subscribers.items():
            try:
                subscriber(event)
            except Exception as failure:
                if name not in self._failed:
                    self._failed.add(name)
                    what = " ".join(str(failure).split())
                    self._report(f"{name} failed ({type(failure).__name__}: {what}); the campaign goes on")
