"""`./tcbi recover`: repairs bags that were cut off."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tcbi_bringup.commands import console
from tcbi_contract.errors import TcbiError
from tcbi_contract.wording import counted

if TYPE_CHECKING:
    from tcbi_infer.bags.recovery import Recovery

SUMMARY = "Repair bags that were cut off: every readable message goes into a new file; the original is kept aside."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which bags."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="a bag's folder or an .mcap file")
    console.add_json(parser)
    console.add_examples(
        parser, "./tcbi recover rollouts/balance-20261121-004512-s1-003", "./tcbi recover x.mcap --json"
    )


def run(args: argparse.Namespace) -> int:
    """Repair one after the other; 1 if one of them could not be repaired, which does not stop the rest."""
    from tcbi_infer.bags.files import left_out

    skipped = left_out(args.bags)
    for path, why in skipped.items():
        console.note(f"note: {path} is left out: {why}")
    answers = []
    for bag in (bag for bag in args.bags if bag not in skipped):
        recovery, error = _tried(bag)
        answers.append(_answer(recovery, error))
        if error:
            console.note(f"tcbi: {error}")
        elif not args.json:
            _show(recovery)
    if args.json:
        console.emit({"bags": answers})
    return int(any(answer["error"] for answer in answers))


def _tried(bag: Path) -> "tuple[Recovery, str]":
    """What a repair saved, and why it failed; empty where it did not."""
    from tcbi_infer.bags.recovery import Recovery, recover

    try:
        return recover(bag), ""
    except TcbiError as e:
        error = " ".join(str(e).split())
    except OSError as e:
        error = f"{bag}: cannot be repaired ({e.strerror or e}); see that it and its folder can be read and written"
    return Recovery(bag), error


def _answer(recovery: "Recovery", error: str) -> dict[str, Any]:
    return {
        "bag": str(recovery.bag),
        "repaired": recovery.repaired,
        "original": str(recovery.original) if recovery.original else None,
        "messages": recovery.messages,
        "seconds": recovery.seconds,
        "topics": recovery.topics,
        "lost_bytes": recovery.lost_bytes,
        "damage": recovery.damage,
        "error": error or None,
    }


def _show(recovery: "Recovery") -> None:
    count = counted(recovery.messages, "message")
    if not recovery.repaired:
        empty = "" if recovery.messages else "; the bag is empty, leave it out or record it again"
        console.note(f"{recovery.bag}: nothing to repair, {count}{empty}")
        return
    reason = "; ".join(recovery.damage) or "it had no metadata"
    lost = counted(recovery.lost_bytes, "byte")
    print(f"{recovery.bag}: saved {count} over {recovery.seconds:.2f} s ({reason}; lost {lost})")
    console.table("", ["topic", "messages"], sorted(recovery.topics.items()))
    print(f"the original is kept as {recovery.original}", flush=True)
