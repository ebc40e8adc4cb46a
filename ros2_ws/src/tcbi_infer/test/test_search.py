"""Which candidates are fitted, from which starts and how far; simulations are counted, none is run."""

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tcbi_infer.diagnose import base_fit, search
from tcbi_infer.diagnose.base_fit import better_base
from tcbi_infer.diagnose.fit import Nuisance
from tcbi_infer.diagnose.search import Search, merged
from tcbi_infer.diagnose.settings import QUICK, Settings

BASE_LOSS = 1000.0
BASE = np.array([0.5, 0.5])
NO_SCATTER = Nuisance(np.zeros((1, 1, 1, 0)), ())


class Fake:
    """A fitter of one use, or of the base model; notes in `calls` what it was asked.

    Fits end at `losses`; before them, a few sets lose as much, unless `few` says how much.
    """

    calls: list[tuple[str, str]]
    losses: dict[str, float]
    few: dict[str, float]
    starts: dict[str, np.ndarray]

    def __init__(self, problem: Any, model: str, *_: Any) -> None:
        self.model = model

    def on_few_sets(self) -> "Fake":
        return self

    def few_positions(self) -> np.ndarray:
        return np.array([0])

    def predict(self, starts: np.ndarray) -> np.ndarray:
        self.calls.append(("predict", self.model))
        return np.atleast_2d(starts)

    def start_losses(self, predicted: np.ndarray, _: Any) -> list[float]:
        return [self.few.get(self.model, self.losses[self.model])] * len(predicted)

    def run(self, starts: np.ndarray, steps: Sequence[float] = ()) -> Any:
        self.starts[self.model] = starts
        return fitted(self.model, self.losses[self.model])


def leapt(fitter: Fake, fit: Any, *_: Any) -> Any:
    fitter.calls.append(("leapt", fitter.model))
    return fit


def rescaled(fitter: Fake, fit: Any) -> Any:
    fitter.calls.append(("rescaled", fitter.model))
    return fit


