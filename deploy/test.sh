#!/usr/bin/env bash
# Sets everything up and runs the whole test suite. Tests must cover at least 90 % of the package's lines.
#
#   deploy/test.sh [PYTEST ARGUMENTS]     for example: deploy/test.sh -k container -x
#
# With arguments coverage is not checked, because they mostly choose a part of the tests.
# Without a working OpenCL device this fails; nothing is skipped.
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

# Oclgrind runs kernels and checks memory accesses and races. Debian 13 has dropped it; its tests are skipped there.
if ! command -v oclgrind >/dev/null; then
  apt_install oclgrind 2>/dev/null || say "no oclgrind here: its tests are skipped"
fi

# A second OpenCL runtime, which tests turn on by themselves (RUSTICL_ENABLE). Without it, they are skipped.
if [ ! -e /etc/OpenCL/vendors/rusticl.icd ]; then
  apt_install mesa-opencl-icd 2>/dev/null || say "no mesa-opencl-icd here: the tests of a second OpenCL runtime are skipped"
fi

# The tests of pages need browsers. Without them they are skipped. Firefox draws with WebGL2 on a screen only, which Xvfb is.
if ! command -v chromium >/dev/null && ! command -v google-chrome >/dev/null; then
  apt_install chromium 2>/dev/null || say "no browser here: the tests of report pages are skipped"
fi
if ! command -v firefox-esr >/dev/null && ! command -v firefox >/dev/null; then
  apt_install firefox-esr 2>/dev/null || say "no Firefox here: the viewer's tests in a second browser are skipped"
fi
if ! command -v Xvfb >/dev/null; then
  apt_install xvfb 2>/dev/null || say "no Xvfb here: the viewer's tests in a second browser are skipped"
fi

# Independent programs that read the files we write. Without npm their tests are skipped.
node_packages=(@playcanvas/splat-transform@2.7.1 gltf-validator@2.0.0-dev.3.10 playcanvas@2.23.3 three@0.187.0
  @sparkjsdev/spark@2.2.0 @cesium/engine@24.0.0 typescript@5.9.3 react@18.3.1 react-dom@18.3.1)
if ! command -v npm >/dev/null; then
  say "no npm here: the tests with other programs' readers are skipped"
elif [ "$(cat .node/packages 2>/dev/null)" != "${node_packages[*]}" ]; then
  say "npm install ${node_packages[*]}"
  if npm install --silent --prefix .node --ignore-scripts --no-audit --no-fund --no-save "${node_packages[@]}"; then
    printf '%s' "${node_packages[*]}" >.node/packages
  else
    say "npm could not install them: the tests with other programs' readers are skipped"
  fi
fi

if [ $# -eq 0 ]; then
  rm -f .coverage .coverage.* # a killed run leaves these
  # Most of the suite is Python in one thread, so two processes help. Each takes whole files, so that fixtures are made once.
  set -- --numprocesses=2 --dist=loadfile --cov=flexgs_edge --cov-report=term --cov-fail-under=90
fi
exec "$VENV/bin/python" -m pytest "$@"
