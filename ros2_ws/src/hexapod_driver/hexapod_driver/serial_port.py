"""Opening a serial port for this process alone, and errors that say what to do."""

import errno
import grp
import os
import select
import termios
import time

import serial

from hexapod_driver.errors import LinkLost, PortError

WRITE_TIMEOUT_S = 0.2
BAUD_RATE, SENSOR_BAUD_RATE = 1_000_000, 921_600  # bit/s, unless a user says otherwise


def _remedy(code: int | None, path: str) -> str:
    if code == errno.ENOENT:
        return "port {path} does not exist; plug the robot in, or bind its Bluetooth port with `rfcomm bind`"
    if code in (errno.EBUSY, errno.EAGAIN):
        return "port {path} is busy: another program holds it; `fuser {path}` names it"
    if code in (errno.EACCES, errno.EPERM):
        join = f"sudo usermod -aG {_group(path)} $USER"
        return f"port {{path}}: no permission; join its group with `{join}` and log in again"
    if code in (errno.ENOTTY, errno.EINVAL, errno.EISDIR):
        return "port {path} is not a serial port"
    return "port {path} cannot be opened"


def _group(path: str) -> str:
    try:
        return grp.getgrgid(os.stat(path).st_gid).gr_name
    except (OSError, KeyError):
        return "dialout"


class SerialPort:
    """An open port that never blocks on reading and that turns every failure into `LinkLost`.

    with SerialPort("/dev/rfcomm0", 921600) as port:
        port.write(b"...")
        data = port.read()      # what is there, perhaps nothing
    """

    def __init__(self, path: str, baud_rate: int) -> None:
        """Open `path` exclusively and throw away what lies in its buffers.

        Raises:
          PortError: it does not exist, is busy, is forbidden, or is no serial port.
        """
        self.path = path
        try:
            self._serial = serial.Serial(path, baud_rate, timeout=0, exclusive=True)
            self._serial.reset_output_buffer()
        except (serial.SerialException, OSError, termios.error) as error:
            code = _errno(error)
            raise PortError(f"{_remedy(code, path).format(path=path)} ({_reason(error, code)})") from error
        except ValueError as error:
            raise PortError(f"port {path}: {error}; choose another baud rate") from error

    def fileno(self) -> int:
        """For `select`."""
        return self._serial.fileno()

    def read(self) -> bytes:
        """The bytes that have arrived, perhaps none.

        Raises:
          LinkLost: the other side closed the port or it was unplugged.
        """
        try:
            ready, _, _ = select.select([self._serial.fileno()], [], [], 0)
            if not ready:
                return b""
            data = os.read(self._serial.fileno(), 65536)
        except BlockingIOError:
            return b""
        except (OSError, ValueError, serial.SerialException) as error:
            raise LinkLost(f"port {self.path} went away ({error})") from error
        if not data:  # ready, yet empty: on a terminal, that is how a hang-up looks
            raise LinkLost(f"port {self.path} went away, or another program reads from it too")
        return data

    def write(self, data: bytes) -> None:
        """Write all of `data`.

        Raises:
          LinkLost: the port is gone or takes no more bytes.
        """
        deadline = time.monotonic() + WRITE_TIMEOUT_S
        try:
            while True:
                data = data[self._write_some(data) :]
                if not data:
                    return
                if time.monotonic() > deadline:
                    raise LinkLost(f"port {self.path} takes no more bytes; the other side has stopped reading")
                select.select([], [self._serial.fileno()], [], WRITE_TIMEOUT_S)
        except (serial.SerialException, OSError, ValueError) as error:
            raise LinkLost(f"port {self.path} went away ({error})") from error

    def _write_some(self, data: bytes) -> int:
        try:
            return os.write(self._serial.fileno(), data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close the port; safe to call twice and on a port that is gone."""
        try:
            self._serial.close()
        except (OSError, termios.error):
            self._serial.is_open = False

    def __enter__(self) -> "SerialPort":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _errno(error: BaseException | None) -> int | None:
    """The error number behind an exception, which pyserial and termios hide in different places."""
    while error is not None:
        numbers = [a for a in (getattr(error, "errno", None), *error.args) if isinstance(a, int)]
        if numbers:
            return numbers[0]
        error = error.__cause__ or error.__context__
    return None


def _reason(error: Exception, code: int | None) -> str:
    return os.strerror(code) if code else str(error)
