#compdef fprf
# Completion of fprf for zsh: `fprf --install-completion zsh` says which line of ~/.zshrc loads it.
_fprf() {
    local -a found
    found=("${(@f)$(fprf --complete "--word=$PREFIX" "${(@)words[2,CURRENT-1]}" 2>/dev/null)}")
    if [[ -z $found[1] ]]; then
        _files
    elif [[ $found[1] == *= ]]; then
        compadd -S '' -- "${found[@]}"
    else
        compadd -- "${found[@]}"
    fi
}
compdef _fprf fprf
