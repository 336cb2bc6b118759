"""Runs every effort on every scene that it finds, and makes the tables of the pages anew.

python -m benchmarks.scenes [--repeats N]

Scenes are the bundled one and the folders of FLEXGS_SCENES with a scene, cameras and photos. The rows go to
docs/results/figures.csv, the table to docs/results/scenes.md.
"""

from __future__ import annotations

import argparse

from benchmarks.figures import EFFORTS, MEAN, SCENES, run, write_tables


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--repeats", type=int, default=1, help="timed runs after the one that is checked; 0: that one counts"
    )
    options = parser.parse_args()
    run(list(SCENES), [*EFFORTS, *MEAN], options.repeats)
    write_tables()


if __name__ == "__main__":
    main()
