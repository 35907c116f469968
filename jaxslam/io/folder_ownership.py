"""Check that a folder belongs to the user alone, so that its files are safe to execute."""

import os
import stat
from pathlib import Path

OWN_MODE = 0o755
"""Permissions for a new folder that `why_not_own` accepts under every umask."""


def why_not_own(folder: Path) -> str | None:
    """Explain why other users may have written to a folder, as the end of a sentence; `None` if no other user can.

    Raises:
        OSError: If the folder is missing or cannot be read.
    """
    found = folder.stat()
    if found.st_uid != os.geteuid():
        return f"it belongs to user {found.st_uid}, not to you"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"other users may write to it; chmod go-w '{folder}' changes that, after a look at what is in it"
    return None
