"""Every real set and every made set with a truth in one table.

    python -m benchmarks.reality [SET ...] [--half develop] [--seeds 0 1 2] [--keep FOLDER] [--threads 2] [--large]
        [--notes] [--out ROWS.json] [--table TABLE.md]

A set is named in `benchmarks.real_sets`, with the half that it belongs to: heuristics are made on one half and
confirmed on the other. A model is right where its rotations are within 2 degrees of the truth, all of them, and its
positions within 5 percent of the extent; it is wrong beyond 4 degrees or 10 percent. Loose truth counts photos.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.data import DATA
from benchmarks.real_sets import Input, RealSet, chosen
from benchmarks.rows import QUALITY, TIMES, Better, Row, add_out_option, write_rows
from benchmarks.truth_errors import LooseCounts, TruthErrors, loose_counts, truth_errors
from fieldstone.errors import InputError
from fieldstone.io.files.cache import UnitCache
from fieldstone.io.given_matches.matching_txt import is_given_matches_folder
from fieldstone.progress import silent
from fieldstone.records.mapping import Grade
from fieldstone.run.mapper_checkpoint import MapperCheckpoints
from fieldstone.run.matching.photos_to_graph import MatchedPhotos, match_photos, read_matched_photos
from fieldstone.run.reconstruct import graded, run_mapper, run_record
from fieldstone.run.reconstruct_options import ReconstructOptions
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Reconstruction

RIGHT_DEG, RIGHT_SHARE = 2.0, 0.05
WRONG_DEG, WRONG_SHARE = 4.0, 0.1
ERRORS = 0.25
"""How much an error against the truth scatters with the seed, as a share."""

GRADES = {"good": 0, "weak": 1, "doubtful": 2}

Verdict = Literal["right", "between", "wrong", "refused", ""]


@dataclass(frozen=True)
class Outcome:
    """What came of one set with one seed."""

    name: str
    half: str
    expected: int
    seed: int
    seconds: float
    refused: str | None = None
    """Why nothing was reconstructed."""
    sizes: tuple[int, ...] = ()
    """Registered photos of every model, the largest first."""
    pairs_lost: int = 0
    """Verified pairs that had no part."""
    pairs: int = 0
    """Verified pairs."""
    cameras: str = ""
    errors: TruthErrors | None = None
    counts: LooseCounts | None = None
    metric: bool = False
    grade: str = ""
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Whether the truth agrees; empty where there is none, or too little was registered to say."""
        if self.refused is not None:
            return "refused"
        if self.counts is not None:
            return "wrong" if self.counts.wrong_largest > 0.1 * self.counts.right_largest else "right"
        if self.errors is None or self.errors.rotation_deg is None or self.errors.position_share is None:
            return ""
        rotation, position = self.errors.rotation_deg, self.errors.position_share
        if rotation > WRONG_DEG or position > WRONG_SHARE:
            return "wrong"
        return "right" if rotation <= RIGHT_DEG and position <= RIGHT_SHARE else "between"


