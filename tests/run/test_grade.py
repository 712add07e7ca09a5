"""The grade of a run reaches its record, its file, the console and the report."""

from fieldstone.cli.console import plain_console, show_grade
from fieldstone.records.mapping import Grade, GradeReason, RunRecord
from fieldstone.run.reconstruct import reconstruct
from fieldstone.run.scene import open_scene


def test_a_run_is_graded(house_photos, tmp_path):
    scene = reconstruct(house_photos, keep_in=tmp_path / "out", threads=1)
    assert scene.grade is not None
    assert scene.grade.word != "doubtful"
    assert scene.grade.pairs > 0
    assert open_scene(tmp_path / "out", photos=house_photos).grade == scene.grade
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    body = page[page.index("<main>") :]
    assert body.index(f'class="grade {scene.grade.word}"') < body.index('class="facts"')
    record = scene.record
    assert isinstance(record, RunRecord)
    assert record.seconds["grading"] > 0


def test_the_console_says_why_and_what_to_do(capsys):
    reason = GradeReason("doubtful", "two lenses in one folder", "give each its own folder")
    show_grade(plain_console(), Grade("doubtful", (reason,)))
    shown = capsys.readouterr().out
    assert shown.splitlines() == ["grade: doubtful", "  doubtful: two lenses in one folder; give each its own folder"]
