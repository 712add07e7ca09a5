"""What a user waits for before anything happens: `python -m benchmarks.startup [--runs 15] [--out ROWS.json]`.

Seconds of `import fieldstone` and of `fieldstone --help` in a process of its own, interleaved with a Python that does
nothing, which is the peer: the ratio is 1 where nothing is added. The shortest of the runs counts, because a start can
only be held up.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

from benchmarks.rows import Row, add_out_option, write_rows

COMMANDS = {
    "empty": ["-c", "pass"],
    "import": ["-c", "import fieldstone"],
    "help": ["-m", "fieldstone.cli", "--help"],
}


def main() -> None:
    """Measure and print one line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=15)
    add_out_option(parser, "startup")
    arguments = parser.parse_args()
    seconds: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for run in range(arguments.runs + 1):
        for name, command in COMMANDS.items():
            elapsed = process_seconds(command)
            if run:  # the first fills the cache of the disk
                seconds[name].append(elapsed)
    empty = min(seconds["empty"])
    best = {name: min(seconds[name]) for name in ("import", "help")}
    rows = [
        Row(f"startup/{name}", best_s, "s", "lower", peer="empty Python", peer_value=empty)
        for name, best_s in best.items()
    ]
    for row in rows:
        sys.stdout.write(f"{row.metric:16s} {row.value:.3f} s, {row.value - empty:.3f} s over an empty Python\n")
    write_rows(rows, arguments.out)


def process_seconds(arguments: list[str]) -> float:
    """Wall seconds of one Python process."""
    start = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
