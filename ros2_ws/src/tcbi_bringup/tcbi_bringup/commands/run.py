"""`./tcbi run PACKAGE EXECUTABLE [ARGS]`: what `ros2 run` does, without a ROS installation."""

import argparse
import os
import sys

from tcbi_bringup.commands import console
from tcbi_bringup.executables import PACKAGES, executables, find_executable

SUMMARY = "Start one executable of one package in this terminal; what follows is passed on to it."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Two names and the rest."""
    parser.add_argument("package", nargs="?", help="e.g. tcbi_sim; without it, all packages and executables are listed")
    parser.add_argument("executable", nargs="?", help="e.g. sim_node; without it, those of the package are listed")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="passed on, e.g. --ros-args -p mode:=lockstep")
    console.add_examples(
        parser,
        "./tcbi run",
        "./tcbi run tcbi_sim sim_node --ros-args -p mode:=lockstep",
        "./tcbi run hexapod_driver driver_node --ros-args -r __ns:=/left",
    )


def run(args: argparse.Namespace) -> int:
    """Replace this process by the executable, so that signals and the exit status are its own."""
    if args.executable is None:
        for package in [args.package] if args.package else PACKAGES:
            for name in executables(package) or [find_executable(package, "").name]:
                print(package, name)
        return 0
    path = find_executable(args.package, args.executable)
    sys.stdout.flush()
    os.execv(path, [str(path), *args.arguments])
