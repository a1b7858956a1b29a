"""Whether the addresses of a rig file take messages, for the doctor."""

from __future__ import annotations

from collections.abc import Iterator

from acquisition.doctor.findings import Act, Finding
from config.rig import RigConfig
from storage.errors import InputError
from wavefocus.rig.messages import AppriseOutbox, addresses

REMEDY = "correct the address, or look whether its server can be reached from here"
EDIT = Act("edit-rig", "messages.urls")


def message_findings(rig: RigConfig, name: str, *, send: bool) -> Iterator[Finding]:
    """Look at the addresses of a rig file, and send a message to each if asked to; addresses are never told.

    Parameters
    ----------
    rig : RigConfig
        The rig.
    name : str
        Its file, for the message.
    send : bool
        Whether to send.
    """
    urls = addresses(rig.messages)
    if not urls:
        if send:
            yield Finding(
                "messages", "addresses", "fail", "there are none", "write messages.urls into the rig file", EDIT
            )
        return
    if not send:
        try:
            AppriseOutbox(urls)
        except InputError as wrong:
            yield Finding("messages", "addresses", "fail", str(wrong), "correct it", EDIT)
            return
        what = f"{len(urls)} known, none tried"
        yield Finding("messages", "addresses", "ok", what, "--test-message sends one to each", Act("test-message"))
        return
    for number, url in enumerate(urls):
        kind = url.partition("://")[0][:20]
        try:
            refused = AppriseOutbox([url]).send(f"{name}: test", "A test message of wavefocus doctor.")
        except InputError as wrong:
            yield Finding("messages", f"address {number}", "fail", str(wrong).partition(": ")[2], "correct it", EDIT)
            continue
        if refused:
            yield Finding("messages", f"address {number}", "fail", f"{kind}: took no message", REMEDY, EDIT)
        else:
            yield Finding("messages", f"address {number}", "ok", f"{kind}: took a message")
