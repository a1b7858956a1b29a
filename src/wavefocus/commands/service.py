"""``wavefocus service``: the system carries on with a run by itself."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from wavefocus.acquisition.run_queue import read_queue
from wavefocus.campaign.blueprint import blueprint_from_bank, blueprint_with_rig
from wavefocus.console import answer, say
from wavefocus.rig.user_service import user_service
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import require_outputs, write_whole


def install(what: Path, rig_file: Path | None = None, *, force: bool, as_json: bool) -> None:
    """Write a user service that carries on with a queue or a campaign after a reboot.

    Raises InputError: it is neither, or the service exists and may not be replaced.
    """
    what = what.absolute()
    words = ["queue", "run", str(what)]
    if what.suffix.lower() == ".h5":
        words = ["resume", str(what)]
        if rig_file is None:
            blueprint_from_bank(what)
        else:
            blueprint_with_rig(what, rig_file)
            words += ["--rig", str(rig_file.absolute())]
    elif rig_file is not None:
        raise InputError("--rig: is for a bank; the runs of a queue name their rigs")
    else:
        read_queue(what)
    command = [sys.executable, "-m", "wavefocus", *words]
    service = user_service(sys.platform, what.stem.removesuffix(".queue"), command, what.parent, Path.home())
    service.file.parent.mkdir(parents=True, exist_ok=True)
    require_outputs([service.file], [what, rig_file], force=force)
    write_whole(service.file, service.content)
    say(f"{service.file} is written; switch it on with:")
    if as_json:
        print(json.dumps({"file": str(service.file), "command": command, "next": list(service.next_commands)}))
        return
    for line in service.next_commands:
        answer(line)