def main(arguments: Sequence[str] | None = None) -> int:
    """Reconstruct every set, print the table as it grows, and write rows and table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", help="names of sets; default: all but the large ones")
    parser.add_argument("--half", choices=("develop", "confirm"))
    parser.add_argument("--large", action="store_true", help="also sets that take minutes")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for features and matches, which later runs of one code find")
    parser.add_argument("--notes", action="store_true", help="also print what the runs say")
    parser.add_argument("--table", type=Path, help="file for the table (Markdown)")
    add_out_option(parser, "reality")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.ERROR)
    outcomes: list[Outcome] = []
    sys.stdout.write("\n".join(HEAD) + "\n")
    with tempfile.TemporaryDirectory() as temporary:
        keep = given.keep or Path(temporary)
        for each in chosen(given.sets, given.half, large=given.large):
            if not each.is_present():
                sys.stdout.write(f"skipped {each.name}: no {each.needs} in the data; set FIELDSTONE_DATA\n")
                continue
            for seed in given.seeds:
                outcomes.append(reconstruct_set(each, seed, keep, given.threads))
                sys.stdout.write(line(outcomes[-1]) + "\n")
                if given.notes:
                    sys.stdout.writelines(f"    {note}\n" for note in outcomes[-1].notes)
                sys.stdout.flush()
    write_rows([row for outcome in outcomes for row in rows_of(outcome)], given.out)
    if given.table:
        given.table.write_text("\n".join([*HEAD, *map(line, outcomes)]) + "\n")
    return 0


def reconstruct_set(each: RealSet, seed: int, keep: Path, threads: int) -> Outcome:
    """One set with one seed."""
    source, truth = each.source(keep)
    options = ReconstructOptions(seed=seed, threads=threads)
    cache = UnitCache(keep / each.name)
    start = time.perf_counter()
    try:
        matched, given = matched_of(source, options, cache)
        mapper, run = run_mapper(matched, options, MapperCheckpoints(UnitCache()), silent, given=given)
    except InputError as error:
        why = str(error).replace(f"{DATA}/", "")
        return Outcome(each.name, each.half, each.expected, seed, time.perf_counter() - start, refused=why)
    seconds = time.perf_counter() - start
    record = run_record(Path(each.name), mapper, run, matched, graded(run, matched, options), seed, {})
    models = (run.reconstruction, *run.others)
    before, after = (verified(graph) for graph in (matched.graph, run.graph))
    loose = each.truth == "loose"
    return Outcome(
        each.name,
        each.half,
        each.expected,
        seed,
        seconds,
        sizes=tuple(size for size in record.components if size),
        pairs_lost=len(before - after),
        pairs=len(before),
        cameras=cameras_of(run.reconstruction),
        errors=None if truth is None or loose else truth_errors(models[0], truth, cameras=each.truth != "poses"),
        counts=loose_counts(models, truth) if truth is not None and loose else None,
        metric=each.truth == "metric",
        grade="" if record.grade is None else record.grade.word,
        notes=(*record.notes, *(() if record.grade is None else grade_lines(record.grade))),
    )


def matched_of(source: Input, options: ReconstructOptions, cache: UnitCache) -> tuple[MatchedPhotos, bool]:
    """Verified matches, and whether they were given without the geometry of pairs."""
    if isinstance(source, MatchedPhotos):
        return source, False
    if is_given_matches_folder(source):
        return read_matched_photos(source), True
    return match_photos(source, options.matching(), options.seed, cache), False


def verified(graph: MatchGraph) -> set[tuple[int, int]]:
    """Pairs that one geometry explains."""
    return {pair for pair, two_view in graph.two_views.items() if two_view.inliers.any()}


def cameras_of(model: Reconstruction) -> str:
    """Model and focal lengths of the cameras with registered photos; of many, their number and range."""
    used = sorted({model.views[v].camera for v in model.registered().tolist()})
    if not used:
        return "-"
    found = [model.cameras[c] for c in used]
    if len(found) > 2:
        focal = np.array([float(np.sqrt(np.prod(camera.focal))) for camera in found])
        kinds = "/".join(sorted({camera.model for camera in found}))
        return f"{len(found)} cameras, {kinds}, f {focal.min():.0f} to {focal.max():.0f}"
    return "; ".join(f"{c.model} {'/'.join(f'{f:.1f}' for f in dict.fromkeys(c.focal.tolist()))}" for c in found)


def grade_lines(grade: Grade) -> list[str]:
    """The numbers of a grade, and its reasons."""
    shares = (grade.matches_kept, grade.matches_denied, grade.error_added, grade.matches_turned)
    numbers = "kept {}, denied {}, error added {}, turned {}".format(
        *("-" if s is None else f"{s:.3f}" for s in shares)
    )
    return [f"grade {grade.word}: {numbers}", *(f"grade {r.word}: {r.reason}" for r in grade.reasons)]


HEAD = (
    "| set | half | seed | registered | models | pairs lost | cameras, f px | rotation max / mean deg | position max % "
    "| mean mm | focal % | corner px | loose: right, wrong (largest; all) | truth says | grade | s |",
    "|" + "---|" * 16,
)
"""Of the table: names and rule."""


def line(outcome: Outcome) -> str:
    """One row of the table."""
    if outcome.refused is not None:
        return (
            f"| {outcome.name} | {outcome.half} | {outcome.seed} | refused, expected "
            f"{outcome.expected or 'that'} | {outcome.refused} |" + " |" * 11
        )
    errors, counts = outcome.errors or TruthErrors(0), outcome.counts
    mm = None if errors.position_mean is None or not outcome.metric else 1e3 * errors.position_mean
    share = None if errors.position_share is None else 100.0 * errors.position_share
    loose = ""
    if counts is not None:
        loose = f"{counts.right_largest}, {counts.wrong_largest}; {counts.right_all}, {counts.wrong_all}"
    cells = [
        outcome.name,
        outcome.half,
        str(outcome.seed),
        f"{outcome.sizes[0] if outcome.sizes else 0} of {outcome.expected or 'none'}",
        " + ".join(map(str, outcome.sizes)),
        f"{outcome.pairs_lost} of {outcome.pairs}",
        outcome.cameras,
        " / ".join(filter(None, [_cell(errors.rotation_deg, 3), _cell(errors.rotation_mean_deg, 3)])),
        _cell(share, 3),
        _cell(mm, 1),
        _cell(errors.focal_percent, 2),
        _cell(errors.corner_px, 1),
        loose,
        outcome.verdict,
        outcome.grade,
        f"{outcome.seconds:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def rows_of(outcome: Outcome) -> Iterator[Row]:
    """The numbers of an outcome that are compared between versions."""
    errors, counts = outcome.errors or TruthErrors(0), outcome.counts
    numbers: list[tuple[str, float | None, str, Better, float]] = [
        ("registered", outcome.sizes[0] if outcome.sizes else 0, "photos", "higher", QUALITY),
        ("pairs lost", outcome.pairs_lost, "pairs", "lower", QUALITY),
        ("rotation", errors.rotation_deg, "deg", "lower", ERRORS),
        ("position", errors.position_share, "of the extent", "lower", ERRORS),
        ("focal", errors.focal_percent, "%", "lower", ERRORS),
        ("right in largest", counts and counts.right_largest, "photos", "higher", QUALITY),
        ("wrong in largest", counts and counts.wrong_largest, "photos", "lower", QUALITY),
        ("right in all", counts and counts.right_all, "photos", "higher", QUALITY),
        ("wrong in all", counts and counts.wrong_all, "photos", "lower", QUALITY),
        ("grade", GRADES.get(outcome.grade), "0 good, 1 weak, 2 doubtful", "lower", QUALITY),
        ("time", outcome.seconds, "s", "lower", TIMES),
    ]
    for metric, value, unit, better, tolerance in numbers:
        if value is not None:
            yield Row(f"reality/{outcome.name}/seed {outcome.seed}/{metric}", float(value), unit, better, tolerance)


if __name__ == "__main__":
    sys.exit(main())
