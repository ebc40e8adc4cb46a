"""Learns from rollouts as they are finished: posterior, model error, diagnosis, and when to train anew.

It watches the recorder's folder. Once enough new rollouts lie there it infers in a worker process, publishes the
posterior and the error on rollouts that no fit sees, and asks for a new policy if the posterior moved or the error fell
enough since the last training.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from tcbi_contract import messages, names
from tcbi_contract.errors import TcbiError
from tcbi_contract.parameters import declare, parameter
from tcbi_contract.running import run
from tcbi_contract.wording import counted
from tcbi_infer.diagnose import adopt
from tcbi_infer.diagnose_server import DiagnoseServer
from tcbi_infer.earlier_fit import newest_fit, posterior_of
from tcbi_infer.inference_worker import DIAGNOSE, INFER, Job
from tcbi_infer.messages import model_error_message, number, posterior_message
from tcbi_infer.rollout_folder import RolloutFolder
from tcbi_infer.training_client import TrainingClient
from tcbi_infer.worker_process import Worker
from tcbi_msgs.action import Diagnose
from tcbi_msgs.msg import ModelError, Posterior, RolloutEvent
from tcbi_msgs.srv import AddEffect, LoadModel
from tcbi_sim.model import Model
from tcbi_sim.store import LATEST, ModelStore

FIRST_PAUSE_S, LONGEST_PAUSE_S = 5.0, 600.0  # after a failed inference, twice as long each time


@dataclass(frozen=True)
class InferenceParameters:
    """Parameters of the inference node."""

    store: str = parameter("", "folder of the store; empty for ~/.local/share/tcbi")
    bags: str = parameter("", "folder of bags to watch; empty for `rollouts` in the store")
    model: str = parameter(LATEST, "model version whose parameters are inferred, or latest")
    method: str = parameter("calibrated", "of inference", choices=("calibrated", "paper"))
    particles: int = parameter(50, "simulated in each generation", low=10, high=100000)
    generations: int = parameter(0, "at most; 0 for as many as the method makes by itself", low=0, high=1000)
    least_rollouts: int = parameter(8, "to fit, before the first inference", low=2, high=100000)
    new_rollouts: int = parameter(4, "finished since the last inference, before the next", low=1, high=100000)
    holdout_every: int = parameter(5, "one rollout in so many is judged on and never fitted; 0 for none", low=0)
    posterior_moved: float = parameter(
        0.5,
        "shift of a parameter's mean since the last training that asks for one, in its standard deviations then",
        low=0.0,
    )
    error_fell: float = parameter(
        0.1,
        "fall of the error on held-out rollouts since the last training that asks for one, as a share of it",
        low=0.0,
        high=1.0,
    )
    retrain: bool = parameter(True, "whether to ask for trainings")
    retrain_budget_s: float = parameter(120.0, "of such a training, s; 0 for no limit", low=0.0)
    threads: int = parameter(0, "processors for the simulations; 0 for all", low=0, high=256)
    seed: int = parameter(0, "of all randomness", low=0)
    poll_s: float = parameter(1.0, "how often to look for finished bags and for the worker's news", low=0.05, high=60.0)


class InferenceNode(Node):
    """One worker at a time; no callback waits for it but the diagnose action's, which has a thread of its own."""

    def __init__(self) -> None:
        super().__init__("inference_node")
        self.values = declare(self, InferenceParameters)
        self._store = ModelStore(self.values.store or None)
        self._model = self.values.model
        self._store.load(self._model)
        bags = Path(self.values.bags).expanduser() if self.values.bags else self._store.root / "rollouts"
        self._folder = RolloutFolder(bags, self.values.holdout_every)
        self._worker: Worker | None = None
        self._inferred: set[Path] = set()  # bags fitted in an inference
        self._wanted = False  # an inference is due whatever the number of rollouts
        self._news: dict[str, Any] = {}
        self._warned: set[str] = set()  # each inference reads all bags again and says the same of them
        self._state, self._fault = "waiting for rollouts", ""
        self._failures = 0  # inferences in a row
        self._not_before = 0.0  # s of the steady clock, when the next inference may begin
        self._open()
        self._take_up()

    def _open(self) -> None:
        rest = MutuallyExclusiveCallbackGroup()
        self._posterior = self.create_publisher(Posterior, names.POSTERIOR, messages.LATCHED_QOS)
        self._running = self.create_publisher(Posterior, names.POSTERIOR_PROGRESS, messages.STREAM_QOS)
        self._error = self.create_publisher(ModelError, names.MODEL_ERROR, messages.LATCHED_QOS)
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, messages.STREAM_QOS)
        self.create_subscription(
            RolloutEvent, names.ROLLOUT_EVENT, self._on_event, messages.LATCHED_QOS, callback_group=rest
        )
        self.create_service(LoadModel, names.INFERENCE_LOAD_MODEL, self._on_load, callback_group=rest)
        self.create_service(AddEffect, names.ADD_EFFECT, self._on_add, callback_group=rest)
        self._training = TrainingClient(self, self.values, self._store.load(self._model).version, rest)
        self._diagnose = DiagnoseServer(self, self._job, lambda: self._worker is None, self._warn)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(self.values.poll_s, self._on_poll, clock=steady, callback_group=rest)
        self.create_timer(1 / names.DIAGNOSTICS_RATE_HZ, self._report, clock=steady, callback_group=rest)
        self.get_logger().info(f"watches {self._folder.path}, model {self._model}")

    # -- rollouts and inference -----------------------------------------------------------------------------------

    def _take_up(self) -> None:
        """Count what an earlier life inferred as inferred, and publish that posterior once more."""
        self._look()
        try:
            version = self._version(self._model)
        except TcbiError as e:  # rollouts of a rig that has no model
            self._warn(str(e))
            return
        found = newest_fit(self._store, version, self.values.method)
        known = self._folder.holding(found.evidence["inference"]["rollouts"]) if found else set()
        if found is None or not known & set(self._folder.fitted):
            return
        try:
            posterior = posterior_of(self._store, found)
        except (OSError, KeyError) as e:
            self.get_logger().warning(f"{found.version} was not saved whole ({e}); it is inferred again")
            return
        self._posterior.publish(posterior_message(posterior, self.get_clock().now().to_msg()))
        self._inferred = known
        if self._model != LATEST:
            self._model = found.version
        self.get_logger().info(f"goes on from {found.version}, which holds {counted(len(known), 'rollout')} of these")

    def _on_event(self, event: RolloutEvent) -> None:
        if event.kind == RolloutEvent.END and self._worker is None:
            self._state = f"rollout {event.rollout_id} ended"

    def _on_poll(self) -> None:
        self._look()
        if self._worker is not None:
            for event in self._worker.events():
                self._on_news(event)
        if self._worker is None and self._due():
            self._start()

    def _look(self) -> None:
        """Take note of new bags; a change of their source is said, since it leaves the others out."""
        if self._folder.look() and (others := self._folder.left_out):
            sources = ", ".join(sorted({source or "unknown" for source in others.values()}))
            self._warn(
                f"left out: {counted(len(others), 'rollout')} whose source is {sources}; that of the newest one is "
                f"{self._folder.source or 'unknown'}, and rollouts of several sources are not taken together"
            )

    def _due(self) -> bool:
        fitted = set(self._folder.fitted)
        if self._diagnose.runs or len(fitted) < self.values.least_rollouts or time.monotonic() < self._not_before:
            return False
        return self._wanted or len(fitted - self._inferred) >= self.values.new_rollouts or not fitted & self._inferred

    def _start(self) -> None:
        v, fitted = self.values, self._folder.fitted
        self._inferred.update(fitted)
        self._wanted = False
        job = Job(
            INFER, str(self._store.root), self._model, _texts(fitted), _texts(self._folder.held_out),
            self._training.trained_on, v.method, v.particles, v.generations, v.seed, v.threads,
        )  # fmt: skip
        self._worker, self._fault, self._news = Worker(job), "", {}
        self._state = f"inferring from {counted(len(fitted), 'rollout')}"
        self.get_logger().info(self._state)

    def _on_news(self, event: dict[str, Any]) -> None:
        kind, stamp = event.pop("event"), self.get_clock().now().to_msg()
        if kind == "progress":
            self._state = f"inferring, {event['stage']}, {number(event['remaining_s']):.0f} s left"
        elif kind == "warning":
            self._warn(event["message"])
        elif kind == "generation":
            self._running.publish(posterior_message(event, stamp))
        elif kind == "posterior":
            self._news["posterior"] = event
            self._posterior.publish(posterior_message(event, stamp))
            self.get_logger().info(f"posterior of {event['model']}: " + "; ".join(_described(event)))
            for line in event["warnings"]:
                self.get_logger().warning(line)
        elif kind == "model_error":
            self._news[event["role"]] = number(event["error_over_floor"])
            self._error.publish(model_error_message(event, stamp))
        elif kind == "superseded":
            self._news["superseded"] = event["model"]
        else:
            self._end(kind, event)

    def _warn(self, message: str) -> None:
        """Log a worker's warning, unless it was logged before."""
        if message not in self._warned:
            self._warned.add(message)
            self.get_logger().warning(message)

    def _end(self, kind: str, event: dict[str, Any]) -> None:
        assert self._worker is not None
        self._worker.stop()
        self._worker = None
        if kind == "failed":
            self._failed(event["message"])
            return
        self._failures = 0
        if newest := self._news.get("superseded"):
            self._wanted = True
            self._state = f"{newest} was made meanwhile; infers from there"
            self.get_logger().info(self._state)
            return
        self._state = f"waiting for {self.values.new_rollouts} more rollouts"
        if self._model != LATEST:
            self._model = self._news["posterior"]["model"]
        if self.values.retrain:
            errors = (self._news.get(role, math.nan) for role in ("before", "after"))
            self._training.consider(self._news["posterior"], *errors)

    def _failed(self, why: str) -> None:
        """Say why, and infer once more after a while: a disk that was full or a worker that was killed may be back."""
        pause = min(FIRST_PAUSE_S * 2**self._failures, LONGEST_PAUSE_S)
        self._failures += 1
        self._wanted, self._not_before = True, time.monotonic() + pause
        self._state, self._fault = "inference failed", f"{why}; mend this, it is tried again in {pause:.0f} s"
        self.get_logger().error(self._fault)

    def _begin_anew(self) -> None:
        """Infer as soon as may be; what is at work is of a version that is no longer in question."""
        if self._worker is not None:
            self._worker.stop()
            self._worker = None
            self.get_logger().info("the inference at work is given up for one of the version that was asked for")
        self._wanted, self._not_before = True, 0.0

    # -- services -------------------------------------------------------------------------------------------------

    def _on_load(self, request: LoadModel.Request, response: LoadModel.Response) -> LoadModel.Response:
        try:
            response.model = self._version(request.model or LATEST).version
            self._model, response.success = request.model or LATEST, True
            self._begin_anew()
        except TcbiError as e:
            response.message, response.model = str(e), self._model
        return response

    def _on_add(self, request: AddEffect.Request, response: AddEffect.Response) -> AddEffect.Response:
        try:
            parent = self._version(request.model or self._model)
            child, how = self._with_effect(parent, request.effect)
            response.model = self._store.save(child).version
            self._model = response.model if self._model != LATEST else LATEST
            response.success = True
            self._begin_anew()
            response.message = f"{response.model} is {parent.version} with {request.effect}, {how}"
        except TcbiError as e:
            response.message = str(e)
        return response

    def _version(self, name: str) -> Model:
        """A version; `latest` is the newest of the rig that was diagnosed last, or else of the newest rollout."""
        rig = self._diagnose.rig or self._folder.rig
        return self._store.load(name, rig) if rig else self._store.load(name)

    def _with_effect(self, parent: Model, use: str) -> tuple[Model, str]:
        """The next version as the newest diagnosis that fitted this use says, else with the prior; and which it is."""
        child = parent.with_effect(use)  # a wrong name is told first
        found = adopt.latest(self._store.folder("runs"), parent.version, use)
        if found is None:
            return child, "its size as wide as the prior: no diagnosis of this version has fitted it"
        fitted = adopt.offered(parent, use, found)
        doubt = adopt.doubt(fitted.evidence)
        return fitted, "as the newest diagnosis fitted it" + (doubt and f", which {doubt}: it is a guess")

    # -- diagnosis ------------------------------------------------------------------------------------------------

    def _job(self, goal: Diagnose.Goal) -> Job:
        bags = tuple(goal.bags) or _texts(self._folder.fitted)
        return Job(DIAGNOSE, str(self._store.root), goal.model or self._model, bags, threads=self.values.threads)

    # -- health ---------------------------------------------------------------------------------------------------

    def _report(self) -> None:
        status = DiagnosticStatus(level=DiagnosticStatus.OK, name="inference_node", message=self._state)
        if self._fault:
            status.level, status.message = DiagnosticStatus.WARN, self._fault
        facts = {
            "model": self._model,
            "rollouts to fit": len(self._folder.fitted),
            "rollouts held out": len(self._folder.held_out),
            "training": self._training.runs,
            "training wanted": self._training.is_wanted,
        }
        status.values = [KeyValue(key=key, value=str(value)) for key, value in facts.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def leave(self) -> None:
        """End the workers."""
        self._diagnose.leave()
        if self._worker is not None:
            self._worker.stop()


def _texts(paths: Sequence[Path]) -> tuple[str, ...]:
    return tuple(map(str, paths))


def _described(event: dict[str, Any]) -> list[str]:
    rows = zip(event["parameter"], event["mean"], event["variance"], event["unit"], event["identified"], strict=True)
    return [f"{n} {m:.3g} ± {math.sqrt(v):.2g} {u}{'' if known else ' (unknown still)'}" for n, m, v, u, known in rows]


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    return run("inference_node", InferenceNode, args, threads=3)
