"""Repeats the experiments of the FlexGaussian paper on a scene; see docs/results/paper.md.

python -m benchmarks.paper SCENE -o DIR [--max-drop DB] [--resolution PIXELS] [--device SPEC] [--force]
"""

from __future__ import annotations

import argparse

from benchmarks.paper.study import study_paper
from flexgs_edge.progress import Progress
from flexgs_edge.run.options import CompressOptions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a .ply or a model folder, with its cameras")
    parser.add_argument("-o", "--output", required=True, metavar="DIR", help="for index.html, tables and charts")
    parser.add_argument("--max-drop", type=float, default=1.0, metavar="DB", help="what the search aims at")
    parser.add_argument("--resolution", type=int, default=CompressOptions.resolution, help="most pixels of a width")
    parser.add_argument("--device")
    parser.add_argument("--force", action="store_true", help="replace an earlier page")
    words = vars(parser.parse_args())
    scene, output = words.pop("scene"), words.pop("output")
    print(study_paper(scene, output, CompressOptions(**words), Progress()).summary(), end="")


if __name__ == "__main__":
    main()
