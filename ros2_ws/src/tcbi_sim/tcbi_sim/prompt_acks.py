"""Have the middleware ask for acknowledgements every 5 ms instead of every 3 s: waiting for listeners is short then."""

import logging
import os
import tempfile
from pathlib import Path

from tcbi_contract.files import replace_file

log = logging.getLogger(__name__)
VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com">
  <data_writer profile_name="prompt" is_default_profile="true">
    <times>
      <heartbeatPeriod><nanosec>5000000</nanosec></heartbeatPeriod>
      <nackResponseDelay><nanosec>1000000</nanosec></nackResponseDelay>
    </times>
  </data_writer>
</profiles>
"""


def ask_for_prompt_acks() -> None:
    """Set Fast DDS's default profile for this process; call it before rclpy starts. A user's own profile stays.

    Where the file cannot be written it goes on without, with a line in the log.
    """
    if VARIABLE in os.environ or "FASTDDS_DEFAULT_PROFILES_FILE" in os.environ:
        return
    try:
        os.environ[VARIABLE] = str(_written())
    except OSError as e:
        log.warning(
            "tcbi: waiting for listeners takes longer, for the middleware's profile cannot be written: %s; "
            "free space, or name another folder in TMPDIR",
            e,
        )


def _written() -> Path:
    """The file with the profile."""
    path = Path(tempfile.gettempdir()) / f"tcbi-{os.getuid()}-prompt-acks.xml"
    if not path.is_file() or path.read_bytes() != PROFILE.encode():
        replace_file(path, PROFILE)
    return path
