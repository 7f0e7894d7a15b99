#!/bin/bash
# complete.sh PROGRAM WORD ...: what bash completes the last word to, asked as bash does: the command, the word, the one before.
set -euo pipefail
eval "$("$1" completions bash)"
complete -p "$1" >/dev/null
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
"_$1" "$1" "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD - 1]}"
echo "${COMPREPLY[@]}"
