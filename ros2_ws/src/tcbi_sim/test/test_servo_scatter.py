"""Each servo gets a gain of its own, where there are siblings to differ from."""

import pytest

from tcbi_sim.effects import find_use
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig
from tcbi_sim.scatter import with_scatter


def test_every_servo_gets_a_gain_that_is_one_where_it_is_like_the_others():
    model = base_model("hexapod")
    scattered, joints = with_scatter(model)
    assert joints == tuple(load_rig("hexapod").joint_names)
    assert len(scattered.effects) == len(joints)
    assert {find_use(key, load_rig("hexapod")).effect.parameters[0].null for key in scattered.effects} == {1.0}
    assert model.effects == base_model("hexapod").effects


def test_a_servo_whose_gain_is_a_parameter_already_keeps_its_own():
    model = base_model("hexapod").with_effect("gain_scatter:lm_femur")
    scattered, joints = with_scatter(model)
    assert "lm_femur" not in joints and len(joints) == 17
    assert list(scattered.effects).count("gain_scatter:lm_femur") == 1


@pytest.mark.parametrize("rig", ["servo_bench", "double_pendulum"])
def test_a_rig_without_siblings_is_left_as_it_is(rig):
    model = base_model(rig)
    assert with_scatter(model) == (model, ())
