"""Checks of what is recorded of the body as a whole: its feet, its place, the ground that it was told to stand on."""

import numpy as np

from tcbi_sim.measurement import Measurement

FALLS = 0.5  # share of the time in which a robot on legs stands on less than two
SPEED = 10.0  # m/s, of a small robot
STEEP = 0.8  # rad, of ground on which none stands
LEGS = 3  # of a robot that never leaves the ground with all of them


def check_body(m: Measurement) -> list[str]:
    """Findings about contacts, tracker and slopes of one recording."""
    return [*_contacts(m), *_tracker(m), *_slopes(m)]


def _contacts(m: Measurement) -> list[str]:
    if m.contact is None or m.contact.shape[1] < LEGS:
        return []
    if not m.contact.any():
        return ["No foot ever touches the ground: the contacts are not measured"]
    falls = float(np.mean(m.contact.sum(axis=1) < 2))
    if falls > FALLS:
        return [
            f"Less than two feet touch the ground {100 * falls:.0f} % of the time: the contacts may be inverted or dead"
        ]
    return []


def _tracker(m: Measurement) -> list[str]:
    if m.position is None or len(m.time) < 2:
        return []
    width = max(len(m.time) // 10, 1)
    way = np.linalg.norm(m.position[width:, :2] - m.position[:-width, :2], axis=-1)
    speed = float(np.nanmedian(way / (m.time[width:] - m.time[:-width])))
    if speed > SPEED:
        return [f"The tracker moves at {speed:.3g} m/s: its positions look like millimetres, not metres"]
    return []


def _slopes(m: Measurement) -> list[str]:
    steepest = max(abs(m.scenario.slope_roll), abs(m.scenario.slope_pitch))
    if steepest > STEEP:
        return [f"The ground is told to slope by {steepest:.3g} rad: that looks like degrees"]
    return []
