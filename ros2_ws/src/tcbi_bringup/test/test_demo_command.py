"""`./tcbi demo`: its options are those of the robot that it builds."""

import pytest

from tcbi_bringup import cli
from tcbi_bringup.commands import demo
from tcbi_bringup.demo.robot import Robot
from tcbi_bringup.emulated_robot.main import parser as emulated_robot_parser


@pytest.mark.parametrize("words", [[], ["--seed", "7", "--hidden", "backlash", "--strength", "weak"]])
def test_the_emulated_robot_takes_what_the_demo_was_given(words: list[str]) -> None:
    command = next(c for c in cli.available() if c.name == "demo")
    args = cli.parser_for(command, demo).parse_args(words)
    built = emulated_robot_parser().parse_args(Robot(args.seed, args.hidden, args.strength).arguments())
    assert (built.seed, built.strength) == (args.seed, args.strength)
