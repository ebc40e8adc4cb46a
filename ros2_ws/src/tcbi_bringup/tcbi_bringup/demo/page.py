"""The demo's report: one HTML file that tells the story to somebody who has not seen it."""

from pathlib import Path

import numpy as np

from tcbi_bringup.demo.story import Outcome, mean_return, tilt
from tcbi_bringup.emulated_robot.hidden_names import parts
from tcbi_infer.report import Report, Section, Table, add_comparison, add_diagnosis, add_history, add_ladder
from tcbi_infer.report.inference import identifiability
from tcbi_infer.tcbi.method import find_method
from tcbi_policy.reward import episode_reward
from tcbi_sim.model import Model

LEAD = (
    "A walking robot and its simulation never quite agree. Here a robot whose physics differ from the model's, by its "
    "plain parameters and perhaps by one effect that the model does not have, was driven over its serial port and "
    "recorded; the model was compared with the recordings, its missing effect looked for and added, its parameters "
    "inferred, and a policy retrained on it. The robot is an emulated one, so the truth is known; it was looked at "
    "only at the end."
)


def findings(outcome: Outcome) -> list[Section]:
    """Errors, diagnoses and comparison: what is known, and takes seconds to draw, while the robot still moves."""
    report = Report("")
    add_ladder(
        report,
        [(label(m), outcome.errors[m.version].error_over_floor) for m in outcome.models],
        repeated=outcome.errors[outcome.models[0].version].floor.from_replicates,
    )
    for diagnosis in outcome.diagnoses:
        add_diagnosis(report, diagnosis)
    last = outcome.errors[outcome.models[-1].version]
    first = outcome.errors[outcome.models[0].version]
    add_comparison(report, first, last)
    return report.sections


def write(outcome: Outcome, drawn: list[Section], truth: dict[str, object], path: Path) -> Path:
    """Write the report around its findings; returns its path."""
    report = Report(f"Robot {outcome.robot.seed}: from measurement to model", LEAD)
    _in_short(report, outcome, truth)
    for section in drawn:
        report.add(section)
    _parameters(report, outcome, truth)
    _policy(report, outcome)
    rows = [
        (m.version, m.parent or "–", ", ".join(m.effects) or "none", outcome.errors[m.version].error_over_floor)
        for m in outcome.models
    ]
    add_history(report, rows)
    return report.write(path)


def label(model: Model) -> str:
    """A version and what is in it."""
    return f"{model.version}: {', '.join(model.effects) or 'no effect'}"


def _in_short(report: Report, outcome: Outcome, truth: dict[str, object]) -> None:
    steps = [f"{step}: {text}" for step, text in outcome.narration.lines]
    hidden = str(truth["hidden"])
    said = ", ".join(outcome.effects) or "nothing"
    verdict = (
        f"Hidden in the robot: {hidden if hidden != 'none' else 'nothing'}. Found: {said}. "
        f"Verdict: {outcome.diagnoses[0].headline}."
    )
    tone = "good" if outcome.right(parts(hidden)) else "warn"
    report.add(Section("In short", verdict=verdict, tone=tone, notes=steps))


def _parameters(report: Report, outcome: Outcome, truth: dict[str, object]) -> None:
    if outcome.inference is None:
        return
    found, method = outcome.inference, find_method(outcome.inference.method)
    rows = [
        [
            e.name,
            e.unit,
            e.mean,
            f"{e.low90:.3g} to {e.high90:.3g}",
            identifiability(e, found, method),
            truth.get(e.name),
        ]
        for e in found.estimates
    ]
    head = ["parameter", "unit", "mean", "90 % interval", "identified?", "truth"]
    text = [
        "Task-consistent Bayesian inference compares distributions of what the task is about (reward, attitude, "
        "contacts, tracking, body rates) between robot and simulation. Where the data do not tell, the interval is "
        "little narrower than the prior. An effect's own parameters have no truth to show: the robot implements the "
        "effect another way."
    ]
    report.add(Section("The model's parameters", text=text, table=Table(head, rows)))


def _policy(report: Report, outcome: Outcome) -> None:
    rows = [
        [name, len(ms), mean_return(ms), float(np.std([episode_reward(m).total for m in ms])), tilt(ms)]
        for name, ms in (("first policy", outcome.before), ("after retraining", outcome.after))
        if ms
    ]
    head = ["policy", "rollouts", "mean return", "spread of return", "final inclination / deg"]
    text = [outcome.retraining.message] if outcome.retraining is not None else []
    text.append(
        "Both policies ran on the robot from the same postures on the same slopes; few rollouts, so read it with care."
    )
    report.add(Section("The policy on the robot", text=text, table=Table(head, rows)))
