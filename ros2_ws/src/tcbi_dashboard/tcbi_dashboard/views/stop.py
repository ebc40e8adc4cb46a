"""The emergency stop: a card with the robot's state on Live, and a button that every view has within reach."""

import asyncio
from collections.abc import Callable

from nicegui import ui

from tcbi_dashboard.elements import card, say, soft, words
from tcbi_dashboard.live import POLICY_NODE, RECORDER_NODE, Live
from tcbi_dashboard.torque import RELEASE, RESET, STOP

COLOR = "#d55e00"


async def stop(live: Live) -> None:
    """Stop the robot."""
    ui.notify(await asyncio.to_thread(live.emergency_stop), type="warning", timeout=8000)


class StopAnywhere:
    """The button in the head, or at the bottom of a small screen, while there is a robot to stop."""

    def __init__(self, live: Live) -> None:
        self.live = live
        self._button = ui.button("STOP", on_click=lambda: stop(live), color=COLOR).classes("tcbi-stop-anywhere")
        self._button.set_visibility(False)

    def tick(self) -> None:
        """Twice a second."""
        self._button.set_visibility(self.live.there())
        self._button.set_text("STOPPED" if self.live.shown_torque(False).stopped else "STOP")


class StopCard:
    """Stop, what the torque is, what comes next, the rollout and the policy."""

    def __init__(self, live: Live, motion: bool) -> None:
        self.live, self._motion = live, motion

    def build(self) -> None:
        """The button first."""
        with card("Stop", "third").classes("tcbi-first"):
            ui.button(STOP, on_click=lambda: stop(self.live), color=COLOR).classes("tcbi-stop").mark("stop")
            soft("Takes the torque off all joints at once. The robot will sink.")
            with ui.element("div").classes("tcbi-torque").mark("torque") as self._state:
                self._head = words("", "strong")
                self._then = words("", "p")
                self._release = ui.button(RELEASE, on_click=lambda: self._lead_on(self.live.release)).props("outline")
                self._reset = ui.button(RESET, on_click=lambda: self._lead_on(self.live.reset)).props("outline")
                self._reset.tooltip("the robot moves")
            self._rollout = words("", "p")
            self._policy = words("", "p")

    async def _lead_on(self, what: Callable[[], str]) -> None:
        """Do what lets the robot move again: for a page that may, whatever a browser shows."""
        if self._motion:
            ui.notify(await asyncio.to_thread(what))

    def tick(self) -> None:
        """Twice a second while it is seen."""
        live = self.live
        shown = live.shown_torque(self._motion)
        say(self._head, shown.head)
        say(self._then, shown.then)
        self._release.set_visibility(shown.release)
        self._reset.set_visibility(shown.reset and not live.rollout)
        self._state.classes(remove="tcbi-stopped tcbi-old", add=_tone(shown.stopped, shown.old))
        silent = live.last_word(RECORDER_NODE)
        told = f"Rollout in progress: {live.rollout}" if live.rollout else "No rollout in progress."
        _say(self._rollout, told, silent if live.rollout else "")
        _say(self._policy, f"Policy in use: {live.policy}" if live.policy else "", live.last_word(POLICY_NODE))


def _tone(stopped: bool, old: bool) -> str:
    return " ".join(name for name, on in (("tcbi-stopped", stopped), ("tcbi-old", old)) if on)


def _say(place: ui.html, told: str, silent: str) -> None:
    """A sentence that is greyed, and says why, once its source is silent."""
    say(place, f"{told} ({silent})" if told and silent else told, bool(silent))
