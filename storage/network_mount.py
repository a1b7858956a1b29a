"""Is a path on a network drive, where locks and syncs cannot be relied on."""

from __future__ import annotations

from pathlib import Path

_NETWORK_TYPES = frozenset(
    [
        "9p",
        "afs",
        "beegfs",
        "ceph",
        "cifs",
        "davfs",
        "fuse.ceph",
        "fuse.davfs",
        "fuse.glusterfs",
        "fuse.rclone",
        "fuse.sshfs",
        "glusterfs",
        "lustre",
        "ncpfs",
        "nfs",
        "nfs4",
        "smb3",
        "smbfs",
        "virtiofs",
    ]
)


def is_network_mount(path: Path) -> bool:
    """Tell whether a path lies on a network drive; False where there is no ``/proc/mounts``."""
    mounts = Path("/proc/mounts")
    return mounts.exists() and is_network_mount_in(mounts.read_text(), path.absolute())


def is_network_mount_in(mounts: str, path: Path) -> bool:
    """As :func:`is_network_mount`, for a table in the form of ``/proc/mounts`` (fstab(5))."""
    best, kind = -1, ""
    for line in mounts.splitlines():
        fields = line.split()
        if len(fields) < 3:
            continue
        folder = Path(fields[1].replace("\\040", " "))
        if path.is_relative_to(folder) and len(folder.parts) >= best:
            best, kind = len(folder.parts), fields[2]
    return kind in _NETWORK_TYPES
