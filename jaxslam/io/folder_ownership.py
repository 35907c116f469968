"""Whether a folder is the user's own, so that what lies in it can be run."""

import os
import stat
from pathlib import Path

OWN_MODE = 0o755
"""Permissions of a folder to make that `why_not_own` accepts, whatever the umask is."""


def why_not_own(folder: Path) -> str | None:
    """Why others than the user may have put files into a folder, as the end of a sentence; `None` if nobody can have.

    Raises:
        OSError: If the folder is not there or cannot be looked at.
    """
    found = folder.stat()
    if found.st_uid != os.geteuid():
        return f"it belongs to user {found.st_uid}, not to you"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"other users may write to it; chmod go-w '{folder}' changes that, after a look at what is in it"
    return None
