"""`./tcbi demo`: its options are those of the robot that it builds."""

import pytest

from tcbi_bringup import cli
from tcbi_bringup.commands import demo
from tcbi_bringup.demo import story
from tcbi_bringup.demo.robot import Robot
from tcbi_bringup.emulated_robot.main import parser as emulated_robot_parser


@pytest.mark.parametrize("words", [[], ["--seed", "7", "--hidden", "backlash", "--strength", "weak"]])
def test_the_emulated_robot_takes_what_the_demo_was_given(words: list[str]) -> None:
    command = next(c for c in cli.available() if c.name == "demo")
    args = cli.parser_for(command, demo).parse_args(words)
    built = emulated_robot_parser().parse_args(Robot(args.seed, args.hidden, args.strength).arguments())
    assert (built.seed, built.strength) == (args.seed, args.strength)


@pytest.mark.parametrize(("load", "told"), [(1.5, ""), (6.2, "; 6 processes want this machine's 2 processors: run")])
def test_a_demo_that_fails_on_a_machine_with_much_to_do_says_so(monkeypatch: pytest.MonkeyPatch, load, told) -> None:
    monkeypatch.setattr(story.os, "getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr(story.os, "sched_getaffinity", lambda _: {0, 1})
    assert story.busy().startswith(told) and bool(story.busy()) == bool(told)
