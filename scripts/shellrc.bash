# Start file of `./xtdrone shell`: the user's own first, so that nothing in it comes before the workspace.
# shellcheck disable=SC1090
[[ -f ~/.bashrc ]] && source ~/.bashrc
# shellcheck disable=SC1091
source "$(dirname "${BASH_SOURCE[0]}")/env.bash"
PS1="(xtdrone) ${PS1:-\\w\\$ }"
# shellcheck disable=SC1091
[[ ! -f "$(dirname "${BASH_SOURCE[0]}")/../.setup/completion.bash" ]] ||
  source "$(dirname "${BASH_SOURCE[0]}")/../.setup/completion.bash"

# end_jobs: ends what was started with "&" and not disowned, with all processes of its group; programs get time to clean up.
end_jobs() {
  local group groups alive waited
  mapfile -t groups < <(jobs -p)
  ((${#groups[@]} > 0)) || return
  echo "xtdrone: ending what was started in this shell with '&' (disown JOB keeps a job)" >&2
  for group in "${groups[@]}"; do
    kill -TERM -- "-$group" 2>/dev/null
    kill -CONT -- "-$group" 2>/dev/null
  done
  for ((waited = 0; waited < 300; waited++)); do
    alive=()
    for group in "${groups[@]}"; do
      ! kill -0 -- "-$group" 2>/dev/null || alive+=("$group")
    done
    ((${#alive[@]} > 0)) || return
    sleep 0.1
  done
  for group in "${alive[@]}"; do
    kill -KILL -- "-$group" 2>/dev/null
  done
}
trap end_jobs EXIT
