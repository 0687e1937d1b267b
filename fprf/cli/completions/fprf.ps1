# Completion of fprf for PowerShell: `fprf --install-completion powershell` says which line of $PROFILE loads it.
Register-ArgumentCompleter -Native -CommandName fprf -ScriptBlock {
    param($word, $ast, $cursor)
    $words = @($ast.CommandElements | Select-Object -Skip 1 | Where-Object { $_.Extent.EndOffset -lt $cursor } | ForEach-Object { $_.ToString() })
    fprf --complete "--word=$word" @words 2>$null | ForEach-Object {
        [System.Management.Automation.CompletionResult]::new($_, $_, 'ParameterValue', $_)
    }
}
