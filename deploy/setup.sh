#!/usr/bin/env bash
# Prepares this checkout: makes a virtual environment, installs the package and, if needed, an OpenCL runtime.
#
#   deploy/setup.sh [EXTRAS]     EXTRAS: test, dev or test,dev (see setup.cfg)
#
# FLEXGS_VENV    folder of the virtual environment (default: .venv in the checkout)
# FLEXGS_PYTHON  interpreter to make it with (default: python3)
#
# You may run it again at any time. It skips steps that are done.
# Exit code 0: ready; 4: ready, but no OpenCL device passes the self-test (only `--device numpy` works).
set -euo pipefail
# shellcheck source=deploy/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$ROOT"

EXTRAS=${1:-}
PYTHON=${FLEXGS_PYTHON:-python3}

make_environment() {
  if "$VENV/bin/python" -m pip --version >/dev/null 2>&1; then return; fi
  if [ -e "$VENV" ] && [ ! -e "$VENV/pyvenv.cfg" ] && [ -n "$(ls -A "$VENV")" ]; then
    die "$VENV exists and is no virtual environment" "move it away, or name another folder in FLEXGS_VENV"
  fi
  command -v "$PYTHON" >/dev/null || apt_install python3 python3-venv ||
    die "no Python: $PYTHON is not on the PATH" "install it (sudo apt install python3 python3-venv) or name one in FLEXGS_PYTHON"
  "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
    die "Python 3.10 or newer is needed, $PYTHON is $("$PYTHON" --version 2>&1)" "name a newer one in FLEXGS_PYTHON"

  say "virtual environment $VENV with $("$PYTHON" --version)"
  # Debian and Ubuntu keep ensurepip, which `venv` needs, in a package of its own.
  "$PYTHON" -m venv --clear "$VENV" >/dev/null 2>&1 && return
  if apt_install python3-venv && "$PYTHON" -m venv --clear "$VENV"; then return; fi
  "$PYTHON" -m virtualenv --clear --quiet "$VENV" 2>/dev/null && return
  die "$PYTHON cannot make virtual environments with pip in them" \
    "with root: sudo apt install python3-venv" \
    "without: name in FLEXGS_PYTHON a Python 3.10 or newer that has venv or virtualenv"
}

# Each extra has a stamp of its own, so that demo, tests and development do not undo each other's work.
install_package() {
  local state stamp extra missing=
  state=$(cat setup.cfg pyproject.toml constraints.txt flexgs_edge/_version.py | cksum)
  for extra in base ${EXTRAS//,/ }; do
    stamp=$VENV/flexgs-edge.$extra
    [ "$(cat "$stamp" 2>/dev/null)" = "$state $ROOT" ] || missing=yes
  done
  [ -n "$missing" ] || return 0
  say "pip install flexgs-edge${EXTRAS:+[$EXTRAS]} (the versions of constraints.txt)"
  "$VENV/bin/python" -m pip install --quiet --disable-pip-version-check --editable ".${EXTRAS:+[$EXTRAS]}" -c constraints.txt ||
    die "pip could not install the packages" "is there a network, and is pip's index the right one ($VENV/bin/pip config list)?"
  for extra in base ${EXTRAS//,/ }; do
    printf '%s\n' "$state $ROOT" >"$VENV/flexgs-edge.$extra"
  done
}

# Returns 0 if some device passes the self-test, and 4 if none does or a runtime crashed. Any other code is a fault of ours.
self_test() {
  local code=0 report
  report=$(flexgs_edge devices --json - 2>&1) || code=$?
  case $code in
    0 | "$NO_DEVICE") return "$code" ;;
    *)
      printf '%s\n' "$report" >&2
      if [ "$code" -gt 128 ]; then
        say "an OpenCL runtime crashed in the self-test (exit code $code, see above)"
        return "$NO_DEVICE"
      fi
      die "the self-test of the OpenCL devices broke down (exit code $code, see above)"
      ;;
  esac
}

make_environment
install_package
if self_test; then
  say "an OpenCL device passes the self-test"
elif apt_install pocl-opencl-icd && self_test; then
  say "PoCL is installed and passes the self-test"
else
  say "no OpenCL device passes the self-test"
  say "to get one: sudo apt install pocl-opencl-icd; to list devices: $VENV/bin/flexgs-edge devices"
  exit "$NO_DEVICE"
fi
