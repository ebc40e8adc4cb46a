"""`./tcbi recover`: repairs bags that were cut off."""

import argparse
from pathlib import Path

from tcbi_bringup.commands import console
from tcbi_contract.wording import counted

SUMMARY = "Repair bags that were cut off: every readable message goes into a new file; the original is kept aside."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which bags."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="a bag's folder or an .mcap file")
    console.add_json(parser)
    console.add_examples(
        parser, "./tcbi recover rollouts/balance-20261121-004512-s1-003", "./tcbi recover x.mcap --json"
    )


def run(args: argparse.Namespace) -> int:
    """Repair one after the other."""
    from tcbi_infer.bags.recovery import recover

    found = [recover(bag) for bag in args.bags]
    if args.json:
        console.emit(
            {
                "bags": [
                    {
                        "bag": str(r.bag),
                        "repaired": r.repaired,
                        "original": str(r.original) if r.original else None,
                        "messages": r.messages,
                        "seconds": r.seconds,
                        "topics": r.topics,
                        "lost_bytes": r.lost_bytes,
                        "damage": r.damage,
                    }
                    for r in found
                ]
            }
        )
        return 0
    for r in found:
        if not r.repaired:
            console.note(f"{r.bag}: nothing to repair, {counted(r.messages, 'message')}")
            continue
        reason = "; ".join(r.damage) or "it had no metadata"
        lost = counted(r.lost_bytes, "byte")
        print(f"{r.bag}: saved {counted(r.messages, 'message')} over {r.seconds:.2f} s ({reason}; lost {lost})")
        console.table("", ["topic", "messages"], sorted(r.topics.items()))
        print(f"the original is kept as {r.original}")
    return 0
