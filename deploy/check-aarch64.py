#!/usr/bin/env python3
"""Checks with pip's own resolver that every dependency, of the package and its extras, has a wheel for aarch64 Linux.

    deploy/check-aarch64.py [3.10 3.11 3.12]     needs pip and the package index, installs nothing

It takes the dependencies of setup.cfg with the versions of constraints.txt. Extras for developers are left out, and so is
`lpips`: pip fetches whole wheels to look at them, and torch's are gigabytes. pip evaluates markers such as
`python_version < "3.11"` for the Python that runs it, and an index may not say which Python a package requires. So this
script checks both for the wanted Python.
Exit code 0: all resolve; 1: some do not.
"""

from __future__ import annotations

import configparser
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

try:
    from packaging.requirements import Requirement
    from packaging.specifiers import SpecifierSet
    from packaging.utils import canonicalize_name
except ImportError:  # pip brings a copy
    from pip._vendor.packaging.requirements import Requirement
    from pip._vendor.packaging.specifiers import SpecifierSet
    from pip._vendor.packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
VERSIONS = ("3.10", "3.11", "3.12")
LEFT_OUT = ("test", "dev", "lpips")
"""Extras that are not checked, for the reasons above."""
# Wheels for glibc 2.31 or older. Ubuntu 20.04 of JetPack 5 has 2.31, and 22.04 of JetPack 6 has 2.35.
PLATFORMS = (
    "manylinux2014_aarch64",
    "manylinux_2_17_aarch64",
    "manylinux_2_26_aarch64",
    "manylinux_2_27_aarch64",
    "manylinux_2_28_aarch64",
)


def environment(version: str) -> dict[str, str]:
    """Values of markers on the target."""
    return {
        "python_version": version,
        "python_full_version": f"{version}.0",
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
        "platform_machine": "aarch64",
        "platform_system": "Linux",
        "sys_platform": "linux",
        "os_name": "posix",
        "extra": "",
    }


def applies(requirement: Requirement, version: str) -> bool:
    """Whether the target needs a requirement."""
    return requirement.marker is None or bool(requirement.marker.evaluate(environment(version)))


def plain(requirement: Requirement) -> str:
    """The requirement without its marker, because pip would evaluate it for the wrong Python."""
    extras = f"[{','.join(sorted(requirement.extras))}]" if requirement.extras else ""
    return f"{requirement.name}{extras}{requirement.specifier}"


def runtime_requirements() -> list[Requirement]:
    """`install_requires` of setup.cfg, and the extras that users may install on a board."""
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg")
    lists = [settings["options"]["install_requires"]]
    lists += [text for name, text in settings["options.extras_require"].items() if name not in LEFT_OUT]
    lines = [line.strip() for text in lists for line in text.split("\n")]
    found = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return [each for each in found if each.marker is None or each.marker.evaluate({"platform_machine": "aarch64"})]


def constraints(version: str) -> list[str]:
    """The lines of constraints.txt that hold on the target."""
    lines = [line.split("#")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines()]
    found = [Requirement(line) for line in lines if line]
    return [plain(requirement) for requirement in found if applies(requirement, version)]


def resolve(wanted: list[str], version: str) -> list[dict[str, Any]]:
    """The files that pip chooses. Raises `RuntimeError` with pip's message if it finds none."""
    with tempfile.TemporaryDirectory() as folder:
        limits, report = Path(folder) / "constraints.txt", Path(folder) / "report.json"
        limits.write_text("\n".join(constraints(version)) + "\n")
        words = (
            "--quiet --disable-pip-version-check --dry-run --ignore-installed --only-binary=:all: --implementation cp"
        )
        command = [sys.executable, "-m", "pip", "install", *words.split()]
        command += ["--python-version", version, "--target", f"{folder}/target"]
        command += [f"--platform={platform}" for platform in PLATFORMS]
        command += ["--constraint", str(limits), "--report", str(report), *wanted]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr.strip() or done.stdout.strip())
        chosen: list[dict[str, Any]] = json.loads(report.read_text())["install"]
    return chosen


def missing(chosen: list[dict[str, Any]], version: str) -> list[str]:
    """Requirements of chosen packages that pip left out, because it evaluated markers for its own Python."""
    names = {canonicalize_name(item["metadata"]["name"]) for item in chosen}
    required = [Requirement(line) for item in chosen for line in item["metadata"].get("requires_dist", [])]
    return sorted({plain(r) for r in required if applies(r, version) and canonicalize_name(r.name) not in names})


def faults(item: dict[str, Any], version: str) -> list[str]:
    """Reasons why a chosen file would not install on the target."""
    file = item["download_info"]["url"].rsplit("/", 1)[-1]
    requires = SpecifierSet(item["metadata"].get("requires_python") or "")
    found = []
    if not file.endswith(".whl") or not any(file.endswith(f"{kind}.whl") for kind in ("aarch64", "-none-any")):
        found.append(f"{file} is no wheel for aarch64")
    if not requires.contains(f"{version}.99"):
        found.append(f"{file} requires Python {requires}")
    return found


def check(version: str) -> bool:
    """Resolve for one Python version and print the chosen files. Returns False if that fails."""
    wanted = [plain(requirement) for requirement in runtime_requirements() if applies(requirement, version)]
    try:
        chosen = resolve(wanted, version)
        while more := missing(chosen, version):
            wanted += more
            chosen = resolve(wanted, version)
    except RuntimeError as error:
        print(f"aarch64, Python {version}: pip cannot resolve {' '.join(wanted)}\n{error}", file=sys.stderr)
        return False
    bad = [fault for item in chosen for fault in faults(item, version)]
    for fault in bad:
        print(f"aarch64, Python {version}: {fault}", file=sys.stderr)
    if not bad:
        names = sorted(f"{item['metadata']['name']} {item['metadata']['version']}" for item in chosen)
        print(f"aarch64, Python {version}: {len(chosen)} wheels: {', '.join(names)}")
    return not bad


if __name__ == "__main__":
    versions = sys.argv[1:] or list(VERSIONS)
    results = [check(version) for version in versions]
    sys.exit(0 if all(results) else 1)
