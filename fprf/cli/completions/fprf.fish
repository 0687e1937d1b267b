# Completion of fprf for fish: `fprf --install-completion fish` puts it where fish finds it.
function __fprf_complete
    set -l words (commandline -opc)
    set -l word (commandline -ct)
    set -l found (fprf --complete "--word=$word" $words[2..-1] 2>/dev/null)
    if test (count $found) -gt 0
        printf '%s\n' $found
    else
        __fish_complete_path $word
    end
end
complete -c fprf -f -a '(__fprf_complete)'
