"""TCBI beside pyABC and sbi at the same inference: seconds until the others' error is as small as TCBI's.

./tcbi python bench/inference_peers.py                             # six truths: half an hour on two cores
./tcbi python bench/inference_peers.py --quick                     # one short one: that it runs
./tcbi python bench/inference_peers.py --truths 0:20 --keep peers.jsonl

Needs the libraries of requirements-peers.in; one that is missing is left out with a line. A truth is drawn from the
prior, simulated with finer steps than an inference takes, and given sensor noise. The error is that of the posterior's
mean, in shares of the prior's range, root mean square over parameters and truths. A peer may take so many times as long
as TCBI did on the same rollouts. `--keep FILE` holds one JSON line for each truth of each task, size and set of peers;
what is there is not run again.
"""

import argparse
import dataclasses
import importlib.util
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from calibration.truths import INFERENCES, RIG, recorded
from peers.inference import PEERS, Belief, with_tcbi

from tcbi_bringup.commands.bench import figure
from tcbi_infer.tcbi.problem import Problem
from tcbi_sim.model import base_model

TARGET = 5.0  # times as fast
PATIENCE = 10.0  # times TCBI's time that a peer may take
RESAMPLES = 2000

Result = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Case:
    """What is run; a result of the same case is not run again."""

    task: str
    truth: int
    rollouts: int
    duration: float  # s
    generations: int  # of TCBI
    peers: tuple[str, ...]

    def key(self) -> str:
        """Equal for equal cases, and for their JSON."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)


def run(case: Case) -> Result:
    """Everybody's beliefs about one robot."""
    values, measured = recorded("model", case.task, case.truth, case.rollouts, case.duration)
    seed = INFERENCES + case.truth
    problem = Problem.of(base_model(RIG), measured, seed=seed)
    own = with_tcbi(problem, seed, case.generations)
    found = {"tcbi": own}
    for name in case.peers:
        found[name] = PEERS[name](problem, seed, PATIENCE * own[-1].wall_s)
        print(f"truth {case.truth}: {name}, {len(found[name])} rounds", file=sys.stderr)
    unit = problem.model.to_unit(values)
    return {
        "case": json.loads(case.key()),
        "parameters": list(problem.model.names),
        "beliefs": {name: [_plain(belief, unit) for belief in beliefs] for name, beliefs in found.items()},
    }


def _plain(belief: Belief, unit: np.ndarray) -> dict[str, Any]:
    return {
        "wall_s": belief.wall_s,
        "simulations": belief.simulations,
        "error": (belief.mean - unit).tolist(),
        "sd": belief.sd.tolist(),
    }


def figures(found: list[Result], peers: Sequence[str]) -> list[dict[str, Any]]:
    """Errors, times, and how many times as long a peer takes to TCBI's error."""
    own = [r["beliefs"]["tcbi"][-1] for r in found]
    n = len(found)
    rows = [
        figure(f"tcbi: error of the mean, share of the prior's range, {n} truths", rms(own), "1"),
        figure("tcbi: seconds, median", float(np.median([b["wall_s"] for b in own])), "s"),
    ]
    for name in peers:
        last = [r["beliefs"][name][-1] for r in found if r["beliefs"][name]]
        if len(last) < n:
            print(f"{name}: no round was finished on {n - len(last)} of {n} truths", file=sys.stderr)
            continue
        shares = [b["wall_s"] / o["wall_s"] for b, o in zip(last, own, strict=True)]
        times, low, high = as_long(found, name)
        if np.isinf(times):
            print(f"{name}: its error was never as small as TCBI's; the time to it has no value", file=sys.stderr)
        rows += [
            figure(f"{name}: error of the mean after {np.median(shares):.1f} times TCBI's time", rms(last), "1"),
            figure(f"{name}: simulated robots to TCBI's, then", _simulated(last) / _simulated(own), "1"),
            figure(f"{name}: time to TCBI's error, to TCBI's time", times, "1", least=TARGET),
            figure(f"{name}: the same, 90 % of resampled truths above", low, "1"),
            figure(f"{name}: the same, 90 % of resampled truths below", high, "1"),
        ]
    return rows


