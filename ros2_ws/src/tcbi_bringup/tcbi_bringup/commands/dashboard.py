"""`./tcbi dashboard`: the whole loop in a browser."""

import argparse
from pathlib import Path

from tcbi_bringup.arguments import between, namespace
from tcbi_bringup.commands import console

SUMMARY = "Serve the loop as a web page: live graph, comparison, diagnosis, adding effects, reports."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to listen, and which rollouts to offer."""
    parser.add_argument(
        "folders", nargs="*", type=Path, metavar="FOLDER", help="folders of bags, besides the store's own rollouts"
    )
    parser.add_argument(
        "--host",
        default="localhost",
        help="address to listen on (default: localhost); any other one asks for the token that is printed",
    )
    parser.add_argument("--port", type=between(1, 65_535), default=8080, help="default: 8080")
    parser.add_argument(
        "--allow-motion", action="store_true", help="with --host: let the page move the robot, not only stop it"
    )
    parser.add_argument("--open", action="store_true", help="open it in a browser")
    parser.add_argument("--namespace", type=namespace, default="", help="of the graph to show")
    console.add_store(parser)
    console.add_json(parser)
    console.add_examples(
        parser,
        "./tcbi dashboard --open",
        "./tcbi dashboard rollouts walks --store project",
        "./tcbi dashboard --host 0.0.0.0                      # for a phone beside the robot",
    )


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from tcbi_dashboard.access import Access
    from tcbi_dashboard.live import Live
    from tcbi_dashboard.server import serve
    from tcbi_dashboard.workbench import Workbench
    from tcbi_sim.store import ModelStore

    store = ModelStore(args.store)
    access = Access.of(args.host, args.port, args.allow_motion)
    folders = [store.root / "rollouts", *(folder.expanduser().absolute() for folder in args.folders)]
    for folder in args.folders:
        if not folder.expanduser().is_dir():
            console.note(f"note: {folder} is no folder yet; bags that come there will be shown")
    bench = Workbench(store, folders, access)

    def started() -> None:
        if args.json:
            said = {"address": access.address, "addresses": access.addresses}
            console.emit({**said, "store": str(store.root), "motion": access.motion})
        else:
            here, *elsewhere = access.addresses
            console.note(f"open {here}")
            for address in elsewhere:
                console.note(f"from another machine {address}")
            console.note(f"Ctrl-C ends it; store {store.root}")
            if access.token and not access.motion:
                console.note("the page may stop the robot but not move it; --allow-motion lets it")

    live = Live()
    try:
        from tcbi_dashboard.dashboard_node import listen
    except ImportError as e:
        live.fault = f"ROS is not here, so there is no graph to see ({e}); all else works"
    else:
        listen(live, args.namespace)
    try:
        serve(bench, live, args.open, started)
    except KeyboardInterrupt:
        return 130
    finally:
        live.close()
    return 0
