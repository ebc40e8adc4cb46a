"""`./tcbi import`: all logs become bags, or none does."""

from pathlib import Path

import pytest

from tcbi_bringup import cli

MAPPING = """
rig = "servo_bench"
joints = ["servo"]
[time]
column = "t"
[position]
column = "angle"
"""


def log(path: Path) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text("t,angle\n" + "".join(f"{0.01 * k:.2f},{0.1 * k:.1f}\n" for k in range(20)))
    return path


@pytest.fixture
def run(tmp_path, capsys):
    def call(*logs: Path) -> tuple[int, str]:
        mapping = tmp_path / "bench.toml"
        mapping.write_text(MAPPING)
        status = cli.main(["import", str(mapping), *map(str, logs), "--out", str(tmp_path / "bags")])
        return status, capsys.readouterr().err

    return call


def test_logs_of_one_name_and_bags_that_are_there_are_all_told_before_anything_is_written(run, tmp_path):
    fresh, old, other = (log(tmp_path / name) for name in ("a/fresh.csv", "a/old.csv", "a/other.csv"))
    assert run(old, other)[0] == 0
    status, told = run(fresh, old, other, log(tmp_path / "b/fresh.csv"))
    assert status == 1
    line = told.splitlines()[-1]
    for words in ("bags/old exists already", "bags/other exists already", "2 rollouts are named 'fresh'"):
        assert words in line
    assert sorted(bag.name for bag in (tmp_path / "bags").iterdir()) == ["old", "other"]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_columns_may_be_apart_by_semicolons_or_tabs(run, tmp_path, separator):
    path = log(tmp_path / "log.csv")
    path.write_text(path.read_text().replace(",", separator))
    assert run(path)[0] == 0


def test_a_log_whose_times_have_another_unit_is_told_at_once(run, tmp_path):
    path = log(tmp_path / "log.csv")
    path.write_text("t,angle\n" + "".join(f"{10 * k},{0.01 * k}\n" for k in range(20)))
    status, told = run(path)
    assert status == 0 and "note: The samples come 10 s apart: the times look as if they had another unit" in told


def test_the_name_of_the_times_column_is_asked_for_where_it_belongs(run, tmp_path):
    path = log(tmp_path / "log.csv")
    path.write_text(path.read_text().replace("t,angle", "stamp,angle"))
    status, told = run(path)
    assert status == 1 and "it has stamp, angle; correct the mapping (of the times: column in [time])" in told


def test_a_log_that_is_not_there_is_told_with_what_to_give(run, tmp_path):
    status, told = run(tmp_path / "gone.csv")
    assert status == 1 and told.endswith(
        "gone.csv: there is no such log; give a log (.json, .csv, .gz) or a folder of logs\n"
    )


def test_a_name_that_no_bag_can_have_stops_the_others_too(run, tmp_path):
    status, told = run(log(tmp_path / "a/fine.csv"), log(tmp_path / "a/.csv"))
    assert status == 1 and "'' is no plain file name" in told
    assert not (tmp_path / "bags").exists()
