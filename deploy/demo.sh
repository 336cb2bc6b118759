#!/usr/bin/env bash
# Sets everything up, compresses the bundled scene, decompresses the result and renders two views of it.
#
#   deploy/demo.sh
#
# The results are in demo-output/ afterwards.
set -euo pipefail
# shellcheck source=deploy/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$ROOT"

code=0
deploy/setup.sh || code=$?
device=() way=(--effort fast)
if [ "$code" -eq "$NO_DEVICE" ]; then
  say "using --device numpy, which is far slower; so also --method paper, which is quicker and makes larger files"
  device=(--device numpy) way=(--method paper)
elif [ "$code" -ne 0 ]; then
  exit "$code"
fi

run() {
  printf '\n$ flexgs-edge %s\n' "$*"
  flexgs_edge "$@"
}

mkdir -p demo-output
scene=samples/still_life
run compress "$scene/point_cloud.ply" -o demo-output/still_life.fgs -f "${way[@]}" "${device[@]}"
run info demo-output/still_life.fgs
run verify demo-output/still_life.fgs
run decompress demo-output/still_life.fgs -o demo-output/still_life.ply -f
run render demo-output/still_life.fgs -o demo-output/views -f --cameras "$scene/cameras.json" --views 0,40 "${device[@]}"

echo
say "compressed scene   demo-output/still_life.fgs"
say "for any viewer     demo-output/still_life.ply"
say "two views of it    demo-output/views/"
if [ ${#device[@]} -gt 0 ]; then say "made on --device numpy, since no OpenCL device passes the self-test"; fi
