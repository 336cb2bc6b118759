#!/usr/bin/env bash
# Sets everything up and runs the whole test suite; at least 90 % of the package's lines must have run.
#
#   deploy/test.sh [PYTEST ARGUMENTS]     for example: deploy/test.sh -k container -x
#
# With arguments the coverage is not judged, since they mostly choose a part of the tests.
# No working OpenCL device is a failure here, not a skip.
set -euo pipefail
# shellcheck source=deploy/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$ROOT"

code=0
deploy/setup.sh test || code=$?
if [ "$code" -eq "$NO_DEVICE" ]; then
  die "the tests need an OpenCL device, and none passes the self-test" "with root: sudo apt install pocl-opencl-icd"
fi
[ "$code" -eq 0 ] || exit "$code"

# Runs the kernels under a checker of memory accesses and races. Debian 13 has dropped it: those tests then skip.
if ! command -v oclgrind >/dev/null; then
  apt_install oclgrind 2>/dev/null || say "no oclgrind here: its tests are skipped"
fi

# Opens the pages of reports: those tests skip where there is no browser.
if ! command -v chromium >/dev/null && ! command -v google-chrome >/dev/null; then
  apt_install chromium 2>/dev/null || say "no browser here: the tests of report pages are skipped"
fi

if [ $# -eq 0 ]; then
  rm -f .coverage .coverage.* # left by a run that was killed
  # Most of the suite is Python in one thread: two processes, whole files each, so that fixtures are made once.
  set -- --numprocesses=2 --dist=loadfile --cov=flexgs_edge --cov-report=term --cov-fail-under=90
fi
exec "$VENV/bin/python" -m pytest "$@"
