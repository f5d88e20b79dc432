"""seepast completion: these commands and their options, completed by a shell."""

from __future__ import annotations

from typing import Literal


def completion(shell: Literal["bash", "zsh", "fish"], /) -> int:
    """Print what makes a shell complete these commands.

    For example, once and for all

      seepast completion bash > ~/.local/share/bash-completion/completions/seepast
      seepast completion fish > ~/.config/fish/completions/seepast.fish
      seepast completion zsh > ~/.zsh/completions/_seepast

    where ~/.zsh/completions is in the fpath of ~/.zshrc: fpath=(~/.zsh/completions $fpath); autoload -U compinit;
    compinit. For the shell at hand only

      eval "$(seepast completion bash)"

    Parameters
    ----------
    shell
        bash, zsh or fish.
    """
    from ..cli import app

    print(app.generate_completion(shell=shell))
    return 0
