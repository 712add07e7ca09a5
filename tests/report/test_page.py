"""The page says what the run wrote, all of it, and can neither be broken nor made to act by it."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fieldstone.errors import InputError
from fieldstone.mapping.textbook import TextbookOptions, map_textbook
from fieldstone.records.field import CurvePoint, FieldMetrics, ViewScores
from fieldstone.records.mapping import CameraRecord, DropRecord, PhotoVerdict, RunRecord, TruthErrors
from fieldstone.report.figure_store import read_index, write_figures
from fieldstone.report.figures import FigureOptions, field_figures, mapping_figures, pairs_to_show, thumbnails
from fieldstone.report.page import Story
from fieldstone.run.folder import RunFolder
from fieldstone.run.scene import summary_of
from fieldstone.synthetic.scenes import SceneOptions, synthesize

NASTY = (
    "<script>alert(1)</script>.png",
    '"><img src=x onerror=alert(1)>.png',
    "' onload='alert(1).png",
    "{{ 7 * 7 }}{% raw %}.png",
    "</style><style>body{background:url(https://example.com/x)}.png",
    "javascript:alert(1)//照片&amp;.png",
)
VOID = {"meta", "img", "source", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Elements, attributes, text and balance of a page."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.text: list[str] = []
        self.rows: list[list[str]] = []
        self.open: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text.append(data)
        if any(t in ("td", "th") for t in self.open):
            self.rows[-1][-1] += data


def assert_inert(html: str) -> Page:
    """No script, no handler, nothing loaded from elsewhere, and a policy that forbids all of it."""
    page = Page(html)
    assert not page.open
    assert not {"script", "iframe", "object", "embed", "link", "base", "form", "input"} & set(page.tags)
    assert page.tags.count("style") == 1
    for tag, name, value in page.attributes:
        assert not name.startswith("on"), (tag, name)
        assert name != "style"  # the policy forbids it, so it would do nothing
        if name in ("src", "srcset"):
            assert re.fullmatch(r"data:image/(svg\+xml|jpeg);base64,[A-Za-z0-9+/=]+", value)
        if name == "href":
            assert value.startswith("#")
    (policy,) = (v for t, n, v in page.attributes if n == "content" and "default-src" in v)
    (css,) = re.findall(r"<style>(.*?)</style>", html, flags=re.DOTALL)
    assert "url(" not in css
    assert "@import" not in css
    digest = base64.b64encode(hashlib.sha256(css.encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; img-src data:; style-src 'sha256-{digest}';")
    assert "unsafe" not in policy
    return page


def renamed(graph, names):
    return type(graph)(names, graph.keypoints, graph.colors, graph.matches, graph.two_views)


@pytest.fixture(scope="module")
def mapped():
    """A run on photos with nasty names."""
    options = SceneOptions(num_cameras=4, num_points=100, layout="arc", noise_px=0.5, outlier_share=0.2)
    scene = synthesize(options, np.random.default_rng(0))
    camera_of_image = np.array([view.camera for view in scene.truth.views])
    graph = renamed(scene.graph, NASTY[:4])
    return map_textbook(graph, scene.truth.cameras, camera_of_image, TextbookOptions(), 0)


def run_record(run) -> RunRecord:
    verdicts = [PhotoVerdict(n, v.startswith("registered"), v, 10) for n, v in run.verdicts.items()]
    return RunRecord(
        version="0.1.0",
        input="<i>hall</i>",
        mapper="textbook",
        seed=7,
        seconds={"read_photos": 1.25, "map": 62.0},
        summary=summary_of(run.reconstruction, 5),
        components=(4, 2),
        cameras=(
            CameraRecord("PINHOLE", 1000, 750, (800.0, 810.5, 505.0, 370.0)),
            CameraRecord(
                "SIMPLE_RADIAL", 90, 60, (80.0, 45.0, 30.0, 0.1), (0.25, None, None, 0.01), "weak", "<b>few</b> points"
            ),
        ),
        notes=("focal <length> from EXIF of 3 photos",),
        photos=(*verdicts, PhotoVerdict(NASTY[5], False, "not registered: sees 3 points", 0)),
        table=tuple(record.row() for record in run.records),
        drops=tuple(DropRecord(d.stage, d.reason, d.observations) for d in run.drops),
        how_errors_are_counted="mean distance & <b>nothing</b> else",
        photos_folder="/home/someone/private",
        truth=TruthErrors(4, 0.0123, 0.02, 0.004, 0.005, 0.1),
    )


METRICS = FieldMetrics(
    psnr=21.5,
    ssim=0.75,
    views={NASTY[4]: ViewScores(21.5, 0.75)},
    protocol="8 <bit>",
    seconds=30.0,
    steps=4,
    field="fast",
    device="cpu",
    threads=1,
    seed=7,
    version="0.1.0",
)
CURVE = [CurvePoint(k, float(k), -float(k), 10.0 + k) for k in range(4)]


def photo_of(name: str):
    return np.random.default_rng(len(name)).integers(0, 256, size=(75, 100, 3), dtype=np.uint8)


OPTIONS = FigureOptions(max_pairs=1, max_photos=1)


@pytest.fixture(scope="module")
def folder(mapped, tmp_path_factory) -> Path:
    """The output folder of that run, report included."""
    out = tmp_path_factory.mktemp("out")
    write_figures(
        out / "figures", "mapping", mapping_figures(mapped, photo_of, OPTIONS), thumbnails(NASTY[:4], photo_of)
    )
    run = RunFolder(out)
    write_figures(run.figures, "field", field_figures(CURVE, photo_of, photo_of, METRICS.views))
    run.write_run(run_record(mapped))
    run.write_metrics(METRICS)
    run.write_curve(CURVE)
    run.write_report(Story(run_record(mapped), METRICS, CURVE))
    return out


def write_report(folder: Path) -> None:
    RunFolder(folder).write_report(RunFolder(folder).read_story())


def page_of(folder: Path) -> str:
    return (folder / "report.html").read_text(encoding="utf-8")


def test_page_is_inert_whatever_the_names(folder):
    page = assert_inert(page_of(folder))
    text = "".join(page.text)
    for name in NASTY:
        assert name in text  # shown as it is, not run, not swallowed


def test_page_holds_every_row_of_the_tables(folder, mapped):
    rows = Page(page_of(folder)).rows
    assert len(mapped.records) > 10
    for record in mapped.records:
        row = record.row()
        shown = [row.stage, row.photo, f"{row.points:,}", f"{row.behind:,}"]
        shown += ["–" if px is None else f"{px:,.3f}" for px in (row.mean_px, row.median_px, row.rms_px)]
        assert any(r[:7] == shown for r in rows), shown
    for drop in mapped.drops:
        assert [drop.stage, drop.reason, f"{drop.observations:,}"] in rows
    assert [NASTY[4], "21.50", "0.7500"] in rows


def test_photos_are_pooled_per_stage_as_if_their_errors_were_one_set(folder, mapped):
    rows = Page(page_of(folder)).rows
    for stage in ("linear PnP", "before BA", "after BA"):
        errors = np.concatenate([r.errors() for r in mapped.records if r.stage == stage])
        (row,) = (r for r in rows if r[0] == stage and len(r) == 7)
        assert row[2] == f"{len(errors):,}"
        assert row[4:6] == [f"{errors.mean():.3f}", f"{np.sqrt(np.mean(errors**2)):.3f}"]


def test_key_numbers_and_verdicts_stand_first(folder):
    text = " ".join("".join(Page(page_of(folder)).text).split())
    for part in (
        "4 of 5",
        "21.50 dB",
        "1 min 33 s",
        "0.012°",
        "not registered: sees 3 points",
        "8 <bit>",
        "seed 7",
        "4 + 2",
    ):
        assert part in text
    assert "focal <length> from EXIF" in text
    assert "fx 800, fy 810.5, cx 505, cy 370" in text
    assert "f 80 ± 0.25, cx 45, cy 30, k 0.1 ± 0.01" in text
    assert "weak: <b>few</b> points" in text
    assert "/home/someone" not in page_of(folder)  # where a run's photos lay is nobody's business


def test_every_stage_has_its_figures(folder):
    index = read_index(folder / "figures")
    sections = [f.section for f in index.figures if f.part == "mapping"]
    for section in ("matches", "two-view", "triangulation", "registration", "bundle", "errors", "model"):
        assert section in sections
    assert [f.section for f in index.figures if f.part == "field"] == ["field", "field"]
    assert all(f.caption.endswith(".") and f.title for f in index.figures)
    images = [v for _, n, v in Page(page_of(folder)).attributes if n in ("src", "srcset")]
    assert len(images) == sum(1 + (f.dark is not None) for f in index.figures) + len(index.thumbnails)
    for image in images:
        kind, content = image.split(",")
        if "svg" in kind:
            assert_svg_is_inert(base64.b64decode(content))
        else:
            Image.open(io.BytesIO(base64.b64decode(content))).verify()


def assert_svg_is_inert(svg: bytes) -> None:
    """Shapes, text and pictures inside the file; nothing that acts, styles, or is loaded."""
    for element in ET.fromstring(svg).iter():
        assert element.tag.split("}")[1] in {"svg", "g", "defs", "use", "path", "rect", "circle", "text", "image"}
        for name, value in element.attrib.items():
            assert name != "style"
            assert not name.startswith("on")
            assert "url(" not in value
            if "href" in name:
                assert re.fullmatch(r"#[a-z0-9-]+|data:image/(png|jpeg);base64,[A-Za-z0-9+/=]+", value)


def test_figures_and_page_come_out_the_same_bytes_twice(folder, mapped, tmp_path):
    kinds = ("track-lengths", "matches-", "perspective")
    again = [f for f in mapping_figures(mapped, photo_of, OPTIONS) if f.key.startswith(kinds)]
    index = write_figures(tmp_path, "mapping", again, thumbnails(NASTY[:4], photo_of))
    assert len(index.figures) == 3
    for path in tmp_path.glob("mapping-*"):
        assert path.read_bytes() == (folder / "figures" / path.name).read_bytes()
    before = page_of(folder)
    write_report(folder)
    assert page_of(folder) == before


@pytest.mark.parametrize("missing", ["run.json", "metrics.json", "curve.json", "figures", "all"])
def test_missing_parts_leave_their_part_out(folder, tmp_path, missing):
    for name in ("run.json", "metrics.json", "curve.json"):
        if missing not in (name, "all"):
            (tmp_path / name).write_bytes((folder / name).read_bytes())
    if missing not in ("figures", "all"):
        (tmp_path / "figures").mkdir()
        for path in (folder / "figures").iterdir():
            (tmp_path / "figures" / path.name).write_bytes(path.read_bytes())
    write_report(tmp_path)
    text = "".join(assert_inert(page_of(tmp_path)).text)
    assert ("Error table" in text) == (missing not in ("run.json", "all"))
    assert ("Held-out views" in text) == (missing not in ("metrics.json", "all"))
    assert ("nothing to report" in text) == (missing == "all")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("run.json", '{"a": 1,\n "b": }', "cannot be read"),
        ("run.json", "[1]", "not what this version writes"),
        ("run.json", '{"version": 3}', r"\$\.version"),
        ("curve.json", "{}", "not what this version writes"),
        ("metrics.json", b"\xff\xfe\x00", "cannot be read"),
        ("figures/index.json", '{"format": 99}', "format 99"),
        ("figures/index.json", '{"format": 1, "figures": [{"section": "x"}], "thumbnails": {}}', "not an index"),
        ("figures/index.json", '{"format": 1, "figures": [], "thumbnails": {"a": "../../secret.svg"}}', "secret"),
        ("figures/index.json", '{"format": 1, "figures": [], "thumbnails": {"a": ["x"]}}', "not an index"),
        ("figures/index.json", "[]", "not an index"),
    ],
)
def test_damaged_files_are_named_and_nothing_is_written(tmp_path, name, content, message):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=message) as error:
        write_report(tmp_path)
    assert path.name in str(error.value)
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize("kind", ["link", "missing"])
def test_an_image_that_is_a_link_out_of_the_folder_or_missing_is_an_input_error(mapped, tmp_path, kind):
    (tmp_path / "figures").mkdir()
    secret = tmp_path / "secret"
    secret.write_text("key")
    if kind == "link":
        (tmp_path / "figures" / "a.svg").symlink_to(secret)
    content = {"format": 1, "figures": [], "thumbnails": {"x": "a.svg"}}
    (tmp_path / "figures" / "index.json").write_text(json.dumps(content))
    record = replace(run_record(mapped), photos=(PhotoVerdict("x", False, "", 0),))
    with pytest.raises(InputError, match=r"a\.svg"):
        RunFolder(tmp_path).write_report(Story(record))


def test_missing_folder_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        write_report(tmp_path / "nowhere")


def test_writing_a_part_again_replaces_it_alone(folder, mapped, tmp_path):
    everything = list(mapping_figures(mapped, lambda name: None, OPTIONS))
    write_figures(tmp_path, "mapping", everything[:2])
    write_figures(tmp_path, "field", [everything[1]])
    first = {p.name for p in tmp_path.iterdir()}
    index = write_figures(tmp_path, "mapping", everything[:1])
    assert [(f.part, f.title) for f in index.figures] == [
        ("field", everything[1].title),
        ("mapping", everything[0].title),
    ]
    stem = f"mapping-{everything[1].key}"
    assert first - {p.name for p in tmp_path.iterdir()} == {f"{stem}.svg", f"{stem}-dark.svg"}
    assert read_index(tmp_path).figures == index.figures


def test_a_run_without_any_registered_photo_has_a_report(mapped, tmp_path):
    graph = type(mapped.graph)(
        mapped.graph.names,
        mapped.graph.keypoints,
        mapped.graph.colors,
        {p: m[:3] for p, m in mapped.graph.matches.items()},
    )
    cameras = mapped.reconstruction.cameras
    run = map_textbook(graph, cameras, np.zeros(4, dtype=np.int64), TextbookOptions(), 0)
    assert not len(run.reconstruction.registered())
    write_figures(tmp_path / "figures", "mapping", mapping_figures(run, lambda name: None))
    RunFolder(tmp_path).write_run(run_record(run))
    write_report(tmp_path)
    assert "not registered" in "".join(assert_inert(page_of(tmp_path)).text)


def test_the_initial_pair_is_shown_first(mapped):
    pairs = pairs_to_show(mapped.graph, (1, 3), 3)
    inliers = [int(mapped.graph.two_views[p].inliers.sum()) for p in pairs]
    assert pairs[0] == (1, 3)
    assert inliers[1] >= inliers[2]
