# Start file of `./xtdrone shell`: the user's own first, so that nothing in it comes before the workspace.
# shellcheck disable=SC1090
[[ -f ~/.bashrc ]] && source ~/.bashrc
# shellcheck disable=SC1091
source "$(dirname "${BASH_SOURCE[0]}")/env.bash"
PS1="(xtdrone) ${PS1:-\\w\\$ }"
# shellcheck disable=SC1091
[[ ! -f "$(dirname "${BASH_SOURCE[0]}")/../.setup/completion.bash" ]] ||
  source "$(dirname "${BASH_SOURCE[0]}")/../.setup/completion.bash"
