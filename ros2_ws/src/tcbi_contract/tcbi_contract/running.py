"""How every node process starts and ends: 0 on Ctrl-C or SIGTERM, 1 with one line when it is set up wrongly; needs ROS.

def main(args=None) -> int:
    return run("sim_node", SimNode, args)
"""

import sys
import time
from collections.abc import Callable, Sequence

import rclpy
from rclpy.exceptions import InvalidParameterException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from tcbi_contract.errors import TcbiError

SIGNAL_S = 0.5  # for a signal to end the context
RCLError = rclpy_implementation.RCLError  # rclpy gives it no public name


def run(name: str, make: Callable[[], Node], args: Sequence[str] | None = None, threads: int = 1) -> int:
    """Make a node and spin it until the process is told to end.

    Args:
      name: what the process is called in its error line.
      make: builds the node; a TcbiError from it, or from a callback later, ends the process with status 1.
      args: command line; None for the process's own.
      threads: of the executor; more than one only for nodes whose actions need it.

    Returns:
      The exit status.
    """
    node = None
    try:
        rclpy.init(args=list(args) if args is not None else None)
        node = make()
        executor = SingleThreadedExecutor() if threads == 1 else MultiThreadedExecutor(num_threads=threads)
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (TcbiError, InvalidParameterException, InvalidParameterValueException) as error:
        sys.stderr.write(f"{name}: {' '.join(str(error).split())}\n")
        return 1
    except (RCLError, RuntimeError):
        if not _told_to_end():
            raise  # else a signal came between two steps of the executor, or within a conversion of rclpy's
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _told_to_end() -> bool:
    """Whether a signal ends the context, which its handler does from another thread."""
    deadline = time.monotonic() + SIGNAL_S
    while rclpy.ok() and time.monotonic() < deadline:
        time.sleep(0.01)
    return not rclpy.ok()