def fitted(model: str, loss: float) -> Any:
    return SimpleNamespace(model=model, total=loss, unit=np.r_[BASE, 0.3], scatter=NO_SCATTER, nuisance=np.zeros(0))


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A search among uses of which each fit ends at a loss that a test wants, and the calls that it makes."""

    def make(losses: dict[str, float]) -> tuple[Search, list[tuple[str, str]]]:
        Fake.calls, Fake.losses, Fake.few, Fake.starts = [], {"base": BASE_LOSS, **losses}, {}, {}

        def starts(screen: Any, data: Any, use: int, base: Any, fitter: Fake) -> np.ndarray:
            Fake.calls.append(("starts", fitter.model))
            return np.array([[0.1, 0.2, use]])

        def fine(problem: Any, fit: Any, *_: Any) -> Any:
            Fake.calls.append(("fine", next(u for u, loss in losses.items() if loss == fit.total)))
            return fit

        monkeypatch.setattr(search, "Fitter", Fake)
        monkeypatch.setattr(search, "start_points", starts)
        monkeypatch.setattr(search, "refined", fine)
        monkeypatch.setattr(search, "leapt", leapt)
        monkeypatch.setattr(search, "rescaled", rescaled)
        monkeypatch.setattr(search, "resized", lambda fitter, fine, rough, count: fine)
        screen = SimpleNamespace(
            sizes=np.ones(5, int),
            data=None,
            directions=SimpleNamespace(uses=tuple(losses), models=tuple(losses)),
            sized=lambda data, use, sizes, count: np.array(sizes)[:, None],
        )
        scatter = SimpleNamespace(effect=np.zeros((1, 1, 1, 1)), names=("lf_coxa",))
        base = SimpleNamespace(unit=BASE, model="base", scatter=scatter, nuisance=np.zeros(1))
        gains, quiet = np.ones((5, len(losses))), lambda stage, share: None
        settings: Any = Settings()
        sets: Any = np.array([0])
        problem: Any = None
        made = Search(problem, base, BASE_LOSS, screen, gains, sets, settings, quiet)  # type: ignore[arg-type]
        return made, Fake.calls

    return make


def asked(calls: list[tuple[str, str]], what: str) -> list[str]:
    return [use for name, use in calls if name == what]


def test_starts_far_from_the_base_fit_are_looked_for_once(made):
    looked, calls = made({"a": 500.0, "b": 300.0, "c": 200.0, "d": 400.0})
    chosen = looked.hidden([0])
    assert list(chosen) == [2, 1] and asked(calls, "starts") == ["b", "c", "d"]
    looked.fit(chosen, (0.8, 0.85))
    assert asked(calls, "starts") == ["b", "c", "d"]
    assert Fake.starts["c"].tolist() == [[0.1, 0.2, 2]]


def test_of_an_effect_with_places_the_one_that_explains_most_is_looked_for_and_none_again_that_was_fitted(made):
    looked, calls = made({"leg:a": 500.0, "leg:b": 300.0, "leg:c": 200.0, "damping": 400.0})
    assert list(looked.hidden([0])) == [2, 3]
    assert asked(calls, "starts") == ["leg:c", "damping"], "not fitted yet"
    assert not looked.hidden([0, 1, 2, 3])


def test_who_gains_a_hundredth_of_the_best_one_gets_neither_other_valleys_nor_fine_steps(made):
    looked, calls = made({"best": 100.0, "poor": 991.0, "fair": 700.0})
    Fake.few = {"poor": 500.0}
    fits = looked.fit([0], (0.5, 0.7))
    assert asked(calls, "rescaled") == asked(calls, "leapt") == asked(calls, "fine") == ["best"]
    later = looked.fit([1, 2], (0.7, 0.8), fits)
    assert list(later) == [2]
    assert asked(calls, "leapt") == ["best"] and asked(calls, "fine") == ["best", "fair"]


def test_who_gains_nothing_on_a_few_sets_is_not_fitted_to_all(made):
    looked, _ = made({"best": 100.0, "poor": 991.0, "fair": 700.0})
    assert list(looked.fit([0, 1, 2], (0.5, 0.7))) == [0, 2]
    assert list(Fake.starts) == ["best", "fair"]
    little, _ = made({"best": 995.0, "next": 999.5})
    assert list(little.fit([0, 1], (0.5, 0.7))) == [0], "too little to tell from a few sets"
    assert list(Fake.starts) == ["best", "next"]


def test_the_best_one_by_screening_is_fitted_whatever_a_few_sets_say(made):
    looked, _ = made({"best": 100.0, "poor": 991.0})
    looked = dataclasses.replace(looked, gains=np.array([1.0, 2.0]) * looked.gains)
    assert list(looked.fit([0, 1], (0.5, 0.7))) == [0], "with coarse steps, and no further"
    assert list(Fake.starts) == ["best", "poor"]


def test_who_leads_over_all_that_was_fitted_looks_for_other_valleys(made):
    looked, calls = made({"first": 700.0, "leader": 100.0, "second": 650.0})
    fits = looked.fit([0], (0.5, 0.7))
    assert list(looked.fit([1, 2], (0.7, 0.8), fits)) == [1, 2]
    assert asked(calls, "rescaled") == asked(calls, "leapt") == ["first", "leader"]


def test_a_nuisance_is_no_rival(made):
    uses = ["weak_leg:lf", "gain_scatter:lf_coxa", "gain_scatter:rf_coxa", "joint_offset:lf_coxa"]
    looked, calls = made(dict.fromkeys(uses, 100.0))
    leader = fitted(uses[0], 100.0)
    rivals = looked.rivals({0: (leader, leader)})
    assert asked(calls, "predict") == ["base", "weak_leg:lf", "gain_scatter:rf_coxa", "joint_offset:lf_coxa"]
    assert list(rivals) == [2, 3]
    assert rivals[2].tolist() == [[*BASE, search.RIVAL_SIZES[0]]] and not asked(calls, "starts")


@pytest.mark.parametrize(("own", "found"), [(3000.0, [1]), (1050.0, []), (500.0, [])])
def test_a_rival_explains_a_fifth_of_what_the_leader_does_over_the_base_model_by_itself(made, monkeypatch, own, found):
    looked, _ = made({"leader": 100.0, "other": 900.0})
    leader = SimpleNamespace(**{**vars(fitted("leader", 100.0)), "unit": np.array([0.9, 0.9, 0.3])})

    def losses(self: Fake, predicted: np.ndarray, _: Any) -> list[float]:
        if self.model == "base":
            return [4000.0 if np.allclose(unit, 0.9) else own for unit in predicted]
        assert np.allclose(predicted[:, :2], 0.9), "in the leader's place"
        return [Fake.losses[self.model]] * len(predicted)

    monkeypatch.setattr(Fake, "start_losses", losses)
    assert list(looked.rivals({0: (leader, leader)})) == found


@pytest.mark.parametrize(("there", "again"), [(300.0, True), (900.0, False)])
def test_a_use_that_was_fitted_is_tried_in_the_place_of_the_leader(made, monkeypatch, there, again):
    looked, _ = made({"leader": 100.0, "stuck": 600.0})
    leader, stuck = (
        SimpleNamespace(**{**vars(fitted(use, loss)), "unit": np.array(unit)})
        for use, loss, unit in (("leader", 100.0, [0.9, 0.9, 0.3]), ("stuck", 600.0, [0.2, 0.2, 0.3]))
    )

    def losses(self: Fake, predicted: np.ndarray, _: Any) -> list[float]:
        far = {"base": 4000.0, "leader": 100.0, "stuck": there}[self.model]
        near = {"base": 3000.0, "leader": 100.0, "stuck": 600.0}[self.model]
        return [far if unit[0] > 0.5 else near for unit in predicted]

    monkeypatch.setattr(Fake, "start_losses", losses)
    fits = {0: (leader, leader), 1: (stuck, stuck)}
    assert list(looked.rivals(fits)) == [1] * again


def test_of_a_use_that_was_fitted_twice_the_better_fit_stays():
    good, bad, other = fitted("a", 1.0), fitted("a", 2.0), fitted("b", 3.0)
    assert merged({0: (good, good)}, {0: (bad, bad), 1: (other, other)}) == {0: (good, good), 1: (other, other)}
    assert merged({0: (bad, bad)}, {0: (good, good)}) == {0: (good, good)}


class TwoValleys:
    """A fitter of one parameter whose loss is 50 in the wide valley at 0.2 and 0 in the narrow one at 0.8."""

    used = whole = 0  # how many were made, and how many whole fits
    sets = np.arange(2)

    def __init__(self, *_: Any) -> None:
        TwoValleys.used += 1

    def on_few_sets(self) -> "TwoValleys":
        return self

    def loss(self, unit: np.ndarray) -> float:
        return float(min(50 + 100 * abs(unit[0] - 0.2), 2000 * abs(unit[0] - 0.8)))

    def run(self, starts: np.ndarray, nuisance: Any = None, radii: Sequence[float] = (), valleys: bool = True) -> Any:
        TwoValleys.whole += valleys
        start = min(starts, key=self.loss)
        unit = np.array([0.8 if start[0] > 0.7 else 0.2])
        return SimpleNamespace(unit=unit, total=self.loss(unit), scatter=NO_SCATTER)


def base_again(monkeypatch: pytest.MonkeyPatch, *starts: float) -> Any:
    """The base model's fit where candidates ended at these base parameters, the present one being at 0.2."""
    monkeypatch.setattr(base_fit, "Fitter", TwoValleys)
    TwoValleys.used = TwoValleys.whole = 0
    nothing: Any = None
    coarse: Any = SimpleNamespace(model=None, unit=np.array([0.2]), total=50.0, scatter=NO_SCATTER)
    fits: Any = [SimpleNamespace(unit=np.array([start, 0.5]), total=0.0) for start in starts]
    return better_base(nothing, np.arange(5), Settings(), coarse, fits, lambda stage, share: None)


