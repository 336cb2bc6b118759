#!/usr/bin/env bash
# Sets everything up, compresses the bundled scene, and makes pages that show the result and what it cost.
#
#   deploy/demo.sh
#
# The results are in demo-output/ afterwards, and what the commands said is in demo-output/log.txt.
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

out=demo-output scene=samples/still_life
mkdir -p "$out"
: >"$out/log.txt"

run() {
  printf '\n$ flexgs-edge %s\n' "$*" >>"$out/log.txt"
  flexgs_edge "$@" >>"$out/log.txt" 2>&1 || {
    code=$?
    cat "$out/log.txt"
    exit "$code"
  }
}

say "compressing $scene, at most 1 dB from its photos"
run compress "$scene/point_cloud.ply" -o "$out/still_life.fgs" -f --report "$out/report" "${way[@]}" "${device[@]}"
grep -E '^(wrote|ratio|drop|took):' "$out/log.txt"
say "checking the file, and writing it as a PLY and as a page"
run verify "$out/still_life.fgs"
run decompress "$out/still_life.fgs" -o "$out/still_life.ply" -f
run view "$out/still_life.fgs" -o "$out/still_life.html" -f

say "look at the scene      $out/still_life.html"
say "what it cost           $out/report/index.html"
say "compressed, as a PLY   $out/still_life.fgs, $out/still_life.ply"
if [ ${#device[@]} -gt 0 ]; then say "made on --device numpy, since no OpenCL device passes the self-test"; fi
