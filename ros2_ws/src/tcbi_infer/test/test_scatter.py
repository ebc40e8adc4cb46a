"""Each joint's own gain: found beside what jumps, kept by the version that a diagnosis makes."""

import dataclasses

import numpy as np
import pytest
from legged_cases import walk
from scipy.linalg import hadamard

from tcbi_infer.compare import compare
from tcbi_infer.diagnose import diagnose
from tcbi_infer.diagnose.adopt import adopt
from tcbi_infer.diagnose.fit import Nuisance
from tcbi_infer.diagnose.scatter import SCATTER, joint_gains, slopes
from tcbi_infer.diagnose.settings import QUICK
from tcbi_sim.model import base_model

SIGNS = hadamard(32)[:, 1:19].astype(float)
RNG = np.random.default_rng(0)
TRUE = RNG.normal(size=(18, 40))


def test_slopes_are_exact_where_predictions_are_linear():
    np.testing.assert_allclose(slopes(SIGNS, 5.0 + SIGNS @ TRUE), TRUE.T, atol=1e-12)


def test_jumps_of_a_simulation_weigh_an_nth():
    jumps = RNG.normal(size=(32, 40))
    assert (slopes(SIGNS, SIGNS @ TRUE + jumps).T - TRUE).std() == pytest.approx(1 / np.sqrt(32), rel=0.1)


def test_what_diverged_bends_slopes_only_as_much_as_it_lacks():
    predicted = SIGNS @ TRUE
    predicted[3, :20] = predicted[:, 39] = np.nan
    found = slopes(SIGNS, predicted).T
    np.testing.assert_allclose(found[:, 20:39], TRUE[:, 20:39], atol=1e-12)
    assert (found[:, 39] == 0.0).all() and 0 < np.abs(found[:, :20] - TRUE[:, :20]).max() < 1.0


def test_gains_are_those_that_the_model_knows_times_what_was_fitted():
    model = base_model("hexapod")
    nuisance = Nuisance(np.zeros((1, 1, 1, 2)), ("lf_femur", "rr_tibia"))
    found = joint_gains(model, nuisance, np.array([1.0, -2.0]))
    assert found == (1.0, 1.0 + SCATTER, *[1.0] * 15, 1.0 - 2 * SCATTER)
    again = joint_gains(dataclasses.replace(model, joint_gains=found), nuisance, np.array([1.0, 0.0]))
    assert again == pytest.approx((1.0, (1.0 + SCATTER) ** 2, *[1.0] * 15, 1.0 - 2 * SCATTER))
    assert joint_gains(model, Nuisance(np.zeros((1, 1, 1, 0)), ()), np.zeros(0)) == ()


def test_the_version_that_a_diagnosis_makes_knows_the_gains_and_predicts_better_by_them():
    model = base_model("hexapod")
    gains = 1.0 + SCATTER * np.random.default_rng(1).normal(size=18)
    robot = dataclasses.replace(model, joint_gains=tuple(gains / np.exp(np.log(gains).mean())))
    values = np.array([0.7, 0.75, 2.0])
    recorded = walk(robot, values, count=4)
    seen, unseen = recorded[:-2], recorded[-2:]
    settings = dataclasses.replace(QUICK, escape=False)
    fitted = adopt(model, "", diagnose(model, seen, uses=[], settings=settings).to_json())
    assert np.corrcoef(fitted.joint_gains, robot.joint_gains)[0, 1] > 0.8
    alike = dataclasses.replace(fitted, joint_gains=())
    error, before = (compare(m, unseen, particles=0).error_over_floor for m in (fitted, alike))
    assert error - 1.0 < 0.7 * (before - 1.0)
