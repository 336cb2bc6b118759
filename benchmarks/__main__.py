"""Runs all benchmarks, each in its own process: JSON lines go to a file, a table goes to the terminal.

python -m benchmarks [view splats peak quantize codec coder search twins compress] [--json FILE]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.harness import run_module, table

ALL = ("view", "splats", "peak", "quantize", "codec", "coder", "search", "twins", "compress")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(ALL)}; default: all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="append the JSON lines to this file")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(ALL))
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(ALL)}")
    lines: list[str] = []
    for name in options.names or ALL:
        print(f"{name} ...", file=sys.stderr, flush=True)
        lines += run_module(name).splitlines()
    if options.json:
        with open(options.json, "a", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines)
    print(table(lines))


if __name__ == "__main__":
    main()
