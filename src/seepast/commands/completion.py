"""seepast completion: these commands and their options, completed by a shell."""

from __future__ import annotations

import re
from typing import Literal


def completion(shell: Literal["bash", "zsh", "fish"], /) -> int:
    """Print what makes a shell complete these commands.

    For example, once and for all

      seepast completion bash > ~/.local/share/bash-completion/completions/seepast
      seepast completion fish > ~/.config/fish/completions/seepast.fish
      seepast completion zsh > ~/.zsh/completions/_seepast

    where ~/.zsh/completions is in the fpath of ~/.zshrc: fpath=(~/.zsh/completions $fpath); autoload -U compinit;
    compinit. For the shell at hand only

      eval "$(seepast completion bash)"      or zsh
      seepast completion fish | source

    Parameters
    ----------
    shell
        bash, zsh or fish.
    """
    from ..cli import app

    script = app.generate_completion(shell=shell)
    print(_begun(script) if shell == "zsh" else script)
    return 0


def _begun(script: str) -> str:
    """cyclopts' script for zsh only defines its function. As a file of fpath it is the body of a function that has the
    file's name, and so must call it; after `eval` it must be registered."""
    function = re.search(r"^(_\w+)\(\) *\{", script, re.MULTILINE)
    if function is None or not script.rstrip().endswith("}"):  # another version of cyclopts, which does it itself
        return script
    return (
        f"{script.rstrip()}\n\n"
        "if [[ $funcstack[1] == _* ]]; then\n"
        f'  {function[1]} "$@"\n'
        "else\n"
        f"  compdef {function[1]} seepast\n"
        "fi"
    )
