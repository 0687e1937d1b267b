# Completion of fprf for bash: `fprf --install-completion bash` puts it where bash-completion finds it.
_fprf() {
    local IFS=$'\n'
    local word=${COMP_WORDS[COMP_CWORD]}
    # Bash parts words at equals signs; one alone stands for an empty word behind it.
    [[ $word == "=" ]] && word=
    mapfile -t COMPREPLY < <(fprf --complete "--word=$word" "${COMP_WORDS[@]:1:COMP_CWORD-1}" 2>/dev/null)
    # Behind `REGION=` a reference follows at once.
    [[ ${#COMPREPLY[@]} -gt 0 && ${COMPREPLY[0]} == *= ]] && compopt -o nospace
}
complete -o bashdefault -o default -F _fprf fprf
