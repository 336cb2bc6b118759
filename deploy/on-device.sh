#!/usr/bin/env bash
# Sets everything up on a small board (a Jetson, any aarch64 or x86 Linux) and compresses a scene on it.
set -euo pipefail
shopt -s extglob # must be set before bash reads the functions below
# shellcheck source=deploy/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"

usage() {
  cat <<'END'
Usage: deploy/on-device.sh SCENE [OPTIONS OF COMPRESS...]

Sets this checkout up (as deploy/setup.sh does), then compresses SCENE: a .ply, a .fgs or a model folder.

  deploy/on-device.sh garden/point_cloud.ply                       writes garden/point_cloud.fgs
  deploy/on-device.sh garden/point_cloud.ply --effort fast         faster, larger file
  deploy/on-device.sh garden/point_cloud.ply -o /mnt/ssd/garden.fgs --memory-limit 2GiB
  deploy/on-device.sh garden/point_cloud.ply --method paper                       quickest, much larger file
  deploy/on-device.sh garden/point_cloud.ply --method paper -f --max-drop 0.5     again, with the same scores

Options after SCENE go to `flexgs-edge compress` (see .venv/bin/flexgs-edge compress --help). Added unless you give them:

  -o OUT.fgs           beside the scene, under its name
  --memory-limit       a share of the free memory, within the limits of a container
  --score-cache FILE   with --method paper: OUT.scores.npz; scores are computed again only if scene, poses or score change

  FLEXGS_MEMORY_SHARE  that share in percent (default 60, because CPU and GPU of such boards share their memory)
  FLEXGS_VENV, FLEXGS_PYTHON   as for deploy/setup.sh

Device, memory limit and scores go to stderr, the summary of `compress` to stdout. Nothing is overwritten without -f. Exit
codes are those of `compress`. 4: no OpenCL device passes the self-test, and you did not ask for --device numpy (far slower).
END
}

# stdout belongs to `compress`, because --json - writes there.
note() { say "$@" >&2; }

# Reads the options of `compress`, to know which ones to add.
read_options() {
  while [ $# -gt 0 ]; do
    case $1 in
      -h | --help) usage && exit ;;
      --dry-run) dry_run=yes ;;
      # Short flags may be joined: -fo OUT, -qfoOUT.
      --output | -*([fq])o) output=${2:-} ;;
      --output=*) output=${1#*=} ;;
      -*([fq])o?*) output=${1#*o} ;;
      --memory-limit) limit=${2:-} ;;
      --memory-limit=*) limit=${1#*=} ;;
      --method) method=${2:-} ;;
      --method=*) method=${1#*=} ;;
      --score) score=${2:-} ;;
      --score=*) score=${1#*=} ;;
      --score-cache) cache=${2:-} ;;
      --score-cache=*) cache=${1#*=} ;;
      --device) device=${2:-} ;;
      --device=*) device=${1#*=} ;;
    esac
    shift
  done
}

# Sets `output` to the name beside the scene.
name_output() {
  local name=${scene%/}
  [ ! -d "$scene" ] || name=$(cd "$scene" && pwd) # the folder . needs its full name
  case $name in
    *.fgs) die "$scene: give the file to write with -o, since this one is the input" ;;
    *.[pP][lL][yY]) name=${name%.*} ;;
  esac
  output=$name.fgs
}

describe_board() {
  local model
  model=$(tr -d '\0' 2>/dev/null </proc/device-tree/model) || model=$(uname -m)
  note "board: $model, $(nproc) cores"
  [ ! -e /etc/nv_tegra_release ] || note "Jetson Linux $(head -n 1 /etc/nv_tegra_release); docs/jetson.md has advice"
}

case ${1:-} in
  -h | --help) usage && exit ;;
  "" | -*) usage >&2 && exit 2 ;;
esac
scene=$1
shift
dry_run='' output='' limit='' method='' score='' cache='' device=''
read_options "$@"
share=${FLEXGS_MEMORY_SHARE:-60}
[[ $share =~ ^[1-9][0-9]?$ ]] || die "FLEXGS_MEMORY_SHARE=$share: expected a percentage from 1 to 99"
[ -e "$scene" ] || die "$scene: no such scene"
added=()
if [ -z "$output" ]; then
  name_output
  [ -n "$dry_run" ] || added+=(-o "$output")
fi

# The other scripts work in the checkout. This one works where it is called, so VENV must be absolute.
case $VENV in /*) ;; *) VENV=$ROOT/$VENV ;; esac
code=0
"$ROOT/deploy/setup.sh" >&2 || code=$?
if [ "$code" -eq "$NO_DEVICE" ] && [ "$device" != numpy ]; then
  note "see docs/jetson.md for what works on which board; or add --device numpy, which needs no OpenCL and is far slower"
  exit "$code"
fi
[ "$code" -eq 0 ] || [ "$code" -eq "$NO_DEVICE" ] || exit "$code"

describe_board
if [ "$device" = numpy ]; then
  note "device: the NumPy twins, as asked for: the same results, far slower"
else
  note "device:"
  flexgs_edge devices ${device:+--device "$device"} >&2
fi

# Only the program knows its default method and the free memory.
known=$("$VENV/bin/python" -c '
from flexgs_edge.memory.process import available_memory
from flexgs_edge.run.options import CompressOptions
print(CompressOptions.method, available_memory() // 2**20)')
read -r default_method free <<<"$known"
method=${method:-$default_method}
if [ -n "$limit" ]; then
  note "memory limit: $limit, as given"
else
  limit=$((free * share / 100))MiB
  added+=(--memory-limit "$limit")
  note "memory limit: $limit, $share % of the ${free}MiB that are free"
fi

if [ "$method" != paper ]; then
  note "scores: --method $method measures as it goes and keeps none (--method paper is quicker and keeps them)"
elif [ -n "$score" ] && [ "$score" != gs ] && [ "$score" != meson ]; then
  note "scores: from $score"
else
  if [ -z "$cache" ]; then
    cache=${output%.fgs}.scores.npz
    added+=(--score-cache "$cache")
  fi
  if [ -e "$cache" ]; then
    note "scores: from $cache, if they are of this scene and these poses"
  else
    note "scores: made in this run, kept in $cache"
  fi
fi

flexgs_edge compress "$scene" "${added[@]}" "$@"
