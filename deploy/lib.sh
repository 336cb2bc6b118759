# shellcheck shell=bash
# Shared by the scripts of this folder. They source it; nobody runs it.

ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
VENV=${FLEXGS_VENV:-$ROOT/.venv}
# shellcheck disable=SC2034
NO_DEVICE=4 # exit code of `flexgs-edge devices`, and of setup.sh, when no OpenCL device passes the self-test
FAILED=1 # exit code of die; a script that passes on codes of other programs sets another one

say() { printf '==> %s\n' "$*"; }

die() {
  printf 'error: %s\n' "$1" >&2
  shift
  if [ $# -gt 0 ]; then printf '       %s\n' "$@" >&2; fi
  exit "$FAILED"
}

# Sets AS_ROOT to the words that run a command as root. Fails if that would need a password.
can_be_root() {
  if [ "$(id -u)" -eq 0 ]; then
    AS_ROOT=(env)
  elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    AS_ROOT=(sudo -n env)
  else
    return 1
  fi
}

# Installs Debian packages without asking. Fails quietly if there is no apt, or no right to use it.
apt_install() {
  command -v apt-get >/dev/null && can_be_root || return 1
  say "apt-get install $*"
  # The lock needs a time-out, because a fresh machine is often busy with its own updates.
  local apt=("${AS_ROOT[@]}" DEBIAN_FRONTEND=noninteractive apt-get -qq -o Dpkg::Use-Pty=0 -o DPkg::Lock::Timeout=120)
  "${apt[@]}" update || say "apt-get update failed: going on with the old package lists"
  "${apt[@]}" install -y --no-install-recommends "$@" >/dev/null
}

flexgs_edge() { "$VENV/bin/python" -m flexgs_edge "$@"; }
