"""Rows of benchmarks: what is written is read back, and worse is told from better in both directions."""

import json
from dataclasses import replace

import pytest
from benchmarks.compare import compare, main
from benchmarks.rows import Row, read_rows, write_rows

FAST = Row("bundle/ring/cpu", 2.0, "s", "lower", 0.1, "ceres", 4.0, machine="here")
SHARP = Row("field/lego/psnr", 30.0, "dB", "higher", 0.05, machine="here")


def verdicts(before, after):
    return {change.metric: change.verdict for change in compare(before, after)}


def test_rows_are_read_as_they_were_written(tmp_path):
    write_rows([FAST, SHARP], tmp_path / "a" / "rows.json")
    again = read_rows(tmp_path / "a")
    assert [replace(row, commit="", machine="here") for row in again] == [FAST, SHARP]
    assert all(row.machine for row in again)
    documents = json.loads((tmp_path / "a" / "rows.json").read_text())
    assert [document["ratio"] for document in documents] == [0.5, None]


def test_a_metric_is_measured_once(tmp_path):
    with pytest.raises(ValueError, match=r"measured twice.*bundle/ring/cpu"):
        write_rows([FAST, FAST], tmp_path / "rows.json")


@pytest.mark.parametrize("text", ["{", "3", '{"metric": "a"}', '[{"metric": "a"}]', '["a"]'])
def test_other_files_are_refused(tmp_path, text):
    (tmp_path / "rows.json").write_text(text)
    with pytest.raises(ValueError, match=r"rows\.json holds no rows"):
        read_rows(tmp_path / "rows.json")


@pytest.mark.parametrize(("value", "expected"), [(2.19, "same"), (2.21, "worse"), (1.81, "same"), (1.79, "better")])
def test_less_is_better_for_time(value, expected):
    assert verdicts([FAST], [replace(FAST, value=value)]) == {FAST.metric: expected}


@pytest.mark.parametrize(("value", "expected"), [(28.4, "worse"), (28.6, "same"), (31.4, "same"), (31.6, "better")])
def test_more_is_better_for_quality(value, expected):
    assert verdicts([SHARP], [replace(SHARP, value=value)]) == {SHARP.metric: expected}


def test_a_slower_machine_is_not_worse_where_the_peer_is_slower_too():
    assert verdicts([FAST], [replace(FAST, value=6.0, peer_value=12.0, machine="there")]) == {FAST.metric: "same"}
    assert verdicts([FAST], [replace(FAST, value=2.0, peer_value=2.0, machine="there")]) == {FAST.metric: "worse"}


def test_without_a_common_peer_only_one_machine_is_compared():
    assert verdicts([SHARP], [replace(SHARP, value=1.0, machine="there")]) == {SHARP.metric: "not comparable"}
    assert verdicts([FAST], [replace(FAST, peer="scipy", machine="there")]) == {FAST.metric: "not comparable"}
    assert verdicts([FAST], [replace(FAST, peer=None, peer_value=None)]) == {FAST.metric: "same"}
    assert verdicts([FAST], [replace(FAST, unit="ms")]) == {FAST.metric: "not comparable"}


def test_a_number_that_is_no_longer_finite_is_worse():
    assert verdicts([SHARP], [replace(SHARP, value=float("nan"))]) == {SHARP.metric: "worse"}
    assert verdicts([replace(SHARP, value=float("nan"))], [SHARP]) == {SHARP.metric: "better"}


def test_metrics_come_and_go():
    assert verdicts([FAST], [SHARP]) == {FAST.metric: "gone", SHARP.metric: "new"}


def test_the_exit_code_tells_whether_anything_got_worse(tmp_path, capsys):
    before, after = tmp_path / "before.json", tmp_path / "after.json"
    write_rows([FAST, SHARP], before)
    write_rows([replace(FAST, value=3.0), SHARP], after)
    assert main([str(before), str(after)]) == 1
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first.split() == ["worse", "bundle/ring/cpu", "0.5", "->", "0.75", "x", "ceres"]
    assert last.startswith("1 worse, 0 gone")
    assert main([str(before), str(after), "--slack", "6"]) == 0
    assert main([str(after), str(before)]) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [({"better": "more"}, "lower or higher"), ({"peer": None}, "peer"), ({"tolerance": -1.0}, "-1.0")],
)
def test_half_a_row_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(FAST, **change)
