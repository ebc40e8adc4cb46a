"""Where a user's own files are kept."""

import os
from pathlib import Path

USER_EFFECTS = "TCBI_EFFECTS"  # environment variable: the folder with the user's own effects
USER_RIGS = "TCBI_RIGS"  # environment variable: the folder with the user's own rigs


def default_root() -> Path:
    """Where everything is kept unless the user says otherwise."""
    given = os.environ.get("TCBI_STORE")
    return Path(given) if given else Path.home() / ".local" / "share" / "tcbi"


def effects_folder() -> Path:
    """The folder with the user's own effects: TCBI_EFFECTS, else `effects` in the store."""
    given = os.environ.get(USER_EFFECTS)
    return Path(given).expanduser() if given else default_root().expanduser() / "effects"


def rigs_folder() -> Path:
    """The folder with the user's own rigs: TCBI_RIGS, else `rigs` in the store."""
    given = os.environ.get(USER_RIGS)
    return Path(given).expanduser() if given else default_root().expanduser() / "rigs"
