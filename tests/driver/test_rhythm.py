"""When the driver measures: at one distance from the control ticks, whatever the link's delay, and after stalls too."""

import time

import numpy as np
import pytest

from hexapod_driver.robot import READ_PERIOD_S, READ_PHASE_S, _out_of_phase
from hexapod_driver.timer import Timer


def test_a_timer_keeps_its_rhythm_and_leaves_out_what_was_missed():
    timer = Timer(0.02, 1.0)
    assert timer.due(1.001) and not timer.due(1.015) and timer.due(1.021)
    assert timer.due(1.075), "late"
    assert not timer.due(1.0799) and timer.due(1.0801)
    timer.shift(0.004)
    assert not timer.due(1.103) and timer.due(1.105)


@pytest.mark.parametrize("late", [-0.009, -0.001, 0.0, 0.006, 0.0099])
def test_how_far_a_reading_is_out_of_phase(late):
    stamp = 1_800_000_000.0 + 7 * READ_PERIOD_S + READ_PHASE_S + late
    assert _out_of_phase(round(stamp * 1e9)) == pytest.approx(late, abs=1e-6)


@pytest.mark.real_time
@pytest.mark.parametrize("ports", [1, 2])
def test_joints_are_measured_close_behind_each_control_tick(make_bench, make_driver, ports):
    bench = make_bench(ports=ports)
    driver = make_driver(bench.paths).start()
    time.sleep(1.5)
    stamps = np.array([reading.stamp_ns for reading in driver.joints])
    late = np.array([_out_of_phase(int(stamp)) for stamp in stamps[stamps > stamps[-1] - 500_000_000]])
    assert len(late) >= 20 and abs(float(np.median(late))) < 0.002, late
