"""`python3 -m tcbi_setup`: brings the checkout into the state that `./tcbi` needs; run by it, one at a time."""

import fcntl
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tcbi_setup import environment, workspace
from tcbi_setup.layout import LOG, STATE, SetupError, read, write
from tcbi_setup.progress import say


def main() -> int:
    """Set up what is missing; 0 when all of it is there. SIGTERM and the end of the terminal count as Ctrl-C."""
    os.environ.pop("PYTHONSAFEPATH", None)  # against what lies in the folder of the call; the build has its own ways
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as below nohup
            signal.signal(number, signal.default_int_handler)
    try:
        with one_at_a_time():
            set_up(os.environ.get("TCBI_FINGERPRINT", ""))
    except KeyboardInterrupt:
        say("set-up interrupted; the next call goes on from here")
        return 130
    except SetupError as e:
        say(str(e))
        return 1
    except OSError as e:
        say(f"set-up failed: {e}; mend this and call again (log: {LOG})")
        return 1
    return 0


def set_up(fingerprint: str) -> None:
    """All steps; each is skipped if it is complete. The stamp comes last; until then an earlier one counts no more."""
    began = time.monotonic()
    torch = environment.wanted_torch()
    if not (STATE / "stamp").exists():
        say("first use: setting up inside this folder, some two minutes (a second call finds it ready)")
    (STATE / "stamp").unlink(missing_ok=True)
    made = environment.key(torch)
    if read(STATE / "environment") != made:
        say("[1/2] Python packages and ROS wheels")
    environment.install(torch)
    names = [package.name for package in workspace.outdated(made)]
    if names:
        say(f"[2/2] building {', '.join(names)}")
    workspace.build(made)
    write(STATE / "stamp", f"{fingerprint}\n{torch}\n")
    if time.monotonic() - began > 1:
        say(f"ready after {time.monotonic() - began:.0f} s")


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """Hold the set-up's lock, waiting for another call that holds it, or whose programs go on after it was killed."""
    STATE.mkdir(parents=True, exist_ok=True)
    with (STATE / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another call is setting up: waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        os.set_inheritable(lock.fileno(), True)
        yield


if __name__ == "__main__":
    sys.exit(main())
