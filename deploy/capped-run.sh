#!/usr/bin/env bash
# Runs a command under a memory limit that the kernel keeps: a control group, which counts every process and the file cache.
# shellcheck disable=SC2317 # traps and `attempt` call functions by name
set -euo pipefail
# shellcheck source=deploy/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"

usage() {
  cat <<'END'
Usage: deploy/capped-run.sh LIMIT COMMAND [ARGUMENTS...]

Runs COMMAND in a memory control group of its own. LIMIT is 512MiB (2^20), 1.5GB (10^9) or plain bytes, as for --memory-limit.
What the processes of the command hold and the file cache that they fill count together; the kernel drops cache before it kills
a process. Swap does not help.

  deploy/capped-run.sh 512MiB .venv/bin/flexgs-edge compress scene/point_cloud.ply -o scene.fgs --memory-limit 400MiB

Used is what works here, in this order: cgroup version 2, version 1, a scope of systemd-run with version 2 (the user's own one, or
for root the system's). The first two need root, or a group that was handed to the user.

  FLEXGS_CGROUP_ROOT   where control groups are mounted (default /sys/fs/cgroup)

On stderr: what is used, at the end the peak of the group, the peak of its anonymous memory (sampled: shorter peaks are missed),
and whether the cap killed something. Exit code: the command's own; 137: it was killed, by the cap if a line says so; 125: it was
not run (LIMIT wrong, no control group to be had). Ctrl-C and TERM go to the command, which has 10 s to end. Whatever it left
running is killed at the end, and the group removed.
END
}

# Codes below 125 may be the command's. env, timeout and docker take the same one.
# shellcheck disable=SC2034
FAILED=125
CGROUPS=${FLEXGS_CGROUP_ROOT:-/sys/fs/cgroup}
PERIOD=0.1 # seconds between samples
GRACE=10   # seconds that the command has after a signal

# stdout and, but for these lines, stderr belong to the command.
note() { say "$@" >&"$talk"; }

mib() { printf '%d.%d MiB' $(($1 >> 20)) $((($1 & 1048575) * 10 >> 20)); }

# Bytes of a LIMIT; whole numbers only, as bash has no others.
parse_limit() {
  local text=$1 whole fraction unit bytes
  if [[ $text =~ ^\ *([0-9]{1,15})?(\.([0-9]{1,9}))?\ *([A-Za-z]*)\ *$ && -n ${BASH_REMATCH[1]}${BASH_REMATCH[3]} ]]; then
    whole=${BASH_REMATCH[1]:-0} fraction=${BASH_REMATCH[3]} unit=${BASH_REMATCH[4]^^}
    case $unit in
      "" | B) unit=1 ;;
      KB) unit=1000 ;;
      MB) unit=1000000 ;;
      GB) unit=1000000000 ;;
      KIB) unit=$((1 << 10)) ;;
      MIB) unit=$((1 << 20)) ;;
      GIB) unit=$((1 << 30)) ;;
      *) unit= ;;
    esac
    if [ -n "$unit" ] && [ $((10#$whole)) -lt $(((1 << 62) / unit)) ]; then
      bytes=$((10#$whole * unit))
      [ -z "$fraction" ] || bytes=$((bytes + 10#$fraction * unit / 10 ** ${#fraction}))
      if [ "$bytes" -gt 0 ]; then
        printf '%s' "$bytes"
        return
      fi
    fi
  fi
  die "LIMIT '$text': expected a number above zero and a unit such as 700000000, 1.5GB (10^9) or 512MiB (2^20)"
}

# Sets OWN to the path of this process's group in the hierarchy whose line of /proc/self/cgroup matches the pattern.
own_group() {
  local line
  OWN=
  while read -r line; do
    if [[ $line =~ $1 ]]; then OWN=${line#*:*:}; fi
  done </proc/self/cgroup
}

# Runs a command; where it fails, its last words go to WHY_NOT.
attempt() {
  WHY_NOT=$({ "$@"; } 2>&1) && return
  WHY_NOT=${WHY_NOT%%$'\n'*} WHY_NOT=${WHY_NOT##*: }
  return 1
}

# Writes $1 to the file $2. In a process of its own where $1 is 0 and the file cgroup.procs: the one that writes is moved.
put() { echo "$1" >"$2"; }

# Sets group to a new group in the folder $1, limited; else says why not in WHY. $2: name of the file with the limit.
make_group() {
  local parent=$1 limit_file=$2 file value
  group=$parent/flexgs-capped-$$
  if ! attempt mkdir "$group"; then
    WHY="cannot make a group in $parent ($WHY_NOT)"
    group=
    return 1
  fi
  # A folder of a hierarchy without the memory controller (or no control group at all) has no such file.
  if [ ! -e "$group/$limit_file" ]; then
    WHY="groups made in $parent have no $limit_file: the memory controller is not handed down to them"
  elif ! attempt put 0 "$group/cgroup.procs"; then
    WHY="cannot put a process into $group ($WHY_NOT)"
  elif ! attempt put "$limit" "$group/$limit_file"; then
    WHY="cannot set $group/$limit_file ($WHY_NOT)"
  else
    # Version 2: memory.swap.max counts swap alone; version 1: memsw counts both, and swappiness helps where it is missing.
    for file in memory.swap.max:0 memory.memsw.limit_in_bytes:"$limit" memory.swappiness:0; do
      value=${file#*:} file=$group/${file%%:*}
      if [ -e "$file" ] && ! attempt put "$value" "$file"; then note "swap: cannot set $file ($WHY_NOT)"; fi
    done
    return 0
  fi
  rmdir "$group" 2>/dev/null || true
  group=
  return 1
}

# Version 2. A group with processes cannot hand controllers down (but for the root), so the parents are tried after the own group.
# With $1, the group is a scope made for this script, which then moves into a leaf of it.
try_v2() {
  local place=$CGROUPS at parent
  [ -e "$place/cgroup.controllers" ] || place=$CGROUPS/unified
  WHY="$CGROUPS has no cgroup.controllers"
  [ -e "$place/cgroup.controllers" ] || return 1
  WHY="the memory controller is not among those of $place"
  grep -qw memory "$place/cgroup.controllers" || return 1
  own_group '^0::'
  WHY="/proc/self/cgroup names no group"
  [ -n "$OWN" ] || return 1
  at=${OWN%/}
  if [ -n "${1:-}" ]; then
    parent=$place$at
    if ! attempt mkdir -p "$parent/watch" || ! attempt put $$ "$parent/watch/cgroup.procs"; then
      WHY="the scope $parent is not this user's to divide ($WHY_NOT)"
      return 1
    fi
  fi
  while :; do
    parent=$place$at
    # From inside a container the path may be the host's: the folders that are there count.
    if [ -e "$parent/cgroup.procs" ]; then
      if ! grep -qw memory "$parent/cgroup.subtree_control"; then
        attempt put +memory "$parent/cgroup.subtree_control" || true
      fi
      if make_group "$parent" memory.max; then return 0; fi
      # Beside a group with a limit, the command would be out of that limit's reach.
      if [ -z "$at" ] || [ -n "${1:-}" ] || [ "$(cat "$parent/memory.max" 2>/dev/null || echo max)" != max ]; then return 1; fi
    elif [ -z "$at" ]; then
      return 1
    fi
    at=${at%/*}
  done
}

# Version 1: a group inside the own one, so that whatever limits this script limits the command as well.
try_v1() {
  local place=$CGROUPS/memory at
  WHY="$place has no memory.limit_in_bytes"
  [ -e "$place/memory.limit_in_bytes" ] || return 1
  own_group '^[0-9]+:([^:]*,)?memory(,[^:]*)?:'
  at=${OWN%/}
  while [ -n "$at" ] && [ ! -d "$place$at" ]; do at=${at%/*}; done
  make_group "$place$at" memory.limit_in_bytes
}

# Starts this script again in a scope of its own; comes back only where that cannot work.
try_systemd() {
  local words=(systemd-run --scope --quiet --collect --no-ask-password -p Delegate=yes) said
  [ "$(id -u)" -eq 0 ] || words+=(--user)
  WHY="systemd-run is not installed"
  command -v systemd-run >/dev/null || return 1
  # The scope is only asked for; the limit is set by this script, in a group inside it that holds the command and nothing else.
  if said=$("${words[@]}" -- "$BASH" "${BASH_SOURCE[0]}" --in-scope "$limit" true 2>&1); then
    exec "${words[@]}" -- "$BASH" "${BASH_SOURCE[0]}" --in-scope "$limit" "$@"
  fi
  WHY=$(printf '%s\n' "$said" | sed -n '1s/^error: //;1p')
}

find_group() {
  local tried=()
  if [ -n "$in_scope" ]; then
    if try_v2 scope; then
      used="a scope of systemd-run, cgroup v2"
      return
    fi
    die "$WHY"
  fi
  if try_v2; then
    used="cgroup v2"
    return
  fi
  tried+=("cgroup v2: $WHY")
  if try_v1; then
    used="cgroup v1"
    return
  fi
  tried+=("cgroup v1: $WHY")
  try_systemd "$@" || true
  tried+=("systemd-run --scope: $WHY")
  die "no memory control group can be had here, so nothing was run" "${tried[@]}" \
    "what to do: run it as root (sudo deploy/capped-run.sh ...), or as a user whom systemd gives scopes (a login session)," \
    "or in a container with a limit of its own (docker run --memory 512m --memory-swap 512m ...);" \
    "if control groups are mounted elsewhere, name the place in FLEXGS_CGROUP_ROOT"
}

# Does the terminal send Ctrl-C to the command itself? Then passing it on would be a second one, in the middle of its clean-up.
at_terminal() {
  local stat fields
  stat=$(<"/proc/$$/stat")
  read -ra fields <<<"${stat##*) }" # state, parent, process group, session, terminal, its foreground group
  [ "${fields[2]}" = "${fields[5]}" ]
}

on_signal() {
  [ -n "$child" ] || exit "$2"
  deadline=$((SECONDS + GRACE))
  if [ "$1" != INT ] || ! at_terminal; then kill -s "$1" "$child" 2>/dev/null || true; fi
}

# Kills every process of the group, also those of groups that the command made inside; says how many there were in KILLED.
kill_group() {
  local pids i
  KILLED=0
  for ((i = 0; i < 100; i++)); do
    mapfile -t pids < <(find "$group" -name cgroup.procs -exec cat {} + 2>/dev/null)
    [ ${#pids[@]} -gt 0 ] || return 0
    if [ "$i" -eq 0 ]; then KILLED=${#pids[@]}; fi
    kill -KILL "${pids[@]}" 2>/dev/null || true
    nap
  done
}

clean_up() {
  local i
  trap '' INT TERM HUP
  [ -n "$group" ] || return 0
  kill_group
  for ((i = 0; i < 100; i++)); do # processes that have ended may hold the group for a moment
    find "$group" -depth -type d -exec rmdir {} + 2>/dev/null || true
    [ -d "$group" ] || return 0
    nap
  done
  note "the group $group could not be removed"
}

# Not `read -t` on a silent pipe, which would need no process: a signal that is caught meanwhile leaves bash 5.2 hanging.
nap() { sleep "$PERIOD" || true; }

sample() {
  local line lines=() now
  mapfile -t lines 2>/dev/null <"$group/memory.stat" || true
  for line in "${lines[@]}"; do
    case $line in
      # Both count groups inside this one. `rss` of version 1 is anonymous memory, file pages that are mapped left out.
      "anon "* | "total_rss "*)
        now=${line#* } samples=$((samples + 1))
        if [ "$now" -gt "$anonymous" ]; then anonymous=$now; fi
        ;;
    esac
  done
  if [ -z "$peak_file" ] && read -r now 2>/dev/null <"$group/memory.current" && [ "$now" -gt "$peak" ]; then peak=$now; fi
}

count_kills() {
  local key value
  kills=0
  for file in memory.events memory.oom_control; do
    [ -r "$group/$file" ] || continue
    while read -r key value; do
      if [ "$key" = oom_kill ]; then kills=$value; fi
    done <"$group/$file"
  done
}

report() {
  local how
  if [ -n "$peak_file" ]; then
    read -r peak <"$group/$peak_file"
    how=$peak_file
  else
    how="memory.current, sampled every $PERIOD s: this kernel has no memory.peak"
  fi
  note "peak: $peak bytes ($(mib "$peak")) of $limit, file cache included ($how)"
  if [ "$samples" -gt 0 ]; then
    note "peak of anonymous memory: $anonymous bytes ($(mib "$anonymous")), the most of $samples samples, one every $PERIOD s"
  else
    note "peak of anonymous memory: not known (memory.stat could not be read)"
  fi
  count_kills
  if [ "$kills" -gt 0 ] && [ "$status" -eq 137 ]; then
    note "KILLED by the cap: the command needed more than $limit bytes ($(mib "$limit"))"
  elif [ "$kills" -gt 0 ]; then
    note "the cap killed $kills of the command's processes; the command itself ended with status $status"
  fi
}

in_scope=''
if [ "${1:-}" = --in-scope ]; then
  in_scope=yes
  shift
fi
case ${1:-} in
  -h | --help) usage && exit ;;
  "" | -*) usage >&2 && exit "$FAILED" ;;
esac
limit=$(parse_limit "$1") || exit "$FAILED"
shift
[ $# -gt 0 ] || die "no COMMAND after LIMIT: deploy/capped-run.sh 512MiB COMMAND [ARGUMENTS...]"

group='' child='' deadline='' peak_file='' used=''
peak=0 anonymous=0 samples=0 status=0
exec {talk}>&2
trap clean_up EXIT
trap 'on_signal INT 130' INT
trap 'on_signal TERM 143' TERM
trap 'on_signal HUP 129' HUP

find_group "$@"
for file in memory.peak memory.max_usage_in_bytes; do
  if [ -r "$group/$file" ]; then peak_file=$file; fi
done
note "cap: $limit bytes ($(mib "$limit")) by $used, $group"
if [ "$(wc -l </proc/swaps)" -gt 1 ] && [ ! -e "$group/memory.swap.max" ] && [ ! -e "$group/memory.memsw.limit_in_bytes" ]; then
  note "swap is not counted by this kernel: what is swapped out is beyond the cap"
fi

# Bash starts background commands with Ctrl-C ignored and stdin closed: neither is wanted.
(
  trap - INT QUIT TERM HUP EXIT
  exec {talk}>&-
  echo 0 >"$group/cgroup.procs"
  exec "$@"
) <&0 &
child=$!
{
  while kill -0 "$child"; do
    sample
    nap
    if [ -n "$deadline" ] && [ "$SECONDS" -ge "$deadline" ]; then
      note "the command did not end within $GRACE s of the signal: killing it"
      kill_group
      deadline=
    fi
  done
  wait "$child" || status=$?
} 2>/dev/null # where bash tells of killed commands in words of its own
report
kill_group
if [ "$KILLED" -gt 0 ]; then note "$KILLED processes that the command had left running were killed"; fi
exit "$status"