@pytest.mark.parametrize("starts", [(0.22, 0.3, 0.75), (0.75,)])
def test_a_valley_far_off_is_shown_to_the_base_model_though_a_nearer_start_loses_less(monkeypatch, starts):
    better = base_again(monkeypatch, *starts)
    assert better is not None and better.unit[0] == pytest.approx(0.8)


def test_where_a_start_falls_back_on_few_sets_no_whole_fit_is_made(monkeypatch):
    assert base_again(monkeypatch, 0.3) is None
    assert TwoValleys.used == 1 and TwoValleys.whole == 0


@pytest.mark.parametrize("starts", [(), (0.17, 0.24)])
def test_the_base_model_is_not_fitted_again_from_where_it_is(monkeypatch, starts):
    assert base_again(monkeypatch, *starts) is None
    assert TwoValleys.used == 0


def test_one_kind_of_motion_that_went_otherwise_costs_no_effect_its_fit(made):
    looked, _ = made({"right": 100.0, "little": 700.0})
    gains = np.array([[-52.0, -0.4, 15.9, 5.6, 12.9], [2.0, 1.0, 2.0, 1.0, 2.0]]).T
    looked = dataclasses.replace(looked, gains=gains, settings=QUICK)
    assert looked.best_by_screening() == [0]


@pytest.mark.parametrize(("loss", "better"), [(60.0, [0]), (100.0, [])])
def test_a_quick_search_looks_for_another_valley_only_when_asked_to(made, monkeypatch, loss, better):
    looked, _ = made({"best": 100.0, "elsewhere": 60.0})
    looked = dataclasses.replace(looked, settings=QUICK)
    fit = fitted("best", 100.0)
    fits = {0: (fit, fit)}
    monkeypatch.setattr(search, "leapt", lambda _, fit, count: fitted("best", loss) if loss < fit.total else fit)
    assert list(looked.elsewhere(fits)) == better
    assert dataclasses.replace(looked, settings=Settings()).elsewhere(fits) == {}, "it has looked there already"
