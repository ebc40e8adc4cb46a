"""Charts for the browser."""

import json
import math

import pytest

from tcbi_dashboard import charts

ESTIMATE = {"name": "backlash.gap", "unit": "rad", "value": 0.05, "low90": 0.04, "high90": 0.06, "null": 0.0}
CANDIDATE = {"use": "backlash", "elpd_gain": 10.0, "elpd_se": 2.0}
MOMENT = {"signal": "lf_coxa", "unit": "deg", "time": [0.0, 0.1], "measured": [1.0, None], "before": [0.0, 0.5],
          "after": {"backlash": [0.9, 1.0]}}  # fmt: skip
MASS = {"name": "mass", "unit": "kg", "low": 0.1, "high": 1.0, "scale": "linear"}
MADE = {
    "over_floor": charts.over_floor({"v0": {"lf_coxa": 3.0, "roll": math.nan}, "v1": {"lf_coxa": 1.0}}),
    "heat": charts.heat(["a", "b"], ["moving"], [[2.0, None]]),
    "curve": charts.curve("slope", "deg", [1.0, 2.0], [1.5, math.nan]),
    "gains": charts.gains([CANDIDATE], ["backlash"]),
    "interval": charts.interval(ESTIMATE),
    "moment": charts.moment(MOMENT, "backlash"),
    "history": charts.history({"a-v0": 27.0, "a-v1": None, "a-v2": 3.0}, {"a-v1": "a-v0", "a-v2": "a-v0"}),
    "ladder": charts.ladder({"model": 5.0}),
    "pair": charts.pair(MASS, {**MASS, "name": "friction", "unit": "1", "scale": "log"}, [[0.5, 0.6]]),
    "lines": charts.lines("steps", "return", {"mean": [(0, 1.0), (1, math.inf)]}),
    "levels": charts.levels(["a"], "position / deg", 30.0),
}


def axes(options, which):
    """The axes of a chart, as a list."""
    found = options[which]
    return found if isinstance(found, list) else [found]


@pytest.mark.parametrize("name", MADE)
def test_a_chart_is_json_that_any_browser_reads(name):
    json.dumps(MADE[name], allow_nan=False)


@pytest.mark.parametrize("name", MADE)
def test_every_axis_with_numbers_has_a_title(name):
    numeric = [a for which in ("xAxis", "yAxis") for a in axes(MADE[name], which) if a["type"] != "category"]
    assert all(a.get("name") or a.get("show") is False for a in numeric)


def test_what_the_verdict_names_stands_out():
    series = charts.gains([CANDIDATE, {**CANDIDATE, "use": "payload"}], ["payload"])["series"]
    colors = [bar["itemStyle"]["color"] for bar in series[0]["data"]]
    assert colors == [charts.GREY, charts.BLUE]


def test_an_interval_that_vanishes_still_has_a_width():
    axis = charts.interval({**ESTIMATE, "low90": 0.05, "high90": 0.05, "null": None})["xAxis"]
    assert axis["min"] < 0.05 < axis["max"]


@pytest.mark.parametrize(
    ("value", "shown"), [(None, "–"), (math.nan, "–"), (0.0123456, "0.0123"), (12345.6, "12,346"), (0.0, "0")]
)
def test_numbers_are_for_people(value, shown):
    assert charts.number(value) == shown


def test_a_version_is_joined_with_its_parent_and_not_with_the_one_before():
    errors = {"a-v0": 27.0, "a-v1": 5.0, "a-v2": 3.0}
    made = charts.history(errors, {"a-v0": None, "a-v1": "a-v0", "a-v2": "a-v0"})
    joined = [s["data"] for s in made["series"] if s["type"] == "line"]
    assert joined == [[[0, 27.0], [1, 5.0]], [[0, 27.0], [2, 3.0]]]
    assert made["xAxis"]["data"] == ["v0", "v1", "v2\nfrom v0"]


def test_a_version_without_a_figure_has_no_point_and_no_line():
    series = MADE["history"]["series"]
    assert [p["name"] for p in series[-1]["data"]] == ["a-v0", "a-v2"]
    assert len([s for s in series if s["type"] == "line"]) == 1