def as_long(found: list[Result], name: str) -> tuple[float, float, float]:
    """Time to TCBI's error over TCBI's, and its 10 and 90 % points over resampled truths; inf: it never was."""
    rng = np.random.default_rng(0)
    drawn = [_as_long([found[i] for i in rng.integers(len(found), size=len(found))], name) for _ in range(RESAMPLES)]
    low, high = np.quantile(drawn, [0.1, 0.9], method="inverted_cdf")
    return _as_long(found, name), float(low), float(high)


def _as_long(found: list[Result], name: str) -> float:
    """The least share of TCBI's time at which a peer's error over all truths is TCBI's or less, and stays so."""
    wanted = rms([r["beliefs"]["tcbi"][-1] for r in found])
    scaled = []
    for r in found:
        whole = r["beliefs"]["tcbi"][-1]["wall_s"]
        scaled.append([(b["wall_s"] / whole, b) for b in r["beliefs"][name]])
    moments = sorted({share for beliefs in scaled for share, _ in beliefs})
    reached = np.inf
    for moment in reversed(moments):
        known = [[b for share, b in beliefs if share <= moment] for beliefs in scaled]
        if not all(known) or rms([beliefs[-1] for beliefs in known]) > wanted:
            break
        reached = moment
    return float(reached)


def rms(beliefs: list[dict[str, Any]]) -> float:
    """Error over parameters and truths."""
    return float(np.sqrt(np.mean(np.square([b["error"] for b in beliefs]))))


def _simulated(beliefs: list[dict[str, Any]]) -> float:
    return float(np.median([b["simulations"] for b in beliefs]))


def kept(path: Path) -> list[Result]:
    """What an earlier run left; a last line that was cut off is dropped."""
    found = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            found.append(json.loads(line))
        except ValueError:
            print(f"{path}: a line that was cut off is left out", file=sys.stderr)
    return found


def results(wanted: list[Case], file: Path) -> list[Result]:
    """Of all cases, those kept from an earlier run as they are."""
    done = {json.dumps(r.get("case"), sort_keys=True): r for r in kept(file)}
    for case in wanted:
        if case.key() not in done:
            done[case.key()] = run(case)
            torn = file.exists() and not file.read_bytes().endswith(b"\n")
            with file.open("a") as stream:
                stream.write("\n" * torn + json.dumps(done[case.key()]) + "\n")
    return [done[case.key()] for case in wanted]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one truth, two short rollouts")
    parser.add_argument("--task", default="forward", choices=("balance", "forward"))
    parser.add_argument("--truths", default="0:6", help="first:end (default: 0:6)")
    parser.add_argument("--rollouts", type=int, default=6, help="of each truth (default: 6)")
    parser.add_argument("--duration", type=float, default=1.6, help="of each, s (default: 1.6)")
    parser.add_argument("--generations", type=int, default=6, help="of TCBI, 50 particles each (default: 6)")
    parser.add_argument("--keep", type=Path, help="file of results, one JSON object a line")
    options = parser.parse_args()
    first, end = (0, 1) if options.quick else (int(n) for n in options.truths.split(":"))
    size = (2, 1.0, 2) if options.quick else (options.rollouts, options.duration, options.generations)
    peers = tuple(name for name in PEERS if importlib.util.find_spec(name))
    for name in PEERS.keys() - set(peers):
        print(f"{name} is left out: not installed (requirements-peers.in)", file=sys.stderr)
    with tempfile.TemporaryDirectory() as folder:
        cases = [Case(options.task, truth, *size, peers) for truth in range(first, end)]
        found = results(cases, options.keep or Path(folder) / "results.jsonl")
    print(json.dumps({"name": "inference_peers", "figures": figures(found, peers)}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
