"""`./tcbi export-model`: a model version as MJCF that plain MuJoCo loads."""

import argparse
from pathlib import Path

from tcbi_bringup.commands import console

SUMMARY = "Write a model version as one self-contained MJCF file, at its mean parameters."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    console.add_examples(
        parser,
        "./tcbi export-model hexapod.xml                      # the latest version",
        "./tcbi export-model --model hexapod-v2 v2.xml",
    )
    parser.add_argument("file", type=Path, metavar="F", help="the MJCF file to write")
    console.add_model(parser)
    parser.add_argument("--rig", default="hexapod", help="whose latest version (default: hexapod)")
    console.add_store(parser)
    console.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Load, write, check that plain MuJoCo reads it back."""
    import mujoco

    from tcbi_contract.files import replace_file
    from tcbi_infer.errors import InferError
    from tcbi_sim.mjcf import outside, to_xml
    from tcbi_sim.store import ModelStore

    folder = args.file.absolute().parent
    if not folder.is_dir():
        raise InferError(
            f"cannot write {args.file}: the folder {folder} does not exist; make it, or choose another place"
        )
    model = console.load_model(ModelStore(args.store), args.model, args.rig)
    try:
        replace_file(args.file, to_xml(model).encode())
    except OSError as e:
        raise InferError(f"cannot write {args.file}: {e.strerror}; choose another place") from e
    loaded, left = mujoco.MjModel.from_xml_path(str(args.file)), outside(model)
    if left:
        console.note(f"not in the file, since they act on commands or readings: {', '.join(left)}")
    if args.json:
        console.emit(
            {
                "model": model.version,
                "file": str(args.file),
                "joints": loaded.njnt,
                "mass": float(sum(loaded.body_mass)),
                "left_out": left,
            }
        )
    else:
        print(f"{model.version} -> {args.file} ({loaded.nbody} bodies, {loaded.nu} actuators)")
    return 0
