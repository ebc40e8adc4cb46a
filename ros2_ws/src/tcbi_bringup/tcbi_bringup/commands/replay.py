"""`./tcbi replay`: plays a bag into the running graph."""

import argparse
from pathlib import Path

from tcbi_bringup.arguments import between, namespace
from tcbi_bringup.commands import console

SUMMARY = "Play a bag into the graph: the same bytes on the same topics, with /clock, at any speed."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to play, and how fast."""
    parser.add_argument("bag", type=Path, help="a bag's folder or an .mcap file; a cut-off one plays as far as it goes")
    parser.add_argument(
        "--rate", type=between(0.01, 1000.0), default=1.0, help="speed; 2 is twice as fast as recorded (default: 1)"
    )
    parser.add_argument("--loop", action="store_true", help="start again at the end")
    parser.add_argument(
        "--topics", nargs="+", default=[], metavar="TOPIC", help="only these, e.g. joint_states imu/data"
    )
    parser.add_argument("--namespace", type=namespace, default="", help="put before every topic")
    parser.add_argument(
        "--wait-for", type=between(0, 100), default=0, metavar="N", help="begin once N nodes listen to joint_states"
    )
    parser.add_argument(
        "--drive",
        action="store_true",
        help="with --topics joint_commands: play them although a robot or a simulation listens, which moves",
    )
    parser.add_argument("--no-clock", action="store_true", help="do not publish /clock")
    console.add_examples(
        parser,
        "./tcbi replay rollouts/balance-20261121-004512-s1-003",
        "./tcbi up --robot none    # in one terminal, then in another: ./tcbi replay walk.mcap",
        "./tcbi replay walk.mcap --rate 10 --wait-for 1 --topics joint_states imu/data",
    )


def run(args: argparse.Namespace) -> int:
    """Check the bag here, where the error is one line, then play."""
    import json

    from tcbi_bringup.domain_lock import refuse_beside_robot
    from tcbi_contract.wording import counted
    from tcbi_infer.player import schedule
    from tcbi_infer.replay_node import main
    from tcbi_sim.prompt_acks import ask_for_prompt_acks

    ask_for_prompt_acks()  # before anything starts the middleware
    plan = schedule(args.bag, tuple(args.topics))
    refuse_beside_robot(plan.topics, args.namespace, args.drive)
    messages, seconds = counted(len(plan.cues), "message"), (plan.end - plan.start) * 1e-9
    console.note(f"playing {messages} over {seconds:.1f} s at {args.rate:g} times the recorded speed")
    parameters = {
        "bag": str(args.bag),
        "rate": args.rate,
        "loop": args.loop,
        "topics": " ".join(args.topics),
        "wait_for": args.wait_for,
        "publish_clock": not args.no_clock,
    }
    words = ["--ros-args"]
    for name, value in parameters.items():
        words += ["-p", f"{name}:={json.dumps(value, ensure_ascii=False)}"]
    if args.namespace:
        words += ["-r", f"__ns:=/{args.namespace}"]
    return main(words)
