#!/usr/bin/env bash
# Runs a command under a memory limit that the kernel enforces, by a control group. It counts all processes and the file cache.
# shellcheck disable=SC2317 # traps and `attempt` call functions by name
set -euo pipefail
# shellcheck source=deploy/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"

usage() {
  cat <<'END'
Usage: deploy/capped-run.sh LIMIT COMMAND [ARGUMENTS...]

Runs COMMAND in a memory control group of its own. LIMIT is 512MiB (2^20), 1.5GB (10^9) or plain bytes, as for --memory-limit.
The memory of all processes of the command and their file cache count together. The kernel drops cache before it kills a
process. Swap does not help.

  deploy/capped-run.sh 512MiB .venv/bin/flexgs-edge compress scene/point_cloud.ply -o scene.fgs --memory-limit 400MiB

It uses the first of these that works: cgroup version 2, version 1, a scope of systemd-run with version 2 (the user's own, or for
root the system's). The first two need root, or a group that belongs to the user.

  FLEXGS_CGROUP_ROOT   where control groups are mounted (default /sys/fs/cgroup)

stderr gets the control group in use and, at the end, the peak of the group, the peak of its anonymous memory (sampled, so short
peaks are missed), and whether the cap killed a process. Exit code: the command's own. 137: it was killed, by the cap if a line
says so. 125: it was not run (wrong LIMIT, or no control group). Ctrl-C and TERM go to the command, which has 10 s to end.
Processes that it leaves running are killed at the end, and the group is removed.
END
}

# Codes below 125 may be the command's. env, timeout and docker use 125 too.
# shellcheck disable=SC2034
FAILED=125
CGROUPS=${FLEXGS_CGROUP_ROOT:-/sys/fs/cgroup}
PERIOD=0.1 # seconds between samples
GRACE=10   # seconds that the command has to end after a signal

# stdout and stderr belong to the command. Only these lines on stderr are ours.
note() { say "$@" >&"$talk"; }

mib() { printf '%d.%d MiB' $(($1 >> 20)) $((($1 & 1048575) * 10 >> 20)); }

# Prints the bytes of a LIMIT, in whole numbers only, because bash has no others.
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

# Sets OWN to the path of this process's group, from the line of /proc/self/cgroup that matches the pattern $1.
own_group() {
  local line
  OWN=
  while read -r line; do
    if [[ $line =~ $1 ]]; then OWN=${line#*:*:}; fi
  done </proc/self/cgroup
}

# Runs a command. If it fails, its error message goes to WHY_NOT.
attempt() {
  WHY_NOT=$({ "$@"; } 2>&1) && return
  WHY_NOT=${WHY_NOT%%$'\n'*} WHY_NOT=${WHY_NOT##*: }
  return 1
}

# Writes $1 to the file $2. Writing 0 to cgroup.procs moves the process that writes, so do that in a process of its own.
put() { echo "$1" >"$2"; }

# Makes a limited group in the folder $1 and sets `group`; on failure sets WHY. $2: name of the file for the limit.
make_group() {
  local parent=$1 limit_file=$2 file value
  group=$parent/flexgs-capped-$$
  if ! attempt mkdir "$group"; then
    WHY="cannot make a group in $parent ($WHY_NOT)"
    group=
    return 1
  fi
  # The file is missing without the memory controller, or if the folder is no control group at all.
  if [ ! -e "$group/$limit_file" ]; then
    WHY="groups made in $parent have no $limit_file: the memory controller is not handed down to them"
  elif ! attempt put 0 "$group/cgroup.procs"; then
    WHY="cannot put a process into $group ($WHY_NOT)"
  elif ! attempt put "$limit" "$group/$limit_file"; then
    WHY="cannot set $group/$limit_file ($WHY_NOT)"
  else
    # In version 2, memory.swap.max counts swap alone. In version 1, memsw counts both; swappiness helps if memsw is missing.
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

# Version 2. Only the root can hold processes and hand controllers down, so we try the own group first, then its parents.
# With $1, the own group is a scope made for this script, and the script moves into a leaf of it.
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
    # Inside a container the path may be the host's, so some of its folders may not exist.
    if [ -e "$parent/cgroup.procs" ]; then
      if ! grep -qw memory "$parent/cgroup.subtree_control"; then
        attempt put +memory "$parent/cgroup.subtree_control" || true
      fi
      if make_group "$parent" memory.max; then return 0; fi
      # Stop at a group with a limit: in a group beside it, the command would escape that limit.
      if [ -z "$at" ] || [ -n "${1:-}" ] || [ "$(cat "$parent/memory.max" 2>/dev/null || echo max)" != max ]; then return 1; fi
    elif [ -z "$at" ]; then
      return 1
    fi
    at=${at%/*}
  done
}

# Version 1. The group goes inside the script's own group, so that limits on this script also hold for the command.
try_v1() {
  local place=$CGROUPS/memory at
  WHY="$place has no memory.limit_in_bytes"
  [ -e "$place/memory.limit_in_bytes" ] || return 1
  own_group '^[0-9]+:([^:]*,)?memory(,[^:]*)?:'
  at=${OWN%/}
  while [ -n "$at" ] && [ ! -d "$place$at" ]; do at=${at%/*}; done
  make_group "$place$at" memory.limit_in_bytes
}

# Starts this script again in a scope of its own. Returns only if that does not work.
try_systemd() {
  local words=(systemd-run --scope --quiet --collect --no-ask-password -p Delegate=yes) said
  [ "$(id -u)" -eq 0 ] || words+=(--user)
  WHY="systemd-run is not installed"
  command -v systemd-run >/dev/null || return 1
  # The scope itself has no limit. Inside it, this script makes a limited group that holds only the command.
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

# Whether the terminal sends Ctrl-C to the command itself. Then we must not pass it on: a second one would hit its clean-up.
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

# Kills all processes of the group, and of groups that the command made inside it. Sets KILLED to their number.
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
  for ((i = 0; i < 100; i++)); do # the group stays busy for a moment after its processes end
    find "$group" -depth -type d -exec rmdir {} + 2>/dev/null || true
    [ -d "$group" ] || return 0
    nap
  done
  note "the group $group could not be removed"
}

# `read -t` on a silent pipe would need no process, but bash 5.2 hangs if it catches a signal meanwhile.
nap() { sleep "$PERIOD" || true; }

sample() {
  local line lines=() now
  mapfile -t lines 2>/dev/null <"$group/memory.stat" || true
  for line in "${lines[@]}"; do
    case $line in
      # Both include groups inside this one. `total_rss` of version 1 is anonymous memory, without mapped file pages.
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
  note "this kernel does not count swap, so swapped memory escapes the cap"
fi

# Bash starts background commands with Ctrl-C ignored and stdin closed. The command needs both.
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
} 2>/dev/null # hides bash's own messages about killed commands
report
kill_group
if [ "$KILLED" -gt 0 ]; then note "$KILLED processes that the command had left running were killed"; fi
exit "$status"
