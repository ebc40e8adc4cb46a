"""Reports: self-contained, escaped, written whole."""

import dataclasses
import re

import pytest

from tcbi_infer.diagnose.evidence import Agreement, Diagnosis, Evidence, KindValue, ParameterEstimate
from tcbi_infer.errors import InferError
from tcbi_infer.report import Report, Section, Table, add_diagnosis, add_history
from tcbi_infer.report.page import cell

SIZE = ParameterEstimate("coulomb_friction.torque", "N m", 0.055, 0.05, 0.061, 0.0)
NAMED = Evidence("coulomb_friction", "coulomb_friction", 310.0, 42.0, 7.3, 4.1, 1.4, (SIZE,), True, True, True)
OTHER = dataclasses.replace(
    NAMED, effect="weak_leg", use="weak_leg:lm", elpd_gain=5.0, accepted=False, reason="too weak"
)
DIAGNOSIS = Diagnosis(
    model="hexapod-v0",
    verdict="effect",
    effects=("coulomb_friction",),
    uses=("coulomb_friction",),
    statement="The model lacks coulomb_friction.",
    ranking=(NAMED, OTHER),
    seconds=80.0,
    rollouts=("a", "b"),
    sealed=("b",),
    threshold=2.2,
    errors={"unfitted": 40.0, "base": 4.1, "coulomb_friction": 1.4},
    floor_from_replicates=True,
    untestable=("lost_commands",),
    guards=(),
    claims=("7 kinds of motion were held out in turn.",),
    base=NAMED,
)


def page() -> str:
    report = Report("What does the model lack?", "Two rollouts.")
    add_diagnosis(report, DIAGNOSIS)
    add_history(report, [("hexapod-v0", "–", "none", 9.3), ("hexapod-v1", "hexapod-v0", "backlash", 1.4)])
    return report.html()


def test_a_version_that_diverged_is_marked_in_the_history_and_one_that_was_not_measured_is_not():
    report = Report("Model versions")
    nan, inf = float("nan"), float("inf")
    add_history(report, [("v0", "–", "none", inf), ("v1", "v0", "backlash", 1.4), ("v2", "v1", "none", nan)])
    assert report.html().count(">diverged<") == 1
    add_history(report, [("v0", "–", "none", inf)])


def test_a_report_loads_nothing_from_elsewhere():
    links = re.findall(r'(?:src|href)="([^"]+)"', page()) + re.findall(r"@import|url\((?!#)", page())
    assert all(link.startswith("#") for link in links)


def test_verdict_ranking_size_and_caveats_are_on_the_page():
    text = page()
    for words in ("The model lacks coulomb_friction.", "weak_leg:lm", "0.055 N m", "lost_commands", "held out in turn"):
        assert words in text


def test_not_every_effect_was_tried_where_some_were_left_out():
    assert "Every effect of the library was tried" in page()
    report = Report("What does the model lack?")
    found = dataclasses.replace(DIAGNOSIS, verdict="outside_library", untried=("payload",))
    add_diagnosis(report, found)
    assert "Not every effect of the library was tried" in report.html()
    assert found.headline == "Something is missing that no effect tried explains"


def test_values_that_disagree_stand_in_a_table_and_in_a_sentence():
    own = tuple(KindValue(f"gait{k}", v, 0.9 * v, 1.1 * v) for k, v in enumerate((0.02, 0.055, 0.09)))
    doubted = Agreement("coulomb_friction.torque", "N m", 0.055, False, "The motions disagree on it.", own, 0.0003)
    unknown = Agreement("mass", "kg", 0.6, None, "Too few kinds know it.", ())
    report = Report("What does the model lack?")
    add_diagnosis(report, dataclasses.replace(DIAGNOSIS, agreement={"": (), "coulomb_friction": (doubted, unknown)}))
    (section,) = (s for s in report.sections if s.title.startswith("Do the motions agree"))
    assert list(section.notes) == ["The motions disagree on it."]
    assert section.table.head == ["motion", "coulomb_friction.torque / N m", "mass / kg"]
    rows = {row[0]: row[1:] for row in section.table.rows}
    assert list(rows) == ["gait0", "gait1", "gait2", "all together", "do they agree?", "p"]
    assert rows["gait2"] == ["0.09 (0.081 to 0.099)", "–"]
    assert rows["do they agree?"] == ["no", "cannot be told"] and rows["p"] == [0.0003, "–"]


def test_the_headline_is_no_surer_than_the_verdict():
    def headline(**changes) -> str:
        report = Report("What does the model lack?")
        add_diagnosis(report, dataclasses.replace(DIAGNOSIS, verdict="cannot_tell", **changes))
        return report.sections[0].title

    unsure = (dataclasses.replace(NAMED, accepted=False), OTHER)
    assert headline() == "An effect is missing, but which one cannot be told"
    assert headline(ranking=unsure) == "An effect may be missing"
    little = [dataclasses.replace(e, accepted=True, error_before=3.2, error_after=2.9, held_out=None) for e in unsure]
    assert headline(ranking=little[:1]) == "Something is missing, of which little is explained"
    assert headline(ranking=(), effects=(), uses=(), kinds=1) == "These rollouts cannot tell"


def test_a_fit_that_did_not_converge_has_a_headline_of_its_own_and_its_errors_are_of_held_out_motions():
    stuck = dataclasses.replace(NAMED, use="", converged=False, accepted=False, held_out=(6.0, 6.0))
    doubted = dataclasses.replace(DIAGNOSIS, verdict="cannot_tell", base=stuck, kinds=7)
    nameless = dataclasses.replace(doubted, effects=(), uses=(), ranking=())
    assert doubted.headline == nameless.headline == "The fit of the model did not converge"
    assert not nameless.nothing_held_out and nameless.to_json()["nothing_held_out"] is False
    assert nameless.to_json()["kinds"] == 7 and dataclasses.replace(nameless, kinds=1).nothing_held_out
    well = dataclasses.replace(stuck, held_out=(1.4, 1.4))
    unsure = (dataclasses.replace(NAMED, accepted=False),)
    assert dataclasses.replace(doubted, base=well, ranking=unsure).headline == "An effect may be missing"


def test_figures_take_the_colour_of_the_page_and_share_no_ids():
    ids = re.findall(r' id="([^"]+)"', page())
    assert "currentColor" in page() and len(ids) == len(set(ids))


def test_text_from_recordings_cannot_become_markup():
    report = Report("<b>bag</b>")
    report.add(Section("s", notes=["<script>alert(1)</script>"], table=Table(["a"], [["<i>"]])))
    assert "<script>" not in report.html() and "<b>bag" not in report.html() and "<i>" not in report.html()


def test_json_of_a_diagnosis_has_the_keys_of_the_contract():
    data = DIAGNOSIS.to_json()
    assert {"model", "verdict", "effects", "ranking", "seconds"} <= set(data)
    keys = {"effect", "elpd_gain", "elpd_se", "error_before", "error_after", "parameters"}
    assert keys <= set(data["ranking"][0])
    assert {"name", "unit", "value", "low90", "high90", "null"} <= set(data["ranking"][0]["parameters"][0])


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InferError, match="cannot write the report"):
        Report("x").write(tmp_path / "file" / "report.html")


@pytest.mark.parametrize(
    ("value", "text"), [(1.23456, "1.23"), (float("nan"), "–"), (None, "–"), (12345.6, "12,346"), (True, "yes")]
)
def test_cells_are_short(value, text):
    assert cell(value) == text
